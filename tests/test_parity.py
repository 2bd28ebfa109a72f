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


@pytest.mark.parametrize("name", ["tumbling_box", "box_stack"])
def test_shipped_scenes_agree_at_all_levels(name):
    report = validate(rbd.load_mjcf(path(name)), method="mujoco", steps=60)
    assert report.ok, report.table()
