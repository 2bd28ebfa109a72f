"""Long runs: the bits of an undisturbed rollout, whatever ends them and whenever."""

import os
import pathlib
import random
import signal
import subprocess
import sys
import textwrap
import time

import jax
import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax import longrun
from rbd_jax.longrun import SaveFailed, long_rollout

ROOT = pathlib.Path(__file__).parents[1]
WORLDS, STEPS, EVERY, CHUNK = 3, 100, 5, 20


def build(dt=0.005):
    """Boxes and balls that collide: everything that a step remembers matters."""
    box = rbd.Body("box", rbd.Box((0.1, 0.2, 0.1)), pos=(0, 0, 0.3), omega=(1, 2, 3), mass=1.0, friction=0.5)
    ball = rbd.Body("ball", rbd.Sphere(0.1), pos=(0.05, 0, 0.7), vel=(0, 0, -1), mass=1.0, friction=0.5)
    scene = rbd.Scene(bodies=[box, ball], static=[rbd.Plane()], dt=dt)
    model, state = rbd.build(scene, method="fast")
    noise = np.random.default_rng(0).normal(0, 0.02, (WORLDS, 2, 3))
    state = rbd.batch(state, WORLDS)
    return model, state.replace(pos=np.asarray(state.pos) + noise)


@pytest.fixture(scope="module")
def case():
    model, state = build()
    chunks = [state]
    for _ in range(STEPS // CHUNK):
        chunks.append(rbd.rollout(model, chunks[-1], CHUNK, every=CHUNK)[0])
    return model, state, chunks[-1]


def same(a, b):
    return all(np.array_equal(x, y, equal_nan=True) for x, y in zip(*map(jax.tree.leaves, (a, b))))


def test_it_is_the_rollout(case, tmp_path):
    model, state, end = case
    seen = []
    run = long_rollout(model, state, STEPS, chunk=CHUNK, report=seen.append, checkpoint=tmp_path / "c.npz")
    assert same(run.final, end) and run.steps == STEPS and not run.interrupted and run.diverged == ()
    assert [p.steps for p in seen] == list(range(CHUNK, STEPS + 1, CHUNK)) and seen[-1].left == 0
    assert seen[-1].simulated == pytest.approx(0.5) and "100/100 steps" in str(seen[-1])
    again = long_rollout(model, state, STEPS, chunk=CHUNK, checkpoint=tmp_path / "c.npz")
    assert same(again.final, end)  # it was done


@pytest.mark.parametrize("stop", [1, 3, 4])
def test_ctrl_c_saves_and_the_rest_has_the_same_bits(case, tmp_path, stop):
    model, state, end = case
    path = tmp_path / "c.npz"

    def press(progress):
        if progress.steps == stop * CHUNK:
            signal.raise_signal(signal.SIGINT)

    run = long_rollout(model, state, STEPS, chunk=CHUNK, checkpoint=path, report=press)
    assert run.interrupted and run.steps == stop * CHUNK and os.listdir(tmp_path) == ["c.npz"]
    # a checkpoint knows its chunks, whatever is asked for now
    rest = long_rollout(model, state, STEPS, chunk=10, checkpoint=path)
    assert same(rest.final, end) and not rest.interrupted
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_ctrl_c_ends_it_at_once(case):
    model, state, _ = case

    def twice(progress):
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        long_rollout(model, state, STEPS, chunk=CHUNK, report=twice)


CHILD = """
    import sys, jax
    sys.path.insert(0, {tests!r})
    from test_longrun import build, STEPS, EVERY
    from rbd_jax.longrun import long_rollout
    model, state = build()
    steps = 60 * STEPS
    run = long_rollout(model, state, steps, EVERY, chunk=20, checkpoint=sys.argv[1], save_every=0.0,
                       stream=sys.argv[2], report=lambda p: print(p.steps, flush=True))
    print("end", flush=True)
"""


def test_killed_at_random_moments(tmp_path):
    """No warning, at any instant: the file is whole, the samples and the end those of a run that was left alone."""
    zarr = pytest.importorskip("zarr")
    code = textwrap.dedent(CHILD.format(tests=str(ROOT / "tests")))
    env = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}
    paths = [str(tmp_path / "c.npz"), str(tmp_path / "s")]

    def start():
        return subprocess.Popen([sys.executable, "-c", code, *paths], stdout=subprocess.PIPE, text=True, env=env)

    rng = random.Random(1)
    for _ in range(2):
        child = start()
        assert child.stdout.readline()
        time.sleep(rng.uniform(0.0, 0.3))
        child.kill()
        child.wait()
        child.stdout.close()
    with start() as child:
        lines = child.stdout.read().split()
    assert lines[-1] == "end" and int(lines[0]) > 20
    model, state = build()
    alone = long_rollout(model, state, 60 * STEPS, EVERY, chunk=20, stream=tmp_path / "alone")
    kept, _ = longrun.load_checkpoint(paths[0], alone.final)
    assert same(kept, alone.final)
    a, b = zarr.open_group(paths[1], mode="r"), zarr.open_group(str(tmp_path / "alone"), mode="r")
    assert set(a.array_keys()) == set(b.array_keys()) == {"pos", "vel", "quat", "omega", "step", "status", "time"}
    for name in a.array_keys():
        assert np.array_equal(a[name][:], b[name][:]), name


def test_samples_are_those_of_the_rollout(case, tmp_path):
    zarr = pytest.importorskip("zarr")
    model, state, _ = case
    for steps in (STEPS, 47, 3):
        at, parts = state, []
        for first in range(0, steps, CHUNK):
            at, part = rbd.rollout(model, at, min(CHUNK, steps - first), every=EVERY)
            parts.append(jax.tree.map(lambda c: c[:, first > 0 :] if np.ndim(c) > 1 else c, part))
        traj = jax.tree.map(lambda *c: np.concatenate(c, 1) if np.ndim(c[0]) > 1 else c[0], *parts)
        long_rollout(model, state, steps, EVERY, chunk=CHUNK, stream=tmp_path / str(steps))
        kept = zarr.open_group(str(tmp_path / str(steps)), mode="r")
        for name in ("pos", "vel", "quat", "omega", "step", "status"):
            # where two chunks meet, the sample is the next one's first: its quaternion is normalised once more
            np.testing.assert_allclose(kept[name][:], getattr(traj, name), rtol=1e-6, atol=1e-5, err_msg=name)
        np.testing.assert_allclose(kept["time"][:], traj.time, atol=1e-6)


def test_a_world_that_is_lost_is_named(case):
    model, state, _ = case
    vel = np.array(state.vel)
    vel[1, 0, 0] = 1e30
    seen = []
    run = long_rollout(model, state.replace(vel=vel), 40, chunk=CHUNK, report=seen.append)
    (gone,) = run.diverged
    assert gone.world == (1,) and gone in seen and "world (1,)" in str(gone)
    assert gone.state.pos.shape == (2, 3) and np.isfinite(gone.state.pos).all() and gone.time <= 0.005


@pytest.mark.parametrize(
    "change, message",
    [
        ({"steps": 50}, "its steps is 100, this one's 50"),
        ({"every": 2}, "its every is 5, this one's 2"),
        ({"dt": 0.004}, "its scene is"),
        ({"worlds": 2}, "do not fit this state"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(case, tmp_path, change, message):
    model, state, _ = case
    path = tmp_path / "c.npz"
    long_rollout(model, state, STEPS, EVERY, chunk=CHUNK, checkpoint=path)
    before = path.read_bytes()
    if "dt" in change:
        model = model.replace(dt=change["dt"])
    if "worlds" in change:
        state = jax.tree.map(lambda c: c[:2] if np.ndim(c) else c, state)
    with pytest.raises(ValueError, match=message):
        long_rollout(model, state, change.get("steps", STEPS), change.get("every", EVERY), checkpoint=path)
    assert path.read_bytes() == before


def test_a_file_that_is_no_checkpoint_is_refused(case, tmp_path, monkeypatch):
    model, state, _ = case
    path = tmp_path / "c.npz"
    for content in (b"", b"nonsense", b"PK\x03\x04 cut off"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="c.npz: not a checkpoint"):
            long_rollout(model, state, STEPS, checkpoint=path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(ValueError, match="c.npz: not a checkpoint"):
        long_rollout(model, state, STEPS, checkpoint=path)
    path.unlink()
    with monkeypatch.context() as newer:
        newer.setattr(longrun, "FORMAT", 2)
        long_rollout(model, state, CHUNK, checkpoint=path)
    with pytest.raises(ValueError, match="format 2 is newer than this rbd_jax reads"):
        long_rollout(model, state, CHUNK, checkpoint=path)


def test_a_full_disk_loses_nothing(case, tmp_path, monkeypatch):
    """The checkpoint that was there stays, and the error holds the state."""
    model, state, end = case
    path = tmp_path / "c.npz"

    def press(progress):
        if progress.steps == CHUNK:
            signal.raise_signal(signal.SIGINT)

    long_rollout(model, state, STEPS, chunk=CHUNK, checkpoint=path, report=press)
    before = path.read_bytes()

    def full(file, **arrays):
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(np, "savez", full)
        with pytest.raises(SaveFailed, match="No space left on device.*step 100 is not saved") as error:
            long_rollout(model, state, STEPS, checkpoint=path)
    assert same(error.value.state, end) and error.value.steps == STEPS
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["c.npz"]
    assert same(long_rollout(model, state, STEPS, checkpoint=path).final, end)


def test_bad_arguments_are_refused(case, tmp_path):
    model, state, _ = case
    for bad, message in (
        ({"steps": -1}, "steps = -1"),
        ({"steps": 10, "every": 0}, "every = 0"),
        ({"steps": 10, "every": 3, "chunk": 10}, "chunk = 10 must be a multiple of every = 3"),
    ):
        with pytest.raises(ValueError, match=message):
            long_rollout(model, state, **bad)
    with pytest.raises(SaveFailed, match="nowhere"):
        long_rollout(model, state, 0, checkpoint=tmp_path / "nowhere" / "c.npz")
    pytest.importorskip("zarr")
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "mine").write_text("x")
    with pytest.raises(ValueError, match="is there already"):
        long_rollout(model, state, 10, stream=tmp_path / "s")
