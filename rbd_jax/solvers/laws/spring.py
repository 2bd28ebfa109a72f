"""Layer 5: a linear spring with a dashpot, stepped implicitly.

The force of a pair is k (-phi) - k tau u_n, so r = N / (h k (h + tau)), vhat = -phi / (h + tau), with N the
number of live points that share it.
"""

from __future__ import annotations

import dataclasses
import math

from .base import ContactModel, Law, points, spring_energy


@dataclasses.dataclass(frozen=True)
class Spring(ContactModel):
    """stiffness: of a pair, k [N/m]. relaxation: tau [s], damping over stiffness.

    Raises:
      ValueError: stiffness <= 0 or relaxation < 0.
    """

    stiffness: float = 1e5
    relaxation: float = 1e-2

    name = "spring"
    physical = True

    def __post_init__(self):
        for field, low in (("stiffness", self.stiffness > 0), ("relaxation", self.relaxation >= 0)):
            if not (low and math.isfinite(getattr(self, field))):
                raise ValueError(f"Spring.{field} = {getattr(self, field)}: stiffness > 0 [N/m], relaxation >= 0 [s]")

    def law(self, rows, w, problem, load=None) -> Law:
        slow = problem.h + self.relaxation
        compliance = 1.0 / (problem.h * self.stiffness * slow)
        return Law(-rows.phi / slow, points(rows, w.dtype) * compliance + 0.0 * w)

    def energy(self, rows, w, problem):
        return spring_energy(self.stiffness / points(rows, w.dtype), -rows.phi)
