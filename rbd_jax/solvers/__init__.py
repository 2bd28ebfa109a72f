"""Layer 5: contact solvers by name."""

from .base import Problem, Solution, Solver
from .laws import CONTACT_MODELS, ContactModel
from .mujoco import MujocoNewton
from .newton import NewtonLagged
from .newton_cone import NewtonCone
from .penalty import Penalty
from .pgs import PGS
from .rows import Impulses, Rows
from .tgs import TGS

SOLVERS = {cls.name: cls for cls in (TGS, PGS, NewtonLagged, NewtonCone, MujocoNewton, Penalty)}

__all__ = [
    "CONTACT_MODELS",
    "ContactModel",
    "Impulses",
    "MujocoNewton",
    "NewtonCone",
    "NewtonLagged",
    "PGS",
    "Penalty",
    "Problem",
    "Rows",
    "SOLVERS",
    "Solution",
    "Solver",
    "TGS",
]
