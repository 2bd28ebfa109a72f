"""Layer 9: rollouts that take hours: progress, checkpoints, resumption, samples that are written as they come.

A loop on the host over compiled chunks. Nothing is called back from inside a program, so a chunk is the rollout that
it would be by itself, and a run that was cut short goes on with the same bits.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from .checks import whole
from .model import Model, batch_of
from .record import seconds, versions, whole_or_not_at_all
from .rollout import rollout
from .state import State
from .status import Status
from .step import with_memory

FORMAT = 1
#: A run is cut into about so many chunks, of at most so many steps.
CHUNKS, LONGEST = 100, 4096
FIELDS = ("pos", "vel", "quat", "omega")


@dataclasses.dataclass(frozen=True)
class Progress:
    """steps of total are done; simulated: seconds of one world; rate: steps of all worlds per wall second in this
    session; left: wall seconds to go at that rate."""

    steps: int
    total: int
    simulated: float
    rate: float
    left: float

    def __str__(self):
        left = time.strftime("%H:%M:%S", time.gmtime(self.left))
        return (
            f"{self.steps}/{self.total} steps, {self.simulated:.4g} s simulated, {self.rate:.3g} world-steps/s, "
            f"{left} left"
        )


@dataclasses.dataclass(frozen=True)
class Diverged:
    """A world that was lost: its place among the batch axes, when [s], and the last state that was finite."""

    world: tuple[int, ...]
    time: float
    state: State

    def __str__(self):
        return f"world {self.world}: not finite after {self.time:.6g} s"


@dataclasses.dataclass(frozen=True)
class LongRun:
    """What became of it: ``final`` is the state after ``steps`` steps, ``interrupted`` whether Ctrl-C ended it."""

    final: State
    steps: int
    interrupted: bool
    diverged: tuple[Diverged, ...]


class SaveFailed(OSError):
    """A checkpoint or a sample could not be written; ``state`` is that of ``steps`` steps, which nothing else holds."""

    def __init__(self, message: str, state: State, steps: int):
        super().__init__(message)
        self.state, self.steps = state, steps


def long_rollout(
    model: Model,
    state: State,
    steps: int,
    every: int = 1,
    control=None,
    checkpoint: str | os.PathLike[str] | None = None,
    save_every: float = 60.0,
    stream: str | os.PathLike[str] | None = None,
    chunk: int | None = None,
    report: Callable[[Progress | Diverged], None] | None = None,
) -> LongRun:
    """``rollout`` for hours.

    Args:
      model, state, steps, control: as for :func:`rbd_jax.rollout`. A run that is resumed must be given the same.
      every: steps between two samples of ``stream``.
      checkpoint: a file. If it is there, the run goes on from it; else it is made: every ``save_every`` wall seconds,
        at the end, and when Ctrl-C is pressed. It is written beside itself and renamed: there is always a whole one.
      stream: a folder, in which zarr (``pip install 'rbd-jax[stream]'``) keeps the samples: arrays ``pos, vel, quat,
        omega`` (batch..., samples, n, 3 | 4), ``step, status, time`` (batch..., samples), the first being the start.
        Without it no samples are kept.
      chunk: steps of one compiled call, a multiple of ``every``; None: about a hundredth of the run.
      report: is told of the progress after every chunk, and of every world that is lost.

    Ctrl-C ends the run after the chunk that runs, saved; a second one at once.

    Raises:
      ValueError: a checkpoint of another scene, method, dtype, batch, ``steps``, ``every`` or newer format, or no
        checkpoint at all; a stream that does not belong to it; arguments as for ``rollout``.
      SaveFailed: a file cannot be written (a full disk); the last whole checkpoint stays, and the error has the state.
    """
    for name, value, least in (("steps", steps, 0), ("every", every, 1), ("chunk", chunk, 1)):
        if not whole(value, least) and not (name == "chunk" and value is None):
            raise ValueError(f"long_rollout: {name} = {value!r} must be an integer >= {least}")
    if chunk is not None and chunk % every:
        raise ValueError(f"long_rollout: chunk = {chunk} must be a multiple of every = {every}")
    if chunk is None:
        chunk = max(1, min(math.ceil(steps / CHUNKS), LONGEST) // every) * every
    batch = batch_of(model, state.batch_shape)
    if batch != state.batch_shape:
        raise ValueError(f"long_rollout: the model makes worlds {batch}, the state has {state.batch_shape}: batch it")
    state = with_memory(model, state)
    what = {"scene": _digest(model), "dtype": str(model.mass.dtype), "batch": list(batch), "steps": int(steps),
            "every": int(every)}  # fmt: skip
    done, saved = 0, None
    if checkpoint is not None and os.path.exists(checkpoint):
        state, saved = load_checkpoint(checkpoint, state)
        for name, value in what.items():
            if saved[name] != value:
                raise ValueError(
                    f"{os.fspath(checkpoint)}: of another run: its {name} is {saved[name]!r}, this one's {value!r}"
                )
        done, chunk = saved["done"], saved["chunk"]
    what["chunk"] = int(chunk)
    samples = None if stream is None else _Stream(stream, model, state, steps, every, chunk, saved)
    lost = _lost(state)
    found = [] if saved is None else _diverged(state, lost, np.zeros_like(lost))
    begin = saved_at = time.perf_counter()
    first = done

    def save():
        if checkpoint is not None:
            try:
                save_checkpoint(checkpoint, state, {**what, "done": done})
            except OSError as error:
                raise SaveFailed(f"{os.fspath(checkpoint)}: {error}; step {done} is not saved", state, done) from error

    with _interruptible() as interrupted:
        while done < steps and not interrupted.is_set():
            count = min(chunk, steps - done)
            after, traj = rollout(model, state, count, every=every if samples else count, control=control)
            jax.block_until_ready(after)
            if samples:
                last = traj._with(memory=None)
                try:
                    samples.write(done // every, last, whole=count % every == 0)
                except OSError as error:
                    raise SaveFailed(f"{os.fspath(stream)}: {error}; step {done} is not saved", state, done) from error
            state, done = after, done + count
            now = time.perf_counter()
            if report is not None:
                worlds = math.prod(batch)
                rate = (done - first) * worlds / (now - begin)
                left = (steps - done) * worlds / rate
                report(Progress(done, int(steps), done * float(np.max(np.asarray(model.dt))), rate, left))
            gone = _lost(state)
            fresh = _diverged(state, gone, lost)
            lost = gone
            found += fresh
            for world in fresh if report is not None else ():
                report(world)
            if now - saved_at >= save_every and done < steps:
                save()
                saved_at = time.perf_counter()
        if samples and done == steps and steps % every == 0:
            samples.last(steps // every, state)
        save()
        return LongRun(state, done, interrupted.is_set(), tuple(found))


# --- checkpoints ---


def _digest(model: Model) -> str:
    """Of all that decides what a run does: structure, method and numbers."""
    seen = hashlib.sha256(model.structure._digest)
    seen.update(repr(model.method).encode())
    for leaf in jax.tree.leaves(model):
        leaf = np.asarray(leaf)
        seen.update(f"{leaf.dtype}{leaf.shape}".encode() + np.ascontiguousarray(leaf).tobytes())
    return seen.hexdigest()


def save_checkpoint(path: str | os.PathLike[str], state: State, notes: dict[str, Any]) -> None:
    """Write every leaf of ``state`` and the notes to one file, whole or not at all."""
    from . import __version__

    header = {"format": FORMAT, "kind": "checkpoint", "rbd_jax": __version__, "versions": versions(), **notes}
    leaves = {f"leaf{k}": np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(state))}
    with whole_or_not_at_all(path) as file:
        np.savez(file, header=np.array(json.dumps(header)), **leaves)


def load_checkpoint(path: str | os.PathLike[str], like: State) -> tuple[State, dict[str, Any]]:
    """(state, header) of a checkpoint of worlds like ``like``.

    Raises:
      OSError: it cannot be read. ValueError: it is no checkpoint, of a newer format, or of other worlds.
    """
    name = os.fspath(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            content = dict(file)
        header = json.loads(str(content.pop("header")))
        good = header["kind"] == "checkpoint"
    except OSError:
        raise
    except Exception as error:
        raise ValueError(f"{name}: not a checkpoint of rbd_jax ({type(error).__name__})") from None
    if not good:
        raise ValueError(f"{name}: not a checkpoint of rbd_jax")
    if header["format"] > FORMAT:
        raise ValueError(f"{name}: format {header['format']} is newer than this rbd_jax reads ({FORMAT})")
    leaves, tree = jax.tree.flatten(like)
    kept = [content.get(f"leaf{k}") for k in range(len(leaves))]
    if len(content) != len(leaves) or any(
        c is None or c.shape != np.shape(l) or c.dtype != l.dtype for c, l in zip(kept, leaves)
    ):
        raise ValueError(f"{name}: of another scene, method, batch or dtype: its arrays do not fit this state")
    return jax.tree.unflatten(tree, [jax.numpy.asarray(c) for c in kept]), header


# --- samples ---


class _Stream:
    """Samples in zarr arrays whose chunks are those of the run: a chunk is written whole, or again after a crash."""

    def __init__(self, path, model: Model, state: State, steps: int, every: int, chunk: int, saved):
        try:
            import zarr
        except ModuleNotFoundError:
            raise ValueError("long_rollout: stream needs zarr: pip install 'rbd-jax[stream]'") from None
        name = os.fspath(path)
        self.axis, count = len(state.batch_shape), steps // every + 1
        piece = max(chunk // every, 1)
        if saved is None and os.path.isdir(path) and os.listdir(path):
            raise ValueError(f"{name}: is there already and belongs to no checkpoint; take another folder")
        if saved is None:
            group = zarr.open_group(name, mode="w")
            group.attrs.update(
                {"rbd_jax": versions(), "bodies": list(model.names.bodies), "every": every, "steps": steps,
                 "dt": np.asarray(model.dt).astype(str).astype(float).tolist()}
            )  # fmt: skip
            first = state._with(memory=None)
            for field, value in self._arrays(first).items():
                value = np.expand_dims(value, self.axis)
                shape = (*value.shape[: self.axis], count, *value.shape[self.axis + 1 :])
                chunks = (*value.shape[: self.axis], min(piece, count), *value.shape[self.axis + 1 :])
                group.create_array(field, shape=shape, chunks=chunks, dtype=value.dtype)
        else:
            try:
                group = zarr.open_group(name, mode="r+")
            except Exception as error:
                raise ValueError(f"{name}: the stream of the checkpoint cannot be opened: {error}") from None
            if group["step"].shape != (*state.batch_shape, count):
                raise ValueError(f"{name}: of another run: {group['step'].shape} samples")
        self.group = group

    def _arrays(self, state: State) -> dict[str, np.ndarray]:
        arrays = {f: np.asarray(getattr(state, f)) for f in FIELDS}
        for f in ("step", "status"):
            arrays[f] = np.broadcast_to(np.asarray(getattr(state, f)), state.batch_shape)
        arrays["time"] = np.broadcast_to(seconds(state.step, state.dt), state.batch_shape)
        if state.kinematic is not None:
            arrays |= {f"kinematic_{f}": np.asarray(getattr(state, f"kinematic_{f}")) for f in FIELDS}
        return arrays

    def write(self, first: int, traj: State, whole: bool) -> None:
        """The samples of a chunk from number ``first`` on; the last of a whole one is the first of the next."""
        count = traj.batch_shape[-1] - whole
        before = (slice(None),) * self.axis
        for field, value in self._arrays(traj).items():
            self.group[field][(*before, slice(first, first + count))] = value[(*before, slice(0, count))]

    def last(self, number: int, state: State) -> None:
        before = (slice(None),) * self.axis
        for field, value in self._arrays(state._with(memory=None)).items():
            self.group[field][(*before, number)] = value


# --- worlds that are lost, Ctrl-C ---


def _lost(state: State) -> np.ndarray:
    return (np.asarray(state.status) & int(Status.NOT_FINITE)) != 0


def _diverged(state: State, lost: np.ndarray, before: np.ndarray) -> list[Diverged]:
    """Worlds that are lost and were not before; a lost world is held at its last finite state."""
    found = []
    lost, before = (np.broadcast_to(c, state.batch_shape) for c in (lost, before))
    clock = np.broadcast_to(seconds(state.step, state.dt), state.batch_shape)
    for world in map(tuple, np.argwhere(lost & ~before)):
        place = tuple(int(k) for k in world)
        depth = len(place)
        own = jax.tree.map(lambda c: c[place] if np.ndim(c) >= depth else c, state._with(memory=None))
        found.append(Diverged(place, float(clock[place]), own))
    return found


@contextlib.contextmanager
def _interruptible():
    """A flag that the first Ctrl-C raises; the second is a KeyboardInterrupt. In the main thread only."""
    flag = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    before = signal.getsignal(signal.SIGINT)

    def note(number, frame):
        if flag.is_set():
            raise KeyboardInterrupt
        flag.set()

    signal.signal(signal.SIGINT, note)
    try:
        yield flag
    finally:
        signal.signal(signal.SIGINT, before)
