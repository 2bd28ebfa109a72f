"""Layer 4: MuJoCo's integrators (4.0.1) for free bodies whose frame origin is the centre of mass.

MuJoCo carries the angular velocity of the body frame, where w' = I^-1 (R^T tau - w x I w), and so
keeps neither L nor energy. Here w is recovered from L = R I w at the start of a step and L is
formed again at its end, with the pose of the end.
Source: MuJoCo 4.0.1 documentation, "Computation", section "Integrators" and the part on free bodies; each
compared with the library over 1,000 steps (tests/test_free_motion.py).
"""

from __future__ import annotations

import dataclasses

from ..bodies import Bodies, Inertia
from ..spatial import Vec3
from . import gyroscopic
from .base import Integrator, add, is_constant
from .rk4 import weighted
from .rotation_maps import dexp_inverse, exp, norm_correction


@dataclasses.dataclass(frozen=True)
class MujocoEuler(Integrator):
    """``Euler``: v, w, then x and q from the new velocities; the gyroscopic term is explicit.

    Order 1. Keeps |q|; |L| and energy grow, without bound for h|w| above about 0.1. 230 flops,
    9 divisions, 1 square root.
    """

    name = "mujoco_euler"
    order = 1
    contact = True

    def kick(self, old, a, tau, inertia, h):
        v, L = super().kick(old, a, tau, inertia, h)
        if L is not None and not inertia.isotropic:
            L = L - inertia.velocity(old.q, old.L).cross(old.L) * h
        return v, L

    def momentum(self, old: Bodies, L: Vec3, inertia: Inertia, h) -> Vec3:
        """New angular momentum in the principal frame, given world L after kick and contact."""
        return old.q.rotate_inv(L)

    def move(self, old, v, L, inertia, h):
        x = old.x + v * h
        if old.q is None:
            return Bodies(x, v, None, L)
        p = self.momentum(old, L, inertia, h)
        q = old.q @ exp(p / inertia.moments * h, norm_correction(old.q))
        return Bodies(x, v, q, L if inertia.isotropic else q.rotate(p))


@dataclasses.dataclass(frozen=True)
class MujocoImplicitFast(MujocoEuler):
    """``implicitfast`` since 3.11: the change of w is solved with the gyroscopic derivative.

    w += (I + h d(w x Iw)/dw)^-1 dp, where dp is the explicit change of I w (torque, gyroscopic
    term and contact). Order 1. Keeps |q|; energy and |L| of a tumbling body decay, steady spins
    are kept. 350 flops, 15 divisions, 1 square root.
    """

    name = "mujoco_implicitfast"

    def momentum(self, old, L, inertia, h):
        p1 = old.q.rotate_inv(L)
        if inertia.isotropic:
            return p1
        p = old.q.rotate_inv(old.L)
        w = p / inertia.moments
        return p + gyroscopic.solve(inertia.moments, w, h, p1 - p) * inertia.moments


@dataclasses.dataclass(frozen=True)
class MujocoRK4(Integrator):
    """``RK4`` since 4.0: Runge-Kutta-Munthe-Kaas on (x, v, q, w).

    Stages q exp(theta_i), theta' = dexp^-1(theta) w (whole series). Order 4. Keeps |q|; L and
    energy drift as h^5 a step. 740 flops, 30 divisions, 4 square roots. Free motion only.
    Source: Munthe-Kaas 1999 (Appl. Numer. Math. 29); identified by experiment with 4.0.1.
    """

    name = "mujoco_rk4"
    order = 4
    contact = False

    def advance(self, old, force, inertia, h):
        once = force(old) if is_constant(force) else None
        turning = old.q is not None
        w0 = old.q.rotate_inv(old.L) / inertia.moments if turning else None
        scale = norm_correction(old.q) if turning else None

        def ahead(v, a, t, dw, h):
            """State after h along a slope; its w, and theta from the start of the step."""
            x, v = old.x + v * h, add(old.v, a, h)
            if not turning:
                return Bodies(x, v, None, old.L), None, None
            w, theta = add(w0, dw, h), t * h
            q = old.q @ exp(theta, scale)
            return Bodies(x, v, q, q.rotate(w * inertia.moments)), w, theta

        stage, w, theta, slopes = old, w0, None, []
        for step in (0.5 * h, 0.5 * h, h, None):
            a, tau = once or force(stage)
            t = w if theta is None else dexp_inverse(theta, w)
            dw = self._acceleration(stage, w, tau, inertia) if turning else None
            slopes.append((stage.v, a, t, dw))
            if step is not None:
                stage, w, theta = ahead(*slopes[-1], step)
        return ahead(*(weighted(*k) for k in zip(*slopes)), h)[0]

    @staticmethod
    def _acceleration(stage, w, tau, inertia) -> Vec3 | None:
        """w' = I^-1 (R^T tau - w x I w) in the principal frame; None where it vanishes."""
        torque = None if tau is None else stage.q.rotate_inv(tau)
        if not inertia.isotropic:
            turn = (w * inertia.moments).cross(w)
            torque = turn if torque is None else torque + turn
        return None if torque is None else torque / inertia.moments
