"""The built wheel works where there is no source tree."""

import os
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with the wheel in it, and one to work in."""
    built, target, elsewhere = (tmp_path_factory.mktemp(n) for n in ("built", "target", "elsewhere"))
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    done = subprocess.run(
        [*pip, "wheel", "-q", "--no-deps", "-w", str(built), str(ROOT)], capture_output=True, text=True, timeout=300
    )
    if "hatchling" in done.stderr and "Could not find a version" in done.stderr:
        pytest.skip("no package index to build a wheel with")
    assert done.returncode == 0, done.stderr[-2000:]
    (wheel,) = built.glob("rbd_jax-*.whl")
    subprocess.run([*pip, "install", "-q", "--no-deps", "--target", str(target), str(wheel)], check=True, timeout=300)
    return target, elsewhere


def run(installed, *command):
    target, elsewhere = installed
    env = {**os.environ, "PYTHONPATH": str(target), "JAX_PLATFORMS": "cpu"}
    return subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, env=env, cwd=elsewhere, timeout=300
    )


def test_wheel_runs_a_shipped_scene_elsewhere(installed):
    where = run(installed, "-c", "import rbd_jax; print(rbd_jax.__file__)")
    assert where.stdout.startswith(str(installed[0])), where.stdout + where.stderr
    done = run(installed, "-m", "rbd_jax", "run", "bouncing_balls", "--out", "out.npz", "--html", "out.html")
    assert done.returncode == 0, done.stderr[-2000:]
    assert {"out.npz", "out.html"} <= {p.name for p in installed[1].iterdir()}


def test_wheel_says_where_the_suite_is(installed):
    """The benchmark suite is of the source tree: without it there is a sentence, no traceback."""
    done = run(installed, "-m", "rbd_jax", "bench", "--suite", "smoke")
    assert done.returncode != 0 and "Traceback" not in done.stderr
    assert "source" in done.stderr, done.stderr
