"""Where does contact fail? Maps of height, mass ratio, spin, overlap and speed against the step, for every method.

    PYTHONPATH=. python benchmarks/stability_maps.py                        (every map; about 15 minutes on 2 cores)
    PYTHONPATH=. python benchmarks/stability_maps.py --maps height,mass --methods fast,tgs/1,MuJoCo
    PYTHONPATH=. python benchmarks/stability_maps.py --quick --out /tmp/x   (seconds; the pictures mean nothing)
    PYTHONPATH=. python benchmarks/stability_maps.py --draw                 (pictures of what is there)

Writes stability_maps.json, stability_map_NAME.png and stability_map.png (height and mass side by side) under ``--out``
(benchmarks/results); needs matplotlib. Cells that the file has already are not run again, unless ``--again`` is given.

A cell is one world run for ``--seconds``; ours in float32, MuJoCo in float64. The rules, the same for all:

* *gained energy*: kinetic and potential energy rose above that of the start and of the place of rest by more than
  M g size / 4, a hop of all bodies by a quarter of their size (free spin: by more than 10 %).
* *fell*: a body moved by more than half its size, or leans by more than 45 degrees (free spin: half the energy was
  lost, or the angular momentum changed by half).
* *off*: a body moved by more than 1 % of its size, downwards by more than 1 % of the height of its top, or the energy
  rose by more than M g size / 100 (free spin: energy or angular momentum changed by more than 1 %).

* *went through*: the centre of the ball got beyond the far side of the wall; *off*: it got deeper than R / 100.
* *not finite*: a status bit of ours, a warning of MuJoCo's (bad qpos, qvel or qacc). *refused*: by ``rbd_jax.build``.

Places are judged at all times; after a start with overlap, in the last second.

A method is a preset, or a solver's name with the defaults of ``rbd_jax.Method``; ``NAME/8`` sets 8 substeps. A step
of s substeps is s steps of dt / s: they are run as such, so that methods which are the same there share a run.
MuJoCo: the same scene through MJCF, one thread, elliptic cone. "MuJoCo": solref, solimp and impratio at their defaults;
"MuJoCo rigid": solref = (2 dt, 1), solimp = (0.9999, 0.9999, 0.001, 0.5, 2), impratio 100.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import pathlib
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
from common import G, MuJoCo  # noqa: E402
from stability import method_of  # noqa: E402

import rbd_jax as rbd  # noqa: E402
from rbd_jax.integrators import INTEGRATORS  # noqa: E402
from rbd_jax.model import BASE_NDIM  # noqa: E402

MU, DENSITY, SIZE = 0.6, 1000.0, 1.0
STAGGER = 0.01  # sideways shift of the cubes of a column, of their size
GYRO = (0.1, 0.2, 0.3)
STEPS = (1 / 30, 1 / 60, 1 / 120, 1 / 240, 1 / 500)
BULLET_STEP, RADIUS = 1 / 60, 0.1
PHASES = (0.0, 0.382, 0.764, 0.146)  # of a fast ball against the steps
BLOCK, EVERY = 150, 2  # steps of one compiled call, and between two samples
OURS = ("fast", "accurate", *(s for s in ("tgs", "pgs", "penalty", "newton_lagged", "newton_cone") if s in rbd.SOLVERS))
RIVALS = ("MuJoCo", "MuJoCo rigid")

#: What became of a world, from good to bad, with its colour: light to dark, told apart by the colour-blind.
COLOURS = {
    "holds": "#a6d8f0",
    "off": "#f5d328",
    "fell": "#e06c00",
    "gained energy": "#a8327d",
    "went through": "#1b4f8f",
    "not finite": "#000000",
    "refused": "#b8b8b8",
}
OUTCOMES = tuple(COLOURS)


# --- worlds ---


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """A scene and what is needed to judge it.

    Attributes:
      size: of its bodies [m]. seconds: to run it. rest: (n, 3) places where the bodies should rest [m], or None.
      settle: places are judged from this time on [s]. facts: numbers of the scene by name.
    """

    scene: rbd.Scene
    size: float
    seconds: float
    rest: np.ndarray | None = None
    settle: float = 0.0
    facts: dict = dataclasses.field(default_factory=dict)


@functools.cache
def column(n, ratio=1.0, overlap=0.0, seconds=5.0) -> World:
    """``n`` cubes on each other, 1 cm to and fro, the top one ``ratio`` times as heavy.

    The uppermost starts ``overlap`` of its size inside the one below. Only neighbours collide: what a column does once
    it has fallen is not judged, and its other pairs would cost as the square of its height.
    """
    k = np.arange(n)
    rest = SIZE * np.stack([STAGGER * (k % 2), STAGGER * (k // 2 % 2), k + 0.5], axis=-1)
    begin = rest - np.outer(k == n - 1, [0, 0, overlap * SIZE])
    ground = 1 << 30
    bodies = []
    for i in range(n):
        near = sum(1 << j for j in (i - 1, i + 1) if 0 <= j < n) | (ground if i == 0 else 0)
        cube = rbd.Geom(rbd.Box((SIZE / 2,) * 3), group=1 << i, mask=near, friction=MU)
        mass = DENSITY * SIZE**3 * (ratio if i == n - 1 else 1.0)
        bodies.append(rbd.Body(f"cube{i}", cube, pos=tuple(begin[i]), mass=mass))
    plane = rbd.Geom(rbd.Plane(), group=ground, mask=0, friction=MU, name="ground")
    scene = rbd.Scene(bodies=bodies, static=[plane], gravity=(0, 0, -G), name=f"column{n}")
    return World(scene, SIZE, seconds, rest, settle=max(seconds - 1.0, 0.0) if overlap else 0.0)


@functools.cache
def gyro(spin, seconds=5.0) -> World:
    """A free box with half-extents 0.1, 0.2, 0.3 m that spins about its middle axis, 1 % beside it [rad/s]."""
    omega = (0.01 * spin, spin, 0.01 * spin)
    body = rbd.Body("box", rbd.Box(GYRO), vel=(0, 0, 0), omega=omega, density=DENSITY)
    return World(rbd.Scene(bodies=[body], gravity=None, name="gyro"), 2 * GYRO[0], seconds)


@functools.cache
def turning(spin, seconds=5.0) -> World:
    """The same box laid flat on a plane, spinning about the vertical [rad/s]."""
    half, rest = GYRO[::-1], (0.0, 0.0, GYRO[0])
    body = rbd.Body("box", rbd.Box(half), pos=rest, omega=(0, 0, spin), density=DENSITY, friction=MU)
    plane = rbd.Geom(rbd.Plane(), friction=MU, name="ground")
    scene = rbd.Scene(bodies=[body], static=[plane], gravity=(0, 0, -G), name="turning")
    return World(scene, 2 * GYRO[0], seconds, np.array([rest]))


@functools.cache
def bullet(travel, thickness, phase=0.0) -> World:
    """A ball that moves ``travel`` radii in a step of 1/60 s, against a wall ``thickness`` radii thick; 0.5 s.

    The ball starts 2 + ``phase`` steps in front of the wall.
    """
    half, speed = thickness * RADIUS / 2, travel * RADIUS / BULLET_STEP
    start = -(half + RADIUS) - (2 + phase) * travel * RADIUS
    ball = rbd.Body("ball", rbd.Sphere(RADIUS), pos=(start, 0, 0.013), vel=(speed, 0, 0), omega=(0, 0, 0), friction=MU)
    wall = rbd.Geom(rbd.Box((half, 0.5, 0.5)), friction=MU, name="wall")
    scene = rbd.Scene(bodies=[ball], static=[wall], gravity=None, name="bullet")
    return World(scene, RADIUS, 0.5, facts={"half": half, "speed": speed})


# --- runs ---


@dataclasses.dataclass(frozen=True)
class Path:
    """What a world did: pos, vel, omega (T, n, 3), quat (T, n, 4), time (T,) [s], float64.

    mass: (n,) [kg]. inertia: (n, 3) about the axes of the bodies [kg m^2]. finite: whether it went to the end.
    """

    pos: np.ndarray
    vel: np.ndarray
    quat: np.ndarray
    omega: np.ndarray
    time: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray
    finite: bool

    @functools.cached_property
    def momentum(self) -> np.ndarray:
        """Angular momentum about the centres of mass, world frame (T, n, 3) [N m s]."""
        return _rotate(self.quat, self.inertia * _rotate(_conjugate(self.quat), self.omega))

    def energy(self, world: World) -> np.ndarray:
        """Kinetic and potential energy (T,) [J]."""
        kinetic = 0.5 * (self.mass * (self.vel**2).sum(-1) + (self.momentum * self.omega).sum(-1)).sum(-1)
        return kinetic if world.scene.gravity is None else kinetic + G * self.pos[..., 2] @ self.mass


def _conjugate(q):
    return q * [1, -1, -1, -1]


def _rotate(q, v):
    """v (..., 3) turned by the unit quaternion q (..., 4)."""
    t = 2 * np.cross(q[..., 1:], v)
    return v + q[..., :1] * t + np.cross(q[..., 1:], t)


def _bodies(model: rbd.Model) -> dict:
    """mass and inertia of a ``Path``."""
    inertia = np.asarray(model.inertia, np.float64)
    return {
        "mass": np.asarray(model.mass, np.float64),
        "inertia": np.repeat(inertia[:, None], 3, axis=1) if inertia.ndim == 1 else inertia,
    }


def built(world: World, method: rbd.Method, dt: float) -> tuple[rbd.Model, rbd.State]:
    """The model with its substeps as steps of their own, and the start state."""
    model, state = rbd.build(world.scene, dt=dt, method=method)
    parts = model.method.substeps
    if parts == 1:
        return model, state
    return rbd.build(world.scene, dt=dt / parts, method=dataclasses.replace(model.method, substeps=1))


def our_paths(members: list[tuple[World, rbd.Model, rbd.State]]) -> list[Path]:
    """The paths of worlds with the same structure, method and length: one program for all steps.

    Worlds with the same step are one batch, filled up to the size of the largest.
    """
    names = [k for k in ("inertia", *BASE_NDIM) if k != "dt" and getattr(members[0][1], k) is not None]
    same = lambda k: all(np.array_equal(getattr(m, k), getattr(members[0][1], k)) for _, m, _ in members)
    varied = [k for k in names if not same(k)]
    by_step: dict[float, list[int]] = {}
    for i, (_, model, _) in enumerate(members):
        by_step.setdefault(float(model.dt), []).append(i)
    size = max(map(len, by_step.values()))
    needed = {h: round(members[at[0]][0].seconds / h) for h, at in by_step.items()}
    block = EVERY * max(1, min(BLOCK, *needed.values()) // EVERY)
    paths: list[Path | None] = [None] * len(members)
    for h, at in by_step.items():
        lanes = at + at[-1:] * (size - len(at))
        model = members[at[0]][1]
        model = model.replace(**{k: jnp.stack([getattr(members[i][1], k) for i in lanes]) for k in varied})
        state = jax.tree.map(lambda *c: jnp.stack(c), *(members[i][2] for i in lanes))
        seen = []
        for _ in range(-(-needed[h] // block)):
            state, traj = jax.block_until_ready(rbd.rollout(model, state, block, every=EVERY))
            part = {k: np.asarray(getattr(traj, k), np.float64) for k in ("pos", "vel", "quat", "omega")}
            seen.append({k: v[:, 1 if seen else 0 :] for k, v in part.items()})
        joined = {k: np.concatenate([s[k] for s in seen], axis=1)[:, : needed[h] // EVERY + 1] for k in seen[0]}
        bad = np.asarray(state.status) & int(rbd.Status.NOT_FINITE)
        for lane, i in enumerate(at):
            mine = {k: v[lane] for k, v in joined.items()}
            when = EVERY * h * np.arange(len(mine["pos"]))
            paths[i] = Path(**mine, time=when, **_bodies(members[i][1]), finite=not bad[lane])
    return paths


def mujoco_path(world: World, label: str, dt: float) -> Path:
    """The path of a world in MuJoCo; ``label``: "MuJoCo", then an integrator and "rigid" where wanted."""
    words = label.split()[1:]
    scene = world.scene
    if integrator := [w for w in words if w != "rigid"]:
        scene = dataclasses.replace(scene, integrator=integrator[0].lower())
    mujoco.set_mju_user_warning(lambda text: None)  # what it says is read from the counters below
    rival = MuJoCo(scene, dt, threads=1)
    if "rigid" in words:
        rival.model.geom_solref[:] = 2 * dt, 1.0
        rival.model.geom_solimp[:] = 0.9999, 0.9999, 0.001, 0.5, 2.0
        rival.model.opt.impratio = 100.0
    model, state = rbd.build(scene, dt=dt)
    q, v = (np.asarray(a, float)[None] for a in rbd.to_mujoco(model, state))
    begin, steps = rival.initial(q, v), round(world.seconds / dt)
    out = rival.call(begin, steps, rival.allocate(1, steps))
    warnings = rival.data[0].warning
    kinds = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")
    bad = any(warnings[int(getattr(mujoco.mjtWarning, k))].number for k in kinds)
    rival.close()
    states = np.concatenate([begin[:, None], out], axis=1)[0, ::EVERY]
    nq, n = rival.model.nq, model.n
    qpos, qvel = states[:, 1 : 1 + nq].reshape(-1, n, 7), states[:, 1 + nq : 1 + nq + 6 * n].reshape(-1, n, 6)
    quat = qpos[..., 3:]
    omega = _rotate(quat, qvel[..., 3:])
    when = EVERY * dt * np.arange(len(states))
    return Path(qpos[..., :3], qvel[..., :3], quat, omega, when, **_bodies(model), finite=not bad)


# --- verdicts: each (world, path) -> (outcome, moved over size, energy gained) ---


def _finite(path: Path) -> bool:
    return path.finite and all(np.isfinite(a).all() for a in (path.pos, path.vel, path.quat, path.omega))


def standing(world: World, path: Path) -> tuple[str, float, float]:
    """Did bodies stay where they should rest? Energy over M g size."""
    if not _finite(path):
        return "not finite", np.nan, np.nan
    late = path.time >= world.settle - 1e-9
    moved = path.pos[late] - world.rest
    sideways = np.linalg.norm(moved[..., :2], axis=-1).max() / world.size
    up = moved[..., 2].max() / world.size
    top = world.rest[:, 2] + world.size / 2
    sagged = (-moved[..., 2] / top).max()
    far = max(sideways, np.abs(moved[..., 2]).max() / world.size)
    upright = (1 - 2 * (path.quat[late, :, 1] ** 2 + path.quat[late, :, 2] ** 2)).min()
    energy = path.energy(world)
    at_rest = G * path.mass @ world.rest[:, 2]
    gained = (energy.max() - max(energy[0], at_rest)) / (path.mass.sum() * G * world.size)
    if gained > 0.25:
        return "gained energy", far, gained
    if far > 0.5 or upright < np.sqrt(0.5):
        return "fell", far, gained
    return "off" if max(sideways, up, sagged, gained) > 0.01 else "holds", far, gained


def spinning(world: World, path: Path) -> tuple[str, float, float]:
    """Does a free body keep energy and angular momentum? (outcome, relative change of L, of energy)."""
    if not _finite(path):
        return "not finite", np.nan, np.nan
    energy, momentum = path.energy(world), path.momentum[:, 0]
    rise = energy / energy[0] - 1
    turned = (np.linalg.norm(momentum - momentum[0], axis=-1) / np.linalg.norm(momentum[0])).max()
    change = rise[np.abs(rise).argmax()]
    if rise.max() > 0.1:
        return "gained energy", turned, change
    if rise.min() < -0.5 or turned > 0.5:
        return "fell", turned, change
    return "off" if max(abs(change), turned) > 0.01 else "holds", turned, change


def stopped(world: World, path: Path) -> tuple[str, float, float]:
    """Did the ball stay in front of the wall? (outcome, depth over radius, energy over that of the start, minus 1)."""
    if not _finite(path):
        return "not finite", np.nan, np.nan
    x, energy = path.pos[:, 0, 0], path.energy(world)
    depth = (x.max() + world.facts["half"]) / world.size + 1
    gained = energy.max() / energy[0] - 1
    if x.max() > world.facts["half"]:
        return "went through", depth, gained
    if gained > 0.1:
        return "gained energy", depth, gained
    return "off" if depth > 0.01 or gained > 0.01 else "holds", depth, gained


# --- maps ---


@dataclasses.dataclass(frozen=True)
class Map:
    """A map of outcomes.

    Attributes:
      title. x_label, y_label: of the axes. x, y: their values. methods: labels.
      worlds: (x, y, seconds) -> the worlds of a cell, of which the worst counts. step: (x) -> step [s].
      judge: (world, path) -> verdict. words: what outcomes are called here.
    """

    title: str
    x_label: str
    x: tuple
    y_label: str
    y: tuple
    worlds: Callable
    step: Callable = lambda x: x
    judge: Callable = standing
    words: dict = dataclasses.field(default_factory=dict)
    methods: tuple = (*OURS, *RIVALS)


_STANDS = {"holds": "stands", "off": "sags, drifts or hops by more than 1 %"}
_STEP = "step [s]"

MAPS = {
    "height": Map(
        "columns of 1 m cubes",
        _STEP,
        STEPS,
        "cubes",
        (2, 5, 10, 15, 20, 30),
        lambda x, y, s: [column(y, seconds=s)],
        words=_STANDS,
    ),
    "mass": Map(
        "ten 1 m cubes, the top one heavier",
        _STEP,
        STEPS,
        "mass ratio",
        (1.0, 10.0, 1e2, 1e3, 1e4, 1e6),
        lambda x, y, s: [column(10, y, seconds=s)],
        words=_STANDS,
    ),
    "mass_two": Map(
        "two 1 m cubes, the upper one heavier",
        _STEP,
        STEPS,
        "mass ratio",
        (1.0, 10.0, 1e2, 1e3, 1e4, 1e6),
        lambda x, y, s: [column(2, y, seconds=s)],
        words=_STANDS,
    ),
    "overlap": Map(
        "two 1 m cubes, one placed inside the other",
        _STEP,
        STEPS,
        "overlap at the start [%]",
        (0.0, 5.0, 10.0, 20.0, 35.0, 50.0),
        lambda x, y, s: [column(2, overlap=y / 100, seconds=s)],
        words={
            "holds": "recovers and stands",
            "off": "hops, or is off by more than 1 %",
            "fell": "fell, or still inside",
            "gained energy": "thrown up by more than half its size",
        },
    ),
    "spin": Map(
        "free box 0.2 x 0.4 x 0.6 m about its middle axis",
        _STEP,
        STEPS,
        "spin [rad/s]",
        (1.0, 3.0, 10.0, 30.0, 100.0, 300.0),
        lambda x, y, s: [gyro(y, s)],
        judge=spinning,
        words={
            "holds": "keeps energy and momentum",
            "off": "off by more than 1 %",
            "fell": "lost half",
            "gained energy": "gained 10 % energy",
        },
        methods=(
            *("fast", "accurate", "buss2", "implicit_midpoint", "rk4", "semi_implicit_euler"),
            *("MuJoCo", "MuJoCo implicitfast", "MuJoCo RK4"),
        ),
    ),
    "spin_plane": Map(
        "the same box flat on a plane, about the vertical",
        _STEP,
        STEPS,
        "spin [rad/s]",
        (1.0, 3.0, 10.0, 30.0, 100.0, 300.0),
        lambda x, y, s: [turning(y, s)],
        words={"holds": "stays in place", "off": "walks or hops by more than 1 %", "fell": "thrown or tipped over"},
    ),
    "speed": Map(
        "ball of radius R against a fixed wall, 1/60 s",
        "thickness / R [-]",
        (0.02, 0.1, 0.5, 1.0, 2.0),
        "v h / R [-]",
        (0.25, 0.5, 1.0, 2.0, 5.0, 10.0),
        lambda x, y, s: [bullet(y, x, p) for p in PHASES],
        step=lambda x: BULLET_STEP,
        judge=stopped,
        words={"holds": "stopped at the surface", "off": "stopped, deeper than R / 100"},
    ),
}
QUICK_METHODS = ("penalty", "MuJoCo", "MuJoCo rigid")


def quick(m: Map) -> Map:
    """Two columns and a row of a map."""
    return dataclasses.replace(m, x=m.x[1:4:2], y=m.y[:1])


def maker(label: str) -> rbd.Method:
    """The method of a label, which may be the name of an integrator alone (free motion, no substeps)."""
    return rbd.Method(integrator=label, substeps=1) if label in INTEGRATORS else method_of(label)


# --- the run ---


@dataclasses.dataclass(frozen=True)
class Task:
    """A cell of a map that is to be run."""

    map: str
    method: str
    row: int
    column: int


class Book:
    """The results by map and method, as in stability_maps.json.

    Of another length than ``seconds`` (None: any), or with other axes, they are forgotten.
    """

    def __init__(self, path: pathlib.Path, maps: dict[str, Map], seconds: float | None, env: dict):
        self.path, self.maps, self.env = path, maps, env
        old = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        seconds = old.get("seconds") if seconds is None else seconds
        self.data = {"environment": env, "seconds": seconds, "outcomes": OUTCOMES, "maps": old.get("maps", {})}
        for name, m in maps.items():
            now = {"title": m.title, "x_label": m.x_label, "x": list(m.x), "y_label": m.y_label, "y": list(m.y)}
            kept = self.data["maps"].get(name, {})
            same = old.get("seconds") == seconds and all(kept.get(k) == v for k, v in now.items())
            self.data["maps"][name] = now | {"methods": kept["methods"] if same else {}}

    def methods(self, name) -> dict:
        return self.data["maps"][name]["methods"]

    def forget(self, name, label):
        self.methods(name).pop(label, None)

    def known(self, t: Task) -> bool:
        entry = self.methods(t.map).get(t.method)
        return entry is not None and entry["outcome"][t.row][t.column] is not None

    def put(self, t: Task, outcome, moved, gained, method):
        """Note the outcome of a cell; ``method``: the solver and its substeps that ran."""
        m = self.maps[t.map]
        empty = lambda: [[None] * len(m.x) for _ in m.y]
        entry = self.methods(t.map).setdefault(
            t.method, {"outcome": empty(), "moved": empty(), "gained": empty(), "ran": empty()}
        )
        entry |= {"date": self.env["date"], "commit": self.env["commit"]}
        short = lambda x: float(f"{x:.3g}") if np.isfinite(x) else None
        for key, value in (("outcome", outcome), ("moved", short(moved)), ("gained", short(gained)), ("ran", method)):
            entry[key][t.row][t.column] = value

    def write(self):
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(_lines(common.plain(self.data)) + "\n", encoding="utf-8")


def _lines(value, depth=0) -> str:
    """JSON with rows of cells on one line."""
    if not isinstance(value, dict) or depth > 5:
        return json.dumps(value)
    pad = " " * (depth + 1)
    inside = ",\n".join(f"{pad}{json.dumps(k)}: {_lines(v, depth + 1)}" for k, v in value.items())
    return "{\n" + inside + "\n" + " " * depth + "}" if value else "{}"


def _shown(method: rbd.Method, parts: float) -> str:
    """What ran: the solver, and its substeps if there are any."""
    return method.solver.name + (f" x {round(parts)}" if parts > 1.5 else "")


@dataclasses.dataclass
class Run:
    """A world to be run, and the cells that wait for it. model, state: None in MuJoCo."""

    world: World
    dt: float
    model: rbd.Model | None = None
    state: rbd.State | None = None
    tasks: list[Task] = dataclasses.field(default_factory=list)


def paths_of(label: str, runs: list[Run]) -> list[Path]:
    if label.startswith("MuJoCo"):
        return [mujoco_path(r.world, label, r.dt) for r in runs]
    return our_paths([(r.world, r.model, r.state) for r in runs])


def solve(book: Book, tasks: list[Task], seconds: float, budget: float) -> None:
    """Run the cells and note their outcomes; a map that has cost more than ``budget`` seconds is left as it is."""
    verdicts: dict[Task, list] = {}  # of the worlds of a cell: (outcome, moved, gained)
    ran: dict[Task, str] = {}
    groups: dict[tuple, dict[tuple, Run]] = {}  # runs that share a program; those that are the same are one

    def note(task: Task, verdict):
        m = book.maps[task.map]
        verdicts.setdefault(task, []).append(verdict)
        if len(verdicts[task]) == len(m.worlds(m.x[task.column], m.y[task.row], seconds)):
            book.put(task, *max(verdicts[task], key=lambda v: OUTCOMES.index(v[0])), ran[task])

    for t in tasks:
        m = book.maps[t.map]
        x, y = m.x[t.column], m.y[t.row]
        for world in m.worlds(x, y, seconds):
            if t.method.startswith("MuJoCo"):
                key, run, ran[t] = (t.method, t.map), Run(world, m.step(x)), t.method
            else:
                try:
                    model, state = built(world, maker(t.method), m.step(x))
                except ValueError as error:  # a method that does not do this scene says so when it is built
                    ran[t] = str(error).splitlines()[0]
                    note(t, ("refused", np.nan, np.nan))
                    continue
                run = Run(world, float(model.dt), model, state)
                key, ran[t] = (model.structure, model.method, world.seconds), _shown(model.method, m.step(x) / run.dt)
            groups.setdefault(key, {}).setdefault((world, run.dt), run).tasks.append(t)

    spent = dict.fromkeys(book.maps, 0.0)
    for group in groups.values():
        runs = list(group.values())
        first = runs[0].tasks[0]
        if spent[first.map] > budget:
            print(f"{first.map}: time ran out ({budget:g} s) before {first.method}", flush=True)
            continue
        begin = time.perf_counter()
        for run, path in zip(runs, paths_of(first.method, runs)):
            for t in run.tasks:
                note(t, book.maps[t.map].judge(run.world, path))
        book.write()
        took = time.perf_counter() - begin
        spent[first.map] += took
        print(f"{first.map} | {ran[first]} | {len(runs)} x {runs[0].world.scene.name}  ({took:.0f} s)", flush=True)


# --- pictures ---


def _tick(value, label) -> str:
    if "[s]" in label:
        return f"1/{round(1 / value)}"
    if value >= 1000:
        return f"$10^{{{round(np.log10(value))}}}$"
    return f"{value:g}"


def _panels(figure, m: Map, entries: dict, columns=3):
    """One small panel a method, in a subfigure."""
    from matplotlib.colors import ListedColormap

    labels = [k for k in m.methods if k in entries] + [k for k in entries if k not in m.methods]
    rows = max(1, -(-len(labels) // columns))
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    palette = ListedColormap(list(COLOURS.values()))
    for ax, label in zip(axes.flat, labels):
        grid = [[np.nan if c is None else OUTCOMES.index(c) for c in row] for row in entries[label]["outcome"]]
        ax.pcolormesh(
            np.arange(len(m.x) + 1), np.arange(len(m.y) + 1), np.ma.masked_invalid(grid), cmap=palette,
            vmin=-0.5, vmax=len(OUTCOMES) - 0.5, edgecolors="white", linewidth=0.8,
        )  # fmt: skip
        ax.set_title(label, fontsize=8, pad=3, fontweight="bold" if label in rbd.PRESETS else "normal")
    for i, ax in enumerate(axes.flat):
        ax.set_xticks(np.arange(len(m.x)) + 0.5, [_tick(v, m.x_label) for v in m.x], fontsize=7, rotation=90)
        ax.set_yticks(np.arange(len(m.y)) + 0.5, [_tick(v, m.y_label) for v in m.y], fontsize=7)
        ax.tick_params(length=0, pad=2, labelbottom=i >= (rows - 1) * columns, labelleft=i % columns == 0)
        ax.spines[:].set_visible(False)
    figure.supxlabel(m.x_label, fontsize=8)
    figure.supylabel(m.y_label, fontsize=8)
    figure.suptitle(m.title, fontsize=9)
    return labels


def draw(book: Book, names, path: pathlib.Path) -> bool:
    """The maps ``names`` side by side, for a page about 900 px wide; False where there is nothing to draw."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.patches import Patch

    names = [n for n in names if book.methods(n)]
    if not names:
        return False
    most = max(len(book.methods(n)) for n in names)
    height = 0.55 + 1.35 * -(-most // 3) + 0.5
    whole = plt.figure(figsize=(9.0 if len(names) > 1 else 6.0, height), layout="constrained", dpi=150)
    pages = np.atleast_1d(whole.subfigures(1, len(names), wspace=0.03))
    seen, words = set(), {}
    for page, name in zip(pages, names):
        _panels(page, book.maps[name], book.methods(name))
        seen |= {c for e in book.methods(name).values() for row in e["outcome"] for c in row}
        words = book.maps[name].words | words
    patches = [Patch(color=COLOURS[o], label=words.get(o, o)) for o in OUTCOMES if o in seen]
    whole.legend(
        handles=patches, loc="outside lower center", ncols=2 if len(names) == 1 else 6, fontsize=8, frameon=False
    )
    whole.savefig(path)
    plt.close(whole)
    return True


def draw_all(book: Book, out: pathlib.Path) -> list[str]:
    """Every map that has results; the names of the pictures."""
    made = {f"stability_map_{name}.png": [name] for name in book.maps}
    if {"height", "mass"} <= set(book.maps):
        made["stability_map.png"] = ["height", "mass"]
    return [file for file, names in made.items() if draw(book, names, out / file)]


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--maps", default="", metavar="A,B", help=f"default all: {','.join(MAPS)}")
    parser.add_argument("--methods", default="", metavar="A,B", help="default: those of every map")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of a run [s]")
    parser.add_argument("--budget", type=float, default=900.0, help="no further run of a map after so many seconds")
    parser.add_argument("--again", action="store_true", help="run also what the file has already")
    parser.add_argument("--draw", action="store_true", help="run nothing, draw what the file has")
    parser.add_argument("--quick", action="store_true", help="two columns and one row of each, 0.2 s; a few methods")
    parser.add_argument("--out", type=pathlib.Path, default=None, metavar="DIR", help="default benchmarks/results")
    args = parser.parse_args(argv)
    names = [k for k in args.maps.split(",") if k] or list(MAPS)
    for name in names:
        if name not in MAPS:
            parser.error(f"unknown map '{name}'; maps: {', '.join(MAPS)}")
    wanted = [k for k in args.methods.split(",") if k]
    for label in wanted:
        try:
            if not label.startswith("MuJoCo"):
                maker(label)
        except ValueError as error:
            parser.error(str(error))
    if args.quick:
        args.seconds, wanted = 0.2, wanted or list(QUICK_METHODS)
    maps = {k: quick(m) if args.quick else m for k, m in MAPS.items()}
    begin, out = time.perf_counter(), args.out or common.RESULTS
    env = common.environment()
    print(common.header(env), flush=True)
    book = Book(out / "stability_maps.json", maps, None if args.draw else args.seconds, env)
    tasks = []
    for name in names if not args.draw else ():
        m = maps[name]
        for label in wanted or m.methods:
            if args.again:
                book.forget(name, label)
            every = [Task(name, label, i, j) for i in range(len(m.y)) for j in range(len(m.x))]
            tasks += [t for t in every if not book.known(t)]
    if not args.draw:
        solve(book, tasks, args.seconds, args.budget)
        book.write()
    print(f"wrote {', '.join(draw_all(book, out))} under {out}  ({time.perf_counter() - begin:.0f} s)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
