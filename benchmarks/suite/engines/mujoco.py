"""MuJoCo C through ``mujoco.rollout``: float64, elliptic cone, Newton with its own tolerance, two threads or one."""

from __future__ import annotations

import os

import mujoco
import numpy as np

from ..case import Case, Motion
from ..engine import Engine, Simulation
from ..judge import rotated
from .mujoco_law import contact

KINDS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "rigid": mujoco.mjtIntegrator.mjINT_EULER,
}
#: Numbers kept by one call; a longer one is cut.
STORED = 20_000_000


class MujocoC(Engine):
    name = "mujoco"
    title = "MuJoCo C"
    any_number = True
    colour = "#D55E00"
    variants = {
        "euler": "Euler, default contact (damping tuned to the restitution, where there is one)",
        "implicitfast": "implicitfast, default contact",
        "rk4": "RK4, default contact",
        "rigid": "Euler, contact as rigid as the step bears: solref 2 dt, solimp 0.9999, impratio 100",
    }

    def version(self) -> str:
        return mujoco.__version__

    def load(self, case: Case, variant: str, dt: float, dtype: str) -> Simulation:
        return _Simulation(case, variant, dt)


class _Simulation(Simulation):
    def __init__(self, case, variant, dt):
        import common  # what the benchmarks share

        scene = case.scene()
        self.dt = dt
        self.runs = {1: None, os.cpu_count() or 1: None}
        for threads in self.runs:
            run = common.MuJoCo(scene, dt, threads=threads)
            rigid = variant == "rigid"
            run.model.opt.integrator = KINDS[variant]
            run.model.geom_solref[:], run.model.geom_solimp[:] = contact(case, dt, rigid)
            run.model.opt.impratio = 100 if rigid else 1
            self.runs[threads] = run

    def motion(self, start, samples, steps_a_sample):
        run = self.runs[max(self.runs)]
        qpos, qvel = to_free_joints(start.pos[0], start.quat[0], start.vel[0], start.omega[0])
        q, v = run.run(qpos, qvel, samples * steps_a_sample, every=steps_a_sample)
        times = self.dt * steps_a_sample * np.arange(samples + 1)
        return Motion(times, *from_free_joints(np.moveaxis(q, 1, 0), np.moveaxis(v, 1, 0)))

    def timer(self, start, steps):
        worlds = start.pos.shape[1]
        run = self.runs[1 if worlds == 1 else max(self.runs)]
        steps = max(1, min(steps, STORED // (worlds * run.size)))
        initial = run.initial(*to_free_joints(start.pos[0], start.quat[0], start.vel[0], start.omega[0]))
        arrays = run.allocate(worlds, steps)
        chunk = run.tune(initial, steps) if worlds > 1 else None
        return lambda: run.call(initial, steps, arrays, chunk), worlds, steps

    def close(self):
        for run in self.runs.values():
            run.close()


def to_free_joints(pos, quat, vel, omega):
    """(qpos (B, 7 n), qvel (B, 6 n)) of free joints: MuJoCo's angular velocity is in the body frame."""
    flat = lambda *c: np.concatenate(c, axis=-1).reshape(len(pos), -1)
    return flat(pos, quat), flat(vel, rotated(quat, omega, back=True))


def from_free_joints(qpos, qvel):
    """(pos, quat, vel, omega) of (..., 7 n) and (..., 6 n)."""
    q, v = qpos.reshape(*qpos.shape[:-1], -1, 7), qvel.reshape(*qvel.shape[:-1], -1, 6)
    quat = q[..., 3:] / np.linalg.norm(q[..., 3:], axis=-1, keepdims=True)
    return q[..., :3], quat, v[..., :3], rotated(quat, v[..., 3:])


ENGINE = MujocoC()
