"""World-steps per second beside ``mujoco.rollout``, compile time, and the error at that speed.

    PYTHONPATH=. python benchmarks/throughput.py                 (about 7 minutes on 2 cores)
    PYTHONPATH=. python benchmarks/throughput.py --smoke --out /tmp/x
    PYTHONPATH=. python benchmarks/throughput.py --devices 2     (two host devices instead of two threads)

Appends to throughput.jsonl and writes throughput.md under ``--out`` (benchmarks/results).

Both sides run the same MJCF, the same start states and the same number of steps of 4 ms, one after the
other in turn. Ours is float32, MuJoCo float64; both use all cores (two threads of MuJoCo, which does not gain by more
here). MuJoCo stores the state of every
step (``rollout`` cannot do otherwise), ours the last one; "every step stored" is ours with all of them.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import pathlib
import subprocess
import sys
import time

_parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
_parser.add_argument("--smoke", action="store_true", help="a few seconds: one scene, few worlds and steps")
_parser.add_argument("--devices", type=int, default=1, metavar="N", help="host devices to shard the batch over")
_parser.add_argument("--scenes", default="", metavar="A,B", help="only these scenes")
_parser.add_argument("--rivals", action="store_true", help="MJX and Brax too, where they are (twenty minutes more)")
_parser.add_argument("--report", action="store_true", help="measure nothing: the page of the last run in the file")
_parser.add_argument("--of", nargs=2, metavar=("RIVAL", "WORLDS"), help=argparse.SUPPRESS)  # what --rivals calls
_parser.add_argument("--repeats", type=int, default=5, metavar="N", help="timed runs of each side (default 5)")
_parser.add_argument("--out", type=pathlib.Path, default=None, metavar="DIR", help="default benchmarks/results")
if __name__ == "__main__":
    _args = _parser.parse_args()
    if _args.devices > 1:
        os.environ["XLA_FLAGS"] = (
            os.environ.get("XLA_FLAGS", "") + f" --xla_force_host_platform_device_count={_args.devices}"
        )

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
from common import G, MuJoCo, Program, number, verdict  # noqa: E402

import rbd_jax as rbd  # noqa: E402

DT = 0.004
MU = 0.5
HALF = (0.2, 0.15, 0.1)
LEAST = 1024
RUNS_OF_ERROR = 64  # worlds whose error is measured
ROUNDING = float(np.finfo(np.float32).eps) / 2  # of a metre in float32 [m]
SLOW = {"pile64": 4}  # fewer where MuJoCo takes 10 ms a step


# --- scenes: (scene, start states of B worlds) ---


def _scene(bodies, friction=MU, plane=True):
    return rbd.Scene(bodies=bodies, static=[rbd.Geom(rbd.Plane(), friction=friction)] if plane else [], dt=DT)


def ball():
    scene = _scene([rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 0.15), friction=MU)])

    def worlds(state, n, rng):
        pos = np.stack([rng.normal(size=n), rng.normal(size=n), rng.uniform(0.1, 0.3, n)], -1)
        vel, omega = rng.normal(size=(n, 1, 3)) * [1.0, 1.0, 0.2], 5 * rng.normal(size=(n, 1, 3))
        return common.start(state, pos[:, None], vel, omega)

    return scene, worlds


def _free(half):
    scene = _scene([rbd.Body("body", rbd.Box(half), omega=(1.0, 2.0, 3.0))], plane=False)

    def worlds(state, n, rng):
        spin = rng.normal(size=(n, 1, 3))
        spin *= rng.uniform(2.0, 6.0, (n, 1, 1)) / np.linalg.norm(spin, axis=-1, keepdims=True)
        return common.start(
            state, rng.normal(size=(n, 1, 3)), rng.normal(size=(n, 1, 3)), spin, common.random_quat(rng, n, 1)
        )

    return scene, worlds


def isotropic():
    return _free((0.1, 0.1, 0.1))


def asymmetric():
    return _free((0.1, 0.15, 0.2))


def box():
    scene = _scene([rbd.Body("box", rbd.Box(HALF), pos=(0, 0, 0.2), friction=MU)])

    def worlds(state, n, rng):
        tilt = np.concatenate([np.ones((n, 1)), rng.normal(size=(n, 3)) * [0.1, 0.1, 1.0]], -1)
        pos = np.stack([rng.normal(size=n), rng.normal(size=n), rng.uniform(0.16, 0.25, n)], -1)
        vel, omega = rng.normal(size=(n, 1, 3)) * [1, 1, 0.2], rng.normal(size=(n, 1, 3))
        tilt /= np.linalg.norm(tilt, axis=-1, keepdims=True)
        return common.start(state, pos[:, None], vel, omega, tilt[:, None])

    return scene, worlds


def _stack(n):
    half = 0.1
    bodies = [
        rbd.Body(f"box{i}", rbd.Box((half, half, half)), pos=(0, 0, half * (2 * i + 1)), friction=0.6) for i in range(n)
    ]
    scene = _scene(bodies, friction=0.6)

    def worlds(state, size, rng):
        pos = np.asarray(state.pos) + rng.uniform(-1, 1, (size, n, 3)) * [0.01, 0.01, 0.0]
        pos[..., 2] += 0.002 * np.arange(1, n + 1)  # every box falls a little
        turn = np.concatenate([np.ones((size, n, 1)), rng.normal(size=(size, n, 3)) * [0, 0, 0.05]], -1)
        vel = rng.normal(size=(size, n, 3)) * [0.05, 0.05, 0.0]
        return common.start(state, pos, vel, None, turn / np.linalg.norm(turn, axis=-1, keepdims=True))

    return scene, worlds


def _dropped(shapes, width):
    """Bodies dropped into a bin of four upright planes; the start of the timed run is 1.5 s later, at rest but for
    rolling."""
    n = len(shapes)
    side = int((width - 0.04) / 0.22)  # as many as lie beside each other
    pitch = (width - 0.24) / (side - 1)
    place = lambda k: (pitch * (k % side - (side - 1) / 2), pitch * (k // side % side - (side - 1) / 2))
    bodies = [
        rbd.Body(f"b{k}", shape, pos=(*place(k), 0.15 + 0.3 * (k // side**2)), friction=MU)
        for k, shape in enumerate(shapes)
    ]
    half = width / 2
    turn = lambda axis, angle: (np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis, float)))
    upright = [((-half, 0, 0), (0, 1, 0), 1), ((half, 0, 0), (0, 1, 0), -1), ((0, -half, 0), (1, 0, 0), -1),
               ((0, half, 0), (1, 0, 0), 1)]  # fmt: skip
    walls = [
        rbd.Geom(rbd.Plane(), pos=at, quat=turn(axis, sign * np.pi / 2), friction=MU) for at, axis, sign in upright
    ]
    scene = rbd.Scene(bodies, [rbd.Geom(rbd.Plane(), friction=MU), *walls], dt=DT)
    model = functools.cache(lambda: rbd.build(scene, dt=DT, method="fast")[0])

    def worlds(state, size, rng):
        pos = np.asarray(state.pos) + rng.uniform(-0.01, 0.01, (size, n, 3))
        dropped = common.start(state, pos, rng.normal(size=(size, n, 3)) * 0.1)
        settled = rbd.rollout(model(), dropped._with(memory=None), 375, every=375)[0]
        return common.start(state, settled.pos, settled.vel, settled.omega, settled.quat)

    return scene, worlds


def pile16():
    return _dropped([rbd.Sphere(0.1)] * 16, 0.56)


def pile64():
    return _dropped([rbd.Sphere(0.1)] * 64, 0.94)


def clutter():
    shapes = [rbd.Sphere(0.1), rbd.Box((0.12, 0.1, 0.1)), rbd.Sphere(0.1), rbd.Box((0.1, 0.1, 0.1))] * 2
    return _dropped(shapes, 0.6)


#: name: (maker, steps timed, batches of "fast", batch of "accurate", MuJoCo's worlds, bars of ratio and compile [s])
SCENES = {
    "ball": (ball, 1000, (1024, 4096, 16384), 1024, 1024, 200.0, 3.0),
    "isotropic": (isotropic, 1000, (1024, 4096, 16384), 1024, 1024, 200.0, 3.0),
    "asymmetric": (asymmetric, 1000, (1024, 4096, 16384), 1024, 1024, 50.0, 3.0),
    "box": (box, 250, (1024, 4096), 1024, 1024, 15.0, 3.0),
    "stack": (lambda: _stack(5), 250, (1024,), 128, 128, 3.0, 10.0),
    "clutter": (clutter, 250, (1024,), None, 128, 3.0, 10.0),
    "pile16": (pile16, 250, (1024,), None, 128, 4.0, 10.0),
    "pile64": (pile64, 50, (1024,), None, 4, 2.0, 10.0),
}
TITLES = {
    "ball": "ball on a plane",
    "isotropic": "isotropic free body",
    "asymmetric": "asymmetric free box",
    "box": "box on a plane",
    "stack": "five-box stack",
    "clutter": "4 boxes and 4 balls in a bin",
    "pile16": "16 balls in a bin",
    "pile64": "64 balls in a bin",
    "ten_boxes": "10 boxes (compile only)",
}
TEN_BOX_COMPILE = 10.0
OVERHEAD_BAR = 1.5


# --- timing ---


def last(steps):
    """(model, state) -> the final state."""
    return lambda model, state: rbd.rollout(model, state, steps, every=steps)[0]


def called(model, state, steps):
    """Run the rollout as a user calls it, on all cores or devices, and wait."""
    jax.block_until_ready(rbd.rollout(model, state, steps, every=steps)[0])


def spread(times) -> dict:
    q = np.percentile(times, (25, 50, 75))
    return {"median_s": q[1], "iqr_s": q[2] - q[0], "runs_s": [round(t, 6) for t in times]}


def in_turn(calls, repeats):
    """Seconds of each of ``calls``, measured in turn after one warm-up: one list per call."""
    times = [[] for _ in calls]
    for r in range(repeats + 1):
        for k, call in enumerate(calls):
            begin = time.perf_counter()
            call()
            if r:
                times[k].append(time.perf_counter() - begin)
    return times


def measure(name, method, batches, args, env, steps, mj_worlds):
    """Rows of one scene and method: one per batch kept (the smallest and the best), MuJoCo in turn with each."""
    scene, worlds = SCENES[name][0]()
    model, one = rbd.build(scene, dt=DT, method=method)
    rival = MuJoCo(scene, DT)
    first = worlds(one, mj_worlds, np.random.default_rng(1))
    qpos, qvel = (np.asarray(a, np.float64) for a in rbd.to_mujoco(model, first))
    initial, arrays = rival.initial(qpos, qvel), rival.allocate(mj_worlds, steps)
    cone = rival.choose_cone(initial, steps)
    chunk = rival.tune(initial, steps)
    probes = {}
    for size in batches:
        state = worlds(one, size, np.random.default_rng(1))
        program = Program(last(steps), model, state)
        run = functools.partial(called, model, state, steps)
        run()
        probes[size] = (program, state, min(in_turn([run], 2)[0]) / size)
    best = min(probes, key=lambda b: probes[b][2])
    rows, errors = [], None
    for size in sorted({min(batches), best}):
        program, state, _ = probes[size]
        calls = [
            lambda s=state: called(model, s, steps),
            lambda: rival.call(initial, steps, arrays, chunk),
        ]
        ours, theirs = in_turn(calls, args.repeats)
        if errors is None:
            judge = contact_errors if scene.static else free_errors
            errors = judge(name, scene, rival, model, one, size, worlds, args)
        rate = size * steps / np.median(ours)
        mj_rate = mj_worlds * steps / np.median(theirs)
        status = np.asarray(program(model, state).status)
        rows.append(
            {
                **env, "benchmark": "throughput", "scene": name, "method": method, "dtype": str(model.mass.dtype),
                "dt": DT, "batch": size, "steps": steps, **spread(ours), "world_steps_per_s": rate,
                "ns_per_world_step": 1e9 / rate, "sharded_over": args.devices, "best": size == best,
                "trace_s": program.trace_s, "lower_s": program.lower_s, "compile_s": program.compile_s,
                "compile_total_s": program.total_s,
                "bad_worlds": int(np.count_nonzero(status)), "status": sorted({int(s) for s in status.ravel()}),
                "mujoco": {
                    "worlds": mj_worlds, "threads": rival.threads, "chunk": chunk, "cone": cone, **spread(theirs),
                    "world_steps_per_s": mj_rate, "ns_per_world_step": 1e9 / mj_rate,
                },
                "ratio": rate / mj_rate,
                "ratio_range": [
                    size / mj_worlds * f(t / o for o, t in zip(ours, theirs, strict=True)) for f in (min, max)
                ],
                "error": errors,
            }
        )  # fmt: skip
    rival.close()
    if method == "fast" and args.devices == 1 and name in ("ball", "isotropic", "asymmetric", "box"):
        rows[0]["ratio_every_step_stored"] = stored(model, probes[min(batches)][1], steps, args.repeats, rows[0])
    return rows


def stored(model, state, steps, repeats, row):
    """The ratio when ours, like MuJoCo, stores the state of every step."""
    (times,) = in_turn([lambda: jax.block_until_ready(rbd.rollout(model, state, steps, every=1))], repeats)
    return len(state.step) * steps / np.median(times) / row["mujoco"]["world_steps_per_s"]


def overheads(name, args, steps, size):
    """Time of vmap(rollout) and of a user's scan over step, over that of rollout."""
    scene, worlds = SCENES[name][0]()
    model, one = rbd.build(scene, dt=DT, method="fast")
    state = worlds(one, size, np.random.default_rng(1))
    forms = {
        "direct": last(steps),
        "vmap": lambda m, s: jax.vmap(lambda w: rbd.rollout(m, w, steps, every=steps)[0])(s),
        "scan": lambda m, s: jax.lax.scan(lambda c, _: (rbd.step(m, c), None), s, None, length=steps)[0],
    }
    programs = [Program(f, model, state) for f in forms.values()]
    times = in_turn([lambda p=p: p(model, state) for p in programs], args.repeats if name != "stack" else 3)
    direct, vmap, scan = (float(np.median(t)) for t in times)
    return {"vmap_over_rollout": vmap / direct, "scan_over_rollout": scan / direct, "batch": size, "steps": steps}


# --- errors ---


def contact_errors(name, scene, rival, model, one, size, worlds, args):
    """After 2 s: deepest overlap and residual speed; then a slide (box) or a slip (ball) at the same step.

    "ours" and "mujoco" are the worst of 64 worlds (4 of 64 balls). Balls roll on, and hit another now and then: theirs
    is the speed along the normals, of the median world. Distances and speeds of the second part are relative to the
    closed form.
    """
    state = worlds(one, size, np.random.default_rng(1))
    seconds = 2.0 if not args.smoke else 0.2
    few = min(SLOW.get(name, RUNS_OF_ERROR), size)
    out = {}

    def compare(state, seconds):
        cut = lambda s: jax.tree.map(lambda c: c[:few], s._with(memory=None))
        steps = round(seconds / DT)
        final = rbd.rollout(model, cut(state), steps, every=steps)[0]
        p0, v0 = (np.asarray(a) for a in rbd.to_mujoco(model, cut(state)))
        ours = [np.asarray(a, np.float64) for a in rbd.to_mujoco(model, cut(final))]
        p, v = rival.run(p0, v0, round(seconds / DT), every=round(seconds / DT))
        return p0.astype(np.float64), ours, (p[:, -1], v[:, -1]), seconds

    _, ours, theirs, out["seconds"] = compare(state, seconds)
    speed = lambda _, v: float(np.abs(v.reshape(few, -1, 6)[..., :3]).max())
    both = lambda f: {"ours": f(*ours), "mujoco": f(*theirs)}
    out["penetration_m"] = both(lambda p, v: rival.penetration(p))
    if any(g.shape.kind == "sphere" for b in scene.bodies for g in b.geoms):  # a ball rolls on
        along = both(rival.normal_speeds)
        out["normal_speed_m_s"] = {who: float(np.median(speeds)) for who, speeds in along.items()}
        out["worst_normal_speed_m_s"] = {who: float(speeds.max()) for who, speeds in along.items()}
        out["speed_m_s"] = both(speed)
    else:
        out["residual_speed_m_s"] = both(speed)
    if name not in ("ball", "box"):
        return out
    v0 = np.linspace(1.0, 4.0, size)
    zero, rest = np.zeros((size, 1, 3)), 0.1  # both lie 0.1 m above the plane
    sliding = common.start(one, zero + [0, 0, rest], zero + v0[:, None, None] * [1, 0, 0], zero)
    p0, ours, theirs, seconds = compare(sliding, seconds)
    u = v0[:few]
    if name == "ball":
        exact = 5 / 7 * u
        error = lambda p, v: float(np.abs(v[:, 0] / exact - 1).max())
        out["rolling_speed_error"] = {"ours": error(*ours), "mujoco": error(*theirs)}
    else:
        exact = u**2 / (2 * MU * G)
        error = lambda p, v: float(np.abs((p[:, 0] - p0[:, 0]) / exact - 1).max())
        out["slide_distance_error"] = {"ours": error(*ours), "mujoco": error(*theirs)}
    return out


def free_errors(name, scene, rival, model, one, size, worlds, args):
    """Attitude after 1 s against symtop4 at dt / 32 in float64 [rad], worst of 64 worlds."""
    few, fine = min(RUNS_OF_ERROR, size), 32
    steps = 250 if not args.smoke else 50
    state = worlds(one, size, np.random.default_rng(1))
    state = jax.tree.map(lambda c: c[:few], state)
    p0, v0 = (np.asarray(a, np.float64) for a in rbd.to_mujoco(model, state))
    end = jax.jit(lambda m, s: rbd.rollout(m, s, steps, every=steps)[0])(model, state)
    ours = np.asarray(end.quat)[:, 0]
    theirs = rival.run(p0, v0, steps, every=steps)[0][:, -1, 3:7]
    exact = []
    with jax.enable_x64(True):
        for parts in (fine, fine // 2):
            m, s = rbd.build(scene, dt=DT / parts, method=rbd.Method("symtop4"))
            s = rbd.from_mujoco(m, p0, v0)
            end = jax.jit(lambda m, s, n=steps * parts: rbd.rollout(m, s, n, every=n)[0])(m, s)
            exact.append(np.asarray(end.quat)[:, 0])
    return {
        "seconds": steps * DT,
        "attitude_error_rad": {
            "ours": common.angle(ours, exact[0]).max(), "mujoco": common.angle(theirs, exact[0]).max(),
        },
        "reference_halving_rad": common.angle(*exact).max(),
    }  # fmt: skip


# --- MJX and Brax, where they are installed ---

#: scene: (batches, steps timed); a scene of several bodies is slow enough that few steps tell.
RIVAL_RUNS = {
    "ball": ((256, 1024, 4096), 100),
    "isotropic": ((256, 1024, 4096), 100),
    "asymmetric": ((256, 1024, 4096), 100),
    "box": ((64, 256, 1024), 50),
    "stack": ((16, 64), 5),
    "clutter": ((16, 64), 5),
    "pile16": ((8, 32), 5),
}


def mjx(scene, steps):
    """(model, states) -> (function of MJX, its arguments)."""
    import gradients  # what it needs of MJX is there

    if gradients.mjx_module() is None:
        raise ImportError(gradients.NO_MJX)
    m, d = gradients.mjx_model(scene, DT)
    run = jax.vmap(lambda q, v: gradients.mjx_end(m, d.replace(qpos=q, qvel=v), steps).qpos)
    return lambda model, states: (run, rbd.to_mujoco(model, states))


def brax(pipeline):
    """As ``mjx``, with one of Brax's pipelines."""

    def made(scene, steps):
        from suite.engines.brax import Program

        # Brax reads no other cone, and its pipelines use neither
        program = Program(rbd.to_mjcf(scene).replace('cone="elliptic"', 'cone="pyramidal"'), pipeline)
        run = jax.vmap(lambda *start: program.after(jnp.float32(DT), program.start(*start), steps).x.pos)
        return lambda model, states: (run, [states.pos, states.quat, states.vel, states.omega])

    return made


#: name: (title, maker, bar of the ratio: many bodies, few)
RIVALS = {
    "mjx": ("MJX", mjx, (50.0, 1.0)),
    "brax_spring": ("Brax, spring", brax("spring"), (1.0, 1.0)),
    "brax_positional": ("Brax, positional", brax("positional"), (1.0, 1.0)),
}


#: Batches of an engine on a scene where the others do not fit: MJX only gets slower with more worlds on two cores.
BATCHES = {
    **{("mjx", name): (256, 1024) for name in ("ball", "isotropic", "asymmetric")},
    ("mjx", "clutter"): (1, 16),
    ("mjx", "pile16"): (1, 8),
}
#: Seconds that another engine has for one batch, with its compilation; several minutes at its slowest here.
PATIENCE = 150


def rival_row(rival, name, size) -> dict:
    """Times of another engine on the same scene and start states, in this process."""
    scene, worlds = SCENES[name][0]()
    model, one = rbd.build(scene, dt=DT, method="fast")
    steps = RIVAL_RUNS[name][1]
    run, start = RIVALS[rival][1](scene, steps)(model, worlds(one, size, np.random.default_rng(1)))
    begin = time.perf_counter()
    compiled = jax.jit(run).lower(*start).compile()
    compile_s = time.perf_counter() - begin
    (times,) = in_turn([lambda: jax.block_until_ready(compiled(*start))], 3)
    took = {"ns_per_world_step": float(1e9 * np.median(times) / size / steps)}
    return {"steps": steps, **spread(times), "compile_s": compile_s, **took}


def rival_rows(rival, name, env):
    """Rows of another engine; an error is kept as the reason.

    Every batch in a process of its own that may be ended: MJX, which calls for linear algebra, can wait for itself for
    ever on two cores.
    """
    same = {**env, "benchmark": rival, "scene": name, "dt": DT, "dtype": "float32"}
    rows = []
    for size in BATCHES.get((rival, name), RIVAL_RUNS[name][0]):
        call = [sys.executable, __file__, "--scenes", name, "--of", rival, str(size)]
        try:
            done = subprocess.run(call, capture_output=True, text=True, timeout=PATIENCE, check=False)
            found = json.loads(done.stdout.splitlines()[-1])
        except subprocess.TimeoutExpired:
            found = {"reason": f"no end within {PATIENCE} s"}
        except (IndexError, json.JSONDecodeError):
            found = {"reason": (done.stderr.strip().splitlines() or ["it said nothing"])[-1][:200]}
        rows.append({**same, "batch": size, **found})
        took, compile_s = found.get("ns_per_world_step"), found.get("compile_s")
        said = found.get("reason") or f"{took:9.0f} ns  compile {compile_s:.1f} s"
        print(f"{name:11s} {rival:15s} {size:6d} {said}", flush=True)
    return rows


def kept(path) -> list[dict]:
    """The rows of the runs before."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def last_run(path):
    """(environment, rows, times of other forms) of the last run in a file."""
    known = kept(path)
    last = [r["date"] for r in known if r["benchmark"] == "throughput"][-1]
    rows, extra = [], {}
    for r in [r for r in known if r["date"] == last and r["benchmark"] not in RIVALS]:
        (extra.setdefault(r["scene"], []) if r["benchmark"] == "overhead" else rows).append(r)
    return rows[0], rows, extra


def earlier_rivals(path) -> list[dict]:
    """The last row of every batch of another engine on a scene, of the runs before, each with our time in its run."""
    ours, found = {}, {}
    for r in kept(path):
        run = r["scene"], r["commit"].rstrip("+"), r["date"][:10]
        if r["benchmark"] in RIVALS:
            found[r["scene"], r["benchmark"], r["batch"]] = r | {"ours_ns": ours.get(run)}
        elif r["benchmark"] == "throughput" and r["method"] == "fast":
            ours[run] = min(ours.get(run, np.inf), r["ns_per_world_step"])
    return list(found.values())


# --- compile time alone ---


def ten_boxes(method, env, size):
    scene, worlds = _stack(10)
    model, one = rbd.build(scene, dt=DT, method=method)
    state = worlds(one, size, np.random.default_rng(1))
    p = Program(last(100), model, state)
    return {
        **env, "benchmark": "compile", "scene": "ten_boxes", "method": method, "dtype": str(model.mass.dtype),
        "dt": DT, "batch": size, "steps": 100, "trace_s": p.trace_s, "lower_s": p.lower_s, "compile_s": p.compile_s,
        "compile_total_s": p.total_s,
    }  # fmt: skip


# --- the page ---

COLUMNS = (
    "scene", "method", "batch", "ours [ns]", "IQR %", "MuJoCo [ns]", "IQR %", "ratio (range)", "bar", "",
    "errors at most MuJoCo's", "ratio, every step stored", "worlds with a status",
)  # fmt: skip
#: error: (title, what float32 rounds of it: an error below is none; None: told, not judged).
QUANTITIES = {
    "penetration_m": ("penetration [m]", ROUNDING),
    "residual_speed_m_s": ("residual speed [m/s]", ROUNDING / DT),
    "normal_speed_m_s": ("residual speed along normals, median world [m/s]", ROUNDING / DT),
    "worst_normal_speed_m_s": ("the same of the worst world [m/s]", None),
    "speed_m_s": ("fastest body [m/s]", None),
    "rolling_speed_error": ("rolling speed, relative", ROUNDING),
    "slide_distance_error": ("slide distance, relative", ROUNDING),
    "attitude_error_rad": ("attitude [rad]", None),
}


def quality(row) -> dict:
    """Verdicts on the errors of a row that are judged: no larger than MuJoCo's, or rounding."""
    judged = {k: v for k, v in row["error"].items() if isinstance(v, dict) and QUANTITIES[k][1] is not None}
    return {k: verdict(v["ours"], max(v["mujoco"], QUANTITIES[k][1])) for k, v in judged.items()}


def report(env, rows, extra):
    timed = [r for r in rows if r["benchmark"] == "throughput"]
    lines = []
    for r in timed:
        bar = SCENES[r["scene"]][5] if r["method"] == "fast" else None
        low, high = r["ratio_range"]
        lines.append(
            [
                TITLES[r["scene"]], r["method"], f"{r['batch']:,}" + (" (best)" if r["best"] else ""),
                number(r["ns_per_world_step"]), number(100 * r["iqr_s"] / r["median_s"], 2),
                number(r["mujoco"]["ns_per_world_step"]),
                number(100 * r["mujoco"]["iqr_s"] / r["mujoco"]["median_s"], 2),
                f"**{number(r['ratio'])}** ({number(low)} to {number(high)})",
                "-" if bar is None else f"{bar:g}", verdict(r["ratio"], bar, least=True),
                "MISS" if "MISS" in quality(r).values() else "ok" if quality(r) else "-",
                number(r.get("ratio_every_step_stored")), r["bad_worlds"] or "",
            ]
        )  # fmt: skip
    compiles = []
    for r in rows:
        if r["benchmark"] in RIVALS or (not r.get("best", True) and r["batch"] != LEAST):
            continue
        bar = TEN_BOX_COMPILE if r["scene"] == "ten_boxes" else SCENES[r["scene"]][6]
        bar = bar if r["method"] == "fast" else None
        compiles.append(
            [TITLES[r["scene"]], r["method"], f"{r['batch']:,}", number(r["trace_s"]), number(r["lower_s"])]
            + [number(r["compile_s"]), f"**{number(r['compile_total_s'])}**", "-" if bar is None else f"{bar:g}"]
            + [verdict(r["compile_total_s"], bar)]
        )
    errors, seen = [], set()
    for r in timed:
        if (r["scene"], r["method"]) in seen:
            continue
        seen.add((r["scene"], r["method"]))
        for key, value in r["error"].items():
            if isinstance(value, dict):
                what = [TITLES[r["scene"]], r["method"], QUANTITIES[key][0]]
                errors.append([*what, number(value["ours"]), number(value["mujoco"]), quality(r).get(key, "")])
    ratios = [
        [TITLES[k], f"{v['batch']:,}"]
        + [f"{number(v[c])} {verdict(v[c], OVERHEAD_BAR)}" for c in ("vmap_over_rollout", "scan_over_rollout")]
        for k, rows_of_scene in extra.items()
        for v in rows_of_scene
    ]
    rivals = []
    days = sorted({r["date"][:10] for r in rows if r["benchmark"] in RIVALS})
    when = f"ours of the same run ({', '.join(days)})"
    for name, rival in {(r["scene"], r["benchmark"]): None for r in rows if r["benchmark"] in RIVALS}:
        title, _, bars = RIVALS[rival]
        theirs = [r for r in rows if r["benchmark"] == rival and r["scene"] == name]
        mine = theirs[0].get("ours_ns") or min(
            r["ns_per_world_step"] for r in timed if r["scene"] == name and r["method"] == "fast"
        )
        done = [r for r in theirs if "ns_per_world_step" in r]
        bar = bars[0 if name in ("stack", "clutter", "pile16") else 1]
        if done:
            top = min(done, key=lambda r: r["ns_per_world_step"])
            ratio = top["ns_per_world_step"] / mine
            rivals.append(
                [TITLES[name], title, f"{top['batch']:,}", number(top["ns_per_world_step"]), number(top["compile_s"])]
                + [number(mine), f"**{number(ratio)}**", f"{bar:g}", verdict(ratio, bar, least=True)]
            )
        for r in theirs:
            if "reason" in r:
                rivals.append([TITLES[name], title, r["batch"], r["reason"], "-", number(mine), "-", "-", "-"])
    rivals = (
        f"## MJX and Brax on the same cores\n\nTheir best batch, float32, same MJCF and start states; {when}.\n\n"
        + common.table(["scene", "engine", "batch", "it [ns]", "compile [s]", "ours [ns]", "ratio", "bar", ""], rivals)
        if rivals
        else ""
    )
    where = "a thread a core" if env["sharded_over"] == 1 else f"sharded over {env['sharded_over']} host devices"
    return f"""# Throughput

{common.header(env)}
Made by `benchmarks/throughput.py`; dt = 4 ms. Ours: `rbd.rollout` as a user calls it, float32,
{where}. MuJoCo: float64, `mujoco.rollout` with 2 threads, tuned chunks, the faster of its friction cones, arrays
allocated before, compiling the model not counted. Both measured in turn,
synchronised; median of {len(timed[0]["runs_s"]) if timed else 0}. ns per world-step of all cores
together.

{common.table(COLUMNS, lines)}

"ours" stores the final state only; MuJoCo's rollout always stores every step, "every step stored" is ours doing so too.
Worlds of MuJoCo: {", ".join(f"{n} {SCENES[n][4]}" for n in SCENES)} (its rate does not depend on the number).

## Compile time of `rollout` [s], cold

{common.table(["scene", "method", "batch", "trace", "lower", "compile", "all", "bar", ""], compiles)}

## Error at that speed

Worst of {RUNS_OF_ERROR} worlds (4 of 64 balls), at the same step.
Contact scenes after 2 s: deepest overlap (MuJoCo's geometry measures
both; MuJoCo with its default soft contact), residual speed. Balls roll on and hit another now and then: of scenes with
balls the speed of touching points along their normals, in the median world. Then v0 = 1 to 4 m/s: slide to stop, or
rolling speed over 5/7 v0. "ok": at most MuJoCo's, or what float32 rounds of a metre, {ROUNDING:.1g} m, or of that in a
step, {ROUNDING / DT:.1g} m/s. Rows without a verdict are told, not judged.
Free bodies: attitude after 1 s against symtop4 at dt/32, f64; not judged, as MuJoCo's is exact for the isotropic body.

{common.table(["scene", "method", "error", "ours", "MuJoCo", ""], errors)}

## Other forms of the same call, over the time of `rollout` (bar {OVERHEAD_BAR})

{common.table(["scene", "batch", "vmap(rollout)", "scan over step"], ratios)}

{rivals}
"""


def main(args) -> int:
    begin = time.perf_counter()
    out = args.out or common.RESULTS
    env = common.environment() | {"sharded_over": args.devices}
    chosen = [s for s in args.scenes.split(",") if s] or [*SCENES, "ten_boxes"]
    if args.of:
        print(json.dumps(rival_row(args.of[0], chosen[0], int(args.of[1]))))
        return 0
    unknown = [s for s in chosen if s not in TITLES]
    if unknown:
        print(f"unknown scene {unknown[0]!r}; known: {', '.join(TITLES)}", file=sys.stderr)
        return 2
    if args.smoke:
        chosen, args.repeats = ["ball", "isotropic"], 2
    print(common.header(env), flush=True)
    rows, extra = [], {}
    if args.report:
        env, rows, extra = last_run(out / "throughput.jsonl")
        chosen, args.rivals = [], False

    def keep(new):
        rows.extend(new)
        common.append_lines(out / "throughput.jsonl", new)
        for r in new:
            ratio = f"{r['ratio']:8.2f} x MuJoCo" if "ratio" in r else ""
            speed = f"{r['ns_per_world_step']:9.1f} ns" if "ratio" in r else ""
            print(
                f"{r['scene']:11s} {r['method']:9s} {r['batch']:6d} {speed} {ratio}"
                f"  compile {r['compile_total_s']:.1f} s   ({time.perf_counter() - begin:.0f} s)",
                flush=True,
            )

    for name in chosen:
        if name == "ten_boxes":
            for method in ("fast", "accurate"):
                keep([ten_boxes(method, env, LEAST)])
            continue
        _, steps, batches, accurate, mj_worlds, _, _ = SCENES[name]
        if args.smoke:
            steps, batches, mj_worlds = 50, (64,), 32
        keep(measure(name, "fast", batches, args, env, steps, mj_worlds))
        if not args.smoke and accurate:
            keep(measure(name, "accurate", (accurate,), args, env, steps, mj_worlds))
        for rival in RIVALS if args.rivals and name in RIVAL_RUNS else ():
            new = rival_rows(rival, name, env)
            rows.extend(new)
            common.append_lines(out / "throughput.jsonl", new)
        if name in ("ball", "box", "stack") and args.devices == 1:
            sizes = {min(batches[0], mj_worlds), *(batches if name != "stack" else ())}
            extra[name] = [overheads(name, args, steps, size) for size in sorted(sizes)]
            same = {**env, "benchmark": "overhead", "scene": name, "method": "fast", "dt": DT}
            new = [{**same, **row} for row in extra[name]]
            common.append_lines(out / "throughput.jsonl", new)
    if not args.rivals:
        rows += [r for r in earlier_rivals(out / "throughput.jsonl") if r["scene"] in {row["scene"] for row in rows}]
    (out / "throughput.md").write_text(report(env, rows, extra), encoding="utf-8")
    print(f"wrote {out / 'throughput.jsonl'}, {out / 'throughput.md'}  ({time.perf_counter() - begin:.0f} s)")
    return 0


if __name__ == "__main__":
    sys.exit(main(_args))
