"""Layer 5: pairs that differ from world to world, in chunks that Gauss-Seidel may solve at once.

An edge colouring of the graph of bodies and live pairs, found anew in every step: in a round every pair without a
colour picks one that both its bodies have free, and of those that pick the same colour at the same body the first
pair has it. The pairs of a colour go into chunks of ``width`` places; pairs that found no colour (a body with more
than 32 of them) go into a tail that is solved pair after pair.

Source: Luby 1986 and Jones, Plassmann 1993 (independent choice and local priority), in the speculative form of
Catalyurek et al. 2012, "Graph coloring algorithms for multi-core and massively multithreaded architectures".
Differs: edges instead of vertices, a bit mask of colours a body, and a choice that is hashed over as many
colours as the busiest body has pairs, so that few rounds are needed.

All loops have fixed trip counts; a round, or a chunk, that has nothing to do in any world is skipped by a
condition. Every world is coloured by itself, whatever its neighbours.
Cost: about ten gathers and scatters of (C, B) a round; 5 to 10 rounds in a pile.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..struct import static, struct

#: One bit each.
COLOURS = 32
#: At least one pair is coloured a round; in practice half of those that are left.
ROUNDS = 64


@struct
class Plan:
    """Where the C pairs of a group are solved.

    Attributes:
      source: pair of every place, int32 (P, B), C where it is empty; P = chunks x width + tail.
      place: place of every pair, int32 (C, B), P where it has none (a dead pair).
      active: whether a chunk holds a pair in any world, bool (chunks,). late: the same of a place of the tail, (tail,).
      overflow: bool (B,), a live pair has no place.
      width: places of a chunk. chunks: chunks whose pairs share no body. tail: places solved one by one.
    """

    source: jax.Array
    place: jax.Array
    active: jax.Array
    late: jax.Array
    overflow: jax.Array
    width: int = static()
    chunks: int = static()
    tail: int = static()


def plan(b: jax.Array, a: jax.Array | None, live: jax.Array, n: int) -> Plan:
    """Chunks for the live pairs of a group.

    Args:
      b, a: bodies of every pair, int32 (C, B); a None: a pair has one body.
      live: bool (C, B).
      n: number of bodies.
    """
    pairs, worlds = b.shape
    width = min(pairs, max(8, -(-n // 4)))
    chunks = min(pairs, pairs // width + COLOURS)
    tail = 0 if pairs <= COLOURS else min(pairs, n)
    total = chunks * width + tail
    column = jnp.arange(worlds)[None, :]
    own = jnp.broadcast_to(jnp.arange(pairs, dtype=jnp.int32)[:, None], b.shape)
    colours = colour(b, a, live, n)
    key = jnp.sort(jnp.where(live, colours, COLOURS + 1) * pairs + own, axis=0)
    hue, pair = key // pairs, key % pairs
    counts = jnp.zeros((COLOURS + 2, worlds), jnp.int32).at[hue, column].add(1)
    first = jnp.cumsum(counts, axis=0) - counts
    used = -(-counts[:COLOURS] // width)  # chunks of every colour
    base = (jnp.cumsum(used, axis=0) - used) * width
    base = jnp.concatenate([base, jnp.full((1, worlds), chunks * width), jnp.full((1, worlds), total)])
    place = jnp.minimum((base - first)[hue, column] + own, total)
    source = jnp.full((total, worlds), pairs, jnp.int32).at[place, column].set(pair, mode="drop")
    return Plan(
        source=source,
        place=jnp.zeros_like(b).at[pair, column].set(place),
        active=(jnp.arange(chunks)[:, None] < used.sum(axis=0)).any(axis=1),
        late=(jnp.arange(tail)[:, None] < counts[COLOURS]).any(axis=1),
        overflow=counts[COLOURS] > tail,
        width=width,
        chunks=chunks,
        tail=tail,
    )


def colour(b: jax.Array, a: jax.Array | None, live: jax.Array, n: int) -> jax.Array:
    """A colour for every live pair such that no body has two pairs of one colour.

    Args: as for ``plan``.

    Returns:
      int32 (C, B), 0..31, or 32 where none was found (or the pair is dead).
    """
    pairs, worlds = b.shape
    column = jnp.arange(worlds)[None, :]
    own = jnp.broadcast_to(jnp.arange(pairs, dtype=jnp.int32)[:, None], b.shape)
    ends = (b,) if a is None else (b, a)
    salt = _mixed(b.astype(jnp.uint32) + (0 if a is None else _mixed(a.astype(jnp.uint32))))

    def spread(x, value, where, op):
        """Scatter ``value`` (C, B) to the bodies of the pairs of ``where``."""
        for end in ends:
            x = getattr(x.at[jnp.where(where, end, n), column], op)(value, mode="drop")
        return x

    degree = spread(jnp.zeros((n, worlds), jnp.uint32), jnp.uint32(1), live, "add").max(axis=0)
    choices = jnp.clip(degree, 1, COLOURS)

    def one_round(carry, k):
        def work(hue, used, _):
            free = ~used[b, column]
            if a is not None:
                free = free & ~used[a, column]
            open_ = live & (hue == COLOURS) & (free != 0)
            start = (_mixed(salt + k) >> 16) * choices >> 16
            later = free & (jnp.uint32(0xFFFFFFFF) << start)
            bit = jnp.where(later != 0, later, free)
            bit = bit & (~bit + 1)
            pick = 31 - jax.lax.clz(bit).astype(jnp.int32)
            first = jnp.full((n * COLOURS, worlds), pairs, jnp.int32)
            seats = [end * COLOURS + pick for end in ends]
            for seat in seats:
                first = first.at[jnp.where(open_, seat, n * COLOURS), column].min(own, mode="drop")
            wins = open_
            for seat in seats:
                wins = wins & (first[seat, column] == own)
            used = spread(used, bit, wins, "add")
            return jnp.where(wins, pick, hue), used, (open_ & ~wins).any()

        return jax.lax.cond(carry[2], work, lambda *c: c, *carry), None

    start = (jnp.full(b.shape, COLOURS, jnp.int32), jnp.zeros((n, worlds), jnp.uint32), live.any())
    return jax.lax.scan(one_round, start, jnp.arange(ROUNDS, dtype=jnp.uint32))[0][0]


def _mixed(x: jax.Array) -> jax.Array:
    """A hash of uint32 (finaliser of Mueller's and Steele's mixers)."""
    x = (x ^ (x >> 16)) * jnp.uint32(0x7FEB352D)
    x = (x ^ (x >> 15)) * jnp.uint32(0x846CA68B)
    return x ^ (x >> 16)
