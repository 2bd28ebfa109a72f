"""Layer 8: how a batch is cut on a CPU: into tiles that stay in a core's cache, over all cores.

XLA's CPU backend runs a program as a list of kernels, 0.2 us and more apart, and hands the large ones to its
threads piece by piece. A rollout is thousands of kernels of microseconds, so both cost more than the arithmetic.
Instead a batch is cut into tiles of a few hundred worlds, each of which runs all its steps

* as one function, where all operations are of a kind that XLA can compile so (``single``),
* on one core, while the other cores run other tiles (``spread``).

A world that chooses its pairs by itself is a tile of its own (``alone``): of many bodies few touch, in each world
others, and a loop over those of one world takes less time than arithmetic on all that touch in one of many.

Every other tile is ``LANES`` wide or a multiple of it, the last one filled up with copies of a world: the arithmetic of
a world does not depend on how many there are, or on which core runs it.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from .kernel import forward
from .model import Model
from .state import State, Wrench
from .xla import on_cpu, one_function

#: Worlds of a tile at most: with fewer a stack has more loops to start, with more its arrays leave the cache.
TILE = 128
#: A tile is a multiple of this: no vector loop of XLA leaves a rest that is computed one by one.
LANES = 32
#: Operations of a program, and of a part of one that is longer, that become one function. Of many worlds: it compiles
#: in 3 s; a bin of boxes and balls takes a fifth longer where detection, 2,900 operations, is one. Of few, where to
#: start kernels costs more than they do: 12 s.
LONGEST, LONGEST_OF_FEW = (4_000, 2_000), (10_000, 6_000)


#: Operations that a group of pairs may add to a program.
OF_GROUP = 4_000


def single(core, worlds: int, model: Model):
    """``core`` as one function, or as few as compile soon."""
    longest, part = LONGEST if worlds >= LANES else LONGEST_OF_FEW
    return one_function(core, longest, part, long=OF_GROUP * len(model.structure.groups) > longest)


# --- tiles ---


def alone(model: Model) -> bool:
    """Whether every world is a tile of its own: a group chooses its pairs by looking at all, for sweeps over them."""
    return model.method.solver.coloured and model.structure.chooses


def width_of(worlds: int, parts: int = 1, alone: bool = False) -> tuple[int, int]:
    """(tiles, worlds of a tile) for a batch over ``parts`` cores: tiles is a multiple of parts, or less than it."""
    if alone:
        return -(-worlds // parts) * parts, 1
    tiles = -(-worlds // TILE)
    if worlds > LANES:
        tiles = -(-tiles // parts) * parts
    width = -(-worlds // tiles)
    if worlds >= LANES:
        width = -(-width // LANES) * LANES
    return -(-worlds // width), width


def padded(worlds: int, parts: int) -> int:
    """The least number of worlds that ``parts`` devices share equally, LANES or a multiple of it each."""
    each = -(-worlds // parts)
    return parts * (-(-each // LANES) * LANES if worlds >= LANES else each)


def per_world(model: Model, state: State, wrench: Wrench | None):
    """Which leaves have batch axes: trees of bool."""
    own = {name: c.ndim > model.base_ndim(name) for name, c in model.leaves()}
    marks = model._with(laws=jax.tree.map(lambda c: False, model.laws), **own)
    return marks, jax.tree.map(lambda c: True, state), jax.tree.map(lambda c: jnp.ndim(c) > 2, wrench)


def flattened(model: Model, state: State, wrench: Wrench | None, batch: tuple[int, ...]):
    """The same with one batch axis; the axes of a leaf are the first of ``batch``."""

    def flat(c, own: int):
        mine = c.ndim - own
        if not mine:
            return c
        full = (*c.shape[:mine], *(1,) * (len(batch) - mine), *c.shape[mine:])
        return jnp.broadcast_to(c.reshape(full), (*batch, *c.shape[mine:])).reshape(-1, *c.shape[mine:])

    model = model._with(**{name: flat(c, model.base_ndim(name)) for name, c in model.leaves()})
    state = jax.tree.map(lambda c: jnp.reshape(c, (-1, *c.shape[len(batch) :])), state)
    return model, state, jax.tree.map(lambda c: flat(c, 2), wrench)


def tiled(
    core, model: Model, state: State, wrench: Wrench | None, counts, batch: tuple[int, ...], first=0, parts: int = 1
):
    """``core(model, state, wrench, counts)``, a tree of arrays with the batch in front, tile by tile.

    counts: numbers that all worlds share.
    first, parts: of ``parts`` equal shares that with number ``first`` (may be traced); its results have one batch
    axis and include the worlds that fill up the last tile.
    """
    worlds = math.prod(batch)
    if not on_cpu():
        with forward():
            return core(model, state, wrench, counts)
    tiles, width = width_of(worlds, parts, alone(model))
    if tiles * width == worlds and tiles == 1 and parts == 1:
        return single(core, width, model)(model, state, wrench, counts)
    args = flattened(model, state, wrench, batch)
    varies = per_world(*args)
    fold = lambda c, b: filled(c, tiles * width).reshape(tiles, width, *c.shape[1:]) if b else c
    args = jax.tree.map(fold, args, varies)
    run, share = single(core, width, model), -(-tiles // parts)

    def tile(k):
        at = lambda c, b: jax.lax.dynamic_index_in_dim(c, k, keepdims=False) if b else c
        return run(*jax.tree.map(at, args, varies), counts)

    if share == 1:
        out = tile(first)
    else:
        out = jax.lax.map(tile, first * share + jnp.arange(share, dtype=jnp.int32))
        out = jax.tree.map(lambda c: c.reshape(-1, *c.shape[2:]), out)
    if parts > 1:
        return out
    return jax.tree.map(lambda c: c[:worlds].reshape(*batch, *c.shape[1:]), out)


def filled(c, size: int):
    """``c`` with its last world repeated until there are ``size``."""
    rest = size - c.shape[0]
    return jnp.concatenate([c, jnp.broadcast_to(c[-1:], (rest, *c.shape[1:]))]) if rest else c
