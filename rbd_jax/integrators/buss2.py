"""Layer 4: Buss's augmented second-order rotation."""

from __future__ import annotations

import dataclasses

from .base import Splitting
from .rotation_maps import exp, norm_correction


@dataclasses.dataclass(frozen=True)
class Buss2(Splitting):
    """One exponential of h w + h^2/2 w' - h^3/12 w' x w (principal frame), w' = -I^-1 (w x L).

    Order 2. Keeps L and |q| to rounding; the energy drifts (not symplectic). 150 flops, 9
    divisions, 1 square root. Exact for isotropic bodies. Torque enters by half kicks of L.
    Source: Buss 2000 (J. Comp. Phys. 164), "augmented second order"; the same as a Magnus
    expansion with w linear in time.
    """

    name = "buss2"
    order = 2
    contact = True

    def rotate(self, q, L, inertia, h):
        if inertia.isotropic:
            return exp(L * (h / inertia.moments), norm_correction(q)) @ q
        p = q.rotate_inv(L)
        w = p / inertia.moments
        a = p.cross(w) / inertia.moments
        return q @ exp((w + a * (0.5 * h) + w.cross(a) * (h * h / 12.0)) * h, norm_correction(q))
