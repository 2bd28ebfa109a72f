"""Layer 4: sphere (A) and sphere (B)."""

from __future__ import annotations

import jax.numpy as jnp

from ..spatial import Vec3, safe_norm, unit_or
from .base import Manifold, Pose, one_point


def sphere_sphere(a: Pose, b: Pose, size_a, size_b, margin, one=1.0) -> Manifold:
    """One point on the line of centres: distance = |xB - xA| - rA - rB; normal +z at coincident centres."""
    (ra,), (rb,) = size_a, size_b
    d = b.x - a.x
    length = safe_norm(d)
    zero = jnp.zeros_like(length)
    n = unit_or(d, Vec3(zero, zero, zero + 1))
    gap = length - ra - rb
    point = a.x + n * (ra + 0.5 * gap)
    return one_point(n, point, gap, margin)
