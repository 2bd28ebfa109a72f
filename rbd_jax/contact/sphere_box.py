"""Layer 4: sphere (A) and box (B)."""

from __future__ import annotations

from ..shapes import Box
from ..xla import materialise
from .base import Manifold, Pose, one_point


def sphere_box(a: Pose, b: Pose, size_a, size_b, margin, one=1.0) -> Manifold:
    """One point, from the box's exact SDF at the sphere's centre, outside or inside.

    distance = sdf - r; the normal, from sphere to box, is minus the gradient of the SDF.
    """
    (radius,) = size_a
    local = materialise(b.q.rotate_inv(a.x - b.x), one)
    sdf, gradient = materialise(Box.sdf(size_b, local), one)
    n = materialise(-b.q.rotate(gradient), one)
    gap = sdf - radius
    point = a.x + n * (radius + 0.5 * gap)
    return one_point(n, point, gap, margin)
