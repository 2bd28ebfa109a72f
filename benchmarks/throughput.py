"""World-steps per second beside ``mujoco.rollout``, compile time, and the error at that speed.

    PYTHONPATH=. python benchmarks/throughput.py                 (about 6 minutes on 2 cores)
    PYTHONPATH=. python benchmarks/throughput.py --smoke --out /tmp/x
    PYTHONPATH=. python benchmarks/throughput.py --devices 2     (batch sharded over two host devices)

Appends to throughput.jsonl and writes throughput.md under ``--out`` (benchmarks/results).

Both sides run the same MJCF, the same start states and the same number of steps of 4 ms, one after the
other in turn. Ours is float32 on XLA's own threads, MuJoCo is float64 on two. MuJoCo stores the state of every
step (``rollout`` cannot do otherwise), ours the last one; "every step stored" is ours with all of them.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import sys
import time

_parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
_parser.add_argument("--smoke", action="store_true", help="a few seconds: one scene, few worlds and steps")
_parser.add_argument("--devices", type=int, default=1, metavar="N", help="host devices to shard the batch over")
_parser.add_argument("--scenes", default="", metavar="A,B", help="only these scenes")
_parser.add_argument("--repeats", type=int, default=5, metavar="N", help="timed runs of each side (default 5)")
_parser.add_argument("--out", type=pathlib.Path, default=None, metavar="DIR", help="default benchmarks/results")
if __name__ == "__main__":
    _args = _parser.parse_args()
    if _args.devices > 1:
        os.environ["XLA_FLAGS"] = (
            os.environ.get("XLA_FLAGS", "") + f" --xla_force_host_platform_device_count={_args.devices}"
        )

import jax  # noqa: E402
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


#: name: (maker, steps timed, batches of "fast", batch of "accurate", MuJoCo's worlds, bars of ratio and compile [s])
SCENES = {
    "ball": (ball, 1000, (1024, 4096, 16384), 1024, 1024, 50.0, 5.0),
    "isotropic": (isotropic, 1000, (1024, 4096, 16384), 1024, 1024, 50.0, 5.0),
    "asymmetric": (asymmetric, 1000, (1024, 4096, 16384), 1024, 1024, 15.0, 5.0),
    "box": (box, 250, (1024, 4096, 16384), 1024, 1024, 5.0, 5.0),
    "stack": (lambda: _stack(5), 250, (1024,), 128, 128, None, None),
}
TITLES = {
    "ball": "ball on a plane",
    "isotropic": "isotropic free body",
    "asymmetric": "asymmetric free box",
    "box": "box on a plane",
    "stack": "five-box stack",
    "ten_boxes": "10 boxes (compile only)",
}
TEN_BOX_COMPILE = 20.0
OVERHEAD_BAR = 1.5


# --- timing ---


def last(steps, devices=1):
    """(model, state) -> the final state, over one device or with the batch sharded."""
    run = lambda model, state: rbd.rollout(model, state, steps, every=steps)[0]
    if devices == 1:
        return run
    P = jax.sharding.PartitionSpec
    mesh = jax.make_mesh((devices,), ("worlds",))
    return jax.shard_map(run, mesh=mesh, in_specs=(P(), P("worlds")), out_specs=P("worlds"), check_vma=False)


def placed(state, devices):
    if devices == 1:
        return state
    mesh = jax.make_mesh((devices,), ("worlds",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("worlds"))
    return jax.device_put(state, sharding)


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
    chunk = rival.tune(initial, steps)
    probes = {}
    for size in batches:
        state = placed(worlds(one, size, np.random.default_rng(1)), args.devices)
        program = Program(last(steps, args.devices), model, state)
        program(model, state)
        probes[size] = (program, state, min(program.seconds(model, state) for _ in range(2)) / size)
    best = min(probes, key=lambda b: probes[b][2])
    rows, errors = [], None
    for size in sorted({min(batches), best}):
        program, state, _ = probes[size]
        calls = [
            lambda p=program, s=state: p(model, s),
            lambda: rival.call(initial, steps, arrays, chunk),
        ]
        ours, theirs = in_turn(calls, args.repeats)
        if errors is None:
            judge = contact_errors if scene.static else free_errors
            errors = judge(name, rival, program, model, one, size, worlds, args)
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
                    "worlds": mj_worlds, "threads": rival.threads, "chunk": chunk, **spread(theirs),
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
    if method == "fast" and args.devices == 1 and name != "stack":
        rows[0]["ratio_every_step_stored"] = stored(model, probes[min(batches)][1], steps, args.repeats, rows[0])
    return rows


def stored(model, state, steps, repeats, row):
    """The ratio when ours, like MuJoCo, stores the state of every step."""
    program = Program(lambda m, s: rbd.rollout(m, s, steps, every=1), model, state)
    (times,) = in_turn([lambda: program(model, state)], repeats)
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


def _chained(program, model, state, seconds, steps):
    for _ in range(max(1, round(seconds / (steps * DT)))):
        state = program(model, state)
    return state


def contact_errors(name, rival, program, model, one, size, worlds, args):
    """After 2 s: deepest overlap and residual speed; then a slide (box) or a slip (ball) at the same step.

    "ours" and "mujoco" are the worst of 64 worlds. Distances and speeds are relative to the closed form.
    """
    state = placed(worlds(one, size, np.random.default_rng(1)), args.devices)
    steps = SCENES[name][1] if not args.smoke else 50
    seconds = 2.0 if not args.smoke else 0.2
    few = min(RUNS_OF_ERROR, size)
    out = {}

    def compare(state, seconds):
        final = _chained(program, model, state, seconds, steps)
        seconds = max(1, round(seconds / (steps * DT))) * steps * DT
        cut = lambda s: jax.tree.map(lambda c: c[:few], s._with(memory=None))
        p0, v0 = (np.asarray(a) for a in rbd.to_mujoco(model, cut(state)))
        ours = [np.asarray(a, np.float64) for a in rbd.to_mujoco(model, cut(final))]
        p, v = rival.run(p0, v0, round(seconds / DT), every=round(seconds / DT))
        return p0.astype(np.float64), ours, (p[:, -1], v[:, -1]), seconds

    _, ours, theirs, out["seconds"] = compare(state, seconds)
    part = (2,) if name == "ball" else (0, 1, 2)  # a ball rolls on; its normal speed is what must vanish
    speed = lambda v: float(np.abs(v.reshape(few, -1, 6)[..., part]).max())
    out["penetration_m"] = {"ours": rival.penetration(ours[0]), "mujoco": rival.penetration(theirs[0])}
    out["residual_speed_m_s"] = {"ours": speed(ours[1]), "mujoco": speed(theirs[1])}
    if name == "stack":
        return out
    v0 = np.linspace(1.0, 4.0, size)
    zero, rest = np.zeros((size, 1, 3)), 0.1  # both lie 0.1 m above the plane
    sliding = common.start(one, zero + [0, 0, rest], zero + v0[:, None, None] * [1, 0, 0], zero)
    p0, ours, theirs, seconds = compare(placed(sliding, args.devices), seconds)
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


def free_errors(name, rival, program, model, one, size, worlds, args):
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
            scene, _ = SCENES[name][0]()
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
    "ratio, every step stored", "worlds with a status",
)  # fmt: skip
QUANTITIES = {
    "penetration_m": "penetration [m]",
    "residual_speed_m_s": "residual speed [m/s]",
    "rolling_speed_error": "rolling speed, relative",
    "slide_distance_error": "slide distance, relative",
    "attitude_error_rad": "attitude [rad]",
}


def report(env, rows, extra, seconds):
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
                number(r.get("ratio_every_step_stored")), r["bad_worlds"] or "",
            ]
        )  # fmt: skip
    compiles = []
    for r in rows:
        if not r.get("best", True) and r["batch"] != LEAST:
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
                what = [TITLES[r["scene"]], r["method"], QUANTITIES[key]]
                errors.append([*what, number(value["ours"]), number(value["mujoco"])])
    ratios = [
        [TITLES[k], f"{v['batch']:,}"]
        + [f"{number(v[c])} {verdict(v[c], OVERHEAD_BAR)}" for c in ("vmap_over_rollout", "scan_over_rollout")]
        for k, rows_of_scene in extra.items()
        for v in rows_of_scene
    ]
    return f"""# Throughput

{common.header(env)}
Made by `benchmarks/throughput.py` in {seconds:.0f} s; dt = 4 ms. Ours: float32, XLA's own threads, batch
{"on one device" if env["sharded_over"] == 1 else f"sharded over {env['sharded_over']} host devices"}. MuJoCo: float64,
`mujoco.rollout` with 2 threads, tuned chunks, arrays allocated before, compiling the model not counted. Both
measured in turn, synchronised; median of {len(timed[0]["runs_s"]) if timed else 0}. ns per world-step of all cores
together.

{common.table(COLUMNS, lines)}

"ours" stores the final state only; MuJoCo's rollout always stores every step, "every step stored" is ours doing so too.
Worlds of MuJoCo: {", ".join(f"{n} {SCENES[n][4]}" for n in SCENES)} (its rate does not depend on the number).

## Compile time of `rollout` [s], cold

{common.table(["scene", "method", "batch", "trace", "lower", "compile", "all", "bar", ""], compiles)}

## Error at that speed

Worst of {RUNS_OF_ERROR} worlds, at the same step. Contact scenes after 2 s: deepest overlap (MuJoCo's geometry measures
both; MuJoCo with its default soft contact), residual speed (ball: along the normal only, since it rolls on). Then v0 =
1 to 4 m/s: slide to stop, or rolling speed over 5/7 v0. Free bodies: attitude after 1 s against symtop4 at dt/32, f64.

{common.table(["scene", "method", "error", "ours", "MuJoCo"], errors)}

## Other forms of the same call, over the time of `rollout` (bar {OVERHEAD_BAR})

{common.table(["scene", "batch", "vmap(rollout)", "scan over step"], ratios)}
"""


def main(args) -> int:
    begin = time.perf_counter()
    out = args.out or common.RESULTS
    env = common.environment() | {"sharded_over": args.devices}
    chosen = [s for s in args.scenes.split(",") if s] or [*SCENES, "ten_boxes"]
    unknown = [s for s in chosen if s not in TITLES]
    if unknown:
        print(f"unknown scene {unknown[0]!r}; known: {', '.join(TITLES)}", file=sys.stderr)
        return 2
    if args.smoke:
        chosen, args.repeats = ["ball", "isotropic"], 2
    print(common.header(env), flush=True)
    rows, extra = [], {}

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
        if not args.smoke:
            keep(measure(name, "accurate", (accurate,), args, env, steps, mj_worlds))
        if name in ("ball", "box", "stack") and args.devices == 1:
            sizes = {min(batches[0], mj_worlds), *(batches if name != "stack" else ())}
            extra[name] = [overheads(name, args, steps, size) for size in sorted(sizes)]
            same = {**env, "benchmark": "overhead", "scene": name, "method": "fast", "dt": DT}
            new = [{**same, **row} for row in extra[name]]
            common.append_lines(out / "throughput.jsonl", new)
    (out / "throughput.md").write_text(report(env, rows, extra, time.perf_counter() - begin), encoding="utf-8")
    print(f"wrote {out / 'throughput.jsonl'}, {out / 'throughput.md'}  ({time.perf_counter() - begin:.0f} s)")
    return 0


if __name__ == "__main__":
    sys.exit(main(_args))
