"""The reading side of the benchmark suite, on rows made here."""

import csv
import dataclasses
import importlib.util
import math
import pathlib
import re
import sys

import numpy as np
import pytest

ROOT = pathlib.Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

from suite import analysis  # noqa: E402


@dataclasses.dataclass(frozen=True)
class Case:
    name: str
    title: str
    group: str
    features: frozenset
    bound: float = 1e-6
    unit: str = "largest position error [m]"
    reference: str = "closed form"
    parts: tuple = (None,)


@dataclasses.dataclass(frozen=True)
class Engine:
    name: str
    title: str
    colour: str
    variants: dict
    install: str = ""

    def order(self, case, variant):
        return {"fast": 2, "accurate": 4}.get(variant) if case.group == "free" else None


CASES = {
    c.name: c
    for c in (
        Case("top", "Spinning top", "free", frozenset({"attitude"}), 1e-12),
        Case("slide", "Sliding box", "friction", frozenset({"attitude", "contact", "friction"})),
        Case("bounce", "Bouncing ball", "impact", frozenset({"contact", "restitution"}), 1e-4),
    )
}
ENGINES = {
    e.name: e
    for e in (
        Engine("ours", "rbd_jax", "#0072B2", dict.fromkeys(("fast", "accurate", "gradient", "mujoco", "rk4"), "")),
        Engine("mujoco", "MuJoCo C", "#D55E00", dict.fromkeys(("euler", "implicitfast", "rk4", "rigid"), "")),
        Engine("rapier", "Rapier", "#CC79A7", {"default": ""}, "cargo build"),
    )
}
STEPS = (0.016, 0.008, 0.004, 0.002, 0.001)
HOME = {"cpu": "AMD EPYC", "cores": 2, "platform": "cpu"}


def point(case="top", engine="ours", variant="fast", dtype="float32", dt=0.004, error=1e-3, time=1e-3, **other):
    """A row; ``time`` of 1,024 worlds, one world takes 20 times as long."""
    stats = lambda e: None if e is None else {"median": e, "p10": e / 2, "p90": e * 2, "worlds": 16, "failed_worlds": 0}
    timed = lambda t, n: {"median": t, "low": 0.97 * t, "high": 1.04 * t, "worlds": n, "steps": 100}
    self_error = other.pop("self_error", error)
    row = {
        "kind": "point", "run": "one", "suite": "standard", "date": "2026-01-01T00:00:00Z", "commit": "aaaaaaa",
        "versions": {"jax": "0.10.2", "mujoco-core": "4.0.1"}, **HOME,
        "case": case, "engine": engine, "variant": variant, "dtype": dtype, "dt": dt, "status": "ok", "reason": "",
        "error": stats(error), "self_error": stats(self_error), "compile_s": {"1": 1.0, "1024": 2.0},
        "seconds": {} if time is None else {"1": timed(20 * time, 1), "1024": timed(time, 1024)},
    }  # fmt: skip
    return {**row, **other}


def sweep(case, engine, variant, dtype, scale, order, floor, cost):
    return [
        point(case, engine, variant, dtype, dt, scale * (dt / 0.016) ** order + floor, cost / dt) for dt in STEPS
    ]  # fmt: skip


@pytest.fixture
def rows():
    found = []
    for case in ("top", "slide"):
        found += sweep(case, "ours", "fast", "float32", 1e-2, 2, 1e-6, 1e-7)
        found += sweep(case, "ours", "accurate", "float64", 1e-3, 2, 0, 4e-7)
        found += sweep(case, "mujoco", "euler", "float64", 1e-1, 1, 0, 2e-6)
        found += sweep(case, "mujoco", "rigid", "float64", 3e-2, 1, 1e-3, 2e-6)
        found += sweep(case, "rapier", "default", "float32", 5e-2, 1, 2e-3, 1e-6)
    found += sweep("bounce", "ours", "fast", "float32", 5e-2, 1, 0, 1e-7)
    found += sweep("bounce", "mujoco", "euler", "float64", 1e-1, 1, 5e-2, 2e-6)
    found += [
        point("bounce", "rapier", "default", dt=0.016, error=None, time=1e-5, status="failed", reason="NaN"),
        point("bounce", "rapier", "default", dt=0.008, error=None, time=None, status="failed", reason="hung"),
        point("bounce", "rapier", "default", dt=0.001, error=None, time=None, status="skipped", reason="budget"),
        {
            "kind": "refused",
            "run": "one",
            "case": "bounce",
            "engine": "mujoco",
            "variant": "rk4",
            "reason": "no damping",
        },
        {"kind": "missing", "run": "one", "engine": "warp", "reason": "not installed", "install": "pip install warp"},
        {"kind": "start", "run": "one", "suite": "standard", "jobs": 60},
        {"kind": "end", "run": "one"},
    ]
    return found


# --- analysis ---


def test_slope_stops_at_the_floor():
    dts = 0.1 / 2.0 ** np.arange(10)
    fit = analysis.slope(dts, dts**2 + 1e-5)
    assert fit.slope == pytest.approx(2, abs=0.1) and fit.floor == pytest.approx(1e-5, rel=0.01) and 3 <= fit.used < 10
    assert analysis.slope(dts[::-1], (3 * dts)[::-1]) == (pytest.approx(1), None, 10)
    assert analysis.slope(dts, np.full(10, 1e-3))[:2] == (None, 1e-3)
    assert analysis.slope(dts[:2], dts[:2]) is None
    rising = np.maximum(dts**4, 1e-9 / dts)  # rounding grows with the number of steps
    fit = analysis.slope(dts, rising)
    assert fit.slope == pytest.approx(4, abs=0.2) and fit.floor == rising.min()
    noisy = analysis.slope([8, 4, 2, 1], [8, None, math.nan, 1])
    assert noisy is None


def test_pareto_and_cheapest():
    assert analysis.pareto([(1, 1.0), (2, 0.5), (2, 0.7), (3, 0.5), (4, 0.1)]) == [0, 1, 4]
    assert analysis.pareto([(1, 1e-9), (2, 1e-12)], bound=1e-8) == [0]
    here = analysis.points([point(dt=d, error=d, time=1e-6 / d) for d in (0.1, 0.01, 0.001)], "1024")
    assert analysis.cheapest(here, 0.05).error == 0.01
    assert analysis.cheapest(here, 1e-4) is None


def test_latest_row_wins():
    old, new = point(error=1.0), point(error=2.0, date="2026-01-02T00:00:00Z", run="two")
    assert analysis.latest([new, old]) == [new] and analysis.latest([old, new], runs=["one"]) == [old]
    again = point(error=3.0)
    assert analysis.latest([old, again]) == [again]
    elsewhere = point(cpu="other", date="2026-01-03T00:00:00Z")
    assert analysis.latest([old, elsewhere], on=analysis.machine(old)) == [old]
    assert analysis.newest_machine([old, elsewhere]) == ("other", 2, "cpu")


def test_verdicts(rows):
    found = analysis.verdicts(rows, CASES)
    top = found.of("top", "1024").targets
    assert top[1e-3].ours.row["variant"] == "fast" and top[1e-3].ours.row["dt"] == 0.004
    assert top[1e-3].mujoco is None and top[1e-3].factor() == math.inf and top[1e-3].peer is None
    assert top[1e-2].factor() == pytest.approx((2e-6 / 0.004) / (1e-7 / 0.008))
    assert top[1e-2].peer_name == "rapier" and found.of("top", "1").on_front
    bounce = found.of("bounce", "1024").targets
    assert bounce[1e-2].factor() == math.inf and bounce[1e-4].factor() is None
    share = next(s for s in found.shares if (s.target, s.batch) == (1e-2, "1024"))
    assert (share.asked, share.ahead, share.bar, share.alone, share.never) == (3, 3, 3, 1, 0)
    coarse = {"top": dataclasses.replace(CASES["top"], bound=5e-3)}
    assert list(analysis.verdicts(rows, coarse).of("top", "1").targets) == [1e-2]
    beaten = analysis.verdicts([point(error=1e-2), point(engine="mujoco", variant="rk4", error=1e-4)], CASES)
    assert not beaten.of("top", "1024").on_front and beaten.of("top", "1024").targets[1e-3].factor() == 0


def test_an_engine_that_ran_at_few_steps_is_not_said_never_to_get_there():
    """A time limit left MuJoCo one of five steps: nothing is known of the finer ones."""
    ours = sweep("top", "ours", "fast", "float32", 1e-2, 2, 1e-6, 1e-7)
    for count, tried in ((1, False), (3, True)):
        rows = [*ours, *sweep("top", "mujoco", "euler", "float64", 1.0, 0, 0, 2e-6)[:count]]
        reached = analysis.verdicts(rows, CASES).of("top", "1024").targets[1e-3]
        assert reached.mujoco is None and ("mujoco" in reached.tried) == tried


def test_changes_beyond_noise_only():
    later = {"date": "2026-01-02T00:00:00Z", "commit": "bbbbbbb"}
    flagged = lambda *rows: [(c.what, c.batch) for c in analysis.changes(rows) if c.flagged]
    assert flagged(point(time=1e-3), point(time=1.2e-3, **later)) == []
    assert flagged(point(time=1e-3), point(time=1.4e-3, **later)) == [("time", "1"), ("time", "1024")]
    wide = point(time=1.4e-3, **later)
    for t in wide["seconds"].values():
        t["low"] = 0.5 * t["median"]
    assert flagged(point(time=1e-3), wide) == []
    assert flagged(point(error=1e-3), point(error=1.05e-3, **later)) == []
    assert flagged(point(error=1e-3), point(error=1.2e-3, **later)) == [("error", "")]
    assert flagged(point(), point(time=9e-3, cpu="other", **later)) == []
    ratios = [c.ratio for c in analysis.changes([point(time=1e-3), point(time=2e-3, **later)])]
    assert ratios == [2.0, 2.0, 1.0]
    assert analysis.broken([point(), point(status="failed", **later)])[0][1:] == (("aaaaaaa", "bbbbbbb"), "failed")


# --- charts and pages ---


@pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="needs matplotlib")
def test_report_draws_everything(rows, tmp_path):
    from suite import charts, report

    later = {"date": "2026-01-02T00:00:00Z", "commit": "bbbbbbb", "run": "two"}
    rows = [*rows, point("top", dt=0.016, error=1e-2, time=2e-5, **later)]
    drawn = charts.work_precision(rows, CASES, ENGINES, tmp_path / "one", "slide")
    assert [f.suffix for f in drawn] == [".png", ".svg", ".csv"]
    lines = list(csv.DictReader(drawn[2].open()))
    measured = {analysis.key(r): r for r in rows if r["kind"] == "point" and r["case"] == "slide"}
    assert len(lines) == 2 * len(measured)
    for line in lines:
        row = measured[line["case"], line["engine"], line["variant"], line["dtype"], float(line["dt"])]
        assert float(line["error"]) == row["error"]["median"]
        assert float(line["seconds"]) == row["seconds"][line["batch"]]["median"]

    cases = {name: CASES[name] for name in ("top", "bounce")}  # slide is one that was removed
    written = report.write(rows, cases, ENGINES, tmp_path, [("a map", drawn[0])], corrupt=["line 7: not JSON"])
    assert all(f.is_file() and f.stat().st_size for f in written)
    names = {f.name for f in written}
    for name in ("overview_1024", "overview_1", "targets_1024", "features", "throughput", "compile_time",
                 "work_precision_top", "work_precision_bounce", "convergence_top"):  # fmt: skip
        assert {f"{name}.png", f"{name}.svg", f"{name}.csv"} <= names
    page = (tmp_path / "suite.html").read_text()
    assert not re.search(r"https?://", page.replace('xmlns="http://www.w3.org', ""))
    assert "line 7: not JSON" in page and "a map" in page and page.count("data:image/png;base64,") == 12
    text = (tmp_path / "suite.md").read_text()
    assert "1 of 2 fitted orders are within 0.2" in text
    assert re.search(r"Spinning top \| fast \| float32 \| 2 \| (1\.9|2\.0)\d \(\d\) \| yes", text)
    assert "| 4 | 2.00 (5) | **no** |" in text
    for part in ("Spinning top", "not installed", "no damping", "never", "bbbbbbb", "AMD EPYC", "line 7", "slide"):
        assert part in text and part in page, part
