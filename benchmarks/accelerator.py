"""Batches on one device, a GPU above all: time per world-step, one kernel against XLA's, scaling, bounds, MJX beside.

    PYTHONPATH=. python benchmarks/accelerator.py                (about 5 minutes on a GPU and 16 cores)
    PYTHONPATH=. python benchmarks/accelerator.py --smoke --out /tmp/x

Preset "fast", float32, ``rbd.rollout`` that stores the final state, 1,024 start states repeated, results waited for,
best of the repeats, compile time apart (programs are compiled side by side, nothing is timed meanwhile). On a GPU a
rollout is one kernel (``rbd_jax.kernel``); "XLA's kernels" is the same program without it, which starts kernels for
every step. Two bounds for free bodies, both of measured rates of this device: bytes, if every step reads and writes the
state; instructions that threads issue, if the steps are fused. The error at that speed, and that of
MuJoCo's C engine, is that of ``throughput.py``. MJX is timed where it is installed, at the better of two batches.
Appends to accelerator.jsonl and writes accelerator.md under ``--out`` (benchmarks/results).
"""

from __future__ import annotations

import concurrent.futures
import functools
import os
import pathlib
import re
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
import throughput  # noqa: E402
from common import MuJoCo, Program, least_seconds, number, verdict  # noqa: E402

import rbd_jax as rbd  # noqa: E402
from rbd_jax import kernel  # noqa: E402
from rbd_jax.memory import bytes_of  # noqa: E402
from rbd_jax.rollout import Length, _advance, _rollout_batch  # noqa: E402
from rbd_jax.step import enter, with_memory  # noqa: E402
from rbd_jax.xla import on_gpu  # noqa: E402

SCENES = ("isotropic", "asymmetric", "ball", "box", "stack", "clutter", "pile16", "pile64")
POWERS = (10, 12, 14, 15, 16, 17)  # 2^10 to 2^17 worlds
MORE = {"isotropic": (20, 22), "asymmetric": (20, 22), "ball": (20, 22), "box": (20,)}
FEWER = {"stack": (10, 12, 15, 17), "clutter": (10, 12, 15, 17), "pile16": (10, 12, 15, 17), "pile64": (10, 13)}
FREE = ("isotropic", "asymmetric")
BY_XLA = {"isotropic": 17, "ball": 17, "box": 14}  # worlds of the row that XLA's own kernels make
STEPS = {"isotropic": 1000, "asymmetric": 1000, "ball": 1000, "box": 200, "pile64": 10}
#: MJX: (worlds, steps) of two runs.
MJX_RUNS = {
    "isotropic": ((8192, 50), (32768, 50)), "asymmetric": ((8192, 50), (32768, 50)),
    "ball": ((8192, 50), (32768, 50)), "box": ((8192, 20), (32768, 20)), "stack": ((2048, 4), (8192, 4)),
    "clutter": ((2048, 4), (8192, 4)), "pile16": ((2048, 4), (8192, 4)),
}  # fmt: skip
START = 1024
BOUND_BAR, MJX_BAR = 50.0, 10.0


def bounds(size: int) -> dict:
    """Measured rates of the device: bytes/s of a copy of ``size`` floats; multiply-adds/s of threads, a GPU's only."""
    x = jnp.linspace(0.1, 0.9, size, dtype=jnp.float32)
    copy = jax.jit(lambda x: x + np.float32(1))
    rates = {"bytes_per_s": 2 * x.nbytes / least_seconds(lambda: jax.block_until_ready(copy(x)), 5)}
    if on_gpu():
        worlds, terms, count = 2**21, 64, 1000

        def polynomial(y, x):
            for k in range(terms):
                y = y * x + np.float32(0.001 * k)
            return y

        def run(x):
            with kernel.forward():
                return kernel.repeated(polynomial, x, x, worlds=worlds, count=count)

        call, x = jax.jit(run), x[:worlds]
        rates["issued_per_s"] = terms * count * worlds / least_seconds(lambda: jax.block_until_ready(call(x)), 5)
    return rates


#: Instructions of the machine that stand for one of PTX where it is not one.
LONG = {"div.rn.f32": 8, "sqrt.rn.f32": 8, "rcp.rn.f32": 6}


def instructions(model, state) -> int:
    """Instructions of a step of one world: those of the innermost loop of the kernel's PTX."""
    p, world = enter(model, with_memory(model, state), state.batch_shape)
    once, n = _advance(model.structure, model.method), jnp.ones((1,), jnp.int32)
    made = kernel.program(kernel._many(once), *state.batch_shape, n, world, p, None)[0]
    lines = kernel.ptx(made.text, kernel.capability()).splitlines()
    labels = {line.split(":")[0]: i for i, line in enumerate(lines) if line.startswith("$")}
    branches = (
        (labels[m[1]], i) for i, line in enumerate(lines) if (m := re.search(r"bra(?:\.uni)?\s+(\$\w+);", line))
    )
    first, last = min(((a, b) for a, b in branches if a < b), key=lambda loop: loop[1] - loop[0])
    words = (re.sub(r"@!?%p\d+\s+", "", line.strip()).split() for line in lines[first : last + 1])
    return sum(LONG.get(w[0], 1) for w in words if w and re.match(r"[a-z][\w.]*$", w[0]))


@functools.cache
def some(name: str, size: int):
    scene, worlds = throughput.SCENES[name][0]()
    model, one = rbd.build(scene, dt=throughput.DT, method="fast")
    return model, worlds(one, size, np.random.default_rng(1))._with(memory=None)


def start(name: str, size: int):
    """Model and worlds of a scene: START of them, repeated."""
    model, state = some(name, min(START, size))
    return model, jax.tree.map(lambda c: jnp.tile(c, (max(size // START, 1), *(1,) * (c.ndim - 1))), state)


class Run:
    """A scene at 2^power worlds: its program, compiled when it is asked for."""

    def __init__(self, name: str, power: int, args, xla: bool = False):
        self.name, self.size, self.xla = name, 2**power, xla
        self.steps = 20 if args.smoke else STEPS.get(name, 50)
        if xla:
            self.steps = min(self.steps, 100)

    def compile(self):
        self.model, self.state = start(self.name, self.size)
        steps = self.steps
        bare = lambda m, s: _rollout_batch(m, with_memory(m, s), None, Length.of(steps, steps))[0]
        self.program = Program(bare if self.xla else throughput.last(steps), self.model, self.state)

    def row(self, args, rates) -> dict:
        took = least_seconds(lambda: self.program(self.model, self.state), args.repeats) / self.steps
        row = {
            "scene": self.name, "size": self.size, "steps": self.steps, "step_s": took, "ns": 1e9 * took / self.size,
            "compile_s": self.program.total_s, "xla": self.xla,
            "kernels": len(re.findall(r" (?:fusion|custom-call)\(", self.program._call.as_text())),
            "status": int(np.asarray(self.program(self.model, self.state).status).max()),
        }  # fmt: skip
        if self.name in FREE:
            moved = 2 * bytes_of(self.state._with(memory=None))
            row["bytes_share"] = 100 * moved / took / rates["bytes_per_s"]
            if on_gpu() and not self.xla:
                row["instructions"] = instructions(self.model, self.state)
                row["issue_share"] = 100 * row["instructions"] * self.size / took / rates["issued_per_s"]
        return row


class MJXRun:
    """A scene in MJX, likewise."""

    def __init__(self, name: str, size: int, steps: int):
        self.name, self.size, self.steps, self.call, self.reason = name, size, steps, None, ""

    def compile(self):
        begin = time.perf_counter()
        try:
            scene, _ = throughput.SCENES[self.name][0]()
            run, self.start = throughput.mjx(scene, self.steps)(*start(self.name, self.size))
            self.call = jax.jit(run).lower(*self.start).compile()
        except Exception as error:
            self.reason = f"{type(error).__name__}: {str(error)[:200]}"
        self.compile_s = time.perf_counter() - begin

    def row(self, args) -> dict:
        row = {"scene": self.name, "size": self.size, "steps": self.steps}
        if self.call is None:
            return row | {"reason": self.reason or "not compiled in time"}
        try:
            took = least_seconds(lambda: jax.block_until_ready(self.call(*self.start)), args.repeats)
        except Exception as error:
            return row | {"reason": f"{type(error).__name__}: {str(error)[:200]}"}
        return row | {"ns": 1e9 * took / self.steps / self.size, "compile_s": self.compile_s}


class Errors:
    """The errors of a scene at this speed."""

    def __init__(self, name: str, args):
        self.name, self.args, self.found = name, args, {}

    def compile(self):
        scene, worlds = throughput.SCENES[self.name][0]()
        model, one = rbd.build(scene, dt=throughput.DT, method="fast")
        rival = MuJoCo(scene, throughput.DT)
        judge = throughput.contact_errors if scene.static else throughput.free_errors
        try:
            self.found = judge(self.name, scene, rival, model, one, throughput.RUNS_OF_ERROR, worlds, self.args)
        finally:
            rival.close()


def report(env, rates, rows, wrong, rivals, took) -> str:
    cells, best = [], {}
    for r in rows:
        if not r["xla"]:
            best[r["scene"]] = min(best.get(r["scene"], r), r, key=lambda r: r["ns"])
        shares = [number(r.get(k)) for k in ("bytes_share", "issue_share")]
        name = throughput.TITLES[r["scene"]] + (", XLA's kernels" if r["xla"] else "")
        cells.append(
            [name, f"{r['size']:,}", number(r["ns"]), number(1e6 * r["step_s"]), number(1e9 / r["ns"]), *shares]
            + [r["kernels"], number(r["compile_s"]), r["status"] or ""]
        )
    heads = ["scene", "worlds", "ns a world-step", "us a step", "world-steps/s", "% of bytes bound", "% of issue bound",
             "kernels of the program", "compile [s]", "status"]  # fmt: skip
    against = []
    for name in dict.fromkeys(r["scene"] for r in rivals):
        theirs = [r for r in rivals if r["scene"] == name]
        done = [r for r in theirs if "ns" in r]
        top = min(done, key=lambda r: r["ns"]) if done else None
        ratio = top["ns"] / best[name]["ns"] if top else None
        what = f"{number(top['ns'])} at {top['size']:,}" if top else theirs[-1]["reason"]
        against.append([throughput.TITLES[name], what, number(best[name]["ns"]), number(ratio), f"{MJX_BAR:g}",
                        verdict(ratio, MJX_BAR, least=True) if top else ""])  # fmt: skip
    seen = [
        [throughput.TITLES[name], throughput.QUANTITIES[key][0], number(value["ours"]), number(value["mujoco"])]
        for name, found in wrong.items() for key, value in found.items() if isinstance(value, dict)
    ]  # fmt: skip
    free = max((r.get("issue_share", r["bytes_share"]) for r in rows if r["scene"] == "isotropic"), default=None)
    counts = {r["scene"]: r["instructions"] for r in rows if "instructions" in r}
    issued = rates.get("issued_per_s")
    return f"""# One device

{common.header(env)} Device: {jax.devices()[0].device_kind}.
Made by `benchmarks/accelerator.py` in {took:.0f} s. Bounds: {rates["bytes_per_s"] / 1e9:.0f} GB/s (a copy, measured){
        ""
        if issued is None
        else f"; {issued / 1e9:.0f} billion instructions/s of threads ({rates.get('how', 'multiply-adds, measured')})"
    }.

{common.table(heads, cells)}

The steps of a rollout are fused, so that a device can do more of them than it could if every step read and wrote the
state (shares above 100 % of the bytes bound); what then bounds them are the instructions that its threads can issue. A
step has {
        ", ".join(f"{n} ({throughput.TITLES[name]})" for name, n in counts.items()) or "(counted on a GPU)"
    } of them in
PTX, a division or root taken for 8. Isotropic free bodies reach {number(free)} % of the bound that applies (bar
{BOUND_BAR:g}: {verdict(free, BOUND_BAR, least=True)}).

## Error at that speed

{common.table(["scene", "error", "ours", "MuJoCo C"], seen)}

## MJX

{common.table(["scene", "MJX [ns] at worlds", "ours [ns]", "ratio", "bar", ""], against)}
"""


def compiled(runs, seconds: float):
    """Compiles programs side by side; those that take longer are left."""
    pool = concurrent.futures.ThreadPoolExecutor(max_workers=len(runs) or 1)
    waiting = [pool.submit(run.compile) for run in runs]
    done, _ = concurrent.futures.wait(waiting, timeout=seconds)
    pool.shutdown(wait=False, cancel_futures=True)
    for future in done:
        future.result()


def main(args) -> int:
    begin = time.perf_counter()
    out = args.out or common.RESULTS
    env = common.environment() | {"device_kind": jax.devices()[0].device_kind, "benchmark": "accelerator"}
    say = lambda text: print(f"{text}   ({time.perf_counter() - begin:.0f} s)", flush=True)
    print(common.header(env), env["device_kind"], flush=True)
    rates = bounds(2**16 if args.smoke else 2**28)
    scenes = ("isotropic", "ball") if args.smoke else args.scenes or SCENES
    powers = lambda name: (6,) if args.smoke else FEWER.get(name, (*POWERS, *MORE.get(name, ())))
    runs = [Run(name, power, args) for name in scenes for power in powers(name)]
    runs += [Run(name, power, args, xla=True) for name, power in BY_XLA.items() if name in scenes and not args.smoke]
    first = {run.name: run for run in runs if not run.xla}  # the rest takes its C program
    compiled(first.values(), 600)
    compiled([run for run in runs if run not in first.values()], 600)
    say("compiled")
    rows, wrong, theirs = [], {}, []
    for run in runs:
        rows.append(run.row(args, rates))
        common.append_lines(out / "accelerator.jsonl", [{**env, **rates, **rows[-1]}])
        say(f"{run.name:11s} {run.size:8,d} {rows[-1]['ns']:10.4f} ns{' XLA' if run.xla else ''}")
    write = lambda: (out / "accelerator.md").write_text(
        report(env, rates, rows, wrong, theirs, time.perf_counter() - begin), encoding="utf-8"
    )
    write()
    judged = [Errors(name, args) for name in scenes if name not in throughput.SLOW]
    rivals = [] if args.smoke else [MJXRun(name, *run) for name in scenes for run in MJX_RUNS.get(name, ())]
    compiled([*judged, *rivals], max(args.seconds - (time.perf_counter() - begin), 60.0))
    for run in judged:
        wrong[run.name] = run.found
        common.append_lines(out / "accelerator.jsonl", [{**env, "scene": run.name, "error": run.found}])
    write()
    say("errors; MJX compiled")
    for run in rivals:
        theirs.append(run.row(args))
        common.append_lines(out / "accelerator.jsonl", [{**env, "engine": "mjx", **theirs[-1]}])
        say(f"{run.name:11s} MJX {run.size:8,d} {theirs[-1].get('ns') or theirs[-1]['reason']}")
        write()
    print(f"wrote {out / 'accelerator.jsonl'}, {out / 'accelerator.md'}", flush=True)
    return 0


if __name__ == "__main__":
    parser = common.options(__doc__, "two scenes, few worlds")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, metavar="SCENE")
    parser.add_argument("--seconds", type=float, default=600.0, help="what MJX has not compiled until then is left out")
    code = main(parser.parse_args())
    sys.stdout.flush()
    os._exit(code)  # a program that is still being compiled would be waited for
