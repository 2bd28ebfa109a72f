"""Layer 5: ballistic restitution, the impact speed evaluated at the surface.

Within a step the gap of a slot follows phi + u0 t + a t^2/2 (u0 its normal speed at the start, a its
normal acceleration from all but the contact forces). If it closes at a time t <= h with speed s, the
contact leaves with e s at that instant, so at the end of the step

    u+ = e s + a (h - t),       phi+ = u+ (h - t) - a (h - t)^2 / 2.

The velocity is a target for the solver, the gap a correction of the pose. Without this the height
of the first bounces is wrong by tens of percent at any practical step (the gradient at every step).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..spatial import Vec3
from ..struct import struct
from .base import Problem
from .rows import Rows, take_tree

#: An impact slower than this many times |a| h is treated as inelastic: the ball has come to rest.
THRESHOLD = 2.0


@struct
class Events:
    """Impacts within the step, every leaf (S, P, B).

    active: the slot hits within the step faster than the threshold.
    vhat: normal velocity it must have at the end of the step [m/s].
    left: time from the impact to the end of the step [s].
    accel: normal acceleration a [m/s^2].
    bound: a slot whose ballistic path does not close its gap within the step must not be stopped at its end
      because u h would: its target velocity is at most this, infinite elsewhere [m/s].
    """

    active: jax.Array
    vhat: jax.Array
    left: jax.Array
    accel: jax.Array
    bound: jax.Array

    def target(self, vhat: jax.Array) -> jax.Array:
        """Target velocities of the rows, ``vhat`` where there is no impact [m/s]."""
        return jnp.where(self.active, self.vhat, jnp.minimum(vhat, self.bound))


def normal_velocity(rows: Rows, v: Vec3, w: Vec3 | None) -> jax.Array:
    """n . u of every slot (S, P, B) for body velocities v, w (n, B)."""

    def side(index, arm, central):
        u = rows.n.dot(take_tree(v, index))
        if w is None or central:
            return u
        return u + arm.cross(rows.n).dot(take_tree(w, index))

    u = side(rows.b, rows.rb, rows.central_b)
    if rows.a is not None:
        u = u - side(rows.a, rows.ra, rows.central_a)
    if rows.surface is not None:
        u = u - rows.n.dot(rows.surface)
    return jnp.broadcast_to(u, jnp.broadcast_shapes(u.shape, rows.phi.shape))


def targets(rows: Rows, problem: Problem) -> Events:
    """Impact events of one group with restitution (``rows.e`` is not None)."""
    h, e, phi = problem.h, rows.e, jnp.maximum(rows.phi, 0.0)
    u0 = normal_velocity(rows, problem.v0, problem.w0)
    a = (normal_velocity(rows, problem.v, problem.w) - u0) / h
    s2 = u0 * u0 - 2.0 * a * phi
    hits = (s2 > 0) & ((u0 < 0) | (a < 0))
    s = jnp.sqrt(jnp.where(hits, s2, 1.0))
    # t = 2 phi / (s - u0): the root that does not cancel; s = -u0 where the gap is already closed
    closing = hits & (s - u0 > 0)
    t = 2.0 * phi / jnp.where(closing, s - u0, 1.0)
    left = h - t
    vhat = e * s + a * left
    active = (
        rows.live
        & closing
        & ((phi > 0) | (u0 < 0))
        & (left >= 0)
        & (s > THRESHOLD * jnp.abs(a) * h)
        & (e * s + 0.5 * a * left >= 0)  # leaves for the rest of the step, not back through the surface
    )
    end = u0 + a * h
    misses = phi + 0.5 * h * (u0 + end) > 0
    if rows.meets is not None:
        active, misses = active & rows.meets, misses | (~rows.meets & (rows.phi > 0))
    # below the free velocity by more than rounding, which would decide whether the slot touches
    slack = jnp.finfo(end.dtype).eps ** 0.5 * (jnp.abs(u0) + jnp.abs(end))
    return Events(active, vhat, jnp.where(active, left, 0.0), a, jnp.where(misses, end - slack, jnp.inf))
