"""Derivatives through rollouts: blocks, truncation, gradients by horizon, worlds that are lost on the way."""

import gc
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

import rbd_jax as rbd
from rbd_jax.xla import called

G, H = 9.81, 1 / 240


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def falling(e=None, z=0.13, vel=(1.0, 0, -1.0)):
    body = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, z), vel=vel, friction=None, restitution=e)
    return rbd.Scene([body], [rbd.Geom(rbd.Plane(), friction=None)], dt=H)


def flying():
    return rbd.Scene([rbd.Body("ball", rbd.Sphere(0.1), mass=2.0, friction=None)], gravity=None, dt=0.01)


# --- blocks ---

STEPS = 23
CONTROLS = {
    "constant": lambda push: rbd.Wrench(force=jnp.ones((1, 3)) * push),
    "function": lambda push: lambda model, state: rbd.Wrench(force=push * (state.vel - state.pos)),
}


def whole_loss(model, state, kind, **kwargs):
    """Of final state and all samples, by mass, velocity and control."""

    def loss(mass, vel, push):
        control = CONTROLS[kind](push)
        final, traj = rbd.rollout(model.replace(mass=mass), state.replace(vel=vel), STEPS, control=control, **kwargs)
        weights = jnp.arange(1.0, 1.0 + traj.pos.shape[0])[:, None, None]
        return (final.pos**2 + final.vel).sum() + (weights * traj.pos * traj.vel).sum()

    return jax.jit(jax.value_and_grad(loss, (0, 1, 2)))(model.mass, state.vel, 0.3)


@pytest.mark.parametrize(
    "every, kind, checkpoints",
    [(1, "constant", [5, (10, 3)]), (4, "function", [10, (9, 2)]), (30, "constant", [(9, 4)])],
)
def test_blocks_change_no_gradient(every, kind, checkpoints):
    model, state = rbd.build(falling(), method="fast")
    value, want = whole_loss(model, state, kind, every=every)
    assert all(float(jnp.abs(g).max()) > 1e-3 for g in want)
    for checkpoint in checkpoints:
        again, got = whole_loss(model, state, kind, every=every, checkpoint=checkpoint)
        np.testing.assert_allclose(again, value, rtol=1e-14)
        for a, b in zip(got, want):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-15)


def test_blocks_and_cuts_leave_the_forward_program_as_it_is():
    model, state = rbd.build(falling(), method="fast")
    text = lambda **kwargs: jax.jit(lambda s: rbd.rollout(model, s, STEPS, every=4, **kwargs)).lower(state).as_text()
    assert text(checkpoint=(10, 3), truncate=7) == text()
    plain = rbd.rollout(model, state, STEPS, every=4)
    blocked = rbd.rollout(model, state, STEPS, every=4, checkpoint=(10, 3), truncate=7)
    for a, b in zip(jax.tree.leaves(blocked), jax.tree.leaves(plain)):
        np.testing.assert_array_equal(a, b)


def test_a_derivative_does_not_trace_the_program_that_has_none(monkeypatch):
    """Which takes as long as what it needs; and the search for cycles, off meanwhile, is as it was before."""
    model, state = rbd.build(falling(e=0.5), method="fast")

    def refuse(*args, **counts):
        raise AssertionError("the program that is not differentiated was traced")

    monkeypatch.setattr(importlib.import_module("rbd_jax.rollout"), "_in_tiles", refuse)
    height = lambda move: lambda vel: move(state.replace(vel=vel)).pos[0, 2]
    moves = (lambda s: rbd.rollout(model, s, STEPS + 6)[0], lambda s: rbd.step(model, s))
    for collects in (True, False):
        (gc.enable if collects else gc.disable)()
        try:
            for move in moves:
                slopes = [jax.make_jaxpr(d(height(move)))(state.vel) for d in (jax.grad, jax.jacfwd)]
                assert all(slope.jaxpr.eqns for slope in slopes)
            assert gc.isenabled() == collects
        finally:
            gc.enable()
    with pytest.raises(AssertionError, match="was traced"):
        jax.make_jaxpr(height(moves[0]))(state.vel)


def test_memory_of_reverse_mode_hardly_grows_with_the_steps():
    """With blocks of 100; without them it is proportional to the steps."""
    ball = rbd.Body("ball", rbd.Sphere(0.1), pos=(0.02, 0, 0.31), friction=0.5)
    model, state = rbd.build(
        rbd.Scene([ball], [rbd.Geom(rbd.Box((0.1, 0.15, 0.2)), friction=0.5)], dt=H), method="fast"
    )

    def memory(steps, checkpoint):
        end = lambda v: rbd.rollout(model, state.replace(vel=v), steps, every=steps, checkpoint=checkpoint)[0].pos
        loss = jax.jit(jax.value_and_grad(lambda v: (end(v) ** 2).sum()))
        return loss.lower(state.vel).compile().memory_analysis().temp_size_in_bytes

    short = memory(1000, 100)
    assert memory(10_000, 100) <= 2 * short
    assert memory(10_000, (1000, 100)) <= 2 * short
    assert memory(1000, None) >= 4 * short


def scans(jaxpr):
    """All loops of a fixed length in a jaxpr."""
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == "scan":
            yield eqn
        for inside in called(eqn.params):
            yield from scans(inside)


def test_reverse_mode_keeps_of_a_step_its_state_and_what_was_found():
    """Not the hundreds of arrays that its derivative is made of."""
    model, state = rbd.build(scenes.stack(2), method="gradient")
    end = lambda v: rbd.rollout(model, state.replace(vel=v), 50, every=50)[0].pos
    jaxpr = jax.make_jaxpr(jax.grad(lambda v: (end(v) ** 2).sum()))(state.vel).jaxpr
    forward = next(e for e in scans(jaxpr) if e.params["length"] == 50)
    kept = forward.outvars[forward.params["num_carry"] :]
    world = sum(v.aval.size for v in forward.outvars[: forward.params["num_carry"]])
    assert 0 < sum(v.aval.size for v in kept) <= 4 * 50 * world
    assert len(kept) <= 100


# --- truncation ---


@pytest.mark.parametrize("checkpoint", [None, 5])
def test_truncation_keeps_what_happened_since_the_last_cut(checkpoint):
    """Free flight: d x / d F = t^2 / 2 m with the time t since the cut; nothing reaches back past one."""
    model, state = rbd.build(flying(), method="fast")
    steps, cut = 23, 7

    def x(force, speed):
        control = rbd.Wrench(force=force * jnp.array([[1.0, 0, 0]]))
        start = state.replace(vel=speed * jnp.array([[1.0, 0, 0]]))
        final, traj = rbd.rollout(model, start, steps, 2, control, checkpoint, cut)
        return jnp.append(traj.pos[:, 0, 0], final.pos[0, 0])

    at = np.append(np.arange(0, steps + 1, 2), steps)
    since = np.where(at > 0, at - cut * ((at - 1) // cut), 0) * 0.01
    by_force, by_speed = jax.jit(jax.jacrev(x, (0, 1)))(1.0, 0.5)
    np.testing.assert_allclose(by_force, since**2 / 4, rtol=1e-12)
    np.testing.assert_allclose(by_speed, np.where(at <= cut, at * 0.01, 0), rtol=1e-12)
    forward, _ = jax.jit(jax.jacfwd(x, (0, 1)))(1.0, 0.5)
    np.testing.assert_allclose(forward, by_force, rtol=1e-12)


@pytest.mark.parametrize(
    "value", [0, -1, 1.5, True, "5", (), (5, 5), (5, 10), (10, 0), [10, 5], (10, 2.5)], ids=lambda v: repr(v)
)
def test_wrong_blocks_are_refused_by_name(value):
    model, state = rbd.build(flying(), method="fast")
    for call in (
        lambda: rbd.rollout(model, state, 10, checkpoint=value),
        lambda: rbd.gradient_norms(model, state, 10, lambda s: s.pos.sum(), checkpoint=value),
    ):
        with pytest.raises(ValueError, match="checkpoint = "):
            call()
    if not isinstance(value, (tuple, list)):
        with pytest.raises(ValueError, match="truncate = "):
            rbd.rollout(model, state, 10, truncate=value)


# --- gradients by horizon ---


def test_gradient_norms_of_free_flight():
    model, state = rbd.build(flying(), method="fast")
    seen = rbd.gradient_norms(model, state, 25, lambda s: 3.0 * s.pos[0, 2], every=10)
    np.testing.assert_array_equal(seen.steps_left, [25, 15, 5])
    np.testing.assert_allclose(seen.position, [3.0, 3.0, 3.0], rtol=1e-12)
    np.testing.assert_allclose(seen.velocity, 3.0 * 0.01 * np.array([25, 15, 5]), rtol=1e-12)
    np.testing.assert_array_equal([seen.attitude, seen.omega], np.zeros((2, 3)))


def test_gradient_norms_of_an_elastic_bounce():
    """Against the closed form of the height, differentiated at every sample; worlds apart from one another."""
    model, state = rbd.build(falling(1.0, 0.6, (0, 0, 0)), method="accurate")
    states = rbd.batch(state, 2)
    states = states.replace(pos=states.pos + jnp.array([0, 0, 0.05]) * jnp.arange(2.0)[:, None, None])
    steps = 120
    height = lambda s: s.pos[:, 0, 2]
    seen = rbd.gradient_norms(model, states, steps, height, every=20, checkpoint=40)
    _, traj = rbd.rollout(model, states, steps, every=20)

    def end(z, v, t):
        hit = (v + jnp.sqrt(v * v + 2 * G * (z - 0.1))) / G
        left = t - hit
        after = 0.1 + (G * hit - v) * left - 0.5 * G * left**2
        return jnp.where(hit < t, after, z + v * t - 0.5 * G * t * t)

    z, v = traj.pos[:, :, 0, 2], traj.vel[:, :, 0, 2]
    slopes = jax.vmap(jax.vmap(jax.grad(end, (0, 1))))(z, v, jnp.broadcast_to(seen.steps_left * H, z.shape))
    assert np.asarray(v)[0, 3] < 0 < np.asarray(v)[0, 4]
    np.testing.assert_allclose(seen.position, jnp.abs(slopes[0]), rtol=1e-9)
    np.testing.assert_allclose(seen.velocity, jnp.abs(slopes[1]), rtol=1e-9)
    assert seen.attitude is None and seen.omega is None, "the scene models no attitude"


def test_gradient_norms_of_a_spinning_body_are_those_of_its_public_state():
    """The first sample against the gradient of a rollout by (quat, omega), turned by a rotation vector."""
    from rbd_jax.spatial import pack, qexp, quat, vec3

    brick = rbd.Body("brick", rbd.Box((0.1, 0.2, 0.3)), omega=(1, 2, 3))
    model, state = rbd.build(rbd.Scene([brick], gravity=None, dt=0.01), method="fast")
    objective = lambda s: s.quat[0, 1] + s.omega[0, 0]
    push = lambda model, state: rbd.Wrench(torque=-0.01 * state.omega)
    seen = rbd.gradient_norms(model, state, 25, objective, every=5, control=push)

    def end(turn, omega):
        q = pack(qexp(vec3(turn)) @ quat(state.quat[0]))
        start = state.replace(quat=q[None], omega=state.omega + omega)
        return objective(rbd.rollout(model, start, 25, every=5, control=push)[0])

    turn, omega = jax.jit(jax.grad(end, (0, 1)))(jnp.zeros(3), jnp.zeros(3))
    np.testing.assert_allclose(seen.attitude[0], jnp.linalg.norm(turn), rtol=1e-10)
    np.testing.assert_allclose(seen.omega[0], jnp.linalg.norm(omega), rtol=1e-10)
    np.testing.assert_allclose([seen.omega[-1], seen.steps_left[-1]], [1.0, 0.0], rtol=1e-12)


def test_an_objective_must_be_one_number_a_world():
    model, state = rbd.build(flying(), method="fast")
    with pytest.raises(ValueError, match=r"objective returned float64 \(1, 3\)"):
        rbd.gradient_norms(model, state, 2, lambda s: s.pos)
    with pytest.raises(ValueError, match="objective = 3"):
        rbd.gradient_norms(model, state, 2, 3)
    with pytest.raises(ValueError, match="gradient_norms: every = 0"):
        rbd.gradient_norms(model, state, 2, lambda s: s.pos.sum(), every=0)


# --- worlds that are lost ---

BAD = 1
KEEP = np.array([0, 2])


def three_worlds(preset="fast", friction=None):
    """A ball that falls and lands, in three worlds of different height; its mass is shared."""
    model, state = rbd.build(scenes.ball(0.11, vel=(1.0, 0, -1.0), friction=friction), method=preset)
    states = rbd.batch(state, 3)
    return model, states.replace(pos=states.pos + jnp.array([0, 0, 0.003]) * jnp.arange(3.0)[:, None, None])


def alive_loss(final):
    """What a user would write: worlds that are not well do not count."""
    value = (final.pos**2).sum((-1, -2)) + (final.omega**2).sum((-1, -2)) + final.vel.sum((-1, -2))
    return jnp.where(final.status == 0, value, 0.0).sum()


def poisoned(states, force):
    """Label -> (velocity, angular velocity, position, force) with world BAD spoilt."""
    v, w, x = states.vel, states.omega, states.pos
    at = lambda c, value: c.at[BAD, 0, 0].set(value)
    return {
        "nan velocity": (at(v, jnp.nan), w, x, force),
        "inf spin": (v, at(w, jnp.inf), x, force),
        "nan position": (v, w, at(x, jnp.nan), force),
        "velocity out of range": (at(v, 1e300), w, x, force),
        "nan force": (v, w, x, at(force, jnp.nan)),
        "huge force": (v, w, x, at(force, 1e200)),
    }


@pytest.mark.parametrize("preset", ["fast", "accurate"])
def test_a_lost_world_leaves_all_other_gradients_as_they_are(preset):
    model, states = three_worlds(preset, 0.2)
    force = jnp.full((3, 1, 3), 0.5)

    def loss(mass, friction, vel, omega, pos, force):
        start = states if len(vel) == 3 else jax.tree.map(lambda c: c[KEEP], states)
        start = start.replace(vel=vel, omega=omega, pos=pos)
        final, _ = rbd.rollout(
            model.replace(mass=mass, friction=friction), start, 8, every=8, control=rbd.Wrench(force=force)
        )
        return alive_loss(final), final.status

    both = jax.jit(jax.value_and_grad(loss, range(6), has_aux=True))
    forward = jax.jit(lambda args, d: jax.jvp(lambda *args: loss(*args)[0], args, d))
    shared = (model.mass, model.friction)
    args = (*shared, states.vel, states.omega, states.pos, force)
    pick = lambda args: (*args[:2], *(c[KEEP] for c in args[2:]))
    (value, _), want = both(*pick(args))
    ahead = forward(pick(args), jax.tree.map(jnp.ones_like, pick(args)))
    assert all(float(jnp.abs(g).max()) > 1e-6 for g in want)
    for label, (vel, omega, pos, push) in poisoned(states, force).items():
        args = (*shared, vel, omega, pos, push)
        (got, status), gradient = both(*args)
        np.testing.assert_array_equal(status, [0, int(rbd.Status.NOT_FINITE), 0], err_msg=label)
        np.testing.assert_allclose(got, value, rtol=1e-12, err_msg=label)
        for a, b in zip(pick(gradient), want):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12, err_msg=label)
        for a in gradient[2:]:
            np.testing.assert_array_equal(a[BAD], 0.0, err_msg=label)
        for a, b in zip(forward(args, jax.tree.map(jnp.ones_like, args)), ahead):
            np.testing.assert_allclose(a, b, rtol=1e-9, err_msg=label)


def test_the_derivative_of_a_frozen_world_is_that_of_its_held_state():
    """It froze in its first step: the identity, and nothing of mass or force. A number that is not finite has none."""
    model, states = three_worlds()
    force = jnp.full((3, 1, 3), 0.5).at[BAD].set(jnp.nan)

    def end(mass, pos, force):
        start = states.replace(pos=pos)
        final, traj = rbd.rollout(model.replace(mass=mass), start, 5, control=rbd.Wrench(force=force))
        return final.pos[BAD, 0], traj.pos[BAD, :, 0]

    slopes = jax.jit(jax.jacrev(end, (0, 1, 2)))
    final, traj = slopes(model.mass, states.pos, force)
    np.testing.assert_array_equal(final[1][:, BAD, 0], np.eye(3))
    np.testing.assert_array_equal(traj[1][:, :, BAD, 0], np.broadcast_to(np.eye(3), (6, 3, 3)))
    for slope in (final[0], final[2], traj[0], traj[2]):
        np.testing.assert_array_equal(slope, 0.0)
    lost = states.pos.at[BAD, 0, 2].set(jnp.nan)
    final, traj = slopes(model.mass, lost, force)
    for slope in (*final, *traj):
        np.testing.assert_array_equal(slope, 0.0)


def test_a_lost_world_is_handed_back_as_it_was_with_and_without_differentiation():
    model, states = three_worlds(friction=0.2)
    states = states.replace(vel=states.vel.at[BAD, 0, 1].set(jnp.nan), omega=jnp.ones((3, 1, 3)))
    run = lambda vel: rbd.rollout(model, states.replace(vel=vel), 5)
    direct = run(states.vel)
    final, traj = jax.jit(lambda v: jax.jvp(run, (v,), (v * 0,))[0])(states.vel)
    for name in ("pos", "vel", "quat", "omega", "step", "status"):
        for one, other in ((final, direct[0]), (traj, direct[1])):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12, atol=1e-12)
        if name != "status":
            np.testing.assert_array_equal(getattr(final, name)[BAD], getattr(states, name)[BAD])
    np.testing.assert_array_equal(traj.status[BAD], int(rbd.Status.NOT_FINITE))


def test_a_control_function_of_a_lost_world_spoils_no_parameter():
    """theta is shared through the closure; world BAD has a force of 0 / 0 from the third step on, or starts as NaN."""
    model, states = three_worlds()

    def gradient(states, fails):
        def loss(theta, mass, vel):
            def control(model, state):
                push = theta * state.vel - 0.1 * model.mass[0] * state.pos
                late = fails & (state.step >= 3) & (jnp.arange(len(state.step)) == BAD)
                return rbd.Wrench(force=push / jnp.where(late, 0.0, 1.0)[:, None, None])

            start = states.replace(vel=vel)
            return alive_loss(
                rbd.rollout(model.replace(mass=mass), start, 8, every=4, control=control, checkpoint=3)[0]
            )

        return jax.jit(jax.grad(loss, (0, 1, 2)))(0.3, model.mass, states.vel)

    two = gradient(jax.tree.map(lambda c: c[KEEP], states), False)
    nan = states.replace(vel=states.vel.at[BAD].set(jnp.nan))
    got = gradient(nan, False)
    for a, b in zip((*got[:2], got[2][KEEP]), two):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-13)
    np.testing.assert_array_equal(got[2][BAD], 0.0)
    vel = gradient(states, True)[2]  # the derivative by theta of 0 / 0 is the function's own
    np.testing.assert_allclose(vel[KEEP], two[2], rtol=1e-9, atol=1e-13)
    assert np.isfinite(vel).all()


@pytest.mark.parametrize("solver", ["penalty", "tgs"])
def test_an_explosion_in_float32_spoils_no_gradient(solver):
    """A ball on springs far too stiff for dt (or shot at the ground): speeds grow until they leave the range."""
    with jax.enable_x64(False):
        body = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 0.099), friction=0.5, restitution=0.9)
        scene = rbd.Scene([body], [scenes.ground(friction=0.5)], dt=H)
        model, state = rbd.build(scene, method=rbd.Method(solver=solver, substeps=1))
        speeds = jnp.array([1.0, 1e3, 1e4, 1e5, 1e6, 2e6, 1e7, 1e12, 1e18, 1e30, 3e38])
        states = rbd.batch(state, len(speeds))
        vel = jnp.ones((len(speeds), 1, 3)) * speeds[:, None, None] * jnp.array([1.0, 0.1, -1.0])

        def loss(mass, vel):
            return alive_loss(rbd.rollout(model.replace(mass=mass), states.replace(vel=vel), 40, every=40)[0])

        status = rbd.rollout(model, states.replace(vel=vel), 40, every=40)[0].status
        assert 0 < (np.asarray(status) & 1).sum() < len(speeds)
        for gradient in jax.jit(jax.grad(loss, (0, 1)))(model.mass, vel):
            assert np.isfinite(gradient).all()


def test_a_world_with_numbers_that_are_not_finite_spoils_no_other():
    model, state = rbd.build(scenes.ball(0.11, vel=(1.0, 0, -1.0), friction=0.5), method="fast")
    force = rbd.Wrench(force=jnp.ones((1, 3)))
    loss = lambda mass, gravity: alive_loss(
        rbd.rollout(model.replace(mass=mass, gravity=gravity), state, 8, every=8, control=force)[0]
    )
    slope = jax.jit(jax.grad(loss, (0, 1)))
    mass = jnp.tile(model.mass, (3, 1))
    want, got = slope(mass, model.gravity), slope(mass.at[BAD].set(jnp.nan), model.gravity)
    np.testing.assert_array_equal(got[0][KEEP], want[0][KEEP])
    np.testing.assert_array_equal(got[0][BAD], 0.0)
    np.testing.assert_allclose(got[1], want[1] * 2 / 3, rtol=1e-12)


def test_a_lost_world_in_single_steps_and_second_derivatives():
    model, states = three_worlds()
    vel = states.vel.at[BAD, 0, 0].set(jnp.nan)

    def loss(mass, vel):
        step = lambda s, _: (rbd.step(model.replace(mass=mass), s, rbd.Wrench(force=jnp.ones((1, 3)))), None)
        return alive_loss(jax.lax.scan(step, states.replace(vel=vel), None, length=4)[0])

    slope = jax.jit(jax.grad(loss, (0, 1)))
    (mass, velocity), want = slope(model.mass, vel), slope(model.mass, states.vel)
    assert np.isfinite(mass).all() and (np.asarray(velocity)[BAD] == 0).all()
    np.testing.assert_array_equal(velocity[KEEP], want[1][KEEP])
    curve = jax.jit(jax.jacfwd(jax.grad(loss)))(model.mass, vel)
    assert np.isfinite(curve).all() and float(jnp.abs(curve).max()) > 0


# --- with other transformations ---


def test_gradients_of_mapped_rollouts():
    """grad of vmap, vmap of grad and the direct call agree."""
    model, states = three_worlds()
    end = lambda s: (rbd.rollout(model, s, 6, every=6, checkpoint=2)[0].pos ** 2).sum()
    one = lambda state: lambda vel: end(state.replace(vel=vel))
    direct = jax.jit(jax.grad(lambda vel: end(states.replace(vel=vel))))(states.vel)
    inside = jax.jit(jax.vmap(lambda s, v: jax.grad(one(s))(v)))(states, states.vel)
    outside = jax.jit(jax.grad(lambda vel: jax.vmap(lambda s, v: one(s)(v))(states, vel).sum()))(states.vel)
    np.testing.assert_allclose(inside, direct, rtol=1e-12)
    np.testing.assert_allclose(outside, direct, rtol=1e-12)


def test_control_may_close_over_traced_values_of_any_kind():
    """A parameter and a random key, both traced outside."""
    model, state = rbd.build(flying(), method="fast")

    @jax.jit
    def end(key, theta):
        control = lambda model, state: rbd.Wrench(force=theta * jax.random.normal(key, (1, 3)))
        return rbd.rollout(model, state, 10, control=control)[0].pos[0]

    key = jax.random.key(0)
    want = 0.1**2 / 4 * jax.random.normal(key, (1, 3))[0]
    np.testing.assert_allclose(jax.jacrev(end, 1)(key, 1.0), want, rtol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(end, 1)(key, 1.0), want, rtol=1e-12)
