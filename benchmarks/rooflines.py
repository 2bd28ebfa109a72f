"""Where the time of a step goes: kernels, flops and bytes of every scene, against what the machine can do.

    PYTHONPATH=. python benchmarks/rooflines.py                  (about 5 minutes on 2 cores)
    PYTHONPATH=. python benchmarks/rooflines.py --smoke --out /tmp/x

One tile of worlds on one core, preset "fast", float32. Every scene is run twice: as ``rollout`` runs it, as one or a
few functions, and kernel by kernel, which is how XLA runs any other program and where its profiler sees what
takes the time. Flops of kernels and bytes are XLA's own count for one step (every kernel's inputs and outputs, loops by
their trip counts); "least bytes" is the state read and written once. The machine's bounds are measured: multiply-adds
on an array in the first-level cache, a copy of an array far larger than the caches. Writes rooflines.json and
rooflines.md under ``--out`` (benchmarks/results).
"""

from __future__ import annotations

import argparse
import collections
import glob
import pathlib
import re
import sys
import tempfile
import time

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
import throughput  # noqa: E402
from common import least_seconds, number  # noqa: E402

import rbd_jax as rbd  # noqa: E402
from rbd_jax import kernel  # noqa: E402
from rbd_jax.memory import bytes_of  # noqa: E402
from rbd_jax.rollout import Length, _rollout_batch  # noqa: E402
from rbd_jax.step import advance, enter, with_memory  # noqa: E402
from rbd_jax.tiles import TILE  # noqa: E402

SCENES = ("ball", "isotropic", "asymmetric", "box", "stack", "clutter", "pile16", "pile64")
KERNELS = 5  # of a scene that are listed


#: Polynomials that are worked out side by side, so that a core waits for none of them.
CHAINS = 8


def machine() -> dict:
    """Measured bounds of one core: flops/s and bytes/s."""
    x = jnp.linspace(0.1, 0.9, 2048, dtype=jnp.float32)
    count, terms = 2000, 32

    def polynomials(x):
        def body(x, _):
            chains = [x + np.float32(0.01 * c) for c in range(CHAINS)]
            for k in range(terms):
                chains = [y * x + np.float32(0.5 + 0.001 * k) for y in chains]
            return sum(chains) * np.float32(1e-3) + np.float32(0.3), None

        return jax.lax.scan(body, x, None, length=count)[0]

    run = jax.jit(polynomials)
    flops = 2 * CHAINS * terms * count * x.size / least_seconds(lambda: jax.block_until_ready(run(x)), 5)
    source = np.ones(64_000_000, np.float32)
    target = np.empty_like(source)
    copied = least_seconds(lambda: np.copyto(target, source), 3)
    return {"flops_per_s": flops, "bytes_per_s": 2 * source.nbytes / copied}


#: Operations that are no arithmetic.
FREE_OF_CHARGE = frozenset("and or not xor select_n convert_element_type is_finite gt ge lt le eq ne iota".split())


def arithmetic(model, state) -> int | None:
    """Arithmetic operations of a step of one world, each once; None where loops decide how many there are."""
    p, world = enter(model, with_memory(model, state), state.batch_shape)
    ops = kernel.operations(lambda p, world: advance(model, p, world, None), *state.batch_shape, p, world)
    if any(op.bodies for op in ops):
        return None
    real = (op for op in ops if op.name not in FREE_OF_CHARGE and np.dtype(op.outs[0].dtype).kind == "f")
    return sum(op.outs[0].size for op in real if op.name not in ("slice", "broadcast_in_dim", "gather", "concatenate"))


def counted(compiled) -> dict:
    analysis = compiled.cost_analysis()
    analysis = analysis[0] if isinstance(analysis, list) else analysis
    return {"flops": analysis.get("flops", 0.0), "bytes": analysis.get("bytes accessed", 0.0)}


def origin(text: str) -> dict[str, str]:
    """Kernel -> the operation that it was made for, of a compiled program."""
    lines = re.finditer(r"%?([\w.\-]+) = \S+ [\w\-]+\(.*?op_name=\"([^\"]*)\"", text)
    return {m.group(1): m.group(2).split("/")[-1] for m in lines}


def profile(compiled, args, steps) -> tuple[list, float]:
    """(kernel, operation, microseconds a step, times a step) of the longest kernels, and kernels a step."""
    known = origin(compiled.as_text())
    spent, count = collections.Counter(), collections.Counter()
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(compiled(*args))
        path = glob.glob(folder + "/**/*.xplane.pb", recursive=True)[0]
        for plane in jax.profiler.ProfileData.from_file(path).planes:
            for line in plane.lines:
                for event in line.events:
                    if event.name in known and not event.name.startswith(("while", "call", "conditional")):
                        spent[event.name] += event.duration_ns
                        count[event.name] += 1
    longest = [(k, known[k], v / 1e3 / steps, count[k] / steps) for k, v in spent.most_common(KERNELS)]
    return longest, sum(count.values()) / steps


def measure(name, args) -> dict:
    scene, worlds = throughput.SCENES[name][0]()
    model, one = rbd.build(scene, dt=throughput.DT, method="fast")
    size = 64 if args.smoke else TILE
    steps = 10 if args.smoke else 50 if name in ("pile64",) else 200
    state = worlds(one, size, np.random.default_rng(1))
    whole = jax.jit(lambda m, s: rbd.rollout(m, s, steps, every=steps)[0])
    single = whole.lower(model, state).compile()
    kernels = jax.jit(lambda m, s: _rollout_batch(m, with_memory(m, s), None, Length.of(steps, steps))[0])
    split = kernels.lower(model, state).compile()
    step = jax.jit(lambda m, s: _rollout_batch(m, s, None, Length.of(1, 1))[0])
    warm = with_memory(model, state)
    cost = counted(step.lower(model, warm).compile())
    longest, launches = profile(split, (model, state), steps)
    per = 1e9 / size / steps
    return {
        "scene": name, "worlds": size, "steps": steps, "one_function": "xla_cpu_small_call" in single.as_text(),
        "ns": per * least_seconds(lambda: jax.block_until_ready(single(model, state)), 3),
        "ns_kernels": per * least_seconds(lambda: jax.block_until_ready(split(model, state)), 3),
        "flops": cost["flops"] / size, "arithmetic": arithmetic(model, state), "bytes": cost["bytes"] / size,
        "least_bytes": 2 * bytes_of(state._with(memory=None)) / size,
        "kernels_per_step": launches, "longest": longest,
    }  # fmt: skip


def report(env, bounds, rows, took) -> str:
    table = []
    for r in rows:
        own = r["arithmetic"]
        rate = (own or r["flops"]) / r["ns"]
        at_most = "" if own else "at most "
        table.append(
            [throughput.TITLES[r["scene"]], number(r["ns"]), number(r["ns_kernels"]), number(r["kernels_per_step"])]
            + [number(own), number(r["flops"]), number(r["bytes"]), number(r["least_bytes"]), at_most + number(rate)]
            + [at_most + number(100 * rate * 1e9 / bounds["flops_per_s"], 2)]
            + [number(100 * r["least_bytes"] / r["ns"] * 1e9 / bounds["bytes_per_s"], 2)]
        )
    heads = ["scene", "one function [ns]", "kernel by kernel [ns]", "kernels a step", "flops", "flops of kernels",
             "bytes of kernels", "least bytes", "Gflop/s", "% of flops bound", "% of bytes bound"]  # fmt: skip
    text = f"""# Where the time goes

{common.header(env)}
Made by `benchmarks/rooflines.py` in {took:.0f} s: one tile of {rows[0]["worlds"]} worlds on one core, preset "fast",
float32, figures per world and step. Bounds of one core, measured: {bounds["flops_per_s"] / 1e9:.0f} Gflop/s
(multiply-adds in the first-level cache), {bounds["bytes_per_s"] / 1e9:.1f} GB/s (copy of 256 MB).

{common.table(heads, table)}

"Flops": operations of one step of one world, each once, divisions and roots as one; "-" where loops over what touches
decide. "Flops of kernels": XLA's count of its kernels, which work out shared values again (three to six times), with
all loops, live or not; of these a share is an upper one. "% of bytes bound": the least bytes over the measured time.

## The longest kernels, kernel by kernel [us a step of the tile]
"""
    for r in rows:
        cells = [[k, what, number(us), number(n)] for k, what, us, n in r["longest"]]
        heads = ["kernel", "made for", "us a step", "times a step"]
        text += f"\n{throughput.TITLES[r['scene']]}\n\n{common.table(heads, cells)}\n"
    return text


def main(args) -> int:
    begin = time.perf_counter()
    out = args.out or common.RESULTS
    rbd.use_cores(1)
    env = common.environment()
    print(common.header(env), flush=True)
    bounds, rows = machine(), []
    for name in ("isotropic", "ball") if args.smoke else SCENES:
        rows.append(measure(name, args))
        r = rows[-1]
        print(f"{name:11s} {r['ns']:9.1f} ns, kernel by kernel {r['ns_kernels']:9.1f} ns, {r['kernels_per_step']:.0f} "
              f"kernels a step   ({time.perf_counter() - begin:.0f} s)", flush=True)  # fmt: skip
    common.write_json(out / "rooflines.json", {"environment": env, "bounds": bounds, "rows": rows})
    (out / "rooflines.md").write_text(report(env, bounds, rows, time.perf_counter() - begin), encoding="utf-8")
    print(f"wrote {out / 'rooflines.json'}, {out / 'rooflines.md'}")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--smoke", action="store_true", help="a few seconds: two scenes")
    parser.add_argument("--out", type=pathlib.Path, default=None, metavar="DIR", help="default benchmarks/results")
    sys.exit(main(parser.parse_args()))
