"""Layer 2: half-space."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from ..spatial import Vec3
from .base import Shape


@dataclasses.dataclass(frozen=True)
class Plane(Shape):
    """Half-space below the plane z = 0 of its frame; the outward normal is +z. Static or kinematic only."""

    kind = "plane"
    solid = False

    @property
    def size(self):
        return ()

    @staticmethod
    def sdf(size, p: Vec3):
        """z and (0, 0, 1)."""
        zero, one = jnp.zeros_like(p.z), jnp.ones_like(p.z)
        return p.z, Vec3(zero, zero, one)
