"""Layer 5: projected Gauss-Seidel, the classic reference.

Sweeps over all rows until they hold; no substeps, no relaxation: what a model adds to recover from overlap
stays in the velocities.

Source: Erleben 2005, "Stable, robust, and versatile multibody dynamics animation", chapter 5.
Gradients: of the truncated iteration.
"""

from __future__ import annotations

import dataclasses

import jax

from ..xla import materialise
from .base import Problem, Solution, Solver
from .gauss_seidel import apply, arranged, biased, prepare, solution, sweep
from .laws import contact_model


@dataclasses.dataclass(frozen=True)
class PGS(Solver):
    """sweeps: Gauss-Seidel sweeps a step, >= 1."""

    sweeps: int = 30

    name = "pgs"
    contact = "baumgarte"
    spins = True

    def __post_init__(self):
        if self.sweeps < 1:
            raise ValueError(f"PGS: sweeps = {self.sweeps} must be >= 1")

    def solve(self, problem: Problem) -> Solution:
        model, one = contact_model(self, problem), problem.one
        groups = [prepare(rows, problem) for rows in problem.rows]
        body = (problem.v, problem.w)
        warm = [arranged(l, g.plan) for g, l in zip(groups, problem.warm)]
        for g, l in zip(groups, warm):
            body = apply(g, l, body)
        laws = [biased(g, model.law(g.rows, g.k_n, problem)) for g in groups]

        def once(carry, _):
            body, lam = carry
            lam = list(lam)
            for k, g in enumerate(groups):
                body, lam[k] = sweep(g, laws[k], lam[k], body, one)
            return (body, tuple(lam)), None

        lam = tuple(
            jax.tree.map(lambda c, g=g: jax.numpy.broadcast_to(c, g.rows.phi.shape), l) for g, l in zip(groups, warm)
        )
        (body, lam), _ = jax.lax.scan(once, (materialise(body, one), lam), length=self.sweeps)
        return solution(problem, groups, body, lam)
