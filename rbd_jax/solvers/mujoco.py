"""Layer 5: MuJoCo's convex contact problem with the elliptic cone, solved by Newton's method.

The accelerations minimise (a - a_s)' M (a - a_s) / 2 + sum_c s(J_c a - a_ref): see ``mujoco_law`` for a_ref and R,
and ``cone`` for s and the solver; D_t = D_n impratio. Everything is multiplied by the step h: velocities
x = h (J a - a_ref) and impulses p = h f.

Source: MuJoCo documentation, "Computation: solver"; compared with ``mj_forward`` of 4.0.1 (``tests/test_newton.py``).
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from ..xla import materialise
from . import dense
from .base import Problem
from .cone import ConeLaw, ConeNewton, minus
from .dense import Contacts
from .mujoco_law import MIN_FRICTION, MujocoLaw, impedance, stiffness_damping
from .rows import Impulses, Rows, take


@dataclasses.dataclass(frozen=True)
class MujocoNewton(ConeNewton):
    """MuJoCo's contact forces; for the attributes see ``ConeNewton``."""

    name = "mujoco"
    contact = "mujoco"
    models = ("mujoco",)
    level = "force"

    def law(self, c: Contacts, rows: Rows, problem: Problem, load) -> ConeLaw:
        return _law(c, rows, problem)

    def free(self, c: Contacts, rows: Rows, law: ConeLaw, problem: Problem) -> Impulses:
        """x = h (J a_s - a_ref)."""
        dw = None if problem.w is None else problem.w - problem.w0
        return materialise(minus(dense.at_points(c, problem.v - problem.v0, dw), law.reference), problem.one)


def _law(c: Contacts, rows: Rows, problem: Problem) -> ConeLaw:
    law: MujocoLaw = rows.law
    if not isinstance(law, MujocoLaw):
        raise ValueError("the solver 'mujoco' needs Rows.law = MujocoLaw(...) in every group")
    h = problem.h
    weight = take(problem.inv_mass, rows.b)
    if rows.a is not None:
        weight = weight + take(problem.inv_mass, rows.a)
    d = impedance(law, rows.phi)
    acts = c.live & (rows.phi < law.margin)
    stiffness = jnp.where(acts, 1.0, 0.0) / jnp.maximum((1.0 - d) / d * weight, 1e-15)
    k, b = stiffness_damping(law, h, law.timeconst, law.dampratio)
    u = dense.relative(c, rows, problem.v0, problem.w0)
    normal = -h * (b * u.n + k * d * (rows.phi - law.margin))
    if not c.friction:
        return materialise(ConeLaw(stiffness, Impulses(normal)), problem.one)
    if law.timeconst_friction is not None:
        _, b = stiffness_damping(law, h, law.timeconst_friction, law.dampratio_friction)
    mu = jnp.maximum(rows.mu, MIN_FRICTION)
    slowing = lambda x: None if x is None else -h * b * x
    reference = Impulses(normal, *(slowing(x) for x in (u.t1, u.t2, u.s, u.r1, u.r2)))
    tangential = stiffness * law.impratio
    angular = {}
    for name, d, coefficient, least in (("mu_spin", "ds", rows.mu_spin, 4), ("mu_roll", "dr", rows.mu_roll, 6)):
        if coefficient is not None:
            nu = jnp.maximum(coefficient, MIN_FRICTION)
            if law.condim is not None:
                nu = jnp.where(law.condim >= least, nu, 0.0)
            angular |= {name: nu, d: tangential * (nu / mu) ** 2}
    if law.condim is not None:
        tangential = jnp.where(law.condim >= 3, tangential, 0.0)
        mu = jnp.where(law.condim >= 3, mu, 0.0)
    return materialise(
        ConeLaw(stiffness, reference, tangential, mu, mu / jnp.sqrt(law.impratio), **angular), problem.one
    )
