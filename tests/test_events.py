"""Impacts at their own instant (``Method.events``): closed forms, order of several impacts, nothing gets through."""

import dataclasses

import jax
import numpy as np
import pytest

import rbd_jax as rbd

G, H = 9.81, 1 / 240


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def with_events(preset="accurate", events=4):
    return dataclasses.replace(rbd.PRESETS[preset], events=events)


def dropped(e, height=1.0):
    body = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 0.1 + height), friction=None, restitution=e)
    return rbd.Scene([body], [rbd.Geom(rbd.Plane(), friction=None)], dt=H)


def heights(t, height=1.0):
    """Height of an elastic ball above its rest position."""
    period = 2 * np.sqrt(2 * height / G)
    tau = (t + period / 2) % period - period / 2
    return height - 0.5 * G * tau**2


@pytest.mark.parametrize("preset", ["accurate", "fast"])
def test_elastic_ball_follows_the_closed_form_for_twenty_bounces(preset):
    model, state = rbd.build(dropped(1.0), method=with_events(preset))
    _, traj = rbd.rollout(model, state, int(20 * 2 * np.sqrt(2 / G) / H))
    np.testing.assert_allclose(np.asarray(traj.pos)[:, 0, 2] - 0.1, heights(np.asarray(traj.time)), atol=1e-10)


def test_zeno_ball_rests_when_it_should():
    e = 0.8
    model, state = rbd.build(dropped(e), method=with_events())
    rest = np.sqrt(2 / G) * (1 + e) / (1 - e)
    final, traj = rbd.rollout(model, state, int(rest / H) + 20)
    moving = np.abs(np.asarray(traj.vel)[:, 0, 2]) > 1e-3
    assert abs((np.flatnonzero(moving).max() + 1) * H - rest) <= 2 * H
    assert abs(float(final.pos[0, 2]) - 0.1) < 1e-6


def test_oblique_collision_uses_the_normal_of_the_impact():
    """Two spheres that meet off centre in mid-step: velocities after, by hand; momentum, energy and L kept."""
    bodies = [
        rbd.Body("a", rbd.Sphere(0.1), pos=(0, 0, 0), vel=(3.0, 0, 0), mass=1.0, friction=None, restitution=1.0),
        rbd.Body("b", rbd.Sphere(0.2), pos=(0.4, 0.15, 0), vel=(-2.0, 0, 0), mass=3.0, friction=None, restitution=1.0),
    ]
    scene = rbd.Scene(bodies, gravity=None, dt=0.1)
    model, state = rbd.build(scene, method=with_events())
    final = rbd.step(model, state)
    t = (0.4 - np.sqrt(0.3**2 - 0.15**2)) / 5.0
    n = np.array([0.4 - 5.0 * t, 0.15, 0]) / 0.3
    J = 2.0 * 0.75 * 5.0 * n[0] * n
    va, vb = np.array([3.0, 0, 0]) - J, np.array([-2.0, 0, 0]) + J / 3.0
    np.testing.assert_allclose(final.vel, [va, vb], atol=1e-12)
    xa = np.array([3.0 * t, 0, 0]) + va * (0.1 - t)
    np.testing.assert_allclose(final.pos[0], xa, atol=1e-12)
    for before, after in zip(rbd.momentum(model, state), rbd.momentum(model, final)):
        np.testing.assert_allclose(after, before, atol=1e-12)
    np.testing.assert_allclose(rbd.energy(model, final)[0], rbd.energy(model, state)[0], rtol=1e-12)


def test_cradle_passes_the_blow_on_within_one_step():
    """Five balls with gaps: four impacts in order, the last ball leaves with the speed of the first."""
    bodies = [
        rbd.Body(
            f"b{i}", rbd.Sphere(0.1), pos=(0.201 * i, 0, 0), vel=(2.0 * (i == 0), 0, 0), friction=None, restitution=1.0
        )
        for i in range(5)
    ]
    model, state = rbd.build(rbd.Scene(bodies, gravity=None, dt=H), method=with_events())
    final = rbd.step(model, state)
    np.testing.assert_allclose(np.asarray(final.vel)[:, 0], [0, 0, 0, 0, 2.0], atol=1e-12)


def test_events_are_differentiable_to_second_order():
    """d z(T)/d z0 of a ball after one bounce and its derivative, against the closed form."""
    model, state = rbd.build(dropped(0.7), method=with_events())
    steps, e = 150, 0.7

    def end(z):
        return rbd.rollout(model, state.replace(pos=z * np.array([0.0, 0, 1.0])), steps, every=steps)[0].pos[0, 2]

    def truth(z):
        hit = jax.numpy.sqrt(2 * (z - 0.1) / G)
        left = steps * H - hit
        return 0.1 + e * G * hit * left - 0.5 * G * left**2

    for f in (lambda g: g, jax.grad, lambda g: jax.jacfwd(jax.grad(g))):
        np.testing.assert_allclose(f(end)(1.1), f(truth)(1.1), rtol=1e-9)


def test_ball_on_a_resting_box_leaves_it_at_rest():
    """The forces of resting contacts are kept while the ball flies to its impact."""
    bodies = [
        rbd.Body("box", rbd.Box((0.5, 0.5, 0.5)), pos=(0, 0, 0.5), mass=1e6, friction=0.5),
        rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 1.4), friction=0.5, restitution=1.0),
    ]
    scene = rbd.Scene(bodies, [rbd.Geom(rbd.Plane(), friction=0.5)], dt=H)
    model, state = rbd.build(scene, method=with_events())
    _, traj = rbd.rollout(model, state, 240)
    assert np.abs(np.asarray(traj.vel)[2:, 0]).max() < 2e-3
    apex = np.asarray(traj.pos)[60:, 1, 2].max()
    assert abs(apex - 1.4) < 2e-3


def test_without_impacts_a_step_is_the_step_without_events():
    scene = rbd.Scene(
        [rbd.Body("box", rbd.Box((0.5, 0.4, 0.3)), pos=(0, 0, 0.3), vel=(1, 0, 0))], [rbd.Geom(rbd.Plane())]
    )
    ends = []
    for events in (0, 4):
        model, state = rbd.build(scene, dt=H, method=with_events(events=events))
        ends.append(rbd.rollout(model, state, 30)[0])
    for a, b in zip(jax.tree.leaves(ends[0].x), jax.tree.leaves(ends[1].x)):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_a_slot_that_misses_does_not_touch_for_a_rounding_error():
    """A ball that overlaps the ground and leaves it: whether it is in contact decides where it ends."""
    body = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 0.0998), vel=(0, 0, 0.06), restitution=0.3)
    model, state = rbd.build(rbd.Scene([body], [rbd.Plane()], dt=1 / 120), method="gradient")
    gravity = model.gravity + 1e-9 * np.random.default_rng(0).normal(size=(64, 3))
    final, _ = rbd.rollout(model.replace(gravity=gravity), state, 1)
    assert (np.asarray(final.memory.contacts[0].n) == 0).all()
    np.testing.assert_allclose(final.pos, np.broadcast_to(final.pos[:1], final.pos.shape), atol=1e-12)


@pytest.mark.parametrize("value", [-1, 1.5, True])
def test_wrong_numbers_of_events_are_refused(value):
    with pytest.raises(ValueError, match="events"):
        rbd.build(dropped(1.0), method=dataclasses.replace(rbd.PRESETS["accurate"], events=value))
    with pytest.raises(ValueError, match="splitting integrator"):
        rbd.build(dropped(1.0), method=rbd.Method("semi_implicit_euler", events=2))
