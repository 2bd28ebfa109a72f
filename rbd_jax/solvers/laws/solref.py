"""Layer 5: MuJoCo's solref and solimp, at the velocity level.

MuJoCo's row a + R f = a_ref (see ``solvers.mujoco_law``) over one step is u+ + R p = u- + h a_ref, so
vhat = u- + h a_ref, r = R. The solver "mujoco" uses the law at the acceleration level itself.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from ..mujoco_law import impedance, stiffness_damping
from ..restitution import normal_velocity
from ..rows import take
from .base import ContactModel, Law, spring_energy


@dataclasses.dataclass(frozen=True)
class Solref(ContactModel):
    """MuJoCo's softness, from the scene (``Geom.solref``, ``Geom.solimp``, margins)."""

    name = "mujoco"
    reach = "margin"
    physical = True

    def law(self, rows, w, problem, load=None) -> Law:
        law, h = rows.law, problem.h
        weight = _weight(rows, problem)
        d = impedance(law, rows.phi)
        k, b = stiffness_damping(law, h, law.timeconst, law.dampratio)
        u = normal_velocity(rows, problem.v0, problem.w0)
        compliance = jnp.maximum((1.0 - d) / d * weight, 1e-15)
        bt = b
        if law.timeconst_friction is not None:
            _, bt = stiffness_damping(law, h, law.timeconst_friction, law.dampratio_friction)
        vhat = u - h * (b * u + k * d * (rows.phi - law.margin))
        return Law(vhat, compliance, compliance / law.impratio, 1.0 - h * bt)

    def energy(self, rows, w, problem):
        """Of the spring k d / R that carries a load at rest, from the margin on; its change of d is left out."""
        law = rows.law
        d = impedance(law, rows.phi)
        k, _ = stiffness_damping(law, problem.h, law.timeconst, law.dampratio)
        compliance = jnp.maximum((1.0 - d) / d * _weight(rows, problem), 1e-15)
        return spring_energy(k * d / compliance, law.margin - rows.phi)


def _weight(rows, problem):
    """Inverse mass of a pair as MuJoCo scales its compliance with [1/kg]."""
    weight = take(problem.inv_mass, rows.b)
    return weight if rows.a is None else weight + take(problem.inv_mass, rows.a)
