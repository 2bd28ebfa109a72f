"""Measure one case in one engine: errors of a sweep of steps first, then the time of each; a row a point.

Run by ``run`` in a process of its own, so that a peer that crashes or hangs costs its own rows only.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import pathlib
import sys
import time

import numpy as np

if __package__ in (None, ""):
    sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))
    __package__ = "suite"

from . import cases, engines, store
from .case import Case, Motion
from .engine import Engine, Refused
from .plan import Job

#: Own limit of an engine: its run at the finest step over this.
FINER = 4
#: In the place of a step: the run at that one.
LIMIT = "limit"
#: An error from here on is no solution.
LOST = 1e3
REPEATS = 4
#: The first timed call takes no longer [s], if that leaves it a step.
LONG = 1.0
TOO_SLOW = "an error run would take more than {:g} s"


def spread(values) -> dict:
    """Median and the band of 80 %; a world that is lost counts as infinite, which is written as null."""
    values = np.where(np.isfinite(values) & (values < LOST), values, np.inf)
    low, middle, high = np.percentile(values, (10, 50, 90), method="nearest")
    failed = int(np.isinf(values).sum())
    return {"median": middle, "p10": low, "p90": high, "worlds": len(values), "failed_worlds": failed}


class TooSlow(Exception):
    """An error run would take longer than it may."""


@functools.lru_cache(maxsize=2)
def truth_of(case: Case) -> Motion | None:
    """Of all its worlds; some take a minute."""
    return case.truth(case.start()) if case.truth else None


class Sweep:
    """One variant of an engine over the steps of a case."""

    def __init__(self, case: Case, engine: Engine, variant: str, dtype: str, job: Job):
        self.case, self.engine, self.variant, self.dtype, self.job = case, engine, variant, dtype, job
        self.worlds = min(case.worlds, engine.most(case))
        self.any_worlds = engine.any_number or not engine.scales
        self.cost = None  # seconds of a world and step, as last seen
        self.costs = {}  # the same of every step

    def load(self, dt, dtype=None):
        return self.engine.load(self.case, self.variant, dt, dtype or self.dtype)

    def affordable(self, dt) -> bool:
        """Whether an error run fits the time; an engine without programs may take fewer worlds."""
        if self.cost is None:
            return True
        steps = self.case.steps_a_sample(dt) * self.case.samples
        if self.any_worlds:
            self.worlds = max(min(self.worlds, int(self.job.error_s / (self.cost * steps))), 1)
        return self.cost * steps * self.worlds <= self.job.error_s

    def run(self, dt, dtype=None) -> Motion:
        case, steps = self.case, self.case.steps_a_sample(dt)
        simulation = self.load(dt, dtype)
        all_worlds = case.start()
        if self.cost is None or self.engine.compiles:
            few = all_worlds.worlds(min(self.worlds, os.cpu_count() or 1) if self.any_worlds else self.worlds)
            simulation.motion(few, 1, steps)  # another step may be another program
        if self.cost is None:
            begin = time.perf_counter()
            simulation.motion(few, 1, steps)
            self.cost = (time.perf_counter() - begin) / (few.pos.shape[1] * steps)
            if not self.affordable(dt):
                raise TooSlow
        start = all_worlds.worlds(self.worlds)
        begin = time.perf_counter()
        motion = simulation.motion(start, case.samples, steps)
        self.cost = (time.perf_counter() - begin) / (self.worlds * case.samples * steps)
        self.costs[dt] = self.cost
        simulation.close()
        check_start(motion, start, dtype or self.dtype)
        return motion

    def error(self, motion: Motion) -> dict:
        truth = truth_of(self.case)
        truth = truth and truth.worlds(motion.pos.shape[1])
        with np.errstate(all="ignore"):
            return spread(np.where(motion.finite, self.case.error(motion, truth, self.case), np.inf))

    def self_error(self, motion: Motion, limit: Motion) -> dict:
        both = min(motion.pos.shape[1], limit.pos.shape[1])
        motion, limit = motion.worlds(both), limit.worlds(both)
        with np.errstate(all="ignore"):
            return spread(np.where(motion.finite & limit.finite, self.case.distance(motion, limit, self.case), np.inf))

    def seconds(self, dt, batch: int, middle: Motion | None) -> tuple[dict, float | None]:
        """Wall seconds per simulated second and world: of the whole case, or from its middle where that is long."""
        case, simulation, cost = self.case, self.load(dt), self.costs.get(dt, self.cost)
        try:
            whole = case.steps_a_sample(dt) * case.samples
            few = min(whole, 64)
            if self.engine.any_number:
                if batch > 1:
                    batch = max(2 * (os.cpu_count() or 1), min(batch, int(self.job.time_s / (cost * few))))
            longest = self.job.time_s if self.engine.any_number else LONG
            few = max(min(few, int(longest / (cost * batch))), 1)
            start = case.start(min(batch, case.worlds)).worlds(batch)
            begin = time.perf_counter()
            call, worlds, steps = simulation.timer(start, few)
            call()
            cold = time.perf_counter() - begin
            begin = time.perf_counter()
            call()
            step = (time.perf_counter() - begin) / steps
            count = max(min(whole, int(self.job.time_s / step)), steps)
            part = count < whole and middle is not None
            if part:
                start = middle.worlds(batch)
            if part or count != steps:
                call, worlds, steps = simulation.timer(start, count)
                call()
            times = []
            for _ in range(REPEATS if step * steps < 1.0 else 2):
                begin = time.perf_counter()
                call()
                times.append(time.perf_counter() - begin)
        finally:
            simulation.close()
        cores = 1 if self.engine.scales or batch == 1 else os.cpu_count() or 1
        low, median, high = np.percentile(times, (25, 50, 75)) / (worlds * steps * dt * cores)
        row = {"median": median, "low": low, "high": high, "worlds": worlds, "steps": steps, "cold_s": cold}
        return row, getattr(simulation, "compile_s", {}).get(worlds)


def check_start(motion: Motion, start: Motion, dtype: str) -> None:
    """The first sample is the start: what is not so shifts every curve."""
    tolerance = 1e-9 if dtype == "float64" else 2e-5
    for name in ("pos", "quat", "vel", "omega"):
        seen, given = getattr(motion, name)[0], getattr(start, name)[0]
        if name == "quat":
            given = given * np.sign((seen * given).sum(-1, keepdims=True))
        off = np.abs(seen - given).max()
        if not off <= tolerance * max(1.0, np.abs(given).max()):
            raise AssertionError(f"the first sample of {name} is off by {off:.2g}: it is not the start state")


def measure(job: Job, case: Case, engine: Engine, done: set, write, current) -> None:
    """All points of a job that are not in ``done``; ``write(row)`` each, ``current(point)`` before what may hang."""
    for variant, dtype in job.variants:
        same = {"kind": "point", "case": case.name, "engine": engine.name, "variant": variant, "dtype": dtype}
        if all((variant, dtype, dt) in done for dt in job.steps) or (variant, dtype, None) in done:
            continue
        sweep, motions, reasons = Sweep(case, engine, variant, dtype, job), {}, {}
        try:
            for dt in job.steps:
                if (variant, dtype, dt) in done:
                    continue
                if not sweep.affordable(dt):
                    reasons[dt] = "skipped", TOO_SLOW.format(job.error_s)
                    continue
                current((variant, dtype, dt))
                try:
                    motions[dt] = sweep.run(dt)
                except Refused:
                    raise
                except TooSlow:
                    reasons[dt] = "skipped", TOO_SLOW.format(job.error_s)
                except Exception as error:  # a peer's own
                    reasons[dt] = "failed", f"{type(error).__name__}: {str(error).splitlines()[0][:150]}"
        except Refused as refusal:
            write({**same, "kind": "refused", "reason": str(refusal)})
            continue
        limit = None
        if case.distance is not None and motions:
            limit = motions[min(motions)]
            fine = min(motions) / FINER
            wanted = variant in job.both and (variant, dtype, LIMIT) not in done
            if wanted and sweep.affordable(fine):
                current((variant, dtype, LIMIT))
                with contextlib.suppress(Exception):  # else the finest step is the limit
                    limit = sweep.run(fine, engine.widths[-1])  # without the rounding of the narrower one
        for dt in job.steps:
            if (variant, dtype, dt) in done:
                continue
            row = {**same, "dt": dt, "status": "ok", "reason": "", "error": None, "self_error": None, "seconds": {},
                   "compile_s": {}}  # fmt: skip
            if dt in reasons:
                row["status"], row["reason"] = reasons[dt]
                write(row)
                continue
            motion = motions[dt]
            row["error"] = sweep.error(motion)
            if limit is not None and limit is not motion:
                row["self_error"] = sweep.self_error(motion, limit)
            if row["error"]["failed_worlds"] > row["error"]["worlds"] / 2:
                row["status"], row["reason"] = "failed", "more than half of the worlds diverged or left the scene"
            current((variant, dtype, dt))
            good = motion.finite.all()
            middle = None
            if good:
                k = (len(motion.time) - 1) // 2
                middle = Motion(*(getattr(motion, f)[k : k + 1] for f in ("time", "pos", "quat", "vel", "omega")))
            for batch in job.batches if variant in job.both else job.batches[-1:]:
                try:
                    row["seconds"][str(batch)], compiled = sweep.seconds(dt, batch, middle)
                except Exception as error:
                    row["reason"] = f"timing {batch}: {type(error).__name__}: {str(error).splitlines()[0][:150]}"
                    continue
                if compiled is not None:
                    row["compile_s"][str(batch)] = compiled
            write(row)


def told(row: dict) -> str:
    """A row in one line."""
    head = f"{row['case']:10s} {row['engine']:7s} {row['variant']:16s}"
    if row["kind"] == "refused":
        return f"{head} cannot: {row['reason']}"
    error = row["error"]["median"] if row["error"] else None
    text = f"{head} {row['dtype'][-2:]} {1e3 * row['dt']:7.3g} ms  error {'-' if error is None else f'{error:.2e}':>8s}"
    for batch, s in row["seconds"].items():
        text += f"  {batch}: {1e6 * s['median']:9.3g} us"
    return text + (f"  {row['status']}: {row['reason']}" if row["reason"] else "")


def main(argv) -> int:
    """``measure.py FILE``: the job, the place of the rows, what every row carries and what is there already."""
    told_us = json.loads(pathlib.Path(argv[0]).read_text())
    job = told_us["job"]
    job = Job(**{**job, "variants": tuple(map(tuple, job["variants"])), "steps": tuple(job["steps"])})
    case = cases.load(*told_us["cases"])[job.case]
    engine = engines.load(*told_us["engines"])[job.engine]
    out, marker = pathlib.Path(told_us["rows"]), pathlib.Path(told_us["current"])
    done = {(v, d, t) for v, d, t in told_us["done"]}

    def write(row):
        store.append(out, {**told_us["same"], **row})
        print(told(row), flush=True)

    measure(job, case, engine, done, write, lambda point: marker.write_text(json.dumps(point)))
    marker.unlink(missing_ok=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
