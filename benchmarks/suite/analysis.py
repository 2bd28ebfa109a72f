"""What the rows say: orders, floors, fronts, who is the cheapest at an error, what a commit changed.

Pure functions of rows as ``store`` keeps them. Nothing is interpolated: every answer is a measured point.
"""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

OURS, RIVAL = "ours", "mujoco"
#: What a user of ours gets by name; the other variants of ours are parts of a method.
PRESETS = ("fast", "accurate", "gradient", "mujoco")
TARGETS = (1e-2, 1e-3, 1e-4)
BATCHES = ("1", "1024")
#: "At most a fifth of MuJoCo's time".
BAR = 5.0
#: A point belongs to the floor where no finer step fell by this order.
FLAT = 0.25
#: A finest step that gains less than this part of the order of the others has reached a floor.
BENDS = 0.6
#: A fit takes points above this many floors: nearer ones bend.
CLEAR = 2.0
#: Changes of a time and of an error up to these factors are not looked at.
TIME_NOISE, ERROR_NOISE = 1.25, 1.1

Row = dict[str, Any]
Key = tuple[str, str, str, str, float]


# --- rows ---


def key(row: Row) -> Key:
    return row["case"], row["engine"], row["variant"], row["dtype"], row["dt"]


def machine(row: Row) -> tuple:
    """What makes times comparable: (cpu, cores, platform)."""
    return row.get("cpu"), row.get("cores"), row.get("platform")


def newest_machine(rows: Iterable[Row]) -> tuple | None:
    """The machine of the newest point."""
    points = [r for r in rows if r.get("kind") == "point"]
    return machine(max(points, key=lambda r: r.get("date", ""))) if points else None


def latest(rows: Iterable[Row], runs: Iterable[str] | None = None, on: tuple | None = None) -> list[Row]:
    """The newest point of every key, of the ``runs`` (default: all) and of the machine ``on`` (default: any).

    Rows of one date: the later one in the file wins.
    """
    chosen = None if runs is None else set(runs)
    best: dict[Key, Row] = {}
    for row in rows:
        if row.get("kind") != "point" or (chosen is not None and row["run"] not in chosen):
            continue
        if on is not None and machine(row) != tuple(on):
            continue
        old = best.get(key(row))
        if old is None or row.get("date", "") >= old.get("date", ""):
            best[key(row)] = row
    return list(best.values())


def notes(rows: Iterable[Row], kind: str, runs: Iterable[str] | None = None) -> list[Row]:
    """The newest "refused" or "missing" row of each (case, engine, variant)."""
    chosen = None if runs is None else set(runs)
    best = {}
    for row in rows:
        if row.get("kind") == kind and (chosen is None or row["run"] in chosen):
            best[row.get("case", ""), row["engine"], row.get("variant", "")] = row
    return list(best.values())


def value(row: Row, what: str = "error", part: str = "median") -> float | None:
    """``error`` or ``self_error`` of a point; None where there is none or it is not finite."""
    number = (row.get(what) or {}).get(part)
    return float(number) if number is not None and math.isfinite(number) else None


def seconds(row: Row, batch: str, part: str = "median") -> float | None:
    """Wall seconds per simulated second and world."""
    number = ((row.get("seconds") or {}).get(batch) or {}).get(part)
    return float(number) if number is not None and math.isfinite(number) and number > 0 else None


def compiled(row: Row, batch: str) -> float | None:
    number = (row.get("compile_s") or {}).get(batch)
    return float(number) if number is not None and math.isfinite(number) else None


def ok(row: Row) -> bool:
    return row.get("status") == "ok"


def is_preset(row: Row) -> bool:
    return row["engine"] == OURS and row["variant"] in PRESETS


# --- curves ---


class Slope(NamedTuple):
    """``slope``: order in dt, None with fewer than three points above the floor; ``floor``: None where the finest step
    still lowers the error; ``used``: points of the fit."""

    slope: float | None
    floor: float | None
    used: int


def slope(dts: Sequence[float], errors: Sequence[float]) -> Slope | None:
    """Order of a method by least squares on the errors above its floor; None with fewer than three points.

    The floor begins at the step after which no finer one lowers the error by at least the order ``FLAT``, and is the
    least error from there on. Points within ``CLEAR`` floors are left out of the fit: they bend towards it.
    """
    dts, errors = np.asarray(dts, float), np.asarray([math.nan if e is None else e for e in errors], float)
    keep = np.isfinite(errors) & (errors >= 0) & (dts > 0)
    order = np.argsort(-dts[keep])
    dts, errors = dts[keep][order], errors[keep][order]
    if len(dts) < 3:
        return None
    tiny = np.maximum(errors, 1e-300)
    first = len(dts)
    while first > 1:
        best = int(np.argmin(tiny[: first - 1]))
        if tiny[first - 1] < tiny[best] * (dts[first - 1] / dts[best]) ** FLAT:
            break
        first -= 1
    if first == len(dts):
        floor, above = None, errors > 0
    else:
        floor = float(errors[first - 1 :].min())
        above = (np.arange(len(dts)) < first) & (errors > CLEAR * floor) & (errors > 0)
    x, y = np.log(dts[above]), np.log(errors[above])
    order_of = lambda x, y: float(np.polyfit(x, y, 1)[0])
    while len(x) > 3 and (y[-2] - y[-1]) / (x[-2] - x[-1]) < BENDS * order_of(x[:-1], y[:-1]):
        floor = float(errors.min()) if floor is None else floor  # the finest point has bent towards it
        x, y = x[:-1], y[:-1]
    return Slope(order_of(x, y) if len(x) >= 3 else None, floor, len(x))


@dataclasses.dataclass(frozen=True)
class Curve:
    """A method of an engine on a case over its steps, coarse to fine.

    Attributes:
      rows: of the points that ran. failed: of those that did not. skipped: how many were over the budget of time.
      order, self_order: fits of the errors against truth and against the engine's own limit.
    """

    case: str
    engine: str
    variant: str
    dtype: str
    rows: tuple[Row, ...]
    failed: tuple[Row, ...]
    skipped: int
    order: Slope | None
    self_order: Slope | None

    @property
    def preset(self) -> bool:
        return self.engine == OURS and self.variant in PRESETS

    def column(self, what: str, part: str = "median") -> np.ndarray:
        """``error`` or ``self_error`` of the rows, nan where there is none."""
        return np.array([math.nan if (v := value(r, what, part)) is None else v for r in self.rows])

    def time(self, batch: str, part: str = "median") -> np.ndarray:
        return np.array([math.nan if (v := seconds(r, batch, part)) is None else v for r in self.rows])

    @property
    def dt(self) -> np.ndarray:
        return np.array([r["dt"] for r in self.rows])


def curve(rows: Sequence[Row]) -> Curve:
    """The points of one case, engine, variant and dtype."""
    name = {key(r)[:4] for r in rows}
    if len(name) != 1:
        raise ValueError(f"rows of {len(name)} curves, not of one")
    rows = sorted(rows, key=lambda r: -r["dt"])
    ran = tuple(r for r in rows if ok(r))
    fit = lambda what: slope([r["dt"] for r in ran], [value(r, what) for r in ran])
    return Curve(
        *name.pop(), ran, tuple(r for r in rows if r["status"] == "failed"),
        sum(r["status"] == "skipped" for r in rows), fit("error"), fit("self_error"),
    )  # fmt: skip


def curves(rows: Iterable[Row], case: str | None = None) -> list[Curve]:
    """All curves (of one case), in the order of their first rows."""
    groups = collections.defaultdict(list)
    for row in latest(rows):
        if case is None or row["case"] == case:
            groups[key(row)[:4]].append(row)
    return [curve(group) for group in groups.values()]


# --- points of time and error ---


class Point(NamedTuple):
    """A measured time [s per simulated second and world] and error."""

    seconds: float
    error: float
    row: Row

    @property
    def label(self) -> str:
        """Variant, dtype and step, as in "fast, float32, 4 ms"."""
        return f"{self.row['variant']}, {self.row['dtype']}, {1e3 * self.row['dt']:.3g} ms"


def points(rows: Iterable[Row], batch: str, case: str | None = None) -> list[Point]:
    """What ran, has an error and was timed."""
    found = []
    for row in rows:
        if ok(row) and (case is None or row["case"] == case):
            time, error = seconds(row, batch), value(row)
            if time is not None and error is not None:
                found.append(Point(time, error, row))
    return found


def pareto(points: Sequence[tuple], bound: float = 0.0) -> list[int]:
    """Indices of the (time, error, ...) that no other point beats in one without losing in the other, by time.

    Errors below ``bound``, that of the truth, count as it: they cannot be told apart.
    """
    better = lambda a, b: a[0] <= b[0] and a[1] <= b[1] and (a[0] < b[0] or a[1] < b[1])
    pairs = [(p[0], max(p[1], bound)) for p in points]
    front = [i for i, p in enumerate(pairs) if not any(better(q, p) for q in pairs)]
    return sorted(front, key=lambda i: pairs[i])


def cheapest(points: Iterable[Point], target: float) -> Point | None:
    """The least time among the points whose error is at most ``target``; None: never reached."""
    return min((p for p in points if p[1] <= target), key=lambda p: p[0], default=None)


# --- verdicts ---


@dataclasses.dataclass(frozen=True)
class Reached:
    """Who is how fast at one error; None where it is never reached.

    Attributes:
      ours: cheapest of our presets. own: of all variants of ours. mujoco: of MuJoCo C. peer: of the other engines.
      tried: engines that reach it, or do not although they ran at half of the steps: of others nothing is known.
    """

    target: float
    ours: Point | None
    own: Point | None
    mujoco: Point | None
    peer: Point | None
    tried: frozenset[str]

    @property
    def other(self) -> Point | None:
        """The cheapest that is not ours."""
        return min((p for p in (self.mujoco, self.peer) if p), key=lambda p: p.seconds, default=None)

    @property
    def peer_name(self) -> str | None:
        return self.peer.row["engine"] if self.peer else None

    def factor(self, who: str = "mujoco") -> float | None:
        """Time of ``who`` ("mujoco", "peer" or "other") over ours; inf where only ours gets there, 0 where only it
        does, None where neither."""
        other = getattr(self, who)
        if self.ours is None:
            return None if other is None else 0.0
        return math.inf if other is None else other.seconds / self.ours.seconds


@dataclasses.dataclass(frozen=True)
class Verdict:
    """One case at one batch.

    Attributes:
      on_front: a preset of ours is on the front of the presets and all other engines. front: that front.
      targets: by error; none below the bound of the truth.
    """

    case: str
    batch: str
    on_front: bool
    front: tuple[Point, ...]
    targets: dict[float, Reached]


@dataclasses.dataclass(frozen=True)
class Share:
    """How many cases at one error and batch; ``asked``: those that both engines ran and one of them solved.

    Attributes:
      ahead: in less than MuJoCo's time. bar: in a fifth of it or less. alone: of these, MuJoCo never reaches the error.
      never: those in which only MuJoCo reaches it.
    """

    target: float
    batch: str
    asked: int
    ahead: int
    bar: int
    alone: int
    never: int


@dataclasses.dataclass(frozen=True)
class Verdicts:
    cases: list[Verdict]
    shares: list[Share]
    fronts: dict[str, tuple[int, int]]

    def of(self, case: str, batch: str) -> Verdict | None:
        return next((v for v in self.cases if (v.case, v.batch) == (case, batch)), None)


def _reached(found: list[Point], target: float) -> Reached:
    def of(test):
        return cheapest([p for p in found if test(p.row)], target)

    return Reached(
        target,
        of(is_preset),
        of(lambda r: r["engine"] == OURS),
        of(lambda r: r["engine"] == RIVAL),
        of(lambda r: r["engine"] not in (OURS, RIVAL)),
        frozenset(e for e in {p.row["engine"] for p in found} if e == OURS or _far_enough(found, e, target)),
    )


def _far_enough(found: list[Point], engine: str, target: float) -> bool:
    """Whether an engine reaches the error, or one of its variants ran at half of the steps that others ran at."""
    mine = [p for p in found if p.row["engine"] == engine]
    steps = {p.row["dt"] for p in found}
    runs = collections.Counter(v for v, _ in {(p.row["variant"], p.row["dt"]) for p in mine})
    return cheapest(mine, target) is not None or 2 * max(runs.values()) >= len(steps)


def _share(verdicts: list[Verdict], target: float, batch: str) -> Share:
    reached = [v.targets[target] for v in verdicts if v.batch == batch and target in v.targets]
    asked = [r for r in reached if {OURS, RIVAL} <= r.tried]
    factors = [f for r in asked if (f := r.factor()) is not None]
    count = lambda test: sum(map(test, factors))
    return Share(
        target, batch, len(factors), count(lambda f: f > 1), count(lambda f: f >= BAR), count(math.isinf),
        count(lambda f: f == 0),
    )  # fmt: skip


def verdicts(rows: Iterable[Row], cases: dict[str, Any], targets: Sequence[float] = TARGETS) -> Verdicts:
    """For each case and batch that has points judged by truth: the front, and who reaches which error how fast."""
    rows = latest(rows)
    found = []
    for name, case in cases.items():
        for batch in BATCHES:
            here = points(rows, batch, name)
            if not here:
                continue
            shown = [p for p in here if p.row["engine"] != OURS or is_preset(p.row)]
            front = tuple(shown[i] for i in pareto(shown, case.bound))
            reached = {t: _reached(here, t) for t in targets if t >= case.bound}
            found.append(Verdict(name, batch, any(is_preset(p.row) for p in front), front, reached))
    shares = [_share(found, t, b) for b in BATCHES for t in targets]
    fronts = {
        b: (sum(v.on_front for v in found if v.batch == b), sum(v.batch == b for v in found)) for b in BATCHES
    }  # fmt: skip
    return Verdicts(found, shares, fronts)


# --- history ---


@dataclasses.dataclass(frozen=True)
class Change:
    """A figure of one key on one machine at its latest commit against the commit before.

    Attributes:
      what: "time" of ``batch``, or "error" (batch ""). ratio: after over before. flagged: beyond noise.
      same_versions: of the libraries.
    """

    key: Key
    machine: tuple
    batch: str
    what: str
    before: float
    after: float
    commits: tuple[str, str]
    flagged: bool
    same_versions: bool

    @property
    def ratio(self) -> float:
        if self.before == self.after:
            return 1.0
        return self.after / self.before if self.before else math.inf


def _apart(old: dict, new: dict) -> bool:
    """The interquartile ranges of two times do not overlap."""
    return old["high"] < new["low"] or new["high"] < old["low"]


def _beyond(ratio: float, noise: float) -> bool:
    return ratio > noise or ratio < 1 / noise


def changes(rows: Iterable[Row]) -> list[Change]:
    """Every figure measured at two commits on one machine; ``flagged`` where the difference is beyond noise.

    A time is flagged where its ranges low to high do not overlap and the ratio is beyond ``TIME_NOISE``; an error,
    which repeats exactly, where the ratio is beyond ``ERROR_NOISE``.
    """
    history: dict = collections.defaultdict(dict)
    for row in sorted((r for r in rows if r.get("kind") == "point"), key=lambda r: r.get("date", "")):
        commits = history[machine(row), key(row)]
        commits.pop(row["commit"], None)  # measured again: last in the order
        commits[row["commit"]] = row
    found = []
    for (where, name), commits in history.items():
        if len(commits) < 2:
            continue
        old, new = list(commits.values())[-2:]
        if not (ok(old) and ok(new)):
            continue
        told = (old["commit"], new["commit"])
        same = old.get("versions") == new.get("versions")
        for batch in BATCHES:
            before, after = seconds(old, batch), seconds(new, batch)
            if before is not None and after is not None:
                flagged = _beyond(after / before, TIME_NOISE) and _apart(old["seconds"][batch], new["seconds"][batch])
                found.append(Change(name, where, batch, "time", before, after, told, flagged, same))
        before, after = value(old), value(new)
        if before is not None and after is not None:
            change = Change(name, where, "", "error", before, after, told, False, same)
            found.append(dataclasses.replace(change, flagged=_beyond(change.ratio, ERROR_NOISE)))
    return found


def drift(found: Iterable[Change]) -> dict[str, tuple[float, int]]:
    """Per engine the geometric mean of the time ratios, and their number: an engine that did not change tells how much
    of it is the machine."""
    ratios = collections.defaultdict(list)
    for change in found:
        if change.what == "time":
            ratios[change.key[1]].append(change.ratio)
    return {engine: (float(np.exp(np.mean(np.log(r)))), len(r)) for engine, r in ratios.items()}


def broken(rows: Iterable[Row]) -> list[tuple[Key, tuple[str, str], str]]:
    """Keys whose latest commit fails where the one before ran, or the other way round: (key, commits, new status)."""
    history: dict = collections.defaultdict(dict)
    for row in sorted((r for r in rows if r.get("kind") == "point"), key=lambda r: r.get("date", "")):
        if row["status"] in ("ok", "failed"):
            commits = history[machine(row), key(row)]
            commits.pop(row["commit"], None)
            commits[row["commit"]] = row
    found = []
    for (_, name), commits in history.items():
        if len(commits) > 1:
            old, new = list(commits.values())[-2:]
            if old["status"] != new["status"]:
                found.append((name, (old["commit"], new["commit"]), new["status"]))
    return found
