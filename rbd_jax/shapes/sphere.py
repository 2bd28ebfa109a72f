"""Layer 2: sphere."""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp

from ..spatial import Vec3, safe_norm, unit_or
from .base import Shape


@dataclasses.dataclass(frozen=True)
class Sphere(Shape):
    """Sphere of ``radius`` [m] about its origin."""

    radius: float

    kind = "sphere"

    @property
    def size(self):
        return (self.radius,)

    def mass_properties(self, density):
        """Mass [kg] and inertia 2/5 m r^2 [kg m^2]."""
        mass = density * 4.0 / 3.0 * math.pi * self.radius**3
        return mass, (0.4 * mass * self.radius**2,) * 3

    @staticmethod
    def sdf(size, p: Vec3):
        """|p| - r and p / |p| (z at the centre)."""
        (radius,) = size
        zero, one = jnp.zeros_like(p.x), jnp.ones_like(p.x)
        return safe_norm(p) - radius, unit_or(p, Vec3(zero, zero, one))
