"""Layer 1: what the program must know of XLA's CPU backend.

XLA's CPU backend emits one kernel per output and re-evaluates shared producers in each of them;
``optimization_barrier`` does not stop that, but an operation that XLA takes for expensive and that
has several users is never duplicated. A division by one, where the one is an array whose value XLA
cannot know, costs next to nothing and leaves a finite value bit for bit (measured on a pair update with
twelve outputs: 2.9 ns instead of 12).
"""

from __future__ import annotations

import contextlib
import contextvars
import functools

import jax
import jax.numpy as jnp


def opaque_one(x: jax.Array) -> jax.Array:
    """A scalar 1 of x's dtype that the compiler cannot fold; x is any finite traced scalar."""
    return jnp.exp(jax.lax.stop_gradient(x).ravel()[0] * 0)


def materialise(tree, one: jax.Array | float | None = 1.0):
    """The same values, computed once however many kernels use them (an infinite value becomes NaN).

    ``one`` None leaves the fusion to XLA.

    The divisor has the leaf's own shape: XLA turns a division by a broadcast array into a product with
    its reciprocal, which it duplicates again.
    """
    if one is None:
        return tree
    return jax.tree.map(lambda x: x / jax.lax.stop_gradient(one + 0.0 * x), tree)


def materialise_linear(tree, like: jax.Array, one):
    """``materialise`` in a way that JAX sees is linear: the divisors are made of ``like``, of the leaves' shape."""
    unit = jax.lax.stop_gradient(one + 0.0 * like)
    return jax.tree.map(lambda x: x / unit, tree)


_single = contextvars.ContextVar("single", default=False)


def in_one_function() -> bool:
    """Whether what is being traced is to become one function of the CPU (``tiles``).

    There a loop over rows costs nothing but its arithmetic and may end early, and scatters do not exist; elsewhere
    every operation of a loop's body is a kernel that is started anew each time.
    """
    return _single.get()


@contextlib.contextmanager
def one_function(wanted: bool = True):
    """Trace what follows for one function."""
    token = _single.set(wanted)
    try:
        yield
    finally:
        _single.reset(token)


#: Longer axes are gone through in a loop.
UNROLL = 16


def _folded(f, c: jax.Array, axis: int) -> jax.Array:
    """``c`` reduced over an axis; XLA's own reductions have no place in one function."""
    if c.shape[axis] <= UNROLL:
        parts = [jax.lax.index_in_dim(c, k, axis, keepdims=False) for k in range(c.shape[axis])]
        return functools.reduce(f, parts)
    at = lambda k: jax.lax.dynamic_index_in_dim(c, k, axis, keepdims=False)
    return jax.lax.fori_loop(1, c.shape[axis], lambda k, a: f(a, at(k)), at(0))


def summed(c: jax.Array, axis: int = 0) -> jax.Array:
    """The sum of ``c`` over one axis."""
    return _folded(jnp.add, c, axis) if in_one_function() and c.shape[axis] else c.sum(axis=axis)


def largest(c: jax.Array, axis: int = 0) -> jax.Array:
    """The largest of ``c`` along one axis."""
    return _folded(jnp.maximum, c, axis) if in_one_function() else c.max(axis=axis)
