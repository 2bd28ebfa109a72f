"""Which cases, engines, variants and steps a suite measures, and how long each may take."""

from __future__ import annotations

import dataclasses

from .case import Case
from .engine import Engine

#: Ours in every case; what else is added below.
PRESETS = ("fast", "accurate")
INTEGRATORS = ("forward_euler", "semi_implicit", "rk4", "midpoint", "buss2", "symtop2")
SOLVERS = ("pgs", "newton_cone", "penalty")
#: Cases of the smoke size, where none are named.
SMOKE = ("parabola", "elastic")
#: Cases of the solvers.
SOLVED = ("slide", "incline", "column")


#: Longest job of ``standard`` [s].
LIMITS = {"ours": 300.0, "mujoco": 100.0, "mjx": 60.0, "brax": 60.0}
#: Bodies of a scene from which on an error run may take longer.
LARGE = 64
#: Made for batches, and slow to compile: one world of three bodies or more is left to ``full``.
SLOW_ALONE = ("mjx", "brax")


@dataclasses.dataclass(frozen=True)
class Job:
    """What one process measures: a case in one engine.

    Attributes:
      variants: (name, dtype) each. batches: worlds timed; only the last for variants not in ``both``.
      error_s, limit_s: longest error run, longest job [s].
    """

    case: str
    engine: str
    variants: tuple[tuple[str, str], ...]
    steps: tuple[float, ...]
    both: tuple[str, ...] = ()
    batches: tuple[int, ...] = (1, 1024)
    error_s: float = 3.0
    time_s: float = 0.05
    limit_s: float = 120.0


def ours(case: Case, known) -> list[tuple[str, str]]:
    """Presets everywhere; float64 and integrators in free flight; impacts at their instant; solvers in contact."""
    out = [(p, "float32") for p in PRESETS]
    if case.group == "free":
        out += [("accurate", "float64"), *((i, "float64") for i in INTEGRATORS if i in known)]
    elif case.restitution:
        out += [("fast+events", "float32"), ("accurate+events", "float64")]
    elif case.group == "friction":
        out += [("accurate", "float64")]
    if case.name in SOLVED:
        out += [(s, "float32") for s in SOLVERS]
    return out


def others(engine: Engine, case: Case) -> list[tuple[str, str]]:
    names = list(engine.variants)
    if engine.name == "bullet":
        names = ["default", "bounce"] if case.restitution else ["default"]
    if engine.name == "mujoco":
        names = ["euler", "implicitfast", "rk4"] if case.group == "free" else ["euler", "rigid"]
    return [(n, engine.widths[0]) for n in names]


def jobs(suite: str, cases: dict[str, Case], engines: dict[str, Engine]) -> list[Job]:
    """In the order in which they are measured: case by case, ours and MuJoCo first."""
    first = {"ours": 0, "mujoco": 1}
    order = sorted(engines.values(), key=lambda e: first.get(e.name, 2))
    return [SUITES[suite](case, engine) for case in cases.values() for engine in order]


def smoke(case, engine) -> Job:
    names = PRESETS[:1] if engine.name == "ours" else list(engine.variants)[:1]
    variants = tuple((n, engine.widths[0]) for n in names)
    return Job(case.name, engine.name, variants, case.steps[:2], tuple(names), (1, 16), 2.0, 0.02, 60.0)


def standard(case, engine) -> Job:
    variants = ours(case, engine.variants) if engine.name == "ours" else others(engine, case)
    both = tuple(v for v, _ in variants if engine.name != "ours" or v.split("+")[0] in PRESETS)
    batches = (1, 1024)
    if engine.name in SLOW_ALONE and len(case.parts) > 2:
        both, batches = (), (1024,)
    large = len(case.parts) >= LARGE
    error_s = 10.0 if large else 3.0 if engine.name == "ours" else 1.5
    limit_s = LIMITS.get(engine.name, 60.0)
    return Job(case.name, engine.name, tuple(variants), case.steps, both, batches, error_s, limit_s=limit_s)


def full(case, engine) -> Job:
    variants = [(n, d) for n in engine.variants for d in engine.widths]
    both = tuple(engine.variants)
    return Job(case.name, engine.name, tuple(variants), case.steps, both, error_s=120.0, time_s=2.0, limit_s=7200.0)


SUITES = {"smoke": smoke, "standard": standard, "full": full}
