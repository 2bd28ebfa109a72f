"""Free flight: closed forms, and Euler's equations solved by an explicit Runge-Kutta method of order 8 (DOP853)."""

from __future__ import annotations

import numpy as np

from ..case import Case, Motion, box, sphere
from ..judge import attitude, position, random_quat, rotated, times

G = (0.0, 0.0, -9.81)
STEPS = (1 / 50, 1 / 100, 1 / 200, 1 / 500, 1 / 1000, 1 / 5000)
ATTITUDE = "attitude, root mean square [rad]"


def sample_times(case_seconds, samples):
    return np.linspace(0.0, case_seconds, samples + 1)


# --- parabola ---


def thrown(n, rng):
    return rng.normal(size=(n, 1, 3)), random_quat(rng, n, 1), 3 * rng.normal(size=(n, 1, 3)), np.zeros((n, 1, 3))


def flight(start: Motion, t) -> Motion:
    """Constant acceleration, no rotation."""
    t = np.asarray(t)[:, None, None, None]
    pos = start.pos + start.vel * t + 0.5 * np.array(G) * t * t
    same = lambda a: np.broadcast_to(a, (len(t), *a.shape[1:]))
    return Motion(t.ravel(), pos, same(start.quat), start.vel + np.array(G) * t, same(start.omega))


PARABOLA = Case(
    name="parabola", title="thrown body (no attitude)", group="free", parts=(sphere(0.1),), planes=(), friction=None,
    restitution=None, gravity=G, starts=thrown, seconds=1.0, samples=10,
    truth=lambda start: flight(start, sample_times(1.0, 10)), reference="closed form", bound=1e-15, error=position,
    unit="position, root mean square [m]", distance=position, steps=STEPS, features=frozenset(),
)  # fmt: skip


# --- tops ---


def spun(half, low, high, about=None):
    """Random attitudes and spins of ``low`` to ``high`` rad/s; near the body axis ``about`` where it is given."""

    def starts(n, rng):
        q, w = random_quat(rng, n, 1), rng.normal(size=(n, 1, 3))
        if about is not None:
            w = np.eye(3)[about] + 0.02 * w
        w *= rng.uniform(low, high, (n, 1, 1)) / np.linalg.norm(w, axis=-1, keepdims=True)
        return np.zeros((n, 1, 3)), q, np.zeros((n, 1, 3)), rotated(q, w)

    return starts


def tumbling(start: Motion, inertia, t) -> Motion:
    """Euler's equations and q' = q w / 2, by DOP853 at 1e-13."""
    from scipy.integrate import solve_ivp

    inertia = np.array(inertia)
    quat, omega = [], []
    for q0, w0 in zip(start.quat[0, :, 0], rotated(start.quat, start.omega, back=True)[0, :, 0]):

        def rate(_, y):
            q, w = y[:4], y[4:]
            return np.concatenate([0.5 * times(q, np.concatenate([[0.0], w])), -np.cross(w, inertia * w) / inertia])

        y = solve_ivp(rate, (0, t[-1]), np.concatenate([q0, w0]), "DOP853", t, rtol=1e-13, atol=1e-13).y.T
        q = y[:, :4] / np.linalg.norm(y[:, :4], axis=-1, keepdims=True)
        quat.append(q)
        omega.append(rotated(q, y[:, 4:]))
    stack = lambda a: np.stack(a, 1)[:, :, None]
    still = np.zeros((len(t), *start.pos.shape[1:]))
    return Motion(t, still + start.pos, stack(quat), still, stack(omega))


def spinning(start: Motion, inertia, t) -> Motion:
    """A body with I_x = I_y: precession about L at |L| / I_x, and its own spin (1 - I_z / I_x) w_z."""
    from ..judge import yaw

    a, _, c = inertia
    q, w = start.quat[0], rotated(start.quat, start.omega, back=True)[0]
    momentum = rotated(q, w * np.array(inertia))
    size = np.linalg.norm(momentum, axis=-1, keepdims=True)
    half = size / a * np.asarray(t)[:, None, None, None] / 2
    about = np.concatenate([np.cos(half), np.sin(half) * momentum / size], -1)
    own = (1 - c / a) * w[..., 2] * np.asarray(t)[:, None, None]
    quat = times(times(about, np.broadcast_to(q, about.shape)), yaw(own))
    turned = yaw(own)
    body = rotated(turned, np.broadcast_to(w, quat[..., 1:].shape), back=True)
    still = np.zeros((len(t), *start.pos.shape[1:]))
    return Motion(np.asarray(t), still, quat, still, rotated(quat, body))


def top(name, title, half, starts, seconds=2.0):
    part = box(half)
    grid = sample_times(seconds, 10)
    symmetric = half[0] == half[1]
    law = spinning if symmetric else tumbling
    return Case(
        name=name, title=title, group="free", parts=(part,), planes=(), friction=None, restitution=None,
        gravity=(0.0, 0.0, 0.0), starts=starts, seconds=seconds, samples=10,
        truth=lambda start: law(start, part.inertia, grid),
        reference="closed form" if symmetric else "Euler's equations by DOP853 at 1e-13",
        bound=1e-14 if symmetric else 1e-11, error=attitude, unit=ATTITUDE, distance=attitude, steps=STEPS,
        features=frozenset({"attitude"}),
    )  # fmt: skip


CASES = (
    PARABOLA,
    top("top", "asymmetric top", (0.1, 0.2, 0.3), spun((0.1, 0.2, 0.3), 2.0, 6.0)),
    top("gyro", "fast gyro, 20 rad/s", (0.1, 0.2, 0.3), spun((0.1, 0.2, 0.3), 18.0, 22.0, about=0)),
    top("symmetric", "symmetric top", (0.1, 0.1, 0.2), spun((0.1, 0.1, 0.2), 2.0, 6.0)),
)
