"""Layer 2: the hot layout of moving bodies, component-wise with the batch innermost.

Symbols: x centre of mass [m], v its velocity [m/s], q attitude of the principal frame,
L angular momentum about the centre of mass [kg m^2/s], R rotation matrix (world frame all).
"""

from __future__ import annotations

import jax

from .spatial import Mat3, Quat, Vec3
from .struct import struct


@struct
class Inertia:
    """Principal moments of inertia [kg m^2] of every body.

    moments: an array (n, 1) or (n, B) when every body is isotropic, else a Vec3 of such arrays,
      in the principal frame whose z is the axis with 1/I farthest from the other two.
    """

    moments: jax.Array | Vec3

    @property
    def isotropic(self) -> bool:
        return not isinstance(self.moments, Vec3)

    def velocity(self, q: Quat, L: Vec3) -> Vec3:
        """Angular velocity w = R I^-1 R^T L, world frame [rad/s]."""
        if self.isotropic:
            return L / self.moments
        return q.rotate(q.rotate_inv(L) / self.moments)

    def momentum(self, q: Quat, w: Vec3) -> Vec3:
        """Angular momentum L = R I R^T w, world frame [kg m^2/s]."""
        if self.isotropic:
            return w * self.moments
        return q.rotate(q.rotate_inv(w) * self.moments)


@struct
class Bodies:
    """Moving bodies in the hot layout; every leaf (n, B).

    ``q`` and ``L`` are None when the scene needs no attitude (frictionless spheres); ``R`` is None
    unless the integrator carries a rotation matrix.
    """

    x: Vec3
    v: Vec3
    q: Quat | None = None
    L: Vec3 | None = None
    R: Mat3 | None = None
