"""Layer 4: contact geometry.

``NARROW`` maps a pair of kinds, in the order of ``SHAPES``, to its narrow phase.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax

from .base import Manifold, Pose
from .box_box import box_box
from .box_plane import plane_box
from .sphere_box import sphere_box
from .sphere_plane import plane_sphere
from .sphere_sphere import sphere_sphere, time_of_impact


@dataclasses.dataclass(frozen=True)
class NarrowPhase:
    """A narrow phase and its number of slots.

    function(a, b, size_a, size_b, margin, one=1.0) -> Manifold, for Poses a and b that broadcast to
      (P, B), sizes as tuples of arrays (Shape.size), margin [m]: a point is live when its distance
      is below it. Without a margin that is overlap. one: see ``xla.materialise``.
    first(a, b, va, vb, size_a, size_b) -> t: where the search for the time of impact starts [s], for centres
      moving straight at va, vb; infinite where they do not meet. None: at once.
    """

    function: Callable[..., Manifold]
    slots: int
    first: Callable[..., jax.Array] | None = None


NARROW: dict[tuple[str, str], NarrowPhase] = {
    ("plane", "sphere"): NarrowPhase(plane_sphere, 1),
    ("plane", "box"): NarrowPhase(plane_box, 8),
    ("sphere", "sphere"): NarrowPhase(sphere_sphere, 1, time_of_impact),
    ("sphere", "box"): NarrowPhase(sphere_box, 1),
    ("box", "box"): NarrowPhase(box_box, 12),
}

__all__ = ["Manifold", "NARROW", "NarrowPhase", "Pose"]
