"""Layer 5: contact models by name: how a contact yields, for any solver.

To add one: subclass ``ContactModel`` in a file of its own and list the class below.
"""

from .base import EXIT, ContactModel, Law
from .near_rigid import Baumgarte, NearRigid
from .soft import Hertz, Soft
from .solref import Solref
from .spring import Spring

CONTACT_MODELS = {cls.name: cls for cls in (Soft, Hertz, NearRigid, Baumgarte, Spring, Solref)}


def contact_model(solver, problem) -> ContactModel:
    """The model of the problem, or the solver's own."""
    return CONTACT_MODELS[solver.contact]() if problem.contact is None else problem.contact


__all__ = [
    "EXIT",
    "Baumgarte",
    "CONTACT_MODELS",
    "ContactModel",
    "Hertz",
    "Law",
    "NearRigid",
    "Soft",
    "Solref",
    "Spring",
    "contact_model",
]
