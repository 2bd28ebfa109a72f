"""Layer 5: soft contact, an overdamped spring by frequency and damping ratio.

With om = 2 pi f h and zeta: vhat = -om / (2 zeta + om) phi / h, r = w / (om (2 zeta + om)).
A point that carries the impulse p a step overlaps by w p h / om^2 at rest (g h^2 / om^2 where it carries a body of
mass 1 / w); of more than that the share om / (2 zeta + om) is taken back a step.
Source: Catto, "Soft constraints" (GDC 2011) and Box2D v3. Differs: ``Soft`` ties the frequency to the
step without a cap, so that heavy loads stand, and has springs of its own for pairs of several points. A gap is a rigid
row.
"""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp

from .base import ContactModel, Law, points, recovery, spring_energy


@dataclasses.dataclass(frozen=True)
class Soft(ContactModel):
    """As stiff as two sweeps bear: stiffer, and a box that is pushed rocks, and so does a column of boxes.

    A spring is a pair of numbers: contact frequency times the step [-] and damping ratio [-].

    stiffness, damping_ratio: of pairs of one point, as spheres have. push_speed: bound of the
    speed at which a contact resolves overlap [m/s]; bodies part at up to ``EXIT`` times this.
    face: spring of pairs of several points, as boxes have. deep: of these a speed [m/s] and a part: overlap is taken
    back at that speed as the spring says, of what is beyond only that part a step; None: no such bound. What a box
    sinks in where it hits would else be given back at once, as energy; at rest it overlaps by far less.
    stacked: the spring where bodies may touch each other, with fixed geometry and between bodies; sweeps are slowest
    there, and with three or four the former may be stiffer.
    """

    stiffness: float = 0.75
    damping_ratio: float = 30.0
    push_speed: float = 2.0
    face: tuple[float, float] = (0.6, 5.0)
    deep: tuple[float, float] | None = (0.003, 0.03)
    stacked: tuple[tuple[float, float], tuple[float, float]] = ((0.25, 10.0), (0.25, 10.0))

    name = "soft"
    reach = "nearby"

    @classmethod
    def uniform(cls, stiffness: float, damping_ratio: float) -> Soft:
        """The same spring for all pairs."""
        spring = stiffness, damping_ratio
        return cls(*spring, face=spring, deep=None, stacked=(spring, spring))

    def spring(self, rows, problem) -> tuple[float, float]:
        """Stiffness and damping ratio of a group of pairs."""
        if rows.slots == 1:
            return self.stiffness, self.damping_ratio
        if not problem.stacked:
            return self.face
        return self.stacked[0 if rows.a is None else 1]

    def law(self, rows, w, problem, load=None) -> Law:
        stiffness, damping_ratio = self.spring(rows, problem)
        om = 2.0 * math.pi * stiffness
        both = 2.0 * damping_ratio + om
        deep = None if rows.slots == 1 or problem.stacked else self.deep
        vhat = recovery(rows.phi, problem, om / both, self.push_speed, deep)
        return Law(vhat, jnp.where(rows.phi <= 0, w / (om * both), 0.0))


@dataclasses.dataclass(frozen=True)
class Hertz(ContactModel):
    """A spring of its own frequency, whatever the step: the contact of a pair oscillates at ``hertz`` [Hz]
    with ``damping_ratio`` [-] as if its effective mass were free. push_speed [m/s] as in ``Soft``.
    """

    hertz: float = 30.0
    damping_ratio: float = 1.0
    push_speed: float = 2.0

    name = "hertz"
    physical = True

    def law(self, rows, w, problem, load=None) -> Law:
        om = 2.0 * math.pi * self.hertz * problem.h
        both = 2.0 * self.damping_ratio + om
        vhat = recovery(rows.phi, problem, om / both, self.push_speed)
        return Law(vhat, w * points(rows, w.dtype) / (om * both))

    def energy(self, rows, w, problem):
        om = 2.0 * math.pi * self.hertz
        return spring_energy(om * om / (w * points(rows, w.dtype)), -rows.phi)
