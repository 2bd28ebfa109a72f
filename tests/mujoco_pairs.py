"""How MuJoCo combines the contact numbers of two geoms, priority and solmix included: an oracle for the tests."""

from __future__ import annotations

import dataclasses

import numpy as np

from rbd_jax.solvers.mujoco_law import MIN_FRICTION, MIN_VALUE, MujocoLaw

DEFAULT_SOLREF = (0.02, 1.0)
DEFAULT_SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)


@dataclasses.dataclass(frozen=True)
class GeomLaw:
    """Contact numbers of one geom, MuJoCo's defaults; friction is the sliding coefficient, the others are in [m]."""

    friction: float = 1.0
    solref: tuple[float, float] = DEFAULT_SOLREF
    solimp: tuple[float, ...] = DEFAULT_SOLIMP
    margin: float = 0.0
    gap: float = 0.0
    solmix: float = 1.0
    priority: int = 0
    condim: int = 3
    torsional: float = 0.005
    rolling: float = 0.0001


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
    torsional: float = 0.005
    rolling: float = 0.0001


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
        more = {"torsional": g.torsional, "rolling": g.rolling}
        law = PairLaw(g.friction, tuple(g.solref), tuple(g.solimp), margin, gap, g.condim, **more)
    else:
        m = _mix(geom_a.solmix, geom_b.solmix)
        a, b = (np.asarray(g.solref, float) for g in (geom_a, geom_b))
        solref = m * a + (1 - m) * b if a[0] > 0 and b[0] > 0 else np.minimum(a, b)
        solimp = m * np.asarray(geom_a.solimp, float) + (1 - m) * np.asarray(geom_b.solimp, float)
        law = PairLaw(
            max(geom_a.friction, geom_b.friction),
            tuple(solref.tolist()),
            tuple(solimp.tolist()),
            margin,
            gap,
            max(geom_a.condim, geom_b.condim),
            torsional=max(geom_a.torsional, geom_b.torsional),
            rolling=max(geom_a.rolling, geom_b.rolling),
        )
    law = dataclasses.replace(law, **(override or {}))
    return dataclasses.replace(
        law, **{f: max(getattr(law, f), MIN_FRICTION) for f in ("friction", "torsional", "rolling")}
    )


def _mix(a: float, b: float) -> float:
    """Weight of the first geom."""
    if a >= MIN_VALUE and b >= MIN_VALUE:
        return a / (a + b)
    if a < MIN_VALUE and b < MIN_VALUE:
        return 0.5
    return 0.0 if a < MIN_VALUE else 1.0


def law_of_pairs(pairs, impratio: float = 1.0, refsafe: bool = True, dtype=None) -> MujocoLaw:
    """``MujocoLaw`` of a list of ``PairLaw`` (host)."""
    col = lambda values: np.asarray(list(values), dtype or float)[:, None]
    solref = [col(p.solref[k] for p in pairs) for k in range(2)]
    solimp = [col(p.solimp[k] for p in pairs) for k in range(5)]
    friction = (None, None)
    if any(any(p.solreffriction) for p in pairs):
        rows = [p.solreffriction if any(p.solreffriction) else p.solref for p in pairs]
        friction = tuple(col(r[k] for r in rows) for k in range(2))
    return MujocoLaw(
        *solref,
        *solimp,
        margin=col(p.margin for p in pairs),
        impratio=np.full((1, 1), impratio, dtype or float),
        timeconst_friction=friction[0],
        dampratio_friction=friction[1],
        condim=np.asarray([p.condim for p in pairs])[:, None] if len({p.condim for p in pairs}) > 1 else None,
        refsafe=refsafe,
    )
