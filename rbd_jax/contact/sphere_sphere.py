"""Layer 4: sphere (A) and sphere (B)."""

from __future__ import annotations

import jax
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


def time_of_impact(a: Pose, b: Pose, va: Vec3, vb: Vec3, size_a, size_b) -> jax.Array:
    """First t >= 0 with |xB - xA + (vB - vA) t| = rA + rB while they approach [s]; infinite if there is none."""
    (ra,), (rb,) = size_a, size_b
    d, v = b.x - a.x, vb - va
    v2, dv = v.dot(v), d.dot(v)
    c = d.dot(d) - (ra + rb) ** 2
    s2 = dv * dv - v2 * c
    meets = (dv < 0) & (s2 > 0)
    return jnp.where(
        meets, jnp.maximum(c, 0.0) / jnp.where(meets, -dv + jnp.sqrt(jnp.where(meets, s2, 1.0)), 1.0), jnp.inf
    )
