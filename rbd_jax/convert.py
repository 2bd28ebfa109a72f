"""Layer 8: states to and from MuJoCo's free joints.

MuJoCo: qpos = position of the body frame's origin (not the centre of mass) and quaternion (w, x, y, z);
qvel = velocity of that origin in the world, angular velocity in the *body* frame. Here: velocity of
the centre of mass and angular velocity, both in the world.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from .model import Model, batch_of
from .spatial import Quat, Vec3, pack, quat, vec3
from .state import State


def _arm(model: Model, q: Quat) -> Vec3 | None:
    """From the body frame's origin to the centre of mass, world frame [m]; None when they coincide."""
    if model.com is None:
        return None
    own = model.com.shape[:-2]
    com = model.com.reshape(*own, *(1,) * (q.w.ndim - 1 - len(own)), *model.com.shape[-2:])
    return q.rotate(vec3(com))


def to_mujoco(model: Model, state: State) -> tuple[jax.Array, jax.Array]:
    """MuJoCo's (qpos, qvel) of a state, (..., 7 n) and (..., 6 n), bodies in the scene's order."""
    batch_of(model, state.batch_shape)
    x, v, q = state.x, state.v, state.q
    arm = _arm(model, q)
    if arm is not None:
        x, v = x - arm, v - state.w.cross(arm)
    join = lambda *parts: jnp.concatenate([pack(p) for p in parts], axis=-1)
    qpos, qvel = join(x, q), join(v, q.rotate_inv(state.w))
    flat = lambda a: a.reshape(*a.shape[:-2], -1)
    return flat(qpos), flat(qvel)


def from_mujoco(model: Model, qpos, qvel, state: State | None = None) -> State:
    """The state of MuJoCo's (qpos, qvel), (..., 7 n) and (..., 6 n).

    Args:
      model: from :func:`rbd_jax.build`.
      qpos, qvel: any batch axes.
      state: where the step counter, status and kinematic bodies come from; None: a start state.

    Raises:
      ValueError: wrong shapes.
    """
    n = model.n
    qpos, qvel = jnp.asarray(qpos, model.mass.dtype), jnp.asarray(qvel, model.mass.dtype)
    for name, a, k in (("qpos", qpos, 7), ("qvel", qvel, 6)):
        if a.shape[-1:] != (k * n,):
            raise ValueError(f"from_mujoco: {name} has shape {a.shape}; the model of {n} bodies needs (..., {k * n})")
    if qpos.shape[:-1] != qvel.shape[:-1]:
        raise ValueError(f"from_mujoco: batch axes of qpos {qpos.shape[:-1]} and qvel {qvel.shape[:-1]} differ")
    batch = qpos.shape[:-1]
    qpos, qvel = qpos.reshape(*batch, n, 7), qvel.reshape(*batch, n, 6)
    q = quat(qpos[..., 3:]).normalised()
    w = q.rotate(vec3(qvel[..., 3:]))
    x, v = vec3(qpos[..., :3]), vec3(qvel[..., :3])
    arm = _arm(model, q)
    if arm is not None:
        x, v = x + arm, v + w.cross(arm)
    grow = lambda c: jnp.broadcast_to(c, (*batch, *jnp.shape(c)))
    if state is None:
        kinematic = None
        step, status = grow(jnp.zeros((), jnp.int32)), grow(jnp.zeros((), jnp.uint32))
    else:
        one = lambda c: c if state.batch_shape == batch else grow(c)
        kinematic = jax.tree.map(one, state.kinematic)
        step, status = one(state.step), one(state.status)
    dt = jnp.broadcast_to(model.dt, batch) if model.dt.ndim == 0 else model.dt
    return State(x, v, q, w, step, status, dt, kinematic)
