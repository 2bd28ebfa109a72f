"""The gradient contract as a page: runs the tests that check it and writes what they found, docs/gradients.md.

    PYTHONPATH=. python benchmarks/gradient_contract.py                     (25 minutes on 2 cores)
    PYTHONPATH=. python benchmarks/gradient_contract.py --junit FILE        (from reports of runs there were)

Nothing in the tables is typed here: a test records a row with the fixture ``contract`` when it has found its figures,
and a row whose test fails afterwards says so.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
from common import number, step_text  # noqa: E402

ROOT = pathlib.Path(__file__).parent.parent
TESTS = ("tests/test_gradient_contract.py", "tests/test_gradients.py", "tests/test_large_worlds.py")

#: What a page of several reports says of itself.
LATER = ", of a test the last; the machine and the commit above are those of the page, not of every row"


def run_tests(report: pathlib.Path, quick: bool) -> int:
    """Exit status of pytest, whose report with the recorded rows is left at ``report``."""
    only = ["-k", "flight or refuses"] if quick else ["-n", "2", "-m", ""]
    call = [sys.executable, "-m", "pytest", "-q", *TESTS, *only, f"--junitxml={report}"]
    return subprocess.run(call, cwd=ROOT, check=False).returncode


def recorded(reports) -> dict[str, list[dict]]:
    """Section -> rows, each with whether its test passed; of a test in several reports the last."""
    tests: dict[str, list[tuple[str, dict]]] = {}
    for report in reports:
        for case in ET.parse(report).iter("testcase"):
            name = f"{case.get('classname')}::{case.get('name')}"
            passed = not any(case.find(tag) is not None for tag in ("failure", "error"))
            tests[name] = [
                (item.get("name"), json.loads(item.get("value")) | {"passed": passed}) for item in case.iter("property")
            ]
    sections: dict[str, list[dict]] = {}
    for section, row in (pair for rows in tests.values() for pair in rows):
        sections.setdefault(section, []).append(row)
    return sections


def verdict(row: dict) -> str:
    return "passed" if row["passed"] else "**FAILED**"


def closed(rows) -> str:
    lines = []
    for r in rows:
        errors = ", ".join(f"{number(e, 2)} ({step_text(dt)})" for e, dt in zip(r["errors"], r["steps"]))
        lines.append([r["event"], r["derivatives"], r["formula"], errors, number(r["bar"], 2), verdict(r)])
    return common.table(["event", "derivatives", "closed form", "largest error, relative", "bar", "test"], lines)


def leaves(rows) -> str:
    heads = ["pairs", "preset", "reverse against central differences", "forward against reverse", "test"]
    lines = [[r["pairs"], f'`"{r["preset"]}"`', number(r["error"], 2), number(r["modes"], 2), verdict(r)] for r in rows]
    return common.table(heads, lines)


def page(sections: dict[str, list[dict]], env: dict, reports: int) -> str:
    get = lambda name: sections.get(name, [])
    of_leaves = get("leaves")
    every = sorted({leaf for r in of_leaves for leaf in r["leaves"]})
    finite = sorted({place for r in get("finite") for place in r["where"]})
    second = common.table(
        ["pairs", "preset", "Hessian-vector product against differences of the gradient", "test"],
        [[r["pairs"], f'`"{r["preset"]}"`', number(r["error"], 2), verdict(r)] for r in get("second")],
    )
    integrators = common.table(
        ["integrator", "first order", "second order", "test"],
        [
            [f'`"{r["integrator"]}"`', number(r["first"], 2), number(r["second"], 2), verdict(r)]
            for r in get("integrators")
        ],
    )
    none = common.table(
        ["where", "why", "what is returned there, and what was found", "test"],
        [[r["event"], r["why"], r["found"], verdict(r)] for r in get("none")],
    )
    source = f"{reports} report(s) of " + ", ".join(f"`{t}`" for t in TESTS) + (LATER if reports > 1 else "")
    return f"""# The gradient contract

What `jax.grad`, `jax.jvp` and `jax.hessian` of `rbd.step` and `rbd.rollout` return, as the tests found it. Float64.
{common.header(env)}
Made by `benchmarks/gradient_contract.py` from {source}.

Two promises:

* (a) **Every preset and method**: derivatives are those of its own discrete map, and finite.
* (b) **`"gradient"`**, and any method with events: derivatives are those of the physics, wherever the physics has one.

## Events: against closed forms

Preset `"gradient"`. Errors are relative to the largest entry of a row of the Jacobian. Events that are found at their
own instant are exact at any step; sliding is a process in time, whose derivative converges with the step.

{closed(get("closed"))}

## Shape pairs and leaves: against the discrete map

A loss of the whole final state after four steps in contact. Reverse mode along one direction of every leaf against
central differences: {", ".join(f"`{name}`" for name in every)}. Forward mode along all of them at once.

{leaves(of_leaves)}

Finite in the same programs at: {"; ".join(finite)}. Lost worlds, inactive contacts and padded slots:
`tests/test_rollout_gradients.py`, `tests/test_large_worlds.py`.

### Second order, in contact

{second}

### Integrators, a tumbling box

{integrators}

## Where there is no derivative

{none}

* **A lost world** (status `NOT_FINITE`) is held at its last state: its derivative by that state is the identity, by
  everything else zero (`tests/test_rollout_gradients.py`).
* **Contact appears or ends at rest without an impact** (a corner that lifts off): the derivative is that of the set of
  contacts at the state given; it may jump at the switch.
* **`rollout(truncate=n)`** returns the derivative of the last steps alone, by intent.
* **Smoothing "backward"**: first derivatives are those of the smoothed law at the values of the law as it is; second
  derivatives are those of that rule.
* **Third derivatives** inside loops are not right: a solver's rule is kept to second order (`rbd_jax/implicit.py`).
* Without events a bounce falls on the end of a step: promise (a) holds, and the derivative by the instant is lost.
"""


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--junit", type=pathlib.Path, action="append", help="report of a run with --junitxml, instead of running"
    )
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "docs" / "gradients.md")
    parser.add_argument("--quick", action="store_true", help="one case only")
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as place:
        reports = args.junit or [pathlib.Path(place) / "report.xml"]
        status = 0 if args.junit else run_tests(reports[0], args.quick)
        if not all(report.exists() for report in reports):
            print("pytest wrote no report", file=sys.stderr)
            return status or 1
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(page(recorded(reports), common.environment(), len(reports)), encoding="utf-8")
    print(f"wrote {args.out}")
    return status


if __name__ == "__main__":
    sys.exit(main())
