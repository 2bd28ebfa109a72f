"""Layer 5: TGS-soft, soft Gauss-Seidel sweeps and one hard relaxing sweep a (sub)step.

The soft sweeps move the poses; the relaxing sweep takes the speed of recovery from overlap out of the
velocities. A contact model whose compliance is the material's is not relaxed.

Source: Catto, "Solver2D" (2024) and Box2D v3, soft step; Macklin et al. 2019, "Small steps".
Gradients: of the truncated iteration.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from ..xla import part
from . import single
from .base import Problem, Solution, Solver
from .gauss_seidel import biased, each, in_phases, relaxing, solution, started, sweeps
from .laws import Law, contact_model
from .restitution import normal_velocity, targets
from .rows import Impulses, Rows


@dataclasses.dataclass(frozen=True)
class TGS(Solver):
    """TGS-soft.

    Attributes:
      sweeps: soft sweeps a step, >= 1 (one lets the energy of a tumbling box rise by up to 1.7e-3 m g d a step).
      relax: hard sweeps after the poses have moved, >= 1.
    """

    sweeps: int = 2
    relax: int = 1

    name = "tgs"
    contact = "soft"
    substeps = True
    spins = True
    coloured = True

    def __post_init__(self):
        if self.sweeps < 1 or self.relax < 1:
            raise ValueError(f"TGS: sweeps = {self.sweeps}, relax = {self.relax} must be >= 1")

    def solve(self, problem: Problem) -> Solution:
        model = contact_model(self, problem)
        if single.applies(problem):
            return single.solve(problem, model)
        groups, lam, body = part(started)(problem)
        return part(lambda *args: self._swept(model, *args))(problem, groups, lam, body)

    def _swept(self, model, problem: Problem, groups, lam, body) -> Solution:
        one = problem.one
        soft = each(lambda g: biased(g, model.law(g.rows, g.k_n, problem)), groups)
        if model.physical:
            body, lam = sweeps(groups, soft, lam, body, one, self.sweeps)
            return solution(problem, groups, body, lam)
        relaxed = lambda body, lam: each(lambda g, lam: relaxing(g, lam, body, problem.h), groups, lam)
        body, lam, moving = in_phases(groups, soft, relaxed, lam, body, one, (self.sweeps, self.relax))
        return solution(problem, groups, body, lam, moving)

    def final_law(self, rows: Rows, p: Impulses, w, problem: Problem, solution: Solution, load) -> Law:
        """That of the relaxing sweeps: no bias on overlap, gaps as they are after the move.

        A gap that carries nothing at the end binds the velocity of the move, not that of the end.
        """
        model = contact_model(self, problem)
        if model.physical:
            return super().final_law(rows, p, w, problem, solution, load)
        v, w_end = solution.velocities(problem)
        end = normal_velocity(rows, v, w_end)
        moved = normal_velocity(rows, solution.v_move, w_end if solution.w_move is None else solution.w_move)
        closes = -rows.phi / problem.h
        vhat = jnp.where(rows.phi <= 0, 0.0, jnp.minimum(closes - moved, 0.0))
        idle = (rows.phi > 0) & (p.n <= 0)
        if rows.e is None:
            return Law(jnp.where(idle, closes + end - moved, vhat))
        events = targets(rows, problem)
        vhat = jnp.where(idle, jnp.minimum(closes, events.bound) + end - moved, vhat)
        return Law(jnp.where(events.active, events.vhat, vhat))
