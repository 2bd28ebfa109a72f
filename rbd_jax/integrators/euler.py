"""Layer 4: the lecture's Euler methods, on linear momentum P = m v and world angular momentum L.

All three are first order. With ``attitude="matrix"`` the rotation matrix is carried and updated as
R <- R + h [w]x R, which is no rotation: R^T R grows by h^2|w|^2 a step across w unless
``orthonormalise`` says "gram_schmidt" or "polar"; the quaternion is derived from it. With
``attitude="quaternion"``, q <- q + h/2 (0, w) q, normalised. w = R I^-1 R^T L with the attitude
that the method prescribes. L is kept to rounding, energy is not. On a parabola the position is off
by g h t/2.
Source: Baraff 1997, "Physically Based Modeling: Rigid Body Simulation", sections 2 to 4;
Witkin & Baraff 1997, "Differential Equation Basics" (forward), Hairer, Lubich, Wanner 2006,
"Geometric Numerical Integration", I.1 (semi-implicit, backward).
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax

from ..bodies import Bodies, Inertia
from ..spatial import Mat3, Quat, Vec3
from .attitude import gram_schmidt, matrix_to_quat, polar
from .base import Integrator, is_constant
from .rk4 import plus

ORTHONORMALISE = {None: lambda R: R, "gram_schmidt": gram_schmidt, "polar": polar}


@dataclasses.dataclass(frozen=True)
class Euler(Integrator):
    """What the three Euler methods share: the attitude update for a given w."""

    attitude: str = "quaternion"
    orthonormalise: str | None = None

    order = 1
    contact = True

    def __post_init__(self):
        if self.attitude not in ("matrix", "quaternion"):
            raise ValueError(f'attitude must be "matrix" or "quaternion", not {self.attitude!r}')
        if self.orthonormalise not in ORTHONORMALISE:
            raise ValueError(f"orthonormalise must be one of {list(ORTHONORMALISE)}, not {self.orthonormalise!r}")
        if self.attitude == "quaternion" and self.orthonormalise is not None:
            raise ValueError('orthonormalise needs attitude="matrix"; a quaternion is normalised')

    @property
    def carries_matrix(self):
        return self.attitude == "matrix"

    def pose(self, b: Bodies) -> Quat | Mat3 | None:
        """The attitude that is carried."""
        if self.carries_matrix and b.q is not None:
            return b.q.mat() if b.R is None else b.R
        return b.q

    def omega(self, pose: Quat | Mat3, L: Vec3, inertia: Inertia) -> Vec3:
        """w = R I^-1 R^T L [rad/s]."""
        if inertia.isotropic or not self.carries_matrix:
            return inertia.velocity(pose, L)
        return pose @ (pose.tmul(L) / inertia.moments)

    def turned(self, pose: Quat | Mat3, w: Vec3, h) -> Quat | Mat3:
        """R + h [w]x R, orthonormalised, or q + h/2 (0, w) q, normalised."""
        w = w * h
        if not self.carries_matrix:
            t = (w.cross(pose.vec()) + w * pose.w) * 0.5
            dq = Quat(-0.5 * w.dot(pose.vec()), t.x, t.y, t.z)
            return plus(pose, dq, 1.0).normalised()
        c = pose.T
        c = Mat3(c.a + w.cross(c.a), c.b + w.cross(c.b), c.c + w.cross(c.c))
        return ORTHONORMALISE[self.orthonormalise](c.T)

    def bodies(self, old: Bodies, x: Vec3, v: Vec3, pose, L) -> Bodies:
        """Bodies with the new pose; the quaternion of a carried matrix is derived."""
        if self.carries_matrix and pose is not None:
            return Bodies(x, v, matrix_to_quat(pose, near=old.q), L, pose)
        return Bodies(x, v, pose, L)


@dataclasses.dataclass(frozen=True)
class ForwardEuler(Euler):
    """x, attitude from the velocities at the start; v and L from the forces at the start.

    Order 1; energy and orbits grow. A parabola ends too high by g h t/2. 115 flops, 3 divisions, 1 square root.
    """

    name: ClassVar[str] = "forward_euler"

    def move(self, old, v, L, inertia, h):
        pose = self.pose(old)
        if pose is not None:
            pose = self.turned(pose, self.omega(pose, old.L, inertia), h)
        return self.bodies(old, old.x + old.v * h, v, pose, L)


@dataclasses.dataclass(frozen=True)
class SemiImplicitEuler(Euler):
    """v and L first, then x from the new v and the attitude from w = I(old attitude)^-1 new L.

    Order 1; symplectic in translation only. A parabola ends too low by g h t/2. 115 flops, 3 divisions, 1 square root.
    """

    name: ClassVar[str] = "semi_implicit_euler"

    def move(self, old, v, L, inertia, h):
        pose = self.pose(old)
        if pose is not None:
            pose = self.turned(pose, self.omega(pose, L, inertia), h)
        return self.bodies(old, old.x + v * h, v, pose, L)


@dataclasses.dataclass(frozen=True)
class BackwardEuler(Euler):
    """Forces, v and w of the end of the step, found by ``iterations`` fixed-point iterations.

    Order 1; energy decays. A parabola ends too low by g h t/2. The fixed point is contracted by
    about h|w| an iteration. With a quaternion this is backward Euler itself, since (1 - u)^-1 is
    parallel to 1 + u; with a matrix it is R <- R + h [w]x R with w of the end. 110 flops, 3 divisions and 1 square root
    an iteration.
    """

    name: ClassVar[str] = "backward_euler"
    iterations: int = 5

    def move(self, old, v, L, inertia, h):
        start = pose = self.pose(old)
        if start is not None:
            again = lambda _, pose: self.turned(start, self.omega(pose, L, inertia), h)
            pose = jax.lax.fori_loop(0, self.iterations, again, start)
        return self.bodies(old, old.x + v * h, v, pose, L)

    def advance(self, old, force, inertia, h):
        if is_constant(force):
            return super().advance(old, force, inertia, h)
        start = self.pose(old)

        def again(_, new):
            v, L = self.kick(old, *force(new), inertia, h)
            pose = self.pose(new)
            if start is not None:
                pose = self.turned(start, self.omega(pose, L, inertia), h)
            return self.bodies(old, old.x + v * h, v, pose, L)

        return jax.lax.fori_loop(0, self.iterations, again, old)
