"""Two processes give what one gives, bit for bit."""

import os
import pathlib
import socket
import subprocess
import sys
import textwrap

import numpy as np
import pytest

import rbd_jax as rbd

ROOT = pathlib.Path(__file__).parents[1]
WORLDS = 100  # shares of 64 and 36

CHILD = """
    import sys
    import jax
    import numpy as np
    import rbd_jax as rbd

    count, mine, port, out = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], sys.argv[4]
    if count > 1:
        jax.distributed.initialize(f"localhost:{port}", count, mine)
    ball = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 0.3), vel=(1, 0, 0), mass=1.0, friction=0.5, restitution=0.5)
    model, state = rbd.build(rbd.Scene(bodies=[ball], static=[rbd.Plane()]), method="fast")
    vel = np.random.default_rng(0).normal(size=(100, 1, 3)).astype(np.float32)
    share = rbd.my_worlds(100)
    mine_of = vel[share]
    states = rbd.batch(state, len(mine_of)).replace(vel=mine_of)
    final, traj = rbd.rollout(model, states, 60, every=20)
    got = rbd.gathered((final.pos, final.vel, traj.quat))
    np.savez(out, *got)
    print(jax.process_count(), share)
"""


def run(count, tmp_path):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    env = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    outs = [tmp_path / f"{count}_{k}.npz" for k in range(count)]
    code = textwrap.dedent(CHILD)
    children = [
        subprocess.Popen([sys.executable, "-c", code, str(count), str(k), port, str(out)], stdout=subprocess.PIPE,
                         stderr=subprocess.PIPE, text=True, env=env)
        for k, out in enumerate(outs)
    ]  # fmt: skip
    said = [child.communicate(timeout=240) for child in children]
    assert all(child.returncode == 0 for child in children), said
    return [dict(np.load(out)) for out in outs], [out for out, _ in said]


def test_two_processes_are_one(tmp_path):
    (alone,), _ = run(1, tmp_path)
    both, said = run(2, tmp_path)
    assert "slice(0, 64" in said[0] and "slice(64, 100" in said[1]
    for got in both:
        assert set(got) == set(alone)
        for name in alone:
            assert np.array_equal(got[name], alone[name])


def test_shares_are_checked(monkeypatch):
    import jax

    assert rbd.my_worlds(7) == slice(0, 7)
    monkeypatch.setattr(jax, "process_count", lambda: 4)
    monkeypatch.setattr(jax, "process_index", lambda: 3)
    assert rbd.my_worlds(1000) == slice(768, 1000)
    for bad in (0, -1, 1.5, True):
        with pytest.raises(ValueError, match="must be an integer >= 1"):
            rbd.my_worlds(bad)
    with pytest.raises(ValueError, match="96 worlds cannot be shared by 4 processes in parts of 32"):
        rbd.my_worlds(96)
