"""Layer 4: signed distance of a shape placed in the world (public)."""

from __future__ import annotations

import jax.numpy as jnp

from ..shapes import Shape
from ..spatial import pack, quat, vec3


def sdf(geom, points):
    """Signed distance and its gradient at world points.

    Args:
      geom: a Geom (``shape`` placed at ``pos`` [m] with attitude ``quat``), or a bare Shape at the origin.
      points: (..., 3) world positions [m]; their dtype is the dtype of the result.

    Returns:
      distance (...,) [m], negative inside, and gradient (..., 3), a unit vector pointing outward.

    Gradients: of the distance, the gradient returned, except on the medial axis (centre of a sphere,
    equidistant faces inside a box), where both are finite and pick one side.
    """
    points = jnp.asarray(points)
    if points.shape[-1:] != (3,):
        raise ValueError(f"sdf: points have shape {points.shape}, expected (..., 3) [m]")
    if not jnp.issubdtype(points.dtype, jnp.floating):
        points = points.astype(jnp.result_type(float))
    shape = geom if isinstance(geom, Shape) else geom.shape
    size = tuple(jnp.asarray(s, points.dtype) for s in shape.size)
    if shape is geom:
        distance, gradient = shape.sdf(size, vec3(points))
        return distance, pack(gradient)
    pos = vec3(jnp.asarray(geom.pos, points.dtype))
    q = quat(jnp.asarray(geom.quat, points.dtype)).normalised()
    distance, gradient = shape.sdf(size, q.rotate_inv(vec3(points) - pos))
    return distance, pack(q.rotate(gradient))
