"""Layer 2: a program over worlds as one kernel of a GPU, in which every thread runs one world.

XLA starts a kernel for every few operations of a step, a few microseconds each, and every one of them reads and writes
the state of all worlds. Here the whole loop over steps is one kernel: what JAX traced for one world, with loops that
end early, is written as a function of C (``emit``), compiled by NVRTC (``nvrtc``) and put into XLA's program as a call.

Forward only. Where an operation has no place in such a function, or there is no NVRTC, XLA's own kernels are used.
"""

from __future__ import annotations

import contextlib
import contextvars
import functools
import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np

from ..loops import repeat
from ..xla import lean, on_gpu, traced_for_a_thread
from .emit import Leaf, source
from .flat import Op, Unsupported, flatten
from .nvrtc import CompileError, ptx

_forward = contextvars.ContextVar("forward", default=False)
#: XLA's call of a kernel that is given as PTX.
TARGET = "__gpu$xla.gpu.ptx"
NAME = "rbd_worlds"
#: Threads of a block, and of one where there would be fewer blocks than a GPU can run at once.
BLOCK, SMALL_BLOCK, MANY_BLOCKS = 64, 32, 1024
#: Threads whose arrays are in a buffer: one after the other, each runs the worlds that are left.
MOST_THREADS = 32_768


@contextlib.contextmanager
def forward():
    """What is traced within is not differentiated: ``repeated`` may make kernels of it."""
    token = _forward.set(True)
    try:
        yield
    finally:
        _forward.reset(token)


def repeated(run, world, *given, worlds: int, count: int | jax.Array):
    """``world = run(world, *given)``, ``count`` times, of as many worlds; a traced count is not to be differentiated.

    All leaves of ``world`` have an axis of worlds at the end, those of ``given`` too or one element there (or no axis)
    for what the worlds share. What becomes of a world must not depend on the others: where that can be, each is a
    thread of a kernel of its own. The number of steps is no part of that kernel's code, nor is that of the worlds;
    the same function ``run`` has the same kernel.
    """
    if _forward.get() and on_gpu():
        try:
            return launched(_many(run), worlds, jnp.full((1,), count, jnp.int32), world, *given)
        except (Unsupported, CompileError) as reason:
            warnings.warn(f"these steps are not one kernel of the GPU, and slower: {reason}", stacklevel=2)
    if not isinstance(count, int):
        return repeat(0, count, lambda _, world: run(world, *given), world)
    if count == 1:
        return run(world, *given)
    return jax.lax.scan(lambda world, _: (run(world, *given), None), world, None, length=count)[0]


def program(run, worlds: int, *args):
    """(source, used, shape): the C of ``run`` for one world, which leaves of ``args`` it takes, and its results.

    One program for every number of worlds, as long as ``run`` is the same function.

    Raises:
      Unsupported: it has no place in one kernel.
    """
    return _program(run, *_of_one(worlds, args))


@functools.lru_cache(maxsize=64)
def _program(run, tree, one, own):
    flat, used, shape = _traced(run, tree, one)
    arguments = [Leaf(math.prod(c.shape), c.dtype.name, o) for c, o, u in zip(one, own, used, strict=True) if u]
    results = [Leaf(math.prod(c.shape), c.dtype.name, True) for c in jax.tree.leaves(shape)]
    return source(flat, arguments, results, NAME), used, shape


def operations(run, worlds: int, *args) -> list[Op]:
    """What ``run`` does for one world, operation by operation."""
    tree, one, _ = _of_one(worlds, args)
    return _traced(run, tree, one)[0].ops


def _of_one(worlds: int, args):
    """The arguments of one world: their tree, shapes, and which of them every world has for itself."""
    leaves, tree = jax.tree.flatten(args)
    own = tuple(bool(jnp.ndim(c)) and jnp.shape(c)[-1] == worlds for c in leaves)
    shape = lambda c, o: (*jnp.shape(c)[:-1], 1) if o else jnp.shape(c)
    one = tuple(jax.ShapeDtypeStruct(shape(c, o), jnp.result_type(c)) for c, o in zip(leaves, own))
    return tree, one, own


def _traced(run, tree, one):
    with traced_for_a_thread():
        traced, shape = jax.make_jaxpr(run, return_shape=True)(*tree.unflatten(one))
    if any(isinstance(c, jax.core.Tracer) for c in traced.consts):
        raise Unsupported("it closes over a traced value")
    short, used = lean(traced.jaxpr)
    return flatten(short, traced.consts), used, shape


@functools.lru_cache(maxsize=64)
def _many(run):
    """``world = run(world, *given)``, ``n[0]`` times."""
    return lambda n, world, *given: repeat(0, n[0], lambda _, world: run(world, *given), world)


def launched(run, worlds: int, *args):
    """``run(*args)`` as one kernel.

    Raises:
      Unsupported, CompileError: it cannot be.
    """
    made, used, shape = program(run, worlds, *args)
    code = ptx(made.text, capability())
    leaves = [jnp.asarray(c) for c, u in zip(jax.tree.leaves(args), used, strict=True) if u]
    results = [jax.ShapeDtypeStruct((*c.shape[:-1], worlds), c.dtype) for c in jax.tree.leaves(shape)]
    block = SMALL_BLOCK if worlds < BLOCK * MANY_BLOCKS else BLOCK
    blocks = -(-worlds // block)
    if made.pools:
        blocks = min(blocks, MOST_THREADS // block)
        results += [jax.ShapeDtypeStruct((blocks * block * size,), dtype) for dtype, size in made.pools]
    shapes = dict(grid_x=blocks, grid_y=1, grid_z=1, block_x=block, block_y=1, block_z=1)
    numbers = {k: np.int32(v) for k, v in (shapes | {"shared_mem_bytes": 0}).items()}
    call = jax.ffi.ffi_call(TARGET, results)
    out = call(jnp.full((1,), worlds, jnp.int32), *leaves, name=NAME, kernel_type="ptx", kernel_data=code, **numbers)
    kind = jax.tree.structure(shape)
    return kind.unflatten(out[: kind.num_leaves])


def capability() -> str:
    """Compute capability of the GPU, "9.0" for instance."""
    return jax.devices()[0].compute_capability
