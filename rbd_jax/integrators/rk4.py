"""Layer 4: classical fourth-order Runge-Kutta on (x, v, q, L)."""

from __future__ import annotations

import dataclasses

from ..bodies import Bodies, Inertia
from ..spatial import Quat
from .base import Integrator, add, is_constant


def weighted(k1, k2, k3, k4):
    """(k1 + 2 k2 + 2 k3 + k4)/6, None where absent."""
    return None if k1 is None else (k1 + k4 + (k2 + k3) * 2.0) * (1.0 / 6.0)


def plus(q: Quat, dq: Quat, h) -> Quat:
    """q + h dq."""
    return Quat(q.w + h * dq.w, q.x + h * dq.x, q.y + h * dq.y, q.z + h * dq.z)


@dataclasses.dataclass(frozen=True)
class RK4(Integrator):
    """Classical Runge-Kutta on x, v, the quaternion (normalised at stages and end) and world L.

    Order 4 with any force. Keeps L (without torque) and |q| to rounding; the energy drifts as
    h^5 a step. 480 flops, 12 divisions, 4 square roots; four force evaluations (one if constant).
    Free motion only. Source: Kutta 1901; Hairer, Norsett, Wanner, "Solving ODEs I", II.1.
    """

    name = "rk4"
    order = 4
    contact = False

    @staticmethod
    def _slope(b: Bodies, w) -> Quat | None:
        """q' = (0, w) q / 2."""
        u, q = w * 0.5, b.q
        t = u.cross(q.vec()) + u * q.w
        return Quat(-u.dot(q.vec()), t.x, t.y, t.z)

    def advance(self, old, force, inertia: Inertia, h):
        once = force(old) if is_constant(force) else None
        stage, slopes = old, []
        for step in (0.5 * h, 0.5 * h, h, None):
            a, tau = once or force(stage)
            dq = None if old.q is None else self._slope(stage, inertia.velocity(stage.q, stage.L))
            slopes.append((stage.v, a, dq, tau))
            if step is not None:
                stage = self._ahead(old, slopes[-1], step)
        v, a, dq, tau = zip(*slopes)
        if dq[0] is None:
            mean = None
        else:
            mean = Quat(*(weighted(*(getattr(d, c) for d in dq)) for c in "wxyz"))
        return self._ahead(old, (weighted(*v), weighted(*a), mean, weighted(*tau)), h)

    @staticmethod
    def _ahead(old: Bodies, slope, h) -> Bodies:
        v, a, dq, tau = slope
        q = None if dq is None else plus(old.q, dq, h).normalised()
        return Bodies(old.x + v * h, add(old.v, a, h), q, add(old.L, tau, h))
