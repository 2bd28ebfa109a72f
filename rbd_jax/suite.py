"""Layer 9: the benchmark suite of the source tree, for the commands ``bench --suite`` and ``chart``.

The suite lives in ``benchmarks/`` and is no part of an installed package.
"""

from __future__ import annotations

import importlib
import pathlib
import sys


def folder() -> pathlib.Path:
    """``benchmarks/`` of the source tree this package lies in, or of the current folder.

    Raises:
      ValueError: neither has one.
    """
    for place in (pathlib.Path(__file__).parents[1], pathlib.Path.cwd()):
        if (place / "benchmarks" / "suite" / "__init__.py").exists():
            return place / "benchmarks"
    raise ValueError(
        "the benchmark suite is part of the source tree, not of the installed package: run this from a clone of it"
    )


def module(name: str):
    """A module of the suite: ``module("run")``."""
    place = str(folder())
    if place not in sys.path:
        sys.path.insert(0, place)
    return importlib.import_module(f"suite.{name}")


def bench(suite: str, cases=(), engines=(), case_folders=(), engine_folders=(), out=None, fresh=False, say=print):
    """Measure and append rows; the file of the rows.

    Args:
      suite: "smoke", "standard" or "full". cases, engines: names; empty: all. case_folders, engine_folders: more of
        either, a file each. out: folder, default ``benchmarks/results``. fresh: begin a new run even where the last
        one was interrupted.

    Raises:
      ValueError: an unknown name; no suite here.
    """
    run = module("run")
    choice = run.Choice(suite, tuple(cases), tuple(engines), tuple(case_folders), tuple(engine_folders))
    return run.run(choice, pathlib.Path(out) if out else folder() / "results", fresh, say)


def chart(out=None, run=None, case_folders=(), engine_folders=()) -> list[pathlib.Path]:
    """Draw the charts and write the report of the rows in ``out``; the files.

    Args:
      out: folder of suite.jsonl, default ``benchmarks/results``. run: only the rows of this run.

    Raises:
      ValueError: no rows; an unknown run; no suite here.
    """
    place = pathlib.Path(out) if out else folder() / "results"
    store = module("store")
    rows, corrupt = store.read(place / module("run").ROWS)
    if not any(row["kind"] == "point" for row in rows):
        raise ValueError(
            f"no rows in '{place / module('run').ROWS}': measure first, with 'rbd-jax bench --suite standard'"
        )
    runs = sorted({row["run"] for row in rows if row["kind"] == "start"})
    if run is not None and run not in runs:
        raise ValueError(f"unknown run '{run}'; known: {', '.join(runs)}")
    others = [(path.stem.replace("_", " "), path) for path in sorted(place.glob("stability_map_*.png"))]
    others += [(path.stem.replace("_", " "), path) for path in sorted(place.glob("gradient_*.png"))]
    cases = module("cases").load(*case_folders)
    engines = module("engines").load(*engine_folders)
    return module("report").write(
        rows, cases, engines, place, extra=others, corrupt=corrupt, runs=None if run is None else [run]
    )
