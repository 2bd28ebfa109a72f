"""Layer 5: contact solvers by name."""

from .base import Problem, Solution, Solver
from .mujoco import MujocoNewton
from .newton import NewtonLagged
from .rows import Impulses, Rows
from .tgs import TGS

SOLVERS = {cls.name: cls for cls in (TGS, NewtonLagged, MujocoNewton)}

__all__ = ["Impulses", "MujocoNewton", "NewtonLagged", "Problem", "Rows", "SOLVERS", "Solution", "Solver", "TGS"]
