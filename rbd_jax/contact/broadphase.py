"""Layer 4: which pairs are close enough to look at, in a fixed number of places.

Small groups look at every pair. A group with many pairs keeps those whose bounding boxes (balls: their
surfaces), grown by the way the bodies move in a step, come together, in at most ``capacity`` places per world;
one pair more sets the CAPACITY status bit of that world. Three ways to find them:

* ``all_pairs`` compares everything with everything, 32 pairs to a word: about 1 ns a pair and world.
* ``pairs_of_one`` does the same for one world in a program that is one function: it walks through the set bits.
* ``grid_pairs`` sorts the geoms into the cells of a uniform grid as wide as the largest box. The cells of a column are
  neighbours in that order, so the neighbours of a geom are a few ranges, found by bisection; all ranges together
  are laid out in ``candidates`` places. No cell has a capacity of its own; more candidates set the bit.

A pair is known by its key (i // 32 nB + j) 32 + i % 32, i and j its rows among the geoms of side A and B: the
order in which ``all_pairs`` finds it.

Source: Green 2010, "Particle simulation using CUDA" (sorted grid). Differs: ranges of cells instead of cells, and
the layout of their members by a running sum, so that no list has a length of its own.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..loops import only_if, read, repeat, write
from ..spatial import Vec3
from ..struct import struct
from ..xla import largest, summed
from .base import Pose

#: Gap, as a part of the smaller geom's size, up to which its points count as contact.
SLOP = 0.02
#: Bits of a word, and of a cell's row along an axis of the grid.
WORD, ROW = 32, 10


@struct
class Bounds:
    """Bounding boxes of the geoms of one side, leaves (k, 1 or B): centre and half-widths [m], grown by how far the
    surface may come in a step and by half of the gap that still counts as contact. A ball has one half-width.
    """

    x: Vec3
    half: Vec3

    def __len__(self) -> int:
        return self.x.x.shape[0]

    def take(self, rows) -> Bounds:
        return jax.tree.map(lambda c: at(c, rows), self)


def half_widths(kind: str, size, pose: Pose) -> Vec3:
    """Half-widths of the world axis-aligned bounding box of geoms [m]."""
    if kind == "sphere":
        return Vec3(size[0], size[0], size[0])
    r = pose.q.mat()
    h = Vec3(*size)
    return Vec3(*(row.map(jnp.abs).dot(h) for row in (r.a, r.b, r.c)))


def close(a: Bounds, b: Bounds, balls: bool) -> jax.Array:
    """Whether two geoms may touch within the step; ``balls``: both are spheres."""
    d, reach = b.x - a.x, a.half + b.half
    if balls:
        return d.dot(d) < reach.x * reach.x
    d = d.map(jnp.abs)
    return (d.x < reach.x) & (d.y < reach.y) & (d.z < reach.z)


# --- keys ---


def key_of(i, j, count: int):
    """Key of the pair of row i of side A and row j of side B, which has ``count`` geoms."""
    return (i // WORD * count + j) * WORD + i % WORD


def rows_of_key(key, count: int):
    """Rows i and j of a key."""
    word = key // WORD
    return word // count * WORD + key % WORD, word % count


def no_key(count_a: int, count_b: int) -> int:
    """The key of an empty place, larger than any other."""
    return -(-count_a // WORD) * count_b * WORD


def bits(i: np.ndarray, j: np.ndarray, count_a: int, count_b: int) -> np.ndarray:
    """Words uint32 (count_a / 32, count_b) with the bits of the pairs (i, j) set."""
    table = np.zeros((-(-count_a // WORD), count_b), np.uint32)
    np.bitwise_or.at(table, (i // WORD, j), np.uint32(1) << (i % WORD).astype(np.uint32))
    return table


# --- small tools ---


def at(x: jax.Array, rows: jax.Array) -> jax.Array:
    """Entries ``rows`` (Q, B) of x (k, 1 or B)."""
    if x.shape[1] == 1:
        return x[:, 0].at[rows].get(mode="clip")
    return jnp.take_along_axis(x, rows, axis=0, mode="clip")


def below(ends: jax.Array, x: jax.Array, inclusive: bool = False) -> jax.Array:
    """How many of the ascending ``ends`` (k, B) are less than x (Q, B) (``inclusive``: or equal), by bisection."""
    count = ends.shape[0]
    steps = 2 ** np.arange(count.bit_length())[::-1].astype(np.int32)

    def step(found, width):
        probe = found + width - 1
        e = at(ends, probe)
        less = (e <= x if inclusive else e < x) & (probe < count)
        return jnp.where(less, found + width, found), None

    return jax.lax.scan(step, jnp.zeros(x.shape, jnp.int32), jnp.asarray(steps))[0]


def nth_bit(word: jax.Array, rank: jax.Array) -> jax.Array:
    """Position of the set bit of uint32 ``word`` that ``rank`` set bits precede."""
    position = jnp.zeros_like(rank)
    for width in (16, 8, 4, 2, 1):
        low = word & jnp.uint32((1 << width) - 1)
        count = jax.lax.population_count(low).astype(rank.dtype)
        high = rank >= count
        rank = jnp.where(high, rank - count, rank)
        word = jnp.where(high, word >> width, low)
        position = position + jnp.where(high, width, 0)
    return position


def lookup(pairs: jax.Array, previous: jax.Array) -> jax.Array:
    """Place that each of ``pairs`` (C, B) had in the ascending ``previous`` (C, B); C where it had none."""
    place = below(previous, pairs)
    return jnp.where(at(previous, place) == pairs, place, previous.shape[0])


def lookup_of_one(pairs: jax.Array, previous: jax.Array, filled: jax.Array) -> jax.Array:
    """As ``lookup``, of one world and for a program that is one function: both lists are gone through once.

    filled: how many pairs there are; the rest are empty places.
    """
    count = len(pairs)

    def step(carry):
        i, j, place = carry
        new, old = pairs[i, 0], previous[jnp.minimum(j, count - 1), 0]
        behind = (j < count) & (old < new)
        found = jnp.where((j < count) & (old == new), j, count)[None, None]
        # what is written too early is written again
        place = jax.lax.dynamic_update_slice(place, found, (i, jnp.int32(0)))
        return jnp.where(behind, i, i + 1), jnp.where(behind, j + 1, j), place

    start = (jnp.int32(0), jnp.int32(0), jnp.full(pairs.shape, count, jnp.int32))
    return jax.lax.while_loop(lambda c: c[0] < filled, step, start)[2]


# --- the searches ---

#: Words of which it is asked at once whether they have a bit.
TOGETHER = 16
#: Words that one world looks at together.
COLUMNS = 128


def _words(a: Bounds, b: Bounds, balls: bool, allowed: np.ndarray | None) -> jax.Array:
    """uint32 (count_a / 32, count_b, B): 32 geoms of side A to a word, a bit where the pair is close."""
    count_a, count_b = len(a), len(b)
    worlds = max(c.shape[1] for c in jax.tree.leaves((a, b)))
    words = -(-count_a // WORD)
    # bits along the slow axis: the fast ones (geoms of B, worlds) are vectors
    a = jax.tree.map(lambda c: c.reshape(words, WORD, 1, c.shape[1]), _far(a, words * WORD))
    b = jax.tree.map(lambda c: c[None, None], b)
    found = jnp.broadcast_to(close(a, b, balls), (words, WORD, count_b, worlds))
    weight = (np.uint32(1) << np.arange(WORD, dtype=np.uint32))[None, :, None, None]
    word = summed(jnp.where(found, weight, jnp.uint32(0)), axis=1).astype(jnp.uint32)
    return word if allowed is None else word & jnp.asarray(allowed)[:, :, None]


def all_pairs(a: Bounds, b: Bounds, balls: bool, allowed: np.ndarray | None, capacity: int):
    """Keys of the close pairs in ascending order.

    Args:
      a, b: both sides. balls: all are spheres.
      allowed: bits of the pairs that count, None = all.
      capacity: places C.

    Returns:
      keys: int32 (C, B), ``no_key`` where a place is empty. overflow: bool (B,), there are more than C.
    """
    word = _words(a, b, balls, allowed)
    words, count_b, worlds = word.shape
    count_a = len(a)
    word = word.reshape(words * count_b, worlds)
    number = jax.lax.population_count(word).astype(jnp.int32)
    ends = jnp.cumsum(number, axis=0)
    place = jnp.broadcast_to(jnp.arange(capacity, dtype=jnp.int32)[:, None], (capacity, worlds))
    home = below(ends, place, inclusive=True)
    key = home * WORD + nth_bit(at(word, home), place - at(ends - number, home))
    return jnp.where(place < ends[-1], key, no_key(count_a, count_b)), ends[-1] > capacity


def pairs_of_one(a: Bounds, b: Bounds, balls: bool, allowed: np.ndarray | None, capacity: int):
    """As ``all_pairs``, of one world and for a program that is one function of the CPU (``xla.one_function``).

    COLUMNS words at a time, which stay in the first cache; of one list of geoms, against itself, from the diagonal on.
    """
    same, count_a, count_b = a is b, len(a), len(b)
    none, words = no_key(count_a, count_b), -(-count_a // WORD)
    columns = min(COLUMNS, -(-count_b // TOGETHER) * TOGETHER)
    blocks = -(-count_b // columns)
    a, b = _far(a, words * WORD), _far(b, blocks * columns)
    if allowed is not None:
        allowed = jnp.asarray(np.pad(allowed, ((0, 0), (0, blocks * columns - count_b))))

    def of_block(w, k, carry):
        rows = jax.tree.map(lambda c: jax.lax.dynamic_slice_in_dim(c, w * WORD, WORD), a)
        others = jax.tree.map(lambda c: jax.lax.dynamic_slice_in_dim(c, k * columns, columns), b)

        def bit(i, word):
            near = close(read(rows, i), others, balls)[:, 0]
            return word | jnp.where(near, jnp.uint32(1) << i.astype(jnp.uint32), jnp.uint32(0))

        word = repeat(0, WORD, bit, jnp.zeros(columns, jnp.uint32))
        if allowed is not None:
            word = word & jax.lax.dynamic_slice(allowed, (w, k * columns), (1, columns))[0]
        some = largest(word.reshape(-1, TOGETHER), 1) != 0
        first = w * count_b + k * columns

        def of_word(j, carry):
            def step(carry):
                left, count, keys = carry
                at = jax.lax.population_count((left & (~left + 1)) - 1).astype(jnp.int32)
                # what is one too many is written behind the others
                keys = write(keys, jnp.minimum(count, capacity), ((first + j) * WORD + at)[None])
                return left & (left - 1), count + 1, keys

            return jax.lax.while_loop(lambda c: c[0] != 0, step, (word[j], *carry))[1:]

        def of_words(g, carry):
            each = lambda carry: repeat(g * TOGETHER, (g + 1) * TOGETHER, of_word, carry)
            return only_if(some[g].astype(jnp.int32), each, carry)

        return repeat(0, len(some), of_words, carry)

    def of_row(w, carry):
        return repeat(w * WORD // columns if same else 0, blocks, lambda k, carry: of_block(w, k, carry), carry)

    start = (jnp.int32(0), jnp.full(capacity + 1, none, jnp.int32))
    count, keys = repeat(0, words, of_row, start)
    return keys[:capacity, None], count[None] > capacity


def _far(x: Bounds, size: int) -> Bounds:
    """``x`` with geoms infinitely far away until there are ``size``."""
    pad = lambda c, value: jnp.pad(c, ((0, size - len(c)), (0, 0)), constant_values=value)
    return Bounds(x.x.map(lambda c: pad(c, jnp.inf)), x.half.map(lambda c: pad(c, 0)))


def grid_pairs(a: Bounds, b: Bounds | None, balls: bool, allowed: np.ndarray | None, capacity: int, candidates: int):
    """As ``all_pairs``; b None: the pairs i < j of one list of geoms."""
    worlds = max(c.shape[1] for c in jax.tree.leaves((a, b)))
    a, b = jax.tree.map(lambda c: jnp.broadcast_to(c, (c.shape[0], worlds)), (a, b))
    halves = [s.half for s in (a, b) if s is not None]
    cells_a, cells_b = [], []
    for axis in "xyz":
        half = [getattr(h, axis).max(axis=0) for h in halves]
        width = 2.02 * (half[0] if b is None else jnp.maximum(*half))
        position = getattr(a.x, axis)
        # the grid covers what lies between the tenth and the ninetieth percentile four times; the rest is at its edge
        order = jnp.sort(position, axis=0)
        low, high = order[len(order) // 10], order[len(order) - 1 - len(order) // 10]
        width = jnp.maximum(width, (high - low) * (4.0 / 2**ROW))
        cell = lambda x: jnp.clip(jnp.floor((x - 0.5 * (low + high)) / width), 1 - 2 ** (ROW - 1), 2 ** (ROW - 1) - 2)
        number = lambda x: cell(x).astype(jnp.int32) + 2 ** (ROW - 1)
        cells_a.append(number(position))
        cells_b.append(None if b is None else number(getattr(b.x, axis)))
    code = lambda c: (c[0] * 2**ROW + c[1]) * 2**ROW + c[2]
    count = len(a)
    own = jnp.broadcast_to(jnp.arange(count, dtype=jnp.int32)[:, None], (count, worlds))
    cell_a, order = jax.lax.sort((code(cells_a), own), dimension=0, num_keys=1)
    side = lambda dx, dy: (dx * 2**ROW + dy) * 2**ROW
    if b is None:
        # each pair once: the rest of the own column, and four columns ahead
        query, geom = cell_a, order
        starts, stops = [own + 1], [below(cell_a, query + 1, True)]
        columns = [side(0, 1), side(1, -1), side(1, 0), side(1, 1)]
    else:
        query = code(cells_b)
        geom = jnp.broadcast_to(jnp.arange(query.shape[0], dtype=jnp.int32)[:, None], query.shape)
        starts, stops = [], []
        columns = [side(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
    at_columns = jnp.concatenate([query + c for c in columns])
    starts = jnp.concatenate([*starts, below(cell_a, at_columns - 1)])
    stops = jnp.concatenate([*stops, below(cell_a, at_columns + 1, True)])
    number = jnp.maximum(stops - starts, 0)
    ends = jnp.cumsum(number, axis=0)
    place = jnp.broadcast_to(jnp.arange(candidates, dtype=jnp.int32)[:, None], (candidates, worlds))
    home = jnp.minimum(below(ends, place, inclusive=True), ends.shape[0] - 1)
    other = at(order, at(starts - (ends - number), home) + place)
    mine = at(geom, home % geom.shape[0])
    if b is None:
        i, j = jnp.minimum(mine, other), jnp.maximum(mine, other)
        b = a
    else:
        i, j = other, mine
    found = close(a.take(i), b.take(j), balls) & (place < ends[-1])
    count_b = len(b)
    if allowed is not None:
        word = jnp.asarray(allowed).reshape(-1)[i // WORD * count_b + j]
        found = found & ((word >> (i % WORD).astype(jnp.uint32)) & 1).astype(bool)
    total = jnp.cumsum(found.astype(jnp.int32), axis=0)
    none = no_key(count, count_b)
    spot = jnp.where(found, total - 1, capacity)
    keys = jnp.full((capacity, worlds), none, jnp.int32)
    keys = keys.at[spot, jnp.arange(worlds)[None, :]].set(key_of(i, j, count_b), mode="drop")
    return jnp.sort(keys, axis=0), (total[-1] > capacity) | (ends[-1] > candidates)
