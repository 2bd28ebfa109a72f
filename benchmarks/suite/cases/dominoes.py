"""Dominoes: the wave has no closed form; the truth is our own run at a tiny step, checked at twice that step."""

from __future__ import annotations

import functools
import json
import pathlib

import numpy as np

import rbd_jax as rbd

from ..case import Case, Motion, box
from .free import STEPS, G
from .impact import GROUND

COUNT, HALF, SPACING, SPIN = 8, (0.05, 0.125, 0.25), 0.25, 2.0
SECONDS, SAMPLES = 2.0, 100
FINE = 1 / 4000
KEPT = pathlib.Path(__file__).with_suffix(".json")
#: A domino has fallen when its axis leans by this angle [rad].
FALLEN = np.pi / 6


def starts(n, rng):
    pos = np.zeros((n, COUNT, 3))
    pos[..., 0], pos[..., 2] = SPACING * np.arange(COUNT), HALF[2]
    vel, omega = np.zeros((n, COUNT, 3)), np.zeros((n, COUNT, 3))
    spin = SPIN * rng.uniform(0.9, 1.1, n)
    omega[:, 0, 1], vel[:, 0, 0], vel[:, 0, 2] = spin, spin * HALF[2], spin * HALF[0]
    return pos, np.broadcast_to([1.0, 0, 0, 0], (n, COUNT, 4)), vel, omega


def fallen_at(motion: Motion) -> np.ndarray:
    """(B,) time at which the last domino but one leans by FALLEN, between samples; infinite if it never does."""
    lean = np.arccos(np.clip(1 - 2 * (motion.quat[:, :, -2, 1] ** 2 + motion.quat[:, :, -2, 2] ** 2), -1, 1))
    out = np.full(lean.shape[1], np.inf)
    for world in range(lean.shape[1]):
        over = np.nonzero(lean[:, world] > FALLEN)[0]
        if len(over) and over[0]:
            k = over[0]
            low, high = lean[k - 1, world], lean[k, world]
            part = (FALLEN - low) / (high - low)
            out[world] = motion.time[k - 1] + part * (motion.time[k] - motion.time[k - 1])
    return out


def times_at(dt: float) -> list[float]:
    """Times of the default start states by "accurate" in float64 at ``dt`` [s]."""
    import jax

    start = CASE.start()
    with jax.enable_x64(True):
        model, one = rbd.build(CASE.scene(), dt=dt, method="accurate")
        arrays = {k: getattr(start, k)[0] for k in ("pos", "quat", "vel", "omega")}
        every = round(SECONDS / SAMPLES / dt)
        state = rbd.batch(one, CASE.worlds).replace(**arrays)
        _, traj = rbd.rollout(model, state, every * SAMPLES, every=every)
    columns = (np.moveaxis(np.asarray(getattr(traj, k), np.float64), 1, 0) for k in ("pos", "quat", "vel", "omega"))
    return fallen_at(Motion(np.linspace(0, SECONDS, SAMPLES + 1)[1:], *columns)).tolist()


@functools.cache
def reference() -> np.ndarray:
    """``times_at(FINE)``, which takes a minute and is kept in a file; ``python -m suite.cases.dominoes`` makes it."""
    kept = json.loads(KEPT.read_text())
    return np.array(kept["seconds"])


def error(motion, other, case):
    exact = reference()[: motion.pos.shape[1]]
    return np.abs(fallen_at(motion) / exact - 1)


CASE = Case(
    name="dominoes", title="eight dominoes", group="pile", parts=(box(HALF),) * COUNT, planes=GROUND, friction=0.5,
    restitution=None, gravity=G, starts=starts, seconds=SECONDS, samples=SAMPLES, truth=None,
    reference="our own run at 1/4000 s in float64, against 1/2000 s", bound=5e-3, error=error,
    unit="time at which the seventh falls, relative", distance=None, steps=STEPS,
    features=frozenset({"contact", "friction", "attitude", "pairs"}),
)  # fmt: skip
CASES = (CASE,)


if __name__ == "__main__":
    fine, half = times_at(FINE), times_at(2 * FINE)
    bound = float(np.abs(np.array(half) / np.array(fine) - 1).max())
    KEPT.write_text(json.dumps({"dt": FINE, "seconds": fine, "at_twice_dt": half, "bound": bound}, indent=1) + "\n")
    print(f"bound {bound:.2g}; wrote {KEPT}")
