"""Colouring of the run-time pairs: what the chunks of a Gauss-Seidel sweep may hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbd_jax.solvers.colouring import COLOURS, colour, plan


def graph(seed, worlds, n, pairs, one_body=False):
    """Random pairs of n bodies, body 0 in many of them, a third of the pairs dead."""
    rng = np.random.default_rng(seed)
    b = rng.integers(1, n, (pairs, worlds))
    a = (b + rng.integers(1, n, (pairs, worlds))) % n
    live = rng.random((pairs, worlds)) < 2 / 3
    return tuple(jnp.asarray(x, jnp.int32) for x in (b, a))[: 2 - one_body] + (None,) * one_body + (jnp.asarray(live),)


coloured = jax.jit(colour, static_argnums=3)
planned = jax.jit(plan, static_argnums=3)


@pytest.mark.parametrize("n, pairs, one_body", [(60, 300, False), (12, 200, False), (40, 90, True), (5, 4, False)])
def test_no_body_twice_and_every_live_pair_once(n, pairs, one_body):
    worlds = 3
    b, a, live = graph(n, worlds, n, pairs, one_body)
    p = planned(b, a, live, n)
    source, place = np.asarray(p.source), np.asarray(p.place)
    ends = [np.asarray(x) for x in (b, a) if x is not None]
    assert source.shape == (p.chunks * p.width + p.tail, worlds)
    for w in range(worlds):
        held = source[:, w][source[:, w] < pairs]
        wanted = np.flatnonzero(np.asarray(live)[:, w])
        assert bool(p.overflow[w]) == (len(held) < len(wanted))
        assert len(set(held)) == len(held) and set(held) <= set(wanted)
        if not p.overflow[w]:
            assert set(held) == set(wanted)
        for k in np.flatnonzero(place[:, w] < len(source)):
            assert source[place[k, w], w] == k
        for c in range(p.chunks):
            rows = source[c * p.width : (c + 1) * p.width, w]
            rows = rows[rows < pairs]
            bodies = np.concatenate([e[rows, w] for e in ends])
            assert len(set(bodies)) == len(bodies), "a body twice in a chunk"
            assert p.active[c] or not len(rows)
    late = source[p.chunks * p.width :] < pairs
    np.testing.assert_array_equal(np.asarray(p.late), late.any(axis=1))
    if n != 12:
        assert not late.any() and not np.asarray(p.overflow).any()


def test_few_colours_suffice():
    b, a, live = graph(0, 1, 300, 900)
    hue = np.asarray(coloured(b, a, live, 300))[np.asarray(live)]
    degree = np.bincount(np.concatenate([np.asarray(x)[np.asarray(live)] for x in (a, b)])).max()
    assert degree <= len(set(hue)) <= degree + 6 and hue.max() < COLOURS


def test_a_hub_goes_to_the_tail():
    """A body with more pairs than there are colours: the rest is solved one by one, and nothing is lost."""
    n = 120
    b = jnp.arange(1, n, dtype=jnp.int32)[:, None]
    p = planned(b, jnp.zeros_like(b), jnp.ones(b.shape, bool), n)
    assert not p.overflow.any() and int(p.late.sum()) == n - 1 - COLOURS
    assert sorted(np.asarray(p.place)[:, 0].tolist()) == sorted(set(np.asarray(p.place)[:, 0].tolist()))


def test_more_than_the_tail_holds_is_reported():
    b = jnp.ones((200, 1), jnp.int32)
    p = planned(b, jnp.zeros_like(b), jnp.ones(b.shape, bool), 20)
    assert p.overflow.all()


def test_a_world_does_not_see_its_neighbours():
    b, a, live = graph(1, 4, 50, 200)
    together = np.asarray(coloured(b, a, live, 50))
    np.testing.assert_array_equal(together, np.asarray(coloured(b, a, live, 50)))
    for w in range(4):
        alone = coloured(b[:, w : w + 1], a[:, w : w + 1], live[:, w : w + 1], 50)
        np.testing.assert_array_equal(np.asarray(alone)[:, 0], together[:, w])
        places = planned(b[:, w : w + 1], a[:, w : w + 1], live[:, w : w + 1], 50).place
        np.testing.assert_array_equal(np.asarray(places)[:, 0], np.asarray(planned(b, a, live, 50).place)[:, w])
