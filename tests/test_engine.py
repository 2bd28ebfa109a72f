"""The engine through its public functions: laws first, then closed forms, then the contract of the API."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

import rbd_jax as rbd
from rbd_jax.step import limit

G = 9.81
PRESETS = ["fast", "accurate"]


def run(scene, seconds, method, every=1, **kwargs):
    model, state = rbd.build(scene, method=method)
    steps = round(seconds / scene.dt)
    final, traj = rbd.rollout(model, state, steps, every=every, **kwargs)
    rbd.check(final)
    return model, final, traj


# --- laws ---


@pytest.mark.parametrize("method", PRESETS)
def test_collision_between_bodies_keeps_momentum(method):
    model, _, traj = run(scenes.two_spheres(), 1.0, method)
    P, L = rbd.momentum(model, traj)
    np.testing.assert_allclose(P, np.broadcast_to(P[0], P.shape), atol=2e-6)
    np.testing.assert_allclose(L, np.broadcast_to(L[0], L.shape), atol=5e-6)
    kinetic = np.asarray(rbd.energy(model, traj)[0])
    assert kinetic[-1] < 0.9 * kinetic[0]


@pytest.mark.parametrize("method", PRESETS)
def test_energy_never_rises_without_restitution(method):
    model, _, traj = run(scenes.box(0.5), 2.0, method)
    total = np.asarray(sum(rbd.energy(model, traj)), np.float64)
    allowed = 1e-3 * float(model.mass[0]) * G * 0.1
    assert np.diff(total).max() <= allowed


@pytest.mark.parametrize("method", PRESETS)
@pytest.mark.parametrize("scene", [scenes.ball(0.5), scenes.box(0.5)], ids=["sphere", "box"])
def test_comes_to_rest_and_stays(method, scene):
    _, _, traj = run(scene, 4.0, method, every=24)
    late = np.asarray(traj.time) >= 2.0
    assert np.abs(np.asarray(traj.vel)[late]).max() < 1e-4


# --- closed forms ---


@pytest.mark.parametrize("method", PRESETS)
def test_slides_to_stop(method):
    _, final, traj = run(scenes.cube_sliding(), 2.0, method, every=8)
    want = 3.0**2 / (2 * scenes.MU * G)
    assert abs(float(final.pos[0, 0]) / want - 1) < 5e-3
    assert np.asarray(traj.pos)[:, 0, 2].max() < 0.1 + 1e-4


@pytest.mark.parametrize("method", [*PRESETS, rbd.Method("symtop2", None, "pgs")], ids=["fast", "accurate", "pgs"])
def test_slides_straight_whatever_way_it_lies(method):
    """Friction is against the slip: a flat box neither swerves nor turns, though its tangents differ in mass."""
    half, speed = (0.2, 0.15, 0.1), 3.0
    body = rbd.Body("box", rbd.Box(half), pos=(0, 0, half[2]), friction=scenes.MU)
    floor = rbd.Geom(rbd.Plane(), friction=scenes.MU)
    model, one = rbd.build(rbd.Scene([body], [floor], dt=1 / 240), method=method)
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False) + 0.3
    zero = np.zeros((8, 1))
    lies = np.stack([np.cos(angle), zero[:, 0], zero[:, 0], np.sin(angle)], -1)
    heads = np.stack([np.cos(2.5 * angle), np.sin(2.5 * angle), zero[:, 0]], -1)
    state = rbd.batch(one, 8).replace(vel=speed * heads[:, None], quat=lies[:, None])
    final = rbd.rollout(model, state, 240, every=240)[0]
    want = speed**2 / (2 * scenes.MU * G) * heads
    np.testing.assert_allclose(np.asarray(final.pos)[:, 0, :2], want[:, :2], atol=5e-3 * np.abs(want).max())
    np.testing.assert_allclose(np.abs((np.asarray(final.quat)[:, 0] * lies).sum(-1)), 1.0, atol=1e-5)


@pytest.mark.parametrize("method", PRESETS)
def test_slips_until_it_rolls(method):
    scene = scenes.ball(0.1, vel=(3.0, 0, 0), friction=scenes.MU)
    _, final, _ = run(scene, 1.5, method, every=8)
    assert abs(float(final.vel[0, 0]) / (5 / 7 * 3.0) - 1) < 1e-3
    assert abs(float(final.omega[0, 1]) * 0.1 / (5 / 7 * 3.0) - 1) < 2e-3


@pytest.mark.parametrize("method,tolerance", [("fast", 5e-2), ("accurate", 1e-2)])
def test_bounces_to_the_right_heights(method, tolerance):
    _, _, traj = run(scenes.ball(restitution=0.8), 4.0, method)
    z, v = np.asarray(traj.pos)[:, 0, 2] - 0.1, np.asarray(traj.vel)[:, 0, 2]
    apex = [i for i in range(1, len(z) - 1) if z[i] > z[i - 1] and z[i] >= z[i + 1] and z[i] > 0.01]
    heights = (z + v**2 / (2 * G))[apex[:5]]
    np.testing.assert_allclose(heights, 0.8 ** (2 * np.arange(1, 6)), rtol=tolerance)


@pytest.mark.parametrize("method", PRESETS)
def test_stack_of_five_stands(method):
    _, final, traj = run(scenes.stack(5), 10.0, method, every=240)
    home = 0.1 * (2 * np.arange(5) + 1)
    assert np.abs(np.asarray(traj.pos)[:, :, :2]).max() < 2e-3
    assert np.abs(np.asarray(traj.pos)[:, :, 2] - home).max() < 4e-3
    assert np.abs(np.asarray(final.vel)).max() < 1e-3


def test_contact_kinds_are_told_apart():
    model, state = rbd.build(scenes.ball(restitution=0.8), method="fast")
    seen = rbd.contacts(model, state)
    assert int(seen.kind[0]) == 0 and not bool(seen.live[0]) and float(seen.distance[0]) == pytest.approx(1.0)
    touching, _ = rbd.rollout(model, state.replace(pos=jnp.array([[0, 0, 0.0999]]), vel=jnp.array([[0, 0, -2.0]])), 0)
    assert int(rbd.contacts(model, touching).kind[0]) == 2
    bounced = rbd.step(model, touching)
    seen = rbd.contacts(model, bounced)
    assert int(seen.kind[0]) == 3 and bool(seen.live[0])
    impulse = float(model.mass[0]) * (1.8 * 2.0)
    assert float(seen.force[0, 2]) / 240 == pytest.approx(impulse, rel=1e-2)
    model, state = rbd.build(scenes.ball(0.1), method="fast")
    final, _ = rbd.rollout(model, state, 240)
    seen = rbd.contacts(model, final)
    assert int(seen.kind[0]) == 1 and bool(seen.live[0])
    weight = float(model.mass[0]) * G
    np.testing.assert_allclose(seen.force[0], [0, 0, weight], rtol=1e-4, atol=1e-3 * weight)
    assert int(seen.body_a[0]) == -1 and int(seen.body_b[0]) == 0
    np.testing.assert_allclose(seen.normal[0], [0, 0, 1])


def test_conveyor_carries_a_box():
    scene = rbd.Scene(
        bodies=[rbd.Body("box", rbd.Box((0.1, 0.1, 0.1)), pos=(0, 0, 0.1), friction=0.5)],
        kinematic=[rbd.Body("belt", rbd.Box((5.0, 1.0, 0.1)), pos=(0, 0, -0.1), vel=(1.0, 0, 0), friction=0.5)],
        dt=1 / 240,
    )
    _, final, _ = run(scene, 1.0, "fast", every=240)
    assert float(final.vel[0, 0]) == pytest.approx(1.0, abs=1e-3)
    slip = 1.0 / (2 * 0.5 * G)  # v^2 / (2 mu g): how far the belt runs ahead
    assert float(final.pos[0, 0]) == pytest.approx(1.0 - slip, abs=2e-3)
    np.testing.assert_allclose(final.kinematic_pos[0], [1.0, 0, -0.1], atol=1e-5)


def test_friction_combines_by_the_larger_value_and_pairs_override():
    def slide(body, plane, pairs=()):
        scene = rbd.Scene(
            bodies=[rbd.Body("box", rbd.Box((0.1, 0.1, 0.1)), pos=(0, 0, 0.1), vel=(2.0, 0, 0), friction=body)],
            static=[rbd.Geom(rbd.Plane(), friction=plane, name="floor")],
            pairs=pairs,
            dt=1 / 240,
        )
        return float(run(scene, 3.0, "fast", every=720)[1].pos[0, 0])

    stop = lambda mu: 2.0**2 / (2 * mu * G)
    assert slide(0.2, 0.5) == pytest.approx(stop(0.5), rel=5e-3)
    assert slide(0.6, 0.5) == pytest.approx(stop(0.6), rel=5e-3)
    assert slide(0.6, 0.5, [rbd.Pair("box", "floor", friction=0.2)]) == pytest.approx(stop(0.2), rel=5e-3)
    assert slide(0.6, 0.5, [rbd.Pair("box", "floor", friction=None)]) == pytest.approx(6.0, rel=1e-4)


def test_masked_and_excluded_geoms_pass_through_each_other():
    for kwargs, pairs in (({"mask": 0, "group": 0}, ()), ({}, [rbd.Pair("ball", "static:0", exclude=True)])):
        scene = rbd.Scene(
            [rbd.Body("ball", rbd.Geom(rbd.Sphere(0.1), **kwargs), pos=(0, 0, 0.2))],
            static=[rbd.Plane()],
            pairs=pairs,
            dt=1 / 240,
        )
        model, final, _ = run(scene, 1.0, "fast", every=240)
        assert not model.structure.groups
        assert float(final.pos[0, 2]) == pytest.approx(0.2 - 0.5 * G, rel=1e-4)


@pytest.mark.parametrize("method", PRESETS)
def test_restitution_at_several_corners_never_adds_energy(method):
    """Newton's law alone added half the energy scale m g d in single steps of a tumbling box with e = 0.9."""
    scene = rbd.Scene(
        bodies=[
            rbd.Body("b", rbd.Box((0.1, 0.15, 0.2)), pos=(0, 0, 0.6), omega=(1, 2, 3), restitution=0.9, friction=0.5)
        ],
        static=[scenes.ground(friction=0.5)],
        dt=1 / 240,
    )
    model, state = rbd.build(scene, method=method)
    rng = np.random.RandomState(1)
    quat = rng.randn(16, 1, 4)
    state = rbd.batch(state, 16)
    state = state.replace(
        quat=quat / np.linalg.norm(quat, axis=-1, keepdims=True), omega=4 * rng.randn(16, 1, 3), vel=rng.randn(16, 1, 3)
    )
    final, traj = rbd.rollout(model, state, 360)
    total = np.asarray(sum(rbd.energy(model, traj)), np.float64)
    assert np.diff(total, axis=1).max() <= 1e-3 * float(model.mass[0]) * G * 0.1
    assert (total[:, -1] < total[:, 0]).all() and np.isfinite(np.asarray(final.pos)).all()


# --- the contract of the API ---


@pytest.fixture(scope="module")
def worlds():
    model, state = rbd.build(scenes.box(0.4), method="fast")
    states = rbd.batch(state, 3)
    return model, states.replace(pos=states.pos + 0.05 * jnp.arange(3.0)[:, None, None])


def test_shapes_and_samples(worlds):
    model, states = worlds
    final, traj = rbd.rollout(model, states, 50, every=20)
    assert traj.pos.shape == (3, 3, 1, 3) and traj.quat.shape == (3, 3, 1, 4)
    np.testing.assert_array_equal(traj.step, np.broadcast_to([0, 20, 40], (3, 3)))
    np.testing.assert_allclose(traj.time, np.asarray(traj.step) / 240, rtol=1e-6)
    np.testing.assert_array_equal(traj.pos[:, 0], states.pos)
    np.testing.assert_array_equal(final.step, [50, 50, 50])
    assert traj.memory is None


def test_vmap_is_the_direct_call(worlds):
    model, states = worlds
    direct = rbd.rollout(model, states, 50, every=20)
    mapped = jax.vmap(lambda s: rbd.rollout(model, s, 50, every=20))(states)
    for a, b in zip(jax.tree.leaves(direct), jax.tree.leaves(mapped)):
        np.testing.assert_array_equal(a, b)
    one = jax.tree.map(lambda c: c[1], states)
    final, _ = rbd.rollout(model, one, 50, every=20)
    np.testing.assert_allclose(final.pos, direct[0].pos[1], atol=1e-5)


def test_scan_over_step_is_rollout(worlds):
    model, states = worlds
    final, _ = rbd.rollout(model, states, 50, every=20)
    scanned = jax.jit(lambda s: jax.lax.scan(lambda s, _: (rbd.step(model, s), None), s, None, length=50)[0])(states)
    np.testing.assert_allclose(scanned.pos, final.pos, atol=2e-5)
    np.testing.assert_allclose(scanned.omega, final.omega, atol=1e-3)
    np.testing.assert_array_equal(scanned.step, final.step)


def test_rollout_in_two_parts(worlds):
    model, states = worlds
    whole, _ = rbd.rollout(model, states, 50, every=20)
    half, _ = rbd.rollout(model, states, 25, every=20)
    half, _ = rbd.rollout(model, half, 25, every=20)
    np.testing.assert_allclose(half.pos, whole.pos, atol=1e-5)


def test_numbers_per_world_and_no_recompilation(worlds):
    from rbd_jax.rollout import _rollout

    model, state = rbd.build(scenes.ball(0.5), method="fast")
    rbd.rollout(model, state, 60, every=60)
    before = _rollout._cache_size()
    heavier = model.replace(mass=model.mass * 2, friction=model.friction * 0.5, radius=model.radius * 1.1)
    rbd.rollout(heavier, state, 60, every=60)
    again, start = rbd.build(scenes.ball(0.7), method="fast")
    rbd.rollout(again, start, 60, every=60)
    assert _rollout._cache_size() == before, "new numbers or an equal scene must not compile again"
    gravity = jnp.array([[0, 0, -9.81], [0, 0, -1.62], [0, 0, 0]])
    direct, _ = rbd.rollout(model.replace(gravity=gravity), state, 20, every=20)
    mapped = jax.vmap(lambda g: rbd.rollout(model.replace(gravity=g), state, 20, every=20)[0])(gravity)
    t = 20 / 240
    np.testing.assert_allclose(direct.pos[:, 0, 2], 0.5 + 0.5 * gravity[:, 2] * t**2, atol=1e-6)
    np.testing.assert_array_equal(direct.pos, mapped.pos)


def test_control_constant_and_function(worlds):
    model, states = worlds
    push = rbd.Wrench(force=jnp.array([[0.0, 0.0, 50.0]]), torque=jnp.array([[0.1, 0.0, 0.0]]))
    constant, _ = rbd.rollout(model, states, 20, every=20, control=push)
    function, _ = rbd.rollout(model, states, 20, every=20, control=lambda m, s: push)
    np.testing.assert_allclose(constant.pos, function.pos, atol=1e-6)
    stepped = rbd.step(model, states, push)
    assert float(stepped.vel[0, 0, 2]) == pytest.approx((50.0 / float(model.mass[0]) - G) / 240, rel=1e-4)
    lever = rbd.wrench_at(jnp.array([0.0, 0, 1.0]), jnp.array([1.0, 0, 0]), jnp.zeros(3))
    np.testing.assert_allclose(lever.torque, [0, -1, 0])


@pytest.mark.parametrize("shape", [rbd.Box((0.1, 0.2, 0.3)), rbd.Sphere(0.137)], ids=["box", "sphere"])
def test_angular_momentum_survives_single_steps(shape):
    """1e5 calls of step: omega is turned into L and back every time, L must not drift (f32).

    Roundings of 6e-8 that lean one way would add up to 6e-3, those that do not walk 2e-5 away.
    """
    scene = rbd.Scene(bodies=[rbd.Body("top", shape, omega=(1.0, 2.0, 3.0))], gravity=None, dt=0.005)
    model, state = rbd.build(scene, method="fast")
    many = jax.jit(lambda s: jax.lax.scan(lambda s, _: (rbd.step(model, s), None), s, None, length=100_000)[0])
    before, after = rbd.momentum(model, state)[1], rbd.momentum(model, many(state))[1]
    assert float(jnp.linalg.norm(after - before) / jnp.linalg.norm(before)) < 4e-5


@pytest.mark.parametrize("worlds", [1, 33])
def test_worlds_are_lost_at_the_step_at_which_they_are(worlds):
    """A rollout asks for them once a block of steps, one that keeps every step at once: the same worlds are held at the
    same states, wherever in a block one is lost and however many. Some are lost from the start."""
    scene = rbd.Scene([rbd.Body("box", rbd.Box((0.1, 0.15, 0.2)), omega=(0.3, 0.2, 0.1))], gravity=None, dt=1.0)
    model, state = rbd.build(scene, dt=1.0, method="fast")
    after = np.resize([0.5, 1, 2, 30, 31, 32, 33, 34, 63, 64, 65, 66, 90, 1e9, 1e9], worlds) if worlds > 1 else [40.0]
    vel = np.zeros((worlds, 1, 3), np.float32)
    vel[:, 0, 0] = limit(np.float32) / (np.array(after) + 0.5)  # out of range after so many steps, or one less
    vel[np.arange(worlds) % 11 == 10] = np.nan
    start, steps = rbd.batch(state, worlds).replace(vel=vel), 96
    final, _ = rbd.rollout(model, start, steps, every=steps)
    for every in (1, 37):
        other, _ = rbd.rollout(model, start, steps, every=every)
        for name in ("pos", "vel", "omega", "quat", "step", "status"):
            atol = 2e-5 if every == 1 and name in ("omega", "quat") else 0.0  # another program rounds otherwise
            np.testing.assert_allclose(getattr(other, name), getattr(final, name), 0, atol, err_msg=f"{name}, {every}")
    made = np.where(np.isnan(vel[:, 0, 0]), 0, np.minimum(np.floor(after), steps))
    np.testing.assert_array_equal(np.asarray(final.status), np.where(made < steps, int(rbd.Status.NOT_FINITE), 0))
    np.testing.assert_allclose(np.asarray(final.step), made, atol=1)


def test_diverged_world_is_frozen_and_its_neighbours_do_not_notice(worlds):
    model, states = worlds
    benign, _ = rbd.rollout(model, states, 30, every=20)
    bad = states.replace(vel=states.vel.at[1].set(jnp.inf))
    final, traj = rbd.rollout(model, bad, 30, every=20)
    np.testing.assert_array_equal(final.status, [0, int(rbd.Status.NOT_FINITE), 0])
    for k in (0, 2):
        for a, b in zip(jax.tree.leaves(final), jax.tree.leaves(benign)):
            np.testing.assert_array_equal(a[k], b[k])
    np.testing.assert_array_equal(final.pos[1], bad.pos[1])
    assert int(final.step[1]) == 0
    with pytest.raises(rbd.SimulationError, match="world 1: NOT_FINITE.*Remedy") as caught:
        rbd.check(final)
    assert caught.value.worlds == (1,)


def test_an_unconverged_solver_warns_and_the_rest_raises(worlds):
    model, states = worlds
    with pytest.warns(RuntimeWarning, match="world 2: NOT_CONVERGED.*Remedy"):
        rbd.check(states.replace(status=jnp.array([0, 0, 4], jnp.uint32)))
    with pytest.raises(rbd.SimulationError, match="world 0: CAPACITY"):
        rbd.check(states.replace(status=jnp.array([2, 0, 4], jnp.uint32)))


def test_energy_momentum_inertia_agree_with_numpy(worlds):
    model, states = worlds
    m, half = float(model.mass[0]), np.array([0.1, 0.15, 0.2])
    body = m / 3 * (np.sum(half**2) - half**2)
    kinetic, potential = rbd.energy(model, states)
    w = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(kinetic, 0.5 * np.sum(body * w**2), rtol=1e-6)
    np.testing.assert_allclose(potential, m * G * np.asarray(states.pos)[:, 0, 2], rtol=1e-6)
    np.testing.assert_allclose(rbd.inertia_world(model, states)[0, 0], np.diag(body), rtol=1e-6, atol=1e-6)


def test_kinematic_and_quaternion_replace(worlds):
    model, states = worlds
    half = np.sqrt(0.5).astype(np.float32)
    turned = states.replace(quat=jnp.array([half, 0, 0, half]))
    np.testing.assert_array_equal(turned.omega, states.omega)
    np.testing.assert_allclose(
        np.diag(rbd.inertia_world(model, turned)[0, 0]),
        np.diag(rbd.inertia_world(model, states)[0, 0])[[1, 0, 2]],
        rtol=1e-5,
    )


@pytest.mark.parametrize("method", PRESETS)
def test_gradients_are_finite_and_match_differences(method):
    with jax.enable_x64(True):
        model, state = rbd.build(scenes.ball(0.3, vel=(1.0, 0, 0)), method=method)

        def height(v):
            final, _ = rbd.rollout(model, state.replace(vel=v), 20, every=20)
            return final.pos[0, 0] + final.pos[0, 2]

        gradient = jax.grad(height)(state.vel)
        eps = 1e-5
        for k in (0, 2):
            d = jnp.zeros((1, 3)).at[0, k].set(eps)
            difference = (height(state.vel + d) - height(state.vel - d)) / (2 * eps)
            assert float(gradient[0, k]) == pytest.approx(float(difference), rel=1e-6, abs=1e-8)


# --- bad input ---


@pytest.mark.parametrize(
    "call,message",
    [
        (lambda m, s: rbd.rollout(m, s, -1), "steps = -1"),
        (lambda m, s: rbd.rollout(m, s, 10, every=0), "every = 0"),
        (lambda m, s: rbd.rollout(m, s, 2.5), "steps = 2.5"),
        (lambda m, s: rbd.step(m, s, rbd.Wrench(force=jnp.zeros((2, 3)))), r"control.force has shape \(2, 3\)"),
        (lambda m, s: rbd.step(m, s, 3.0), "control = float"),
        (lambda m, s: s.replace(pos=jnp.zeros((4, 3))), r"State.pos has shape \(4, 3\)"),
        (lambda m, s: s.replace(speed=0), "no field 'speed'"),
        (lambda m, s: m.replace(mass=-1.0), "Model.mass"),
        (lambda m, s: m.replace(mass=jnp.array([-1.0])), r"Model.mass\[0\] = -1.0 must be finite and > 0"),
        (lambda m, s: m.replace(restitution=jnp.zeros(2)), "Model.restitution is absent"),
        (lambda m, s: m.replace(inertia=jnp.ones(1)), "Model.inertia"),
        (lambda m, s: m.replace(weight=1), "no leaf 'weight'"),
        (lambda m, s: rbd.rollout(m.replace(gravity=jnp.zeros((5, 3))), s, 1), "batch sizes do not match"),
        (lambda m, s: rbd.batch(s, 0), "batch size = 0"),
        (lambda m, s: rbd.build(scenes.ball(), dt=0.0), "dt = 0.0"),
        (lambda m, s: rbd.build(scenes.ball(), method="best"), "unknown method 'best'"),
        (lambda m, s: rbd.build(scenes.ball(), method=rbd.Method(solver="xpbd")), "unknown solver 'xpbd'"),
        (lambda m, s: rbd.build(scenes.ball(), method=rbd.Method(integrator="verlet")), "unknown integrator 'verlet'"),
        (lambda m, s: rbd.build(scenes.ball(), method=rbd.Method(substeps=0)), "substeps = 0"),
        (lambda m, s: rbd.build(scenes.ball(), method=rbd.Method(integrator="rk4")), "free motion"),
        (
            lambda m, s: rbd.build(scenes.ball(), method=rbd.Method(contact="soft", solver="mujoco")),
            "speaks contact model",
        ),
    ],
)
def test_bad_input_is_refused_by_name(worlds, call, message):
    with pytest.raises(ValueError, match=message):
        call(*worlds)


@pytest.mark.parametrize("attitude", ["matrix", "quaternion"])
def test_lecture_integrators_work_with_contact(attitude):
    from rbd_jax.integrators import SemiImplicitEuler

    integrator = SemiImplicitEuler(attitude=attitude)
    model, state = rbd.build(scenes.box(0.3), method=rbd.Method(integrator=integrator, solver="tgs"))
    state = rbd.step(model, state)
    half = np.sqrt(0.5).astype(np.float32)
    turned = state.replace(quat=jnp.array([half, half, 0, 0]))
    np.testing.assert_allclose(rbd.step(model, turned).quat[0], turned.quat[0], atol=0.02)
    final, _ = rbd.rollout(model, state, 720, every=720)
    rbd.check(final)
    assert np.abs(np.asarray(final.vel)).max() < 1e-4
