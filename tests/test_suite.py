"""The suite of speed against accuracy: its truths, its rows, its adapters by known facts, and how it is added to."""

import dataclasses
import json
import pathlib
import sys
import textwrap

import numpy as np
import pytest

BENCHMARKS = pathlib.Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

from suite import (  # noqa: E402
    cases as all_cases,  # noqa: E402
    engines as all_engines,  # noqa: E402
    judge,
    measure,
    plan,
    run,
    store,
)
from suite.case import Motion  # noqa: E402

from rbd_jax.cli import main as cli  # noqa: E402

CASES, ENGINES = all_cases.load(), all_engines.load()
TRUE = [name for name, case in CASES.items() if case.truth]


# --- truths ---


@pytest.mark.parametrize("name", TRUE)
def test_the_truth_begins_with_the_start(name):
    case = CASES[name]
    start = case.start(3)
    truth = case.truth(start)
    assert len(truth.time) == case.samples + 1 and truth.time[-1] == pytest.approx(case.seconds)
    for field in ("pos", "quat", "vel", "omega"):
        np.testing.assert_allclose(getattr(truth, field)[0], getattr(start, field)[0], atol=1e-12)
    assert (case.error(truth, truth, case) == 0).all() and truth.finite.all()


@pytest.mark.parametrize("name", ["parabola", "top", "gyro", "symmetric", "elastic", "spheres", "edge"])
def test_the_truth_keeps_its_energy(name):
    case = CASES[name]
    e = judge.energy(case.truth(case.start(4)), case)
    np.testing.assert_allclose(e, np.broadcast_to(e[0], e.shape), rtol=1e-9)


def test_the_symmetric_top_by_a_second_method():
    from suite.cases.free import sample_times, tumbling

    case = CASES["symmetric"]
    start = case.start(4)
    other = tumbling(start, case.parts[0].inertia, sample_times(case.seconds, case.samples))
    truth = case.truth(start)
    assert judge.attitude(truth, other, case).max() < 1e-9
    np.testing.assert_allclose(truth.omega, other.omega, atol=1e-8)


def test_the_oblique_impact_keeps_what_it_must():
    case = CASES["oblique"]
    truth = case.truth(case.start(64))
    assert (np.diff(judge.energy(truth, case), axis=0) < 1e-9).all()
    arm = np.array([0, 0, -0.1])
    about = np.cross(arm, truth.vel) * case.parts[0].mass - np.array(case.parts[0].inertia) * truth.omega
    np.testing.assert_allclose(about[-1, ..., :2], about[0, ..., :2], atol=1e-12)  # friction acts at the contact
    slip = truth.vel[-1] + np.cross(truth.omega[-1], arm)
    sticks = np.linalg.norm(slip[..., :2], axis=-1) < 1e-9
    assert 0 < sticks.mean() < 1


# --- rows ---


def test_rest_forces_by_the_balance_of_momentum():
    """At rest all is carried; where the top one of 4, 2 and 1 kg speeds up by g, 8/7, 4/3 and 2 of the weights are."""
    case = CASES["forces"]
    at_rest = case.start(2)
    time = np.linspace(0.0, 1.0, 51)
    motion = Motion(time, *(np.repeat(getattr(at_rest, k), 51, axis=0) for k in ("pos", "quat", "vel", "omega")))
    assert case.error(motion, None, case) == pytest.approx([0.0, 0.0])
    motion.vel[:, 1, 2, 2] = 9.81 * time
    assert case.error(motion, None, case) == pytest.approx([0.0, np.sqrt((1 / 49 + 1 / 9 + 1) / 3)])


def test_a_corrupt_row_is_named_and_skipped(tmp_path):
    path = tmp_path / "suite.jsonl"
    store.append(path, {"kind": "start", "run": "a", "suite": "smoke"})
    with path.open("a") as file:
        file.write('{"kind": "point", "run": "a"}\nnonsense\n{"kind": "point", "cut sh')
    store.append(path, {"kind": "end", "run": "a"})
    rows, corrupt = store.read(path)
    assert [r["kind"] for r in rows] == ["start", "end"]
    assert len(corrupt) == 3 and "line 2" in corrupt[0] and "'case'" in corrupt[0] and "line 4" in corrupt[2]


@pytest.mark.parametrize(
    "arguments, word",
    [
        (["--suite", "tiny"], "unknown suite 'tiny'; known: smoke"),
        (["--suite", "smoke", "--cases", "moon"], "unknown case 'moon'; known:"),
        (["--suite", "smoke", "--engines", "chrono"], "unknown engine 'chrono'; known:"),
        (["--suite", "smoke", "--add-cases", "/nowhere"], "no such folder: '/nowhere'"),
        ([], "give either SCENE or --suite"),
        (["box_stack", "--suite", "smoke"], "give either SCENE or --suite"),
    ],
)
def test_bad_requests_are_told(arguments, word, capsys, tmp_path):
    assert cli(["bench", *arguments, "--results", str(tmp_path)]) == 2
    assert word in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_no_rows_no_chart(capsys, tmp_path):
    assert cli(["chart", "--results", str(tmp_path)]) == 2
    assert "no rows in" in capsys.readouterr().err


# --- the command, and one file more for a case or an engine ---

TOY_CASE = """
    import numpy as np
    from suite.case import Case, Motion, sphere
    from suite.judge import position

    def starts(n, rng):
        quat = np.broadcast_to([1.0, 0, 0, 0], (n, 1, 4))
        return rng.normal(size=(n, 1, 3)), quat, rng.normal(size=(n, 1, 3)), np.zeros((n, 1, 3))

    def truth(start):
        t = np.linspace(0, 1, 3)[:, None, None, None]
        same = lambda a: np.broadcast_to(a, (3, *a.shape[1:]))
        return Motion(t.ravel(), start.pos + start.vel * t, *map(same, (start.quat, start.vel, start.omega)))

    CASES = [Case("drift", "drift", "free", (sphere(0.1),), (), None, None, (0.0, 0.0, 0.0), starts, 1.0, 2, truth,
                  "closed form", 0.0, position, "m", position, (0.1, 0.05), frozenset(), worlds=2)]
"""
TOY_ENGINE = """
    import os, pathlib, time
    import numpy as np
    from suite.case import Motion
    from suite.engine import Engine, Refused, Simulation

    class Toy(Engine):
        name, title, colour = "toy", "Toy", "#123456"
        variants = {"good": "", "refuses": "", "dies": "", "raises": "", "hangs": ""}

        def load(self, case, variant, dt, dtype):
            if variant == "refuses":
                raise Refused("has no drift")
            return Run(variant, dt)

    class Run(Simulation):
        def __init__(self, variant, dt):
            self.variant, self.dt = variant, dt

        def motion(self, start, samples, steps):
            if self.dt < 0.07:
                {"dies": os.abort, "raises": lambda: 1 / 0, "hangs": lambda: time.sleep(60)}.get(self.variant, int)()
            t = self.dt * steps * np.arange(samples + 1)
            pos = start.pos + (1 + self.dt) * start.vel * t[:, None, None, None]
            same = lambda a: np.broadcast_to(a, (samples + 1, *a.shape[1:]))
            return Motion(t, pos, *map(same, (start.quat, start.vel, start.omega)))

        def timer(self, start, steps):
            return (lambda: None), start.pos.shape[1], steps

    ENGINE = Toy()
"""


@pytest.fixture
def toys(tmp_path, monkeypatch):
    for name, text in (("cases", TOY_CASE), ("engines", TOY_ENGINE)):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"toy_{name}.py").write_text(textwrap.dedent(text))

    def job(case, engine):
        variants = tuple((v, "float64") for v in engine.variants)
        return plan.Job(case.name, engine.name, variants, case.steps, tuple(engine.variants), (1, 4), limit_s=25.0)

    monkeypatch.setitem(plan.SUITES, "smoke", job)
    yield run.Choice("smoke", ("drift",), ("toy",), (str(tmp_path / "cases"),), (str(tmp_path / "engines"),))
    for module in [m for m in sys.modules if m.endswith((".toy_cases", ".toy_engines"))]:
        del sys.modules[module]


def test_a_case_and_an_engine_by_one_file_each(toys, tmp_path):
    """And one that crashes, raises or hangs costs its own points only."""
    said = []
    rows, corrupt = store.read(run.run(toys, tmp_path / "out", say=said.append))
    points = {(r["variant"], r["dt"]): r for r in rows if r["kind"] == "point"}
    assert not corrupt and {r["kind"] for r in rows} == {"start", "point", "limit", "refused", "job", "end"}
    good = points["good", 0.1]
    assert good["status"] == "ok" and set(good["seconds"]) == {"1", "4"} and good["self_error"]["median"] > 0
    assert good["error"]["median"] / points["good", 0.05]["error"]["median"] == pytest.approx(2, rel=1e-6)
    assert points["dies", 0.05]["status"] == "failed" and "SIGABRT" in points["dies", 0.05]["reason"]
    assert points["dies", 0.1]["status"] == "ok"
    assert points["raises", 0.05]["status"] == "failed" and "ZeroDivisionError" in points["raises", 0.05]["reason"]
    assert points["hangs", 0.05]["reason"] == "time limit"
    assert next(r for r in rows if r["kind"] == "refused")["reason"] == "has no drift"
    assert next(r for r in rows if r["kind"] == "job")["status"] == "time limit"


def test_a_batch_that_takes_long_is_timed_with_fewer_steps_not_worlds(toys):
    case = all_cases.load(*toys.case_folders)["drift"]
    engine = all_engines.load(*toys.engine_folders)["toy"]
    sweep = measure.Sweep(case, engine, "good", "float64", plan.SUITES["smoke"](case, engine))
    assert sweep.worlds == 2
    for cost in (1e-6, 0.1, 10.0):  # seconds of a world and step
        sweep.cost = cost
        assert sweep.seconds(0.1, 4, None)[0]["worlds"] == 4


def test_an_interrupted_run_goes_on(toys, tmp_path, monkeypatch):
    short = lambda case, engine: plan.Job(case.name, engine.name, (("good", "float64"),), case.steps, ("good",), (1,))
    monkeypatch.setitem(plan.SUITES, "smoke", short)
    path = run.run(toys, tmp_path / "out", say=lambda _: None)
    lines = path.read_text().splitlines()
    kinds = [json.loads(line)["kind"] for line in lines]
    assert kinds == ["start", "point", "point", "job", "end"]
    path.write_text("\n".join(lines[:2]) + "\n" + lines[2][: len(lines[2]) // 2])  # cut in the middle of a row
    run.run(toys, tmp_path / "out", say=lambda _: None)
    rows, corrupt = store.read(path)
    assert len(corrupt) == 1 and [r["kind"] for r in rows] == ["start", "point", "point", "job", "end"]
    assert len({r["run"] for r in rows}) == 1 and len({store.key(r) for r in rows if r["kind"] == "point"}) == 2
    run.run(toys, tmp_path / "out", say=lambda _: None)
    assert len({r["run"] for r in store.read(path)[0]}) == 2  # the one before was complete


def test_a_part_of_a_run_does_not_end_it(toys, tmp_path, monkeypatch):
    """Named cases of a run that was interrupted are measured as a part of it, and the rest goes on afterwards."""
    short = lambda case, engine: plan.Job(case.name, engine.name, (("good", "float64"),), case.steps, ("good",), (1,))
    monkeypatch.setitem(plan.SUITES, "smoke", short)
    path = run.run(toys, tmp_path / "out", say=lambda _: None)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    start = {**lines[0], "jobs": 2}  # as if two cases had been asked for
    path.write_text(json.dumps(start) + "\n")
    run.run(toys, tmp_path / "out", say=lambda _: None)
    rows, _ = store.read(path)
    assert [r["kind"] for r in rows] == ["start", "point", "point", "job"] and len({r["run"] for r in rows}) == 1


def test_smoke_and_chart(tmp_path, capfd):
    out = ["--results", str(tmp_path)]
    assert cli(["bench", "--suite", "smoke", "--cases", "parabola", "--engines", "ours,mujoco,warp", *out]) == 0
    said = capfd.readouterr().out
    assert "MuJoCo Warp is left out" in said and "pip install mujoco-warp" in said
    rows = [r for r in store.read(tmp_path / "suite.jsonl")[0] if r["kind"] == "point"]
    assert {(r["engine"], r["status"]) for r in rows} == {("ours", "ok"), ("mujoco", "ok")}
    assert all(r["seconds"]["1"]["median"] > 0 and r["versions"] and r["commit"] and r["date"] for r in rows)
    assert cli(["chart", *out]) == 0
    assert (tmp_path / "suite.html").stat().st_size > 10_000 and "parabola" in (tmp_path / "suite.md").read_text()


# --- adapters, by what is known of each engine ---


def motion(engine, variant, case, dt, samples=None, seconds=None, worlds=2):
    case = dataclasses.replace(case, samples=samples or case.samples, seconds=seconds or case.seconds, steps=(dt,))
    simulation = ENGINES[engine].load(case, variant, dt, ENGINES[engine].widths[-1])
    try:
        return case, simulation.motion(case.start(worlds), case.samples, case.steps_a_sample(dt))
    finally:
        simulation.close()


@pytest.mark.parametrize("variant, order", [("euler", 1), ("rk4", 4)])
def test_mujoco_order_in_attitude(variant, order):
    errors = []
    for dt in (1 / 100, 1 / 200):
        case, seen = motion("mujoco", variant, CASES["top"], dt)
        errors.append(np.median(case.error(seen, case.truth(case.start(2)), case)))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)


def test_mujoco_gains_energy_on_a_spinning_box():
    box = CASES["top"]
    arrays = lambda n, rng: (np.zeros((n, 1, 3)), np.array([[[1.0, 0, 0, 0]]] * n), np.zeros((n, 1, 3)),
                             np.array([[[1.0, 2.0, 3.0]]] * n))  # fmt: skip
    case, seen = motion("mujoco", "euler", dataclasses.replace(box, starts=arrays), 0.01, samples=1, seconds=5.0)
    e = judge.energy(seen, case)[:, 0]
    assert e[-1] / e[0] == pytest.approx(1.087, abs=2e-3)


def test_mujoco_default_contact_bounces():
    soft = dataclasses.replace(CASES["elastic"], restitution=None)
    _, seen = motion("mujoco", "euler", soft, 1 / 5000, samples=5000, seconds=1.0)
    v = seen.vel[:, :, 0, 2]
    np.testing.assert_allclose(-v.max(0) / v.min(0), np.exp(-2), atol=0.015)


def test_mujoco_bounces_as_told():
    case, seen = motion("mujoco", "rigid", CASES["bounce"], 1 / 5000, samples=5000, seconds=1.0)
    v = seen.vel[:, :, 0, 2]
    np.testing.assert_allclose(-v.max(0) / v.min(0), 0.8, atol=0.02)


def test_mujoco_sliding_lifts_off():
    _, seen = motion("mujoco", "rigid", CASES["slide"], 0.002, samples=100, seconds=0.2)
    assert seen.pos[..., 2].max() - 0.1 > 1e-3


@pytest.mark.parametrize("name", ["bullet", "ode", "rapier", "brax", "mjx"])
def test_peers_fall_freely(name):
    """Where they are installed."""
    engine = ENGINES[name]
    if engine.missing():
        pytest.skip(f"{name} is {engine.missing()}")
    case, seen = motion(name, next(iter(engine.variants)), CASES["parabola"], 1 / 200)
    error = case.error(seen, case.truth(case.start(2)), case)
    assert (error < 0.02).all() and (error > 1e-4).all()  # an Euler step is off by g h t / 2
