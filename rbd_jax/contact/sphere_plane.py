"""Layer 4: plane (A) and sphere (B)."""

from __future__ import annotations

from ..spatial import Vec3
from .base import Manifold, Pose, one_point


def plane_sphere(a: Pose, b: Pose, size_a, size_b, margin, one=1.0) -> Manifold:
    """One point: distance = n . (xB - xA) - r along the plane's normal n, its z axis."""
    (radius,) = size_b
    q = a.q
    n = Vec3(2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x * q.x + q.y * q.y))
    gap = n.dot(b.x - a.x) - radius
    point = b.x - n * (radius + 0.5 * gap)
    return one_point(n, point, gap, margin)
