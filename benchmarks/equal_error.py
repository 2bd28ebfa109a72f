"""Time to reach an error: the largest step each engine can afford, on a sliding box and on a stack of five.

    PYTHONPATH=. python benchmarks/equal_error.py                (about 8 minutes on 2 cores)
    PYTHONPATH=. python benchmarks/equal_error.py --smoke --out /tmp/x

Every method is run over a sweep of steps: its error (worst of 64 worlds) and its time per world and simulated second
(1,024 worlds, all cores, both engines in turn). Errors against rigid truth:

    slide   a box that slides to rest from 1 to 4 m/s: distance against v^2 / (2 mu g), relative
    stack   five boxes that fall 2 mm each: heights after 2 s against the rigid ones, over the half-size

MuJoCo runs with its default contact, and as rigid as it may be (solref 2 dt, solimp 0.9999); Euler and implicitfast are
one here. Appends to equal_error.jsonl and writes equal_error.md and equal_error.png under ``--out``.
"""

from __future__ import annotations

import functools
import pathlib
import sys
import time

import jax
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
import throughput  # noqa: E402
from common import MuJoCo, number  # noqa: E402

import rbd_jax as rbd  # noqa: E402

STEPS = (1 / 60, 1 / 120, 1 / 240, 1 / 500, 1 / 1000, 1 / 2000)
TARGETS = {"slide": (1e-1, 1e-2, 1e-3), "stack": (1e-1, 1e-2, 1e-3)}
WORLDS, JUDGED, SECONDS = 1024, 64, 2.0
BAR = 5.0
#: "accurate" takes minutes for the stack below this step [s].
SLOW_BELOW = 1 / 300


def slide():
    scene = throughput.SCENES["box"][0]()[0]
    speed = np.linspace(1.0, 4.0, JUDGED)

    def start(one, size, rng):
        zero = np.zeros((size, 1, 3))
        return common.start(one, zero + [0, 0, 0.1], zero + speed[:, None, None] * [1, 0, 0], zero)

    def error(first, last):
        exact = speed**2 / (2 * throughput.MU * common.G)
        return np.abs((last[:, 0, 0] - first[:, 0, 0]) / exact - 1).max()

    return scene, start, error


def stack():
    scene, worlds = throughput.SCENES["stack"][0]()
    exact = 0.1 * (2 * np.arange(5) + 1)
    return scene, worlds, lambda first, last: np.abs(last[..., 2] - exact).max() / 0.1


CASES = {"slide": slide, "stack": stack}


def ours(case, dt, method, size):
    scene, start, error = CASES[case]()
    model, one = rbd.build(scene, dt=dt, method=method)
    steps = round(SECONDS / dt)
    few = start(one, JUDGED, np.random.default_rng(1))
    many = jax.tree.map(lambda c: np.concatenate([c] * (size // JUDGED)), few)
    final = rbd.rollout(model, many, steps, every=steps)[0]
    wrong = error(np.asarray(few.pos, np.float64), np.asarray(final.pos, np.float64)[:JUDGED])
    return wrong, functools.partial(throughput.called, model, many, steps), size, lambda: None


def mujoco(case, dt, rigid):
    scene, start, error = CASES[case]()
    model, one = rbd.build(scene, dt=dt, method="fast")
    rival = MuJoCo(scene, dt)
    if rigid:
        rival.model.geom_solref[:] = (2 * dt, 1.0)
        rival.model.geom_solimp[:] = (0.9999, 0.9999, 0.001, 0.5, 2.0)
    q, v = (np.asarray(a, np.float64) for a in rbd.to_mujoco(model, start(one, JUDGED, np.random.default_rng(1))))
    steps = round(SECONDS / dt)
    initial, arrays = rival.initial(q, v), rival.allocate(JUDGED, steps)
    chunk = rival.tune(initial, steps)
    last = rival.call(initial, steps, arrays, chunk)[:, -1, 1 : 1 + rival.model.nq]
    poses = np.stack([q, last], axis=1).reshape(JUDGED, 2, -1, 7)[..., :3]
    wrong = error(poses[:, 0], poses[:, 1])
    return wrong, lambda: rival.call(initial, steps, arrays, chunk), JUDGED, rival.close


ENGINES = {
    "fast": lambda case, dt, size: ours(case, dt, "fast", size),
    "accurate": lambda case, dt, size: ours(case, dt, "accurate", size),
    "MuJoCo": lambda case, dt, size: mujoco(case, dt, False),
    "MuJoCo, rigid": lambda case, dt, size: mujoco(case, dt, True),
}


def measure(case, dt, size, repeats):
    """One row per engine: error, and seconds per world and simulated second, timed in turn."""
    names = [n for n in ENGINES if not (case == "stack" and n == "accurate" and dt < SLOW_BELOW)]
    found = {name: ENGINES[name](case, dt, size) for name in names}
    begin = time.perf_counter()
    times = throughput.in_turn([call for _, call, _, _ in found.values()], 1)
    if time.perf_counter() - begin < 20:
        times = throughput.in_turn([call for _, call, _, _ in found.values()], repeats)
    rows = []
    for (name, (wrong, _, worlds, close)), took in zip(found.items(), times, strict=True):
        close()
        rows.append({"case": case, "engine": name, "dt": dt, "error": float(wrong), "worlds": worlds,
                     "s_per_world_second": float(np.median(took)) / SECONDS / worlds})  # fmt: skip
    return rows


def cheapest(rows, case, engines, target):
    fit = [r for r in rows if r["case"] == case and r["engine"] in engines and r["error"] <= target]
    return min(fit, key=lambda r: r["s_per_world_second"], default=None)


def report(env, rows, took) -> str:
    text = f"""# Time to equal error

{common.header(env)}
Made by `benchmarks/equal_error.py` in {took:.0f} s; {WORLDS:,} worlds, ours float32, MuJoCo float64, both on all cores.
Times are per world and simulated second, compilation not counted.

"""
    cells = []
    for case in CASES:
        for target in TARGETS[case]:
            mine = cheapest(rows, case, ("fast", "accurate"), target)
            theirs = cheapest(rows, case, ("MuJoCo", "MuJoCo, rigid"), target)
            show = lambda r: "never" if r is None else (
                f"{number(1e6 * r['s_per_world_second'])} us ({r['engine']}, {common.step_text(r['dt'])})"
            )  # fmt: skip
            ratio = theirs["s_per_world_second"] / mine["s_per_world_second"] if mine and theirs else None
            passed = common.verdict(ratio, BAR, least=True) if theirs else ("ok" if mine else "MISS")
            cells.append([case, f"{target:g}", show(mine), show(theirs),
                          "**-**" if ratio is None else f"**{number(ratio)}**", f"{BAR:g}", passed])  # fmt: skip
    heads = ["case", "error", "ours", "MuJoCo", "ratio", "bar", ""]
    text += common.table(heads, cells) + "\n\n![errors against time](equal_error.png)\n\n## All points\n\n"
    points = [
        [r["case"], r["engine"], common.step_text(r["dt"]), number(r["error"]), number(1e6 * r["s_per_world_second"])]
        for r in rows
    ]
    return text + common.table(["case", "engine", "step", "error", "us per world-second"], points) + "\n"


def chart(rows, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(CASES), figsize=(9, 3.6), layout="constrained")
    style = {"fast": "#0072B2", "accurate": "#009E73", "MuJoCo": "#D55E00", "MuJoCo, rigid": "#E69F00"}
    for axis, case in zip(axes, CASES):
        for engine, colour in style.items():
            line = [r for r in rows if r["case"] == case and r["engine"] == engine]
            axis.loglog([1e6 * r["s_per_world_second"] for r in line], [r["error"] for r in line], "o-", color=colour,
                        ms=4, label=engine)  # fmt: skip
        axis.set(title=case, xlabel="µs per world and simulated second", ylabel="error")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(args) -> int:
    begin = time.perf_counter()
    out = args.out or common.RESULTS
    env = common.environment()
    print(common.header(env), flush=True)
    rows = []
    for case in ("slide",) if args.smoke else CASES:
        for dt in STEPS[:1] if args.smoke else STEPS:
            new = measure(case, dt, 128 if args.smoke else WORLDS, 1 if args.smoke else args.repeats)
            rows += new
            common.append_lines(out / "equal_error.jsonl", [{**env, "benchmark": "equal_error", **r} for r in new])
            for r in new:
                figures = f"error {r['error']:.2e} {1e6 * r['s_per_world_second']:9.1f} us"
                took = time.perf_counter() - begin
                print(f"{case:6s} {r['engine']:14s} {common.step_text(dt):>9s} {figures}   ({took:.0f} s)", flush=True)
            jax.clear_caches()
    chart(rows, out / "equal_error.png")
    (out / "equal_error.md").write_text(report(env, rows, time.perf_counter() - begin), encoding="utf-8")
    print(f"wrote {out / 'equal_error.jsonl'}, {out / 'equal_error.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main(common.options(__doc__, "one case, one step").parse_args()))
