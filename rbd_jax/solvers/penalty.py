"""Layer 5: explicit penalty forces, the smallest contact solver.

Each row is a spring and a dashpot evaluated at the start of the step, no row sees another:

    p_n = max((vhat - (1 - rho) u0) / r, 0),   p_t = -u* min(mu p_n / |u*|, 1 / (w N))

with rho = -vhat h / phi the elastic share of the law. An impact with restitution takes its share of e u.
It needs h well below the period of the contact (2 / om for om the contact frequency, 1 / (zeta om) for the
dashpot) and holds friction with a creep only. No warm start.

Gradients: exact, of the step.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from ..xla import materialise
from . import dense
from .base import Problem, Solution, Solver
from .laws import contact_model
from .laws.base import points
from .restitution import normal_velocity, targets
from .rows import Impulses


@dataclasses.dataclass(frozen=True)
class Penalty(Solver):
    """Explicit springs."""

    name = "penalty"
    contact = "hertz"
    substeps = True

    def solve(self, problem: Problem) -> Solution:
        model = contact_model(self, problem)
        cs = tuple(dense.contacts(rows, problem) for rows in problem.rows)
        p = tuple(self._impulses(c, rows, problem, model) for c, rows in zip(cs, problem.rows))
        p = materialise(p, problem.one)
        impulse, turn = dense.on_bodies(cs, p, problem)
        return Solution(impulse=impulse, angular_impulse=turn, contacts=p, warm=False)

    def _impulses(self, c, rows, problem: Problem, model) -> Impulses:
        w = dense.inverse_mass(c, problem)
        law = model.law(rows, w, problem)
        u0 = normal_velocity(rows, problem.v0, problem.w0)
        u = dense.relative(c, rows, problem.v, problem.w)
        share = w * points(rows, w.dtype)
        touches = rows.live & (rows.phi < 0)
        rho = jnp.where(touches, -law.vhat * problem.h / jnp.where(touches, rows.phi, 1.0), 0.0)
        r = share if law.r is None else law.r
        pn = jnp.where(touches, jnp.maximum((law.vhat - (1.0 - rho) * u0) / r, 0.0), 0.0)
        if rows.e is not None:
            events = targets(rows, problem)
            pn = jnp.where(events.active, jnp.maximum((events.vhat - u.n) / share, 0.0), pn)
        if not c.friction:
            return Impulses(pn)
        slip = u.t1 * u.t1 + u.t2 * u.t2
        slides = slip * pn * pn > 0
        s = jnp.where(slides, rows.mu * pn / jnp.sqrt(jnp.where(slides, slip, 1.0)), 0.0)
        s = jnp.minimum(s, 1.0 / share)
        return Impulses(pn, -s * u.t1, -s * u.t2)
