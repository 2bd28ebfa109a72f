"""Layer 4: what an integrator is, and the kick-drift-kick step that most of them share.

Symbols: h step [s]; x, v centre of mass [m] and velocity [m/s]; q attitude (principal frame to
world), R its matrix; L angular momentum about the centre of mass [kg m^2/s]; w angular velocity
[rad/s]; a acceleration [m/s^2], tau torque about the centre of mass [N m] (world frame all).

A *force* is a function ``force(bodies) -> (a, tau)``; None for either means absent and leaves no
operation. Two optional attributes say what it depends on and so how often it is evaluated:
``constant`` (default True): the same for any state, evaluated once a step;
``damped`` (default: not constant): depends on velocities as well as on the pose.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from ..bodies import Bodies, Inertia
from ..spatial import Quat, Vec3


def is_constant(force) -> bool:
    """Whether ``force`` is the same for any state."""
    return bool(getattr(force, "constant", True))


def is_damped(force) -> bool:
    """Whether ``force`` depends on velocities."""
    return bool(getattr(force, "damped", not is_constant(force)))


def add(a: Vec3 | None, b: Vec3 | None, h) -> Vec3 | None:
    """a + h b, where an absent b adds no operation."""
    return a if a is None or b is None else a + b * h


@dataclasses.dataclass(frozen=True)
class Integrator:
    """One way to advance moving bodies; hashable, as it selects the program.

    With contact a step is ``kick`` -> solve -> ``move`` (only where ``contact`` is True);
    ``advance`` is a whole step of free motion.
    """

    name: ClassVar[str]
    order: ClassVar[int]
    contact: ClassVar[bool]

    @property
    def carries_matrix(self) -> bool:
        """Whether ``Bodies.R`` is part of the state."""
        return False

    def kick(self, old: Bodies, a: Vec3 | None, tau: Vec3 | None, inertia: Inertia, h):
        """Velocities (v, L) before contact: v + h a, L + h tau."""
        return add(old.v, a, h), add(old.L, tau, h)

    def move(self, old: Bodies, v: Vec3, L: Vec3 | None, inertia: Inertia, h) -> Bodies:
        """Bodies after h, given their (solved) velocities v, L at the end of the step."""
        raise NotImplementedError(f"integrator {self.name!r} does not work with contact")

    def advance(self, old: Bodies, force, inertia: Inertia, h) -> Bodies:
        """Bodies after h of free motion under ``force``."""
        v, L = self.kick(old, *force(old), inertia, h)
        return self.move(old, v, L, inertia, h)


class Splitting(Integrator):
    """Kick-drift-kick about a rotation map at constant L (Strang 1968; velocity Verlet).

    Exact for a constant acceleration; second order with any force or torque. |L| changes by the
    torque only. A subclass defines ``rotate``.
    """

    contact = True

    def rotate(self, q: Quat, L: Vec3, inertia: Inertia, h) -> Quat:
        """Attitude after h of torque-free rotation."""
        raise NotImplementedError

    def move(self, old, v, L, inertia, h):
        q = None if old.q is None else self.rotate(old.q, L, inertia, h)
        return Bodies(old.x + v * h, v, q, L)

    def advance(self, old, force, inertia, h):
        a, tau = force(old)
        half = self.move(old, add(old.v, a, 0.5 * h), add(old.L, tau, 0.5 * h), inertia, h)
        if is_constant(force):
            return half._with(v=add(old.v, a, h), L=add(old.L, tau, h))
        return self._second_kick(half, force, h)

    @staticmethod
    def _second_kick(half: Bodies, force, h) -> Bodies:
        """v + h/2 a at the new pose; with damping at the new velocity too (one correction)."""
        a, tau = force(half)
        end = half._with(v=add(half.v, a, 0.5 * h), L=add(half.L, tau, 0.5 * h))
        if is_damped(force):
            a, tau = force(end)
            end = half._with(v=add(half.v, a, 0.5 * h), L=add(half.L, tau, 0.5 * h))
        return end
