"""The code on the pages runs as it stands."""

import os
import pathlib
import re
import subprocess
import sys

import pytest

import rbd_jax

ROOT = pathlib.Path(__file__).parents[1]
PAGES = ("docs/performance.md", "docs/learning.md", "docs/long_runs.md")


@pytest.mark.parametrize("page", PAGES)
def test_code_blocks_run(page, tmp_path):
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.M | re.S)
    assert blocks
    code = "\n".join(blocks).replace("/tmp/jax_cache", str(tmp_path / "cache"))
    env = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]


def test_reference_pages_build(tmp_path):
    """Without a warning and without a network; every public name is on the page of the API."""
    pytest.importorskip("sphinx")
    pytest.importorskip("myst_parser")
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-d", str(tmp_path / "cache"), "docs", str(tmp_path / "out")]
    env = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, env=env, cwd=ROOT, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    page = (tmp_path / "out" / "api.html").read_text()
    missing = [name for name in rbd_jax.__all__ if f'id="rbd_jax.{name}"' not in page and name.upper() != name]
    assert not missing, missing


def test_links_lead_somewhere():
    broken = []
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
            if not target.startswith(("http:", "https:", "mailto:")) and not (page.parent / target).exists():
                broken.append(f"{page.name}: {target}")
    assert not broken, broken
