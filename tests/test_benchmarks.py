"""The benchmark scripts run and write their rows; what they measure is not judged here."""

import json
import os
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[1]


def run(script, *arguments):
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(ROOT / "benchmarks" / script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env={**os.environ, "PYTHONPATH": path})


def smoke(script, out):
    done = run(script, "--smoke", "--out", out)
    assert done.returncode == 0, done.stderr[-3000:]


def test_throughput_writes_rows(tmp_path):
    smoke("throughput.py", tmp_path)
    rows = [json.loads(line) for line in (tmp_path / "throughput.jsonl").read_text().splitlines()]
    timed = {r["scene"]: r for r in rows if r["benchmark"] == "throughput"}
    assert {"ball", "isotropic"} <= set(timed)
    for r in timed.values():
        assert {"date", "commit", "versions", "cpu", "cores", "dtype", "method", "batch", "dt", "iqr_s"} <= set(r)
        assert r["median_s"] > 0 and r["ratio"] > 0 and r["compile_total_s"] > 0 and r["mujoco"]["median_s"] > 0
    assert {"penetration_m", "normal_speed_m_s", "rolling_speed_error"} <= set(timed["ball"]["error"])
    assert "attitude_error_rad" in timed["isotropic"]["error"]
    assert "ball on a plane" in (tmp_path / "throughput.md").read_text()


def test_physics_writes_figures(tmp_path):
    smoke("physics.py", tmp_path)
    data = json.loads((tmp_path / "physics.json").read_text())
    assert {"fast", "MuJoCo"} <= set(data["figures"]) and data["environment"]["versions"]["mujoco-core"]
    assert {"rest_speed_sphere", "roll_error", "linear_momentum"} <= set(data["figures"]["fast"])
    assert all(value is not None for _, value, _ in data["equal_step"])
    assert "## Figures" in (tmp_path / "physics.md").read_text()


def quick(script, out, *arguments):
    done = run(script, "--quick", "--out", out, *arguments)
    assert done.returncode == 0, done.stderr[-3000:]


def test_stability_writes_rows(tmp_path):
    quick("stability.py", tmp_path)
    rows = [json.loads(line) for line in (tmp_path / "stability.jsonl").read_text().splitlines()]
    assert {"slide", "roll", "million"} == {r["row"] for r in rows} and {"fast"} == {r["method"] for r in rows}
    for r in rows:
        assert r["quick"] and r["verdict"] == "" and r["environment"]["versions"]["mujoco-core"]
        assert r["figures"] and all(f["value"] is not None for f in r["figures"])
    assert "slide to stop" in (tmp_path / "stability.md").read_text()


def test_stability_maps_are_resumed_and_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    drawn = lambda: {p.name for p in tmp_path.glob("*.png")}
    read = lambda: json.loads((tmp_path / "stability_maps.json").read_text())
    quick("stability_maps.py", tmp_path, "--maps", "mass_two,spin,speed")
    maps, outcomes = read()["maps"], set(read()["outcomes"])
    assert drawn() == {f"stability_map_{name}.png" for name in ("mass_two", "spin", "speed")}
    for name in ("mass_two", "spin", "speed"):
        assert set(maps[name]["methods"]) == {"penalty", "MuJoCo", "MuJoCo rigid"}
        for entry in maps[name]["methods"].values():
            assert len(entry["outcome"]) == len(maps[name]["y"]) and entry["commit"]
            assert all(
                len(row) == len(maps[name]["x"]) and set(row) <= outcomes - {"refused"} for row in entry["outcome"]
            )
    assert read()["environment"]["device"]
    before = maps["mass_two"]
    quick("stability_maps.py", tmp_path, "--maps", "height,mass,mass_two", "--methods", "MuJoCo")
    assert read()["maps"]["mass_two"] == before and {"stability_map.png", "stability_map_height.png"} <= drawn()


def test_gradient_uses_writes_a_page(tmp_path):
    for package in ("optax", "scipy", "matplotlib"):
        pytest.importorskip(package)
    quick("gradient_uses.py", tmp_path, "--uses", "aim")
    row = json.loads((tmp_path / "gradient_uses.json").read_text())["uses"]["aim"]
    assert min(row["gradient"]["losses"]) < row["gradient"]["losses"][0] and row["zeroth_order"]["evaluations"] == 8
    assert "| aim |" in (tmp_path / "gradient_uses.md").read_text() and (tmp_path / "gradient_uses.png").stat().st_size


def test_unknown_map_is_refused(tmp_path):
    done = run("stability_maps.py", "--maps", "rocket", "--out", tmp_path)
    assert done.returncode == 2 and "unknown map 'rocket'" in done.stderr
    assert not list(tmp_path.iterdir())


def test_unknown_scene_is_refused(tmp_path):
    done = run("throughput.py", "--scenes", "rocket", "--out", tmp_path)
    assert done.returncode == 2 and "unknown scene 'rocket'" in done.stderr
    assert not list(tmp_path.iterdir())


def test_large_worlds_write_rows(tmp_path):
    quick("large_worlds.py", tmp_path)
    rows = json.loads((tmp_path / "large_worlds.json").read_text())["rows"]
    assert {"spheres", "boxes on static boxes"} == {r["scene"] for r in rows}
    assert all(r["finite"] and r["ours_s"] > 0 and r["mujoco_s"] > 0 and r["contacts"] > 0 for r in rows)
    assert "| spheres |" in (tmp_path / "large_worlds.md").read_text()


def test_gradient_costs_are_written(tmp_path):
    quick("gradients.py", tmp_path, "--rows", "cost")
    rows = [json.loads(line) for line in (tmp_path / "gradients.jsonl").read_text().splitlines()]
    ours = [r for r in rows if r["row"] == "cost" and r["engine"] == "rbd_jax"]
    assert ours and all(r["finite"] and r["forward_s"] > 0 and r["reverse_B"] > 0 for r in ours)


def test_the_gradient_contract_is_a_page(tmp_path):
    done = run("gradient_contract.py", "--quick", "--out", tmp_path / "gradients.md")
    assert done.returncode == 0, done.stderr[-3000:]
    assert "| free flight |" in (tmp_path / "gradients.md").read_text()


PAGES = (
    ("gradient_horizon", "median"),
    ("scaling", "slope"),
    ("rooflines", "Gflop/s"),
    ("equal_error", "ratio"),
    ("accelerator", "bound"),
)


@pytest.mark.parametrize("script, page", PAGES)
def test_speed_scripts_write_rows(tmp_path, script, page):
    smoke(f"{script}.py", tmp_path)
    assert page in (tmp_path / f"{script}.md").read_text()
    data = [*tmp_path.glob(f"{script}.json*")]
    assert data and "versions" in data[0].read_text()


def test_learning_writes_rows(tmp_path):
    pytest.importorskip("optax")
    smoke("learning.py", tmp_path)
    rows = [json.loads(line) for line in (tmp_path / "learning.jsonl").read_text().splitlines()]
    speed = {r["engine"]: r for r in rows if r["row"] == "throughput"}
    assert speed["ours"]["steps_per_s"] > 0 and speed["mujoco"]["steps_per_s"] > 0 and "brax" in " ".join(speed)
    assert {"chance", "ppo"} <= {r["learner"] for r in rows if r["row"] == "curve"}
    assert (tmp_path / "learning.md").exists()


def test_people_writes_rows(tmp_path):
    """A small page, and a run that is killed twice."""
    done = run("people.py", "--smoke", "--rows", "page,kills", "--out", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    page, kills = (json.loads(line) for line in (tmp_path / "people.jsonl").read_text().splitlines())
    assert page["megabytes"] < 5 and kills["end_same_bits"] and len(kills["killed_after_steps"]) == 2
    assert "killed 2 times" in (tmp_path / "people.md").read_text()
