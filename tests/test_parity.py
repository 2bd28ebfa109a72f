"""Agreement with MuJoCo through the public functions, at the three levels of ``rbd_jax.parity``."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax.examples import path
from rbd_jax.mjcf import compile_mujoco
from rbd_jax.parity import validate

mujoco = pytest.importorskip("mujoco")
#: The version these bounds were seen with.
SEEN = "4.0.1"


def wild(**kwargs):
    """A compound body whose centre of mass is off its frame, and a ball."""
    return rbd.Scene(
        bodies=[
            rbd.Body(
                "hammer",
                [rbd.Geom(rbd.Box((0.05, 0.05, 0.2))), rbd.Geom(rbd.Box((0.15, 0.06, 0.05)), pos=(0, 0, 0.25))],
                pos=(0.1, 0.2, 1.0),
                quat=(0.9, 0.1, -0.3, 0.2),
                vel=(1, 0, 0.5),
                omega=(1, 2, 3),
            ),
            rbd.Body("ball", rbd.Sphere(0.1), pos=(1, 0, 1), vel=(0, 1, 0), omega=(3, 0, 1)),
        ],
        dt=0.002,
        **kwargs,
    )


def test_state_conversion_round_trip_and_velocity_conventions():
    with jax.enable_x64(True):
        model, state = rbd.build(wild(), method="fast")
        qpos, qvel = rbd.to_mujoco(model, state)
        back = rbd.from_mujoco(model, qpos, qvel)
        for name in ("pos", "vel", "quat", "omega"):
            np.testing.assert_allclose(getattr(back, name), getattr(state, name), atol=1e-14)
        mj, data = compile_mujoco(wild())
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(mj, data)
        velocity = np.zeros(6)
        for i, name in enumerate(("hammer", "ball")):
            body = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_BODY, name)
            np.testing.assert_allclose(data.xipos[body], state.pos[i], atol=1e-12)
            # mjOBJ_BODY is the inertial frame: rotational first, at the centre of mass
            mujoco.mj_objectVelocity(mj, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
            np.testing.assert_allclose(velocity[:3], state.omega[i], atol=1e-12)
            np.testing.assert_allclose(velocity[3:], state.vel[i], atol=1e-12)
        batched = rbd.from_mujoco(model, jnp.stack([qpos, qpos]), jnp.stack([qvel, qvel]))
        assert batched.pos.shape == (2, 2, 3)
        with pytest.raises(ValueError, match="qpos has shape"):
            rbd.from_mujoco(model, qpos[:-1], qvel)


@pytest.mark.parametrize("integrator", ["euler", "implicitfast", "rk4"])
def test_free_flight_is_mujoco_to_1e10(integrator):
    scene = rbd.Scene(
        bodies=[
            rbd.Body("a", rbd.Box((0.1, 0.2, 0.3)), omega=(1, 2, 3), vel=(1, 0, 2)),
            rbd.Body("b", rbd.Box((0.3, 0.1, 0.2)), pos=(2, 0, 0), quat=(0.5, 0.5, -0.5, 0.5), omega=(0.1, 1, 0)),
        ],
        dt=0.002,
        integrator=integrator,
    )
    with jax.enable_x64(True):
        mj, data = compile_mujoco(scene)
        model, state = rbd.build(scene, method="mujoco")
        final, _ = rbd.rollout(model, state, 1000, every=1000)
        for _ in range(1000):
            mujoco.mj_step(mj, data)
        qpos, qvel = rbd.to_mujoco(model, final)
        np.testing.assert_allclose(qpos, data.qpos, atol=1e-10)
        np.testing.assert_allclose(qvel, data.qvel, atol=1e-10)


def bouncing(friction):
    return rbd.Scene(
        bodies=[
            rbd.Body("low", rbd.Sphere(0.1), pos=(0, 0, 0.5), vel=(1, 0, 0), omega=(0, 3, 1), friction=friction),
            rbd.Body("high", rbd.Sphere(0.15), pos=(0.45, 0.05, 1.0), friction=friction),
        ],
        static=[rbd.Geom(rbd.Plane(), friction=friction)],
        dt=0.002,
    )


def test_bouncing_spheres_follow_mujocos_law():
    """Sphere-plane and sphere-sphere under solref/solimp, equal step, 1 s with bounces: 1e-6."""
    scene = bouncing(0.5)
    with jax.enable_x64(True):
        mj, data = compile_mujoco(scene)
        mj.opt.tolerance, mj.opt.iterations = 0.0, 100
        mj.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        model, state = rbd.build(scene, method="mujoco")
        _, traj = rbd.rollout(model, state, 500)
        ours, met = np.asarray(rbd.to_mujoco(model, traj)[0]), set()
        for k in range(500):
            mujoco.mj_step(mj, data)
            met |= {tuple(sorted(c.geom)) for c in data.contact}
            np.testing.assert_allclose(ours[k + 1], data.qpos, atol=1e-6, err_msg=f"step {k + 1}")
        assert len(met) >= 3, "both spheres met the plane and each other"


def surface(shape, friction=0.8, spin=None, roll=None, **more):
    return rbd.Geom(shape, friction=friction, torsional_friction=spin, rolling_friction=roll, **more)


def moving(name, geom, pos, vel=(0.5, 0.2, 0), omega=(0.3, 4, 12)):
    return rbd.Body(name, geom, pos=pos, vel=vel, omega=omega)


BALL, FLOOR = rbd.Sphere(0.1), rbd.Geom(rbd.Plane(), name="floor")
#: Scenes with the contact dimensions MuJoCo sees in them.
TURNING = {
    "spinning ball": ([moving("ball", surface(BALL, spin=0.02), (0, 0, 0.1))], [FLOOR], {4}),
    "rolling ball": ([moving("ball", surface(BALL, spin=0.02, roll=0.003), (0, 0, 0.1))], [FLOOR], {6}),
    "spinning box": (
        [moving("box", surface(rbd.Box((0.1, 0.15, 0.05)), 0.5, 0.03), (0, 0, 0.05), omega=(0, 0, 15))],
        [FLOOR],
        {4},
    ),
    "ball on a box": (
        [
            moving("box", surface(rbd.Box((0.3, 0.25, 0.05)), 0.6), (0, 0, 0.0499), (0.3, 0, 0), None),
            moving("ball", surface(BALL, spin=0.02, roll=0.004), (0, 0, 0.1997)),
        ],
        [FLOOR],
        {3, 6},
    ),
    # the floor's own coefficients act only on the ball that asks for them
    "condim 3 beside 4": (
        [
            moving("plain", surface(BALL, 0.3, group=1), (0, 0, 0.1)),
            moving("spun", surface(BALL, 0.3, 0.001, group=1), (0.5, 0, 0.1)),
        ],
        [surface(rbd.Plane(), 0.5, 0.01, 0.001, condim=3, group=0, mask=1)],
        {3, 4},
    ),
}


@pytest.mark.parametrize("name", TURNING)
def test_torsional_and_rolling_friction_are_mujocos(name):
    """120 steps of contacts of condim 4 and 6: 1e-10 (seen: 4e-14)."""
    bodies, static, condims = TURNING[name]
    apart = [rbd.Pair("plain", "spun", exclude=True)] if len(condims) == 2 and "plain" in bodies[0].name else []
    scene = rbd.Scene(bodies, static, pairs=apart, impratio=2.0)
    with jax.enable_x64(True):
        mj, data = compile_mujoco(scene)
        mj.opt.tolerance, mj.opt.iterations = 0.0, 100
        mj.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        model, state = rbd.build(scene, method="mujoco")
        _, traj = rbd.rollout(model, state, 120)
        rbd.check(traj)
        qpos, qvel = (np.asarray(x) for x in rbd.to_mujoco(model, traj))
        seen = set()
        for k in range(120):
            mujoco.mj_step(mj, data)
            seen |= {int(c.dim) for c in data.contact}
            np.testing.assert_allclose(qpos[k + 1], data.qpos, atol=1e-10, err_msg=f"step {k + 1}")
            np.testing.assert_allclose(qvel[k + 1], data.qvel, atol=1e-10, err_msg=f"step {k + 1}")
    assert seen == condims
    if name == "condim 3 beside 4":
        assert [g.torsion for g in model.structure.groups] == [False, True]
        warm = state.memory.contacts
        assert warm[0].s is None and warm[1].s is not None and warm[1].r1 is None


def test_rolling_friction_stops_a_ball_in_its_distance():
    """The couple nu m g at the contact slows a rolling ball by a = nu g / (7/5 r), to rest after v^2 / (2 a).

    A large impratio, because the law is soft: below the speed at which its dashpot reaches the cone it only creeps.
    """
    nu, r, v = 0.002, 0.1, 0.3
    slowing = nu * 9.81 / (1.4 * r)
    scene = rbd.Scene(
        [moving("ball", surface(BALL, 0.3, nu, nu), (0, 0, r), (v, 0, 0), (0, v / r, 0))],
        [surface(rbd.Plane(), 0.3)],
        impratio=100.0,
    )
    with jax.enable_x64(True):
        model, state = rbd.build(scene, method="mujoco")
        _, traj = rbd.rollout(model, state, 1300, every=10)
        x, speed, spin = (np.asarray(c) for c in (traj.pos[:, 0, 0], traj.vel[:, 0, 0], traj.omega[:, 0, 1]))
    time = 0.02 * np.arange(131)
    rolling = time < 0.95 * v / slowing
    np.testing.assert_allclose(speed[rolling], v - slowing * time[rolling], atol=2e-3 * v)
    assert x[-1] == pytest.approx(v * v / (2 * slowing), rel=3e-4)
    assert abs(speed[-1]) < 1e-6 and abs(spin[-1]) < 1e-5


def test_torsional_friction_turns_a_ball_with_the_surface_below():
    """A ball at rest on a plate that turns: its spin grows by nu g / (2/5 r^2) until it is the plate's."""
    nu, r, plate = 0.004, 0.1, 5.0
    growing = nu * 9.81 / (0.4 * r * r)
    ball = rbd.Body("ball", surface(BALL, 0.3, nu), pos=(0, 0, r))
    scene = rbd.Scene([ball], kinematic=[rbd.Body("plate", surface(rbd.Plane(), 0.3), omega=(0, 0, plate))])
    with jax.enable_x64(True):
        model, state = rbd.build(scene, method="mujoco")

        def spin(nu, steps):
            return rbd.rollout(model.replace(torsional_friction=nu), state, steps, every=steps)[0].omega[0, 2]

        value, slope = jax.jvp(lambda nu: spin(nu, 100), (model.torsional_friction,), (jnp.asarray([1.0, 0.0]),))
        end = spin(model.torsional_friction, 500)
    assert value == pytest.approx(0.2 * growing, rel=1e-3)
    assert slope == pytest.approx(0.2 * growing / nu, rel=3e-3)
    assert end == pytest.approx(plate, rel=1e-3)


def test_solvers_without_angular_rows_refuse_torsional_friction():
    scene = rbd.Scene([moving("ball", surface(BALL, spin=0.0), (0, 0, 0.1))], [FLOOR])
    with pytest.raises(ValueError, match="solver 'penalty' has no torsional or rolling friction"):
        rbd.build(scene, method=rbd.Method(solver="penalty"))


@pytest.mark.parametrize("name", ["tumbling_box", "box_stack"])
def test_shipped_scenes_agree_at_all_levels(name):
    report = validate(rbd.load_mjcf(path(name)), method="mujoco", steps=60)
    assert report.ok, report.table()
