"""Friction: Coulomb's closed forms of a box that slides, a ball that slips and rolls, a box on a slope."""

from __future__ import annotations

import numpy as np

from ..case import Case, Motion, box, sphere
from ..judge import position, travelled, yaw
from .free import STEPS, G, sample_times
from .impact import GROUND

MU, GRAVITY = 0.5, 9.81
HALF = (0.2, 0.15, 0.1)
RADIUS = 0.1


def _motion(start, t, way, speed, direction, omega=None) -> Motion:
    """Straight motion: ``way`` and ``speed`` (T, B) along ``direction`` (B, 3)."""
    pos = start.pos + way[:, :, None, None] * direction[:, None]
    vel = speed[:, :, None, None] * np.broadcast_to(direction[:, None], pos.shape)
    same = lambda a: np.broadcast_to(a, (len(t), *a.shape[1:]))
    return Motion(np.asarray(t), pos, same(start.quat), vel, same(start.omega) if omega is None else omega)


def _headed(n, rng, height, low=1.0, high=4.0):
    """Speeds in every direction, lying on the ground."""
    angle, speed = rng.uniform(-np.pi, np.pi, (n, 1)), np.linspace(low, high, n)[:, None]
    pos = np.zeros((n, 1, 3))
    pos[..., 2] = height
    vel = np.stack([speed * np.cos(angle), speed * np.sin(angle), 0 * angle], -1)
    return pos, yaw(rng.uniform(-np.pi, np.pi, (n, 1))), vel, np.zeros((n, 1, 3))


def _along(start):
    v = start.vel[0, :, 0]
    speed = np.linalg.norm(v, axis=-1)
    return speed, v / speed[:, None]


def sliding(start: Motion, t) -> Motion:
    """v0 - mu g t until it stands."""
    v0, direction = _along(start)
    t = np.asarray(t)[:, None]
    now = np.minimum(t, v0 / (MU * GRAVITY))
    return _motion(start, t[:, 0], v0 * now - 0.5 * MU * GRAVITY * now**2, v0 - MU * GRAVITY * now, direction)


def rolling(start: Motion, t) -> Motion:
    """Slips at mu g until it rolls at 5/7 v0."""
    v0, direction = _along(start)
    t = np.asarray(t)[:, None]
    rolls = 2 * v0 / (7 * MU * GRAVITY)
    slip = np.minimum(t, rolls)
    way = v0 * slip - 0.5 * MU * GRAVITY * slip**2 + 5 / 7 * v0 * np.maximum(t - rolls, 0)
    spin = np.cross([0.0, 0.0, 1.0], direction) * (5 / 2 * MU * GRAVITY / RADIUS)
    omega = slip[:, :, None, None] * spin[:, None]
    return _motion(start, t[:, 0], way, v0 - MU * GRAVITY * slip, direction, omega)


def moving(name, title, part, height, law):
    return Case(
        name=name, title=title, group="friction", parts=(part,), planes=GROUND, friction=MU, restitution=None,
        gravity=G, starts=lambda n, rng: _headed(n, rng, height), seconds=1.0, samples=10,
        truth=lambda start: law(start, sample_times(1.0, 10)), reference="closed form", bound=1e-14, error=travelled,
        unit="place after 1 s, over the way", distance=position, steps=STEPS,
        features=frozenset({"contact", "friction", "attitude"}),
    )  # fmt: skip


# --- a slope: gravity leans by theta towards 30 degrees from x, the boxes are turned any way ---

LEAN = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0])


def slope(name, title, ratio):
    """tan(theta) = ratio mu; a box at rest. Below 1 it stays, above it slides at g (sin - mu cos)."""
    theta = np.arctan(ratio * MU)
    sin, cos = np.sin(theta), np.cos(theta)
    pull = GRAVITY * max(sin - MU * cos, 0.0)

    def starts(n, rng):
        pos = np.zeros((n, 1, 3))
        pos[..., 2] = HALF[2]
        return pos, yaw(rng.uniform(-np.pi, np.pi, (n, 1))), np.zeros((n, 1, 3)), np.zeros((n, 1, 3))

    def truth(start):
        t = sample_times(1.0, 10)[:, None] + np.zeros(start.pos.shape[1])
        return _motion(start, t[:, 0], 0.5 * pull * t**2, pull * t, np.broadcast_to(LEAN, (t.shape[1], 3)))

    def error(motion, other, case):
        free = 0.5 * GRAVITY * sin
        return np.linalg.norm(motion.pos[-1, :, 0, :2] - other.pos[-1, :, 0, :2], axis=-1) / free

    gravity = tuple(GRAVITY * (sin * LEAN - cos * np.array([0.0, 0.0, 1.0])))
    return Case(
        name=name, title=title, group="friction", parts=(box(HALF),), planes=GROUND, friction=MU, restitution=None,
        gravity=gravity, starts=starts, seconds=1.0, samples=10, truth=truth, reference="closed form", bound=1e-14,
        error=error, unit="place after 1 s, over the frictionless way", distance=position, steps=STEPS,
        features=frozenset({"contact", "friction", "attitude"}),
    )  # fmt: skip


CASES = (
    moving("slide", "box slides to rest", box(HALF), HALF[2], sliding),
    moving("roll", "ball slips, then rolls", sphere(RADIUS), RADIUS, rolling),
    slope("incline", "box on a slope, tan = 0.95 mu: stays", 0.95),
    slope("push", "box pulled at an angle, 1.2 mu: slides", 1.2),
)
