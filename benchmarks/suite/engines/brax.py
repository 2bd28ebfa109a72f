"""Brax: its pipelines "spring" and "positional" on free bodies; float32, all parameters at Brax's defaults.

What its source says and its motion shows:

* Both step by semi-implicit Euler without gyroscopic torque: a torque-free box keeps its angular velocity, at any step.
* Contacts are found by MJX's collision functions, box on box included, and treated once a step, all at the same time;
  a body's impulse is divided by the number of its contacts.
* "spring" adds the Baumgarte velocity, 0.1 penetration / step, to every bounce: restitution is too high at any step.
* "positional" adds up the position corrections of all contacts: a box that slides on its corners hops.
"""

from __future__ import annotations

import functools
import importlib
import warnings
from importlib import metadata, util

import jax
import jax.numpy as jnp
import numpy as np

from ..case import Case, Motion, upright
from ..engine import Engine, Refused, Simulation
from .mjx import fewer_steps, fewer_worlds

#: Worlds of a timed batch on the CPU, of one body and of more: on two cores more are not faster.
MOST, MOST_PILE = 256, 64
COLUMNS = ("pos", "quat", "vel", "omega")


class Brax(Engine):
    name = "brax"
    title = "Brax"
    colour = "#9467BD"
    variants = {
        "spring": "pipeline spring: impulses with Baumgarte stabilisation",
        "positional": "pipeline positional: position-based dynamics",
    }
    widths = ("float32",)
    install = "pip install brax"

    def missing(self) -> str | None:
        return None if util.find_spec("brax") else "not installed"

    def version(self) -> str:
        return metadata.version("brax")

    def load(self, case: Case, variant: str, dt: float, dtype: str) -> Simulation:
        return _Simulation(case, variant, dt)


def mjcf(case: Case) -> str:
    """The case in the elements that Brax reads."""
    digits = lambda values: " ".join(repr(float(v)) for v in values)
    friction = f'friction="{float(case.friction or 0.0)!r} 0 0"'
    lines = [f'<geom type="plane" size="0 0 1" pos="{digits(point)}" quat="{digits(upright(normal))}" {friction}/>'
             for point, normal in case.planes]  # fmt: skip
    for part in case.parts:
        lines.append(
            f'<body><freejoint/><inertial pos="0 0 0" mass="{part.mass!r}" diaginertia="{digits(part.inertia)}"/>'
            f'<geom type="{part.kind}" size="{digits(part.size)}" {friction}/></body>'
        )
    return (
        f'<mujoco><option gravity="{digits(case.gravity)}"/><custom><numeric name="elasticity" '
        f'data="{float(case.restitution or 0.0)!r}"/></custom><worldbody>{"".join(lines)}</worldbody></mujoco>'
    )


class Program:
    """Compiled functions of a scene: JAX keeps one of each per number of worlds. The step is an argument."""

    def __init__(self, text: str, variant: str):
        pipeline = importlib.import_module(f"brax.{variant}.pipeline")
        from brax.base import Motion as Rates, Transform
        from brax.io import mjcf as reader

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that Brax is not maintained any more
            try:
                system = reader.loads(text)
            except NotImplementedError as error:
                raise Refused(str(error).split("\n")[0]) from error
        act = jnp.zeros(0)

        def first(pos, quat, vel, omega):
            state = pipeline.init(system, jnp.zeros(system.nq).at[3::7].set(1.0), jnp.zeros(system.nv))
            x, xd = Transform(pos=pos, rot=quat), Rates(vel=vel, ang=omega)
            return state.replace(x=x, xd=xd, x_i=x, xd_i=xd)

        def advance(dt, state, steps):
            at = system.replace(opt=system.opt.replace(timestep=dt))
            return jax.lax.fori_loop(0, steps, lambda _, s: pipeline.step(at, s, act), state)

        self.start, self.after = first, advance  # of one world
        self.first = jax.jit(jax.vmap(first))
        self.advance = jax.jit(jax.vmap(advance, in_axes=(None, 0, None)))


_program = functools.lru_cache(maxsize=8)(Program)


class _Simulation(Simulation):
    def __init__(self, case, variant, dt):
        self.dt, self.most = dt, MOST if len(case.parts) == 1 else MOST_PILE
        self.step = jnp.asarray(dt, jnp.float32)
        self.program = _program(mjcf(case), variant)

    def _first(self, start):
        return self.program.first(*(jnp.asarray(getattr(start, k)[0], jnp.float32) for k in COLUMNS))

    def motion(self, start, samples, steps_a_sample):
        state = self._first(start)
        seen = [_columns(state)]
        for _ in range(samples):
            state = self.program.advance(self.step, state, steps_a_sample)
            seen.append(_columns(state))
        columns = [np.stack([np.asarray(c, np.float64) for c in column]) for column in zip(*seen)]
        return Motion(self.dt * steps_a_sample * np.arange(samples + 1), *columns)

    def timer(self, start, steps):
        """On the CPU at most 256 worlds (64 of several bodies), and steps for a call of about 0.3 s."""
        worlds = fewer_worlds(start.pos.shape[1], self.most)
        state = self._first(start.worlds(worlds))
        run = lambda steps: jax.block_until_ready(self.program.advance(self.step, state, steps))
        steps = fewer_steps(run, steps)
        return functools.partial(run, steps), worlds, steps


def _columns(state):
    """Of the centres of mass, in the world frame."""
    return state.x_i.pos, state.x_i.rot, state.xd_i.vel, state.xd_i.ang


ENGINE = Brax()
