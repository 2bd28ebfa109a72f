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
    # numbers of two geoms that meet must differ: the larger counts, which has no derivative where they are equal
    own = dict(friction=0.4, restitution=0.3) if name == "a" else dict(friction=0.45, restitution=0.25)
    return rbd.Body(name, rbd.Sphere(0.1), pos=pos, mass=0.8, **own, **kwargs)


def box(name, pos, half=(0.1, 0.12, 0.08), **kwargs):
    return rbd.Body(name, rbd.Box(half), pos=pos, mass=1.2, friction=0.5 if name == "a" else 0.55, **kwargs)


GROUND = rbd.Geom(rbd.Plane(), friction=0.6, restitution=0.1)
MOVING = dict(vel=(0.4, -0.2, -0.3), omega=(0.3, 0.5, -0.2))
#: Faces that are exactly parallel gain and lose points with the last bit, which a law of springs at points feels.
TILT = (0.9999, 0.006, -0.004, 0.01)
SCENES = {
    "sphere-plane, sphere-sphere": rbd.Scene(
        [ball("a", (0, 0, 0.0997), **MOVING), ball("b", (0.15, 0.02, 0.228), vel=(-0.3, 0.1, -0.2))], [GROUND], dt=DT
    ),
    "box-plane": rbd.Scene([box("a", (0, 0, 0.0793), **MOVING)], [rbd.Geom(rbd.Plane(), friction=0.6)], dt=DT),
    "sphere-box": rbd.Scene(
        [
            box("a", (0, 0, 0), **MOVING),
            rbd.Body("b", rbd.Sphere(0.1), pos=(0.03, 0.02, 0.178), mass=0.8, friction=0.4),
        ],
        gravity=(0, 0, -9.81),
        dt=DT,
    ),
    "box-box": rbd.Scene(
        [
            box("a", (0, 0, 0), vel=(0.1, 0.05, 0.3)),
            box("b", (0.03, 0.02, 0.149), (0.07, 0.1, 0.07), quat=TILT, **MOVING),
        ],
        gravity=(0, 0, -9.81),
        dt=DT,
    ),
}
PRESETS = ("fast", "accurate", "gradient", "mujoco")
#: What the suite runs; ``-m slow`` has the others (a minute each, all of it compilation).
ALWAYS = {
    ("sphere-plane, sphere-sphere", "fast"),
    ("box-plane", "gradient"),
    ("sphere-box", "accurate"),
    ("box-box", "mujoco"),
}
EVERY = [
    pytest.param(scene, preset, marks=() if (scene, preset) in ALWAYS else pytest.mark.slow)
    for scene in SCENES
    for preset in PRESETS
]
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
    """model, state and a loss of everything a derivative can be taken in."""
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

        return model, state, loss


@pytest.mark.parametrize("scene, preset", EVERY)
def test_every_leaf_has_the_derivative_of_the_map(scene, preset, contract):
    """Reverse mode against central differences leaf by leaf, forward mode along all; finite at degenerate states."""
    model, state, loss = program(scene, preset)
    args = arguments(model, state)
    value, both = jax.jit(loss), jax.jit(jax.value_and_grad(loss))
    _, gradient = both(args)
    rng = np.random.default_rng(0)
    directions, slopes, worst = {}, {}, {}
    for part, leaves in args.items():
        for name, leaf in leaves.items():
            direction = rng.normal(size=leaf.shape) if leaf.ndim else np.ones(())
            if name == "dt":
                direction = direction * 1e-2
            directions.setdefault(part, {})[name] = direction
            slope = slopes[name] = float((gradient[part][name] * direction).sum())
            moved = lambda h: {**args, part: {**leaves, name: leaf + h * direction}}  # noqa: B023
            central = min(
                (float(value(moved(h)) - value(moved(-h))) / (2 * h) for h in (1e-5, 1e-6)),
                key=lambda c: abs(c - slope),
            )
            worst[name] = abs(central - slope) / max(1.0, abs(slope))
    _, ahead = jax.jit(lambda args, change: jax.jvp(loss, (args,), (change,)))(args, directions)
    modes = abs(float(ahead) - sum(slopes.values())) / max(1.0, *map(abs, slopes.values()))
    contract("leaves", pairs=scene, preset=preset, leaves=sorted(worst), error=max(worst.values()), modes=modes)
    assert max(worst.values()) < 2e-6, worst
    assert modes < 1e-9

    names = []
    for name, changes in degenerate(scene, state).items():
        at, gradient = both({**args, "state": {**args["state"], **changes}})
        bad = [
            jax.tree_util.keystr(k)
            for k, g in jax.tree_util.tree_leaves_with_path(gradient)
            if not np.isfinite(g).all()
        ]
        assert np.isfinite(at) and not bad, (name, bad)
        names.append(name)
    contract("finite", pairs=scene, preset=preset, where=names)


@pytest.mark.parametrize("scene", [pytest.param(s, marks=() if s == "box-plane" else pytest.mark.slow) for s in SCENES])
def test_second_derivatives_in_contact(scene, contract):
    """Hessian-vector product of the pose and the velocities against central differences of the gradient."""
    model, state, loss = program(scene, "gradient")
    args = arguments(model, state)
    start = {name: args["state"][name] for name in ("pos", "vel", "omega")}
    of_state = lambda moved: loss({**args, "state": {**args["state"], **moved}})
    rng = np.random.default_rng(1)
    d = jax.tree.map(lambda c: jnp.asarray(rng.normal(size=c.shape)), start)
    gradient = jax.grad(of_state)
    slope = jax.jit(gradient)
    bend = jax.jit(lambda s: jax.jvp(gradient, (s,), (d,))[1])(start)
    at = lambda h: slope(jax.tree.map(lambda c, d: c + h * d, start, d))
    size = max(float(jnp.abs(c).max()) for c in jax.tree.leaves(bend))
    errors = []
    for h in (1e-5, 1e-6):
        curve = jax.tree.map(lambda a, b: (a - b) / (2 * h), at(h), at(-h))
        errors.append(max(float(jnp.abs(a - b).max()) for a, b in zip(*map(jax.tree.leaves, (curve, bend)))) / size)
    contract("second", pairs=scene, preset="gradient", error=min(errors))
    assert min(errors) < 1e-5, errors


#: Centres at which the surfaces of a scene just touch.
TOUCHING = {
    "sphere-plane, sphere-sphere": [[0, 0, 0.1], [0, 0, 0.3]],
    "box-plane": [[0, 0, 0.08]],
    "sphere-box": [[0, 0, 0], [0, 0, 0.18]],
    "box-box": [[0, 0, 0], [0, 0, 0.15]],
}


def degenerate(scene, state):
    """name -> changes of the state at which a careless derivative is not finite."""
    n = state.n
    turn = lambda *q: jnp.tile(jnp.asarray(q, float), (n, 1))
    still = dict(vel=jnp.zeros((n, 3)), omega=jnp.zeros((n, 3)))
    touching = jnp.array(TOUCHING[scene])
    return {
        "zero velocity, identity attitude": dict(quat=turn(1, 0, 0, 0), **still),
        "distance exactly zero, at rest": dict(pos=touching, quat=turn(1, 0, 0, 0), **still),
        "distance exactly zero, approaching": dict(pos=touching, vel=still["vel"].at[:, 2].set(-1.0)),
        "zero slip under load": dict(vel=still["vel"].at[:, 2].set(-0.5), omega=still["omega"]),
        "half a turn": dict(quat=turn(0, 1, 0, 0)),
        "coincident centres": dict(pos=jnp.tile(jnp.array([[0.0, 0.0, 0.1]]), (n, 1)), **still),
        "far apart": dict(pos=jnp.arange(3 * n).reshape(n, 3) + jnp.array([0, 0, 5.0])),
    }


def told(model, state, force):
    """A number of every public function of a model and a state, (...); ``rollout`` has tests of its own."""
    after, account = rbd.audit(model, state, rbd.wrench_at(force, state.pos + jnp.array([0.0, 0.02, 0.05]), state.pos))
    seen = rbd.contacts(model, after)
    over = lambda c: c.reshape((*state.batch_shape, -1)).sum(-1)
    return {
        "step": over(after.pos) + over(after.vel) + over(after.omega),
        "energy": sum(rbd.energy(model, after)),
        "momentum": sum(map(over, rbd.momentum(model, after))),
        "inertia_world": over(rbd.inertia_world(model, after) * jnp.arange(9.0).reshape(3, 3)),
        "contacts": over(seen.distance) + over(seen.force) + over(seen.point) + over(seen.normal),
        "audit": account.kinetic + account.work + account.dissipated + account.penetration,
    }


def test_every_public_function_in_float32_and_64_batched_and_not():
    """Reverse against forward mode and central differences in float64; a batch in float32 against that."""
    scene = rbd.Scene([box("a", (0, 0, 0.0793), quat=TILT, **MOVING)], [rbd.Geom(rbd.Plane(), friction=0.6)], dt=DT)
    start = np.array([(0, 0, 0.0793), MOVING["vel"], MOVING["omega"], (1.0, -0.5, 0.3)])

    def function():
        model, state = rbd.build(scene, method="fast")

        def f(i):
            rows = lambda k: i[..., k : k + 1, :]
            s = rbd.batch(state, *i.shape[:-2]) if i.ndim > 2 else state
            return told(model, s.replace(pos=rows(0), vel=rows(1), omega=rows(2)), rows(3))

        return f

    f = function()
    d, h = np.random.default_rng(0).normal(size=start.shape), 1e-6
    reverse, value = jax.jit(jax.jacrev(f))(start), jax.jit(f)
    _, forward = jax.jit(lambda i: jax.jvp(f, (i,), (d,)))(start)
    high, low = value(start + h * d), value(start - h * d)
    with jax.enable_x64(False):
        starts = jnp.asarray(np.stack([start, 1.1 * start]), jnp.float32)
        batched = jax.jit(jax.jacrev(function()))(starts)
    for name, slope in reverse.items():
        size = float(jnp.abs(slope).max())
        assert size > 0, name
        along = float((slope * d).sum())
        np.testing.assert_allclose(forward[name], along, atol=1e-10 * size, err_msg=name)
        np.testing.assert_allclose((high[name] - low[name]) / (2 * h), along, atol=1e-6 * size, err_msg=name)
        np.testing.assert_allclose(batched[name][0, 0], slope, atol=2e-3 * size, err_msg=name)
        assert not batched[name][0, 1].any(), f"{name}: a world has no influence on another"


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
