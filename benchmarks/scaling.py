"""How the time of a step grows: with the batch, with the bodies of one world, with its contacts; and for one world.

    PYTHONPATH=. python benchmarks/scaling.py                    (about 10 minutes on 2 cores)
    PYTHONPATH=. python benchmarks/scaling.py --rows latency
    PYTHONPATH=. python benchmarks/scaling.py --smoke --out /tmp/x

Preset "fast", float32, ``rbd.rollout`` as a user calls it (all cores), results waited for, best of the repeats; compile
time is not in it. Slopes are least-squares fits of log time against log size. Rows:

    batch     one ball, one box: 1 to 2^20 worlds
    bodies    blocks of touching spheres, one world, 1 to 1,000 bodies
    contacts  64 spheres, of which ever more lie side by side on the ground, 256 worlds
    latency   one world: ``step`` and ``rollout``, beside MuJoCo's one thread

Appends to scaling.jsonl and writes scaling.md and scaling.png under ``--out`` (benchmarks/results), from the last run
of every curve and of every scene of ``latency``.
"""

from __future__ import annotations

import functools
import json
import pathlib
import sys
import time

import jax
import mujoco
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
import throughput  # noqa: E402
from common import MuJoCo, least_seconds, number  # noqa: E402

import rbd_jax as rbd  # noqa: E402

ROWS = ("batch", "bodies", "contacts", "latency")
#: Slopes are fitted from this many worlds (bodies, contacts) on: below it the fixed cost of a step shows.
FIT_FROM = {"batch": 2**12, "bodies": 27, "contacts": 10}
#: Steps of every block of spheres.
BLOCK_STEPS = 240
#: Issue bars: 1,000 bodies over 100, and MuJoCo's one thread over ours for one world.
BODIES_BAR, LATENCY_BARS = 15.0, {"ball": 30.0, "stack": 0.5}


def seconds_a_step(model, state, steps, repeats) -> float:
    return least_seconds(functools.partial(throughput.called, model, state, steps), repeats) / steps


def slope(sizes, times, least) -> float | None:
    use = [(n, t) for n, t in zip(sizes, times) if n >= least]
    if len(use) < 3:
        return None
    return float(np.polyfit(*np.log(np.array(use)).T, 1)[0])


def batch_rows(args):
    top = 6 if args.smoke else 20
    for name in ("ball",) if args.smoke else ("ball", "box"):
        scene, worlds = throughput.SCENES[name][0]()
        model, one = rbd.build(scene, dt=throughput.DT, method="fast")
        for power in range(0, top + 1, 2):
            size = 2**power
            if rbd.memory_estimate(model, size, 10, 10).peak > 0.5 * (
                rbd.memory_estimate(model, 1, 1).available or 4e9
            ):
                print(f"batch {name} {size}: more than half of the memory, left out", flush=True)
                continue
            state = one if size == 1 else worlds(one, size, np.random.default_rng(1))
            per_world = 2e-8 if name == "ball" else 2e-7
            steps = int(np.clip(0.3 / (per_world * size), 10, 2000))
            yield {"row": "batch", "scene": name, "size": size, "steps": steps,
                   "step_s": seconds_a_step(model, state, steps, args.repeats)}  # fmt: skip


def block(n: tuple[int, int, int], gap=0.0005) -> rbd.Scene:
    place = lambda i, j, k: ((0.2 + gap) * i, (0.2 + gap) * j, 0.1 + (0.2 + gap) * k)
    bodies = [
        rbd.Body(f"b{i}_{j}_{k}", rbd.Sphere(0.1), pos=place(i, j, k), friction=0.5)
        for i in range(n[0]) for j in range(n[1]) for k in range(n[2])
    ]  # fmt: skip
    return rbd.Scene(bodies, [rbd.Geom(rbd.Plane(), friction=0.5)], dt=throughput.DT)


def bodies_rows(args):
    """All blocks run for the same time, the one second in which they fall apart."""
    sizes = [(1, 1, 1), (2, 2, 2)] if args.smoke else [(1, 1, 1), (2, 2, 2), (3, 3, 3), (4, 4, 4), (5, 5, 4), (6, 6, 6),
                                                       (7, 7, 7), (10, 10, 10)]  # fmt: skip
    for n in sizes:
        model, one = rbd.build(block(n), method="fast")
        state = common.start(one, vel=0.1 * np.random.default_rng(0).normal(size=(1, one.n, 3)))
        steps = 20 if args.smoke else BLOCK_STEPS
        took = seconds_a_step(model, state, steps, args.repeats)
        final = rbd.rollout(model, state, steps, every=steps)[0]
        live = int(np.asarray(rbd.contacts(model, final).live).sum())
        yield {"row": "bodies", "scene": "block of spheres", "size": one.n, "steps": steps, "step_s": took,
               "contacts": live, "status": int(np.asarray(final.status).max())}  # fmt: skip


def sheet(rows: int) -> rbd.Scene:
    """64 spheres, of which ``rows`` rows of eight lie side by side on the ground; the others fall far above it."""
    lies = lambda k: k // 8 < rows
    place = lambda k: (0.1999 * (k % 8), 0.1999 * (k // 8), 0.0999) if lies(k) else (k % 8, k // 8, 50.0)
    bodies = [rbd.Body(f"b{k}", rbd.Sphere(0.1), friction=0.5, pos=place(k)) for k in range(64)]
    return rbd.Scene(bodies, [rbd.Geom(rbd.Plane(), friction=0.5)], dt=throughput.DT)


def contacts_rows(args):
    """The contacts are those at the end of the run, in which nothing comes together or apart."""
    for rows in (0, 1) if args.smoke else (0, 1, 2, 4, 8):
        model, one = rbd.build(sheet(rows), method="fast")
        state, steps = rbd.batch(one, 1 if args.smoke else 256), 10 if args.smoke else 50
        took = seconds_a_step(model, state, steps, args.repeats)
        final = rbd.rollout(model, state, steps, every=steps)[0]
        found = rbd.contacts(model, jax.tree.map(lambda c: c[:1], final))
        yield {"row": "contacts", "scene": "64 spheres, some side by side", "size": int(np.asarray(found.live).sum()),
               "steps": steps, "worlds": state.batch_shape[0], "step_s": took / state.batch_shape[0]}  # fmt: skip


def latency_rows(args):
    for name in ("ball",) if args.smoke else ("ball", "isotropic", "asymmetric", "box", "stack", "clutter", "pile16"):
        scene, worlds = throughput.SCENES[name][0]()
        for method in ("fast",) if args.smoke else ("fast", "accurate"):
            if method == "accurate" and name in ("clutter", "pile16", "isotropic", "asymmetric"):
                continue
            model, one = rbd.build(scene, dt=throughput.DT, method=method)
            state = jax.tree.map(lambda c: c[0], worlds(one, 1, np.random.default_rng(1)))
            steps = 100 if args.smoke else {"ball": 100_000, "isotropic": 100_000}.get(name, 2000)
            inside = seconds_a_step(model, state, steps, args.repeats)
            few = 20 if args.smoke else 200

            def by_hand(model=model, state=state, few=few):
                for _ in range(few):
                    state = rbd.step(model, state)
                jax.block_until_ready(state)

            single = least_seconds(by_hand, args.repeats) / few
            rival = MuJoCo(scene, throughput.DT, threads=1)
            q, v = (np.asarray(a, np.float64)[None] for a in rbd.to_mujoco(model, state))
            count = min(steps, 20_000)
            initial, arrays = rival.initial(q, v), rival.allocate(1, count)
            theirs = least_seconds(lambda: rival.call(initial, count, arrays), args.repeats) / count

            def mj_steps(rival=rival, initial=initial, few=few):
                data = rival.data[0]
                mujoco.mj_setState(rival.model, data, initial[0], common.PHYSICS)
                for _ in range(few):
                    mujoco.mj_step(rival.model, data)

            mj_single = least_seconds(mj_steps, args.repeats) / few
            rival.close()
            yield {"row": "latency", "scene": name, "method": method, "steps": steps, "step_s": inside,
                   "single_step_s": single, "mujoco_step_s": theirs, "mujoco_single_step_s": mj_single,
                   "ratio": theirs / inside}  # fmt: skip


KINDS = {"batch": batch_rows, "bodies": bodies_rows, "contacts": contacts_rows, "latency": latency_rows}


# --- the page ---


def curves(rows):
    """(row, scene) -> sizes, seconds a step."""
    out = {}
    for r in rows:
        if r["row"] != "latency":
            sizes, times = out.setdefault((r["row"], r["scene"]), ([], []))
            sizes.append(r["size"])
            times.append(r["step_s"])
    return out


def chart(rows, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    kinds = [k for k in ("batch", "bodies", "contacts") if any(r["row"] == k for r in rows)]
    if not kinds:
        return
    figure, axes = plt.subplots(1, len(kinds), figsize=(4.2 * len(kinds), 3.4), layout="constrained", squeeze=False)
    for axis, kind in zip(axes[0], kinds):
        for (row, scene), (sizes, times) in curves(rows).items():
            if row != kind:
                continue
            fit = slope(sizes, times, FIT_FROM[kind])
            label = scene + ("" if fit is None else f", slope {fit:.2f}")
            shown = [(n, 1e6 * t) for n, t in zip(sizes, times) if n]  # no contact has no place on such an axis
            axis.loglog(*zip(*shown), "o-", ms=4, label=label)
        axis.set(xlabel={"batch": "worlds", "bodies": "bodies", "contacts": "contacts"}[kind], ylabel="a step [µs]")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def latest(rows) -> list[dict]:
    """The rows of the last run of every curve, and the last of every scene and method of ``latency``."""
    which = lambda r: (r["row"], r["scene"], r.get("method"))
    last = {which(r): r["date"] for r in rows}
    known = {kind: dict.fromkeys(r["scene"] for r in rows if r["row"] == kind and r["date"] == newest(rows, kind))
             for kind in ROWS}  # fmt: skip
    return [r for r in rows if r["date"] == last[which(r)] and (r["row"] == "latency" or r["scene"] in known[r["row"]])]


def newest(rows, kind: str) -> str:
    """When a kind of row was measured last."""
    return max((r["date"] for r in rows if r["row"] == kind), default="")


def report(rows) -> str:
    text = ['# Scaling\n\nMade by `benchmarks/scaling.py`; preset "fast", float32.\n']
    for (kind, scene), (sizes, times) in curves(rows).items():
        env = next(r for r in rows if (r["row"], r["scene"]) == (kind, scene))
        fit = slope(sizes, times, FIT_FROM[kind])
        text.append(f"## {kind}: {scene}\n\n{common.header(env)}\n\nslope {number(fit)} (from {FIT_FROM[kind]:,} on)\n")
        per = {"batch": "ns a world", "bodies": "µs a body", "contacts": "µs a contact"}[kind]
        scale = {"batch": 1e9, "bodies": 1e6, "contacts": 1e6}[kind]
        text.append(
            common.table(
                ["size", "a step [µs]", per],
                [[f"{n:,}", number(1e6 * t), number(scale * t / max(n, 1))] for n, t in zip(sizes, times)],
            )
            + "\n"
        )
        if kind == "bodies" and {100, 1000} <= set(sizes):
            ratio = times[sizes.index(1000)] / times[sizes.index(100)]
            said = f"{number(ratio)} (bar {BODIES_BAR:g}: {common.verdict(ratio, BODIES_BAR)})"
            text.append(f"1,000 bodies over 100: {said}. Every block runs {BLOCK_STEPS} steps, one second in which it\n"
                        "falls apart, in one call, which takes 0.1 ms of itself.\n")  # fmt: skip
    late = [r for r in rows if r["row"] == "latency"]
    if late:
        text.append("## One world [µs a step]\n\n`rollout`: inside one call. `step`: called from Python, each waited "
                    "for by the next. MuJoCo: one thread, `rollout` and `mj_step`.\n")  # fmt: skip
        text.append("\n\n".join(dict.fromkeys(common.header(r) for r in late)) + "\n")
        cells = []
        for r in late:
            bar = LATENCY_BARS.get(r["scene"]) if r["method"] == "fast" else None
            cells.append(
                [throughput.TITLES[r["scene"]], r["method"]]
                + [number(1e6 * r[k]) for k in ("step_s", "mujoco_step_s", "single_step_s", "mujoco_single_step_s")]
                + [f"**{number(r['ratio'])}**", number(bar), common.verdict(r["ratio"], bar, least=True)]
            )
        heads = ["scene", "method", "rollout", "MuJoCo rollout", "step", "mj_step", "ratio of rollouts", "bar", ""]
        text.append(common.table(heads, cells) + "\n")
    if any(r["row"] != "latency" for r in rows):
        text.append("![scaling](scaling.png)\n")
    return "\n".join(text)


def main(args) -> int:
    begin = time.perf_counter()
    out = args.out or common.RESULTS
    env = common.environment()
    chosen = [r for r in args.rows.split(",") if r]
    unknown = [r for r in chosen if r not in ROWS]
    if unknown:
        print(f"unknown row {unknown[0]!r}; known: {', '.join(ROWS)}", file=sys.stderr)
        return 2
    if args.smoke:
        args.repeats = 1
    print(common.header(env), flush=True)
    for kind in () if args.report else chosen or ROWS:
        for row in KINDS[kind](args):
            common.append_lines(out / "scaling.jsonl", [{**env, "benchmark": "scaling", **row}])
            size = f"{row['size']:9,d}" if "size" in row else row["method"]
            ratio = f"  {row['ratio']:.3g} x MuJoCo" if "ratio" in row else ""
            print(f"{kind:9s} {row['scene']:22s} {size:>9s} {1e6 * row['step_s']:12.3f} us a step{ratio}"
                  f"   ({time.perf_counter() - begin:.0f} s)", flush=True)  # fmt: skip
    lines = (out / "scaling.jsonl").read_text(encoding="utf-8").splitlines()
    rows = latest([json.loads(line) for line in lines])
    chart(rows, out / "scaling.png")
    (out / "scaling.md").write_text(report(rows), encoding="utf-8")
    print(f"wrote {out / 'scaling.jsonl'}, {out / 'scaling.md'}")
    return 0


if __name__ == "__main__":
    parser = common.options(__doc__, "small sizes")
    parser.add_argument("--rows", default="", metavar="A,B", help=f"only these: {', '.join(ROWS)}")
    parser.add_argument("--report", action="store_true", help="measure nothing, make the page of the rows there are")
    sys.exit(main(parser.parse_args()))
