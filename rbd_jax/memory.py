"""Layer 8: how much memory a rollout needs, and whether there is as much."""

from __future__ import annotations

import dataclasses
import math
import pathlib

import jax

from .state import State

#: Results smaller than this are not compared with what the machine has left [bytes].
SMALL = 100_000_000
#: A body's share of a state is less, in float64 [bytes]: what is smaller by this is not measured.
MOST_A_BODY = 256


@dataclasses.dataclass(frozen=True)
class MemoryEstimate:
    """Bytes of a rollout (:func:`rbd_jax.memory_estimate`).

    Attributes:
      arguments: of model and initial state. results: of the final state and the trajectory.
      work: of what the compiled program needs besides, as XLA plans it.
      copies: of the results of several cores, until they are put together.
      peak: of what there is at a time. per_world: the same for one world.
      available: what the device has left, None = unknown.
    """

    arguments: int
    results: int
    work: int
    copies: int
    peak: int
    per_world: float
    available: int | None

    def __str__(self):
        known = ", ".join(f"{k} {readable(getattr(self, k))}" for k in ("arguments", "results", "work", "copies"))
        left = "unknown" if self.available is None else readable(self.available)
        return f"{readable(self.peak)} ({known}), {readable(self.per_world)} a world; available {left}"


def readable(size: float) -> str:
    """Bytes in words."""
    power = min(4, max(0, int(math.log10(max(size, 1)) // 3)))
    return f"{size / 1000**power:.3g} {('bytes', 'kB', 'MB', 'GB', 'TB')[power]}"


def available(devices=()) -> int | None:
    """Bytes that ``devices`` (none: the default one) have left together; None where one does not say."""
    devices = devices or jax.local_devices()[:1]
    if devices[0].platform == "cpu":
        return _of_machine()
    left = [device.memory_stats() or {} for device in devices]
    if not all({"bytes_limit", "bytes_in_use"} <= set(stats) for stats in left):
        return None
    return sum(stats["bytes_limit"] - stats["bytes_in_use"] for stats in left)


def _of_machine(proc=pathlib.Path("/proc/meminfo"), group=pathlib.Path("/sys/fs/cgroup")) -> int | None:
    """What the machine has left, and a container that has a limit of its own."""
    left = []
    try:
        lines = proc.read_text().splitlines()
        left.append(next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable")))
    except (OSError, StopIteration, ValueError):
        pass
    try:
        limit, used = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))
        counts = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        files = int(counts.get("inactive_file", 0))  # copies of files, which the kernel drops when memory is asked for
        left.append(limit - used + files)
    except (OSError, ValueError):
        pass
    return min(left) if left else None


def bytes_of(tree) -> int:
    return sum(math.prod(c.shape) * c.dtype.itemsize for c in jax.tree.leaves(tree))


def refuse(state: State, worlds: int, samples: int, copies: int, devices=()) -> None:
    """Raise where the samples of a rollout cannot fit into ``devices`` together (none: the default one).

    Raises:
      MemoryError: naming what is needed, what there is and what to change.
    """
    if worlds * samples * copies * (state.n + 1) * MOST_A_BODY < SMALL:
        return
    own = math.prod(state.batch_shape)
    each = bytes_of(state._with(memory=None)) // own
    need = worlds * samples * each * copies
    if need < SMALL:
        return
    left = available(devices)
    if left is not None and need > left:
        raise MemoryError(
            f"rollout: {samples:,} samples of {worlds:,} worlds need {readable(need)}, the device has {readable(left)} "
            "left: store fewer samples (every), or go through the worlds in parts"
        )
