"""Layer 5: MuJoCo's soft contact law: numbers of a pair of geoms, and of a row.

A row with impedance d(r), regularisation R and reference acceleration

    a_ref = -b u_n - k d r  (normal),  -b u_t  (friction),     r = phi - margin,  R = (1 - d) / d * A

stands for a constraint whose force is f = (a_ref - a) / R, limited to the friction cone. A is the sum of the
translational inverse masses; friction rows have R / impratio.

Source: MuJoCo documentation, "Computation: constraint model", and the numbers of ``MjData`` (efc_KBIP, efc_R,
efc_aref) of version 4.0.1, in which a contact acts where phi < margin and margins of two geoms add.

Symbols: solref (timeconst, dampratio), or (-stiffness, -damping) where negative; solimp (dmin, dmax, width,
midpoint, power).
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from ..struct import static, struct

#: MuJoCo's limits of impedance and friction, and its smallest divisor.
MIN_IMPEDANCE, MAX_IMPEDANCE, MIN_FRICTION, MIN_VALUE = 1e-4, 0.9999, 1e-5, 1e-15

DEFAULT_SOLREF = (0.02, 1.0)
DEFAULT_SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)


@struct
class MujocoLaw:
    """Law of every pair of a group (``Rows.law``); leaves (P, 1) or (P, B), impratio any such shape.

    timeconst, dampratio: solref, or -stiffness, -damping where they are negative.
    dmin, dmax, width, midpoint, power: solimp.
    margin: a contact acts where phi < margin [m]. impratio: ratio of friction to normal impedance.
    timeconst_friction, dampratio_friction: solreffriction, None = solref.
    frictional: bool, pairs of contact dimension 3; None = all of them (where ``Rows.mu`` is given).
    refsafe: the time constant is at least two steps.
    """

    timeconst: jax.Array
    dampratio: jax.Array
    dmin: jax.Array
    dmax: jax.Array
    width: jax.Array
    midpoint: jax.Array
    power: jax.Array
    margin: jax.Array
    impratio: jax.Array
    timeconst_friction: jax.Array | None = None
    dampratio_friction: jax.Array | None = None
    frictional: jax.Array | None = None
    refsafe: bool = static(default=True)


def law_of_pairs(pairs, impratio: float = 1.0, refsafe: bool = True, dtype=None) -> MujocoLaw:
    """``MujocoLaw`` of a list of ``PairLaw`` (host)."""
    col = lambda values: np.asarray(list(values), dtype or float)[:, None]
    solref = [col(p.solref[k] for p in pairs) for k in range(2)]
    solimp = [col(p.solimp[k] for p in pairs) for k in range(5)]
    friction = (None, None)
    if any(any(p.solreffriction) for p in pairs):
        rows = [p.solreffriction if any(p.solreffriction) else p.solref for p in pairs]
        friction = tuple(col(r[k] for r in rows) for k in range(2))
    dims = {p.condim for p in pairs}
    return MujocoLaw(
        *solref, *solimp, margin=col(p.margin for p in pairs), impratio=np.full((1, 1), impratio, dtype or float),
        timeconst_friction=friction[0], dampratio_friction=friction[1],
        frictional=np.asarray([p.condim == 3 for p in pairs])[:, None] if len(dims) == 2 else None, refsafe=refsafe,
    )


# --- one row ---------------------------------------------------------------------------------------


def impedance(law: MujocoLaw, phi: jax.Array) -> jax.Array:
    """d(r) [-], between dmin at the margin and dmax at the width."""
    dmin, dmax = (jnp.clip(d, MIN_IMPEDANCE, MAX_IMPEDANCE) for d in (law.dmin, law.dmax))
    mid = jnp.clip(law.midpoint, MIN_IMPEDANCE, MAX_IMPEDANCE)
    power = jnp.maximum(law.power, 1.0)
    flat = (dmin == dmax) | (law.width <= MIN_VALUE)
    x = jnp.abs(phi - law.margin) / jnp.where(flat, 1.0, law.width)
    inside = (x > 0) & (x < 1)
    x = jnp.where(inside, x, 0.5)
    low = x <= mid
    base = jnp.where(low, x / mid, (1.0 - x) / (1.0 - mid)) ** power
    y = jnp.where(low, mid * base, 1.0 - (1.0 - mid) * base)
    d = jnp.where(inside, dmin + y * (dmax - dmin), jnp.where(jnp.abs(phi - law.margin) > 0, dmax, dmin))
    return jnp.where(flat, 0.5 * (dmin + dmax), d)


def stiffness_damping(law: MujocoLaw, h: jax.Array, timeconst, dampratio) -> tuple[jax.Array, jax.Array]:
    """k [1/s^2] and b [1/s] of a_ref = -b u - k d r."""
    dmax = jnp.clip(law.dmax, MIN_IMPEDANCE, MAX_IMPEDANCE)
    direct = timeconst <= 0
    tc = jnp.where(direct, 1.0, jnp.maximum(timeconst, 2.0 * h) if law.refsafe else timeconst)
    ratio = jnp.where(direct, 1.0, dampratio)
    k = 1.0 / jnp.maximum(dmax * dmax * tc * tc * ratio * ratio, MIN_VALUE)
    b = 2.0 / jnp.maximum(dmax * tc, MIN_VALUE)
    return jnp.where(direct, -timeconst / (dmax * dmax), k), jnp.where(dampratio <= 0, -dampratio / dmax, b)


# --- two geoms (host) ------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class GeomLaw:
    """Contact numbers of one geom, MuJoCo's defaults; friction is the sliding coefficient."""

    friction: float = 1.0
    solref: tuple[float, float] = DEFAULT_SOLREF
    solimp: tuple[float, ...] = DEFAULT_SOLIMP
    margin: float = 0.0
    gap: float = 0.0
    solmix: float = 1.0
    priority: int = 0
    condim: int = 3


@dataclasses.dataclass(frozen=True)
class PairLaw:
    """Contact numbers of a pair of geoms."""

    friction: float
    solref: tuple[float, float]
    solimp: tuple[float, ...]
    margin: float
    gap: float
    condim: int
    solreffriction: tuple[float, float] = (0.0, 0.0)


def combine(geom_a: GeomLaw, geom_b: GeomLaw, override: dict | None = None) -> PairLaw:
    """Numbers of a pair as MuJoCo combines them; ``override`` replaces fields of the result by name.

    Margins and gaps add. The geom of higher ``priority`` gives the rest; between equals condim and
    friction are the larger ones, and solref and solimp the mean weighted by ``solmix`` (for solref
    the smaller values where one is in the direct, negative format).
    """
    unknown = set(override or ()) - {f.name for f in dataclasses.fields(PairLaw)}
    if unknown:
        raise ValueError(f"override: unknown fields {sorted(unknown)}")
    margin, gap = geom_a.margin + geom_b.margin, geom_a.gap + geom_b.gap
    if geom_a.priority != geom_b.priority:
        g = geom_a if geom_a.priority > geom_b.priority else geom_b
        law = PairLaw(g.friction, tuple(g.solref), tuple(g.solimp), margin, gap, g.condim)
    else:
        m = _mix(geom_a.solmix, geom_b.solmix)
        a, b = (np.asarray(g.solref, float) for g in (geom_a, geom_b))
        solref = m * a + (1 - m) * b if a[0] > 0 and b[0] > 0 else np.minimum(a, b)
        solimp = m * np.asarray(geom_a.solimp, float) + (1 - m) * np.asarray(geom_b.solimp, float)
        law = PairLaw(
            max(geom_a.friction, geom_b.friction), tuple(solref.tolist()), tuple(solimp.tolist()),
            margin, gap, max(geom_a.condim, geom_b.condim),
        )
    law = dataclasses.replace(law, **(override or {}))
    return dataclasses.replace(law, friction=max(law.friction, MIN_FRICTION))


def _mix(a: float, b: float) -> float:
    """Weight of the first geom."""
    if a >= MIN_VALUE and b >= MIN_VALUE:
        return a / (a + b)
    if a < MIN_VALUE and b < MIN_VALUE:
        return 0.5
    return 0.0 if a < MIN_VALUE else 1.0
