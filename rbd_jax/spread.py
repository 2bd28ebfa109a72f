"""Layer 8: a call with a large batch, spread over the cores of a CPU or over several devices.

Only calls that are made, not traced, are spread: within ``jax.jit`` a rollout is part of a program whose place the
user decides. The results are the same to the bit (``tiles``).
"""

from __future__ import annotations

import concurrent.futures
import functools
import math
import os
import typing

import jax
import jax.numpy as jnp
import numpy as np

from .model import Model
from .state import State, Wrench
from .tiles import LANES, alone, filled, flattened, padded, per_world, tiled
from .xla import on_cpu, waits

#: Work of a call for which threads are worth their start (0.6 ms), see ``work``.
LEAST = 240_000

AXIS = "worlds"


class Means(typing.NamedTuple):
    """What a call may use: several devices, or several threads of one CPU; neither for a traced call."""

    devices: tuple = ()
    cores: int = 1


_limit: int | None = None


def use_cores(count: int | None) -> None:
    """Set how many cores of a CPU a rollout of many worlds may use: all (None, the default) or ``count``.

    Raises:
      ValueError: count is not an integer >= 1.
    """
    global _limit
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise ValueError(f"use_cores: count = {count!r} must be an integer >= 1, or None for all")
    _limit = count


def cores() -> int:
    """Cores that a rollout may use."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return count if _limit is None else min(_limit, count)


def means(core, args, batch: tuple[int, ...], steps: int) -> Means:
    """What ``core(*args)`` of so many steps may use; ``args``: arrays or their shapes.

    Several devices are used where JAX has them and the arrays are not committed to one of them.
    """
    use = _allowed(args, math.prod(batch), steps)
    if use != Means() and on_cpu() and _waits(core, args, tuple(batch), use):
        return Means()
    return use


_waiting: dict = {}


def _key(core, args):
    leaves, tree = jax.tree.flatten(args)
    return core, tree, tuple((jnp.shape(c), c.dtype) for c in leaves)


def _waits(core, args, batch, use: Means) -> bool:
    key = _key(core, args), batch, use
    if key not in _waiting:  # the trace is kept for the call
        if use.devices:
            traced = _sharded.trace(core, *args, _mesh(use.devices), batch)
        else:
            traced = _share.trace(core, *args, np.int32(0), batch, use.cores)
        _waiting[key] = waits(traced.jaxpr.jaxpr)
    return _waiting[key]


def any_traced(args) -> bool:
    """Whether a call with these arguments is traced rather than made."""
    return any(issubclass(kind, jax.core.Tracer) for kind in set(map(type, jax.tree.leaves(args))))


#: JAX's tracers of derivatives; it does not export all of them. An unknown one costs time to trace, no more.
CHANGING = ("JVPTracer", "LinearizeTracer")


def first_changing(args) -> int | None:
    """Number of the first leaf of which a derivative is being taken by the innermost transformation; None: of none."""
    leaves = jax.tree.leaves(args)
    kinds = {kind for kind in set(map(type, leaves)) if kind.__name__ in CHANGING}
    return next((i for i, c in enumerate(leaves) if type(c) in kinds and c.size), None)


def _allowed(args, worlds: int, steps: int) -> Means:
    few = 1 if alone(args[0]) else LANES
    if worlds <= few or worlds * work(args, steps) < LEAST or jax.config.jax_disable_jit:
        return Means()
    if any_traced(args):
        return Means()
    arrays = [c for c in jax.tree.leaves(args) if isinstance(c, jax.Array)]
    where = {c.sharding for c in arrays if c.committed}
    devices = jax.local_devices()
    if len(devices) > 1 and jax.process_count() == 1 and all(len(s.device_set) == len(devices) for s in where):
        return Means(devices=tuple(devices))
    if on_cpu() and all(s.num_devices == 1 for s in where):
        return Means(cores=cores())
    return Means()


def work(args, steps: int) -> int:
    """Bodies (5 ns each) and points of contact, touching or not (five times that), that a world goes through."""
    model = args[0]
    substeps = model.method.substeps or int(args[3]["substeps"])
    points = sum(g.slots * (g.capacity or len(g.a)) for g in model.structure.groups)
    return steps * substeps * (model.n + 5 * points)


# --- threads ---


@functools.cache
def _pool(count: int) -> concurrent.futures.ThreadPoolExecutor:
    return concurrent.futures.ThreadPoolExecutor(count, thread_name_prefix="rbd_jax")


@functools.partial(jax.jit, static_argnums=(0, 6, 7))
def _share(core, model, state, wrench, counts, first, batch, parts):
    return tiled(core, model, state, wrench, counts, batch, first, parts)


@functools.partial(jax.jit, static_argnums=(1,))
def _joined(parts, batch):
    size = math.prod(batch)
    return jax.tree.map(lambda *c: jnp.concatenate(c)[:size].reshape(*batch, *c[0].shape[1:]), *parts)


def lowered_share(core, model, state, wrench, counts, batch, parts: int):
    """The program of one of ``parts`` shares, lowered; model and state may be shapes."""
    return _share.lower(core, model, state, wrench, counts, np.int32(0), batch, parts)


_compiled: set = set()


def over_cores(core, count: int, model: Model, state: State, wrench: Wrench | None, counts, batch: tuple[int, ...]):
    """``core(model, state, wrench, counts)``, a share of the batch on each of ``count`` threads, one the caller's."""
    wide, device = jax.config.jax_enable_x64, jax.config.jax_default_device

    def part(first):
        run = lambda: jax.block_until_ready(_share(core, model, state, wrench, counts, first, batch, count))
        if (wide, device) == (jax.config.jax_enable_x64, jax.config.jax_default_device):
            return run()
        with jax.enable_x64(wide), jax.default_device(device):  # settings of a context belong to its thread
            return run()

    numbers = [np.int32(k) for k in range(count)]
    key = (_key(core, (model, state, wrench, counts)), batch, count, wide)
    out = []
    if key not in _compiled:  # else every thread would compile the same program
        out.append(part(numbers.pop(0)))
        _compiled.add(key)
    others = [_pool(count).submit(part, k) for k in numbers[1:]]
    out += [part(k) for k in numbers[:1]]  # a thread that only waits is a core that is woken late
    out += [f.result() for f in others]
    return _joined(tuple(out), batch)


# --- devices ---


def _shard(core, model, state, wrench, counts, mesh, batch):
    size = math.prod(batch)
    args = flattened(model, state, wrench, batch)
    varies = per_world(*args)
    whole = padded(size, mesh.size)
    args = jax.tree.map(lambda c, own: filled(c, whole) if own else c, args, varies)
    split, same = jax.sharding.PartitionSpec(AXIS), jax.sharding.PartitionSpec()
    specs = *jax.tree.map(lambda own: split if own else same, varies), same
    run = lambda *args: tiled(core, *args, (whole // mesh.size,))
    out = jax.shard_map(run, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)(*args, counts)
    return jax.tree.map(lambda c: c[:size].reshape(*batch, *c.shape[1:]), out)


_sharded = jax.jit(_shard, static_argnums=(0, 5, 6))
_sharded_donated = jax.jit(_shard, static_argnums=(0, 5, 6), donate_argnums=(2,))


def over_devices(core, devices, model: Model, state: State, wrench: Wrench | None, counts, batch, donate: bool):
    """``core(model, state, wrench, counts)`` with the batch sharded over ``devices``."""
    call = _sharded_donated if donate else _sharded
    return call(core, model, state, wrench, counts, _mesh(devices), tuple(batch))


def _mesh(devices):
    return jax.sharding.Mesh(np.array(devices), (AXIS,))
