"""The benchmark scripts run and write their rows; what they measure is not judged here."""

import json
import os
import pathlib
import subprocess
import sys

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
    assert {"penetration_m", "residual_speed_m_s", "rolling_speed_error"} <= set(timed["ball"]["error"])
    assert "attitude_error_rad" in timed["isotropic"]["error"]
    assert "ball on a plane" in (tmp_path / "throughput.md").read_text()


def test_physics_writes_figures(tmp_path):
    smoke("physics.py", tmp_path)
    data = json.loads((tmp_path / "physics.json").read_text())
    assert {"fast", "MuJoCo"} <= set(data["figures"]) and data["environment"]["versions"]["mujoco-core"]
    assert {"rest_speed_sphere", "roll_error", "linear_momentum"} <= set(data["figures"]["fast"])
    assert all(value is not None for _, value, _ in data["equal_step"])
    assert "## Figures" in (tmp_path / "physics.md").read_text()


def test_unknown_scene_is_refused(tmp_path):
    done = run("throughput.py", "--scenes", "rocket", "--out", tmp_path)
    assert done.returncode == 2 and "unknown scene 'rocket'" in done.stderr
    assert not list(tmp_path.iterdir())
