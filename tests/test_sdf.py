"""The public ``sdf``: exact distance, unit gradient, finite everywhere."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbd_jax.contact.sdf import sdf
from rbd_jax.shapes import Box, Plane, Sphere

HALF = np.array([0.1, 0.25, 0.4])
SHAPES = {"sphere": Sphere(0.3), "box": Box(tuple(HALF)), "plane": Plane()}


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def surface_distance(kind, p):
    """Signed distance by another route than the code's."""
    if kind == "sphere":
        return np.linalg.norm(p, axis=-1) - 0.3
    if kind == "plane":
        return p[:, 2]
    nearest = np.clip(p, -HALF, HALF)
    walls = np.concatenate([HALF - p, HALF + p], axis=-1).min(-1)  # depth below each of the six faces
    return np.where(walls > 0, -walls, np.linalg.norm(p - nearest, axis=-1))


def random_points(seed=0, count=1000):
    return np.random.default_rng(seed).uniform(-0.6, 0.6, (count, 3))


def placed(shape):
    q = np.array([0.3, -0.5, 0.2, 0.7])
    return types.SimpleNamespace(shape=shape, pos=np.array([0.2, -0.1, 0.5]), quat=q / np.linalg.norm(q))


def to_world(geom, p):
    w, u = geom.quat[0], geom.quat[1:]
    t = 2 * np.cross(u, p)
    return p + w * t + np.cross(u, t) + geom.pos


@pytest.mark.parametrize("kind", SHAPES)
def test_distance_is_exact(kind):
    p = random_points()
    expected = surface_distance(kind, p)
    distance, gradient = sdf(SHAPES[kind], p)
    np.testing.assert_allclose(distance, expected, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=-1), 1.0, atol=1e-14)
    geom = placed(SHAPES[kind])
    moved, turned = sdf(geom, to_world(geom, p))
    np.testing.assert_allclose(moved, expected, atol=1e-14)
    np.testing.assert_allclose(turned, to_world(geom, np.asarray(gradient)) - geom.pos, atol=1e-13)


@pytest.mark.parametrize("kind", SHAPES)
def test_gradient_is_that_of_the_distance(kind):
    geom = placed(SHAPES[kind])
    p = random_points(seed=1, count=300)
    distance = jax.jit(lambda p: sdf(geom, p)[0])
    step = 1e-6 * np.eye(3)
    numeric = np.stack([(distance(p + e) - distance(p - e)) / 2e-6 for e in step], axis=-1)
    gradient = np.asarray(sdf(geom, p)[1])
    smooth = np.abs(np.linalg.norm(numeric, axis=-1) - 1) < 1e-6  # a kink within the step shows here
    assert smooth.mean() > 0.98
    np.testing.assert_allclose(gradient[smooth], numeric[smooth], atol=1e-8)
    automatic = jax.vmap(jax.grad(lambda p: sdf(geom, p)[0]))(p)
    np.testing.assert_allclose(automatic, gradient, atol=1e-12)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("kind", SHAPES)
def test_finite_where_the_distance_has_kinks(kind, dtype):
    h = HALF
    points = [np.zeros(3), h, -h, h * [1, 1, 0], h * [1, 0, 0], h * [0, 0.5, 1], [1e-25, 0, 0], h + [0, 0, 1e-25]]
    points = jnp.asarray(np.array(points), dtype)
    values, pullback = jax.vjp(lambda p: sdf(SHAPES[kind], p), points)
    assert all(v.dtype == dtype and np.isfinite(v).all() for v in values)
    np.testing.assert_allclose(np.linalg.norm(values[1], axis=-1), 1.0, atol=1e-6)
    (back,) = pullback((jnp.ones(len(points), dtype), jnp.ones((len(points), 3), dtype)))
    assert np.isfinite(back).all()


def test_shapes_of_arrays_and_bad_input():
    distance, gradient = sdf(Sphere(1.0), np.zeros((2, 5, 3)))
    assert distance.shape == (2, 5) and gradient.shape == (2, 5, 3)
    assert sdf(Sphere(1.0), (0, 0, 2))[0] == 1.0  # integers, a single point
    mapped = jax.vmap(lambda p: sdf(SHAPES["box"], p)[0])(random_points(count=4))
    np.testing.assert_array_equal(mapped, sdf(SHAPES["box"], random_points(count=4))[0])
    with pytest.raises(ValueError, match=r"points have shape \(4,\)"):
        sdf(Sphere(1.0), np.zeros(4))
