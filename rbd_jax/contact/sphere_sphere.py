"""Layer 4: sphere (A) and sphere (B)."""

from __future__ import annotations

import jax.numpy as jnp

from ..spatial import Vec3, safe_norm, unit_or
from .base import Manifold, Pose


def sphere_sphere(a: Pose, b: Pose, size_a, size_b, margin, one=1.0) -> Manifold:
    """One point on the line of centres: distance = |xB - xA| - rA - rB; normal +z at coincident centres."""
    (ra,), (rb,) = size_a, size_b
    d = b.x - a.x
    length = safe_norm(d)
    zero = jnp.zeros_like(length)
    n = unit_or(d, Vec3(zero, zero, zero + 1))
    gap = length - ra - rb
    point = a.x + n * (ra + 0.5 * gap)
    return Manifold(
        normal=n,
        point=point.map(lambda c: c[None]),
        distance=gap[None],
        live=gap[None] < margin,
        feature=jnp.zeros((1, 1), jnp.int32),
    )
