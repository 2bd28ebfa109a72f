"""Layer 5: what a contact solver receives and returns."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from ..bodies import Inertia
from ..spatial import Quat, Vec3
from ..struct import static, struct
from .rows import Impulses, InverseInertia, Rows


@struct
class Problem:
    """One velocity-level contact problem; every body array is (n, B) or (n, 1).

    Attributes:
      rows: groups of contact rows (at least one).
      v0, w0: velocities at the start of the step [m/s, rad/s].
      v, w: predicted velocities v* = v0 + h a, w* (all but the contact forces applied).
        w0 and w are None when the scene carries no attitude (then no row has an angular part).
      inv_mass: [1/kg]. inertia, q: principal inertia and attitude. inv_inertia: world R I^-1 R^T.
      h: step [s], scalar or (B,). nominal: the step over which overlap is resolved, where h is what impacts left
        of it; None = h.
      warm: impulses to start from, one entry a group, already zero where a contact is new.
      load: normal impulses of the step before, one entry a group (S, P, B), zero where a point is new; those of
        impacts among them. None = unknown.
      smoothing: (normal, slip) speeds [m/s] over which a solver that smooths does so, each (1,) or (B,).
      contact: the ``laws.ContactModel``, None = the solver's own.
      stacked: whether what touches at several points, as boxes do, may carry other bodies.
      one: an array equal to 1 that XLA cannot see through, see ``rbd_jax.xla.materialise``.
    """

    rows: tuple[Rows, ...]
    v0: Vec3
    v: Vec3
    inv_mass: jax.Array
    h: jax.Array
    warm: tuple[Impulses, ...]
    one: jax.Array
    load: tuple[jax.Array, ...] | None = None
    nominal: jax.Array | None = None
    w0: Vec3 | None = None
    w: Vec3 | None = None
    q: Quat | None = None
    inertia: Inertia | None = None
    inv_inertia: InverseInertia | None = None
    smoothing: tuple | None = None
    contact: object = static(default=None)
    stacked: bool = static(default=False)

    @property
    def loads(self) -> tuple:
        """``load``, with a None for every group where it is unknown."""
        return (None,) * len(self.rows) if self.load is None else self.load

    def without_rows(self) -> Problem:
        """What all groups share."""
        return self._with(rows=(), warm=(), load=None)


@struct
class Solution:
    """What the contacts do in this step.

    Attributes:
      impulse: total contact impulse on every body [N s], (n, B).
      angular_impulse: about its centre of mass [N m s], (n, B); None without attitude.
      contacts: impulses per group and slot.
      v_move, w_move: velocities that move the poses in this step where they differ from the
        end-of-step velocities (position bias), else None.
      unconverged: bool (B,) or None.
      overflow: bool (B,), live contacts that found no place and were dropped; None = cannot happen.
      warm: whether the next step starts from these impulses (a closed form does not).
    """

    impulse: Vec3
    contacts: tuple[Impulses, ...]
    angular_impulse: Vec3 | None = None
    v_move: Vec3 | None = None
    w_move: Vec3 | None = None
    unconverged: jax.Array | None = None
    overflow: jax.Array | None = None
    warm: bool = static(default=True)

    def velocities(self, problem: Problem) -> tuple[Vec3, Vec3 | None]:
        """Velocities at the end of the step, at the inertia of its start."""
        v = problem.v + self.impulse * problem.inv_mass
        if problem.w is None:
            return v, None
        return v, problem.w + problem.inv_inertia @ self.angular_impulse


@dataclasses.dataclass(frozen=True)
class Solver:
    """A contact solver: a frozen (hashable, static) dataclass of its iteration counts and constants."""

    name: ClassVar[str]
    #: its contact model where the method names none
    contact: ClassVar[str]
    #: the models it takes, None = any
    models: ClassVar[tuple[str, ...] | None] = None
    #: whether a step is better split than solved harder (``Method.substeps`` = None)
    substeps: ClassVar[bool] = False
    #: whether it has rows of torsional and rolling friction; ``build`` refuses scenes that need them where not
    spins: ClassVar[bool] = False
    #: whether the friction rows of a point share one elliptic cone; else sliding, torsion and rolling have one each
    elliptic: ClassVar[bool] = False
    #: whether it goes through the rows colour by colour
    coloured: ClassVar[bool] = False
    #: "velocity": solves for end-of-step velocities; "force": gives forces at the given state
    level: ClassVar[str] = "velocity"
    #: None, or what of contact is smoothed ("forward": all of it, "backward": its derivatives)
    smoothing = None

    def solve(self, problem: Problem) -> Solution:
        raise NotImplementedError

    def final_law(self, rows: Rows, p: Impulses, w: jax.Array, problem: Problem, solution: Solution, load: jax.Array):
        """The ``laws.Law`` that impulses and end-of-step velocities of a group obey where this solver has converged.

        An impact with restitution hits its target velocity rigidly. ``p``: the impulses of the group; ``w`` as in
        ``ContactModel.law``, and so is ``load``. Only ``residuals`` asks.
        """
        from .laws import contact_model
        from .restitution import targets

        law = contact_model(self, problem).law(rows, w, problem, load)
        if rows.e is None:
            return law
        events = targets(rows, problem)
        r = None if law.r is None else jnp.where(events.active, 0.0, law.r)
        return law._with(vhat=events.target(law.vhat), r=r)
