"""Does contact hold where contact solvers fail? Scenes of ``stability_scenes.py``, judged row by row.

    PYTHONPATH=. python benchmarks/stability.py                              (every row, both presets)
    PYTHONPATH=. python benchmarks/stability.py --rows slide,incline --methods accurate,tgs/8
    PYTHONPATH=. python benchmarks/stability.py --quick --out /tmp/x          (seconds; nothing is judged)

Appends rows to stability.jsonl under ``--out`` (benchmarks/results) and writes stability.md from the last row of
every (row, method). Float32, 1 m cubes, friction 0.6, 1/60 s and 10 s unless a row says otherwise.

Rules:
* *Stands*: no body moved sideways by more than 10 % of its size, nor sank below its place of rest by more than 1 %
  of the height of its top above the ground (its own size for a body on the ground), at any time.
* *Penetration*: the deepest overlap among ``rbd_jax.contacts`` over the last second, at the samples of the run.
* *Speed*: the largest speed of a centre of mass at the end.
* *Energy rise*: the largest rise of ``rbd_jax.energy`` in a step over M g d, M the mass of the scene and d the
  smallest half-size.
* *Events on*: ``Method.events = 8`` where the method has such a field.

A method is a preset, or the name of a solver with the defaults of ``rbd_jax.Method``; ``NAME/8`` sets 8 substeps.
Bars are those of the presets "accurate" and "fast"; other methods are shown, not judged.
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
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
import stability_scenes as scenes  # noqa: E402
from common import G, MuJoCo, number  # noqa: E402
from stability_scenes import FINE, STEP, Case  # noqa: E402

import rbd_jax as rbd  # noqa: E402
from rbd_jax.method import find  # noqa: E402
from rbd_jax.solvers import SOLVERS  # noqa: E402
from rbd_jax.solvers.laws import EXIT  # noqa: E402

PRESETS = ("accurate", "fast")
EVENTS = 8
NO_EVENTS = "no events yet"
QUICK = ("slide", "roll", "million")


@dataclasses.dataclass(frozen=True)
class Figure:
    """One measured number.

    Attributes:
      what: in words. value: NaN misses. unit.
      bar: the largest value that passes (the least one where ``least``); None: told, not judged.
    """

    what: str
    value: float
    unit: str = ""
    bar: float | None = None
    least: bool = False

    @property
    def verdict(self) -> str:
        return common.verdict(self.value, self.bar, self.least)

    def __str__(self):
        bar = "" if self.bar is None else f" ({'>=' if self.least else '<='} {number(self.bar)})"
        missed = " **MISSED**" if self.verdict == "MISS" else ""
        return f"{self.what} {number(self.value)} {self.unit}".rstrip() + bar + missed


# --- methods ---


def method_of(label: str) -> rbd.Method:
    """The method of ``NAME`` or ``NAME/SUBSTEPS``."""
    name, _, substeps = label.partition("/")
    method = rbd.PRESETS.get(name) or (rbd.Method(solver=name) if name in SOLVERS else find(name))
    return dataclasses.replace(method, substeps=int(substeps)) if substeps else method


def with_events(method: rbd.Method) -> tuple[rbd.Method, str]:
    """The method with events on, and a note where it has none."""
    if any(f.name == "events" for f in dataclasses.fields(method)):
        return dataclasses.replace(method, events=EVENTS), ""
    return method, NO_EVENTS


# --- runs ---


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished run of B worlds with T samples.

    Attributes:
      pos, vel, omega: (B, T, n, 3). quat: (B, T, n, 4). time: (T,) [s]. All float64.
      window: samples in the last second.
    """

    case: Case
    model: rbd.Model
    final: rbd.State
    traj: rbd.State
    pos: np.ndarray
    vel: np.ndarray
    quat: np.ndarray
    omega: np.ndarray
    time: np.ndarray
    window: int

    def worlds(self, bit) -> int:
        """How many worlds have this status bit."""
        return int(np.count_nonzero(np.asarray(self.final.status) & int(bit)))

    @property
    def finite(self) -> Figure:
        return holds(self.worlds(rbd.Status.NOT_FINITE) == 0, "finite")

    @property
    def crowded(self) -> bool:
        """Whether pairs were dropped for lack of capacity."""
        return self.worlds(rbd.Status.CAPACITY) > 0

    def speed(self) -> np.ndarray:
        """(B,) largest speed at the end [m/s]."""
        return np.linalg.norm(self.vel[:, -1], axis=-1).max(-1)

    def penetration(self, samples=None) -> np.ndarray:
        """(B,) deepest overlap over the last samples (None: the last second) [m]."""
        count = samples or self.window
        last = jax.tree.map(lambda c: c[:, -count:], self.traj)
        return np.asarray(_deepest(self.model, last)).max(-1)

    def stands(self) -> np.ndarray:
        """(B,) whether every body stayed where it should rest."""
        moved = self.pos - np.broadcast_to(self.case.rest, self.pos[:, 0].shape)[:, None]
        top = np.broadcast_to(self.case.rest[..., 2] + self.case.size / 2, self.pos[:, 0, :, 2].shape)
        sideways = np.linalg.norm(moved[..., :2], axis=-1) <= 0.1 * self.case.size
        return (sideways & (-moved[..., 2] <= 0.01 * top[:, None])).all((1, 2))

    def energy(self) -> np.ndarray:
        """(B, T) kinetic and potential energy [J]."""
        return np.asarray(_energy(self.model, self.traj), np.float64)

    def energy_rise(self) -> float:
        """The largest rise between two samples over M g d."""
        mass = float(np.asarray(self.model.mass).reshape(-1, self.model.n)[0].sum())
        return float(np.diff(self.energy(), axis=1).max()) / (mass * G * self.case.size)


@jax.jit
def _deepest(model, traj):
    seen = rbd.contacts(model, traj)
    return jnp.where(seen.live, -seen.distance, 0.0).max(-1, initial=0.0)


@jax.jit
def _energy(model, traj):
    return sum(rbd.energy(model, traj))


class Bench:
    """Runs scenes; ``quick`` cuts every run to a few steps. Runs shared by rows are kept."""

    def __init__(self, quick=False):
        self.quick = quick
        self.columns = functools.cache(self._columns)

    def __call__(self, case: Case, method, seconds=10.0, every=1, dt=None, control=None, wide=False) -> Run:
        """Run ``case`` for ``seconds``, a sample every ``every`` steps, in float64 where ``wide``."""
        dt = dt or case.scene.dt
        steps = max(1, round((seconds if not self.quick else 10 * dt * every) / dt / every)) * every
        with jax.enable_x64(wide or jax.config.jax_enable_x64):
            model, state = rbd.build(case.scene, dt=dt, method=method)
            size = len(next(iter([*case.start.values(), *case.leaves.values()]), [0]))
            state = rbd.batch(state, size).replace(**case.start)
            if case.leaves:
                model = model.replace(**case.leaves)
            final, traj = jax.block_until_ready(rbd.rollout(model, state, steps, every=every, control=control))
            paths = (np.asarray(getattr(traj, k), np.float64) for k in ("pos", "vel", "quat", "omega"))
            time_ = np.asarray(traj.time, np.float64)[0]
        return Run(case, model, final, traj, *paths, time_, max(1, round(min(1.0, steps * dt) / dt / every)))

    def _columns(self, label) -> Run:
        return self(scenes.columns(), method_of(label), every=4)


def largest(values) -> float:
    """The largest value; NaN where one is not finite."""
    values = np.asarray(values, float)
    return float(values.max()) if np.isfinite(values).all() else float("nan")


def holds(condition, what="stands") -> Figure:
    return Figure(what, float(np.all(condition)), "", 1.0, least=True)


def bars(label: str, accurate, fast):
    """The bar of a preset; None for other methods."""
    return {"accurate": accurate, "fast": fast}.get(label)


def eight(label: str) -> str:
    """ "fast" with 8 substeps, which the rows of heavy loads ask for."""
    return "fast/8" if label == "fast" else label


# --- rows: each (bench, label) -> (figures, note) ---


def _column_figures(run: Run, label, k, depth, speed=(None, None), judged=True):
    stands = holds(run.stands()[k])
    return [
        stands if judged else dataclasses.replace(stands, bar=None),
        Figure("penetration", 1e3 * run.penetration()[k], "mm", bars(label, *depth)),
        Figure("speed", run.speed()[k], "m/s", bars(label, *speed)),
    ]


def cubes(bench: Bench, label):
    """10 equal cubes"""
    return _column_figures(bench.columns(label), label, 0, (0.05, 0.5), (1e-4, 1e-3)), ""


def small_cubes(bench: Bench, label):
    """10 cubes of 0.1 m at 1/240 s"""
    run = bench(scenes.column(10, 0.1, dt=FINE), method_of(label), every=16)
    return _column_figures(run, label, 0, (0.05, 0.2)), ""


def heavy_top(bench: Bench, label):
    """top cube 100x heavier; also with 5 cm offsets"""
    run = bench.columns(eight(label))
    figures = _column_figures(run, label, 1, (0.5, 6.0))
    shifted = _column_figures(run, label, 2, (0.5, 6.0))
    figures += [dataclasses.replace(f, what=f"offsets: {f.what}") for f in shifted]
    return figures, "8 substeps" if label == "fast" else ""


def geometric(bench: Bench, label):
    """masses 1..1000 geometric, heaviest on top"""
    figures = _column_figures(bench.columns(eight(label)), label, 3, (5.0, None), judged=label != "fast")
    return figures, "best reached, 8 substeps" if label == "fast" else ""


def million(bench: Bench, label):
    """two cubes, 1e6 : 1 on top, 1 ms"""
    run = bench(scenes.million(), method_of(label), every=20)
    moved = run.case.rest[0, :, 2] - run.pos[0, :, :, 2]
    depth = 100 * largest(np.diff(moved, axis=-1, prepend=0.0)) / run.case.size
    figures = [
        Figure("light one penetrated", depth, "% of its size", bars(label, 1.0, None)),
        Figure("speed", run.speed()[0], "m/s"),
    ]
    return figures, "best reached" if label == "fast" else ""


def twenty(bench: Bench, label):
    """20 cubes of 0.1 m, mu 1, 2 ms, float64, t = 2..3 s"""
    case = scenes.column(20, 0.1, mu=1.0, dt=0.002)
    run = bench(case, method_of(label), seconds=3.0, every=10, wide=True)
    late = run.time >= (2.0 - 1e-9 if not bench.quick else 0.0)
    fastest = max(np.abs(v[:, late]).max() for v in (run.vel, run.omega))
    return [Figure("largest |qvel|", fastest, "m/s, rad/s", bars(label, 1e-6, 1e-3))], ""


def highest(bench: Bench, label):
    """highest column that stands, 1/240 s, 1 mm gaps"""
    case = scenes.heights() if not bench.quick else scenes.heights((2, 3))
    run = bench(case, method_of(label), every=40)
    stood = run.stands()
    reached = max([0, *(h for h, s in zip(case.facts["heights"], stood) if s)])
    figures = [Figure("height", reached, "cubes", bars(label, 40, 20), least=True)]
    return figures, f"of {', '.join(map(str, case.facts['heights']))}" + (
        "; pairs over capacity" if run.crowded else ""
    )


def pyramid(bench: Bench, label):
    """pyramid of base 10 (55 boxes)"""
    case = scenes.pyramid(10 if not bench.quick else 3)
    run = bench(case, method_of(label), every=10)
    row = run.pos[0, :, : case.facts["base"], 0]
    width = np.ptp(row, axis=-1) + case.size
    spread = 100 * np.abs(width / width[0] - 1).max()
    note = "pairs over capacity" if run.crowded else ""
    return [
        holds(run.stands()),
        Figure("base spread", spread, "%", bars(label, 1.0, None)),
        Figure("penetration", 1e3 * run.penetration()[0], "mm"),
    ], note


def card_house(bench: Bench, label):
    """card house of 3 storeys, 1/240 s"""
    run = bench(scenes.card_house(3 if not bench.quick else 1), method_of(label), every=40)
    moved = 1e3 * np.linalg.norm(run.pos - run.case.rest, axis=-1).max()
    return [holds(run.stands()), Figure("moved", moved, "mm"), Figure("speed", run.speed()[0], "m/s")], ""


def slide(bench: Bench, label):
    """slide to stop, mu 0.5, 3 m/s, 1/240 s"""
    run = bench(scenes.slide(), method_of(label), seconds=1.0)
    error = 100 * abs(run.pos[0, -1, 0, 0] / run.case.facts["distance"] - 1)
    lift = 1e3 * (run.pos[0, :, 0, 2].max() - run.case.size / 2)
    return [
        Figure("distance error", error, "%", bars(label, 0.1, 0.3)),
        Figure("lift-off", lift, "mm", bars(label, 0.1, None)),
    ], ""


def incline(bench: Bench, label):
    """incline, mu 0.5: tan = 0.9, 0.998, 1.002 mu"""
    run = bench(scenes.incline(), method_of(label), every=10)
    x = 1e3 * run.pos[:, :, 0, 0]
    second = max(1, round(1 / (10 * STEP))) if not bench.quick else 1
    creep = (x[:, -1] - x[:, -1 - second]) / max(run.time[-1] - run.time[-1 - second], 1e-9)
    half = x.shape[1] // 2
    middle = (x[:, half] - x[:, max(half - second, 0)]) / max(run.time[half] - run.time[max(half - second, 0)], 1e-9)
    free = 1e3 * run.case.facts["acceleration"][2] * run.time[-1]
    return [
        Figure("creep at 0.9", creep[0], "mm/s", bars(label, 0.3, 0.01)),
        Figure("at 0.998", creep[1], "mm/s", bars(label, 2.0, 0.01)),
        Figure("growth of that from 5 s to 10 s", creep[1] - middle[1], "mm/s", bars(label, 0.02, 0.01)),
        Figure("at 1.002, over g t (sin - mu cos)", creep[2] / free, "-", bars(label, 0.8, 0.8), least=True),
    ], ""


def direction(bench: Bench, label, rounds=3, forces=17, seconds=6.0):
    """slip threshold against push direction, 0..90 degrees"""
    case = scenes.pushed()
    angles = np.radians(np.arange(0, 91, 7.5))
    toward = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1)
    low, high = np.full(len(angles), 0.95), np.full(len(angles), 1.05)
    slips = 1e-3  # [m/s] gained in the second half: what slipped at the start alone slows down
    for _ in range(rounds if not bench.quick else 1):
        tried = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, forces)
        force = case.facts["force"] * tried[..., None, None] * toward[:, None, None]
        force = force.reshape(-1, 1, 3)
        pushed = dataclasses.replace(case, start={"vel": np.zeros_like(force)})
        wrench = rbd.Wrench(force=jnp.asarray(force, jnp.float32))
        run = bench(pushed, method_of(label), seconds=seconds, every=8, control=wrench)
        speed = np.linalg.norm(run.vel[:, :, 0], axis=-1)
        gone = (speed[:, -1] - speed[:, speed.shape[1] // 2] > slips).reshape(tried.shape)
        first = np.where(gone.any(1), gone.argmax(1), forces - 1)
        each = np.arange(len(angles))
        low, high = tried[each, np.maximum(first - 1, 0)], tried[each, first]
    threshold = (low + high) / 2
    spread = 100 * np.ptp(threshold) / threshold.mean()
    return [
        Figure("spread", spread, "%", bars(label, 0.2, 0.5)),
        Figure("mean threshold over mu m g", threshold.mean(), "-"),
    ], f"gaining {slips:g} m/s in the last {seconds / 2:g} s counts as slipping"


def roll(bench: Bench, label):
    """slip to roll"""
    run = bench(scenes.roll(), method_of(label), seconds=3.0, every=4)
    error = np.abs(run.vel[:, -1, 0, 0] / (5 / 7 * run.case.facts["speeds"]) - 1).max()
    return [Figure("speed over 5/7 v0, minus 1", error, "-", bars(label, 1e-4, 1e-3))], ""


def _apexes(run: Run) -> np.ndarray:
    """Heights above contact of the apexes of a ball [m], exact between samples."""
    z, v = run.pos[0, :, 0, 2] - run.case.size, run.vel[0, :, 0, 2]
    k = np.flatnonzero((z[1:-1] > z[:-2]) & (z[1:-1] >= z[2:]) & (z[1:-1] > 0.01 * run.case.facts["height"])) + 1
    return z[k] + v[k] ** 2 / (2 * G)


def elastic(bench: Bench, label, count=20):
    """e = 1 ball, 1 m drop, 20 bounces, 1/240 s"""
    case = scenes.bounce(1.0)
    method, note = with_events(method_of(label)) if label != "fast" else (method_of(label), "events off")
    seconds = (2 * count + 0.5) * case.facts["fall"]
    figures = []
    for wide, tag, bar in ((False, "f32", 2e-4), (True, "f64", 1e-10)):
        if label == "fast" and wide:
            break
        high = np.concatenate([[1.0], _apexes(bench(case, method, seconds=seconds, wide=wide))])
        complete = len(high) > count or bench.quick
        if label == "fast":
            ratio = high[1:] / high[:-1] if len(high) > 1 else np.ones(1)
            loss = largest(1 - ratio) if complete else float("nan")
            figures += [
                Figure("loss per bounce", 100 * loss, "%", 1.0),
                Figure("gain per bounce", 100 * largest(ratio - 1), "%", 1e-3),
            ]
        else:
            error = largest(np.abs(high - 1)) if complete else float("nan")
            figures.append(Figure(f"apex error, {tag}", error, "-", bars(label, bar, None)))
    return figures, note


def zeno(bench: Bench, label):
    """e = 0.8 ball to rest, 1/240 s"""
    case = scenes.bounce(0.8)
    method, note = with_events(method_of(label)) if label != "fast" else (method_of(label), "events off")
    run = bench(case, method, seconds=1.3 * case.facts["rest_time"])
    moving = np.flatnonzero(np.abs(run.vel[0, :, 0, 2]) > 1e-3)
    rests = run.time[min(moving[-1] + 1, len(run.time) - 1)] if len(moving) else 0.0
    steps = (rests - case.facts["rest_time"]) / case.scene.dt
    sink = 1e3 * (case.size - run.pos[0, :, 0, 2].min())
    return [
        Figure("rest time, difference", abs(steps), "steps", bars(label, 2.0, None)),
        Figure("sinking", sink, "mm", bars(label, 0.1, 0.1)),
        run.finite,
    ], note


def gas(bench: Bench, label):
    """gas of 64 spheres, e = 1, 1/240 s"""
    method, note = with_events(method_of(label)) if label != "fast" else (method_of(label), "events off")
    run = bench(scenes.gas(), method, every=4)
    drift = run.energy()[0] / run.energy()[0, 0] - 1
    out = np.abs(run.pos - run.case.facts["size"] / 2).max() - run.case.facts["size"] / 2
    return [
        Figure("energy, largest change", largest(np.abs(drift)), "-", bars(label, 1e-4, None)),
        Figure("energy at the end over the start", 1 + drift[-1], "-", bars(label, None, 2.0)),
        Figure("centre outside the box", max(out, 0.0), "m", bars(label, 0.0, 0.0)),
        Figure("penetration", 1e3 * run.penetration()[0], "mm"),
    ], note


def tunnel(bench: Bench, label):
    """fast balls and a box against walls: none through"""
    case = scenes.bullets()
    run = bench(case, method_of(label), seconds=0.5)
    names = run.model.names.bodies
    x = {name: run.pos[:, :, i, 0] for i, name in enumerate(names)}
    carried = np.asarray(run.traj.kinematic_pos)[:, :, 0, 0]
    wall = {"fixed": 0.0, "carried": carried, "free": x["wall"], "box": 0.0}
    through = {lane: (x[lane] > wall[lane]).any(1) for lane in case.facts["lanes"]}
    through["box"] = through["box"][:1]
    count = sum(int(v.sum()) for v in through.values())
    who = [f"{lane}: {np.flatnonzero(v).tolist()}" for lane, v in through.items() if v.any()]
    deepest = 1e3 * run.penetration(run.pos.shape[1]).max()
    figures = [
        Figure("through", count, "of 10", bars(label, 0, 0)),
        Figure("deepest", deepest, "mm"),
        run.finite,
    ]
    return figures, "v h = R, 2R, 10R" + (f"; through {', '.join(who)}" if who else "")


def overlap(bench: Bench, label):
    """pyramid of 4 rows placed with 25 % overlap, weightless"""
    case = scenes.overlapped()
    run = bench(case, method_of(label), seconds=2.0)
    a, b = case.facts["pairs"].T
    method = method_of(label).resolve(STEP)
    limit = EXIT * method.contact.push_speed if hasattr(method.contact, "push_speed") else None
    apart = np.abs(run.vel[0][:, a] - run.vel[0][:, b])[:, np.arange(len(a)), case.facts["axes"]]
    return [
        Figure("exit speed, of a pair along its least overlap", apart.max(), "m/s", limit),
        Figure("of a body", np.linalg.norm(run.vel[0], axis=-1).max(), "m/s"),
        Figure("overlap left", 1e3 * run.penetration(1)[0], "mm"),
        run.finite,
    ], "the limit is EXIT = 1.5 times push_speed of the contact model"


def _energy_figures(run: Run, label):
    bar = bars(label, 1e-3, 1e-3)
    return [Figure("energy rise", run.energy_rise(), "M g d", bar), run.finite]


def painleve(bench: Bench, label):
    """thin rod on its corner, mu 1.5, beyond the Painleve condition"""
    case = scenes.rod()
    run = bench(case, method_of(label), seconds=5.0)
    return _energy_figures(run, label), f"1 + m r_x (r_x - mu r_z) / I = {case.facts['painleve']:.2f}"


def stacks(bench: Bench, label):
    """two stacks colliding"""
    run = bench(scenes.colliding_stacks(5 if not bench.quick else 2), method_of(label), seconds=5.0)
    return _energy_figures(run, label) + [Figure("penetration", 1e3 * run.penetration()[0], "mm")], ""


def heap(bench: Bench, label):
    """216 spheres collapsing"""
    run = bench(scenes.heap(6 if not bench.quick else 2), method_of(label), seconds=3.0)
    note = "3 s" + ("; pairs over capacity" if run.crowded else "")
    return _energy_figures(run, label) + [Figure("penetration", 1e3 * run.penetration()[0], "mm")], note


def _first(time, value) -> float:
    """When ``value`` first becomes positive, between samples [s]; NaN if never."""
    k = int(np.argmax(value > 0))
    if k == 0:
        return float("nan")
    return time[k] - (time[k] - time[k - 1]) * value[k] / (value[k] - value[k - 1])


def dominoes(bench: Bench, label):
    """30 dominoes, 1/240 and 1/480 s"""
    figures, speeds = [], []
    case = scenes.dominoes(30 if not bench.quick else 3)
    for dt in (FINE, FINE / 2):
        run = bench(case, method_of(label), seconds=10.0, dt=dt, every=round(FINE / dt))
        upright = 1 - 2 * (run.quat[0, :, :, 1] ** 2 + run.quat[0, :, :, 2] ** 2)
        n = upright.shape[1]
        fallen = int((upright[-1] < 0.9).sum())
        when = [_first(run.time, np.cos(0.2) - upright[:, i]) for i in (n // 3, n - 1)]
        speeds.append(case.facts["spacing"] * (n - 1 - n // 3) / (when[1] - when[0]))
        if dt == FINE:
            figures = [Figure("fallen", fallen, f"of {n}", bars(label, n, n), least=True)]
            figures += _energy_figures(run, label)
    change = 100 * abs(speeds[0] / speeds[1] - 1)
    figures.append(Figure("wave speed against half the step", change, "%", bars(label, 2.0, 2.0)))
    return figures, f"wave speed {speeds[1]:.3f} m/s"


def poison(bench: Bench, label):
    """1,024 worlds, one exploding"""
    case = scenes.crowd(*((1024, 500) if not bench.quick else (8, 5)))
    bad = case.facts["bad"]
    run = lambda case: bench(case, method_of(label), seconds=0.5, every=120)
    benign, wild = run(case), run(scenes.exploding(case))
    others = np.arange(len(case.start["pos"])) != bad
    same = lambda a, b: bool((np.asarray(a)[others] == np.asarray(b)[others]).all())
    equal = all(same(getattr(benign.final, k), getattr(wild.final, k)) for k in ("pos", "vel", "quat", "omega"))
    return [
        holds(equal, "others bit-identical"),
        Figure("exploded", wild.worlds(rbd.Status.NOT_FINITE), "worlds", 1.0, least=True),
        Figure("others spoilt", float((np.asarray(wild.final.status)[others] & 1).sum()), "worlds", 0.0),
    ], "step time: --cost"


#: key -> (function, the scene that --cost times, or None)
ROWS: dict[str, tuple[Callable, Callable[[], Case] | None]] = {
    "cubes": (cubes, scenes.columns),
    "small_cubes": (small_cubes, lambda: scenes.column(10, 0.1, dt=FINE)),
    "heavy_top": (heavy_top, lambda: scenes.column(10, masses=[1.0] * 9 + [100.0])),
    "geometric": (geometric, lambda: scenes.column(10, masses=np.geomspace(1.0, 1000.0, 10))),
    "million": (million, scenes.million),
    "twenty": (twenty, lambda: scenes.column(20, 0.1, mu=1.0, dt=0.002)),
    "highest": (highest, lambda: scenes.column(40, dt=FINE)),
    "pyramid": (pyramid, scenes.pyramid),
    "card_house": (card_house, scenes.card_house),
    "slide": (slide, scenes.slide),
    "incline": (incline, scenes.incline),
    "direction": (direction, scenes.pushed),
    "roll": (roll, scenes.roll),
    "elastic": (elastic, scenes.bounce),
    "zeno": (zeno, lambda: scenes.bounce(0.8)),
    "gas": (gas, scenes.gas),
    "tunnel": (tunnel, scenes.bullets),
    "overlap": (overlap, scenes.overlapped),
    "painleve": (painleve, scenes.rod),
    "stacks": (stacks, scenes.colliding_stacks),
    "heap": (heap, scenes.heap),
    "dominoes": (dominoes, scenes.dominoes),
    "poison": (poison, None),
}


# --- cost ---


def cost(case: Case, labels, steps=200, repeats=5) -> dict:
    """Seconds per step of one world in MuJoCo on one thread, and of each method over that.

    The first ``steps`` steps of the scene (a tenth of them for more than LARGE bodies), best of ``repeats``;
    compilation is not counted. A method that refuses the scene has no figure.
    """
    if len(case.scene.bodies) > LARGE:
        steps //= 10
    rival = MuJoCo(case.scene, case.scene.dt, threads=1)
    model, state = rbd.build(case.scene)
    q, v = rbd.to_mujoco(model, rbd.batch(state, 1))
    begin = rival.initial(np.asarray(q, float), np.asarray(v, float))
    arrays = rival.allocate(1, steps)

    best = lambda call: common.least_seconds(call, repeats) / steps
    out = {"MuJoCo [s]": best(lambda: rival.call(begin, steps, arrays))}
    rival.close()
    for label in labels:
        try:
            model, state = rbd.build(case.scene, method=method_of(label))
        except ValueError:
            continue
        run = lambda: jax.block_until_ready(rbd.rollout(model, rbd.batch(state, 1), steps, every=steps))
        out[label] = best(run) / out["MuJoCo [s]"]
    return out


#: Scenes of more bodies than this are timed over fewer steps.
LARGE = 30


def poison_cost(label, repeats=5) -> float:
    """Step time of 1,024 worlds of which one explodes, over that of the benign batch; best of ``repeats``."""
    case = scenes.crowd()
    model, state = rbd.build(case.scene, method=method_of(label))
    states = [rbd.batch(state, len(c.start["pos"])).replace(**c.start) for c in (case, scenes.exploding(case))]
    took = [[], []]
    for k in range(2 * (repeats + 1)):
        begin = time.perf_counter()
        jax.block_until_ready(rbd.rollout(model, states[k % 2], 120, every=120))
        took[k % 2].append(time.perf_counter() - begin)
    return min(took[1][1:]) / min(took[0][1:])


# --- the page ---


def judge(bench: Bench, key, label) -> dict:
    """The row of one (scene, method), for the record."""
    begin = time.perf_counter()
    try:
        figures, note = ROWS[key][0](bench, label)
    except ValueError as error:  # a method that does not do this scene says so when it is built
        figures, note = [Figure("refused", float("nan"), "", bars(label, 0, 0))], str(error).splitlines()[0]
    judged = [f.verdict for f in figures if f.verdict and label in PRESETS]
    return {
        "row": key,
        "title": ROWS[key][0].__doc__,
        "method": label,
        "figures": [dataclasses.asdict(f) for f in figures],
        "note": note,
        "verdict": "" if bench.quick or not judged else "MISSED" if "MISS" in judged else "ok",
        "seconds": time.perf_counter() - begin,
        "quick": bench.quick,
    }


def told(row: dict) -> str:
    """The figures of a row in words."""
    text = "; ".join(
        str(Figure(**{**f, "value": np.nan if f["value"] is None else f["value"]})) for f in row["figures"]
    )
    text = text if row["verdict"] else text.replace(" **MISSED**", "")
    return f"{text} [{row['note']}]" if row["note"] else text


def report(rows: list[dict], costs: list[dict]) -> str:
    """The page of the last row of every (row, method)."""
    last = {(r["row"], r["method"]): r for r in rows}
    methods = list(dict.fromkeys([*PRESETS, *(m for _, m in last)]))
    methods = [m for m in methods if any(k[1] == m for k in last)]
    lines = []
    for key in ROWS:
        for m in methods:
            if r := last.get((key, m)):
                lines.append([r["title"], m, told(r), r["verdict"] or "-"])
    missed = [f"{r['title']} ({m})" for (_, m), r in last.items() if r["verdict"] == "MISSED"]
    env = max((r["environment"] for r in last.values()), key=lambda e: e["date"])
    text = f"""# Stability of contact

{common.header(env)}
Made by `benchmarks/stability.py`; scenes in `benchmarks/stability_scenes.py`, rules in the script's head.
Float32, 1 m cubes, friction 0.6, 1/60 s, 10 s unless said. Bars in brackets; a figure without one is told, not judged.

{len(missed)} missed{": " + "; ".join(missed) if missed else ""}.

{common.table(["scene", "method", "measured (bar)", ""], lines)}
"""
    if costs:
        last = {c["row"]: c for c in costs}
        heads = list(dict.fromkeys(k for c in last.values() for k in c["cost"] if k != "MuJoCo [s]"))
        body = [
            [c["title"], number(1e6 * c["cost"].get("MuJoCo [s]", np.nan)), *(number(c["cost"].get(h)) for h in heads)]
            for c in last.values()
        ]
        text += f"""
## Cost

Time per step of one world over that of MuJoCo on one thread with the same MJCF and step (for the batch with the
exploding world: over that of the benign batch).

{common.table(["scene", "MuJoCo [us]", *heads], body)}
"""
    return text


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rows", default="", metavar="A,B", help=f"default all: {','.join(ROWS)}")
    parser.add_argument("--methods", default="", metavar="A,B", help=f"default {','.join(PRESETS)}")
    parser.add_argument(
        "--quick", action="store_true", help=f'ten samples each, nothing judged; "fast", {", ".join(QUICK)}'
    )
    parser.add_argument("--cost", action="store_true", help="time the scenes beside MuJoCo instead of judging them")
    parser.add_argument("--budget", type=float, default=3600.0, help="no further row is begun after so many seconds")
    parser.add_argument("--out", type=pathlib.Path, default=None, metavar="DIR", help="default benchmarks/results")
    args = parser.parse_args(argv)
    keys = [k for k in args.rows.split(",") if k] or list(QUICK if args.quick else ROWS)
    labels = [m for m in args.methods.split(",") if m] or (["fast"] if args.quick else list(PRESETS))
    for key in keys:
        if key not in ROWS:
            parser.error(f"unknown row '{key}'; rows: {', '.join(ROWS)}")
    for label in labels:
        try:
            method_of(label)
        except ValueError as error:
            parser.error(str(error))
    begin, out = time.perf_counter(), args.out or common.RESULTS
    env = common.environment()
    print(common.header(env), flush=True)
    bench, lines = Bench(args.quick), out / "stability.jsonl"
    for key in keys:
        if time.perf_counter() - begin > args.budget:
            print(f"time ran out ({args.budget:g} s) before {key}", flush=True)
            break
        if args.cost:
            function, make = ROWS[key]
            if key == "poison":
                timed = {label: poison_cost(label) for label in labels}
            elif make is None:
                continue
            else:
                timed = cost(make(), labels)
            row = {"row": key, "title": function.__doc__, "cost": timed, "environment": env}
            common.append_lines(lines, [row])
            print(f"{key}: " + ", ".join(f"{k} {number(v)}" for k, v in timed.items()), flush=True)
            continue
        for label in labels:
            row = common.plain(judge(bench, key, label)) | {"environment": env}
            common.append_lines(lines, [row])
            print(f"{key} | {label} | {told(row)} | {row['verdict']}  ({row['seconds']:.0f} s)", flush=True)
    kept = [json.loads(s) for s in lines.read_text(encoding="utf-8").splitlines()] if lines.exists() else []
    judged = [r for r in kept if "figures" in r and r["quick"] == args.quick]
    if judged:
        (out / "stability.md").write_text(report(judged, [r for r in kept if "cost" in r]), encoding="utf-8")
        print(f"wrote {lines}, {out / 'stability.md'}  ({time.perf_counter() - begin:.0f} s)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
