"""Layer 2: box."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from ..spatial import Vec3, unit_or, where
from .base import Shape


@dataclasses.dataclass(frozen=True)
class Box(Shape):
    """Box with ``half_extents`` (hx, hy, hz) [m] about its origin, sides along its axes."""

    half_extents: tuple[float, float, float]

    kind = "box"

    def __post_init__(self):
        h = tuple(float(v) for v in self.half_extents)
        if len(h) != 3:
            raise ValueError(f"Box half_extents = {h} must have three entries [m]")
        object.__setattr__(self, "half_extents", h)

    @property
    def size(self):
        return self.half_extents

    def mass_properties(self, density):
        """Mass [kg] and inertia m/3 (b^2 + c^2), ... for half-extents (a, b, c) [kg m^2]."""
        a, b, c = self.half_extents
        mass = density * 8.0 * a * b * c
        k = mass / 3.0
        return mass, (k * (b * b + c * c), k * (a * a + c * c), k * (a * a + b * b))

    @staticmethod
    def sdf(size, p: Vec3):
        """Outside |max(d, 0)|, inside max d, with d = |p| - h; the gradient points outward.

        Inside, ties between faces go to the first of x, y, z; at coordinate 0 to the positive face.
        """
        h = Vec3(*size)
        sign = p.map(lambda c: jnp.where(c < 0, -1.0, 1.0).astype(c.dtype))
        d = p * sign - h
        m = d.map(lambda c: jnp.maximum(c, 0.0))
        m2 = m.dot(m)
        outside = m2 > 0
        length = jnp.sqrt(jnp.where(outside, m2, 1.0))
        deepest = jnp.maximum(jnp.maximum(d.x, d.y), d.z)
        one, zero = jnp.ones_like(d.x), jnp.zeros_like(d.x)
        on_x = d.x >= deepest
        on_y = (d.y >= deepest) & ~on_x
        face = Vec3(jnp.where(on_x, one, zero), jnp.where(on_y, one, zero), jnp.where(on_x | on_y, zero, one))
        distance = jnp.where(outside, length, deepest)
        return distance, where(outside, unit_or(m, face), face) * sign
