"""Sustained contact: stacks that must stand where rigid bodies do, their forces, a box that tips on its edge."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..case import Case, Motion, box
from ..judge import attitude, position, rest_forces, rotated, times, yaw
from .free import STEPS, G, sample_times
from .impact import GROUND

EDGE = 0.1
MU = 0.6


def stack(name, title, masses):
    """Cubes of half-size 0.1 m that fall 2 mm each, a little out of line; the truth is where they come to rest."""
    n = len(masses)
    exact = EDGE * (2 * np.arange(n) + 1)

    def starts(worlds, rng):
        pos = np.zeros((worlds, n, 3))
        pos[..., :2] = rng.uniform(-0.01, 0.01, (worlds, n, 2))
        pos[..., 2] = exact + 0.002 * np.arange(1, n + 1)
        return pos, yaw(0.1 * rng.normal(size=(worlds, n))), np.zeros((worlds, n, 3)), np.zeros((worlds, n, 3))

    def error(motion, other, case):
        fell = np.linalg.norm(motion.pos[-1, ..., :2] - motion.pos[0, ..., :2], axis=-1) > EDGE
        high = np.abs(motion.pos[-1, ..., 2] - exact).max(-1) / EDGE
        return np.where(fell.any(-1), np.inf, high)

    return Case(
        name=name, title=title, group="rest", parts=tuple(box((EDGE,) * 3, m) for m in masses), planes=GROUND,
        friction=MU, restitution=None, gravity=G, starts=starts, seconds=2.0, samples=4, truth=None,
        reference="heights of rigid cubes at rest", bound=0.0, error=error, unit="heights after 2 s over half-size",
        distance=position, steps=STEPS, features=frozenset({"contact", "friction", "attitude", "pairs"}),
    )  # fmt: skip


def forces(masses):
    """The forces in a column that fell 2 mm, in windows of 20 ms at the end of a second."""
    return dataclasses.replace(
        stack("forces", "forces in a column at rest", masses), seconds=1.0, samples=50, error=rest_forces,
        reference="weights", unit="force over weight, root mean square over windows of 20 ms",
    )  # fmt: skip


# --- a box that tips over its edge on ice ---

WIDE, HIGH, SECONDS = 0.5, 0.25, 0.2


def tipped(n, rng):
    tilt, turn = rng.uniform(0.5, 0.8, (n, 1)), yaw(rng.uniform(-np.pi, np.pi, (n, 1)))
    pos = np.zeros((n, 1, 3))
    pos[..., 2] = WIDE * np.sin(tilt) + HIGH * np.cos(tilt)
    zero = np.zeros_like(tilt)
    about = np.stack([np.cos(tilt / 2), zero, np.sin(tilt / 2), zero], -1)
    return pos, times(turn, about), np.zeros((n, 1, 3)), np.zeros((n, 1, 3))


def tipping(start: Motion, inertia, t) -> Motion:
    """Height a sin + b cos of the tilt; Lagrange's equation of the tilt by DOP853 at 1e-13."""
    from scipy.integrate import solve_ivp

    pos, quat, vel, omega = [], [], [], []
    for q0, p0 in zip(start.quat[0, :, 0], start.pos[0, :, 0]):
        axis = rotated(q0, np.array([0.0, 1.0, 0.0]))
        tilt = np.arccos(np.clip(rotated(q0, np.array([0.0, 0.0, 1.0]))[2], -1, 1))

        def rate(_, y):
            s, c = np.sin(y[0]), np.cos(y[0])
            dy, ddy = WIDE * c - HIGH * s, -WIDE * s - HIGH * c
            return [y[1], -(dy * ddy * y[1] ** 2 + 9.81 * dy) / (dy**2 + inertia[1])]

        y = solve_ivp(rate, (0, t[-1]), [tilt, 0.0], "DOP853", t, rtol=1e-13, atol=1e-13).y
        height = WIDE * np.sin(y[0]) + HIGH * np.cos(y[0])
        half = (y[0] - tilt) / 2
        back = np.concatenate([np.cos(half)[:, None], np.sin(half)[:, None] * axis], -1)
        pos.append(np.stack([0 * t + p0[0], 0 * t + p0[1], height], -1))
        quat.append(times(back, np.broadcast_to(q0, back.shape)))
        vel.append(np.stack([0 * t, 0 * t, (WIDE * np.cos(y[0]) - HIGH * np.sin(y[0])) * y[1]], -1))
        omega.append(y[1][:, None] * axis)
    worlds = lambda a: np.stack(a, 1)[:, :, None]
    return Motion(np.asarray(t), *map(worlds, (pos, quat, vel, omega)))


TIPPING = box((WIDE, 0.3, HIGH))
EDGEWISE = Case(
    name="edge", title="box tips over its edge on ice", group="rest", parts=(TIPPING,), planes=GROUND, friction=None,
    restitution=None, gravity=G, starts=tipped, seconds=SECONDS, samples=2,
    truth=lambda start: tipping(start, TIPPING.inertia, sample_times(SECONDS, 2)),
    reference="Lagrange's equation by DOP853 at 1e-13", bound=1e-11, error=attitude,
    unit="attitude, root mean square [rad]", distance=attitude, steps=STEPS,
    features=frozenset({"contact", "attitude"}),
)  # fmt: skip

CASES = (
    stack("column", "column of two boxes", (1.0, 1.0)),
    forces((4.0, 2.0, 1.0)),
    stack("stack5", "five-box stack", (1.0,) * 5),
    stack("stack10", "ten-box stack", (1.0,) * 10),
    stack("heavy", "100 kg on 1 kg", (1.0, 100.0)),
    EDGEWISE,
)
