"""Layer 5: solve a symmetric system of small blocks of which few are filled, in loops over those.

H = L D L' with one block row a body, for all worlds of a tile at once: a block is left out where it is zero in every
world. Written for programs that are one function of the CPU, where a loop costs nothing but its arithmetic.

A block is one array, its m columns (6, or 3 without attitude) in front of its m rows: entry by entry, the program would
take many times as long to compile.
Cost: m^3 multiply-adds a world and full block that meets a full block.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..loops import only_if, read, repeat, write
from ..struct import struct
from ..xla import materialise
from .matrices import across


@struct
class Blocks:
    """H and the right-hand side b, of n bodies in B worlds.

    diagonal: blocks (n, m columns, m rows, B), of which the entries on and below the diagonal count. below: the blocks
    (i, j), i > j, at ``place(i, j)``, (n (n - 1) / 2, m, m, B); None where no two bodies are coupled. filled: which of
    them are not zero in every world, int32; what the others hold is of no account. b: (n, m, B).
    """

    diagonal: jax.Array
    b: jax.Array
    below: jax.Array | None = None
    filled: jax.Array | None = None


def place(i, j):
    """Number of the block (i, j), i > j."""
    return i * (i - 1) // 2 + j


def put(h: Blocks, at, block, column: int = 0, row: int = 0) -> Blocks:
    """H with ``block`` added to the one at ``at``, from this column and row on."""
    where = (at, jnp.int32(column), jnp.int32(row), jnp.int32(0))
    old = jax.lax.dynamic_slice(h.below, where, block.shape, allow_negative_indices=False)
    new = jnp.where(h.filled[at] > 0, old, 0.0) + block
    return h._with(below=jax.lax.dynamic_update_slice(h.below, new, where, allow_negative_indices=False))


def fill(h: Blocks, at) -> Blocks:
    """H in which the block at ``at`` counts from now on."""
    return h._with(filled=write(h.filled, at, jnp.ones(1, jnp.int32)))


def solve(h: Blocks, one) -> jax.Array:
    """x = H^-1 b, (n, m, B)."""
    n = h.b.shape[0]
    h = repeat(0, n, lambda k, h: _eliminate(h, k, n, one), h)
    return repeat(0, n, lambda k, x: _back(h, x, n - 1 - k, n, one), h.b)


def entry(c, r: int):
    """Entry r of a column (1, m, B), (1, 1, B)."""
    return jax.lax.slice_in_dim(c, r, r + 1, axis=1)


def _column(block, j: int):
    return jax.lax.index_in_dim(block, j, 1, keepdims=False)


def _outer(left, d, right):
    """left diag(d) right' of columns left, right and the diagonal d, lists of (1, m, B)."""
    return sum(across(d_ * r) * l[:, None] for l, d_, r in zip(left, d, right))


def _eliminate(h: Blocks, k, n: int, one) -> Blocks:
    """Column k: D_k becomes its factors (d on the diagonal), b_k becomes L_k^-1 b_k, the blocks below it those of L."""
    m = h.b.shape[1]
    y, own = read((h.b, h.diagonal), k)
    number = np.arange(m).reshape(1, m, 1)
    low, d, inverse, kept = [], [], [], []
    for j in range(m):
        column = materialise(_column(own, j) - sum(low[c] * (d[c] * entry(low[c], j)) for c in range(j)), one)
        d.append(entry(column, j))
        inverse.append(materialise(1.0 / d[j], one))
        low.append(materialise(jnp.where(number > j, column, 0.0) * inverse[j], one))
        if j < m - 1:
            y = materialise(y - low[j] * entry(y, j), one)
        kept.append(jnp.where(number == j, d[j], low[j])[:, None])
    h = h._with(diagonal=write(h.diagonal, k, jnp.concatenate(kept, axis=1)), b=write(h.b, k, y))
    if h.below is None:
        return h
    scaled = materialise([low[c] * d[c] for c in range(m - 1)], one)

    def panel(i, h):
        """L_ik = H_ik L_k'^-1 D_k^-1, and what it takes from D_i and b_i."""
        e = materialise(read(h.below, place(i, k)), one)
        left = []
        for j in range(m):
            less = sum(left[c] * entry(scaled[c], j) for c in range(j))
            left.append(materialise((_column(e, j) - less) * inverse[j], one))
        own, rest = read((h.diagonal, h.b), i)
        own = own - _outer(left, d, left)
        rest = rest - sum(left[c] * entry(y, c) for c in range(m))
        diagonal, b = write((h.diagonal, h.b), i, (own, rest))
        below = h.below
        for j in range(m):
            at = (place(i, k), jnp.int32(j), jnp.int32(0), jnp.int32(0))
            below = jax.lax.dynamic_update_slice(below, left[j][:, None], at, allow_negative_indices=False)
        return h._with(below=below, diagonal=diagonal, b=b)

    def update(i, j, h):
        """H_ij -= L_ik D_k L_jk'."""
        left, right = materialise(tuple(read(h.below, place(row, k)) for row in (i, j)), one)
        columns = lambda block: [_column(block, c) for c in range(m)]
        at = place(i, j)
        return fill(put(h, at, -_outer(columns(left), d, columns(right))), at)

    def row(i, h):
        others = lambda j, h: only_if(h.filled[place(j, k)], lambda h: update(i, j, h), h)
        return only_if(h.filled[place(i, k)], lambda h: repeat(k + 1, i, others, panel(i, h)), h)

    return repeat(k + 1, n, row, h)


def _back(h: Blocks, x: jax.Array, k, n: int, one) -> jax.Array:
    """x_k = L_k'^-1 (D_k^-1 y_k - sum over i > k of L_ik' x_i)."""
    m = x.shape[1]
    own, z = read((h.diagonal, x), k)
    own = materialise(own, one)
    z = z / jnp.concatenate([entry(_column(own, i), i) for i in range(m)], axis=1)
    if h.below is not None:

        def take(i, z):
            def less(z):
                block, xi = read(h.below, place(i, k)), read(x, i)
                return z - sum(block[:, :, r] * entry(xi, r) for r in range(m))

            return only_if(h.filled[place(i, k)], less, z)

        z = repeat(k + 1, n, take, z)
    number = np.arange(m).reshape(1, m, 1)
    for j in reversed(range(1, m)):  # row j of L takes x_j from the entries before it
        before = jnp.where(number < j, own[:, :, j], 0.0)
        z = materialise(z - before * entry(z, j), one)
    return write(x, k, z)
