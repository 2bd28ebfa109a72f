"""Layer 1: the one trick that XLA's CPU backend needs.

XLA's CPU backend emits one kernel per output and re-evaluates shared producers in each of them;
``optimization_barrier`` does not stop that, but an operation that XLA takes for expensive and that
has several users is never duplicated. A division by one, where the one is an array whose value XLA
cannot know, costs next to nothing and leaves a finite value bit for bit (measured on a pair update with
twelve outputs: 2.9 ns instead of 12).
"""

from __future__ import annotations

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
