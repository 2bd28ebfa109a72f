"""Layer 5: TGS-soft, soft Gauss-Seidel sweeps and one hard relaxing sweep a (sub)step.

The soft sweeps move the poses; the relaxing sweep takes the speed of recovery from overlap out of the
velocities. A contact model whose compliance is the material's is not relaxed.

Source: Catto, "Solver2D" (2024) and Box2D v3, soft step; Macklin et al. 2019, "Small steps".
Gradients: of the truncated iteration.
"""

from __future__ import annotations

import dataclasses

from ..xla import materialise
from . import single
from .base import Problem, Solution, Solver
from .gauss_seidel import apply, arranged, biased, prepare, relaxing, solution, sweep
from .laws import contact_model


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

    def __post_init__(self):
        if self.sweeps < 1 or self.relax < 1:
            raise ValueError(f"TGS: sweeps = {self.sweeps}, relax = {self.relax} must be >= 1")

    def solve(self, problem: Problem) -> Solution:
        model = contact_model(self, problem)
        if single.applies(problem):
            return single.solve(problem, model)
        one = problem.one
        groups = [prepare(rows, problem) for rows in problem.rows]
        lam = [arranged(l, g.plan) for g, l in zip(groups, problem.warm)]
        body = (problem.v, problem.w)
        for g, l in zip(groups, lam):
            body = apply(g, l, body)
        body = materialise(body, one)
        soft = [biased(g, model.law(g.rows, g.k_n, problem)) for g in groups]
        for _ in range(self.sweeps):
            for k, g in enumerate(groups):
                body, lam[k] = sweep(g, soft[k], lam[k], body, one)
        if model.physical:
            return solution(problem, groups, body, lam)
        moving = body
        hard = [relaxing(g, l, moving, problem.h) for g, l in zip(groups, lam)]
        for _ in range(self.relax):
            for k, g in enumerate(groups):
                body, lam[k] = sweep(g, hard[k], lam[k], body, one)
        return solution(problem, groups, body, lam, moving)
