"""Layer 0: run-time status, one bit per cause, OR-ed as a world runs and never cleared by it.

Nothing is clamped, replaced or raised inside a step: a world that goes wrong says so in its
``status`` and the host reads it with :func:`rbd_jax.check`.
"""

from __future__ import annotations

import enum


class Status(enum.IntFlag):
    """What went wrong in a world. Each bit carries a message and a remedy."""

    OK = 0
    NOT_FINITE = 1
    CAPACITY = 2
    NOT_CONVERGED = 4


MESSAGE = {
    Status.NOT_FINITE: (
        "the state became infinite or NaN; the world is frozen at its last finite state",
        "use a smaller dt or more substeps, or look at the control or the parameters of this world",
    ),
    Status.CAPACITY: (
        "more pairs came close than the pair capacity holds, so contacts were dropped",
        "build with a larger Method(capacity=...)",
    ),
    Status.NOT_CONVERGED: (
        "the contact solver stopped above its tolerance",
        "use more iterations or substeps in Method(...)",
    ),
}
