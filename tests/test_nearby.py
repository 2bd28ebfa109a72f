"""Soft contact looks at what may touch within the step; what it leaves out would have done nothing."""

import dataclasses
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax.detect import detect
from rbd_jax.solvers import TGS
from rbd_jax.solvers.laws import Soft


@dataclasses.dataclass(frozen=True)
class Everything(Soft):
    """Every slot, however far."""

    reach = "all"


def heap():
    """Boxes and balls that fall on each other in a corner, with spin."""
    draw = np.random.default_rng(0)
    bodies = []
    for k in range(4):
        shape = rbd.Box((0.1, 0.05, 0.08)) if k % 2 else rbd.Sphere(0.08)
        pos = tuple(np.array([0.15, 0.15, 0.12 + 0.18 * k]) + draw.uniform(-0.03, 0.03, 3))
        omega = tuple(draw.normal(size=3) * 3)
        bodies.append(rbd.Body(f"b{k}", shape, pos=pos, omega=omega, vel=(-1, -1, -2), density=1000.0, friction=0.5))
    half = 0.5**0.5
    wall = rbd.Geom(rbd.Plane(), quat=(half, 0, half, 0), friction=0.5)
    return rbd.Scene(bodies, [rbd.Geom(rbd.Plane(), friction=0.5), wall], dt=0.004)


def flung():
    """A heavy ball hits a light one at rest, 30 mm before a wall: that one has a way of 40 mm in the step."""
    half = 0.5**0.5
    ball = lambda name, x, v, mass: rbd.Body(
        name, rbd.Sphere(0.1), pos=(x, 0, 0), vel=(v, 0, 0), mass=mass, friction=0.3, restitution=0.9
    )
    others = [rbd.Body(f"far{k}", rbd.Sphere(0.1), pos=(-2.0 - k, 0, 0), mass=1.0) for k in range(4)]
    wall = rbd.Geom(rbd.Plane(), pos=(0.33, 0, 0), quat=(half, 0, -half, 0), friction=0.3)
    bodies = [ball("light", 0.2, 0, 0.01), ball("heavy", -0.005, 5, 1.0), *others]
    return rbd.Scene(bodies, [wall], gravity=(0, 0, 0), dt=0.004)


def lifted():
    """A long kinematic plate turns up under a box and a ball far from its axis, 2 mm and more a step there."""
    plate = rbd.Body("plate", rbd.Box((1.0, 0.3, 0.02)), pos=(0, 0, -0.02), omega=(0, -1.0, 0), friction=0.5)
    box = rbd.Body("box", rbd.Box((0.05, 0.05, 0.05)), pos=(0.8, 0, 0.06), density=500.0, friction=0.5)
    ball = rbd.Body("ball", rbd.Sphere(0.05), pos=(0.6, 0.2, 0.06), density=500.0, friction=0.5)
    return rbd.Scene([box, ball], kinematic=[plate], gravity=(0, 0, 0), dt=0.004)


@pytest.mark.parametrize(
    "scene, steps, worlds",
    [(heap, 40, 32), (flung, 3, 1), (lifted, 40, 1)],  # the path of the light ball is chaotic
)
def test_what_is_left_out_does_nothing(scene, steps, worlds):
    ends = []
    for contact in (Soft(), Everything()):
        model, state = rbd.build(scene(), method=rbd.Method("symtop2", contact, TGS()))
        state = rbd.batch(state, worlds)
        push = np.random.default_rng(1).normal(0, 0.003, (worlds, model.n, 3)).astype(np.float32)
        final, traj = rbd.rollout(model, state.replace(vel=state.vel + push), steps)
        rbd.check(final)
        ends.append(np.concatenate([traj.pos, traj.vel], axis=-1))
    moved = np.abs(ends[0][:, -1] - ends[0][:, 0]).max()
    assert moved > 0.05
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-5 * max(1.0, moved))


def test_of_a_heap_at_rest_little_is_looked_at():
    """Of 68 slots those that carry, and few more: the cost follows the contacts."""
    model, state = rbd.build(heap(), method=rbd.Method("symtop2", "soft", TGS()))
    state = rbd.batch(state, 1)
    live = lambda state: sum(int(c.rows.live.sum()) for c in _detected(model, state))
    total = sum(len(g.a) * g.slots for g in model.structure.groups)
    rest, _ = rbd.rollout(model, state, 2000, every=2000)
    fast = state.replace(vel=state.vel * 1e3)
    carry = sum(int((np.asarray(lam.n) != 0).sum()) for lam in rest.memory.contacts)
    assert 3 <= carry <= live(rest) <= carry + 8 < total / 2
    assert live(fast) >= total / 2  # at 2 km/s everything may be hit


def _detected(model, state):
    enter = importlib.import_module("rbd_jax.step").enter  # the package's ``step`` is the function

    @jax.jit
    def run(model, state):
        p, world = enter(model, state, state.batch_shape)
        return detect(model.structure, p, world, model.method.reach)

    return jax.tree.map(jnp.asarray, run(model, rbd.rollout(model, state, 0)[0]))
