"""The reference pages: ``sphinx-build docs out``, without a network.

A line ``[README: Title](../README.md#title)`` becomes that section of the README, and the pages and pictures of
``benchmarks/results`` become pages of the site.
"""

import pathlib
import re
import shutil

import rbd_jax

HERE = pathlib.Path(__file__).parent
README = (HERE.parent / "README.md").read_text(encoding="utf-8")
RESULTS = HERE.parent / "benchmarks" / "results"

project = "rbd_jax"
author = "rbd_jax authors"
copyright = "rbd_jax authors, MIT licence"
release = version = rbd_jax.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_heading_anchors = 3
autodoc_typehints = "none"
autodoc_member_order = "bysource"
# links to notebooks, rows and numbers, which are no pages of this site; tests/test_docs.py looks after them
suppress_warnings = ["myst.xref_missing", "toc.not_included"]

html_theme = "alabaster"
html_theme_options = {
    "description": "Batched, differentiable rigid-body dynamics in JAX",
    "page_width": "1120px",
    "body_max_width": "none",
    "sidebar_width": "200px",
    "fixed_sidebar": True,
}
html_show_sourcelink = False


def section(title: str) -> str:
    """The text of a section of the README, without its heading."""
    return re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", README, re.M | re.S).group(1)


def put_together(app, name, source):
    text = re.sub(r"^\[README: (.+)\]\(\.\./README\.md#[^)]*\)$", lambda m: section(m[1]), source[0], flags=re.M)
    text = re.sub(r"\]\((?:\.\./)?benchmarks/results/", "](results/", text)
    source[0] = text.replace("](docs/", "](") if not name.startswith("results/") else text


def copy_results(app):
    place = HERE / "results"
    for file in [*RESULTS.glob("*.md"), *RESULTS.glob("*.png"), *RESULTS.glob("*.gif"), *RESULTS.glob("suite/*.png")]:
        to = place / file.relative_to(RESULTS)
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(file, to)


HEADING = re.compile(r"(Args|Attributes|Returns|Raises|Yields)\b(.*):")


def lists(app, what, name, obj, options, lines):
    """The sections of a docstring as lists; an entry begins two spaces in and may name several things."""
    out, inside = [], False
    for line in lines:
        line, heading = re.sub(r"(\||\*\*)", r"\\\1", line), HEADING.fullmatch(line)
        if heading:
            out += ["", f"**{heading[1]}**{heading[2]}", ""]
            inside = True
        elif inside and re.match(r"  \S", line):
            out.append("* " + re.sub(r"^(\w+(?:, \w+)*):(?= |$)", r"**\1**:", line.strip()))
        elif inside and line.startswith("   "):
            out.append("  " + line.strip())
        else:
            if inside and line.strip():
                inside = False
                out.append("")
            out.append(line)
    lines[:] = out


def setup(app):
    app.connect("autodoc-process-docstring", lists)
    app.connect("builder-inited", copy_results)
    app.connect("source-read", put_together)
