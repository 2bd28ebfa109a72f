"""Layer 4: which pairs are close enough to look at, in a fixed number of places.

Small groups look at every pair. A group with many pairs keeps those whose bounding boxes (grown by
the way the bodies move in a step) overlap, in at most ``capacity`` places per world; one pair more
sets the CAPACITY status bit of that world.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..spatial import Vec3
from .base import Pose


def half_widths(kind: str, size, pose: Pose) -> Vec3:
    """Half-widths of the world axis-aligned bounding box of geoms [m]."""
    if kind == "sphere":
        return Vec3(size[0], size[0], size[0])
    r = pose.q.mat()
    h = Vec3(*size)
    return Vec3(*(row.map(jnp.abs).dot(h) for row in (r.a, r.b, r.c)))


def separation(pa: Pose, wa: Vec3, pb: Pose, wb: Vec3) -> jax.Array:
    """Largest gap over the three axes between two bounding boxes [m], (P, B); negative = overlap."""
    d = (pb.x - pa.x).map(jnp.abs) - wa - wb
    return jnp.maximum(jnp.maximum(d.x, d.y), d.z)


def compact(close: jax.Array, capacity: int) -> tuple[jax.Array, jax.Array]:
    """Indices of the True entries of ``close`` (P, B) in ascending order, in ``capacity`` places.

    Returns:
      pairs: int32 (C, B); P where a place is empty.
      overflow: bool (B,), more than C entries were True.
    """
    total, worlds = close.shape
    place = jnp.cumsum(close.astype(jnp.int32), axis=0) - 1
    place = jnp.where(close & (place < capacity), place, capacity)
    ids = jnp.broadcast_to(jnp.arange(total, dtype=jnp.int32)[:, None], close.shape)
    empty = jnp.full((capacity + 1, worlds), total, jnp.int32)
    pairs = empty.at[place, jnp.arange(worlds)[None, :]].min(ids)
    return pairs[:capacity], close.sum(axis=0) > capacity


def lookup(pairs: jax.Array, previous: jax.Array, total: int) -> jax.Array:
    """Place that each of ``pairs`` (C, B) had in ``previous`` (C, B); C where it had none."""
    capacity, worlds = previous.shape
    column = jnp.arange(worlds)[None, :]
    places = jnp.broadcast_to(jnp.arange(capacity, dtype=jnp.int32)[:, None], previous.shape)
    table = jnp.full((total + 1, worlds), capacity, jnp.int32).at[previous, column].set(places)
    table = table.at[total].set(capacity)
    return table[pairs, column]
