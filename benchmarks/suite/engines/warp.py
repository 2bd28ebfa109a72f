"""MuJoCo Warp: MuJoCo's model on one CUDA device; float32, Euler, elliptic cone, Newton with MuJoCo's own tolerance.

A step is captured as a CUDA graph and launched once per step, as its documentation advises.
"""

from __future__ import annotations

import functools
from importlib import metadata, util

import mujoco
import numpy as np

from rbd_jax.mjcf import compile_mujoco

from ..case import Case, Motion
from ..engine import Engine, Simulation
from .mujoco import from_free_joints, to_free_joints
from .mujoco_law import contact

#: Contacts of one world that memory is held for, per body.
CONTACTS = 16


class Warp(Engine):
    name = "warp"
    title = "MuJoCo Warp"
    colour = "#17BECF"
    variants = {"default": "Euler, elliptic cone, Newton, default contact (damping tuned to the restitution)"}
    widths = ("float32",)
    install = "pip install mujoco-warp"

    def missing(self) -> str | None:
        if not (util.find_spec("warp") and util.find_spec("mujoco_warp")):
            return "not installed"
        import warp

        return None if warp.is_cuda_available() else "no CUDA device"

    def version(self) -> str:
        return metadata.version("mujoco-warp")

    def load(self, case: Case, variant: str, dt: float, dtype: str) -> Simulation:
        return _Simulation(case, dt)


class _Simulation(Simulation):
    def __init__(self, case, dt):
        import mujoco_warp

        self.dt = dt
        self.host, self.data = compile_mujoco(case.scene())
        self.host.opt.timestep = dt
        self.host.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        self.host.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        self.host.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        self.host.geom_solref[:], self.host.geom_solimp[:] = contact(case, dt, rigid=False)
        self.model = mujoco_warp.put_model(self.host)
        self.contacts = CONTACTS * len(case.parts)
        self._batch = functools.cache(lambda worlds: _Batch(self, worlds))

    def _at(self, start):
        batch = self._batch(start.pos.shape[1])
        batch.set(*to_free_joints(start.pos[0], start.quat[0], start.vel[0], start.omega[0]))
        return batch

    def motion(self, start, samples, steps_a_sample):
        batch = self._at(start)
        seen = [batch.read()]
        for _ in range(samples):
            batch.step(steps_a_sample)
            seen.append(batch.read())
        qpos, qvel = (np.stack(column) for column in zip(*seen))
        return Motion(self.dt * steps_a_sample * np.arange(samples + 1), *from_free_joints(qpos, qvel))

    def timer(self, start, steps):
        """Every call goes back to the start, in two copies."""
        worlds = start.pos.shape[1]
        batch = self._batch(worlds)
        state = to_free_joints(start.pos[0], start.quat[0], start.vel[0], start.omega[0])

        def call():
            batch.set(*state)
            batch.step(steps)

        return call, worlds, steps

    def close(self):
        self._batch.cache_clear()


class _Batch:
    """Data of so many worlds and, on a CUDA device, the graph of one step."""

    def __init__(self, simulation, worlds):
        import mujoco_warp
        import warp

        room = {"nconmax": simulation.contacts, "njmax": 4 * simulation.contacts}
        self.warp, self.data = warp, mujoco_warp.put_data(simulation.host, simulation.data, nworld=worlds, **room)
        self.once = lambda: mujoco_warp.step(simulation.model, self.data)
        if warp.get_device().is_cuda:
            self.once()  # compiles what a capture must find compiled
            with warp.ScopedCapture() as capture:
                self.once()
            self.once = lambda: warp.capture_launch(capture.graph)

    def set(self, qpos, qvel):
        self.data.qpos.assign(np.asarray(qpos, np.float32))
        self.data.qvel.assign(np.asarray(qvel, np.float32))
        self.data.qacc_warmstart.zero_()

    def step(self, steps):
        for _ in range(steps):
            self.once()
        self.warp.synchronize()

    def read(self):
        return self.data.qpos.numpy().astype(np.float64), self.data.qvel.numpy().astype(np.float64)


ENGINE = Warp()
