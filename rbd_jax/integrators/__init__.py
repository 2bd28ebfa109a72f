"""Layer 4: free motion. ``make(name)`` gives an integrator; see ``base`` for what it does.

To add one: subclass ``Integrator`` (or ``Splitting``, if it is a rotation map at constant L) in a
file of its own and list the class below.
"""

from __future__ import annotations

import dataclasses

from .attitude import gram_schmidt, matrix_to_quat, polar
from .base import Integrator, Splitting
from .buss2 import Buss2
from .euler import BackwardEuler, ForwardEuler, SemiImplicitEuler
from .implicit_midpoint import ImplicitMidpoint
from .mujoco import MujocoEuler, MujocoImplicitFast, MujocoRK4
from .rk4 import RK4
from .symtop import SymTop2, SymTop4

INTEGRATORS = {
    cls.name: cls
    for cls in (
        ForwardEuler,
        SemiImplicitEuler,
        BackwardEuler,
        MujocoEuler,
        MujocoImplicitFast,
        MujocoRK4,
        RK4,
        ImplicitMidpoint,
        Buss2,
        SymTop2,
        SymTop4,
    )
}


def make(integrator: str | Integrator, **options) -> Integrator:
    """The integrator of that name with ``options``; an instance is returned as it is."""
    if isinstance(integrator, Integrator):
        if options:
            raise ValueError("options go with an integrator's name, not with an instance of it")
        return integrator
    if integrator not in INTEGRATORS:
        raise ValueError(f"unknown integrator {integrator!r}; known are {', '.join(INTEGRATORS)}")
    cls = INTEGRATORS[integrator]
    known = [f.name for f in dataclasses.fields(cls)]
    wrong = sorted(set(options) - set(known))
    if wrong:
        raise ValueError(f"integrator {integrator!r} has no option {wrong}; it has {known}")
    return cls(**options)


__all__ = [
    "INTEGRATORS",
    "RK4",
    "BackwardEuler",
    "Buss2",
    "ForwardEuler",
    "ImplicitMidpoint",
    "Integrator",
    "MujocoEuler",
    "MujocoImplicitFast",
    "MujocoRK4",
    "SemiImplicitEuler",
    "Splitting",
    "SymTop2",
    "SymTop4",
    "gram_schmidt",
    "make",
    "matrix_to_quat",
    "polar",
]
