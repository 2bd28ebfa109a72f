"""What a person waits for and relies on: the first ten minutes, the page of a large trajectory, a run that is killed.

    PYTHONPATH=. python benchmarks/people.py                     (five minutes on 2 cores; "walk" needs a package index)
    PYTHONPATH=. python benchmarks/people.py --smoke --rows page,kills --out /tmp/x

* walk: in a fresh clone and a fresh environment, the README's first command, its twelve lines and the first notebook,
  each copied from the page by this script; bar: 10 minutes.
* page: 100 bodies, 10 s at 60 samples a second; bars: 5 MB, and 2 s until a headless Chromium (drawn by the processor)
  has the first picture, over what it needs for an empty page.
* kills: a run with checkpoints and samples in zarr, killed at 20 random moments without warning and gone on with; bar:
  the end, the checkpoint and every sample have the bits of a run that was left alone.

Appends to people.jsonl and writes people.md under ``--out`` (benchmarks/results).
"""

from __future__ import annotations

import json
import os
import pathlib
import random
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402

import rbd_jax as rbd  # noqa: E402
from rbd_jax.record import clip  # noqa: E402
from rbd_jax.view import write_html  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parents[1]
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


# --- the first ten minutes ---


def walk(smoke: bool, scratch: pathlib.Path) -> list[dict]:
    page = (ROOT / "README.md").read_text()
    command = re.search(r"^## Run it\n.*?```sh\n(.*?)\n```", page, re.M | re.S).group(1)
    lines = re.search(r"^## Twelve lines\n.*?```python\n(.*?)```", page, re.M | re.S).group(1)
    clone = scratch / "rbd_jax"
    subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
    (clone / "twelve.py").write_text(lines)
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")} | {"MPLBACKEND": "agg"}
    activate = ". .venv/bin/activate && "
    steps = [
        ("the README's first command", command),
        ("its twelve lines", activate + "python twelve.py"),
        ("the first notebook", activate + "pip install -q -e '.[viz]' && python notebooks/1_first_drop.py"),
    ]
    rows = []
    for title, text in steps:
        begin = time.perf_counter()
        done = subprocess.run(["bash", "-c", text], cwd=clone, env=env, capture_output=True, text=True)
        rows.append({"what": title, "seconds": time.perf_counter() - begin, "ok": done.returncode == 0,
                     "said": done.stderr.strip()[-300:] if done.returncode else ""})  # fmt: skip
    total = sum(r["seconds"] for r in rows)
    missing = [f for f in ("out.npz", "out.html", "out.png") if not (clone / f).is_file()]
    good = all(r["ok"] for r in rows) and not missing
    return [*rows, {"what": "all of it", "seconds": total, "bar_s": 600.0, "ok": good and total <= 600.0}]


# --- the page ---


def heap(n: int) -> rbd.Scene:
    """Boxes and balls that rain on a plane between four walls."""
    draw = np.random.default_rng(0)
    bodies = []
    for k in range(n):
        shape = rbd.Box((0.1, 0.08, 0.06)) if k % 2 else rbd.Sphere(0.09)
        layer, place = divmod(k, 16)
        at = (0.5 * (place % 4) - 0.75, 0.5 * (place // 4) - 0.75, 0.3 + 0.35 * layer)
        at = tuple(np.asarray(at) + draw.uniform(-0.05, 0.05, 3))
        bodies.append(rbd.Body(f"b{k}", shape, pos=at, omega=tuple(draw.normal(size=3)), density=1000.0, friction=0.5))
    half = 0.5**0.5
    walls = [((-1, 0, 0), (half, 0, half, 0)), ((1, 0, 0), (half, 0, -half, 0)),
             ((0, -1, 0), (half, -half, 0, 0)), ((0, 1, 0), (half, half, 0, 0))]  # fmt: skip
    static = [rbd.Geom(rbd.Plane(), friction=0.5)]
    static += [rbd.Geom(rbd.Plane(), pos=pos, quat=quat, friction=0.5) for pos, quat in walls]
    return rbd.Scene(bodies, static, dt=1 / 240)


def opened(browser: str, address: str, scratch: pathlib.Path, budget: int = 300) -> tuple[float, str]:
    """Wall seconds of a browser that opens a page, draws it and goes; what the page is then.

    budget: of the page's own time [ms], which stands still while the processor works.
    """
    begin = time.perf_counter()
    done = subprocess.run(
        [browser, "--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
         "--enable-unsafe-swiftshader", f"--user-data-dir={scratch / 'profile'}", f"--virtual-time-budget={budget}",
         "--window-size=1280,800", "--dump-dom", address],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    return time.perf_counter() - begin, done.stdout


def page(smoke: bool, scratch: pathlib.Path) -> list[dict]:
    bodies, seconds, repeats = (6, 0.5, 1) if smoke else (100, 10.0, 5)
    model, state = rbd.build(heap(bodies), method="fast")
    final, traj = rbd.rollout(model, state, round(seconds * 240), every=4)
    rbd.check(final)
    file = scratch / "page.html"
    begin = time.perf_counter()
    write_html(clip(model, traj, title=f"{bodies} bodies, {seconds:g} s"), file)
    size = file.stat().st_size / 1e6
    title = f"{bodies} bodies, {seconds:g} s, {len(traj.time)} samples"
    row = {"what": title, "written_s": time.perf_counter() - begin,
           "megabytes": size, "bar_megabytes": 5.0, "bar_s": 2.0, "opens_s": None, "ok": size <= 5.0}  # fmt: skip
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        return [{**row, "said": f"not opened: none of {', '.join(BROWSERS)} is installed"}]
    empty = scratch / "empty.html"
    empty.write_text("<!doctype html><title>empty</title><p>nothing")
    times = {}
    for name in (empty, file):
        opened(browser, name.as_uri(), scratch)
        got = [opened(browser, name.as_uri(), scratch) for _ in range(repeats)]
        times[name] = statistics.median(t for t, _ in got)
        text = got[-1][1]
    drawn = lambda text: re.search(r'<html[^>]*data-drawn="(\d+)"', text) is not None
    if smoke and not drawn(text):  # a busy processor: the time means nothing, but the page must come
        text = opened(browser, file.as_uri(), scratch, 10_000)[1]
    row |= {"opens_s": times[file] - times[empty], "empty_s": times[empty], "drawn": drawn(text)}
    row["ok"] = row["ok"] and row["drawn"] and (smoke or row["opens_s"] <= 2.0)
    return [row]


# --- killed at random moments ---


def long_case():
    """Boxes and balls that collide: everything that a step remembers matters."""
    box = rbd.Body("box", rbd.Box((0.1, 0.2, 0.1)), pos=(0, 0, 0.3), omega=(1, 2, 3), mass=1.0, friction=0.5)
    ball = rbd.Body("ball", rbd.Sphere(0.1), pos=(0.05, 0, 0.7), vel=(0, 0, -1), mass=1.0, friction=0.5)
    model, state = rbd.build(rbd.Scene([box, ball], [rbd.Plane()], dt=0.005), method="fast")
    noise = np.random.default_rng(0).normal(0, 0.02, (3, 2, 3))
    state = rbd.batch(state, 3)
    return model, state.replace(pos=np.asarray(state.pos) + noise)


def child(checkpoint: str, stream: str, steps: int):
    model, state = long_case()
    return rbd.long_rollout(
        model, state, steps, 5, chunk=20, checkpoint=checkpoint, save_every=0.0, stream=stream,
        report=lambda p: print(p.steps, flush=True),
    )  # fmt: skip


def kills(smoke: bool, scratch: pathlib.Path) -> list[dict]:
    import jax
    import zarr

    wanted, steps = (2, 6_000) if smoke else (20, 60_000)
    env = os.environ | {"PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": str(scratch / "cache")}
    paths = [str(scratch / "c.npz"), str(scratch / "samples")]

    def start():
        again = [sys.executable, __file__, "--child", *paths, str(steps)]
        return subprocess.Popen(again, stdout=subprocess.PIPE, text=True, env=env)

    draw, begin, killed, at = random.Random(1), time.perf_counter(), 0, []
    while killed < wanted:
        process = start()
        first = process.stdout.readline()
        if not first:
            break
        time.sleep(draw.uniform(0.0, 0.5))
        process.kill()
        rest = process.stdout.read().split()
        process.wait()
        killed += process.returncode < 0
        at.append(int((rest or [first])[-1]))
        if process.returncode == 0:
            break
    with start() as process:
        process.stdout.read()
    took = time.perf_counter() - begin
    alone = child(str(scratch / "alone.npz"), str(scratch / "alone"), steps)
    end = child(*paths, steps)  # it was done: what the checkpoint holds
    same = [np.array_equal(a, b, equal_nan=True) for a, b in zip(*map(jax.tree.leaves, (end.final, alone.final)))]
    a, b = (zarr.open_group(p, mode="r") for p in (paths[1], str(scratch / "alone")))
    samples = {n: bool(np.array_equal(a[n][:], b[n][:])) for n in a.array_keys()}
    good = killed == wanted and process.returncode == 0 and all(same) and all(samples.values()) and len(samples) > 0
    return [{"what": f"{steps} steps, killed {killed} times", "killed_after_steps": at, "seconds": took,
             "end_same_bits": all(same), "samples_same_bits": all(samples.values()), "arrays": sorted(samples),
             "bar_kills": wanted, "ok": good}]  # fmt: skip


ROWS = {"walk": walk, "page": page, "kills": kills}


def told(row: dict) -> list:
    figures = {k: v for k, v in row.items() if k not in ("what", "ok", "row", "said", "killed_after_steps", "arrays")}
    text = "; ".join(f"{k} {common.number(v) if not isinstance(v, bool) else v}" for k, v in figures.items())
    return [
        row["row"],
        row["what"],
        text + (f" ({row['said']})" if row.get("said") else ""),
        "ok" if row["ok"] else "MISSED",
    ]


def main(argv=None) -> int:
    argv = sys.argv[1:] if argv is None else argv
    if argv[:1] == ["--child"]:
        child(argv[1], argv[2], int(argv[3]))
        return 0
    parser = common.options(__doc__, "6 bodies, two kills")
    parser.add_argument("--rows", default=",".join(ROWS), metavar="A,B", help=f"of {', '.join(ROWS)}; default all")
    args = parser.parse_args(argv)
    names = args.rows.split(",")
    unknown = [n for n in names if n not in ROWS]
    if unknown:
        parser.error(f"unknown row '{unknown[0]}'; known: {', '.join(ROWS)}")
    out = args.out or common.RESULTS
    env, rows = common.environment(), []
    for name in names:
        with tempfile.TemporaryDirectory() as scratch:
            rows += [{"row": name, **r} for r in ROWS[name](args.smoke, pathlib.Path(scratch))]
        print(json.dumps(common.plain(rows[-1])), flush=True)
    kept = out / "people.jsonl"
    common.append_lines(kept, [{**env, **r} for r in rows])
    newest = {(r["row"], r["what"]): r for r in map(json.loads, kept.read_text().splitlines())}
    newest = sorted(newest.values(), key=lambda r: list(ROWS).index(r["row"]))
    text = ["# What a person waits for and relies on", "", common.header(env),
            "Made by `benchmarks/people.py`; rows of earlier runs have their date.", "",
            common.table(["row", "what", "measured", "", "measured on"],
                         [[*told({k: v for k, v in r.items() if k not in env}), r["date"][:10]] for r in newest]),
            ""]  # fmt: skip
    (out / "people.md").write_text("\n".join(text))
    return 0 if all(r["ok"] for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
