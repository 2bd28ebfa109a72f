"""Layer 5: what a contact model is.

A model says how a contact yields, a solver finds the impulses. Both speak of one row:

    p_n = max((vhat - u_n) / r, 0)          u_n normal velocity at the end of the step, p_n its impulse

with the compliance r [1/kg] (0 = rigid) and the target velocity vhat [m/s]. A spring k with dashpot c
stepped implicitly is r = 1 / (h (c + h k)), vhat = -phi h k / (c + h k) / h, so every linear law has this form.
Friction is |p_t| <= mu p_n in every model; ``rt`` softens it for solvers with a true cone.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from ...struct import struct
from ...xla import summed
from ..rows import Rows

#: Bodies that start in overlap part at up to this many times a model's ``push_speed``: a contact alone gives
#: ``push_speed``, but one between two others receives part of their push (25 % overlapped pyramid: 1.25 to 1.4).
EXIT = 1.5


@struct
class Law:
    """The law of every row of a group, leaves (S, P, B) or what broadcasts to it.

    vhat: target velocity [m/s]. r: compliance [1/kg], None = rigid everywhere.
    rt: compliance of friction [1/kg], None: the solver's own. keep: part of its slip that friction
    leaves a row by the end of the step [-], None = 0 (all of it is stopped, up to the cone).
    """

    vhat: jax.Array
    r: jax.Array | None = None
    rt: jax.Array | None = None
    keep: jax.Array | None = None


@dataclasses.dataclass(frozen=True)
class ContactModel:
    """A contact model: a frozen (hashable, static) dataclass of its constants."""

    name: ClassVar[str]
    #: which slots it wants: "nearby" those that may touch within the step whatever hits what in it, "step" those
    #: that may touch at the velocities of its start, "margin" those closer than their margin, "all" however far.
    reach: ClassVar[str] = "step"
    #: whether the compliance is the material's. If not, it is a means to be stable, and a solver may take out
    #: of the velocities what it adds to recover from overlap.
    physical: ClassVar[bool] = False

    def law(self, rows: Rows, w: jax.Array, problem, load: jax.Array | None = None) -> Law:
        """The law of one group; ``w`` [1/kg] (S, P, B) is the inverse mass seen by each normal row, ``load`` [N s] the
        normal impulse that each carried in the step before (0 where it is new), None = unknown."""
        raise NotImplementedError

    def energy(self, rows: Rows, w: jax.Array, problem) -> jax.Array | None:
        """Elastic energy of the overlap of every slot [J] (S, P, B), None where the model stores none."""
        return None


def spring_energy(stiffness, overlap: jax.Array) -> jax.Array:
    """k x^2 / 2 [J] of a spring that is compressed by ``overlap`` [m]."""
    x = jnp.maximum(overlap, 0.0)
    return 0.5 * stiffness * x * x


def points(rows: Rows, dtype) -> jax.Array:
    """Number of live points of every pair, at least 1: they share its load. (P, B)."""
    return jnp.maximum(summed(rows.live.astype(dtype)), 1)


def recovery(
    phi: jax.Array, problem, fraction, push_speed: float, deep: tuple[float, float] | None = None
) -> jax.Array:
    """Target velocity [m/s]: a gap may close exactly; a ``fraction`` of an overlap is taken back a step, at up to
    ``push_speed``. deep: a speed [m/s] and a fraction, of what is beyond the overlap that gives that speed, if smaller.
    """
    # products with the reciprocal, as XLA makes them of a quotient in one program and not in another
    gap = -phi * (1.0 / problem.h)
    back = gap if problem.nominal is None else -phi * (1.0 / problem.nominal)
    speed = fraction * back
    if deep is not None:
        slow, part = deep[0], min(deep[1], fraction)
        speed = jnp.minimum(speed, part * back + (1.0 - part / fraction) * slow)
    return jnp.where(phi <= 0, jnp.minimum(speed, push_speed), gap)
