"""Layer 4: plane (A) and box (B)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ..spatial import Vec3
from ..xla import materialise
from .base import Manifold, Pose

# Corner k of the box has sign + along axis i where bit i of k is set; shape (8, 1, 1) each.
CORNERS = tuple(((np.arange(8)[:, None, None] >> axis) & 1) * 2.0 - 1.0 for axis in range(3))


def plane_box(a: Pose, b: Pose, size_a, size_b, margin, one=1.0) -> Manifold:
    """Eight slots, one per corner: corner c = xB + sum_i s_i U_i, U_i = h_i times the box's axis i.

    distance = n . (c - xA), point = c - n distance / 2. Both are linear in the signs s_i, so the
    coefficients are computed once per pair and each slot costs three multiply-adds per output.
    """
    q = a.q
    n = Vec3(2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x * q.x + q.y * q.y))
    n = materialise(n, one)
    R = b.q.mat()
    columns = (Vec3(R.a.x, R.b.x, R.c.x), Vec3(R.a.y, R.b.y, R.c.y), Vec3(R.a.z, R.b.z, R.c.z))
    sides = tuple(c * h for c, h in zip(columns, size_b))
    heights = materialise(tuple(n.dot(u) for u in sides), one)
    centre = materialise(n.dot(b.x - a.x), one)
    mids = materialise(tuple(u - n * (0.5 * z) for u, z in zip(sides, heights)), one)
    origin = materialise(b.x - n * (0.5 * centre), one)

    def at_corners(start, steps):
        sign = (jnp.asarray(s, start.dtype) for s in CORNERS)
        return start + sum(s * u for s, u in zip(sign, steps))

    distance = at_corners(centre, heights)
    x, y, z = mids
    point = Vec3(
        at_corners(origin.x, (x.x, y.x, z.x)),
        at_corners(origin.y, (x.y, y.y, z.y)),
        at_corners(origin.z, (x.z, y.z, z.z)),
    )
    return Manifold(
        normal=n,
        point=point,
        distance=distance,
        live=distance < margin,
        feature=jnp.zeros((1, 1), jnp.int32),
    )
