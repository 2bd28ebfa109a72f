"""Layer 5: projected Gauss-Seidel, the classic reference.

Sweeps over all rows until they hold; no substeps, no relaxation: what a model adds to recover from overlap
stays in the velocities.

Source: Erleben 2005, "Stable, robust, and versatile multibody dynamics animation", chapter 5.
Gradients: of the truncated iteration.
"""

from __future__ import annotations

import dataclasses

from ..xla import part
from .base import Problem, Solution, Solver
from .gauss_seidel import biased, each, solution, started, sweeps
from .laws import contact_model


@dataclasses.dataclass(frozen=True)
class PGS(Solver):
    """sweeps: Gauss-Seidel sweeps a step, >= 1."""

    sweeps: int = 30

    name = "pgs"
    contact = "baumgarte"
    spins = True
    coloured = True

    def __post_init__(self):
        if self.sweeps < 1:
            raise ValueError(f"PGS: sweeps = {self.sweeps} must be >= 1")

    def solve(self, problem: Problem) -> Solution:
        model, one = contact_model(self, problem), problem.one
        groups, warm, body = part(started)(problem)
        laws = each(lambda g: biased(g, model.law(g.rows, g.k_n, problem)), groups)
        body, lam = sweeps(groups, laws, warm, body, one, self.sweeps)
        return solution(problem, groups, body, lam)
