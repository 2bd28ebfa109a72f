"""Are the gradients right, and what do they cost? Beside MuJoCo MJX where it is installed.

    PYTHONPATH=. python benchmarks/gradients.py                          (every row; about an hour on 2 cores)
    PYTHONPATH=. python benchmarks/gradients.py --rows toss,bounce
    PYTHONPATH=. python benchmarks/gradients.py --quick --out /tmp/x     (a minute; nothing is judged)
    PYTHONPATH=. python benchmarks/gradients.py --report                 (page and charts from the rows there are)

Appends rows to gradients.jsonl under ``--out`` (benchmarks/results) and writes gradients.md and gradient_*.png from the
last row of every case. Float64 in ``toss`` and ``bounce``, float32 in ``cost``. MJX: ``pip install -e ".[mjx]"`` in an
environment of its own; without it its rows say so.

* ``toss``: the cube toss of the DiffMJX paper (arXiv 2506.14186): a soft, stiff contact law whose trajectory after one
  second depends on two impacts of corners and edges. d y(T) / d v_z(0) of the law itself is known from MuJoCo's RK4 at
  steps so small that nothing changes any more; the question is at which step and cost a simulator's derivative is that.
* ``bounce``: a ball with e = 0.8 that bounces twice, d z(T) / d z(0) in closed form, at steps from 1/60 to 1/2400 s.
* ``cost``: time and memory of value-and-gradient over those of the rollout alone, and against finite differences.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
import pathlib
import sys
import time
from collections.abc import Callable, Iterator
from importlib import metadata

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
from common import G, MuJoCo, Program, number, step_text  # noqa: E402

import rbd_jax as rbd  # noqa: E402
from rbd_jax.method import find  # noqa: E402
from rbd_jax.mjcf import compile_mujoco  # noqa: E402
from rbd_jax.solvers import MujocoNewton  # noqa: E402

EVENTS = 8
NO_MJX = 'not installed: pip install -e ".[mjx]"'
#: Colours that the colour-blind tell apart (Okabe and Ito).
BLUE, ORANGE, GREEN, RED, PURPLE, SKY, BLACK = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000",
)  # fmt: skip


@functools.cache
def mjx_module():
    """``mujoco.mjx``, or None where it is not installed."""
    try:
        from mujoco import mjx
    except ImportError:
        return None
    return mjx


def environment() -> dict:
    env = common.environment()
    try:
        env["versions"]["mujoco-mjx"] = metadata.version("mujoco-mjx")
    except metadata.PackageNotFoundError:
        env["versions"]["mujoco-mjx"] = None
    return env


def compiled(function, *arguments) -> Program:
    """``function`` compiled cold: nothing that was traced before is used again. ``cpu_s``: of all threads."""
    jax.clear_caches()
    begin = time.process_time()
    program = Program(function, *arguments)
    program.cpu_s = time.process_time() - begin
    return program


def in_turn(calls: list[Callable], repeats: int) -> list[float]:
    """Best seconds of each of ``calls``, measured in turn after one warm-up."""
    best = [math.inf] * len(calls)
    for k in range(repeats + 1):
        for i, call in enumerate(calls):
            begin = time.perf_counter()
            call()
            if k:
                best[i] = min(best[i], time.perf_counter() - begin)
    return best


def first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).strip().splitlines()[0]}"


def events_on(method: str | rbd.Method, events: int = EVENTS) -> rbd.Method:
    return dataclasses.replace(find(method), events=events)


# --- toss ------------------------------------------------------------------------------------------

SPEED, SECONDS = -2.0, 1.0
HALF = 0.05
#: y(T) [m] and d y(T) / d v_z(0) [s] of the law, from MuJoCo's RK4 (the rows "MuJoCo RK4" repeat it).
TRUTH = {"elliptic": (-0.26182, 0.5943), "pyramidal": (-0.26090, 0.5758)}
TOSS_BAR = 5e-3
#: Step of MJX whose time to answer ours is compared with [s].
MJX_STEP = 1e-3
CONES = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}
STEPPERS = {"euler": mujoco.mjtIntegrator.mjINT_EULER, "rk4": mujoco.mjtIntegrator.mjINT_RK4}
#: Tolerance of ours whose time to the answer is judged [m/s].
TOLERANCE = 1e-8
#: Newton steps and line search steps of ours.
SOLVER = MujocoNewton(6, 4)


def toss_scene(soft: bool = True) -> rbd.Scene:
    """The cube on its way down; ``soft``: with the law of the paper, else rigid."""
    law = {"solref": (0.005, 1.0), "solimp": (0.0, 0.95, 0.001, 0.5, 2.0)} if soft else {"restitution": 0.0}
    turned = (math.cos(math.pi / 6), math.sin(math.pi / 6), 0.0, 0.0)
    cube = rbd.Body(
        "cube", rbd.Geom(rbd.Box((HALF,) * 3), friction=1.0, **law), pos=(0, 0, 0.2), quat=turned,
        vel=(0.0, -0.1, SPEED), density=100.0,
    )  # fmt: skip
    plane = rbd.Geom(rbd.Plane(), friction=1.0, **law)
    return rbd.Scene(bodies=[cube], static=[plane], gravity=(0, 0, -2.0), dt=MJX_STEP, integrator="rk4", refsafe=False)


@dataclasses.dataclass(frozen=True)
class Toss:
    """One way to get y(T) and its derivative.

    Attributes:
      case: its name. engine: "rbd_jax" or "MJX". dt: step [s]; of ``adaptive`` the tolerance [m/s].
      mode: "forward" or "reverse". method: of rbd_jax. soft: the law of the paper. adaptive: steps by error.
      options: of MJX: integrator, cone, and fields of mjOption. rival: its time to the answer is judged.
    """

    case: str
    engine: str
    dt: float
    mode: str = "forward"
    method: rbd.Method | str | None = None
    soft: bool = True
    adaptive: bool = False
    options: dict = dataclasses.field(default_factory=dict)
    rival: bool = False


def toss_cases(quick: bool) -> list[Toss]:
    """Ours under the soft law, the rigid limit, and MJX."""
    soft = lambda name: rbd.Method(name, "mujoco", SOLVER)
    ours = lambda case, dt, method, **k: Toss(case, "rbd_jax", dt, method=method, **k)
    adaptive = lambda tolerance, **k: ours("steps by error", tolerance, soft("mujoco_euler"), adaptive=True, **k)
    mjx = lambda case, dt, mode="forward", **k: Toss(
        case, "MJX", dt, mode, options={"cone": "pyramidal"} | k, rival=mode == "forward" and dt == MJX_STEP and not k
    )
    rigid = lambda dt: ours("rigid, events", dt, events_on("gradient"), soft=False)
    if quick:
        return [adaptive(1e-3), ours("Euler", 1e-2, soft("mujoco_euler")), rigid(1e-2), mjx("Euler", 1e-2)]
    return [
        *(adaptive(t, rival=t == TOLERANCE) for t in (1e-6, 1e-7, 1e-8, 1e-9)),
        *(ours("RK4", dt, soft("mujoco_rk4")) for dt in (1e-3, 2e-4, 1e-4, 5e-5, 2e-5)),
        *(ours("symtop2", dt, soft("symtop2")) for dt in (1e-3, 1e-4, 2e-5)),
        *(ours("Euler", dt, soft("mujoco_euler")) for dt in (1e-3, 3e-4, 1e-4)),
        ours("Euler", 1e-3, soft("mujoco_euler"), mode="reverse"),
        *(rigid(1 / n) for n in (60, 240, 1000, 4000)),
        dataclasses.replace(mjx("Euler", MJX_STEP, cone="elliptic"), rival=True),
        *(mjx("Euler", dt) for dt in (1e-3, 3e-4, 1e-4)),
        mjx("RK4", 1e-3, integrator="rk4"),
        mjx("Euler", 1e-3, "reverse"),
        mjx("Euler, tolerance 0", 1e-3, "reverse", iterations=4, tolerance=0.0),
        mjx("Euler, 1 iteration", 1e-3, "reverse", iterations=1),
    ]


def derivative(function, at, mode: str):
    """(value, derivative) of a function of a scalar."""
    if mode == "forward":
        return jax.jvp(function, (at,), (jnp.ones_like(at),))
    return jax.value_and_grad(function)(at)


def vector_field(model: rbd.Model, state: rbd.State):
    """y' = f(y), y = (pos, vel, quat, omega) of the only body, 13 numbers.

    MuJoCo's contact is a force at a state, so the change of velocity in a step of 1 s of ``mujoco_euler`` is the
    acceleration at its start (for an isotropic body the angular one too).
    """
    model = model.replace(dt=1.0)

    def f(y):
        x, v, q, w = jnp.split(y, (3, 6, 10))
        q = q / jnp.linalg.norm(q)
        new = rbd.step(model, state.replace(pos=x[None], vel=v[None], quat=q[None], omega=w[None]))
        turn = 0.5 * jnp.concatenate([-w.dot(q[1:])[None], q[0] * w + jnp.cross(w, q[1:])])
        return jnp.concatenate([v, new.vel[0] - v, turn, new.omega[0] - w])

    return f


#: Bogacki and Shampine's pair of order 3 (2): stages, weights, weights of the error.
STAGES = np.array([[0, 0, 0, 0], [1 / 2, 0, 0, 0], [0, 3 / 4, 0, 0], [2 / 9, 1 / 3, 4 / 9, 0]])
WEIGHTS = STAGES[3]
ERRORS = WEIGHTS - np.array([7 / 24, 1 / 4, 1 / 3, 1 / 8])


def by_error(f, y, seconds, tolerance, least=1e-6, most=0.01):
    """y after ``seconds``, in steps whose error in the velocities stays below ``tolerance`` [m/s].

    A step of ``least`` is always taken. Steps are constants to the derivative, which is forward mode only.
    """

    def stage(slopes, x):
        k, row, y, h = x
        return slopes.at[k].set(f(y + h * (row @ slopes))), None

    def attempt(c):
        y, t, h = c
        h = jnp.minimum(h, seconds - t)
        same = lambda v: jnp.broadcast_to(v, (4, *jnp.shape(v)))
        slopes, _ = jax.lax.scan(stage, jnp.zeros((4, 13)), (jnp.arange(4), jnp.asarray(STAGES), same(y), same(h)))
        d = jax.lax.stop_gradient(jnp.abs(h * (ERRORS @ slopes)))
        error = jnp.maximum(d[3:6].max(), HALF * d[10:].max()) / tolerance
        taken = (error <= 1) | (h <= least)
        factor = jnp.clip(0.9 * (error + 1e-12) ** (-1 / 3), 0.2, 4.0)
        new = jnp.where(taken, y + h * (WEIGHTS @ slopes), y)
        return new, jnp.where(taken, t + h, t), jnp.clip(h * factor, least, most)

    start = (y, jnp.zeros(()), jnp.full((), most))
    return jax.lax.while_loop(lambda c: c[1] < seconds * (1 - 1e-12), attempt, start)[0]


def our_toss(toss: Toss, seconds: float):
    """The program and its arguments."""
    model, state = rbd.build(toss_scene(toss.soft), dt=MJX_STEP if toss.adaptive else toss.dt, method=toss.method)
    steps = round(seconds / toss.dt)

    def run(model, state):
        def y(v):
            start = state.replace(vel=state.vel.at[0, 2].set(v))
            if not toss.adaptive:
                return rbd.rollout(model, start, steps, every=steps)[0].pos[0, 1]
            parts = jnp.concatenate([start.pos[0], start.vel[0], start.quat[0], start.omega[0]])
            return by_error(vector_field(model, start), parts, seconds, toss.dt)[1]

        return derivative(y, state.vel[0, 2], toss.mode)

    return run, (model, state)


def mjx_model(scene: rbd.Scene, dt: float, integrator="euler", cone="elliptic", **options):
    """MJX's model and data of a scene; ``options`` are fields of mjOption."""
    mjx = mjx_module()
    model, data = compile_mujoco(scene)
    model.opt.timestep, model.opt.integrator, model.opt.cone = dt, STEPPERS[integrator], CONES[cone]
    for name, value in options.items():
        setattr(model.opt, name, value)
    return mjx.put_model(model), mjx.put_data(model, data)


def mjx_end(m, d, steps: int):
    """Data after ``steps`` steps; its index arrays get the width that a step gives them (64 bits under x64)."""
    step = mjx_module().step
    d = jax.tree.map(lambda c, kind: c.astype(kind.dtype), d, jax.eval_shape(step, m, d))
    return jax.lax.scan(lambda d, _: (step(m, d), None), d, length=steps)[0]


def mjx_toss(toss: Toss, seconds: float):
    m, d = mjx_model(toss_scene(), toss.dt, **toss.options)
    steps = round(seconds / toss.dt)

    def run(m, d):
        def y(v):
            return mjx_end(m, d.replace(qvel=d.qvel.at[2].set(v)), steps).qpos[1]

        return derivative(y, d.qvel[2], toss.mode)

    return run, (m, d)


def tossed(toss: Toss, quick: bool) -> dict:
    """The row of one case: value, derivative, seconds of compilation and of the run."""
    seconds = SECONDS if not quick else 0.1
    cone = toss.options.get("cone", "elliptic")
    row = {
        "row": "toss", "case": toss.case, "engine": toss.engine, "dt": toss.dt, "mode": toss.mode, "soft": toss.soft,
        "adaptive": toss.adaptive, "cone": cone, "options": toss.options,
    }  # fmt: skip
    if toss.engine == "MJX" and mjx_module() is None:
        return row | {"note": NO_MJX}
    try:
        run, (model, state) = (our_toss if toss.engine == "rbd_jax" else mjx_toss)(toss, seconds)
        program = compiled(run, model, state)
        (run_s,) = in_turn([lambda: program(model, state)], 3)
        y, dy = (float(c) for c in program(model, state))
    except Exception as error:  # MJX raises many kinds
        if toss.engine == "rbd_jax":
            raise
        return row | {"note": first_line(error)}
    row |= {"y": y, "dy": dy, "finite": math.isfinite(dy)}
    row |= {"compile_s": program.total_s, "run_s": run_s, "answer_s": program.total_s + run_s}
    row["compile_cpu_s"] = program.cpu_s
    if toss.soft:
        row |= {"y_error": abs(y / TRUTH[cone][0] - 1), "dy_error": abs(dy / TRUTH[cone][1] - 1)}
    else:
        at = lambda v: float(program(model, state.replace(vel=state.vel.at[0, 2].add(v)))[0])
        row["differences"] = (at(WIDTH) - at(-WIDTH)) / (2 * WIDTH)
    return row


#: Width of the central difference of our own rigid toss [m/s].
WIDTH = 1e-5


def toss_truth(quick: bool) -> Iterator[dict]:
    """MuJoCo's RK4 with central differences of three widths, at two steps."""
    scene, widths = dataclasses.replace(toss_scene(), tolerance=0.0), (1e-3, 1e-4, 1e-5)
    speeds = SPEED + np.array([0.0, *(s * w for w in widths for s in (1, -1))])
    model, state = rbd.build(scene, method="mujoco")
    q, v = (np.asarray(a, float) for a in rbd.to_mujoco(model, state))
    q, v = np.tile(q, (len(speeds), 1)), np.tile(v, (len(speeds), 1))
    v[:, 2] = speeds
    for cone in TRUTH:
        for dt in (1e-5, 2e-6) if not quick else (1e-3,):
            rival = MuJoCo(scene, dt)
            rival.model.opt.cone = CONES[cone]
            steps = round(SECONDS / dt)
            y = rival.run(q, v, steps, every=steps // 100)[0][:, -1, 1]
            rival.close()
            slopes = (y[1::2] - y[2::2]) / (2 * np.array(widths))
            yield {
                "row": "toss", "case": "RK4", "engine": "MuJoCo", "dt": dt, "mode": "differences", "soft": True,
                "cone": cone, "y": y[0], "dy": slopes[1], "finite": True, "widths": widths, "slopes": slopes,
                "y_error": abs(y[0] / TRUTH[cone][0] - 1), "dy_error": abs(slopes[1] / TRUTH[cone][1] - 1),
            }  # fmt: skip


def toss(quick: bool) -> Iterator[dict]:
    with jax.enable_x64(True):
        yield from toss_truth(quick)
        for case in toss_cases(quick):
            if not case.rival:
                yield tossed(case, quick)
        rivals = [c for c in toss_cases(quick) if c.rival]
        rounds = [[tossed(c, quick) for c in rivals] for _ in range(3 if not quick else 1)]
        for rows in zip(*rounds):  # in turn, as other work on the machine changes what compilation takes
            best = min(rows, key=lambda r: r.get("answer_s", 0.0))
            yield best | {"compilations_s": [r["compile_s"] for r in rows if "compile_s" in r]}


# --- bounce ----------------------------------------------------------------------------------------

E, FLIGHT = 0.8, 1.5
RADIUS = 0.1
RATES = (60, 120, 240, 480, 960, 2400)
BOUNCE_BAR = 1e-10


def bounced(h):
    """Height above contact after FLIGHT seconds, two bounces, and its derivative by the drop height ``h``."""
    t1 = np.sqrt(2 * h / G)
    dt1 = t1 / (2 * h)
    rise = E * E * G * t1
    left = FLIGHT - (1 + 2 * E) * t1
    slope = E * E * G * (dt1 * left - t1 * (1 + 2 * E) * dt1) + G * left * (1 + 2 * E) * dt1
    return rise * left - G * left * left / 2, slope


def reflected(z, v, dt):
    """Velocity turned at the end of a step that ends below the surface."""
    v = v - G * dt
    z = z + v * dt
    return z, jnp.where((z < 0) & (v < 0), -E * v, v)


def put_back(z, v, dt):
    """The same, and the ball put on the surface."""
    z, w = reflected(z, v, dt)
    return jnp.where(w != v - G * dt, 0.0, z), w


def linear_time(z, v, dt):
    """Time of impact at the velocity of the end of the step."""
    v = v - G * dt
    hits = (z + v * dt < 0) & (v < 0)
    t = jnp.where(hits, -z / jnp.where(hits, v, -1.0), 0.0)
    return jnp.where(hits, -E * v * (dt - t), z + v * dt), jnp.where(hits, -E * v, v)


def penalty(z, v, dt, stiffness=1e4):
    """A spring and damper that bounce with E, stepped explicitly."""
    zeta = -math.log(E) / math.hypot(math.pi, math.log(E))
    force = jnp.where(z < 0, -stiffness * z - 2 * zeta * math.sqrt(stiffness) * v, 0.0)
    v = v + (force - G) * dt
    return z + v * dt, v


#: Schemes written out above; what the table calls them.
SCHEMES = {
    "velocity reflected at the end of the step": reflected,
    "reflected, put on the surface": put_back,
    "linear time of impact": linear_time,
    "spring, k = 1e4 m": penalty,
}


def our_bounces() -> dict[str, rbd.Method]:
    of = lambda preset, events: dataclasses.replace(find(preset), events=events)
    return {
        '"gradient", events': of("gradient", find("gradient").events or EVENTS),
        '"accurate", events': of("accurate", EVENTS),
        '"gradient", no events': of("gradient", 0),
        '"accurate", no events': of("accurate", 0),
        '"fast", no events': of("fast", 0),
    }


JUDGED = '"gradient", events'


def ball_scene(z: float = 1.0 + RADIUS, e: float = E) -> rbd.Scene:
    ball = rbd.Body("ball", rbd.Sphere(RADIUS), pos=(0, 0, z), density=1000.0, restitution=e, friction=None)
    return rbd.Scene(bodies=[ball], static=[rbd.Geom(rbd.Plane(), friction=None)], dt=1 / 240)


SPHERE, FAST = 0.5, 2.0


def oblique_scene() -> rbd.Scene:
    """A weightless ball on its way down to a fixed sphere, off its centre."""
    ball = rbd.Body("ball", rbd.Sphere(RADIUS), pos=(0.3, 0, 2), vel=(0, 0, -FAST), restitution=E, friction=None)
    return rbd.Scene(bodies=[ball], static=[rbd.Geom(rbd.Sphere(SPHERE), friction=None)], gravity=None, dt=1 / 240)


def glanced(x0):
    """x after FLIGHT seconds and its derivative by the first x."""
    reach = RADIUS + SPHERE

    def x(x0):
        z = jnp.sqrt(reach**2 - x0**2)
        return x0 + (1 + E) * FAST * x0 * z / reach**2 * (FLIGHT - (2.0 - z) / FAST)

    return (np.asarray(c) for c in jax.jvp(x, (jnp.asarray(x0),), (jnp.ones_like(x0),)))


@dataclasses.dataclass(frozen=True)
class Bounce:
    """A scene of one ball, of which one coordinate of the start is varied and the same one of the end looked at.

    Attributes:
      exact: closed form (values, derivatives). axis: the coordinate. offset: its value [m] where that form has 0.
      starts: its first values (first, last).
    """

    title: str
    scene: Callable[[], rbd.Scene]
    exact: Callable
    axis: int
    offset: float
    starts: tuple[float, float]


BOUNCES = {
    "drop": Bounce("dropped, two bounces", ball_scene, bounced, 2, RADIUS, (0.9, 1.1)),
    "oblique": Bounce("thrown obliquely at a fixed sphere", oblique_scene, glanced, 0, 0.0, (0.25, 0.35)),
}


def ball_ends(b: Bounce, method: rbd.Method, starts, rate: int):
    """Coordinates after FLIGHT seconds, their derivatives forward and reverse."""
    model, state = rbd.build(b.scene(), dt=1 / rate, method=method)
    states = rbd.batch(state, len(starts))
    steps = round(FLIGHT * rate)

    def end(h):
        pos = states.pos.at[:, 0, b.axis].set(h + b.offset)
        return rbd.rollout(model, states.replace(pos=pos), steps, every=steps)[0].pos[:, 0, b.axis] - b.offset

    h = jnp.asarray(starts)
    value, forward = jax.jit(lambda h: jax.jvp(end, (h,), (jnp.ones_like(h),)))(h)
    return value, forward, jax.jit(jax.grad(lambda h: end(h).sum()))(h)


def scheme_ends(scheme, heights, rate: int):
    steps = round(FLIGHT * rate)

    def end(h):
        one = lambda s, _: (scheme(*s, 1 / rate), None)
        return jax.lax.scan(one, (h, jnp.zeros_like(h)), length=steps)[0][0]

    h = jnp.asarray(heights)
    value, forward = jax.jit(lambda h: jax.jvp(end, (h,), (jnp.ones_like(h),)))(h)
    return value, forward, forward


def bounce(quick: bool) -> Iterator[dict]:
    with jax.enable_x64(True):
        for key, b in BOUNCES.items():
            starts = np.linspace(*b.starts, 401 if not quick else 5)
            value, slope = b.exact(starts)
            runs = {k: functools.partial(ball_ends, b, m) for k, m in our_bounces().items()}
            if key == "drop":
                runs |= {k: functools.partial(scheme_ends, s) for k, s in SCHEMES.items()}
            if quick:
                runs = {k: run for k, run in runs.items() if k == JUDGED or k in SCHEMES}
            for name, run in runs.items():
                for rate in RATES if not quick else RATES[:1]:
                    got, forward, reverse = (np.asarray(c) for c in run(starts, rate))
                    error = np.abs(forward - slope)
                    yield {
                        "row": "bounce", "scene": key, "case": name, "rate": rate,
                        "value_error": np.median(np.abs(got - value)), "gradient_error": np.median(error),
                        "worst": error.max(), "mean_slope": slope.mean(),
                        "reverse_differs": np.abs(forward - reverse).max(), "judged": name == JUDGED,
                    }  # fmt: skip


# --- cost ------------------------------------------------------------------------------------------

COST_STEP = 1 / 240
REVERSE_BAR, REVERSE_AIM, MEMORY_BAR, COMPILE_BAR = 7.0, 4.0, 2.0, 30.0


def box_scene() -> rbd.Scene:
    box = rbd.Body("box", rbd.Box((0.2, 0.15, 0.1)), pos=(0, 0, 0.12), vel=(1.0, 0.5, 0), friction=0.5)
    return rbd.Scene(bodies=[box], static=[rbd.Geom(rbd.Plane(), friction=0.5)], dt=COST_STEP)


def stack_scene(count: int = 5) -> rbd.Scene:
    boxes = [rbd.Body(f"box{i}", rbd.Box((0.1,) * 3), pos=(0, 0, 0.1 + 0.201 * i), friction=0.6) for i in range(count)]
    return rbd.Scene(bodies=boxes, static=[rbd.Geom(rbd.Plane(), friction=0.6)], dt=COST_STEP)


def ten_scene(every_other: rbd.Box | rbd.Sphere) -> rbd.Scene:
    """Five balls and five of ``every_other`` in two layers, falling a little."""
    bodies = []
    for i in range(10):
        shape = every_other if i % 2 else rbd.Sphere(0.1)
        place = (0.25 * (i % 5) + 0.03 * (i // 5), 0.02 * i, 0.105 + 0.22 * (i // 5))
        bodies.append(rbd.Body(f"body{i}", shape, pos=place, friction=0.6))
    return rbd.Scene(bodies=bodies, static=[rbd.Geom(rbd.Plane(), friction=0.6)], dt=COST_STEP)


#: name: (title, scene)
COST_SCENES = {
    "ball": ("one ball", ball_scene),
    "box": ("box on a plane", box_scene),
    "stack": ("five-box stack", stack_scene),
    "boxes": ("ten-box stack", functools.partial(stack_scene, 10)),
    "balls": ("ten balls", functools.partial(ten_scene, rbd.Sphere(0.1))),
    "ten": ("five boxes, five balls", functools.partial(ten_scene, rbd.Box((0.1,) * 3))),
}
#: Those that the bar of compilation is for.
TEN_BODIES = ("boxes", "balls", "ten")
#: (scene, steps, worlds, blocks of ``checkpoint``)
COST_CASES = [
    *((s, 100, b, (None, 10)) for s in ("ball", "box") for b in (1, 64)),
    *((s, steps, 1, (32, 100, (100, 10))) for s in ("ball", "box") for steps in (1000, 10000)),
    ("stack", 100, 1, (None, 10)),
    ("stack", 100, 64, (10,)),
    *((s, 100, 1, (None,)) for s in TEN_BODIES),
]
#: A program whose run is expected to take longer [s] is compiled, for its memory, and not timed.
LONGEST = 60.0


def cost_state(scene: rbd.Scene, worlds: int):
    """Model of the preset "gradient" with events (where they can be), and slightly different worlds."""
    method = find("gradient")
    method = method if method.events else events_on(method)
    model, state = rbd.build(scene, dt=COST_STEP, method=method)
    states = rbd.batch(state, worlds)
    push = 0.05 * np.random.default_rng(0).normal(size=states.vel.shape) * [1.0, 1.0, 0.0]
    return model, states.replace(vel=states.vel + jnp.asarray(push, states.vel.dtype))


def loss_of(steps: int, block=None):
    """(positions, velocities, model, state) -> a number that depends on all of them."""
    options = {} if block is None else {"checkpoint": block}

    def loss(pos, vel, model, state):
        final, _ = rbd.rollout(model, state.replace(pos=pos, vel=vel), steps, every=steps, **options)
        return (final.pos + 0.1 * final.vel).sum()

    return loss


def temporary(program: Program) -> int:
    """Peak size of a program's own buffers [B]."""
    return int(program._call.memory_analysis().temp_size_in_bytes)


def memory_text(value) -> str:
    return "-" if value is None else f"{value / 2**20:.3g} MB"


def our_cost(scene: str, steps: int, worlds: int, blocks, repeats: int, rates: dict) -> Iterator[dict]:
    model, state = cost_state(COST_SCENES[scene][1](), worlds)
    method = model.method
    loss = loss_of(steps)
    forward = compiled(lambda m, s: loss(s.pos, s.vel, m, s), model, state)
    programs = {}
    for block in blocks:
        with_block = loss_of(steps, block)
        both = lambda m, s, f=with_block: jax.value_and_grad(f, argnums=(0, 1))(s.pos, s.vel, m, s)
        programs[block] = compiled(both, model, state)
    calls = [lambda: forward(model, state), *(lambda p=p: p(model, state) for p in programs.values())]
    expected = rates.get((scene, worlds), 0.0) * steps
    told = 5 * expected < LONGEST
    repeats = max(1, min(repeats, int(LONGEST / max(5 * expected * len(calls), 1e-3))))
    seconds = in_turn(calls, repeats) if told else [None] * len(calls)
    if told:
        rates[scene, worlds] = seconds[0] / steps
    for (block, program), took in zip(programs.items(), seconds[1:]):
        finite = None
        if told:
            finite = all(bool(jnp.isfinite(g).all()) for g in program(model, state)[1])
        numbers = 6 * state.n
        yield {
            "row": "cost", "case": f"{scene}, {steps} steps, {worlds} worlds, block {block}", "scene": scene,
            "engine": "rbd_jax", "steps": steps, "worlds": worlds, "block": block, "numbers": numbers,
            "events": method.events, "forward_s": seconds[0], "reverse_s": took,
            "ratio": took / seconds[0] if told else None,
            "forward_B": temporary(forward), "reverse_B": temporary(program),
            "forward_compile_s": forward.total_s, "compile_s": program.total_s, "compile_cpu_s": program.cpu_s,
            "finite": finite, "repeats": repeats,
            "differences_s": 2 * numbers * seconds[0] if told else None,
        }  # fmt: skip


#: MJX as it comes, and the two ways in which it can be differentiated backwards: (name, options).
MJX_SOLVERS = {
    "as it comes": {},
    "tolerance 0, 4 iterations": {"tolerance": 0.0, "iterations": 4, "ls_iterations": 10},
    "1 iteration": {"iterations": 1, "ls_iterations": 4},
}


def mjx_cost(scene: str, steps: int, solver: str, repeats: int) -> dict:
    row = {
        "row": "cost", "case": f"MJX {scene}, {steps} steps, {solver}", "scene": scene, "engine": "MJX", "steps": steps,
        "worlds": 1, "solver": solver,
    }  # fmt: skip
    if mjx_module() is None:
        return row | {"note": NO_MJX}
    try:
        m, d = mjx_model(COST_SCENES[scene][1](), COST_STEP, **MJX_SOLVERS[solver])

        def loss(qpos, qvel, m, d):
            d = mjx_end(m, d.replace(qpos=qpos, qvel=qvel), steps)
            return d.qpos.sum() + 0.1 * d.qvel.sum()

        forward = compiled(lambda m, d: loss(d.qpos, d.qvel, m, d), m, d)
        row |= {"forward_B": temporary(forward), "forward_compile_s": forward.total_s}
        (row["forward_s"],) = in_turn([lambda: forward(m, d)], 1)
        both = compiled(lambda m, d: jax.value_and_grad(loss, argnums=(0, 1))(d.qpos, d.qvel, m, d), m, d)
        row["forward_s"], row["reverse_s"] = in_turn([lambda: forward(m, d), lambda: both(m, d)], repeats)
        gradient = both(m, d)[1]
    except Exception as error:  # MJX raises many kinds
        return row | {"note": first_line(error)}
    return row | {
        "ratio": row["reverse_s"] / row["forward_s"], "reverse_B": temporary(both), "compile_s": both.total_s,
        "finite": all(bool(jnp.isfinite(g).all()) for g in gradient),
    }  # fmt: skip


def cost(quick: bool, scenes=tuple(COST_SCENES)) -> Iterator[dict]:
    rates: dict = {}
    repeats = 5 if not quick else 1
    for scene, steps, worlds, blocks in COST_CASES if not quick else [("ball", 20, 2, (None, 10))]:
        if scene in scenes:
            yield from our_cost(scene, steps, worlds, blocks, repeats, rates)
    for scene in ("ball", "box", "stack") if not quick else ():
        for solver in MJX_SOLVERS if scene != "stack" else ("as it comes",):
            if scene in scenes:
                yield mjx_cost(scene, 100, solver, repeats)


ROWS: dict[str, Callable[[bool], Iterator[dict]]] = {"toss": toss, "bounce": bounce, "cost": cost}


# --- the page --------------------------------------------------------------------------------------


def toss_page(rows: list[dict], misses: list[str]) -> str:
    good = [r for r in rows if r["engine"] == "rbd_jax" and r["soft"] and r["mode"] == "forward" and r["finite"]]
    good = [r for r in good if max(r["y_error"], r["dy_error"]) <= TOSS_BAR]
    good = [r for r in good if "compilations_s" in r] or good
    best = min(good, key=lambda r: r["answer_s"], default=None)
    theirs = [r for r in rows if r["engine"] == "MJX" and r["case"] == "Euler" and r["dt"] == MJX_STEP and "y" in r]
    allowed = {r["cone"]: r["answer_s"] for r in theirs if r["mode"] == "forward"}
    if best is None:
        misses.append(f"toss: nothing of ours is within {100 * TOSS_BAR:g} % of value and derivative")
        summary = ""
    else:
        at = f"tolerance {best['dt']:g} m/s" if best["adaptive"] else step_text(best["dt"])
        summary = f"Cheapest of ours within {100 * TOSS_BAR:g} %: {best['case']}, {at}, {best['answer_s']:.1f} s"
        summary += "; MJX Euler at 1 ms takes " if allowed else ""
        summary += " and ".join(f"{s:.1f} s ({cone})" for cone, s in allowed.items()) + "."
        if allowed and best["answer_s"] > min(allowed.values()):
            misses.append(f"toss: {best['answer_s']:.1f} s to the answer, MJX Euler {min(allowed.values()):.1f} s")
    lines = []
    for r in rows:
        at = f"tolerance {r['dt']:g}" if r.get("adaptive") else step_text(r["dt"])
        name = f"**{r['case']}**" if r is best else r["case"]
        cone = r["cone"] if r["soft"] else "-"
        if "note" in r:
            lines.append([r["engine"], name, cone, at, r["mode"], r["note"], *["-"] * 7])
            continue
        error = lambda k: "-" if r.get(k) is None else f"{100 * r[k]:.2g} %"
        lines.append(
            [r["engine"], name, cone, at, r["mode"], number(r["y"], 6), error("y_error")]
            + [number(r["dy"], 4) if r["finite"] else "not finite"]
            + [f"differences {number(r['differences'], 4)}" if "differences" in r else error("dy_error")]
            + [number(r.get(k)) for k in ("compile_cpu_s", "compile_s", "run_s", "answer_s")]
        )
    plateau = "; ".join(
        f"{r['cone']} at {1e6 * r['dt']:g} us {', '.join(number(s, 5) for s in r['slopes'])}"
        for r in rows
        if r["engine"] == "MuJoCo"
    )
    heads = ["engine", "case", "cone", "step", "mode", "y(T) [m]", "error", "dy/dv [s]", "error"]
    heads += ["compile, CPU [s]", "compile [s]", "run [s]", "both [s]"]
    (y, dy), pyramid = TRUTH["elliptic"], "{}, {}".format(*TRUTH["pyramidal"])
    return f"""## Cube toss

A cube of 0.1 m, turned by 60 degrees, thrown at the ground at 2 m/s: y after one second and its derivative by the
first vertical velocity. Law: solref (0.005, 1), solimp (0, 0.95, 0.001, 0.5, 2), friction 1, refsafe off; its truth is
MuJoCo's RK4: y = {y}, dy/dv = {dy} (pyramidal cone: {pyramid}).
Central differences of it with widths 1e-3, 1e-4, 1e-5 m/s: {plateau}.

{summary}

{common.table(heads, lines)}

"Steps by error" is Bogacki and Shampine's pair around `rbd.step`, forty lines of the script; the other cases of ours
are `rbd.rollout`; Euler and RK4 are MuJoCo's, as those of MJX. **Bold**: compiled three times in turn with MJX Euler at
1 ms, best of three. The law has a jump: at first touch the impedance is MuJoCo's least, 1e-4, not 0. No derivative
along a path sees it; for the elliptic cone that is 0.3 % of the derivative, to which ours converge. "Rigid" is another
law, without rebound, of which no truth is known: beside its derivative the central difference of the same program. The
authors of DiffMJX (arXiv 2506.14186), with collisions of their own and so another truth, 0.1714, publish for MJX Euler
3.24 at 1 ms, -0.60 at 0.3 ms, 0.13 at 0.1 ms, and for RK4 0.93 at 1 ms.

![Error of the derivative of the toss against the time to the answer](gradient_toss.png)
"""


def bounce_page(rows: list[dict], misses: list[str]) -> str:
    parts = []
    for key, b in BOUNCES.items():
        here = [r for r in rows if r["scene"] == key]
        lines = []
        for name in dict.fromkeys(r["case"] for r in here):
            mine = {r["rate"]: r for r in here if r["case"] == name}
            largest = max(r["gradient_error"] for r in mine.values())
            if name == JUDGED and not largest <= BOUNCE_BAR:
                misses.append(f"bounce: {key}: {name}: {number(largest)}, bar {BOUNCE_BAR:g}")
            for what, word in (("value_error", "value [m]"), ("gradient_error", "**gradient**")):
                lines.append([name, word, *(number(mine[k][what], 2) if k in mine else "-" for k in RATES)])
        if here:
            head = f"{b.title[0].upper()}{b.title[1:]}; mean derivative {number(here[0]['mean_slope'])}:"
            parts += [head, common.table(["scheme", "error of", *(f"1/{k} s" for k in RATES)], lines)]
    differs = max((r["reverse_differs"] for r in rows if r["case"].startswith('"')), default=0.0)
    tables = "\n\n".join(parts)
    return f"""## Bouncing ball

e = {E:g}, {FLIGHT:g} s, 401 worlds: median error of the last height (dropped from 0.9 to 1.1 m) or place (thrown at a
sphere of {SPHERE:g} m, 0.25 to 0.35 m off its centre) and of its derivative by the first, against the closed form.
Bar of "gradient" with events: {BOUNCE_BAR:g} at every step. Forward and reverse mode of ours differ by at most
{number(differs)}.

{tables}

The values converge, the gradients do not: an impact at the end of a step has the wrong speed by up to g h, or the wrong
normal by up to v h / R, and how wrong depends on the start, with a slope that does not shrink with h. A ball on a plane
needs no events in rbd_jax, as its step resolves a restitution at its own instant; with the normal that belongs to
that instant it needs them.

![Error of value and gradient of a bouncing ball against the step](gradient_bounce.png)
"""


def cost_page(rows: list[dict], misses: list[str]) -> str:
    ours, theirs = ([r for r in rows if r["engine"] == e] for e in ("rbd_jax", "MJX"))
    heads = ["scene", "steps", "worlds", "block", "forward [s]", "reverse [s]", "ratio", "forward mem", "reverse mem"]
    heads += ["compile, CPU [s]", "compile [s]", "differences over reverse"]
    groups: dict = {}
    for r in ours:
        groups.setdefault((r["scene"], r["steps"], r["worlds"]), []).append(r)
    lines = []
    for (scene, steps, worlds), group in groups.items():
        timed = [r for r in group if r["ratio"] is not None]
        fastest = min(timed, key=lambda r: r["ratio"], default=None)
        if fastest is not None and steps >= 100 and fastest["ratio"] > REVERSE_BAR:
            misses.append(f"cost: {scene}, {steps} steps, {worlds} worlds: {number(fastest['ratio'])} x forward")
        for r in group:
            ratio = number(r["ratio"])
            over = None if r["ratio"] is None else r["differences_s"] / r["reverse_s"]
            lines.append(
                [COST_SCENES[scene][0], f"{steps:,}", worlds, json.dumps(r["block"]).replace("null", "-")]
                + [number(r["forward_s"]), number(r["reverse_s"]), f"**{ratio}**" if r is fastest else ratio]
                + [memory_text(r["forward_B"]), memory_text(r["reverse_B"])]
                + [number(r["compile_cpu_s"]), number(r["compile_s"]), number(over)]
            )
    for scene in COST_SCENES:
        least = {
            steps: min((r["reverse_B"] for r in groups.get((scene, steps, 1), [])), default=None)
            for steps in (1000, 10000)
        }
        if None not in least.values() and least[10000] > MEMORY_BAR * least[1000]:
            growth = number(least[10000] / least[1000])
            misses.append(f"cost: {scene}: memory at 10,000 steps {growth} x that at 1,000, bar {MEMORY_BAR:g}")
    for scene in TEN_BODIES:
        ten = [r["compile_s"] for r in ours if r["scene"] == scene]
        if ten and min(ten) > COMPILE_BAR:
            misses.append(f"cost: {COST_SCENES[scene][0]} compile in {number(min(ten))} s, bar {COMPILE_BAR:g}")
    table = []
    for r in theirs:
        rest = [number(r.get(k)) for k in ("forward_s", "reverse_s", "ratio")] + [memory_text(r.get("reverse_B"))]
        rest += [number(r.get(k)) for k in ("forward_compile_s", "compile_s")]
        table.append([COST_SCENES[r["scene"]][0], f"{r['steps']:,}", r["solver"], *rest, r.get("note", "")])
    beside = ["scene", "steps", "solver", "forward [s]", "reverse [s]", "ratio", "reverse mem"]
    beside += ["compile forward", "compile reverse", ""]
    return f"""## Cost of reverse mode

Preset "gradient" with events, float32, 1/240 s: d loss / d (positions, velocities) of all bodies. Forward: the rollout
and the loss alone. Best of several runs in turn; a run of more than {LONGEST:g} s is not timed. Memory: XLA's own count
of temporary buffers. "block": ``rollout(..., checkpoint=...)``; **bold**: the fastest. Differences: 12 rollouts a body.
Bars: reverse {REVERSE_BAR:g} x forward (aim {REVERSE_AIM:g}), memory at 10,000 steps {MEMORY_BAR:g} x that at 1,000,
compilation of the ten bodies {COMPILE_BAR:g} s.

{common.table(heads, lines)}

MJX, one world, the same MJCF (which has no restitution), elliptic cone, float32:

{common.table(beside, table)}
"""


PAGES = {"toss": toss_page, "bounce": bounce_page, "cost": cost_page}


def report(rows: list[dict], quick: bool) -> str:
    env = max((r["environment"] for r in rows), key=lambda e: e["date"])
    misses: list[str] = []
    parts = []
    for key, page in PAGES.items():
        mine = [r for r in rows if r["row"] == key]
        if mine:
            parts.append(page(mine, misses))
    verdict = f"{len(misses)} missed{': ' + '; '.join(misses) if misses else ''}."
    return "\n".join(
        [
            "# Gradients",
            "",
            common.header(env) + f" MJX {env['versions'].get('mujoco-mjx') or 'not installed'}.",
            "Made by `benchmarks/gradients.py`.",
            "",
            "Quick run: much too short, nothing is judged." if quick else verdict,
            "",
            *parts,
        ]
    )


def last_rows(rows: list[dict], quick: bool) -> list[dict]:
    """The last row of every case, in the order in which the cases came first."""
    last = {}
    for r in rows:
        if r["quick"] == quick:
            names = ("row", "scene", "engine", "case", "cone", "dt", "mode", "rate")
            last[tuple(r.get(k) for k in names)] = r
    return list(last.values())


# --- charts ----------------------------------------------------------------------------------------


def bounce_chart(rows: list[dict], path: pathlib.Path) -> None:
    from matplotlib import pyplot as plt

    styles = {
        JUDGED: ('rbd_jax "gradient": events', BLUE, "o", "-"),
        '"fast", no events': ('rbd_jax "fast": no events', SKY, "s", "--"),
        "velocity reflected at the end of the step": ("velocity reflected at the end of the step", RED, "D", "-"),
        "linear time of impact": ("linear time of impact", ORANGE, "P", "-"),
        "spring, k = 1e4 m": ("spring, k = 1e4 m", BLACK, "x", ":"),
    }
    panels = (
        ("drop", "value_error", "two bounces: the values converge ..."),
        ("drop", "gradient_error", "... the gradients do not"),
        ("oblique", "gradient_error", "oblique impact: gradient"),
    )
    figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.8), layout="constrained", dpi=150, sharex=True, sharey=True)
    for ax, (scene, key, title) in zip(axes, panels):
        for name, (label, colour, marker, line) in styles.items():
            mine = sorted((r["rate"], r[key]) for r in rows if r["case"] == name and r["scene"] == scene)
            if mine:
                step, error = 1 / np.array([m[0] for m in mine]), [max(m[1], 1e-16) for m in mine]
                ax.loglog(step, error, marker + line, color=colour, label=label, markersize=4.5, linewidth=1.3)
        ax.set_title(title, fontsize=9)
        ax.set_xlabel("step [s]", fontsize=9)
        ax.grid(True, which="major", color="0.9", linewidth=0.6)
        ax.tick_params(labelsize=8)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("median error ([m] or [-])", fontsize=9)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.savefig(path)
    plt.close(figure)


def toss_chart(rows: list[dict], path: pathlib.Path) -> None:
    from matplotlib import pyplot as plt

    styles = {
        ("rbd_jax", "steps by error"): ("rbd_jax, steps by error", BLUE, "o", "-"),
        ("rbd_jax", "RK4"): ("rbd_jax, RK4", SKY, "s", "-"),
        ("rbd_jax", "Euler"): ("rbd_jax, MuJoCo's Euler", GREEN, "^", "--"),
        ("MJX", "Euler"): ("MJX, Euler", RED, "D", "--"),
        ("MJX", "RK4"): ("MJX, RK4", ORANGE, "P", "-"),
    }
    figure, ax = plt.subplots(figsize=(6.5, 4.2), layout="constrained", dpi=150)
    for key, (label, colour, marker, line) in styles.items():
        mine = [r for r in rows if (r["engine"], r["case"]) == key and r["mode"] == "forward" and r.get("finite")]
        points = [(r["answer_s"], r["dy_error"], r["dt"], r["adaptive"]) for r in mine]
        points.sort(key=lambda p: -p[2])
        if points:
            x, error, *_ = zip(*points)
            ax.semilogy(x, error, marker + line, color=colour, label=label, markersize=5, linewidth=1.2)
            for a, b, dt, free in points:
                text = f"{dt:.0e} m/s".replace("e-0", "e-") if free else step_text(dt)
                ax.annotate(text, (a, b), xytext=(5, 2), textcoords="offset points", fontsize=6.5, color=colour)
    ax.axhline(TOSS_BAR, color=BLACK, linewidth=0.8, linestyle=":")
    ax.annotate("0.5 %", (1, TOSS_BAR), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=7)
    ax.set_xlim(left=0)
    ax.set_xlabel("compilation and run [s]", fontsize=9)
    ax.set_ylabel("relative error of d y(T) / d v_z(0)", fontsize=9)
    ax.set_title("cube toss: error of the derivative against the time to the answer", fontsize=10)
    ax.tick_params(labelsize=8)
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(fontsize=8, frameon=False)
    figure.savefig(path)
    plt.close(figure)


CHARTS = {"toss": ("gradient_toss.png", toss_chart), "bounce": ("gradient_bounce.png", bounce_chart)}


def draw(rows: list[dict], out: pathlib.Path) -> list[str]:
    """The charts of what there is; names of the files, none without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        print("no charts: matplotlib is not installed")
        return []
    matplotlib.use("Agg")
    made = []
    for key, (name, chart) in CHARTS.items():
        mine = [r for r in rows if r["row"] == key]
        if mine:
            chart(mine, out / name)
            made.append(name)
    return made


def told(row: dict) -> str:
    """A row in one line."""
    shown = {
        "toss": ("y", "dy", "dy_error", "compile_s", "run_s"),
        "bounce": ("value_error", "gradient_error"),
        "cost": ("forward_s", "reverse_s", "ratio", "compile_s"),
    }
    parts = [f"{k} {number(row[k], 4)}" for k in shown[row["row"]] if row.get(k) is not None]
    at = f" 1/{row['rate']} s" if "rate" in row else ""
    if "dt" in row:
        at = f" {row['dt']:g} {row['mode']}"
    if row.get("reverse_B") is not None:
        parts.append(memory_text(row["reverse_B"]))
    name = f"{row['row']} | {row.get('scene') or row.get('engine')}: {row['case']}{at}"
    return f"{name} | " + ", ".join([*parts, *filter(None, [row.get("note")])])


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rows", default="", metavar="A,B", help=f"default all: {','.join(ROWS)}")
    parser.add_argument("--scenes", default="", metavar="A,B", help=f"of cost: {','.join(COST_SCENES)}; default all")
    parser.add_argument("--quick", action="store_true", help="a case or two of each, a few steps; nothing is judged")
    parser.add_argument("--report", action="store_true", help="run nothing, write the page and the charts")
    parser.add_argument("--budget", type=float, default=5400.0, help="no further case is begun after so many seconds")
    parser.add_argument("--out", type=pathlib.Path, default=None, metavar="DIR", help="default benchmarks/results")
    args = parser.parse_args(argv)
    keys = [k for k in args.rows.split(",") if k] or list(ROWS)
    for key in keys:
        if key not in ROWS:
            parser.error(f"unknown row '{key}'; rows: {', '.join(ROWS)}")
    scenes = [s for s in args.scenes.split(",") if s] or list(COST_SCENES)
    for scene in scenes:
        if scene not in COST_SCENES:
            parser.error(f"unknown scene '{scene}'; scenes: {', '.join(COST_SCENES)}")
    rows = ROWS | {"cost": functools.partial(cost, scenes=scenes)}
    begin, out = time.perf_counter(), args.out or common.RESULTS
    env, lines = environment(), out / "gradients.jsonl"
    print(common.header(env), flush=True)
    for key in keys if not args.report else ():
        for row in rows[key](args.quick):
            row = common.plain(row | {"quick": args.quick, "environment": env})
            common.append_lines(lines, [row])
            print(f"{told(row)}  ({time.perf_counter() - begin:.0f} s)", flush=True)
            if time.perf_counter() - begin > args.budget:
                print(f"time ran out ({args.budget:g} s) in {key}", flush=True)
                break
    kept = [json.loads(s) for s in lines.read_text(encoding="utf-8").splitlines()] if lines.exists() else []
    kept = last_rows(kept, args.quick)
    if kept:
        (out / "gradients.md").write_text(report(kept, args.quick), encoding="utf-8")
        print(f"wrote {lines}, {', '.join(['gradients.md', *draw(kept, out)])}  ({time.perf_counter() - begin:.0f} s)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
