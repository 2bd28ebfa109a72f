"""Rollouts farmed out to Ray's workers are those of one process, whatever happens to the workers."""

import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax.farm import TaskFailed

ray = pytest.importorskip("ray")


@pytest.fixture(scope="module")
def cluster():
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, configure_logging=False)
    yield
    ray.shutdown()


def tossed(folder):
    """Balls with a mass and a speed drawn from the task's seed; task 2 takes its worker with it the first time."""

    def simulate(seed):
        import os
        import signal

        import numpy as np

        import rbd_jax as rbd

        if folder is not None:
            (folder / f"{seed}_{os.getpid()}").touch()
            if seed == 2 and not (folder / "killed").exists():
                (folder / "killed").touch()
                os.kill(os.getpid(), signal.SIGKILL)
        draw = np.random.default_rng(seed)
        ball = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 0.3), vel=(1, 0, 0), mass=1.0, friction=0.5)
        model, state = rbd.build(rbd.Scene(bodies=[ball], static=[rbd.Plane()]), method="fast")
        states = rbd.batch(state, 32).replace(vel=draw.normal(size=(32, 1, 3)).astype(np.float32))
        model = model.replace(friction=np.full_like(model.friction, draw.uniform(0.2, 0.8)))
        final, _ = rbd.rollout(model, states, 40, every=40)
        return {"pos": np.asarray(final.pos), "omega": np.asarray(final.omega)}

    return simulate


def test_a_killed_worker_loses_nothing(cluster, tmp_path):
    tasks, told = [5, 2, 7, 1], []
    got = rbd.farm(tossed(tmp_path), tasks, report=lambda done, of: told.append((done, of)))
    assert (tmp_path / "killed").exists() and len(list(tmp_path.glob("2_*"))) == 2, "done again in another process"
    assert told == [(k, 4) for k in (1, 2, 3, 4)], "counted once each"
    for seed, result in zip(tasks, got):
        alone = tossed(None)(seed)
        for name in ("pos", "omega"):
            assert (result[name] == alone[name]).all(), (seed, name)
    assert not (got[0]["pos"] == got[1]["pos"]).all()


def test_a_task_that_fails_keeps_the_others(cluster):
    def halves(task):
        if task == 0:
            import time

            time.sleep(2.0)
        return np.asarray(1.0 / task)

    with pytest.raises(TaskFailed, match=r"task 2 \(0\) failed; 2 of 3 were done.*division by zero") as failed:
        rbd.farm(halves, [4, 2, 0])
    assert failed.value.index == 2 and {k: float(v) for k, v in failed.value.results.items()} == {0: 0.25, 1: 0.5}


@pytest.mark.parametrize("bad", [{"workers": 0}, {"cores": 1.5}, {"retries": -1}])
def test_bad_numbers_are_refused(bad):
    with pytest.raises(ValueError, match=f"farm: {next(iter(bad))} = "):
        rbd.farm(len, [], **bad)
