"""Layer 10: the command line, ``python -m rbd_jax`` and ``rbd-jax``.

Exit codes: 0 fine, 1 a check failed (a world went wrong, parity out of tolerance), 2 a usage error. Heavy imports
are inside the commands.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import math
import os
import sys
import time
import warnings

OK, FAILED, USAGE = 0, 1, 2

SECONDS = 5.0  # simulated time of `run` without --steps and --seconds [s]
SAMPLE_RATE = 60.0  # samples per simulated second [1/s]
SHOWN = 16  # worlds in a page
PICTURED = 9  # worlds in a picture
PIECES = 40  # a run is cut into about so many compiled chunks
STILL = (1e-2, 5e-2)  # a body slower than this is at rest [m/s], [rad/s]

SCENE_HELP = "an MJCF file, or the name of a shipped example (rbd-jax info lists them)"
METHOD_HELP = "preset: fast, accurate, gradient or mujoco (default %(default)s)"


class UsageError(Exception):
    """What the user gave cannot be used; shown as it is."""


def main(argv: list[str] | None = None) -> int:
    """Run a command and return its exit code; ``argv``: None = those of the process."""
    try:
        args = _parser().parse_args(argv)
    except UsageError as error:
        return _complain(error)
    except SystemExit as stop:  # --help, --version
        return int(stop.code or 0)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: print(f"{args.prog}: warning: {message}", file=sys.stderr)
            return args.command(args)
    except UsageError as error:
        return _complain(f"{args.prog}: error: {error}")
    except KeyboardInterrupt:
        print(f"{args.prog}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # e.g. piped into head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK


def _complain(error) -> int:
    print(error, file=sys.stderr)
    return USAGE


@contextlib.contextmanager
def _user_errors():
    """What the library raises about the user's input becomes a message; bugs elsewhere keep their traceback."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise UsageError(error) from None


# --- arguments ---


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        raise UsageError(f"{self.prog}: error: {message} ('{self.prog} --help' shows the options)")


def _integer(least: int):
    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"{text!r} must be an integer >= {least}")
        return value

    return convert


def _number(rule: str, unit: str):
    def convert(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and (value > 0 if rule == "> 0" else value >= 0)):
            raise argparse.ArgumentTypeError(f"{text!r} must be a finite number {rule} [{unit}]")
        return value

    return convert


def _pixels(text: str) -> tuple[int, int]:
    parts = text.split("x")
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f"{text!r} must be WIDTHxHEIGHT, as 480x320")
    return _integer(2)(parts[0]), _integer(2)(parts[1])


def _batches(text: str) -> list[int]:
    return [_integer(1)(part) for part in text.split(",")]


def _names(text: str) -> tuple[str, ...]:
    return tuple(name for name in text.split(",") if name)


def _add_suite(sub) -> None:
    sub.add_argument("--results", metavar="DIR", help="rows, charts and report (default benchmarks/results)")
    for what in ("case", "engine"):
        sub.add_argument(
            f"--add-{what}s",
            action="append",
            default=[],
            metavar="DIR",
            help=f"further {what}s of the suite, a file each",
        )


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="rbd-jax",
        description="Batched rigid-body dynamics: boxes and spheres with contact and friction, in JAX.",
        epilog="Exit codes: 0 fine, 1 a check failed, 2 usage error. JAX_ENABLE_X64=1 computes in float64.\n"
        "Start with: rbd-jax run box_stack --html out.html",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    from . import __version__

    parser.add_argument("--version", action="version", version=f"rbd-jax {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def add(name, command, summary, example):
        sub = commands.add_parser(
            name,
            help=summary,
            description=summary[0].upper() + summary[1:] + ".",
            epilog=example,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        sub.set_defaults(command=command, prog=sub.prog)
        return sub

    def add_scene(sub, method="accurate", dt=True, needed=True):
        sub.add_argument("scene", metavar="SCENE", nargs=None if needed else "?", help=SCENE_HELP)
        sub.add_argument("--method", default=method, metavar="NAME", help=METHOD_HELP)
        if dt:
            sub.add_argument("--dt", type=_number("> 0", "s"), metavar="S", help="step [s] (default: the scene's)")

    def add_noise(sub):
        sub.add_argument(
            "--perturb",
            type=_number(">= 0", "m, m/s"),
            default=0.0,
            metavar="SIZE",
            help="add Gaussian noise of this standard deviation to the start positions [m] and velocities [m/s] of "
            "every world",
        )
        sub.add_argument("--seed", type=_integer(0), default=0, metavar="N", help="of the noise (default 0)")

    sub = add(
        "run",
        _run,
        "simulate a scene and write the trajectory, a page that plays it, or a picture",
        "examples:\n"
        "  rbd-jax run box_stack --html out.html --png shot.png\n"
        "  rbd-jax run scene.xml --batch 64 --perturb 0.01 --seconds 10 --method fast --out out.npz\n\n"
        "Ctrl-C stops early and writes what there is.",
    )
    add_scene(sub)
    length = sub.add_mutually_exclusive_group()
    length.add_argument("--steps", type=_integer(0), metavar="N", help="number of steps")
    length.add_argument(
        "--seconds", type=_number("> 0", "s"), metavar="T", help=f"simulated time [s] (default {SECONDS:g})"
    )
    sub.add_argument("--batch", type=_integer(1), default=1, metavar="B", help="number of worlds (default 1)")
    add_noise(sub)
    sub.add_argument(
        "--every",
        type=_integer(1),
        metavar="K",
        help=f"steps between two samples (default: about {SAMPLE_RATE:g} samples per simulated second)",
    )
    sub.add_argument("--out", metavar="FILE.npz", help="write the trajectory of all worlds")
    sub.add_argument(
        "--html", metavar="FILE.html", help=f"write one page that plays offline (the first {SHOWN} worlds)"
    )
    sub.add_argument("--png", metavar="FILE.png", help=f"write a picture of the end (the first {PICTURED} worlds)")
    sub.add_argument("--forces", action="store_true", help="with the forces of contact in the page")
    sub.add_argument(
        "--ghost", action="store_true", help="with MuJoCo's run of the same worlds as outlines in the page"
    )
    sub.add_argument("--json", action="store_true", help="print the summary as JSON")
    sub.add_argument("--quiet", action="store_true", help="print nothing but warnings and errors")

    sub = add(
        "render",
        _render,
        "draw a scene, or a trajectory that run wrote: picture, movie, page, or a scene for another program",
        "examples:\n"
        "  rbd-jax render dominoes -o dominoes.gif --seconds 3\n"
        "  rbd-jax render out.npz -o clip.mp4 --worlds 4\n\n"
        "The ending of FILE says what is written: .png .gif .mp4 .html .glb (glTF) .usda (USD) "
        ".xml (keyframes for MuJoCo's viewer). No display needed.",
    )
    add_scene(sub, method="fast")
    sub.add_argument("-o", "--out", required=True, metavar="FILE", help="what to write")
    sub.add_argument("--seconds", type=_number("> 0", "s"), metavar="T", help=f"simulated [s] (default {SECONDS:g})")
    sub.add_argument("--worlds", type=_integer(1), default=1, metavar="N", help="worlds side by side (default 1)")
    add_noise(sub)
    sub.add_argument("--fps", type=_number("> 0", "1/s"), default=25.0, metavar="F", help="of a movie (default 25)")
    sub.add_argument("--speed", type=_number("> 0", "-"), default=1.0, metavar="X", help="of a movie (default 1)")
    sub.add_argument("--size", type=_pixels, default=(480, 320), metavar="WxH", help="in pixels (default 480x320)")

    sub = add(
        "validate",
        _validate,
        "compare a scene with MuJoCo: a table, and exit code 1 if out of tolerance",
        "example:\n  rbd-jax validate bouncing_balls --method mujoco",
    )
    add_scene(sub, method=None, dt=False)
    sub.add_argument("--steps", type=_integer(1), metavar="N", help="length of the comparison (default: its own)")
    sub.add_argument("--json", action="store_true", help="print the report as JSON")

    sub = add(
        "bench",
        _bench,
        "measure a scene beside MuJoCo, or the suite of speed against accuracy",
        "examples:\n  rbd-jax bench box_stack --batch 1,64,1024 --method fast --append results.jsonl\n"
        "  rbd-jax bench --suite standard --engines ours,mujoco\n\n"
        "A scene: compile time, speed and penetration; MuJoCo runs it at the same step through mujoco.rollout on all\n"
        "threads; its rate does not depend on the batch. A suite: cases in engines, see benchmarks/README.md; rows\n"
        "are appended to suite.jsonl as they come, an interrupted run goes on where it stopped.",
    )
    add_scene(sub, needed=False)
    sub.add_argument("--suite", metavar="NAME", help="smoke (two cases, a minute), standard or full")
    _add_suite(sub)
    sub.add_argument("--cases", type=_names, default=(), metavar="A,B", help="of the suite, default all")
    sub.add_argument("--engines", type=_names, default=(), metavar="A,B", help="of the suite, default all installed")
    sub.add_argument("--fresh", action="store_true", help="begin a new run of the suite")
    sub.add_argument(
        "--batch", type=_batches, default=[1024], metavar="B[,B...]", help="numbers of worlds (default 1024)"
    )
    sub.add_argument("--seconds", type=_number("> 0", "s"), default=2.0, metavar="T", help="simulated [s] (default 2)")
    sub.add_argument("--repeats", type=_integer(1), default=3, metavar="N", help="timed runs (default 3)")
    add_noise(sub)
    sub.add_argument("--append", metavar="FILE", help="append one JSON line for each batch size")
    sub.add_argument("--json", action="store_true", help="print the JSON lines instead of the text")

    sub = add(
        "chart",
        _chart,
        "draw the charts of the suite's rows and write the report",
        "example:\n  rbd-jax chart --results benchmarks/results",
    )
    _add_suite(sub)
    sub.add_argument("--run", metavar="ID", help="only the rows of this run (default: the newest of each point)")

    sub = add(
        "train",
        _train,
        "learn a task by PPO, or by gradients through the simulator",
        "example:\n  rbd-jax train push --seconds 20 --out push.gif",
    )
    sub.add_argument("task", metavar="TASK", help="push, catch, balance or topple")
    sub.add_argument("--learner", choices=("ppo", "through"), default="ppo", help="default ppo")
    sub.add_argument("--seconds", type=_number("> 0", "s"), metavar="T", help="wall time (default 20 without --steps)")
    sub.add_argument("--steps", type=_integer(1), metavar="N", help="control steps of all worlds")
    sub.add_argument("--seed", type=_integer(0), default=0, metavar="N", help="default 0")
    sub.add_argument("--out", metavar="FILE", help="what the policy does in four worlds; endings as of render")
    sub.add_argument("--json", action="store_true", help="print the result as JSON")

    summary = "versions, devices, extras, shipped examples and presets"
    sub = add("info", _info, summary, "example:\n  rbd-jax info --json")
    sub.add_argument("--json", action="store_true", help="print as JSON")
    return parser


# --- what the commands share ---


def _scene(source: str):
    """(scene, title) of a file or a shipped example."""
    from . import examples
    from .mjcf import load_mjcf

    path, known = source, examples.names()
    if not os.path.exists(source) and source in known:
        path = examples.path(source)
    elif not os.path.exists(source):
        raise UsageError(f"{source}: no such file, nor a shipped example ({', '.join(known)})")
    with _user_errors():
        return load_mjcf(path), os.path.splitext(os.path.basename(path))[0]


def _check_outputs(*paths: str | None) -> None:
    from .view import check_writable

    given = [p for p in paths if p is not None]
    if len({os.path.realpath(p) for p in given}) < len(given):
        raise UsageError(f"output files must differ: {', '.join(given)}")
    for path in given:
        with _user_errors():
            check_writable(path)


def _worlds(model, state, count: int, perturb: float, seed: int):
    """``count`` worlds, with noise from numpy's generator so that a seed means the same on every device."""
    import numpy as np

    from .state import batch

    state = batch(state, count)
    if perturb:
        noise = np.random.default_rng(seed).standard_normal((2, count, model.n, 3)) * perturb
        state = state.replace(pos=np.asarray(state.pos) + noise[0], vel=np.asarray(state.vel) + noise[1])
    return state


@functools.lru_cache(maxsize=16)
def _program(steps: int, every: int):
    import jax

    from .rollout import rollout

    return jax.jit(functools.partial(rollout, steps=steps, every=every))


@functools.lru_cache(maxsize=1)
def _measures():
    """Compiled: energies, momenta and speeds of a state."""
    import jax
    import jax.numpy as jnp

    from .diagnostics import energy, momentum

    def measure(model, state):
        speed = jnp.linalg.norm(state.vel, axis=-1), jnp.linalg.norm(state.omega, axis=-1)
        return energy(model, state), momentum(model, state), speed

    return jax.jit(measure)


def _compile(steps: int, every: int, model, state) -> float:
    """Compile and return how long it took [s]; the call afterwards finds the program."""
    start = time.perf_counter()
    _program(steps, every).lower(model, state).compile()
    return time.perf_counter() - start


def _json(value, **options) -> str:
    """JSON text; numbers that are not finite, which JSON cannot hold, become null."""

    def plain(v):
        if isinstance(v, dict):
            return {k: plain(x) for k, x in v.items()}
        if isinstance(v, (list, tuple)):
            return [plain(x) for x in v]
        return None if isinstance(v, float) and not math.isfinite(v) else v

    return json.dumps(plain(value), allow_nan=False, **options)


# --- run ---


def _divisor(count: int, want: float, slack: float) -> int | None:
    """The divisor of ``count`` nearest to ``want`` (as a ratio), unless it is off by more than ``slack``."""
    if count < 1:
        return None
    small = [k for k in range(1, math.isqrt(count) + 1) if count % k == 0]
    off = lambda k: abs(math.log(k / max(want, 1)))
    best = min({*small, *(count // k for k in small)}, key=off)
    return best if off(best) <= math.log(slack) + 1e-9 else None


def _every(steps: int, dt: float) -> int:
    """Steps between samples: near the sample rate, and a divisor of ``steps`` so that the last state is a sample."""
    want = max(1, min(round(1.0 / (SAMPLE_RATE * dt)), steps))
    return _divisor(steps, want, 1.6) or want


def _chunks(steps: int, unit: int) -> list[int]:
    """Lengths of the chunks, multiples of ``unit`` but for the last; few different ones, as each is compiled."""
    units = steps // unit
    size = _divisor(units, units / PIECES, 4.0) or max(1, math.ceil(units / PIECES))
    chunks = [size * unit] * (units // size)
    rest = steps - sum(chunks)
    return chunks + [rest] if rest or not chunks else chunks


class _Progress:
    """Lines on stderr for runs that take longer than a moment; one line that is rewritten on a terminal."""

    def __init__(self, worlds: int, steps: int, dt: float, quiet: bool):
        self.worlds, self.steps, self.dt, self.quiet = worlds, steps, dt, quiet
        self.terminal = sys.stderr.isatty()
        self.width = 0
        self.last = 0.0

    def say(self, text: str) -> None:
        if not self.quiet:
            end = "\r" if self.terminal else "\n"
            print(text.ljust(self.width), end=end, file=sys.stderr, flush=True)
            self.width = len(text)

    def update(self, done: int, elapsed: float) -> None:
        now = time.perf_counter()
        if now - self.last < (0.2 if self.terminal else 5.0) or done == self.steps:
            return
        self.last = now
        rate = self.worlds * done / elapsed
        left = elapsed * (self.steps - done) / done
        self.say(
            f"{100 * done / self.steps:3.0f} %  {done * self.dt:.4g} of {self.steps * self.dt:.4g} s simulated, "
            f"{rate:.3g} world-steps/s, {_duration(left)} left"
        )

    def close(self) -> None:
        if self.terminal and self.width and not self.quiet:
            print(" " * self.width, end="\r", file=sys.stderr, flush=True)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _simulate(model, state, steps: int, every: int, keep: int, progress: _Progress):
    """(final, traj, compile s, run s, interrupted): a host loop over compiled chunks.

    traj: numpy leaves, the first ``keep`` worlds; None if 0. An interrupt returns what there is.
    """
    import jax
    import numpy as np

    chunks = _chunks(steps, every if keep else 1)
    start = time.perf_counter()
    progress.say("compiling ...")
    for size in dict.fromkeys(chunks):
        _compile(size, every if keep else max(size, 1), model, state)
    compiled = time.perf_counter() - start
    if compiled > 1.0:
        progress.say(f"compiled in {compiled:.1f} s")
    pieces, done, interrupted = [], 0, False
    start = progress.last = time.perf_counter()
    try:
        for size in chunks:
            new, part = jax.block_until_ready(_program(size, every if keep else max(size, 1))(model, state))
            if keep:
                skip = 1 if pieces else 0
                pieces.append(jax.tree.map(lambda c: np.asarray(c[:keep, skip:]), part))  # noqa: B023
            state, done = new, done + size
            progress.update(done, time.perf_counter() - start)
    except KeyboardInterrupt:
        interrupted = True
    ran = time.perf_counter() - start
    progress.close()
    traj = jax.tree.map(lambda *c: np.concatenate(c, axis=1), *pieces) if pieces else None
    return state, traj, compiled, ran, interrupted


def _run(args) -> int:
    import numpy as np

    _check_outputs(args.out, args.html, args.png)
    scene, title = _scene(args.scene)
    from .build import build
    from .diagnostics import SimulationError, check

    with _user_errors():
        model, start = build(scene, dt=args.dt, method=args.method)
    dt = float(str(np.asarray(model.dt)))
    steps = args.steps
    if steps is None:
        steps = max(1, round((args.seconds or SECONDS) / dt))
    start = _worlds(model, start, args.batch, args.perturb, args.seed)
    if args.batch > 1 and not args.perturb:
        warnings.warn("all worlds are the same; --perturb SIZE makes them differ", stacklevel=1)
    keep = args.batch if args.out else SHOWN if args.html else PICTURED if args.png else 0
    every = args.every or _every(steps, dt)
    progress = _Progress(args.batch, steps, dt, args.quiet)
    final, traj, compiled, ran, interrupted = _simulate(model, start, steps, every, keep, progress)

    summary = _summary(model, start, final, args, dt, compiled, ran)
    try:
        check(final)
    except SimulationError as error:
        summary.update(status=str(error).splitlines(), bad_worlds=len(error.worlds))
    notes = {"scene": args.scene, "seed": args.seed, "perturb": args.perturb, "every": every}
    try:
        summary["written"] = _write(args, model, traj, title, notes, _ghost(args, scene, model, start, traj, every))
    except OSError as error:
        print(f"{args.prog}: error: cannot write: {error}", file=sys.stderr)
        return FAILED
    if args.json:
        print(_json(summary, indent=2))
    elif not args.quiet:
        print(_table(summary))
    if interrupted:
        print(f"{args.prog}: interrupted after {summary['steps']} of {steps} steps", file=sys.stderr)
        return 130
    if summary["bad_worlds"]:
        for line in summary["status"]:
            print(f"{args.prog}: {line}", file=sys.stderr)
        return FAILED
    return OK


def _write(args, model, traj, title: str, notes: dict, ghost=None) -> list[str]:
    """Write what was asked for and return the paths."""
    if traj is None:
        return []
    from .record import clip, save
    from .view import write_html, write_png

    if args.out:
        save(args.out, model, traj, **notes)
    if args.html or args.png:
        film = clip(model, traj, title=title, worlds=SHOWN, forces=args.forces and bool(args.html), ghost=ghost)
        if args.html:
            write_html(film, args.html)
        if args.png:
            write_png(film, args.png, world=range(min(film.shape[0], PICTURED)))
    return [p for p in (args.out, args.html, args.png) if p]


def _render(args) -> int:
    write = _film_writer(args.out, args.size, fps=args.fps, speed=args.speed)
    if os.path.abspath(args.out) == os.path.abspath(args.scene):
        raise UsageError(f"cannot write {args.out}: it is the scene itself")
    _check_outputs(args.out)
    with _user_errors():
        film = _film_of_file(args) if args.scene.endswith(".npz") else _film_of_scene(args)
        write(film)
    return OK


def _film_writer(path: str, size: tuple[int, int], **movie):
    """film -> None, writes it as the ending of ``path`` says, its worlds side by side."""
    from .view import write_gif, write_glb, write_html, write_mp4, write_png, write_replay, write_usda

    still = {"width": size[0], "height": size[1]}
    side = lambda film: range(film.shape[0])
    writers = {
        ".png": lambda film: write_png(film, path, world=side(film), **still),
        ".gif": lambda film: write_gif(film, path, world=side(film), **still, **movie),
        ".mp4": lambda film: write_mp4(film, path, world=side(film), **still, **movie),
        ".html": lambda film: write_html(film, path),
        ".glb": lambda film: write_glb(film, path),
        ".usda": lambda film: write_usda(film, path),
        ".xml": lambda film: write_replay(film, path),
    }
    ending = os.path.splitext(path)[1].lower()
    if ending not in writers:
        raise UsageError(f"{path}: cannot write {ending or 'a file without an ending'}; known: {', '.join(writers)}")
    return writers[ending]


def _film_of_scene(args):
    """A scene simulated now."""
    import numpy as np

    from .build import build
    from .record import clip
    from .rollout import rollout

    scene, title = _scene(args.scene)
    model, start = build(scene, dt=args.dt, method=args.method)
    dt = float(str(np.asarray(model.dt)))
    steps = max(1, round((args.seconds or SECONDS) / dt))
    start = _worlds(model, start, args.worlds, args.perturb, args.seed)
    _, traj = rollout(model, start, steps, every=_every(steps, dt))
    return clip(model, traj, title=title, worlds=args.worlds)


def _film_of_file(args):
    """A trajectory that ``run --out`` wrote, of the scene that its header names."""
    from .record import film, load

    content = load(args.scene)
    source = content["header"].get("scene")
    if source is None:
        raise UsageError(f"{args.scene}: its header does not name the scene")
    scene, title = _scene(source)
    return film(scene, content, title=title, worlds=args.worlds)


def _train(args) -> int:
    import importlib

    import jax

    from .learn import make, training, watch

    with _user_errors():
        task = make(args.task)
    write = _film_writer(args.out, (480, 320)) if args.out else None
    _check_outputs(args.out)
    learner = importlib.import_module(f".learn.{args.learner}", __package__)
    seconds = args.seconds if args.seconds or args.steps else 20.0
    say = lambda p: print(
        f"{p.steps:9d} control steps, {p.seconds:6.1f} s: return {p.mean_return:.2f}", file=sys.stderr
    ) if p.episodes else None  # fmt: skip
    try:
        got, history = learner.train(task, jax.random.key(args.seed), seconds=seconds, steps=args.steps, report=say)
    except ModuleNotFoundError as missing:
        raise UsageError(f"train needs {missing.name}: pip install 'rbd-jax[rl]'") from None
    key = jax.random.key(args.seed + 1)
    result = {
        "task": args.task, "learner": args.learner, "steps": history[-1].steps, "seconds": history[-1].seconds,
        "learned": float(training.evaluate(task, got.policy, key).mean()),
        "chance": float(training.evaluate(task, training.at_random(task), key).mean()),
    }  # fmt: skip
    if write is not None:
        with _user_errors():
            write(watch(task, got.policy, key))
    if args.json:
        print(_json(result))
    else:
        print(
            "{task}: return {learned:.2f} after {steps} control steps and {seconds:.1f} s; chance {chance:.2f}".format(
                **result
            )
        )
    return OK


def _ghost(args, scene, model, start, traj, every: int):
    """MuJoCo's run of the worlds that the page shows."""
    if not (args.ghost and args.html) or traj is None:
        return None
    import jax

    from .parity import ghost

    shown = jax.tree.map(lambda c: c[:SHOWN], start)
    return ghost(scene, model, shown, (traj.batch_shape[-1] - 1) * every, every)


def _summary(model, start, final, args, dt: float, compiled: float, ran: float) -> dict:
    """What a run did, for the table and for JSON."""
    import numpy as np

    s = model.structure
    steps = int(np.max(final.step))
    result = {
        "scene": args.scene, "bodies": model.n, "geoms": len(s.kinds), "pairs": sum(len(g.a) for g in s.groups),
        "method": args.method, "dtype": str(model.mass.dtype), "worlds": args.batch, "dt": dt, "steps": steps,
        "seconds": steps * dt, "compile_s": compiled, "run_s": ran,
        "world_steps_per_s": args.batch * steps / ran if steps else 0.0, "status": [], "bad_worlds": 0,
    }  # fmt: skip
    for when, state in (("start", start), ("end", final)):
        (kinetic, potential), momenta, speeds = _measures()(model, state._with(memory=None))
        spread = lambda x: [float(v) for v in (np.mean(x), np.min(x), np.max(x))]
        kinetic, potential = np.asarray(kinetic, float), np.asarray(potential, float)
        energies = {"kinetic": kinetic, "potential": potential, "total": kinetic + potential}
        result[when] = {
            "energy": {k: dict(zip(("mean", "min", "max"), spread(v))) for k, v in energies.items()},
            "momentum": np.asarray(momenta[0], float).mean(0).tolist(),
            "angular_momentum": np.asarray(momenta[1], float).mean(0).tolist(),
        }
    still = (np.asarray(speeds[0]) < STILL[0]) & (np.asarray(speeds[1]) < STILL[1])
    result["resting"], result["moving"] = int(still.sum()), int((~still).sum())
    return result


def _table(s: dict) -> str:
    several = s["worlds"] > 1
    name = lambda text: f"{text:<22}"
    plural = lambda count, word: f"{count} {word}" + ("s" if count != 1 else "")
    lines = [
        name("scene") + f"{s['scene']}: {plural(s['bodies'], 'body').replace('bodys', 'bodies')}, "
        f"{plural(s['geoms'], 'geom')}, {plural(s['pairs'], 'pair')} that may touch",
        name("method") + f"{s['method']}, {s['dtype']}",
        name("simulated") + f"{s['seconds']:.6g} s = {s['steps']} steps of {1e3 * s['dt']:.4g} ms, "
        f"{plural(s['worlds'], 'world')}",
        name("took") + f"{s['run_s']:.3g} s, {s['world_steps_per_s']:.3g} world-steps/s, after {s['compile_s']:.1f} s "
        "of compiling",
        "",
        name("mean over worlds" if several else "") + f"{'start':>26}  {'end':>26}",
    ]
    # a component that is rounding beside the others is shown as 0
    vector = lambda v: " ".join(f"{x if abs(x) > 1e-6 * max(map(abs, v)) else 0.0:8.4g}" for x in v)
    for key in ("kinetic", "potential", "total"):
        start, end = (s[when]["energy"][key] for when in ("start", "end"))
        line = name(f"{key} energy [J]") + f"{start['mean']:26.6g}  {end['mean']:26.6g}"
        if several:
            line += f"  ({end['min']:.4g} to {end['max']:.4g})"
        lines.append(line)
    for key, label in (("momentum", "momentum [N s]"), ("angular_momentum", "angular mom. [N m s]")):
        lines.append(name(label) + f"{vector(s['start'][key]):>26}  {vector(s['end'][key]):>26}")
    bad = s["bad_worlds"]
    lines += [
        "",
        name("bodies at the end") + f"{s['resting']} at rest (< {STILL[0]:g} m/s, < {STILL[1]:g} rad/s), "
        f"{s['moving']} moving" + (", over all worlds" if several else ""),
        name("status") + (f"{plural(bad, 'world')} of {s['worlds']} went wrong, see below" if bad else "all well"),
    ]
    if s["written"]:
        lines += [name("written") + f"{p} ({_size(p)})" for p in s["written"]]
    else:
        lines += ["", "Nothing written. To keep the result: --out FILE.npz (trajectory), --html FILE.html (page that",
                  "plays it in a browser), --png FILE.png (picture)."]  # fmt: skip
    return "\n".join(lines)


def _size(path: str) -> str:
    size = os.path.getsize(path)
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"


# --- validate ---


def _validate(args) -> int:
    scene, _ = _scene(args.scene)
    from .parity import validate

    with _user_errors():
        report = validate(scene, method=args.method, steps=args.steps)
    if args.json:
        print(_json(report.to_dict(), indent=2))
    else:
        print(report.table())
    return OK if report.ok else FAILED


# --- the suite ---


def _suite(args) -> int:
    from . import suite

    with _user_errors():
        rows = suite.bench(
            args.suite, args.cases, args.engines, args.add_cases, args.add_engines, args.results, args.fresh,
            say=lambda text: print(text, flush=True),
        )  # fmt: skip
    print(f"wrote {rows}; 'rbd-jax chart' draws it")
    return OK


def _chart(args) -> int:
    from . import suite

    with _user_errors():
        files = suite.chart(args.results, args.run, args.add_cases, args.add_engines)
    for path in files:
        if str(path).endswith((".html", ".md")):
            print(f"wrote {path}")
    return OK


# --- bench ---


def _bench(args) -> int:
    if (args.scene is None) == (args.suite is None):
        raise UsageError(f"{args.prog}: error: give either SCENE or --suite NAME")
    if args.suite is not None:
        return _suite(args)
    _check_outputs(args.append)
    scene, _ = _scene(args.scene)
    import jax
    import numpy as np

    from .build import build
    from .record import versions

    with _user_errors():
        model, one = build(scene, dt=args.dt, method=args.method)
    dt = float(str(np.asarray(model.dt)))
    every = max(1, round(args.seconds / dt / 20))
    steps = every * max(1, round(args.seconds / dt / every))
    device = jax.devices()[0]
    rival = _bench_mujoco(scene, dt, steps, every, max(args.batch), args)
    if not args.json:
        print(
            f"{args.scene}, method {args.method}, {model.mass.dtype}, dt {1e3 * dt:.4g} ms, {steps} steps, "
            f"{device.device_kind} ({device.platform})"
        )
    ours = 0.0
    for batch in args.batch:
        row = _bench_ours(model, one, dt, steps, every, batch, args)
        ours = max(ours, row["steps_per_s"])
        line = {
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), "scene": args.scene, "method": args.method,
            "dt": dt, "steps": steps, "dtype": str(model.mass.dtype), "device": device.device_kind,
            "platform": device.platform, "cpus": os.cpu_count(), "versions": versions(), "perturb": args.perturb,
            "seed": args.seed, **row, "mujoco": rival,
        }  # fmt: skip
        if args.append:
            try:
                with open(args.append, "a", encoding="utf-8") as file:
                    file.write(_json(line) + "\n")
            except OSError as error:
                print(f"{args.prog}: error: cannot write: {error}", file=sys.stderr)
                return FAILED
        if args.json:
            print(_json(line), flush=True)
        else:
            print(f"\nSummary for {batch} parallel rollouts\n\n Total JIT time: {row['jit_s']:.2f} s")
            print(_five(row), flush=True)
    if args.json:
        return OK
    if "error" in rival:
        print(f"\nMuJoCo: cannot run this scene: {rival['error']}")
    else:
        how = f"{rival['integrator']}, {rival['batch']} rollouts on {rival['threads']} threads"
        print(f"\nMuJoCo {rival['version']}, {how}\n\n{_five(rival)}")
        print(f"\nrbd_jax / MuJoCo: {ours / rival['steps_per_s']:.3g} x")
    return OK


def _five(row: dict) -> str:
    """The lines of mjx-testspeed after the JIT time, and the penetration."""
    gap = row["penetration_m"]
    return (
        f" Total simulation time: {row['run_s']:.3g} s\n"
        f" Total steps per second: {row['steps_per_s']:,.0f}\n"
        f" Total realtime factor: {row['realtime']:,.2f} x\n"
        f" Total time per step: {row['us_per_step']:.4g} µs\n"
        f" Deepest penetration: {'none' if not gap else f'{1e3 * gap:.3g} mm'} (at 20 instants)"
    )


def _rates(run_s: float, worlds: int, steps: int, dt: float) -> dict:
    total = worlds * steps
    return {
        "batch": worlds, "run_s": run_s, "steps_per_s": total / run_s, "realtime": total * dt / run_s,
        "us_per_step": 1e6 * run_s / total,
    }  # fmt: skip


def _bench_ours(model, one, dt: float, steps: int, every: int, batch: int, args) -> dict:
    import jax
    import numpy as np

    state = _worlds(model, one, batch, args.perturb, args.seed)
    jit_s = _compile(steps, every, model, state)
    call = _program(steps, every)
    jax.block_until_ready(call(model, state))
    runs = []
    for _ in range(args.repeats):
        start = time.perf_counter()
        final, traj = jax.block_until_ready(call(model, state))
        runs.append(time.perf_counter() - start)
    bad = int(np.count_nonzero(np.asarray(final.status)))
    if bad:
        warnings.warn(f"{bad} of {batch} worlds went wrong (rbd-jax run tells how)", stacklevel=1)
    return {
        **_rates(float(np.median(runs)), batch, steps, dt), "jit_s": jit_s, "runs_s": runs, "bad_worlds": bad,
        "penetration_m": _penetration(model, traj),
    }  # fmt: skip


def _penetration(model, traj) -> float:
    """Deepest overlap [m] at the samples of the first worlds, >= 0."""
    import jax
    import jax.numpy as jnp

    from .diagnostics import contacts
    from .record import first_worlds

    if not model.structure.groups:
        return 0.0

    @jax.jit
    def deepest(model, state):
        found = contacts(model, state)
        return jnp.where(found.live, -found.distance, 0.0).max()

    return max(0.0, float(deepest(*first_worlds(model, traj, SHOWN))))


def _bench_mujoco(scene, dt: float, steps: int, every: int, batch: int, args) -> dict:
    """The same scene in ``mujoco.rollout`` on all threads; {"error": why} if MuJoCo cannot."""
    import mujoco
    import numpy as np
    from mujoco import rollout

    from .mjcf import compile_mujoco

    threads = os.cpu_count() or 1
    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    try:
        model, data = compile_mujoco(scene)
    except Exception as error:  # MuJoCo's FatalError derives from Exception alone
        return {"error": str(error).splitlines()[0]}
    model.opt.timestep = dt
    one = np.empty(mujoco.mj_stateSize(model, spec))
    mujoco.mj_getState(model, data, one, spec)
    pool = [mujoco.MjData(model) for _ in range(threads)]

    def run(worlds: int):
        initial = np.tile(one, (worlds, 1))
        if args.perturb:
            # full physics state: time, qpos (7 a body), qvel (6 a body)
            noise = np.random.default_rng(args.seed).standard_normal((2, worlds, len(scene.bodies), 3)) * args.perturb
            for i in range(len(scene.bodies)):
                initial[:, 1 + 7 * i : 4 + 7 * i] += noise[0, :, i]
                initial[:, 1 + model.nq + 6 * i : 4 + model.nq + 6 * i] += noise[1, :, i]
        start = time.perf_counter()
        states, _ = rollout.rollout(model, pool, initial, nstep=steps, persistent_pool=True)
        return time.perf_counter() - start, states

    try:
        first, _ = run(threads)
        # as many worlds as take about a second: the rate does not depend on the number
        worlds = int(min(max(batch, threads), max(threads, round(1.0 / first) * threads)))
        timed = [run(worlds) for _ in range(args.repeats)]
        states = timed[-1][1]
        gap = 0.0
        for world in range(min(worlds, 4)):
            for k in range(every - 1, steps, every):
                mujoco.mj_setState(model, data, states[world, k], spec)
                mujoco.mj_fwdPosition(model, data)
                gap = max(gap, float(-data.contact.dist.min(initial=0.0)))
    except Exception as error:
        return {"error": str(error).splitlines()[0]}
    finally:
        rollout.shutdown_persistent_pool()
    runs = [seconds for seconds, _ in timed]
    return {
        "version": mujoco.__version__,
        "integrator": mujoco.mjtIntegrator(model.opt.integrator).name.removeprefix("mjINT_"),
        "threads": threads, **_rates(float(np.median(runs)), worlds, steps, dt),
        "runs_s": runs, "penetration_m": gap,
    }  # fmt: skip


# --- info ---


def _info(args) -> int:
    import importlib.util

    import jax
    import jax.numpy as jnp

    from . import __version__, examples
    from .method import PRESETS
    from .record import versions

    found = lambda *modules: all(_has(importlib.util.find_spec, m) for m in modules)
    extras = {
        "viz": found("matplotlib"), "mjx": found("mujoco.mjx"),
        "cuda": any(map(found, ("jax_cuda13_plugin", "jax_cuda12_plugin"))), "dev": found("pytest", "ruff"),
    }  # fmt: skip
    info = {
        "rbd_jax": __version__,
        "versions": versions(),
        "backend": jax.default_backend(),
        "devices": [f"{d.id}: {d.device_kind}" for d in jax.devices()],
        "dtype": str(jnp.result_type(float)),
        "cpus": os.cpu_count(),
        "extras": extras,
        "examples": list(examples.names()),
        "presets": {
            name: {"integrator": _label(m.integrator), "contact": _label(m.contact), "solver": _label(m.solver)}
            for name, m in PRESETS.items()
        },
    }
    if args.json:
        print(_json(info, indent=2))
        return OK
    name = lambda text: f"{text:<10}"
    print(name("rbd_jax") + info["rbd_jax"])
    print(name("versions") + ", ".join(f"{k} {v or 'missing'}" for k, v in info["versions"].items()))
    print(name("devices") + f"{', '.join(info['devices'])} ({info['backend']}; {info['cpus']} CPU cores)")
    print(name("dtype") + f"{info['dtype']} (JAX_ENABLE_X64=1 makes it float64)")
    print(name("extras") + ", ".join(f"{k} {'yes' if v else 'no'}" for k, v in extras.items()))
    print(name("examples") + ", ".join(info["examples"]))
    for i, (preset, parts) in enumerate(info["presets"].items()):
        text = ", ".join(f"{k} {v}" for k, v in parts.items() if v)
        print(name("" if i else "presets") + f"{preset:<10}{text}")
    return OK


def _label(part) -> str:
    """Name of a part of a method; one that is None is picked for the scene."""
    return "by scene" if part is None else part if isinstance(part, str) else part.name


def _has(find, module: str) -> bool:
    try:
        return find(module) is not None
    except ModuleNotFoundError:
        return False
