"""Layer 5: soft contact, a critically overdamped spring by frequency and damping ratio.

With om = 2 pi f h and zeta: vhat = -om / (2 zeta + om) phi / h, r = w / (om (2 zeta + om)).
Source: Catto, "Soft constraints" (GDC 2011) and Box2D v3. Differs: ``Soft`` ties the frequency to the
step (a quarter of its rate) without a cap, so that heavy loads stand. A gap is a rigid row.
"""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp

from .base import ContactModel, Law, points, recovery, spring_energy


@dataclasses.dataclass(frozen=True)
class Soft(ContactModel):
    """As stiff as the step resolves.

    stiffness: contact frequency times the step [-]. damping_ratio [-]. push_speed: bound of the
    speed at which a contact resolves overlap [m/s]; bodies part at up to ``EXIT`` times this.
    """

    stiffness: float = 0.25
    damping_ratio: float = 10.0
    push_speed: float = 2.0

    name = "soft"
    reach = "nearby"

    def law(self, rows, w, problem, load=None) -> Law:
        om = 2.0 * math.pi * self.stiffness
        stiff = om * (2.0 * self.damping_ratio + om)
        vhat = recovery(rows.phi, problem, om / (2.0 * self.damping_ratio + om), self.push_speed)
        return Law(vhat, jnp.where(rows.phi <= 0, w / stiff, 0.0))


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
