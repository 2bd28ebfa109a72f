"""Layer 5: near-rigid contact, r = beta^2 / (4 pi^2) w N, vhat = -phi / h.

N is the number of live points of the pair: its stiffness does not depend on how many share the load.
The overlap at rest is beta^2 / (4 pi^2) w N p h for a point that carries the impulse p a step.
Source: Castro et al. 2022, "An unconstrained convex formulation of compliant contact" (SAP), section V.
"""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp

from ..restitution import targets
from ..rows import Rows
from .base import ContactModel, Law, points, recovery


def near_rigid(beta: float) -> float:
    return beta * beta / (4.0 * math.pi**2)


def convex(law: Law, rows: Rows, w, problem, event_beta: float) -> Law:
    """``law`` for a convex solver, which needs a compliance: at least that of ``event_beta``, which impacts have."""
    least = near_rigid(event_beta) * points(rows, w.dtype) * w
    vhat, r = law.vhat, least if law.r is None else jnp.maximum(law.r, least)
    if rows.e is not None:
        events = targets(rows, problem)
        vhat, r = events.target(vhat), jnp.where(events.active, least, r)
    return law._with(vhat=vhat, r=r)


@dataclasses.dataclass(frozen=True)
class NearRigid(ContactModel):
    """beta: near-rigid parameter [-]. push_speed: bound of the speed at which a contact resolves overlap [m/s];
    bodies part at up to ``EXIT`` times this. The speed stays in the velocities, so it is low.
    """

    beta: float = 0.05
    push_speed: float = 0.2

    name = "near_rigid"

    def law(self, rows, w, problem, load=None) -> Law:
        r = near_rigid(self.beta) * points(rows, w.dtype) * w
        vhat = recovery(rows.phi, problem, 1.0, math.inf)
        # the bound is one of speed, not of load: the overlap r load h is that of the load, and none to push out
        if load is not None:
            return Law(jnp.minimum(vhat, self.push_speed + r * load), r)
        fast = vhat > self.push_speed  # the force at rest, vhat / r, stays
        slow = jnp.where(fast, self.push_speed / jnp.where(fast, vhat, 1.0), 1.0)
        return Law(vhat * slow, r * slow)


@dataclasses.dataclass(frozen=True)
class Baumgarte(ContactModel):
    """Rigid rows that take back a fraction of the overlap a step, up to ``push_speed`` [m/s].

    Source: Baumgarte 1972. It adds energy: the speed of recovery stays in the velocities (unless the
    solver takes it out).
    """

    fraction: float = 0.2
    push_speed: float = 3.0

    name = "baumgarte"
    reach = "nearby"

    def law(self, rows, w, problem, load=None) -> Law:
        return Law(recovery(rows.phi, problem, self.fraction, self.push_speed))
