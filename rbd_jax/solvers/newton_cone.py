"""Layer 5: any contact model with the true friction cone at the velocity level (SAP).

x = u - vhat (normal), u_t - keep u0_t (friction), r_n of the model, r_t of the model or sigma w. Sticking is held to a
creep of r_t p_t; a sliding contact glides: it lifts off until the normal speed is mu |u_t|, the price of convexity
(``newton_lagged`` has none).

Source: Castro et al. 2022, "An unconstrained convex formulation of compliant contact".
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from ..xla import materialise
from . import dense
from .base import Problem, Solution
from .cone import ConeLaw, ConeNewton, minus
from .dense import Contacts
from .laws import Law, contact_model
from .laws.base import points
from .laws.near_rigid import convex
from .mujoco_law import MIN_FRICTION
from .rows import Impulses, Rows


@dataclasses.dataclass(frozen=True)
class NewtonCone(ConeNewton):
    """Convex contact at the velocity level.

    Attributes (besides those of ``ConeNewton``):
      slip_compliance: sigma [-], compliance of friction over w where the model gives none.
      event_beta: near-rigid parameter of impacts and of rows that are rigid in the model [-].
    """

    iterations: int = 12
    slip_compliance: float = 1e-3
    event_beta: float = 0.02

    name = "newton_cone"
    contact = "near_rigid"

    def law(self, c: Contacts, rows: Rows, problem: Problem, load) -> ConeLaw:
        w = dense.inverse_mass(c, problem)
        model = convex(contact_model(self, problem).law(rows, w, problem, load), rows, w, problem, self.event_beta)
        vhat, r = model.vhat, model.r
        live = jnp.where(c.live, 1.0, 0.0).astype(w.dtype)
        if not c.friction:
            return materialise(ConeLaw(live / r, Impulses(vhat)), problem.one)
        rt = self.slip_compliance * points(rows, w.dtype) * w if model.rt is None else model.rt
        keep = 0.0 if model.keep is None else model.keep
        slip = jax.tree.map(lambda u: u * keep, dense.relative(c, rows, problem.v0, problem.w0))
        mu = jnp.maximum(rows.mu, MIN_FRICTION)
        angular = {}
        for name, d, nu in (("mu_spin", "ds", rows.mu_spin), ("mu_roll", "dr", rows.mu_roll)):
            if nu is not None:
                nu = jnp.maximum(nu, MIN_FRICTION)
                angular |= {name: nu, d: live / rt * (nu / mu) ** 2}
        law = ConeLaw(live / r, slip._with(n=vhat), live / rt, mu, mu * jnp.sqrt(rt / r), **angular)
        return materialise(law, problem.one)

    def final_law(self, rows: Rows, p: Impulses, w, problem: Problem, solution: Solution, load) -> Law:
        law = self.law(dense.contacts(rows, problem), rows, problem, load)
        return Law(law.reference.n, 1.0 / jnp.where(law.dn > 0, law.dn, 1.0))

    def free(self, c: Contacts, rows: Rows, law: ConeLaw, problem: Problem) -> Impulses:
        """x = u* - reference."""
        return materialise(minus(dense.relative(c, rows, problem.v, problem.w), law.reference), problem.one)
