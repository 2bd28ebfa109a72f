"""The command line and the files it writes. In-process calls on scenes that compile in a moment."""

import json
import struct
import subprocess
import sys
import types

import jax
import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax import cli, examples, record
from rbd_jax.mjcf import load_mjcf
from rbd_jax.scene import resolve, rotation

FREE = ["tumbling_box", "--method", "fast"]  # no contact: compiles in a second

BALL = """<mujoco><option timestep="0.004" cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="1 1 1" friction="0"/>
  <body name="ball" pos="0 0 0.1"><freejoint/><geom type="sphere" size="0.1" friction="0"/></body>
</worldbody></mujoco>"""

HINGE = """<mujoco><worldbody><body name="door"><joint name="axis" type="hinge"/><geom size="0.1"/></body>
</worldbody></mujoco>"""

# in float32 its speed overflows after 283 steps
LOST = """<mujoco><option timestep="0.004" gravity="0 0 -3e38"/><worldbody>
  <body name="lost"><freejoint/><geom type="box" size="0.1 0.2 0.3"/></body></worldbody></mujoco>"""


def write(folder, text):
    path = folder / "scene.xml"
    path.write_text(text)
    return str(path)


def run(capsys, *argv):
    """(exit code, stdout, stderr) of a command."""
    code = cli.main([str(a) for a in argv])
    out, err = capsys.readouterr()
    return code, out, err


@pytest.fixture
def no_simulation(monkeypatch):
    """Fails a test that gets as far as simulating."""

    def simulate(*_):
        raise AssertionError("simulated before the input was checked")

    monkeypatch.setattr(cli, "_simulate", simulate)
    monkeypatch.setattr(cli, "_bench_ours", simulate)
    monkeypatch.setattr(cli, "_bench_mujoco", simulate)


# --- run ---


def test_run_writes_what_it_says(capsys, tmp_path):
    out, page, shot = tmp_path / "o.npz", tmp_path / "o.html", tmp_path / "o.png"
    options = ["--batch", 3, "--perturb", 0.01, "--seed", 4, "--steps", 40, "--every", 4]
    code, text, err = run(capsys, "run", *FREE, *options, "--out", out, "--html", page, "--png", shot)
    assert code == 0, err
    for word in ("1 body", "40 steps of 4 ms", "3 worlds", "total energy [J]", "at rest", "all well", str(out)):
        assert word in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["o.html", "o.npz", "o.png"]  # nothing left over

    file = np.load(out, allow_pickle=False)
    assert file["pos"].shape == file["vel"].shape == file["omega"].shape == (3, 11, 1, 3)
    assert file["quat"].shape == (3, 11, 1, 4)
    assert file["time"].shape == file["status"].shape == file["step"].shape == (3, 11)
    np.testing.assert_allclose(file["time"][1], np.arange(11) * 0.016, rtol=0, atol=1e-15)
    assert file["bodies"].tolist() == ["box"] and file["geoms"].tolist() == ["box"]
    assert not file["status"].any() and file["kinematic"].size == 0 and "kinematic_pos" not in file
    assert all(np.isfinite(file[name]).all() for name in ("pos", "vel", "quat", "omega"))
    assert abs(np.diff(file["pos"][:, 0], axis=0)).min() > 0  # worlds differ
    header = json.loads(str(file["header"]))
    assert header["format"] == record.FORMAT and header["dt"] == 0.004 and header["dtype"] == "float32"
    assert header["seed"] == 4 and header["perturb"] == 0.01 and header["scene"] == "tumbling_box"
    assert header["versions"]["jax"] == jax.__version__ and "symtop2" in header["method"].lower()

    html = page.read_text()
    assert html.lstrip().lower().startswith("<!doctype html") and "tumbling_box" in html
    assert "http://" not in html.replace("http://www.w3.org", "") and "<script src" not in html
    data = shot.read_bytes()
    assert data.startswith(b"\x89PNG\r\n\x1a\n") and data.endswith(b"IEND\xaeB`\x82")
    assert struct.unpack(">II", data[16:24]) == (960, 600) and len(data) > 5000


def test_run_agrees_with_rollout(capsys, tmp_path):
    """Chunks joined are one rollout, and a seed means the same twice."""
    files = {}
    for name, seed, steps in (("a", 1, 50), ("b", 1, 50), ("c", 2, 50)):
        path = tmp_path / f"{name}.npz"
        options = ["--steps", steps, "--every", 5, "--batch", 2, "--perturb", 0.1, "--seed", seed]
        assert run(capsys, "run", *FREE, *options, "--out", path)[0] == 0
        files[name] = record.load(path)
    a, b, c = (files[k]["pos"] for k in "abc")
    assert np.array_equal(a, b) and not np.allclose(a, c)

    model, state = rbd.build(load_mjcf(examples.path("tumbling_box")), method="fast")
    state = rbd.batch(state, 2).replace(pos=files["a"]["pos"][:, 0], vel=files["a"]["vel"][:, 0])
    final, traj = rbd.rollout(model, state, steps=50, every=5)
    for name in ("pos", "vel", "quat", "omega"):
        np.testing.assert_allclose(files["a"][name], getattr(traj, name), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(files["a"][name][:, -1], getattr(final, name), rtol=1e-6, atol=1e-6)


def test_run_defaults(capsys):
    code, out, err = run(capsys, "run", *FREE, "--batch", 2)
    assert code == 0
    assert "5 s = 1250 steps" in out and "Nothing written" in out and "--html FILE.html" in out
    assert "all worlds are the same" in err and "compiling" in err


def test_run_json_and_quiet(capsys):
    code, out, err = run(capsys, "run", *FREE, "--seconds", 0.2, "--json", "--quiet")
    summary = json.loads(out)
    assert code == 0 and err == ""
    assert summary["steps"] == 50 and summary["seconds"] == pytest.approx(0.2) and summary["bad_worlds"] == 0
    assert summary["resting"] == 0 and summary["moving"] == 1 and summary["compile_s"] >= 0
    start, end = summary["start"]["energy"]["total"]["mean"], summary["end"]["energy"]["total"]["mean"]
    assert end == pytest.approx(start, rel=1e-3)
    assert run(capsys, "run", *FREE, "--seconds", 0.2, "--quiet")[1:] == ("", "")


def test_no_steps_gives_the_scene(capsys, tmp_path):
    page, shot = tmp_path / "o.html", tmp_path / "o.png"
    assert run(capsys, "run", *FREE, "--steps", 0, "--html", page, "--png", shot)[0] == 0
    assert page.stat().st_size > 10_000 and shot.stat().st_size > 5000


def test_world_that_goes_wrong(capsys, tmp_path):
    out = tmp_path / "o.npz"
    argv = ["run", write(tmp_path, LOST), "--method", "fast", "--steps", 300, "--out", out]
    code, text, err = run(capsys, *argv)
    assert code == 1
    assert "1 world of 1 went wrong" in text and "NOT_FINITE" in err and "Remedy" in err and "Traceback" not in err
    file = record.load(out)
    assert np.isfinite(file["pos"]).all() and file["status"][0, -1] == int(rbd.Status.NOT_FINITE)
    code, text, _ = run(capsys, *argv, "--json")
    assert code == 1 and json.loads(text)["bad_worlds"] == 1


def test_interrupt_writes_what_there_is(capsys, tmp_path, monkeypatch):
    program, calls = cli._program, []

    def interrupted(steps, every):
        calls.append(steps)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return program(steps, every)

    monkeypatch.setattr(cli, "_program", interrupted)
    out = tmp_path / "o.npz"
    code, text, err = run(capsys, "run", *FREE, "--steps", 40, "--every", 4, "--out", out)
    assert code == 130 and "interrupted after" in err and str(out) in text
    file = record.load(out)
    assert 1 < file["pos"].shape[1] < 11


def test_warnings_are_one_line(capsys, tmp_path, monkeypatch):
    def stop(*_):
        raise cli.UsageError("stop")

    monkeypatch.setattr(cli, "_simulate", stop)
    text = BALL.replace(' cone="elliptic"', "").replace('friction="0"', 'friction="0.5"')
    code, _, err = run(capsys, "run", write(tmp_path, text), "--method", "fast")
    assert code == 2 and len(err.splitlines()) == 2
    assert err.startswith("rbd-jax run: warning: ") and err.count("the pyramidal friction cone") == 1


# --- bad input ---


@pytest.mark.parametrize(
    "argv, said",
    [
        ([], "COMMAND"),
        (["walk"], "walk"),
        (["run"], "SCENE"),
        (["run", "nowhere.xml"], "nowhere.xml: no such file, nor a shipped example (ball_pile"),
        (["run", *FREE, "--dt", "0"], "'0' must be a finite number > 0 [s]"),
        (["run", *FREE, "--dt", "-0.01"], "'-0.01' must be a finite number > 0"),
        (["run", *FREE, "--dt", "nan"], "'nan' must be a finite number > 0"),
        (["run", *FREE, "--steps", "-1"], "'-1' must be an integer >= 0"),
        (["run", *FREE, "--steps", "1.5"], "'1.5' must be an integer >= 0"),
        (["run", *FREE, "--seconds", "0"], "--seconds"),
        (["run", *FREE, "--steps", "5", "--seconds", "1"], "not allowed with"),
        (["run", *FREE, "--batch", "0"], "'0' must be an integer >= 1"),
        (["run", *FREE, "--every", "0"], "--every"),
        (["run", *FREE, "--perturb", "-1"], "--perturb"),
        (["run", *FREE, "--seed", "x"], "'x' must be an integer >= 0"),
        (["run", "tumbling_box", "--method", "magic"], "magic"),
        (["run", *FREE, "--speed", "2"], "--speed"),
        (["bench", *FREE, "--batch", "1,x"], "'x' must be an integer >= 1"),
        (["bench", "nowhere"], "nowhere"),
        (["bench", "tumbling_box", "--method", "magic"], "magic"),
        (["validate", "nowhere"], "nowhere"),
    ],
)
def test_usage_errors(capsys, no_simulation, argv, said):
    code, out, err = run(capsys, *argv)
    assert code == 2 and out == ""
    assert said in err and err.startswith("rbd-jax") and len(err.splitlines()) == 1


@pytest.mark.parametrize("option", ["--out", "--html", "--png"])
def test_output_is_checked_before_simulating(capsys, no_simulation, tmp_path, option):
    missing = tmp_path / "missing" / "o"
    for path, said in ((missing, "does not exist"), (tmp_path, "is a folder"), ("", "empty")):
        code, _, err = run(capsys, "run", *FREE, option, path)
        assert code == 2 and said in err and len(err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_outputs_must_differ(capsys, no_simulation, tmp_path):
    code, _, err = run(capsys, "run", *FREE, "--out", tmp_path / "o", "--png", tmp_path / "o")
    assert code == 2 and "must differ" in err


def test_bench_file_is_checked_before_measuring(capsys, no_simulation, tmp_path):
    code, _, err = run(capsys, "bench", *FREE, "--append", tmp_path / "missing" / "o.jsonl")
    assert code == 2 and "does not exist" in err


def test_scene_that_is_refused(capsys, no_simulation, tmp_path):
    code, _, err = run(capsys, "run", write(tmp_path, HINGE))
    assert code == 2 and "hinge" in err and "axis" in err and "Traceback" not in err
    code, _, err = run(capsys, "run", write(tmp_path, "<mujoco><worldbody></mujoco>"))
    assert code == 2 and "cannot compile" in err
    code, _, err = run(capsys, "run", tmp_path)
    assert code == 2 and "directory" in err


# --- the other commands ---


def test_help_and_version(capsys):
    for argv in (["--help"], ["run", "--help"], ["validate", "--help"], ["bench", "--help"], ["info", "--help"]):
        code, out, err = run(capsys, *argv)
        assert code == 0 and err == "" and "rbd-jax " in out and ("example" in out or "Start with" in out)
    assert run(capsys, "--version")[1] == f"rbd-jax {rbd.__version__}\n"


def test_as_a_module():
    argv = [sys.executable, "-m", "rbd_jax", "run", "nowhere"]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stdout == "" and len(done.stderr.splitlines()) == 1


def test_info(capsys):
    code, out, _ = run(capsys, "info")
    assert code == 0 and "tumbling_box" in out and jax.__version__ in out and "float" in out
    code, out, _ = run(capsys, "info", "--json")
    info = json.loads(out)
    assert info["examples"] == list(examples.names()) and set(info["presets"]) == set(rbd.PRESETS)
    assert set(info["extras"]) >= {"viz", "mjx", "cuda"} and info["devices"]


def test_bench(capsys, tmp_path):
    log = tmp_path / "bench.jsonl"
    argv = ["bench", write(tmp_path, BALL), "--method", "fast", "--seconds", 0.08, "--repeats", 2, "--append", log]
    code, out, err = run(capsys, *argv, "--batch", "2")
    assert code == 0, err
    for line in ("Total JIT time", "Total simulation time", "Total steps per second", "Total realtime factor",
                 "Total time per step", "Deepest penetration", "2 parallel rollouts", "MuJoCo 4."):  # fmt: skip
        assert line in out
    code, out, _ = run(capsys, *argv, "--batch", "2", "--json")
    first, second = map(json.loads, log.read_text().splitlines())
    assert json.loads(out) == second and code == 0
    assert first["batch"] == 2 and first["steps"] == 20 and len(first["runs_s"]) == 2 and first["bad_worlds"] == 0
    assert first["realtime"] == pytest.approx(first["steps_per_s"] * 0.004)
    assert first["us_per_step"] == pytest.approx(1e6 / first["steps_per_s"])
    assert first["dtype"] == "float32" and first["device"] and first["versions"]["jax"] == jax.__version__
    assert 0 <= first["penetration_m"] < 0.01
    rival = first["mujoco"]
    assert rival["threads"] >= 1 and rival["steps_per_s"] > 0 and 0 < rival["penetration_m"] < 0.01


def test_validate_reports_and_sets_the_exit_code(capsys, monkeypatch):
    asked = []

    def validate(scene, method=None, steps=None):
        asked.append((type(scene), method, steps))
        return types.SimpleNamespace(table=lambda: "the table", ok=len(asked) == 1, to_dict=lambda: {"error": 1.0})

    monkeypatch.setitem(sys.modules, "rbd_jax.parity", types.SimpleNamespace(validate=validate))
    code, out, _ = run(capsys, "validate", "tumbling_box")
    assert code == 0 and out == "the table\n"
    code, out, _ = run(capsys, "validate", "tumbling_box", "--method", "fast", "--steps", 7, "--json")
    assert code == 1 and json.loads(out) == {"error": 1.0}
    assert asked == [(rbd.Scene, None, None), (rbd.Scene, "fast", 7)]


# --- chunks ---


def test_chunks():
    for steps in (0, 1, 2, 7, 40, 97, 1000, 1009, 1250, 99_991):
        for unit in (1, 3, 5, 2000):
            chunks = cli._chunks(steps, unit)
            assert sum(chunks) == steps and all(c % unit == 0 for c in chunks[:-1])
            assert len(set(chunks)) <= 2 and len(chunks) <= 4 * cli.PIECES + 1
    for steps, dt in ((1250, 0.004), (1200, 1 / 240), (2500, 0.002), (3, 0.004), (1, 1.0)):
        every = cli._every(steps, dt)
        assert steps % every == 0 and every * dt <= max(1.6 / 60, dt) + 1e-9


# --- record ---


def samples(state, worlds, count):
    """A made-up trajectory (worlds, count, n) that does not move, but for its clock."""
    traj = rbd.batch(state._with(memory=None), worlds, count)
    return traj.replace(step=np.broadcast_to(np.arange(count, dtype=np.int32), (worlds, count)))


@pytest.mark.parametrize("name", ["compound", "conveyor", "ball_pile"])
def test_clip_puts_every_geom_where_the_scene_has_it(name):
    """Bodies with a centre of mass off their origin, kinematic bodies, turned geoms, planes."""
    scene = load_mjcf(examples.path(name))
    r = resolve(scene)
    model, state = rbd.build(scene, method="fast")
    film = record.clip(model, samples(state, 3, 4), title=name, worlds=2)
    assert film.shape == (2, 4, len(r.body_names) + len(r.kinematic_names)) and film.dynamic == len(r.body_names)
    assert tuple(film.names) == r.body_names + r.kinematic_names
    np.testing.assert_allclose(film.time, 0.004 * np.arange(4), atol=1e-12)
    bodies = {"pos": [*r.pos, *r.kinematic_pos], "quat": [*r.quat, *r.kinematic_quat]}
    pos, quat = film.poses(1, [3])
    for i, shape in enumerate(r.geom_shapes):
        where, turn = r.geom_pos[i], rotation(r.geom_quat[i])
        body = r.geom_body[i] + (len(r.body_names) if r.geom_category[i] == 1 else 0)
        if r.geom_category[i] < 2:
            frame = rotation(bodies["quat"][body])
            where, turn = bodies["pos"][body] + frame @ where, frame @ turn
        assert film.kind[i] == shape.kind and film.geoms[i]["name"] == r.geom_names[i]
        np.testing.assert_allclose(pos[0, i], where, atol=2e-6)
        np.testing.assert_allclose(rotation(quat[0, i]), turn, atol=2e-6)
        size = {"sphere": lambda s: [s.radius] * 3, "box": lambda s: s.half_extents, "plane": lambda s: [1, 1, 1]}
        np.testing.assert_allclose(film.geom_size[1, i], size[shape.kind](shape), rtol=1e-6)


def test_clip_of_worlds_with_their_own_numbers():
    model, state = rbd.build(load_mjcf(examples.path("compound")), method="fast")
    radius = np.linspace(0.1, 0.2, 3)[:, None] * np.ones_like(model.radius)
    com = np.asarray(model.com) + np.array([0.0, 0.1, 0.2])[:, None, None]
    batched = model.replace(radius=radius, com=com)
    film = record.clip(batched, samples(state, 3, 2))
    ball = film.kind.index("sphere")
    np.testing.assert_allclose(film.geom_size[:, ball, 0], [0.1, 0.15, 0.2], rtol=1e-6)
    plain = record.clip(model, samples(state, 3, 2))
    offset = np.linalg.norm(film.pos - plain.pos, axis=-1)
    expected = np.sqrt(3) * np.array([0, 0.1, 0.2])[:, None, None]
    np.testing.assert_allclose(offset, np.broadcast_to(expected, offset.shape), atol=2e-6)
    # several batch axes become one
    wide = jax.tree.map(lambda c: np.reshape(c, (3, 1, *np.shape(c)[1:])), samples(state, 3, 2))
    np.testing.assert_array_equal(record.clip(batched, wide).geom_size, film.geom_size)
    with pytest.raises(ValueError, match="batch"):
        record.clip(batched, samples(state, 1, 2))
    with pytest.raises(ValueError, match="worlds = 0"):
        record.clip(model, samples(state, 1, 2), worlds=0)


def test_clip_leaves_out_frozen_samples():
    model, state = rbd.build(load_mjcf(examples.path("tumbling_box")), method="fast")
    traj = samples(state, 2, 5)
    both = traj.replace(step=np.array([[0, 1, 1, 1, 1], [0, 1, 2, 2, 2]], np.int32))
    assert record.clip(model, both).shape == (2, 3, 1)
    one = traj.replace(step=np.array([[0, 1, 1, 1, 1], [0, 1, 2, 3, 4]], np.int32))
    assert record.clip(model, one).shape == (2, 5, 1)


def test_save_load(tmp_path):
    model, state = rbd.build(load_mjcf(examples.path("conveyor")), method="fast")
    path = tmp_path / "any.name"
    record.save(path, model, samples(state, 2, 3), remark="hello")
    content = record.load(path)
    assert content["kinematic_pos"].shape == (2, 3, 1, 3) and content["kinematic_quat"].shape == (2, 3, 1, 4)
    assert content["kinematic"].tolist() == ["belt"] and content["header"]["remark"] == "hello"
    np.testing.assert_allclose(content["kinematic_vel"][0, 0, 0], [0.5, 0, 0])

    before = path.read_bytes()
    with pytest.raises(TypeError):
        record.save(path, model, samples(state, 2, 3), remark=object())
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["any.name"]
    with pytest.raises(FileNotFoundError):
        record.save(tmp_path / "missing" / "o.npz", model, state)
    with pytest.raises(FileNotFoundError):
        record.load(tmp_path / "missing.npz")
    other = tmp_path / "other.npz"
    other.write_text("text")
    with pytest.raises(ValueError, match="not a trajectory file"):
        record.load(other)


@pytest.mark.parametrize(
    "ending, start",
    [("gif", b"GIF89a"), ("glb", b"glTF"), ("usda", b"#usda"), ("xml", b"<mujoco"), ("png", b"\x89PNG")],
)
def test_render_writes_what_the_ending_says(tmp_path, ending, start):
    pytest.importorskip("PIL")
    path = tmp_path / f"a.{ending}"
    small = ["--seconds", "0.1", "--size", "48x32", "--fps", "20"]
    assert cli.main(["render", "bouncing_balls", "-o", str(path), *small]) == 0
    assert path.read_bytes().startswith(start)


def test_render_takes_what_run_wrote(tmp_path, capsys):
    out = str(tmp_path / "out.npz")
    noise = ["--perturb", "0.01", "--quiet"]
    assert (
        cli.main(["run", "bouncing_balls", "--batch", "3", "--steps", "6", "--every", "3", "--out", out, *noise]) == 0
    )
    assert cli.main(["render", out, "-o", str(tmp_path / "a.usda"), "--worlds", "2"]) == 0
    assert (tmp_path / "a.usda").read_text().count('def Xform "world_') == 2
    for bad, message in (
        (["render", out, "-o", str(tmp_path / "a.xyz")], "cannot write .xyz; known: .png, .gif"),
        (["render", out, "-o", str(tmp_path / "no" / "a.png")], "does not exist"),
        (["render", str(tmp_path / "s.xml"), "-o", str(tmp_path / "s.xml")], "is the scene itself"),
        (["render", str(tmp_path / "none.npz"), "-o", str(tmp_path / "a.png")], "none.npz"),
        (["render", "dominoes", "-o", str(tmp_path / "a.png"), "--size", "12"], "must be WIDTHxHEIGHT"),
    ):
        assert cli.main(bad) == 2
        assert message in capsys.readouterr().err


def test_train_learns_and_says_so(capsys, tmp_path):
    pytest.importorskip("optax")
    film = tmp_path / "push.glb"
    command = ["train", "push", "--learner", "through", "--steps", "40000", "--json", "--out", str(film)]
    assert cli.main(command) == 0 and film.read_bytes().startswith(b"glTF")
    told = json.loads(capsys.readouterr().out)
    assert told["task"] == "push" and told["steps"] >= 40_000 and told["learned"] > told["chance"]
    assert cli.main(["train", "juggle"]) == 2
    assert "unknown task 'juggle'" in capsys.readouterr().err
