"""The Newton iteration of one function of the CPU: its factorisation, and that it solves what the other form solves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax.solvers import block_ldl
from rbd_jax.xla import one_function, opaque_one


@pytest.mark.parametrize(
    "filled", [(), ((1, 0), (2, 1), (3, 2)), ((2, 0), (3, 0), (3, 1))], ids=["none", "chain", "star"]
)
def test_block_factorisation(filled):
    """Against numpy, four bodies; the star fills (3, 2) on the way. What lies in empty blocks is ignored."""
    n, m, worlds = 4, 6, 32
    rng = np.random.default_rng(0)
    full = np.zeros((worlds, n, m, n, m))
    below = rng.normal(size=(n * (n - 1) // 2, m, m, worlds))  # columns, rows
    for i, j in filled:
        block = below[block_ldl.place(i, j)].transpose(2, 1, 0)
        full[:, i, :, j], full[:, j, :, i] = block, block.transpose(0, 2, 1)
    for i in range(n):
        a = rng.normal(size=(worlds, m, m))
        full[:, i, :, i] = a @ a.transpose(0, 2, 1) + 30 * np.eye(m)
    flags = np.zeros(len(below), np.int32)
    flags[[block_ldl.place(i, j) for i, j in filled]] = 1
    diagonal = np.stack([full[:, i, :, i].transpose(2, 1, 0) for i in range(n)])
    b = rng.normal(size=(n, m, worlds))
    with jax.enable_x64(True):
        h = block_ldl.Blocks(*map(jnp.asarray, (diagonal, b, below, flags)))
        x = jax.jit(lambda h: one_function(block_ldl.solve)(h, opaque_one(h.b, h.b.dtype)))(h)
    dense = full.reshape(worlds, n * m, n * m)
    exact = np.linalg.solve(dense, b.transpose(2, 0, 1).reshape(worlds, n * m, 1))
    np.testing.assert_allclose(
        np.asarray(x).transpose(2, 0, 1).reshape(worlds, n * m, 1), exact, rtol=1e-10, atol=1e-12
    )


def scene():
    """Every kind of pair, and pairs whose body A comes before and after body B."""
    cube, ball = rbd.Box((0.1, 0.1, 0.1)), rbd.Sphere(0.1)
    shapes = [cube, ball, ball, cube, cube]
    at = [(0, 0, 0.1), (0.02, 0, 0.3), (0.22, 0, 0.1), (0.4, 0.02, 0.12), (0.38, 0, 0.3)]
    bodies = [rbd.Body(f"b{i}", s, pos=p, friction=0.5, mass=1 + 0.3 * i) for i, (s, p) in enumerate(zip(shapes, at))]
    return rbd.Scene(bodies, [rbd.Geom(rbd.Plane(), friction=0.5)], dt=0.004)


def test_loops_solve_what_the_dense_system_solves():
    """One step of 32 moving worlds in float64: two stopping rules, one solution."""
    rng = np.random.default_rng(1)
    with jax.enable_x64(True):
        method = rbd.Method("symtop2", "near_rigid", rbd.SOLVERS["newton_lagged"](iterations=40))
        model, one = rbd.build(scene(), method=method)
        state = rbd.batch(one, 32)
        state = state.replace(vel=0.3 * rng.normal(size=(32, one.n, 3)), omega=rng.normal(size=(32, one.n, 3)))
        go = lambda s: rbd.rollout(model, s, 1, every=1)[0]
        loops = go(state)
        zero = lambda c: (
            jnp.zeros_like(c) if jnp.issubdtype(c.dtype, jnp.floating) else np.zeros(c.shape, jax.dtypes.float0)
        )
        dense = jax.jvp(go, (state,), (jax.tree.map(zero, state),))[0]
    assert not np.asarray(loops.status | dense.status).any()
    assert np.abs(np.asarray(loops.vel) - np.asarray(state.vel)).max() > 0.1, "nothing touches"
    for name in ("vel", "omega"):
        np.testing.assert_allclose(getattr(loops, name), getattr(dense, name), atol=1e-6)


def tangent(c):
    return jnp.zeros_like(c) if jnp.issubdtype(c.dtype, jnp.floating) else np.zeros(c.shape, jax.dtypes.float0)


def test_a_pair_without_arms_beside_one_with_arms():
    """Balls that rub on the ground and not on each other: what their block held a Newton step ago is no part of it."""
    rng = np.random.default_rng(2)
    ball = lambda name, x: rbd.Body(name, [rbd.Geom(rbd.Sphere(0.1), friction=None)], pos=(x, 0, 0.0999))
    cube = lambda name, x: rbd.Body(name, rbd.Box((0.1, 0.1, 0.1)), pos=(x, 0, 0.1), friction=0.5)
    bodies = [ball("a", 0.0), ball("b", 0.1999), ball("c", 0.3998), cube("d", 2.0), cube("e", 2.1999)]
    frictional = rbd.Scene(bodies, [rbd.Geom(rbd.Plane(), friction=0.5)], dt=0.004)
    with jax.enable_x64(True):
        model, one = rbd.build(frictional, method=rbd.Method("symtop2", "near_rigid", rbd.SOLVERS["newton_lagged"](40)))
        state = rbd.batch(one, 32)
        vel = 0.3 * rng.normal(size=(32, one.n, 3))
        vel[:, :3, 0] += [1.0, 0.0, -1.0]
        state = state.replace(vel=vel)
        go = lambda s: rbd.rollout(model, s, 1, every=1)[0]
        loops, dense = go(state), jax.jvp(go, (state,), (jax.tree.map(tangent, state),))[0]
    assert not np.asarray(loops.status | dense.status).any()
    np.testing.assert_allclose(loops.vel, dense.vel, atol=1e-6)
    np.testing.assert_allclose(loops.omega, dense.omega, atol=1e-5)  # 1e-6 m/s at an arm of 0.1 m
