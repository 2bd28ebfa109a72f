"""Layer 5: contact solvers by name."""

from .base import Problem, Solution, Solver
from .rows import Impulses, Rows
from .tgs import TGS

SOLVERS = {"tgs": TGS}

__all__ = ["Impulses", "Problem", "Rows", "SOLVERS", "Solution", "Solver", "TGS"]
