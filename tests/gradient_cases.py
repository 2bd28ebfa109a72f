"""Closed forms of derivatives, as data: every case is a scene, a function of few numbers and the matrix it must have.

``test_gradient_contract`` asserts them and records what was found (``--junitxml``). Formulas: ballistic
flight, Newton's law of impact at the instant of the impact (the derivative across an impact is the saltation matrix
D_x r + (f+ - D_x r f-) n' / (n' f-)), Coulomb friction.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import rbd_jax as rbd

G = 9.81
#: Step sizes of cases that converge with the step [s].
COARSE = (1 / 60, 1 / 240)


@dataclasses.dataclass(frozen=True)
class Case:
    """One scene with everything that is asked of its derivatives.

    Attributes:
      event: what happens. outputs, inputs: names of what ``function(dt)(inputs)`` returns and takes.
      points: the inputs at which derivatives are taken.
      truth: inputs -> outputs, the closed form; its Jacobian is found by differentiating it.
      text: the closed form in words.
      bar: allowed error, relative to the largest entry of the row.
      steps: sizes [s]; bars hold at the last, and with ``order`` the error falls at least like dt^order.
      reverse: whether reverse mode is compared with forward mode too.
    """

    event: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    points: tuple[tuple[float, ...], ...]
    function: Callable
    truth: Callable
    text: str
    bar: float = 1e-8
    steps: tuple[float, ...] = (1 / 240,)
    order: float | None = None
    reverse: bool = False


def rollout(scene, dt, seconds, change, read, method="gradient", control=None):
    """inputs -> read(final state) after ``seconds``, from ``change(model, state, inputs)``."""
    model, state = rbd.build(scene, dt=dt, method=method)
    steps = round(seconds / dt)

    @jax.jit
    def run(inputs):
        m, s, *wrench = change(model, state, inputs)
        final, _ = rbd.rollout(m, s, steps, every=max(steps, 1), control=wrench[0] if wrench else None)
        return jnp.stack(read(final))

    return run


def _ball(pos=(0, 0, 1.0), e=None, mu=None, radius=0.1, name="ball"):
    return rbd.Body(name, rbd.Sphere(radius), pos=pos, mass=1.0, friction=mu, restitution=e)


# --- scenes ---


def _flight(dt):
    scene = rbd.Scene([_ball()], gravity=(0, 0, -G))
    change = lambda m, s, i: (m.replace(gravity=jnp.stack([0 * i[1], 0 * i[1], -i[1]])), s.replace(vel=_along(2, i[0])))
    return rollout(scene, dt, 1.0, change, lambda f: (f.pos[0, 2],))


def _along(axis, value):
    return jnp.zeros((1, 3)).at[0, axis].set(value)


def _bounce(dt, gravity, seconds):
    """Inputs: height of the centre over its rest, upward speed, restitution."""
    scene = rbd.Scene([_ball(e=0.8)], [rbd.Plane()], gravity=(0, 0, -gravity) if gravity else None)

    def change(m, s, i):
        return m.replace(restitution=i[2] * jnp.ones_like(m.restitution)), s.replace(
            pos=_along(2, 0.1 + i[0]), vel=_along(2, i[1])
        )

    return rollout(scene, dt, seconds, change, lambda f: (f.pos[0, 2] - 0.1, f.vel[0, 2]))


def _drop(i, seconds, bounces):
    """Height and speed after ``bounces`` bounces."""
    z, v, e = i
    left = seconds
    for _ in range(bounces):
        s = jnp.sqrt(v * v + 2 * G * z)
        left, z, v = left - (v + s) / G, 0.0, e * s
    return jnp.stack([z + v * left - 0.5 * G * left**2, v - G * left])


def _two(dt):
    """Oblique impact of two spheres without gravity. Inputs: sideways offset, closing speed."""
    bodies = [
        _ball((0, 0, 0), 0.5, None, 0.1, "a"),
        dataclasses.replace(_ball((1, 0, 0), 0.5, None, 0.2, "b"), mass=3.0),
    ]
    scene = rbd.Scene(bodies, gravity=None)

    def change(m, s, i):
        return m, s.replace(
            pos=jnp.array([[0.0, 0, 0], [0.5, 0, 0]]).at[1, 1].set(i[0]), vel=jnp.zeros((2, 3)).at[0, 0].set(i[1])
        )

    return rollout(scene, dt, 0.3, change, lambda f: (f.pos[0, 0], f.pos[0, 1], f.vel[1, 0], f.vel[1, 1]))


def _two_truth(i, seconds=0.3):
    y, u = i
    t = (0.5 - jnp.sqrt(0.09 - y * y)) / u
    n = jnp.stack([0.5 - u * t, y]) / 0.3
    J = (1 + 0.5) * 0.75 * u * n[0] * n
    va, vb = jnp.stack([u, 0.0 * u]) - J, J / 3.0
    x = jnp.stack([u * t, 0.0 * u]) + va * (seconds - t)
    return jnp.concatenate([x, vb])


def _roll_truth(i):
    v, mu, F = i
    t = 2 * v / (7 * mu * G)
    rolling = 5 / 7 * F  # m = 1
    speed = 5 / 7 * v + 0 * mu
    x = v * t - 0.5 * mu * G * t**2 + speed * (1 - t)
    return jnp.stack([x + 0.5 * rolling, speed + rolling])


def slider(dt, seconds, method="gradient", body=None):
    """A mass point with friction: a ball that can hardly be turned, or ``body``. Inputs: speed, friction, force."""
    body = body or dataclasses.replace(_ball((0, 0, 0.1), mu=0.5), inertia=(1e9, 1e9, 1e9))
    scene = rbd.Scene([body], [rbd.Geom(rbd.Plane(), friction=0.5)], gravity=(0, 0, -G))

    def change(m, s, i):
        wrench = rbd.Wrench(_along(0, i[2]))
        return m.replace(friction=i[1] * jnp.ones_like(m.friction)), s.replace(vel=_along(0, i[0])), wrench

    return rollout(scene, dt, seconds, change, lambda f: (f.pos[0, 0], f.vel[0, 0]), method)


def _slides(seconds, given, body=None):
    """``slider`` with some of its inputs given, as (dt) -> function of the others."""

    def at(dt):
        run = slider(dt, seconds, body=body)

        def f(i):
            free = iter(i)
            return run(jnp.stack([next(free) if x is None else jnp.asarray(x, float) for x in given]))

        return f

    return at


def _landed(dt):
    """A ball without restitution after it has landed. Inputs: height over its rest, upward speed."""
    scene = rbd.Scene([_ball()], [rbd.Plane()])
    change = lambda m, s, i: (m, s.replace(pos=_along(2, 0.1 + i[0]), vel=_along(2, i[1])))
    return rollout(scene, dt, 1.0, change, lambda f: (f.pos[0, 2], f.vel[0, 2]))


CASES = {
    "flight": Case(
        "free flight",
        ("v0", "g"),
        ("z",),
        ((1.0, G),),
        _flight,
        lambda i: jnp.stack([1.0 + i[0] - 0.5 * i[1]]),
        "z = z0 + v0 T - g T^2 / 2",
        1e-12,
    ),
    "mirror": Case(
        "bounce without gravity",
        ("z0", "v0", "e"),
        ("z", "v"),
        ((1.0, -2.0, 1.0), (1.0, -2.0, 0.6)),
        functools.partial(_bounce, gravity=0.0, seconds=1.0),
        lambda i: jnp.stack([-i[2] * (i[0] + i[1]), -i[2] * i[1]]),
        "z = -e (z0 + v0 T)",
    ),
    "drop": Case(
        "drop with one bounce",
        ("z0", "v0", "e"),
        ("z", "v"),
        ((1.0, 0.0, 0.7), (0.8, 0.5, 0.9)),
        functools.partial(_bounce, gravity=G, seconds=0.75),
        functools.partial(_drop, seconds=0.75, bounces=1),
        "dz/dz0 = (1 + e) g tau / s - e, dz/de = s tau, ...",
    ),
    "twice": Case(
        "drop with two bounces",
        ("z0", "v0", "e"),
        ("z", "v"),
        ((1.0, 0.0, 0.8),),
        functools.partial(_bounce, gravity=G, seconds=1.5),
        functools.partial(_drop, seconds=1.5, bounces=2),
        "two saltations",
        1e-10,
        (1 / 60, 1 / 240),
    ),
    "spheres": Case(
        "oblique collision of two spheres",
        ("offset", "speed"),
        ("xA", "yA", "vxB", "vyB"),
        ((0.15, 3.0),),
        _two,
        _two_truth,
        "normal at the impact, which depends on its instant",
        1e-10,
        (1 / 10,),
        reverse=True,
    ),
    "roll": Case(
        "slip to roll",
        ("v0", "mu"),
        ("x", "v"),
        ((2.0, 0.3),),
        _slides(1.0, (None, None, 0.0), _ball((0, 0, 0.1), mu=0.3)),
        lambda i: _roll_truth(jnp.concatenate([i, jnp.zeros(1)])),
        "dv/dv0 = 5/7, dv/dmu = 0, dx/dmu = -2 v0^2 / (49 mu^2 g)",
        5e-3,
        steps=COARSE,
        order=0.8,
    ),
    "rolling": Case(
        "rolling, pushed at the centre",
        ("F",),
        ("x", "v"),
        ((0.5,),),
        _slides(1.0, (0.0, 0.3, None), _ball((0, 0, 0.1), mu=0.3)),
        lambda i: jnp.stack([5 / 14 * i[0], 5 / 7 * i[0]]),
        "dx/dF = 5 T^2 / (14 m)",
        5e-3,
        steps=COARSE,
        order=0.8,
    ),
    "slide": Case(
        "sliding",
        ("v0", "mu"),
        ("x", "v"),
        ((2.0, 0.5),),
        _slides(0.25, (None, None, 0.0)),
        lambda i: jnp.stack([0.25 * i[0] - 0.5 * i[1] * G * 0.0625, i[0] - i[1] * G * 0.25]),
        "dx/dv0 = T, dx/dmu = -g T^2 / 2",
        1e-6,
        steps=COARSE,
        order=0.8,
    ),
    "stop": Case(
        "slide to stop, then stick",
        ("v0", "mu"),
        ("x", "v"),
        tuple((v, 0.5) for v in np.linspace(1.8, 2.2, 12).tolist()),  # stops at another part of a step
        _slides(1.0, (None, None, 0.0)),
        lambda i: jnp.stack([i[0] ** 2 / (2 * i[1] * G), 0.0 * i[0]]),
        "dx/dv0 = v0 / (mu g), dx/dmu = -v0^2 / (2 mu^2 g)",
        2e-2,
        steps=COARSE,
        order=0.8,
    ),
    "push": Case(
        "pushed above the limit of friction",
        ("mu", "F"),
        ("x", "v"),
        ((0.5, 8.0),),
        _slides(0.5, (0.0, None, None)),
        lambda i: jnp.stack([0.125 * (i[1] - i[0] * G), 0.5 * (i[1] - i[0] * G)]),
        "dx/dF = T^2 / (2 m), dx/dmu = -g T^2 / 2",
        1e-6,
        steps=COARSE,
        order=0.8,
    ),
    "landed": Case(
        "inelastic landing, then rest",
        ("z0", "v0"),
        ("z", "v"),
        ((0.5, 0.3),),
        _landed,
        lambda i: 0.0 * jnp.stack([i[0], i[1]]) + jnp.array([0.1, 0.0]),
        "dz/dz0 = dz/dv0 = 0",
        1e-8,
    ),
}


def jacobians(case: Case, dt: float, reverse: bool):
    """Forward Jacobian and truth at every point, (points, outputs, inputs), and the difference to reverse mode."""
    f = case.function(dt)
    points = [jnp.asarray(p, float) for p in case.points]
    forward, truth = jax.jit(jax.jacfwd(f)), jax.jacfwd(case.truth)
    found, true = (np.stack([np.asarray(J(p)) for p in points]) for J in (forward, truth))
    if not reverse:
        return found, true, None
    weights = np.linspace(1.0, 2.0, len(case.outputs))
    back = jax.jit(jax.grad(lambda i: f(i) @ weights))(points[0])
    return found, true, np.abs(back - weights @ found[0]).max()


def error(found, truth) -> float:
    """Largest difference, relative to the largest entry of its row of the truth (1 where the row is zero)."""
    scale = np.abs(truth).max(axis=-1, keepdims=True)
    return float((np.abs(found - truth) / np.where(scale > 0, scale, 1.0)).max())
