"""MuJoCo's contact for a case: it has no coefficient of restitution, but a damping ratio that stands for one."""

from __future__ import annotations

import math

from ..case import Case

DEFAULT = (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)
#: As stiff as ``solimp`` may be; then restitution follows the closed form.
HARD = (0.9999, 0.9999, 0.001, 0.5, 2.0)
#: Frequency of a bounce [rad/s] where the step resolves it, and what a step resolves: w dt.
SPRING, RESOLVED = 500.0, 0.2


def damping_ratio(e: float) -> float:
    """zeta with e = exp(-2 zeta acos(zeta) / sqrt(1 - zeta^2)), the restitution of the contact law at constant
    impedance; e >= exp(-2). 0 for e = 1."""
    low, high = 0.0, 1.0
    for _ in range(60):
        zeta = (low + high) / 2
        bounce = math.exp(-2 * zeta * math.acos(zeta) / math.sqrt(1 - zeta * zeta)) if zeta < 1 else math.exp(-2)
        low, high = (zeta, high) if bounce > e else (low, zeta)
    return (low + high) / 2


def contact(case: Case, dt: float, rigid: bool):
    """(solref, solimp): what a user gets, or as rigid as a step of ``dt`` [s] bears; with the case's restitution.

    A bounce is a spring of frequency w with damping 2 zeta w (the direct format); its error is of the order of the
    time of contact pi / w, and grows with w dt.
    """
    if case.restitution:
        w = RESOLVED / dt if rigid else min(RESOLVED / dt, SPRING)
        return (-(w**2), -2 * max(damping_ratio(case.restitution), 1e-6) * w), HARD
    return ((2 * dt, 1.0), HARD) if rigid else DEFAULT
