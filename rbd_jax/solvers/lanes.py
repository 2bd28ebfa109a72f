"""Layer 5: pairs of one world in lanes, several that share no body beside each other, for vector instructions.

For a program that is one function of the CPU, where a loop costs nothing but its arithmetic. Every live pair takes the
first colour that both its bodies have free, in every step anew. The pairs of a colour take places beside each other,
``width`` of them a chunk; those that find no colour, of a body with more than 32 pairs, are chunks of their own
at the end.

Source: greedy colouring and layout as in Catto, "SIMD Matters" (2024, Box2D v3). Differs: there colours last as long as
a contact does.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from ..loops import listed, read, repeat, write
from ..struct import static, struct

#: Pairs that are solved at once: floats of a vector register.
WIDTH = 8
#: One bit each.
COLOURS = 32


@struct
class Lanes:
    """Where the P pairs of a group are solved.

    Attributes:
      source: pair of every place, int32 (Q, 1), P where it is empty. place: place of every pair, int32 (P, 1), Q where
        it has none (a dead pair). filled: places in use, the first ones, some of them empty, int32 ().
      first, held: first place of every chunk and how many pairs it holds, int32 (P,). chunks: how many of them there
        are, int32 ().
      width: places that are looked at together. Behind the first place of every chunk there are as many.
    """

    source: jax.Array
    place: jax.Array
    filled: jax.Array
    first: jax.Array
    held: jax.Array
    chunks: jax.Array
    width: int = static()


def lanes(b: jax.Array, a: jax.Array | None, live: jax.Array, n: int, among: jax.Array | None = None) -> Lanes:
    """Places for the live pairs of a group.

    Args:
      b, a: bodies of every pair, int32 (P,); a None: a pair has one body.
      live: bool (P,). n: number of bodies. among: only the first so many pairs may be live; None = all.
    """
    pairs = len(live)
    width = min(WIDTH, pairs)
    places = pairs + min(COLOURS + 1, pairs) * (width - 1)
    ends = [b] if a is None else [b, a]
    at = lambda c, k: read(c, k)[0]
    put = lambda c, k, v: write(c, k, v[None])
    alive = listed(live, among)
    # what is read before it is written is read once, see ``xla.materialise``, with a one that XLA cannot see through
    one = jnp.minimum(alive.count, 0) + 1
    once = lambda x: x // one.astype(x.dtype)

    def paint(k, carry):
        used, hue, count = carry
        pair = at(alive.order, k)
        mine = [once(at(used, at(end, pair))) for end in ends]
        taken = functools.reduce(jnp.bitwise_or, mine)
        free = ~taken & (taken + 1)
        colour = jnp.where(free != 0, jax.lax.population_count(free - 1).astype(jnp.int32), COLOURS)
        for end, old in zip(ends, mine):
            used = put(used, at(end, pair), old | free)
        return used, put(hue, k, colour), put(count, colour, once(at(count, colour)) + 1)

    empty = jnp.zeros(pairs, jnp.int32)
    count = jnp.zeros(COLOURS + 1, jnp.int32)
    _, hue, count = repeat(0, alive.count, paint, (jnp.zeros(n, jnp.uint32), empty, count))

    def begin(colour, carry):
        filled, base, first, held, chunks = carry
        size = jnp.where(colour < COLOURS, width, 1)
        mine = at(count, colour)
        more = (mine + size - 1) // size

        def chunk(i, carry):
            first, held = carry
            here = chunks + i
            return put(first, here, filled + i * size), put(held, here, jnp.minimum(size, mine - i * size))

        first, held = repeat(0, more, chunk, (first, held))
        return filled + more * size, put(base, colour, filled), first, held, chunks + more

    start = jnp.int32(0), jnp.zeros_like(count), empty, empty, jnp.int32(0)
    filled, base, first, held, chunks = repeat(0, COLOURS + 1, begin, start)

    def seat(k, carry):
        base, place, source = carry
        colour, pair = at(hue, k), at(alive.order, k)
        mine = once(at(base, colour))
        return put(base, colour, mine + 1), put(place, pair, mine), put(source, mine, pair)

    start = base, jnp.full(pairs, places, jnp.int32), jnp.full(places, pairs, jnp.int32)
    _, place, source = repeat(0, alive.count, seat, start)
    return Lanes(source[:, None], place[:, None], filled, first, held, chunks, width)
