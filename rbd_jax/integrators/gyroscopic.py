"""Layer 4: gyroscopic term w x Iw in the principal frame and its linear solve.

Symbols: w angular velocity and p = I w angular momentum in the principal frame; I the moments.
"""

from __future__ import annotations

from ..spatial import Vec3


def solve(moments: Vec3, w: Vec3, h, b: Vec3) -> Vec3:
    """x of (I + h d(w x Iw)/dw) x = b, by Cramer's rule; the derivative is [w]I - [Iw].

    Column j is I_j e_j + h (I_j w - p) x e_j.
    """
    i, p = moments, w * moments
    x, y, z = (w * i.x - p) * h, (w * i.y - p) * h, (w * i.z - p) * h
    cx = Vec3(i.x, x.z, -x.y)
    cy = Vec3(-y.z, i.y, y.x)
    cz = Vec3(z.y, -z.x, i.z)
    n = cy.cross(cz)
    return Vec3(b.dot(n), cx.dot(b.cross(cz)), cx.dot(cy.cross(b))) / cx.dot(n)
