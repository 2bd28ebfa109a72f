"""Layer 4: narrow waists, where a value is computed once and read by several outputs.

XLA's CPU backend makes one kernel per output and recomputes the shared producers in each; only an
operation that it deems expensive, a division by a run-time value among them, is never duplicated.
"""

from __future__ import annotations

import jax


def waist(tree, one):
    """The tree divided by 1 + 0 x leaf: the same finite values, computed once.

    one: 1, or None to leave the tree as it is. An array of ones as the divisor would do only if it
      had the full shape of the leaf: XLA turns division by a broadcast array into a multiplication
      by its reciprocal, which is duplicated again. It does not fold 0 x leaf (NaN would be lost).
    """
    if one is None:
        return tree
    return jax.tree.map(lambda leaf: leaf / jax.lax.stop_gradient(one + 0.0 * leaf), tree)
