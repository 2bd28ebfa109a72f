"""Layer 4: what a narrow-phase function receives and returns.

A narrow-phase function handles all pairs of one kind at once. Its arguments are component-wise
arrays that broadcast to (P, B): P pairs, B worlds (batch innermost).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..spatial import Quat, Vec3
from ..struct import struct


@struct
class Pose:
    """World pose of geoms: position [m] and unit quaternion, leaves (P, B) or (P, 1)."""

    x: Vec3
    q: Quat


@struct
class Manifold:
    """Contact points between A and B of every pair of one kind.

    normal: unit vector from A to B, leaves (P, B) or, where it is the same in all worlds, (P, 1); shared by the slots
      of a pair.
    point: world position, midway between the surfaces [m], leaves (S, P, B).
    distance: signed gap along the normal [m], negative = overlap, (S, P, B).
    live: whether the slot holds a point closer than the margin, bool (S, P, B).
    feature: which features touch, int32 (P, B) (or (1, 1) when always the same); equal codes in
      two consecutive steps mean that slot k is the same contact, so its impulse may be reused.
    """

    normal: Vec3
    point: Vec3
    distance: jax.Array
    live: jax.Array
    feature: jax.Array


def one_point(normal: Vec3, point: Vec3, distance: jax.Array, margin) -> Manifold:
    """The manifold of a pair that touches in one point; arguments (P, B)."""
    return Manifold(
        normal=normal,
        point=point.map(lambda c: c[None]),
        distance=distance[None],
        live=distance[None] < margin,
        feature=jnp.zeros((1, 1), jnp.int32),
    )
