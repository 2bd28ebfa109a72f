"""Derivatives of the discrete map: every leaf, every integrator, and where they degenerate.

Float64; reverse mode against central differences along one direction of every leaf.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax.integrators import INTEGRATORS

DT = 1 / 120
STEPS = 4


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


def ball(name, pos, **kwargs):
    return rbd.Body(name, rbd.Sphere(0.1), pos=pos, mass=0.8, friction=0.4, restitution=0.3, **kwargs)


GROUND = rbd.Geom(rbd.Plane(), friction=0.6, restitution=0.1)
MOVING = dict(vel=(0.4, -0.2, -0.3), omega=(0.3, 0.5, -0.2))
SCENES = {
    "sphere-plane, sphere-sphere": rbd.Scene(
        [ball("a", (0, 0, 0.0995), **MOVING), ball("b", (0.15, 0.02, 0.228), vel=(-0.3, 0.1, -0.2))], [GROUND], dt=DT
    ),
}
EVERY = [("sphere-plane, sphere-sphere", "fast")]
#: Leaves of the model that are differentiated where a scene has them.
LEAVES = ("dt", "mass", "inertia", "gravity", "friction", "restitution", "radius", "half_extents", "static_pos")


def arguments(model, state):
    """Everything a derivative can be taken in, as a tree."""
    return {
        "model": {name: getattr(model, name) for name in LEAVES if getattr(model, name) is not None},
        "state": {name: getattr(state, name) for name in ("pos", "vel", "quat", "omega")},
        "control": {"force": jnp.full((model.n, 3), 0.3), "torque": jnp.full((model.n, 3), 0.01)},
    }


@functools.cache
def program(scene, preset):
    """model, state, jitted loss and jitted value_and_grad of it."""
    with jax.enable_x64(True):
        model, state = rbd.build(SCENES[scene], method=preset)

        def loss(args):
            final, _ = rbd.rollout(
                model.replace(**args["model"]),
                state.replace(**args["state"]),
                STEPS,
                every=STEPS,
                control=rbd.Wrench(args["control"]["force"], args["control"]["torque"]),
            )
            out = jnp.concatenate([final.pos, final.quat, 0.1 * final.vel, 0.1 * final.omega], axis=-1)
            return (out * jnp.cos(jnp.arange(out.size).reshape(out.shape))).sum()

        return model, state, jax.jit(loss), jax.jit(jax.value_and_grad(loss))


@pytest.mark.parametrize("scene, preset", EVERY)
def test_every_leaf_has_the_derivative_of_the_map(scene, preset, contract):
    model, state, loss, both = program(scene, preset)
    args = arguments(model, state)
    _, gradient = both(args)
    rng = np.random.default_rng(0)
    worst = {}
    for part, leaves in args.items():
        for name, value in leaves.items():
            direction = rng.normal(size=value.shape) if value.ndim else np.ones(())
            if name == "dt":
                direction = direction * 1e-2
            slope = float((gradient[part][name] * direction).sum())
            moved = lambda h: {**args, part: {**leaves, name: value + h * direction}}  # noqa: B023
            central = min(
                (float(loss(moved(h)) - loss(moved(-h))) / (2 * h) for h in (1e-5, 1e-6)), key=lambda c: abs(c - slope)
            )
            worst[name] = abs(central - slope) / max(1.0, abs(slope))
    contract("leaves", pairs=scene, preset=preset, leaves=sorted(worst), error=max(worst.values()))
    assert max(worst.values()) < 2e-6, worst


def degenerate(state):
    """name -> changes of the state at which a careless derivative is not finite."""
    n = state.n
    turn = lambda *q: jnp.tile(jnp.asarray(q, float), (n, 1))
    still = dict(vel=jnp.zeros((n, 3)), omega=jnp.zeros((n, 3)))
    touching = jnp.array([[0, 0, 0.1], [0, 0, 0.3]])
    return {
        "zero velocity, identity attitude": dict(quat=turn(1, 0, 0, 0), **still),
        "distance exactly zero, at rest": dict(pos=touching, quat=turn(1, 0, 0, 0), **still),
        "distance exactly zero, approaching": dict(pos=touching, vel=still["vel"].at[:, 2].set(-1.0)),
        "zero slip under load": dict(vel=still["vel"].at[:, 2].set(-0.5), omega=still["omega"]),
        "half a turn": dict(quat=turn(0, 1, 0, 0)),
        "coincident centres": dict(pos=jnp.tile(jnp.array([[0.0, 0.0, 0.1]]), (n, 1)), **still),
        "far apart": dict(pos=jnp.arange(3 * n).reshape(n, 3) + jnp.array([0, 0, 5.0])),
    }


@pytest.mark.parametrize("scene, preset", EVERY)
def test_derivatives_are_finite_where_they_degenerate(scene, preset, contract):
    model, state, _, both = program(scene, preset)
    args = arguments(model, state)
    names = []
    for name, changes in degenerate(state).items():
        value, gradient = both({**args, "state": {**args["state"], **changes}})
        bad = [
            jax.tree_util.keystr(k)
            for k, g in jax.tree_util.tree_leaves_with_path(gradient)
            if not np.isfinite(g).all()
        ]
        assert np.isfinite(value) and not bad, (name, bad)
        names.append(name)
    contract("finite", pairs=scene, preset=preset, where=names)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_every_integrator(name, contract):
    """Free flight of a tumbling box: gradient and Hessian-vector product in velocity, spin and inertia."""
    method = rbd.Method(integrator=name)
    scene = rbd.Scene([rbd.Body("box", rbd.Box((0.3, 0.2, 0.1)), mass=1.0, omega=(1, 2, -1), vel=(1, 0, 0))], dt=0.02)
    model, state = rbd.build(scene, method=method)

    def loss(i):
        s = state.replace(vel=i[None, :3], omega=i[None, 3:6])
        final, _ = rbd.rollout(model.replace(inertia=i[None, 6:9]), s, 3, every=3)
        return final.pos[0] @ jnp.array([1.0, 2, 3]) + final.quat[0] @ jnp.array([1.0, -1, 2, 3])

    i = jnp.concatenate([state.vel[0], state.omega[0], model.inertia[0]])
    d = jnp.asarray(np.random.default_rng(1).normal(size=9)) * jnp.array([1.0] * 6 + [1e-3] * 3)
    gradient = jax.jit(jax.grad(loss))
    bend = jax.jit(lambda i: jax.jvp(jax.grad(loss), (i,), (d,))[1])(i)
    h = 1e-5
    slope = (jax.jit(loss)(i + h * d) - jax.jit(loss)(i - h * d)) / (2 * h)
    curve = (gradient(i + h * d) - gradient(i - h * d)) / (2 * h)
    first = abs(slope - gradient(i) @ d) / abs(slope)
    second = np.abs(curve - bend).max() / np.abs(bend).max()
    contract("integrators", integrator=name, first=float(first), second=float(second))
    assert first < 1e-7 and second < 1e-6
