"""Layer 2: shapes. ``SHAPES`` lists them in the order of a pair (A before B), as MuJoCo orders them."""

from .base import Shape
from .box import Box
from .plane import Plane
from .sphere import Sphere

SHAPES = (Plane, Sphere, Box)

__all__ = ["Box", "Plane", "SHAPES", "Shape", "Sphere"]
