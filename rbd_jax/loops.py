"""Layer 1: loops over the rows of arrays that matter, for programs that are one function of the CPU.

There a loop costs nothing but its arithmetic, and an array that it carries is changed in place as long as a row is read
only before it is written.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from .struct import struct
from .xla import in_a_thread, unset


def read(tree, row):
    """Row ``row`` of every array, with its axis."""
    return jax.tree.map(lambda c: jax.lax.dynamic_slice_in_dim(c, row, 1, 0, allow_negative_indices=False), tree)


def write(tree, row, values):
    put = lambda c, v: jax.lax.dynamic_update_slice_in_dim(c, v, row, 0, allow_negative_indices=False)
    return jax.tree.map(put, tree, values)


def add(x, where, values):
    """The array x with ``values`` added to its block that begins at ``where``, an index for every axis."""
    where = tuple(jnp.asarray(i, jnp.int32) for i in where)
    old = jax.lax.dynamic_slice(x, where, values.shape, allow_negative_indices=False)
    return jax.lax.dynamic_update_slice(x, old + values, where, allow_negative_indices=False)


def repeat(start, stop, body, carry):
    """``carry = body(i, carry)`` for i = start, ..., stop - 1, which may be traced."""
    step = lambda c: (c[0] + 1, body(c[0], c[1]))
    return jax.lax.while_loop(lambda c: c[0] < stop, step, (jnp.asarray(start, jnp.int32), carry))[1]


def only_if(flag, body, carry):
    """``body(carry)`` where the int32 ``flag`` is 1, as a loop: the branches of a condition would copy the carry."""
    return repeat(0, flag, lambda _, carry: body(carry), carry)


@struct
class Listed:
    """The numbers of rows that matter, int32 (N,), of which the first ``count`` are valid."""

    order: jax.Array
    count: jax.Array


def listed(matters, among: jax.Array | None = None) -> Listed:
    """The rows of ``matters`` (N,) that are true; ``among``: looking at so many of them."""
    matters = matters.astype(jnp.int32)

    def put(number, carry):
        order, count = carry
        # a number is written where the next one goes; it stays only if it counts
        order = jax.lax.dynamic_update_slice(order, number[None], (count,))
        return order, count + jax.lax.dynamic_index_in_dim(matters, number, keepdims=False)

    start = (jnp.zeros(len(matters), jnp.int32), jnp.int32(0))
    return Listed(*repeat(0, len(matters) if among is None else among, put, start))


def over(rows: Listed, body, carry):
    """``carry = body(row, carry)`` for the rows listed."""
    return repeat(0, rows.count, lambda i, carry: body(rows.order[i], carry), carry)


# --- pairs: arrays (..., P, B) ---


def _cut(c, axis: int, at):
    return c if c.shape[axis] == 1 else jax.lax.dynamic_slice_in_dim(c, at, 1, axis, allow_negative_indices=False)


def of_pair(tree, pair):
    """Of arrays (..., P, B) those of one pair; what has no axis of pairs stays."""
    return jax.tree.map(lambda c: c if jnp.ndim(c) < 2 else _cut(c, c.ndim - 2, pair), tree)


def of_point(tree, slot):
    """Of arrays (S, 1, B) those of one slot; what is the same for all slots stays."""
    return jax.tree.map(lambda c: c if jnp.ndim(c) < 3 else _cut(c, 0, slot), tree)


def each_pair(f, matters, *args):
    """``f(*args)``, trees of arrays (..., P, B), pair by pair for those that ``matters`` (P,); zero for the others.

    f(pair, *args): of any number of pairs, and then without regard to ``pair``, their row.
    """
    rows = listed(matters)
    blank = jax.tree.map(lambda c: jnp.zeros(c.shape, c.dtype), jax.eval_shape(lambda *args: f(None, *args), *args))

    def put(pair, out):
        new = f(pair, *of_pair(args, pair))
        at = lambda c: c.ndim - 2
        one = lambda c, v: jax.lax.dynamic_update_slice_in_dim(c, v, pair, at(c), allow_negative_indices=False)
        return jax.tree.map(one, out, new)

    return over(rows, put, blank)


#: Pairs of a block, one or two vectors: with more, a world in which few touch computes more for nothing.
BLOCK = 8


def block_of(width: int) -> int:
    """Pairs of a block that may be so wide: one in a thread, which has no vectors."""
    return 1 if in_a_thread() else width


def in_blocks(f, filled: jax.Array | None, *args, width: int = BLOCK):
    """``f(*args)``, trees of arrays (..., P, B), of the first ``filled`` pairs, block by block; any values behind them.

    f: of any number of pairs, each by itself. filled None: of all, at once.
    """
    if filled is None:
        return f(*args)
    pairs = max(c.shape[-2] for c in jax.tree.leaves(args))
    width = block_of(min(width, pairs))
    worlds = max(c.shape[-1] for c in jax.tree.leaves(args))

    def wide(*args):  # what is the same for all pairs, or all worlds, too
        return jax.tree.map(lambda c: c if jnp.ndim(c) > 1 else jnp.broadcast_to(c, (1, worlds)), f(*args))

    cut = lambda c, at: c if c.shape[-2] == 1 else jax.lax.dynamic_slice_in_dim(c, at, width, c.ndim - 2)
    blank = lambda c: unset((*c.shape[:-2], pairs, c.shape[-1]), c.dtype)

    def put(k, out):
        at = jnp.minimum(k * width, pairs - width)  # the last block may hold pairs of the one before it
        new = wide(*jax.tree.map(lambda c: cut(c, at), args))

        def one(c, v):
            v = jnp.broadcast_to(v, (*v.shape[:-2], width, v.shape[-1]))
            return jax.lax.dynamic_update_slice_in_dim(c, v, at, c.ndim - 2, allow_negative_indices=False)

        return jax.tree.map(one, out, new)

    out = jax.tree.map(blank, jax.eval_shape(wide, *args))
    return repeat(0, (filled + width - 1) // width, put, out)
