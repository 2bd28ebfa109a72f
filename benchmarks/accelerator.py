"""Batches on one device, a GPU above all: time per world-step, kernels of a step, scaling, bounds, and MJX beside.

    PYTHONPATH=. python benchmarks/accelerator.py                (about 15 minutes on a GPU)
    PYTHONPATH=. python benchmarks/accelerator.py --smoke --out /tmp/x

Preset "fast", float32, ``rbd.rollout`` that stores the final state, results waited for, best of the repeats,
compile time apart. Two bounds for free bodies, both of measured rates of this device: bytes, if every step reads and
writes the state; arithmetic, if the steps are fused (XLA's count of one step's flops). The error at that speed, and
that of MuJoCo's C engine, is that of ``throughput.py``. MJX is timed where it is installed, at its best batch. Appends
to accelerator.jsonl and writes accelerator.md under ``--out`` (benchmarks/results).
"""

from __future__ import annotations

import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
import throughput  # noqa: E402
from common import MuJoCo, Program, least_seconds, number, verdict  # noqa: E402
from rooflines import counted  # noqa: E402

import rbd_jax as rbd  # noqa: E402
from rbd_jax.memory import bytes_of  # noqa: E402

SCENES = ("isotropic", "asymmetric", "ball", "box", "stack", "pile16", "clutter")
POWERS = range(10, 18)  # 2^10 to 2^17 worlds
FREE = ("isotropic", "asymmetric")
BOUND_BAR, MJX_BAR = 50.0, 10.0


def bounds(size: int) -> dict:
    """Measured rates of the device: bytes/s of a copy of ``size`` floats, flops/s of multiply-adds."""
    x = jnp.linspace(0.1, 0.9, size, dtype=jnp.float32)
    copy, terms, count = jax.jit(lambda x: x + np.float32(1)), 64, 100

    def polynomials(x):
        def body(_, y):
            for k in range(terms):
                y = y * x + np.float32(0.001 * k)
            return y

        return jax.lax.fori_loop(0, count, body, x)

    some = x[: max(size // 64, 1)]
    run = jax.jit(polynomials)
    copied = least_seconds(lambda: jax.block_until_ready(copy(x)), 5)
    worked = least_seconds(lambda: jax.block_until_ready(run(some)), 5)
    return {"bytes_per_s": 2 * x.nbytes / copied, "flops_per_s": 2 * terms * count * some.size / worked}


def measure(name, powers, args, rates):
    """A row per batch."""
    scene, worlds = throughput.SCENES[name][0]()
    model, one = rbd.build(scene, dt=throughput.DT, method="fast")
    steps = 20 if args.smoke else 500 if name in (*FREE, "ball") else 100
    for power in powers:
        size = 2**power
        state = worlds(one, size, np.random.default_rng(1))
        program = Program(throughput.last(steps), model, state)
        took = least_seconds(lambda: program(model, state), args.repeats) / steps
        cost = counted(jax.jit(lambda m, s: rbd.step(m, s)).lower(model, state).compile())
        moved = 2 * bytes_of(state._with(memory=None))
        yield {
            "scene": name, "size": size, "steps": steps, "step_s": took, "ns": 1e9 * took / size,
            "compile_s": program.total_s, "kernels": program._call.as_text().count(" fusion("),
            "bytes_share": 100 * moved / took / rates["bytes_per_s"],
            "flops_share": 100 * cost["flops"] / took / rates["flops_per_s"],
            "status": int(np.asarray(program(model, state).status).max()),
        }  # fmt: skip


def errors(name, args) -> dict:
    scene, worlds = throughput.SCENES[name][0]()
    model, one = rbd.build(scene, dt=throughput.DT, method="fast")
    rival = MuJoCo(scene, throughput.DT)
    judge = throughput.contact_errors if scene.static else throughput.free_errors
    try:
        return judge(name, rival, model, one, throughput.RUNS_OF_ERROR, worlds, args)
    finally:
        rival.close()


def report(env, rates, rows, wrong, rivals, took) -> str:
    cells, best = [], {}
    for r in rows:
        best[r["scene"]] = min(best.get(r["scene"], r), r, key=lambda r: r["ns"])
        shares = [number(r[k]) if r["scene"] in FREE else "-" for k in ("bytes_share", "flops_share")]
        cells.append(
            [throughput.TITLES[r["scene"]], f"{r['size']:,}", number(r["ns"]), number(1e6 * r["step_s"]), r["kernels"]]
            + [*shares, number(r["compile_s"]), r["status"] or ""]
        )
    heads = ["scene", "worlds", "ns a world-step", "us a step", "kernels", "% of bytes bound", "% of flops bound",
             "compile [s]", "status"]  # fmt: skip
    against = []
    for name, theirs in rivals.items():
        done = [r for r in theirs if "ns_per_world_step" in r]
        top = min(done, key=lambda r: r["ns_per_world_step"]) if done else None
        ratio = top["ns_per_world_step"] / best[name]["ns"] if top else None
        what = number(top["ns_per_world_step"]) if top else theirs[-1].get("reason", "-")
        against.append([throughput.TITLES[name], what, number(best[name]["ns"]), number(ratio), f"{MJX_BAR:g}",
                        verdict(ratio, MJX_BAR, least=True) if top else ""])  # fmt: skip
    seen = [
        [throughput.TITLES[name], throughput.QUANTITIES[key], number(value["ours"]), number(value["mujoco"])]
        for name, found in wrong.items() for key, value in found.items() if isinstance(value, dict)
    ]  # fmt: skip
    free = max((max(r["bytes_share"], r["flops_share"]) for r in rows if r["scene"] == "isotropic"), default=None)
    return f"""# One device

{common.header(env)} Device: {jax.devices()[0].device_kind}.
Made by `benchmarks/accelerator.py` in {took:.0f} s. Measured: {rates["bytes_per_s"] / 1e9:.0f} GB/s,
{rates["flops_per_s"] / 1e9:.0f} Gflop/s.

{common.table(heads, cells)}

Isotropic free bodies reach {number(free)} % of the bound that applies (bar {BOUND_BAR:g}:
{verdict(free, BOUND_BAR, least=True)}).

## Error at that speed

{common.table(["scene", "error", "ours", "MuJoCo C"], seen)}

## MJX

{common.table(["scene", "MJX [ns]", "ours [ns]", "ratio", "bar", ""], against)}
"""


def main(args) -> int:
    begin = time.perf_counter()
    out = args.out or common.RESULTS
    env = common.environment() | {"device_kind": jax.devices()[0].device_kind}
    print(common.header(env), env["device_kind"], flush=True)
    rates = bounds(2**16 if args.smoke else 2**28)
    rows, wrong, rivals = [], {}, {}
    for name in ("isotropic", "ball") if args.smoke else SCENES:
        for row in measure(name, (6,) if args.smoke else POWERS, args, rates):
            rows.append(row)
            common.append_lines(out / "accelerator.jsonl", [{**env, "benchmark": "accelerator", **rates, **row}])
            print(
                f"{name:11s} {row['size']:8,d} {row['ns']:10.3f} ns   ({time.perf_counter() - begin:.0f} s)", flush=True
            )
        wrong[name] = errors(name, args)
        if not args.smoke:
            rivals[name] = throughput.mjx_rows(name, args, env)
            common.append_lines(out / "accelerator.jsonl", rivals[name])
        jax.clear_caches()
    page = report(env, rates, rows, wrong, rivals, time.perf_counter() - begin)
    (out / "accelerator.md").write_text(page, encoding="utf-8")
    print(f"wrote {out / 'accelerator.jsonl'}, {out / 'accelerator.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main(common.options(__doc__, "two scenes, few worlds").parse_args()))
