"""Worlds that choose their pairs are run one by one, in loops over what touches in each."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax import tiles
from rbd_jax.contact.broadphase import Bounds, all_pairs, lookup, lookup_of_one, no_key, pairs_of_one
from rbd_jax.loops import in_blocks
from rbd_jax.solvers import PGS, gauss_seidel
from rbd_jax.solvers.lanes import COLOURS, lanes
from rbd_jax.spatial import Vec3

STEPS = 30


def corner(restitution=None, n=12, boxes=0):
    """Bodies that fall into a corner, the first ``boxes`` of them boxes."""
    draw = np.random.default_rng(3)
    bodies = []
    for k in range(n):
        shape = rbd.Box((0.1, 0.08, 0.09)) if k < boxes else rbd.Sphere(0.1)
        pos = np.array([0.12 + 0.205 * (k % 2), 0.12 + 0.205 * (k // 2 % 2), 0.12 + 0.21 * (k // 4)])
        pos += draw.uniform(0, 0.004, 3)
        bodies.append(
            rbd.Body(
                f"b{k}", shape, pos=tuple(pos), vel=(-0.5, -0.5, -1), omega=tuple(draw.normal(size=3)), friction=0.5,
                restitution=restitution,
            )
        )  # fmt: skip
    half = 0.5**0.5
    walls = [rbd.Geom(rbd.Plane(), quat=q, friction=0.5) for q in ((half, 0, half, 0), (half, -half, 0, 0))]
    return rbd.Scene(bodies, [rbd.Geom(rbd.Plane(), friction=0.5), *walls], dt=0.004)


def every_pair_chosen(monkeypatch):
    builder = sys.modules["rbd_jax.build"]
    monkeypatch.setattr(builder, "COLOURED_PAIRS", dict.fromkeys(builder.COLOURED_PAIRS, 0))


def many(model, one, worlds):
    rng = np.random.default_rng(0)
    state = rbd.batch(one, worlds)
    return state.replace(vel=np.asarray(state.vel) + 0.2 * rng.normal(size=(worlds, one.n, 3)))


def cut(tree, rows):
    return jax.tree.map(lambda c: c[rows], tree)


def same(a, b):
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y, equal_nan=True) for x, y in leaves)


@pytest.mark.parametrize("balls", (True, False))
@pytest.mark.parametrize("count, capacity, same", ((70, 600, False), (70, 20, True), (300, 900, True)))
def test_the_pairs_of_one_world_are_those_of_many(balls, count, capacity, same):
    rng = np.random.default_rng(1)
    x = Vec3(*(jnp.asarray(rng.uniform(0, (count / 70) ** (1 / 3), (count, 1)), jnp.float32) for _ in range(3)))
    half = Vec3(*(jnp.asarray(rng.uniform(0.05, 0.15, (count, 1)), jnp.float32) for _ in range(3)))
    i, j = np.triu_indices(count, 1)
    allowed = np.zeros((-(-count // 32), count), np.uint32)
    np.bitwise_or.at(allowed, (i // 32, j), np.uint32(1) << (i % 32).astype(np.uint32))
    a = Bounds(x, half)
    args = a, a if same else Bounds(x, half), balls, allowed, capacity
    (keys, over), (expected, too_many) = (jax.jit(lambda f=f: f(*args))() for f in (pairs_of_one, all_pairs))
    found = (np.asarray(expected) < no_key(count, count)).sum()
    assert found == capacity if capacity < count else 50 < found < capacity
    assert np.array_equal(keys, expected) and np.array_equal(over, too_many)
    assert bool(over[0]) == (capacity < count)


@pytest.mark.parametrize("n, pairs, one_body", [(60, 300, False), (12, 200, False), (40, 90, True), (5, 4, False)])
def test_lanes_hold_every_live_pair_once_and_no_body_twice(n, pairs, one_body):
    rng = np.random.default_rng(n)
    b = rng.integers(1, n, pairs)
    ends = [b] if one_body else [b, (b + rng.integers(1, n, pairs)) % n]
    live = rng.random(pairs) < 2 / 3
    args = [jnp.asarray(e, jnp.int32) for e in ends] + [None] * one_body
    t = jax.jit(lanes, static_argnums=3)(*args, jnp.asarray(live), n)
    source, place = np.asarray(t.source)[:, 0], np.asarray(t.place)[:, 0]
    assert np.array_equal(np.sort(source[source < pairs]), np.flatnonzero(live))
    assert np.array_equal(source[place[live]], np.flatnonzero(live)) and (place[~live] == len(source)).all()
    assert (source[int(t.filled) :] == pairs).all()
    seen = []
    for first, held in zip(np.asarray(t.first)[: int(t.chunks)], np.asarray(t.held)):
        assert 1 <= held <= t.width and first + t.width <= len(source)
        here = source[first : first + held]
        bodies = np.concatenate([e[here] for e in ends])
        assert len(set(bodies)) == len(bodies), "a body twice in a chunk"
        seen += [*here]
    assert np.array_equal(np.sort(seen), np.flatnonzero(live))


def test_lanes_of_a_hub_are_solved_one_by_one():
    """A body with more pairs than there are colours: what finds none goes to the end, and nothing is lost."""
    n = 120
    b, live = jnp.arange(1, n, dtype=jnp.int32), jnp.ones(n - 1, bool)
    t = jax.jit(lanes, static_argnums=3)(b, jnp.zeros_like(b), live, n)
    assert int(t.chunks) == n - 1 and (np.asarray(t.held)[: n - 1] == 1).all()
    assert int(t.filled) == COLOURS * t.width + n - 1 - COLOURS


@pytest.mark.parametrize("restitution", (None, 0.7))
def test_lanes_give_what_point_after_point_gives(restitution, monkeypatch):
    """Another order of the points: converged, they agree."""
    every_pair_chosen(monkeypatch)
    state, ends = None, []
    for many_pairs, sweeps in ((10**9, 200), (1, 201)):  # other numbers of sweeps are other programs
        monkeypatch.setattr(gauss_seidel, "MANY", many_pairs)
        model, one = rbd.build(corner(restitution), method=rbd.Method("symtop2", "soft", PGS(sweeps=sweeps)))
        if state is None:
            state = rbd.rollout(model, many(model, one, 3), STEPS, every=STEPS)[0]
        ends.append(rbd.rollout(model, state, 1, every=1)[0])
    points, in_lanes = ends
    for name in ("pos", "quat", "vel", "omega"):
        np.testing.assert_allclose(getattr(points, name), getattr(in_lanes, name), atol=5e-4)
    carries = [np.asarray(c.n).astype(bool) for c in points.memory.contacts]
    assert sum(c.sum() for c in carries) > (30 if restitution is None else 0)
    for a, b in zip(points.memory.contacts, in_lanes.memory.contacts):
        np.testing.assert_allclose(a.n.sum(-2), b.n.sum(-2), atol=2e-2 * np.abs(a.n).max())


def test_places_of_pairs_are_found_by_going_through_both_lists():
    rng = np.random.default_rng(2)
    for _ in range(20):
        a, b = (np.full((40, 1), 1000, np.int32) for _ in range(2))
        filled = rng.integers(0, 40)
        a[:filled, 0] = np.sort(rng.choice(90, filled, replace=False))
        others = rng.integers(0, 40)
        b[:others, 0] = np.sort(rng.choice(90, others, replace=False))
        found = lookup_of_one(jnp.asarray(a), jnp.asarray(b), jnp.int32(filled))
        assert np.array_equal(found[:filled], lookup(jnp.asarray(a), jnp.asarray(b))[:filled])
        assert (np.asarray(found[filled:]) == 40).all()


@pytest.mark.parametrize("filled", (0, 1, 16, 17, 37))
def test_blocks_give_what_all_at_once_gives(filled):
    rng = np.random.default_rng(4)
    x, y = (jnp.asarray(rng.normal(size=s), jnp.float32) for s in ((3, 37, 1), (37, 1)))
    f = lambda x, y: {"a": x * y, "b": y + 1.0, "same": jnp.float32(2.0)}
    blocks, whole = in_blocks(f, jnp.int32(filled), x, y), f(x, y)
    for name in ("a", "b"):
        got = np.asarray(blocks[name])
        assert np.array_equal(got[..., :filled, :], np.asarray(whole[name])[..., :filled, :])
        behind = -(-filled // 16) * 16
        assert not got[..., min(behind, 37) :, :].any()
    assert (np.asarray(blocks["same"])[:filled] == 2.0).all()


@pytest.mark.parametrize("restitution", (None, 0.7))
def test_bits_depend_neither_on_the_batch_nor_on_cores(restitution, monkeypatch):
    every_pair_chosen(monkeypatch)
    model, one = rbd.build(corner(restitution), method="fast")
    assert tiles.alone(model)
    state = many(model, one, 6)
    run = lambda s: rbd.rollout(model, s, STEPS, every=10)
    rbd.use_cores(1)
    final, traj = run(state)
    rbd.check(final)
    assert np.asarray(final.pos)[..., 2].min() > 0.09
    for rows in (slice(0, 1), slice(2, 5)):
        assert same(run(cut(state, rows)), cut((final, traj), rows))
    from rbd_jax import spread

    monkeypatch.setattr(spread, "LEAST", 0)
    for count in (2, 4):
        monkeypatch.setattr(spread, "cores", lambda count=count: count)
        assert spread._allowed((model, state), 6, STEPS).cores == count
        assert same(run(state), (final, traj))
    rbd.use_cores(None)


@pytest.mark.parametrize("boxes, restitution", ((0, None), (0, 0.7), (6, None)))
def test_the_same_steps_as_the_program_that_is_differentiated(boxes, restitution, monkeypatch):
    """That one goes through chunks of colours, this one through the live points in turn; converged they agree."""
    every_pair_chosen(monkeypatch)
    model, one = rbd.build(corner(restitution, boxes=boxes), method=rbd.Method("symtop2", "soft", PGS(sweeps=200)))
    assert tiles.alone(model)
    go = lambda s: rbd.rollout(model, s, 1, every=1)[0]
    state = rbd.rollout(model, many(model, one, 3), STEPS, every=STEPS)[0]
    direct = go(state)
    zero = lambda c: (
        jnp.zeros_like(c) if jnp.issubdtype(c.dtype, jnp.floating) else np.zeros(c.shape, jax.dtypes.float0)
    )
    other = jax.jvp(go, (state,), (jax.tree.map(zero, state),))[0]
    for name in ("pos", "quat", "vel", "omega"):
        np.testing.assert_allclose(getattr(direct, name), getattr(other, name), atol=5e-4)
    carries = [np.asarray(c.n).astype(bool) for c in direct.memory.contacts]
    assert sum(c.sum() for c in carries) > (30 if restitution is None else 0)
    for a, b in zip(direct.memory.pairs, other.memory.pairs):
        assert a is None or np.array_equal(a, b)
    for a, b in zip(direct.memory.contacts, other.memory.contacts):
        np.testing.assert_allclose(a.n.sum(-2), b.n.sum(-2), atol=2e-2 * np.abs(b.n).max())


def test_elastic_balls_keep_momentum_and_energy():
    """Sixteen balls that meet without gravity, in float64: laws hold to rounding."""
    with jax.enable_x64(True):
        draw = np.random.default_rng(5)
        bodies = [
            rbd.Body(f"b{k}", rbd.Sphere(0.1), pos=(0.3 * (k % 4), 0.3 * (k // 4), 0), friction=0, restitution=1)
            for k in range(16)
        ]
        method = rbd.Method("symtop2", None, None, events=4)  # three balls may meet in one step
        model, one = rbd.build(rbd.Scene(bodies, gravity=None, dt=0.002), method=method)
        assert tiles.alone(model)
        state = rbd.batch(one, 3).replace(vel=draw.normal(size=(3, 16, 3)) * [1, 1, 0.1])
        final = rbd.rollout(model, state, 300, every=300)[0]
        before, after = np.asarray(state.vel), np.asarray(final.vel)
        assert (np.abs(after - before).max(-1) > 1e-3).sum() > 12, "few balls met"
        np.testing.assert_allclose(after.sum(1), before.sum(1), atol=1e-12)
        np.testing.assert_allclose((after**2).sum((1, 2)), (before**2).sum((1, 2)), rtol=1e-9)
