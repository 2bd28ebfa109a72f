"""Groups that choose their pairs at run time: same physics as all pairs, a stated capacity, an overflow bit."""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

import rbd_jax as rbd
from rbd_jax.contact import broadphase
from rbd_jax.spatial import Vec3

builder = sys.modules["rbd_jax.build"]
EVERY_KIND = {("box", "box"): 0, ("sphere", "box"): 0, ("sphere", "sphere"): 0}
TGS = rbd.Method(solver="tgs")


def choosing(monkeypatch, scene, method=TGS):
    """The scene with all its groups choosing their pairs at run time."""
    with monkeypatch.context() as m:
        m.setattr(builder, "DENSE_PAIRS", EVERY_KIND)
        m.setattr(builder, "COLOURED_PAIRS", EVERY_KIND)
        m.setattr(builder, "FLOATING_PAIRS", EVERY_KIND)
        return rbd.build(scene, method=method)


def test_chosen_pairs_give_the_same_motion_as_all_pairs(monkeypatch):
    model, state = rbd.build(scenes.stack(4), method=TGS)
    dense, _ = rbd.rollout(model, state, 240, every=240)
    model, state = choosing(monkeypatch, scenes.stack(4), rbd.Method(solver="tgs", capacity=5))
    assert [g.capacity for g in model.structure.groups if g.kind == ("box", "box")] == [5]
    chosen, _ = rbd.rollout(model, state, 240, every=240)
    rbd.check(chosen)
    np.testing.assert_allclose(chosen.pos, dense.pos, atol=5e-4)
    assert np.abs(np.asarray(chosen.vel)).max() < 1e-3
    live = np.asarray(jax.jit(rbd.contacts)(model, chosen).live)
    assert live.sum() >= 12


def test_too_small_a_capacity_for_the_start_is_refused(monkeypatch):
    with pytest.raises(ValueError, match="capacity = 2 is too small: 3 box-box pairs.*at least 3"):
        choosing(monkeypatch, scenes.stack(4), rbd.Method(solver="tgs", capacity=2))


def test_too_small_a_capacity_later_is_reported(monkeypatch):
    """Spheres in a row, apart: the first pushes them together."""
    ball = rbd.Sphere(0.1)
    scene = rbd.Scene(
        [rbd.Body(f"b{i}", ball, pos=(0.3 * i, 0, 0), friction=None) for i in range(4)], gravity=None, dt=1 / 240
    )
    model, state = choosing(monkeypatch, scene, rbd.Method(solver="tgs", capacity=1))
    still, _ = rbd.rollout(model, state, 10, every=10)
    rbd.check(still)
    pushed = state.replace(vel=np.array([[4.0, 0, 0], [2.0, 0, 0], [-2.0, 0, 0], [-4.0, 0, 0]]))
    final, _ = rbd.rollout(model, pushed, 10, every=10)
    assert int(final.status) & int(rbd.Status.CAPACITY)
    with pytest.raises(rbd.SimulationError, match="CAPACITY.*capacity="):
        rbd.check(final)


def balls():
    """Two balls on a plane, one rolls into the other."""
    return rbd.Scene(
        [rbd.Body(f"b{i}", rbd.Sphere(0.1), pos=(0.21 * i, 0, 0.1), vel=(1 - i, 0, 0), friction=0.3) for i in range(2)],
        static=[rbd.Plane()],
        dt=1 / 240,
    )


def marbles():
    """Balls that slide on boxes and into each other, with everything a pair can have of its own."""
    ball, plank = rbd.Sphere(0.1), rbd.Box((1.0, 0.2, 0.05))
    geom = lambda **k: rbd.Geom(ball, **k)
    pos = lambda i, j: (0.21 * i - 0.4, 0.5 * j, 0.15)
    return rbd.Scene(
        [
            rbd.Body("plain", ball, pos=pos(0, 0), friction=0.1, vel=(1, 0, 0)),
            rbd.Body("rough", ball, pos=pos(1, 0), friction=0.9),
            rbd.Body("first", geom(friction=0.05, priority=1), pos=pos(0, 1), vel=(1, 0, 0)),
            rbd.Body("second", ball, pos=pos(1, 1), friction=0.8),
            rbd.Body("own", ball, pos=pos(0, 2), friction=0.1, vel=(1, 0, 0)),
            rbd.Body("other", ball, pos=pos(1, 2), friction=0.1),
            rbd.Body("ghost", geom(group=2, mask=4, friction=0.1), pos=pos(2, 0)),
            rbd.Body("cut", ball, pos=pos(2, 2), friction=0.1),
        ],
        static=[rbd.Geom(plank, pos=(0, 0.5 * j, 0), friction=0.3, mask=5, name=f"plank{j}") for j in range(3)],
        pairs=[
            rbd.Pair("own", "plank2", friction=0.7),
            rbd.Pair("own", "other", friction=0.0),
            rbd.Pair("other", "cut", exclude=True),
        ],
        dt=1 / 240,
    )


def test_every_pair_keeps_its_own_numbers(monkeypatch):
    model, state = rbd.build(marbles(), method=TGS)
    dense, _ = rbd.rollout(model, state, 60, every=60)
    model, state = choosing(monkeypatch, marbles())
    assert all(g.capacity for g in model.structure.groups)
    chosen, _ = rbd.rollout(model, state, 60, every=60)
    rbd.check(chosen)
    np.testing.assert_allclose(chosen.pos, dense.pos, atol=2e-5)
    np.testing.assert_allclose(chosen.omega, dense.omega, atol=2e-3)


def test_a_world_does_not_depend_on_its_neighbours(monkeypatch):
    """Bit for bit in batches of one size; another size is another program, equal to rounding."""
    model, state = choosing(monkeypatch, balls())
    push = np.asarray(state.vel) + np.random.default_rng(0).normal(size=(5, 2, 3)) * [0.3, 0.02, 0]
    run = lambda vel: rbd.rollout(model, rbd.batch(state, len(vel)).replace(vel=vel), 30, every=30)[0]
    first, second, alone = run(push[:3]), run(push[[3, 4, 1]]), run(push[1:2])
    for name in ("pos", "vel", "quat", "omega"):
        mine = np.asarray(getattr(first, name))[1]
        np.testing.assert_array_equal(np.asarray(getattr(second, name))[2], mine)
        np.testing.assert_allclose(np.asarray(getattr(alone, name))[0], mine, rtol=1e-5, atol=1e-6)


def test_gradients_pass_around_the_choice(monkeypatch):
    ball = rbd.Sphere(0.1)
    pair = rbd.Scene(
        [rbd.Body(f"b{i}", ball, pos=(0.2 * i, 0.02 * i, 0), vel=(-i, 0, 0), friction=None) for i in range(2)],
        gravity=None,
        dt=1 / 240,
    )

    def slope(model, state):
        end = lambda v: rbd.rollout(model, state.replace(vel=v), 4, every=4)[0].pos[0, 1]
        return jax.grad(end)(state.vel)

    dense = slope(*rbd.build(pair, method=TGS))
    chosen = slope(*choosing(monkeypatch, pair))
    assert np.abs(dense).max() > 1e-3
    np.testing.assert_allclose(chosen, dense, rtol=1e-4, atol=1e-7)


def test_a_hundred_bodies_and_a_hundred_static_geoms():
    n = 10
    scene = rbd.Scene(
        bodies=[
            rbd.Body(f"b{i}_{j}", rbd.Box((0.1, 0.1, 0.1)), pos=(0.25 * i, 0.25 * j, 0.13), friction=0.6)
            for i in range(n)
            for j in range(n)
        ],
        static=[
            rbd.Geom(rbd.Box((0.05, 0.05, 0.02)), pos=(0.25 * i, 0.25 * j, 0.01)) for i in range(n) for j in range(n)
        ],
        dt=1 / 240,
    )
    model, state = rbd.build(scene, method="fast")
    assert all(g.capacity for g in model.structure.groups)
    final, _ = rbd.rollout(model, state, 60, every=60)
    rbd.check(final)
    np.testing.assert_allclose(np.asarray(final.pos)[:, 2], 0.13, atol=1e-3)
    assert np.abs(np.asarray(final.vel)).max() < 5e-3


@pytest.mark.parametrize("search", ["all pairs", "grid"])
def test_a_thousand_spheres(monkeypatch, search):
    """A block of touching balls, each pushed at random: momentum is what gravity and the ground made of it."""
    n, gap = 10, 0.2005
    rng = np.random.default_rng(0)
    scene = rbd.Scene(
        [
            rbd.Body(f"b{i}_{j}_{k}", rbd.Sphere(0.1), pos=(gap * i, gap * j, 0.1 + gap * k), friction=0.5)
            for i in range(n)
            for j in range(n)
            for k in range(n)
        ],
        static=[rbd.Plane()],
        dt=1 / 240,
    )
    monkeypatch.setattr(builder, "GRID_PAIRS", 0 if search == "grid" else 10**9)
    start = time.perf_counter()
    model, state = rbd.build(scene, method=TGS)
    assert time.perf_counter() - start < 10
    (group,) = (g for g in model.structure.groups if g.capacity)
    assert group.capacity == 8000 and (group.choice.candidates is None) == (search == "all pairs")
    vel = rng.normal(size=(1000, 3)) * 0.1
    steps = 3
    final, _ = rbd.rollout(model, state.replace(vel=vel), steps, every=steps)
    rbd.check(final)
    mass = np.asarray(model.mass)[:, None]
    before, after = (mass * vel).sum(0), (mass * np.asarray(final.vel)).sum(0)
    scale = (mass * np.abs(vel)).sum()
    weight = 9.81 * mass.sum() * steps / 240
    assert -weight - 1e-3 * scale < (after - before)[2] < 0.1 * weight
    seen = jax.jit(rbd.contacts)(model, final)
    ground = np.asarray(seen.body_a) < 0
    friction = np.where(ground, np.linalg.norm(np.asarray(seen.force)[:, :2], axis=1), 0.0).sum()
    assert np.abs((after - before)[:2]).max() < 2e-4 * scale + 2 * steps / 240 * friction
    assert (np.asarray(seen.live) & ~ground).sum() > 1000


def boxes(rng, count, worlds, size):
    """Bounds of boxes that fill a third of a cube; two of them are far away."""
    x = rng.uniform(0, size * (3 * count) ** (1 / 3), (3, count, worlds))
    x[:, 0], x[:, 1] = 1e6, -40 * size
    half = rng.uniform(0.3, 0.6, (3, count, 1)) * size
    return broadphase.Bounds(*(Vec3(*(jnp.asarray(c, jnp.float32) for c in v)) for v in (x, half)))


@pytest.mark.parametrize("same, balls", [(True, False), (True, True), (False, False)])
def test_the_grid_finds_what_comparing_everything_finds(same, balls):
    rng = np.random.default_rng(3)
    a = boxes(rng, 150, 2, 0.2)
    b = a if same else boxes(rng, 70, 2, 0.2)
    ok = rng.random((len(a), len(b))) < 0.9
    if same:
        ok &= np.triu(np.ones_like(ok), 1)
    allowed = broadphase.bits(*np.nonzero(ok), *ok.shape)
    near = np.asarray(
        broadphase.close(*(jax.tree.map(lambda c: c[i], s) for i, s in ((np.s_[:, None], a), (None, b))), balls)
    )
    expect = [np.sort(broadphase.key_of(*np.nonzero(near[..., w] & ok), len(b))) for w in range(2)]
    most = max(map(len, expect))
    assert most > 50
    exact = jax.jit(lambda a, b, places: broadphase.all_pairs(a, b, balls, allowed, places), static_argnums=2)
    grid = jax.jit(
        lambda a, b, places, room: broadphase.grid_pairs(a, None if same else b, balls, allowed, places, room),
        static_argnums=(2, 3),
    )
    for keys, overflow in (exact(a, b, most), grid(a, b, most, 8000)):
        assert not np.asarray(overflow).any()
        for w, keys_of_world in enumerate(expect):
            mine = np.asarray(keys)[:, w]
            np.testing.assert_array_equal(mine[: len(keys_of_world)], keys_of_world)
            assert (mine[len(keys_of_world) :] == broadphase.no_key(*ok.shape)).all()
            rows = broadphase.rows_of_key(keys_of_world, len(b))
            assert set(zip(*map(np.ndarray.tolist, rows))) == set(
                zip(*map(np.ndarray.tolist, np.nonzero(near[..., w] & ok)))
            )
    fewer = [len(k) > most - 1 for k in expect]
    np.testing.assert_array_equal(exact(a, b, most - 1)[1], fewer)
    np.testing.assert_array_equal(grid(a, b, most - 1, 8000)[1], fewer)
    assert np.asarray(grid(a, b, most, 50)[1]).all(), "too many candidates are reported"
