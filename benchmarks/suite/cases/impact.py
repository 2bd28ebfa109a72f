"""Impacts: closed forms of a ball on a plane, of two spheres, and the energy of a gas."""

from __future__ import annotations

import numpy as np

from ..case import Case, Motion, sphere
from ..judge import energy_change, last_velocity, position
from .free import STEPS, G, sample_times

GROUND = (((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),)
RADIUS = 0.1
ONE = np.array([1.0, 0.0, 0.0, 0.0])


def _still(n, k):
    return np.zeros((n, k, 3))


def _upright(n, k):
    return np.broadcast_to(ONE, (n, k, 4))


# --- a ball that bounces ---


def dropped(n, rng):
    pos = _still(n, 1)
    pos[..., 2] = RADIUS + rng.uniform(0.5, 1.5, (n, 1))
    return pos, _upright(n, 1), _still(n, 1), _still(n, 1)


def bouncing(start: Motion, e: float, t) -> Motion:
    """Arcs between impacts, each beginning at e times the speed the last one ended with."""
    g = 9.81
    h, v = start.pos[0, :, 0, 2] - RADIUS, start.vel[0, :, 0, 2]
    z, vz = np.empty((len(t), len(h))), np.empty((len(t), len(h)))
    for world in range(len(h)):
        height, speed, begin = h[world], v[world], 0.0
        land = begin + (speed + np.sqrt(speed**2 + 2 * g * height)) / g
        for k, now in enumerate(t):
            while now > land:
                height, speed, begin = 0.0, -e * (speed - g * (land - begin)), land
                land = begin + 2 * speed / g
            z[k, world] = height + speed * (now - begin) - 0.5 * g * (now - begin) ** 2
            vz[k, world] = speed - g * (now - begin)
    pos = np.repeat(start.pos, len(t), 0)
    vel = np.zeros_like(pos)
    pos[:, :, 0, 2], vel[:, :, 0, 2] = z + RADIUS, vz
    same = lambda a: np.broadcast_to(a, (len(t), *a.shape[1:]))
    return Motion(np.asarray(t), pos, same(start.quat), vel, same(start.omega))


def bounce(name, title, e):
    return Case(
        name=name, title=title, group="impact", parts=(sphere(RADIUS),), planes=GROUND, friction=None, restitution=e,
        gravity=G, starts=dropped, seconds=2.0, samples=20,
        truth=lambda start: bouncing(start, e, sample_times(2.0, 20)), reference="closed form", bound=1e-14,
        error=position, unit="height, root mean square over 2 s [m]", distance=position, steps=STEPS,
        features=frozenset({"contact", "restitution"}),
    )  # fmt: skip


# --- a ball that strikes the ground at an angle, with spin and friction ---

E_OBLIQUE, MU_OBLIQUE = 0.7, 0.3


def struck(n, rng):
    pos, vel = _still(n, 1), _still(n, 1)
    pos[..., 2] = RADIUS + rng.uniform(0.3, 0.6, (n, 1))
    vel[..., :2], vel[..., 2] = 2 * rng.normal(size=(n, 1, 2)), -1.0
    return pos, _upright(n, 1), vel, 10 * rng.normal(size=(n, 1, 3))


def glancing(start: Motion, t) -> Motion:
    """One impact of a solid sphere: its point of contact sticks, or slips and feels mu (1 + e) v_n (Coulomb)."""
    g, k = 9.81, 0.4
    h, v, w = start.pos[0, :, 0, 2] - RADIUS, start.vel[0, :, 0], start.omega[0, :, 0]
    land = (v[:, 2] + np.sqrt(v[:, 2] ** 2 + 2 * g * h)) / g
    vn = v[:, 2] - g * land
    arm = np.array([0.0, 0.0, -RADIUS])
    slip = v + np.cross(w, arm)
    slip[:, 2] = 0.0
    size = np.linalg.norm(slip, axis=-1, keepdims=True)
    stick = -slip / (1 + 1 / k)
    push = MU_OBLIQUE * (1 + E_OBLIQUE) * -vn[:, None]
    dv = np.where(np.linalg.norm(stick, axis=-1, keepdims=True) <= push, stick, -push * slip / size)
    after_v, after_w = v + dv, w + np.cross(arm, dv) / (k * RADIUS**2)
    after_v[:, 2] = -E_OBLIQUE * vn
    pos, vel, omega = (np.empty((len(t), len(h), 1, 3)) for _ in range(3))
    for i, now in enumerate(t):
        before = (now <= land)[:, None]
        rest = np.maximum(now - land, 0.0)[:, None]
        free = start.pos[0, :, 0] + v * now + 0.5 * np.array(G) * now**2
        touch = start.pos[0, :, 0] + v * land[:, None] + 0.5 * np.array(G) * land[:, None] ** 2
        pos[i, :, 0] = np.where(before, free, touch + after_v * rest + 0.5 * np.array(G) * rest**2)
        vel[i, :, 0] = np.where(before, v + np.array(G) * now, after_v + np.array(G) * rest)
        omega[i, :, 0] = np.where(before, w, after_w)
    return Motion(np.asarray(t), pos, np.broadcast_to(start.quat, (len(t), *start.quat.shape[1:])), vel, omega)


OBLIQUE = Case(
    name="oblique", title="oblique impact with spin and friction", group="impact", parts=(sphere(RADIUS),),
    planes=GROUND, friction=MU_OBLIQUE, restitution=E_OBLIQUE, gravity=G, starts=struck, seconds=0.4, samples=4,
    truth=lambda start: glancing(start, sample_times(0.4, 4)), reference="closed form", bound=1e-14,
    error=last_velocity, unit="velocity and spin after the impact, relative", distance=position, steps=STEPS,
    features=frozenset({"contact", "restitution", "friction", "attitude"}),
)  # fmt: skip


# --- two spheres ---

MASSES, RADII = (1.0, 3.0), (0.1, 0.2)


def aimed(n, rng):
    pos, vel = _still(n, 2), _still(n, 2)
    pos[:, 1, 0] = rng.uniform(0.5, 0.7, n)
    pos[:, 1, 1:] = rng.uniform(-0.15, 0.15, (n, 2))
    vel[:, 0, 0] = rng.uniform(0.8, 1.2, n)
    return pos, _upright(n, 2), vel, _still(n, 2)


def colliding(start: Motion, t) -> Motion:
    """Frictionless, elastic: the relative velocity along the line of centres is reversed when they touch."""
    p, v = start.pos[0], start.vel[0]
    d, u = p[:, 1] - p[:, 0], v[:, 1] - v[:, 0]
    a, b, c = (u * u).sum(-1), (d * u).sum(-1), (d * d).sum(-1) - sum(RADII) ** 2
    meet = (-b - np.sqrt(b * b - a * c)) / a
    n = (d + u * meet[:, None]) / sum(RADII)
    m = 1 / (1 / MASSES[0] + 1 / MASSES[1])
    impulse = -2 * m * (u * n).sum(-1, keepdims=True) * n
    after = np.stack([v[:, 0] - impulse / MASSES[0], v[:, 1] + impulse / MASSES[1]], 1)
    late = np.maximum(np.asarray(t)[:, None] - meet, 0.0)[..., None, None]
    now = np.asarray(t)[:, None, None, None]
    pos = p + v * (now - late) + after * late
    vel = np.where(late > 0, after, v)
    same = lambda x: np.broadcast_to(x, (len(t), *x.shape[1:]))
    return Motion(np.asarray(t), pos, same(start.quat), vel, same(start.omega))


SPHERES = Case(
    name="spheres", title="two spheres collide", group="impact",
    parts=tuple(sphere(r, m) for r, m in zip(RADII, MASSES)), planes=(), friction=None, restitution=1.0,
    gravity=(0.0, 0.0, 0.0), starts=aimed, seconds=1.0, samples=10,
    truth=lambda start: colliding(start, sample_times(1.0, 10)), reference="closed form", bound=1e-14, error=position,
    unit="position, root mean square [m]", distance=position, steps=STEPS,
    features=frozenset({"contact", "restitution", "pairs"}),
)  # fmt: skip


# --- gas ---

ATOMS, ATOM = 16, 0.05


def warm(n, rng):
    grid = np.stack(np.meshgrid(*[np.linspace(0.15, 0.85, 3)] * 3, indexing="ij"), -1).reshape(-1, 3)
    pos = np.stack([grid[rng.permutation(27)[:ATOMS]] for _ in range(n)]) + rng.uniform(-0.05, 0.05, (n, ATOMS, 3))
    vel = rng.normal(size=(n, ATOMS, 3))
    return pos, _upright(n, ATOMS), vel, _still(n, ATOMS)


WALLS = tuple(
    (tuple(1.0 if (k == axis and side < 0) else 0.0 for k in range(3)),
     tuple(float(side) if k == axis else 0.0 for k in range(3)))
    for axis in range(3) for side in (1, -1)
)  # fmt: skip

GAS = Case(
    name="gas", title="16 elastic spheres in a box", group="impact", parts=(sphere(ATOM),) * ATOMS, planes=WALLS,
    friction=None, restitution=1.0, gravity=(0.0, 0.0, 0.0), starts=warm, seconds=2.0, samples=20, truth=None,
    reference="the energy is constant", bound=0.0, error=energy_change, unit="energy, largest change, relative",
    distance=None, steps=STEPS, features=frozenset({"contact", "restitution", "pairs"}),
)  # fmt: skip

CASES = (bounce("bounce", "bouncing ball, e = 0.8", 0.8), bounce("elastic", "bouncing ball, e = 1", 1.0), OBLIQUE,
         SPHERES, GAS)  # fmt: skip
