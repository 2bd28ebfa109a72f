"""Layer 8: one step with an account of it: residuals of the contact problem, penetration, energy ledger."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from .bodies import Bodies
from .detect import detect
from .diagnostics import energies
from .model import Model, Params, batch_of
from .rollout import _batched_call, _check_state, _check_wrench, _hot_wrench, _step
from .solvers import dense
from .solvers.residuals import WORST, nothing, residuals
from .state import State, World, Wrench, to_public
from .step import FROZEN, _problem, enter, leave, spins, watched, with_memory
from .struct import struct


@struct
class Audit:
    """What a step did in every world, leaves (...).

    Residuals, the worst of all contact points and substeps (formulas and sources: ``solvers.residuals``), against the
    law that the contact model sets, compliance and restitution included:

      signorini: gap speed against impulse response [m/s]. complementarity: impulse times gap speed [J].
      cone: friction impulse beyond mu times the normal one [N s].
      dissipation: power of friction against the most that the cone allows, over the step [J].
      momentum: impulse that a body received against the impulses of its contact points [N s].

    Contacts: points: how many carried an impulse in the last substep, int32. penetration, mean_penetration: deepest,
    and mean over the points that overlap, at the end of the step [m].

    Energy ledger [J]: kinetic, potential (- sum of m g . x) and stored at the end of the step; stored is the elastic
    energy of overlap where the compliance is the material's ("hertz", "spring", "mujoco"), else 0. Over the step

      dissipated = work - change of (kinetic + potential + stored)
                 = dissipated_friction + dissipated_normal + drag + error of the integrator

      work: of the control and of kinematic surfaces. dissipated_friction, dissipated_normal: what the friction rows and
      the normal rows take, from their impulses: an impact with restitution at its instant, others at the middle of the
      substep (so an inelastic landing is known to m g h |v|; ``dissipated`` itself has no such error).
    """

    signorini: jax.Array
    complementarity: jax.Array
    cone: jax.Array
    dissipation: jax.Array
    momentum: jax.Array
    points: jax.Array
    penetration: jax.Array
    mean_penetration: jax.Array
    kinetic: jax.Array
    potential: jax.Array
    stored: jax.Array
    work: jax.Array
    dissipated: jax.Array
    dissipated_friction: jax.Array
    dissipated_normal: jax.Array


def audit(model: Model, state: State, control=None) -> tuple[State, Audit]:
    """One step and an account of it.

    Args:
      model, state, control: as for :func:`rbd_jax.step`.

    Returns:
      The state after the step, bit for bit that of :func:`rbd_jax.step` (inside a program of your own as XLA compiles
      that program, as ``step`` is), and an :class:`Audit`.

    The work of a torque is that of the mean of the angular velocities before and after a substep. With
    ``Method.events`` residuals, ``points``, ``dissipated_friction``, ``dissipated_normal`` and the work of kinematic
    surfaces are those of what the impacts left of the step, the other entries of all of it. A frozen world made no
    step: its residuals, ``points``, work and dissipation are 0.
    """
    _check_state(model, state)
    if callable(control):
        control = control(model, state)
    _check_wrench(model, state, control)
    given = (model, with_memory(model, state), control)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(given)):
        return _audit(*given)
    return _step(*given), _audit(*given)[1]  # XLA rounds differently in a larger program


@jax.jit
def _audit(model, state, wrench):
    return _batched_call(_audit_batch)(model, state, wrench)


def _audit_batch(model: Model, state: State, wrench: Wrench | None) -> tuple[State, Audit]:
    batch = batch_of(model, state.batch_shape)
    p, old = enter(model, state, batch)
    dtype = state.x.x.dtype
    wrench = _hot_wrench(wrench, batch, dtype)
    worlds = old.step.shape[0]

    def watch(before: World, after: World, problem, solution):
        seen = nothing(worlds, dtype) if problem is None else residuals(model.method.solver, problem, solution)
        turned = jnp.zeros(worlds, dtype)
        if wrench is not None and wrench.torque is not None and before.bodies.L is not None:
            first, last = (p.inertia.velocity(b.q, b.L) for b in (before.bodies, after.bodies))
            turned = turned + (0.5 * p.h * wrench.torque.dot(first + last)).sum(axis=0)
        return seen, turned

    new, (seen, turned) = watched(model, p, old, wrench, watch)
    lost = (new.status & jnp.uint32(FROZEN)) != 0
    keep = lambda x: jnp.where(lost, jnp.zeros_like(x), x)
    worst = {name: keep(getattr(seen, name).max(axis=0)) for name in (*WORST, "momentum")}

    kinetic, potential = energies(p, new.bodies)
    change = _change(p, old.bodies, new.bodies)
    deepest, mean, stored = _overlap(model, p, new)
    loaded = 0.0
    if stored is None:
        stored = jnp.zeros(worlds, dtype)
    else:
        loaded = stored - _overlap(model, p, old)[2]
    work = turned.sum(axis=0) + seen.surfaces.sum(axis=0)
    if wrench is not None and wrench.force is not None:
        work = work + wrench.force.dot(new.bodies.x - old.bodies.x).sum(axis=0)
    account = Audit(
        **worst,
        points=keep(seen.points[-1]),
        penetration=deepest,
        mean_penetration=mean,
        kinetic=kinetic,
        potential=potential,
        stored=stored,
        work=keep(work),
        dissipated=keep(work - change - loaded),
        dissipated_friction=keep(seen.friction.sum(axis=0)),
        dissipated_normal=keep(seen.normal.sum(axis=0) - loaded),
    )
    full = lambda x: jnp.broadcast_to(x, (worlds,))
    return leave(model, p, new, batch), to_public(jax.tree.map(full, account), batch)


def _change(p: Params, old: Bodies, new: Bodies) -> jax.Array:
    """Change of kinetic and potential energy [J], (B,), by differences that do not cancel."""
    d, s = new.v - old.v, new.v + old.v
    change = 0.5 * p.mass * d.dot(s)
    if p.gravity is not None:
        change = change - p.mass * p.gravity.dot(new.x - old.x)
    if old.L is not None:
        a, b = (old.L, new.L) if p.inertia.isotropic else (old.q.rotate_inv(old.L), new.q.rotate_inv(new.L))
        change = change + 0.5 * (b - a).dot((b + a) / p.inertia.moments)
    return change.sum(axis=0)


def _overlap(model: Model, p: Params, world: World):
    """Deepest and mean penetration [m] and elastic energy [J] at the poses of ``world``, (B,); no energy is None."""
    bodies, contact = world.bodies, model.method.contact
    zero = jnp.zeros(world.step.shape, bodies.x.x.dtype)
    deepest, depth, count, stored = zero, zero, zero, None
    contacts = detect(model.structure, p, world, contact.reach) if model.structure.groups else ()
    problem = _problem(p, bodies, bodies.v, spins(p, bodies, bodies.L), contacts) if contacts else None
    for c in contacts:
        rows = c.rows
        over = jnp.where(rows.live & (rows.phi < 0), -rows.phi, 0.0)
        deepest = jnp.maximum(deepest, over.max(axis=(0, 1)))
        depth, count = depth + over.sum(axis=(0, 1)), count + (over > 0).sum(axis=(0, 1))
        energy = contact.energy(rows, dense.inverse_mass(dense.contacts(rows, problem), problem), problem)
        if energy is not None:
            energy = jnp.where(rows.live, energy, 0.0).sum(axis=(0, 1))
            stored = energy if stored is None else stored + energy
    return deepest, depth / jnp.maximum(count, 1), stored
