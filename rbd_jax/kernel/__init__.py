"""Layer 2: a program over worlds as one kernel of a GPU, in which every thread runs one world.

XLA starts a kernel for every few operations of a step, a few microseconds each, and every one of them reads and writes
the state of all worlds. Here the whole loop over steps is one kernel: what JAX traced for one world, with loops that
end early, is written as a function of C (``emit``), compiled by NVRTC (``nvrtc``) and put into XLA's program as a call.

Forward only. Where an operation has no place in such a function, or there is no NVRTC, XLA's own kernels are used.
"""

from __future__ import annotations

import contextlib
import contextvars
import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np

from ..xla import lean, on_gpu, traced_for_a_thread
from .emit import Leaf, source
from .flat import Unsupported, flatten
from .nvrtc import CompileError, ptx

_forward = contextvars.ContextVar("forward", default=False)
#: XLA's call of a kernel that is given as PTX.
TARGET = "__gpu$xla.gpu.ptx"
NAME = "rbd_worlds"
#: Threads of a block, and of one where there would be fewer blocks than a GPU can run at once.
BLOCK, SMALL_BLOCK, MANY_BLOCKS = 64, 32, 1024


@contextlib.contextmanager
def forward():
    """What is traced within is not differentiated: ``by_thread`` may make kernels of it."""
    token = _forward.set(True)
    try:
        yield
    finally:
        _forward.reset(token)


def by_thread(run, worlds: int):
    """``run(*args)`` of as many worlds, each by a thread of its own where that can be; elsewhere ``run`` itself.

    All leaves of ``args`` have an axis of worlds at the end, or one element there (or none) for what they share; those
    of the results have it. What becomes of a world must not depend on the others.
    """

    def call(*args):
        if not (_forward.get() and on_gpu()):
            return run(*args)
        try:
            text, used, shape = program(run, worlds, *args)
            code = ptx(text, _capability())
        except (Unsupported, CompileError) as reason:
            warnings.warn(f"these steps are not one kernel of the GPU, and slower: {reason}", stacklevel=2)
            return run(*args)
        leaves = [jnp.asarray(c) for c, u in zip(jax.tree.leaves(args), used, strict=True) if u]
        results = [jax.ShapeDtypeStruct((*c.shape[:-1], worlds), c.dtype) for c in jax.tree.leaves(shape)]
        return jax.tree.structure(shape).unflatten(launched(code, worlds, leaves, results))

    return call


def program(run, worlds: int, *args):
    """(text, used, shape): the C of ``run`` for one world, which leaves of ``args`` it takes, and its results.

    Raises:
      Unsupported: it has no place in one kernel.
    """
    leaves, tree = jax.tree.flatten(args)
    own = [bool(jnp.ndim(c)) and jnp.shape(c)[-1] == worlds for c in leaves]
    one = [jax.ShapeDtypeStruct((*jnp.shape(c)[:-1], 1) if o else jnp.shape(c), c.dtype) for c, o in zip(leaves, own)]
    with traced_for_a_thread():
        traced, shape = jax.make_jaxpr(run, return_shape=True)(*tree.unflatten(one))
    if any(isinstance(c, jax.core.Tracer) for c in traced.consts):
        raise Unsupported("it closes over a traced value")
    short, used = lean(traced.jaxpr)
    arguments = [Leaf(math.prod(c.shape), c.dtype.name, o) for c, o, u in zip(one, own, used, strict=True) if u]
    results = [Leaf(math.prod(c.shape), c.dtype.name, True) for c in jax.tree.leaves(shape)]
    return source(flatten(short, traced.consts), arguments, results, NAME), used, shape


def launched(code: str, worlds: int, leaves, results):
    """The results of a kernel given as PTX."""
    block = SMALL_BLOCK if worlds < BLOCK * MANY_BLOCKS else BLOCK
    whole = dict(grid_x=-(-worlds // block), grid_y=1, grid_z=1, block_x=block, block_y=1, block_z=1)
    attributes = {k: np.int32(v) for k, v in whole.items()} | {"shared_mem_bytes": np.int32(0)}
    call = jax.ffi.ffi_call(TARGET, results)
    return call(
        jnp.full((1,), worlds, jnp.int32), *leaves, name=NAME, kernel_type="ptx", kernel_data=code, **attributes
    )


def _capability() -> str:
    return jax.devices()[0].compute_capability
