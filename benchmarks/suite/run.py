"""Run a suite: one process a job, rows as they come, an interrupted run goes on where it stopped."""

from __future__ import annotations

import dataclasses
import datetime
import json
import os
import pathlib
import signal
import subprocess
import sys
import tempfile
import time

import common

from . import cases as all_cases, engines as all_engines, plan, store

ROWS = "suite.jsonl"
#: A job whose process dies is begun again so often, without the point it died of.
RESTARTS = 5


@dataclasses.dataclass(frozen=True)
class Choice:
    """What of a suite is run: names of cases and engines (all where empty), further folders of either."""

    suite: str = "standard"
    cases: tuple[str, ...] = ()
    engines: tuple[str, ...] = ()
    case_folders: tuple[str, ...] = ()
    engine_folders: tuple[str, ...] = ()


def chosen(choice: Choice):
    """(cases, engines) by name.

    Raises:
      ValueError: a name that is not known.
    """
    pick = lambda known, names, what: (
        known if not names else {n: known[n] if n in known else _unknown(what, n, known) for n in names}
    )
    if choice.suite not in plan.SUITES:
        _unknown("suite", choice.suite, plan.SUITES)
    found = all_cases.load(*choice.case_folders)
    rivals = all_engines.load(*choice.engine_folders)
    few = choice.cases or (plan.SMOKE if choice.suite == "smoke" else ())
    return pick(found, few, "case"), pick(rivals, choice.engines, "engine")


def _unknown(what, name, known):
    raise ValueError(f"unknown {what} '{name}'; known: {', '.join(known)}")


def unfinished(rows: list[dict], suite: str, machine: dict) -> str | None:
    """The last run of this suite on this machine, if it has not ended."""
    last = None
    for row in rows:
        if row["kind"] == "start" and row["suite"] == suite and all(row.get(k) == v for k, v in machine.items()):
            last = row["run"]
        if row["kind"] == "end" and row["run"] == last:
            last = None
    return last


def run(choice: Choice, out: pathlib.Path, fresh: bool = False, say=print) -> pathlib.Path:
    """Measure; the file of the rows.

    Raises:
      ValueError: an unknown name.
    """
    cases, engines = chosen(choice)
    rows_file = out / ROWS
    rows, corrupt = store.read(rows_file)
    for line in corrupt:
        say(f"skipped: {line}")
    same = common.environment()
    same.pop("xla_flags")
    machine = {k: same[k] for k in ("cpu", "cores", "platform")}
    name = None if fresh else unfinished(rows, choice.suite, machine)
    jobs = plan.jobs(choice.suite, cases, engines)
    part = name is not None and any(r["kind"] == "start" and r["run"] == name and r["jobs"] > len(jobs) for r in rows)
    if name is None:
        name = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%SZ")
        store.append(rows_file, {**same, "kind": "start", "run": name, "suite": choice.suite, "jobs": len(jobs)})
    else:
        say(f"going on with the run of {name}")
    same |= {"run": name, "suite": choice.suite}
    mine = [r for r in rows if r.get("run") == name]
    finished = {(r["case"], r["engine"]) for r in mine if r["kind"] == "job"}
    absent = {}
    for engine in engines.values():
        reason = engine.missing()
        if reason:
            absent[engine.name] = reason
            say(f"{engine.title} is left out: {reason}; to install it: {engine.install}")
            if not any(r["kind"] == "missing" and r["engine"] == engine.name for r in mine):
                gone = {"kind": "missing", "engine": engine.name, "reason": reason, "install": engine.install}
                store.append(rows_file, {**same, **gone})
    begin = time.perf_counter()
    for k, job in enumerate(jobs, 1):
        if job.engine in absent or (job.case, job.engine) in finished:
            continue
        say(f"[{k}/{len(jobs)}, {time.perf_counter() - begin:.0f} s] {job.case} in {engines[job.engine].title}")
        _job(job, choice, rows_file, same | {"engine_version": engines[job.engine].version()}, say)
    if part:
        say(f"a part of the run of {name}; the rest is measured without naming cases and engines")
    else:
        store.append(rows_file, {**same, "kind": "end"})
    return rows_file


def _job(job, choice, rows_file, same, say) -> None:
    begin = time.perf_counter()
    status, reason = "crashed", ""
    for _ in range(RESTARTS):
        rows, _ = store.read(rows_file)
        mine = [r for r in rows if r.get("run") == same["run"] and r.get("case") == job.case]
        mine = [r for r in mine if r.get("engine") == job.engine and r["kind"] in ("point", "refused", "limit")]
        done = [(r["variant"], r["dtype"], r.get("dt")) for r in mine]
        left = job.limit_s - (time.perf_counter() - begin)
        code, point = _process(job, choice, rows_file, same, done, left)
        if code == 0:
            status = "done"
            break
        reason = "time limit" if code is None else f"its process ended with {_words(code)}"
        if point is not None:
            variant, dtype, dt = point
            row = {
                "kind": dt if dt == "limit" else "point", "case": job.case, "engine": job.engine, "variant": variant,
                "dtype": dtype, "dt": dt, "status": "skipped" if code is None else "failed", "reason": reason,
                "error": None, "self_error": None, "seconds": {}, "compile_s": {},
            }  # fmt: skip
            store.append(rows_file, {**same, **row})
        say(f"{job.case} in {job.engine}: {reason}")
        if code is None:
            status = "time limit"
            break
    store.append(rows_file, {**same, "kind": "job", "case": job.case, "engine": job.engine, "status": status,
                             "reason": reason, "seconds": time.perf_counter() - begin})  # fmt: skip


def _words(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"code {code}"


def _process(job, choice, rows_file, same, done, limit_s):
    """(exit code or None past the limit, point it was at or None)."""
    folder = pathlib.Path(__file__).parent
    with tempfile.TemporaryDirectory() as scratch:
        marker, task = pathlib.Path(scratch) / "current", pathlib.Path(scratch) / "job"
        task.write_text(
            json.dumps(
                {
                    "job": dataclasses.asdict(job), "rows": str(rows_file.resolve()), "same": same, "done": done,
                    "current": str(marker), "cases": list(choice.case_folders), "engines": list(choice.engine_folders),
                }
            )
        )  # fmt: skip
        paths = [str(folder.parent), str(folder.parents[1]), os.environ.get("PYTHONPATH", "")]
        env = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in paths if p)}
        process = subprocess.Popen([sys.executable, "-m", "suite.measure", str(task)], env=env, start_new_session=True)
        try:
            code = process.wait(timeout=max(limit_s, 1.0))
        except subprocess.TimeoutExpired:
            code = None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        point = json.loads(marker.read_text()) if code != 0 and marker.exists() else None
    return code, point
