"""Layer 4: closed form of torque-free rotation, for validation only (host, numpy and scipy).

Angular velocity in Jacobi elliptic functions; the remaining angle about L by quadrature of a smooth
function. Source: Landau & Lifshitz, "Mechanics", section 37; van Zon & Schofield 2007 (J. Comp.
Phys. 225) for the attitude.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import ellipj, ellipk, ellipkinc


@dataclasses.dataclass(frozen=True)
class EulerTop:
    """Free rotation of a body with distinct ``moments`` (3,) [kg m^2], off its separatrix.

    omega: angular velocity at t = 0 in the principal frame (3,) [rad/s], about no principal axis.
    """

    moments: np.ndarray
    omega: np.ndarray

    def __post_init__(self):
        i, w = np.asarray(self.moments, float), np.asarray(self.omega, float)
        twice_energy, l2 = (i * w * w).sum(), (i * i * w * w).sum()
        order = np.argsort(i)
        if l2 < twice_energy * i[order[1]]:
            order = order[::-1]
        (i1, i2, i3), (w1, w2, w3) = i[order], w[order]
        parity = 1.0 if tuple(order) in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1.0
        if i1 > i3:  # the formulas below hold for descending moments too, with signs of sums
            parity = -parity
        p, s = twice_energy * i3 - l2, l2 - twice_energy * i1
        amplitude = np.sqrt([p / (i1 * (i3 - i1)), p / (i2 * (i3 - i2)), s / (i3 * (i3 - i1))])
        sign = np.sign(w3)
        set_ = object.__setattr__
        set_(self, "order", order)
        set_(self, "amplitude", amplitude * np.array([1.0, parity * sign, sign]))
        set_(self, "rate", np.sqrt((i3 - i2) * s / (i1 * i2 * i3)))
        set_(self, "modulus", (i2 - i1) * p / ((i3 - i2) * s))
        phase = np.arctan2(w2 / self.amplitude[1], w1 / self.amplitude[0])
        set_(self, "start", ellipkinc(phase, self.modulus))

    @property
    def period(self) -> float:
        """Period of the angular velocity [s]."""
        return 4.0 * ellipk(self.modulus) / self.rate

    def omega_body(self, t) -> np.ndarray:
        """Angular velocity in the principal frame (..., 3) [rad/s] at times t [s]."""
        sn, cn, dn, _ = ellipj(self.rate * np.asarray(t) + self.start, self.modulus)
        w = np.empty((*np.shape(t), 3))
        for axis, a, f in zip(self.order, self.amplitude, (cn, sn, dn)):
            w[..., axis] = a * f
        return w

    def matrix(self, t: float) -> np.ndarray:
        """Rotation from the principal frame at time t to that at 0."""
        k = self.order[1]  # L is never along the middle axis
        others = [j for j in range(3) if j != k]
        i = np.asarray(self.moments, float)
        panels = max(1, int(np.ceil(t / self.period * 32)))
        node, weight = np.polynomial.legendre.leggauss(16)
        h = t / panels
        w = self.omega_body((np.arange(panels)[:, None] + 0.5 + 0.5 * node) * h)[..., others]
        p = w * i[others]
        size = np.linalg.norm(i * self.omega)
        angle = 0.5 * h * (weight * size * (p * w).sum(-1) / (p * p).sum(-1)).sum()
        start, end = self._frame(i * self.omega, k), self._frame(i * self.omega_body(t), k)
        c, s = np.cos(angle), np.sin(angle)
        return start @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ end.T

    @staticmethod
    def _frame(p, k) -> np.ndarray:
        """Columns: axis k without its part along p, completed, p (unit)."""
        e3 = p / np.linalg.norm(p)
        e1 = np.eye(3)[k] - e3[k] * e3
        e1 /= np.linalg.norm(e1)
        return np.stack([e1, np.cross(e3, e1), e3], axis=-1)
