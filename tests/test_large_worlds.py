"""Groups that choose their pairs at run time: same physics as all pairs, a stated capacity, an overflow bit."""

import sys

import numpy as np
import pytest
import scenes

import rbd_jax as rbd


def stack_with_capacity(monkeypatch, capacity):
    monkeypatch.setattr(sys.modules["rbd_jax.build"], "DENSE_PAIRS", {("box", "box"): 0})
    return rbd.build(scenes.stack(4), method=rbd.Method(solver="tgs", capacity=capacity))


def test_chosen_pairs_give_the_same_motion_as_all_pairs(monkeypatch):
    model, state = rbd.build(scenes.stack(4), method="fast")
    dense, _ = rbd.rollout(model, state, 240, every=240)
    model, state = stack_with_capacity(monkeypatch, 5)
    assert [g.capacity for g in model.structure.groups if g.kind == ("box", "box")] == [5]
    chosen, _ = rbd.rollout(model, state, 240, every=240)
    rbd.check(chosen)
    np.testing.assert_allclose(chosen.pos, dense.pos, atol=5e-4)
    assert np.abs(np.asarray(chosen.vel)).max() < 1e-3
    live = np.asarray(rbd.contacts(model, chosen).live)
    assert live.sum() >= 12


def test_too_small_a_capacity_is_reported(monkeypatch):
    model, state = stack_with_capacity(monkeypatch, 2)
    final, _ = rbd.rollout(model, state, 5, every=5)
    assert int(final.status) & int(rbd.Status.CAPACITY)
    with pytest.raises(rbd.SimulationError, match="CAPACITY.*capacity="):
        rbd.check(final)


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
