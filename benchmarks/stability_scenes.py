"""Scenes on which contact solvers fail: columns, pyramids, a card house, friction, bounces, fast bodies, piles.

Every function returns a ``Case``: the scene and what is needed to judge it. SI units, z up; bodies and fixed
geometry have the same friction. Scenes that differ by numbers alone are one scene with batched leaves
(``Case.leaves`` for the model, ``Case.start`` for the state), so that they share a program.
"""

from __future__ import annotations

import dataclasses

import numpy as np

import rbd_jax as rbd

G = 9.81
MU = 0.6
DENSITY = 1000.0
STEP = 1 / 60
FINE = 1 / 240


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene and what is needed to judge it.

    Attributes:
      scene: with its time step.
      size: edge of the bodies, or the smallest half-size d of energy bars where ``depth`` is None [m].
      rest: (n, 3) or (B, n, 3) positions in which the bodies should rest [m].
      leaves: of the model, with a batch axis (B, ...).
      start: arrays of the start state, (B, n, 3 | 4).
      facts: numbers of the scene by name.
    """

    scene: rbd.Scene
    size: float
    rest: np.ndarray | None = None
    leaves: dict = dataclasses.field(default_factory=dict)
    start: dict = dataclasses.field(default_factory=dict)
    facts: dict = dataclasses.field(default_factory=dict)


def _cube(name, size, pos, mu=MU, **kwargs):
    return rbd.Body(name, rbd.Box((size / 2,) * 3), pos=tuple(map(float, pos)), friction=mu, **kwargs)


def _ground(mu=MU, e=None):
    return rbd.Geom(rbd.Plane(), friction=mu, restitution=e, name="ground")


def _turn(axis, angle):
    """Quaternion of a rotation by ``angle`` [rad] about a unit ``axis``."""
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * np.asarray(axis, float)])


def _times(p, q):
    """Product of two quaternions (w, x, y, z)."""
    return np.concatenate([[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])])


# --- columns ---


def column(n, size=1.0, masses=None, offset=0.0, gap=0.0, mu=MU, dt=STEP) -> Case:
    """``n`` cubes of edge ``size`` [m] on each other.

    Args:
      masses: (n,) from the ground up [kg], or (B, n): a batch of columns; None: equal cubes of 1000 kg/m^3.
      offset: sideways shift of every cube against the one below [m], to and fro along x and y; or (B,).
      gap: height above the one below at the start [m].
    """
    k = np.arange(n)
    zigzag = np.stack([k % 2, k // 2 % 2, 0 * k], axis=-1)
    rest = np.atleast_1d(offset)[:, None, None] * zigzag + np.stack([0 * k, 0 * k, size * (k + 0.5)], axis=-1)
    masses = np.full((1, n), DENSITY * size**3) if masses is None else np.atleast_2d(masses)
    worlds = max(len(rest), len(masses))
    rest = np.broadcast_to(rest, (worlds, n, 3))
    masses = np.broadcast_to(masses, (worlds, n))
    begin = rest + gap * np.stack([0 * k, 0 * k, k + 1], axis=-1)
    bodies = [_cube(f"cube{i}", size, begin[0, i], mu, mass=masses[0, i]) for i in k]
    return Case(
        rbd.Scene(bodies=bodies, static=[_ground(mu)], dt=dt, name=f"column{n}"),
        size,
        rest,
        leaves={"mass": masses, "inertia": masses * size**2 / 6},
        start={"pos": begin},
    )


def columns(n=10) -> Case:
    """Four columns of 1 m cubes: equal, top 100 times as heavy, the same with 5 cm offsets, 1 to 1000 geometric."""
    equal = np.full(n, DENSITY)
    heavy = equal * np.where(np.arange(n) == n - 1, 100.0, 1.0)
    return column(n, masses=[equal, heavy, heavy, DENSITY * 1000 ** (np.arange(n) / (n - 1))], offset=[0, 0, 0.05, 0])


def million(size=1.0) -> Case:
    """1e6 kg on 1 kg, 1 ms."""
    return column(2, size, masses=[1.0, 1e6], dt=1e-3)


def heights(values=(10, 20, 30, 40), size=1.0, dt=FINE) -> Case:
    """A batch of columns of different heights, 1 mm gaps; the cubes that a column lacks lie apart on the ground."""
    n = max(values)
    case = column(n, size, gap=1e-3, dt=dt)
    k = np.arange(n)
    apart = np.stack([3.0 * size * (k + 2), 0 * k, np.full(n, size / 2)], axis=-1)
    above = (k >= np.asarray(values)[:, None])[..., None]
    rest, begin = (np.where(above, apart, a[0]) for a in (case.rest, case.start["pos"]))
    return dataclasses.replace(case, rest=rest, leaves={}, start={"pos": begin}, facts={"heights": values})


# --- pyramids and cards ---


def _triangle(base, spacing, size):
    """(n, 3) centres of a wall of ``base`` boxes in the lowest row, ``spacing`` [m] apart in both directions."""
    places = [
        (spacing * (i - (base - row - 1) / 2), 0.0, size / 2 + spacing * row)
        for row in range(base)
        for i in range(base - row)
    ]
    return np.array(places)


def pyramid(base=10, size=1.0, dt=STEP) -> Case:
    """A wall of base (base + 1) / 2 cubes, each on two; the boxes of a row are 10 % of their size apart."""
    rest = _triangle(base, 1.1 * size, size)
    rest[:, 2] = size / 2 + size * np.round((rest[:, 2] - size / 2) / (1.1 * size))
    bodies = [_cube(f"box{i}", size, p) for i, p in enumerate(rest)]
    scene = rbd.Scene(bodies=bodies, static=[_ground()], dt=dt, name=f"pyramid{base}")
    return Case(scene, size, rest, facts={"base": base})


def overlapped(base=4, size=1.0, overlap=0.25, dt=STEP) -> Case:
    """The same with neighbours ``overlap`` of their size inside each other, in weightlessness."""
    places = _triangle(base, (1 - overlap) * size, size)
    bodies = [_cube(f"box{i}", size, p) for i, p in enumerate(places)]
    far = np.abs(places[:, None] - places)
    touching = np.argwhere(np.triu(far.max(-1) < size * (1 - 1e-6), 1))
    axes = far[tuple(touching.T)].argmax(-1)
    scene = rbd.Scene(bodies=bodies, gravity=None, dt=dt, name="overlapped")
    return Case(scene, size, places, facts={"pairs": touching, "axes": axes})


def card_house(storeys=3, lean=25.0, half=(0.005, 0.1, 0.2), dt=FINE) -> Case:
    """Storeys of cards that lean on each other at ``lean`` degrees from the vertical, flat cards between them.

    Args:
      half: half thickness, depth and height of a card [m].
    """
    t, depth, h = half
    s, c = np.sin(np.radians(lean)), np.cos(np.radians(lean))
    reach = h * s + t * c  # from the middle of a frame to the centre of its card
    spacing = 4 * reach + 2 * t
    rise = h * c + t * s
    bodies, rest = [], []

    def card(pos, angle, shape):
        bodies.append(
            rbd.Body(f"card{len(bodies)}", rbd.Box(shape), pos=pos, quat=_turn((0, 1, 0), angle), friction=MU)
        )
        rest.append(pos)

    for storey in range(storeys):
        frames = storeys - storey
        floor = storey * (2 * rise + 2 * t)
        middle = spacing * (np.arange(frames) - (frames - 1) / 2)
        for x in middle:
            for side in (-1, 1):
                card((x + side * reach, 0.0, floor + rise), -side * np.radians(lean), half)
        for i in range(frames - 1):
            left = middle[i] - (4 * t if i == 0 else -t / 5)
            right = middle[i + 1] + (4 * t if i == frames - 2 else -t / 5)
            flat = ((right - left) / 2, depth, t)
            card(((left + right) / 2, 0.0, floor + 2 * rise + t), 0.0, flat)
    scene = rbd.Scene(bodies=bodies, static=[_ground()], dt=dt, name=f"card_house{storeys}")
    return Case(scene, 2 * h, np.array(rest))


# --- friction ---


def slide(speed=3.0, mu=0.5, size=1.0, dt=FINE) -> Case:
    """A cube laid on a plane that slides to rest after speed^2 / (2 mu g) [m]."""
    scene = rbd.Scene(
        bodies=[_cube("box", size, (0, 0, size / 2), mu, vel=(speed, 0, 0))], static=[_ground(mu)], dt=dt, name="slide"
    )
    return Case(scene, size, facts={"distance": speed**2 / (2 * mu * G)})


def incline(ratios=(0.9, 0.998, 1.002), mu=0.5, size=1.0, dt=STEP) -> Case:
    """A cube at rest on planes whose slope is tan = ratio x mu: a batch of directions of gravity."""
    angle = np.arctan(np.asarray(ratios) * mu)
    gravity = G * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=-1)
    scene = rbd.Scene(bodies=[_cube("box", size, (0, 0, size / 2), mu)], static=[_ground(mu)], dt=dt, name="incline")
    excess = G * (np.sin(angle) - mu * np.cos(angle))
    return Case(scene, size, leaves={"gravity": gravity}, facts={"acceleration": excess})


def pushed(mu=MU, size=1.0, dt=STEP) -> Case:
    """A cube at rest on a plane, to be pushed along it; facts: the force at which it should slip [N]."""
    scene = rbd.Scene(bodies=[_cube("box", size, (0, 0, size / 2), mu)], static=[_ground(mu)], dt=dt, name="pushed")
    return Case(scene, size, facts={"force": mu * DENSITY * size**3 * G})


def roll(speeds=(1.0, 2.0, 3.0, 4.0), mu=0.5, radius=0.1, dt=FINE) -> Case:
    """A sphere set down sliding without spin; it ends rolling at 5/7 of its speed."""
    body = rbd.Body("ball", rbd.Sphere(radius), pos=(0, 0, radius), vel=(speeds[0], 0, 0), friction=mu)
    vel = np.asarray(speeds)[:, None, None] * [1.0, 0.0, 0.0]
    scene = rbd.Scene(bodies=[body], static=[_ground(mu)], dt=dt, name="roll")
    return Case(scene, radius, start={"vel": vel}, facts={"speeds": np.asarray(speeds)})


# --- bounces ---


def bounce(e=1.0, height=1.0, radius=0.1, dt=FINE) -> Case:
    """A frictionless ball dropped from ``height`` above contact; facts: the time at which it should rest [s]."""
    ball = rbd.Body("ball", rbd.Sphere(radius), pos=(0, 0, radius + height), friction=None, restitution=e)
    scene = rbd.Scene(bodies=[ball], static=[_ground(None, e)], dt=dt, name="bounce")
    fall = np.sqrt(2 * height / G)
    rest = fall * (1 + e) / (1 - e) if e < 1 else np.inf
    return Case(scene, radius, facts={"fall": fall, "rest_time": rest, "height": height})


def gas(n=64, radius=0.05, size=1.0, speed=1.0, seed=0, dt=FINE) -> Case:
    """``n`` frictionless spheres in a box of six planes, e = 1, no gravity, rms speed ``speed`` [m/s]."""
    rng = np.random.default_rng(seed)
    places = []
    while len(places) < n:
        p = rng.uniform(1.02 * radius, size - 1.02 * radius, 3)
        if all(np.linalg.norm(p - q) > 2.02 * radius for q in places):
            places.append(p)
    vel = rng.normal(size=(n, 3))
    vel *= speed / np.sqrt((vel**2).sum(-1).mean())
    bodies = [
        rbd.Body(f"s{i}", rbd.Sphere(radius), pos=tuple(p), vel=tuple(v), friction=None, restitution=1.0)
        for i, (p, v) in enumerate(zip(places, vel))
    ]
    walls = []
    for axis in range(3):
        for side in (-1, 1):  # the plane's normal is its z axis
            about = ((0, 1, 0), (1, 0, 0), (1, 0, 0))[axis]
            angle = ((-side, side, 0 if side < 0 else 2)[axis]) * np.pi / 2
            pos = np.zeros(3)
            pos[axis] = size if side > 0 else 0.0
            walls.append(
                rbd.Geom(rbd.Plane(), pos=tuple(pos), quat=tuple(_turn(about, angle)), friction=None, restitution=1.0)
            )
    return Case(rbd.Scene(bodies=bodies, static=walls, gravity=None, dt=dt, name="gas"), radius, facts={"size": size})


# --- fast bodies ---


def bullets(factors=(1.0, 2.0, 10.0), radius=0.1, half=0.01, dt=STEP) -> Case:
    """Balls that cross v dt = factor x ``radius`` in a step, against walls ``2 half`` thick; a long fast box.

    Lanes along x, 3 m apart, no gravity: ball and fixed wall; ball and wall carried against it; ball and free
    wall thrown against it (each has half the speed in the last two); box of 0.4 x 0.1 x 0.1 m at 180 m/s and
    20 rad/s and fixed wall 0.2 m thick.
    """
    lanes = ("fixed", "carried", "free", "box")
    y = {k: 3.0 * i for i, k in enumerate(lanes)}
    start = -0.3
    thin = rbd.Box((half, 0.5, 0.5))
    bits = {k: 1 << i for i, k in enumerate(lanes)}
    put = lambda shape, k, **kw: rbd.Geom(shape, group=bits[k], mask=bits[k], friction=MU, **kw)
    bodies = [
        rbd.Body(k, put(rbd.Sphere(radius), k), pos=(start, y[k], 0.013), vel=(1, 0, 0), omega=(0, 0, 0))
        for k in lanes[:3]
    ]
    bodies.append(rbd.Body("wall", put(thin, "free"), pos=(0, y["free"], 0), vel=(-1, 0, 0), omega=(0, 0, 0)))
    long = put(rbd.Box((0.2, 0.05, 0.05)), "box")
    bodies.append(rbd.Body("box", long, pos=(-2.0, y["box"], 0), vel=(180, 0, 0), omega=(0, 20, 0)))
    scene = rbd.Scene(
        bodies=bodies,
        static=[
            put(thin, "fixed", pos=(0, y["fixed"], 0)),
            put(rbd.Box((0.1, 2, 2)), "box", pos=(0, y["box"], 0)),
        ],
        kinematic=[rbd.Body("carried_wall", put(thin, "carried"), pos=(0, y["carried"], 0), vel=(-1, 0, 0))],
        gravity=None,
        dt=dt,
        name="bullets",
    )
    speed = np.asarray(factors) * radius / dt
    vel = np.zeros((len(speed), 5, 3))
    vel[:, 0, 0], vel[:, 1, 0], vel[:, 2, 0], vel[:, 3, 0] = speed, speed / 2, speed / 2, -speed / 2
    vel[:, 4, 0] = 180.0
    carried = np.zeros((len(speed), 1, 3))
    carried[:, 0, 0] = -speed / 2
    return Case(scene, radius, start={"vel": vel, "kinematic_vel": carried}, facts={"factors": factors, "lanes": lanes})


# --- energy and collapse ---


def rod(speeds=(1.0, 3.0, 5.0), mu=1.5, tangent=2.0, half=(0.5, 0.01, 0.01), dt=STEP) -> Case:
    """A thin rod on one corner, its axis inclined by atan ``tangent``, sliding so that friction presses it in.

    facts: 1 + m r_x (r_x - mu r_z) / I of the contact in the plane of motion; below zero rigid contact with
    Coulomb friction has no finite force (Painleve).
    """
    lean = np.arctan(tangent)
    quat = _times(_turn((0, 1, 0), -lean), _turn((1, 0, 0), np.pi / 4))
    a, b = half[0], half[1] * np.sqrt(2)
    r_x, r_z = -a * np.cos(lean) + b * np.sin(lean), -a * np.sin(lean) - b * np.cos(lean)
    inertia_per_mass = (half[0] ** 2 + half[1] ** 2) / 3
    body = rbd.Body("rod", rbd.Box(half), pos=(0, 0, -r_z), quat=tuple(quat), vel=(-speeds[0], 0, 0), friction=mu)
    vel = np.asarray(speeds)[:, None, None] * [-1.0, 0.0, 0.0]
    scene = rbd.Scene(bodies=[body], static=[_ground(mu)], dt=dt, name="rod")
    return Case(scene, min(half), start={"vel": vel}, facts={"painleve": 1 + r_x * (r_x - mu * r_z) / inertia_per_mass})


def colliding_stacks(n=5, size=1.0, speed=2.0, dt=STEP) -> Case:
    """Two columns of ``n`` cubes, 20 % of their size apart, that slide against each other."""
    bodies = [
        _cube(f"{side}{i}", size, (sign * 0.6 * size, 0, size * (i + 0.5)), vel=(-sign * speed, 0, 0))
        for side, sign in (("a", -1), ("b", 1))
        for i in range(n)
    ]
    return Case(rbd.Scene(bodies=bodies, static=[_ground()], dt=dt, name="colliding_stacks"), size / 2)


def heap(edge=6, radius=0.1, seed=0, dt=STEP) -> Case:
    """``edge``^3 spheres in a slightly disturbed grid, 5 % apart, that collapse on a plane."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), -1).reshape(-1, 3)
    places = 2.1 * radius * grid + [0, 0, 1.1 * radius] + rng.uniform(-1, 1, (edge**3, 3)) * 0.04 * radius
    bodies = [
        rbd.Body(f"s{i}", rbd.Sphere(radius), pos=tuple(p), friction=MU, omega=(0, 0, 0)) for i, p in enumerate(places)
    ]
    return Case(rbd.Scene(bodies=bodies, static=[_ground()], dt=dt, name="heap"), radius)


def dominoes(n=30, half=(0.1, 0.25, 0.5), spacing=0.5, spin=1.0, dt=FINE) -> Case:
    """A row of ``n`` dominoes along x, the first one given ``spin`` [rad/s] about its lower front edge.

    Dominoes collide with the next two on either side only (what lies farther is out of reach).
    """
    bodies = []
    ground = 1 << 30
    for i in range(n):
        near = sum(1 << j for j in range(max(i - 2, 0), min(i + 3, n)) if j != i)
        geom = rbd.Geom(rbd.Box(half), group=1 << i, mask=near | ground, friction=MU)
        first = {"omega": (0, spin, 0), "vel": (spin * half[2], 0, spin * half[0])} if i == 0 else {}
        bodies.append(rbd.Body(f"domino{i}", geom, pos=(spacing * i, 0, half[2]), **first))
    plane = rbd.Geom(rbd.Plane(), group=ground, mask=0, friction=MU, name="ground")
    return Case(rbd.Scene(bodies=bodies, static=[plane], dt=dt, name="dominoes"), min(half), facts={"spacing": spacing})


def crowd(worlds=1024, bad=500, size=0.2, dt=FINE) -> Case:
    """Three boxes dropped in every world, tumbling; facts: the world that is to explode."""
    rng = np.random.default_rng(0)
    bodies = [_cube(f"box{i}", size, (0, 0, size * (1 + 1.5 * i))) for i in range(3)]
    pos = np.array([b.pos for b in bodies]) + rng.uniform(-0.02, 0.02, (worlds, 3, 3))
    omega = rng.normal(size=(worlds, 3, 3))
    scene = rbd.Scene(bodies=bodies, static=[_ground()], dt=dt, name="crowd")
    return Case(scene, size, start={"pos": pos, "vel": 0 * pos, "omega": omega}, facts={"bad": bad})


def exploding(case: Case) -> Case:
    """The crowd with one world whose speeds overflow in the first steps."""
    start = {k: v.copy() for k, v in case.start.items()}
    start["vel"][case.facts["bad"]] = start["omega"][case.facts["bad"]] = 3e38
    return dataclasses.replace(case, start=start)
