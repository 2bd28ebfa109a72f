"""Layer 2: what every shape provides."""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar


@dataclasses.dataclass(frozen=True)
class Shape:
    """A rigid shape about its own frame. Sizes are in metres.

    Subclasses are frozen dataclasses whose fields are their sizes. They provide

    * ``kind``: the name, also MuJoCo's geom type,
    * ``size``: the sizes as a flat tuple of floats,
    * ``mass_properties(density)``: mass [kg] and principal inertia [kg m^2] in the shape's frame,
    * ``sdf(size, p)``: exact signed distance [m] (negative inside) and its unit gradient at the
      local point ``p`` (a Vec3), with traced sizes.
    """

    kind: ClassVar[str]
    solid: ClassVar[bool] = True

    @property
    def size(self) -> tuple[float, ...]:
        raise NotImplementedError

    def check(self, owner: str) -> None:
        """Raise ValueError, naming ``owner``, unless every size is finite and positive."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            for v in value if isinstance(value, tuple) else (value,):
                if not (math.isfinite(v) and v > 0):
                    raise ValueError(f"{owner}: {self.kind} {field.name} = {value} must be finite and > 0 [m]")
