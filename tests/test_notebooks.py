"""The notebooks run as they stand, at small size: what they conclude they assert."""

import os
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))


def test_there_are_seven():
    assert len(NOTEBOOKS) == 7


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path, tmp_path):
    pytest.importorskip("matplotlib")
    env = {**os.environ, "RBD_JAX_SMALL": "1", "MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, str(path)], capture_output=True, text=True, env=env, cwd=tmp_path, timeout=300
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert not list(tmp_path.iterdir())


def test_a_clip_shows_itself_in_a_notebook():
    from rbd_jax.view import Clip

    ball = {"kind": "sphere", "size": (0.1,), "body": 0}
    text = Clip([ball], [0.0, 0.1], [[[[0, 0, 0]], [[0, 0, 1]]]], [[[[1, 0, 0, 0]]] * 2])._repr_html_()
    assert text.startswith('<iframe srcdoc="&lt;!') and text.count('"') == 6 and "</iframe>" in text
