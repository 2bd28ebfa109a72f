"""MuJoCo MJX: MuJoCo's model in JAX. float32, Euler, elliptic cone, Newton with MuJoCo's own tolerance.

Step and contact softness are leaves of the model and the number of steps is a bound read at run time, so one program
per scene and number of worlds serves a whole sweep. Under ``vmap`` the solver iterates until the last world has
converged. ``put_data`` gives some arrays another dtype than a step returns; they are cast before the first step.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from importlib import metadata, util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rbd_jax.mjcf import to_mjcf

from ..case import Case, Motion
from ..engine import Engine, Refused, Simulation
from .mujoco import from_free_joints, to_free_joints
from .mujoco_law import contact

#: Worlds of a timed batch on the CPU, of one body and of more: on two cores more are not faster.
MOST, MOST_PILE = 256, 16
#: A timed call is cut to about so long [s], but not below so many steps.
LONGEST, FEWEST = 0.3, 2


class MJX(Engine):
    name = "mjx"
    title = "MJX"
    colour = "#E69F00"
    variants = {"default": "Euler, elliptic cone, Newton, default contact (damping tuned to the restitution)"}
    widths = ("float32",)
    install = "pip install 'rbd-jax[mjx]'"

    def missing(self) -> str | None:
        return None if util.find_spec("mujoco.mjx") else "not installed"

    def version(self) -> str:
        return metadata.version("mujoco-mjx")

    def most(self, case: Case) -> int:
        return most(case)

    def load(self, case: Case, variant: str, dt: float, dtype: str) -> Simulation:
        return _Simulation(case, dt)


class _Program:
    """Compiled functions of a scene: JAX keeps one of each per number of worlds."""

    def __init__(self, text: str):
        from mujoco import mjx

        model = mujoco.MjModel.from_xml_string(text)
        # Without friction both cones give the same rows, and MJX 3.17 fails on the elliptic one.
        rubs = (model.geom_condim > 1).any()
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if rubs else mujoco.mjtCone.mjCONE_PYRAMIDAL
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        try:
            self.model = mjx.put_model(model)
            data = mjx.put_data(model, mujoco.MjData(model))
            kinds = jax.eval_shape(mjx.step, self.model, data)
        except NotImplementedError as error:
            raise Refused(str(error).split("\n")[0]) from error

        def first(qpos, qvel):
            full = data.replace(qpos=qpos, qvel=qvel)
            return jax.tree.map(lambda c, kind: jnp.asarray(c, kind.dtype), full, kinds)

        def advance(model, data, steps):
            return jax.lax.fori_loop(0, steps, lambda _, d: mjx.step(model, d), data)

        self.first = jax.jit(jax.vmap(first))
        self.advance = jax.jit(jax.vmap(advance, in_axes=(None, 0, None)))


_program = functools.lru_cache(maxsize=8)(_Program)


class _Simulation(Simulation):
    def __init__(self, case, dt):
        self.dt, self.most = dt, most(case)
        self.program = _program(to_mjcf(case.scene()))
        model, (solref, solimp) = self.program.model, contact(case, dt, rigid=False)
        everywhere = lambda leaf, value: jnp.broadcast_to(jnp.asarray(value, leaf.dtype), leaf.shape)
        self.model = model.replace(
            opt=model.opt.replace(timestep=jnp.asarray(dt, model.opt.timestep.dtype)),
            geom_solref=everywhere(model.geom_solref, solref),
            geom_solimp=everywhere(model.geom_solimp, solimp),
        )

    def _first(self, start):
        qpos, qvel = to_free_joints(start.pos[0], start.quat[0], start.vel[0], start.omega[0])
        kind = self.model.opt.timestep.dtype
        data = self.program.first(jnp.asarray(qpos, kind), jnp.asarray(qvel, kind))
        # Bound to the device as the model is, and so what a step returns; else ``advance`` would be compiled twice.
        return jax.device_put(data, jax.devices()[0])

    def motion(self, start, samples, steps_a_sample):
        data = self._first(start)
        seen = [(data.qpos, data.qvel)]
        for _ in range(samples):
            data = self.program.advance(self.model, data, steps_a_sample)
            seen.append((data.qpos, data.qvel))
        qpos, qvel = (np.stack([np.asarray(c, np.float64) for c in column]) for column in zip(*seen))
        return Motion(self.dt * steps_a_sample * np.arange(samples + 1), *from_free_joints(qpos, qvel))

    def timer(self, start, steps):
        """On the CPU at most 256 worlds (16 of several bodies), and steps for a call of about 0.3 s.

        A cut call sees the beginning of the motion only, where Newton may need more or fewer iterations than later.
        """
        worlds = fewer_worlds(start.pos.shape[1], self.most)
        data = self._first(start.worlds(worlds))
        run = lambda steps: jax.block_until_ready(self.program.advance(self.model, data, steps))
        steps = fewer_steps(run, steps)
        return functools.partial(run, steps), worlds, steps


def most(case: Case) -> int:
    return MOST if len(case.parts) == 1 else MOST_PILE


def fewer_worlds(worlds: int, most: int) -> int:
    """As many worlds as fill the device."""
    return min(worlds, most) if jax.default_backend() == "cpu" else worlds


def fewer_steps(run: Callable[[int], object], steps: int) -> int:
    """Steps, at most these, that ``run`` does in about LONGEST; it is compiled before the clock is read."""
    few = min(steps, FEWEST)
    run(few)
    while True:
        begin = time.perf_counter()
        run(few)
        took = time.perf_counter() - begin
        if took > LONGEST / 20 or few == steps:
            return max(FEWEST, min(steps, int(few * LONGEST / took)))
        few = min(steps, 8 * few)


ENGINE = MJX()
