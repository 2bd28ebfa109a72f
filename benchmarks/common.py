"""What the benchmark scripts share: the record of the machine, rows, MuJoCo on many worlds, start states."""

from __future__ import annotations

import argparse
import copy
import datetime
import json
import os
import pathlib
import platform
import subprocess
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout as mj_rollout

import rbd_jax as rbd
from rbd_jax.mjcf import compile_mujoco
from rbd_jax.record import versions

RESULTS = pathlib.Path(__file__).parent / "results"
PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
G = 9.81


# --- the record ---


def cpu_model() -> str:
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((s.split(":", 1)[1].strip() for s in lines if s.startswith("model name")), platform.machine())


def commit() -> str:
    """Short hash of the working copy, with "+" when tracked files differ from it; "unknown" outside git."""
    run = lambda *a: subprocess.run(
        ["git", *a], cwd=pathlib.Path(__file__).parent, capture_output=True, text=True, timeout=30
    )
    try:
        head = run("rev-parse", "--short", "HEAD")
        changed = run("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return head.stdout.strip() + ("+" if changed.stdout.strip() else "") if head.returncode == 0 else "unknown"


def environment() -> dict:
    device = jax.devices()[0]
    return {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "commit": commit(),
        "rbd_jax": rbd.__version__,
        "versions": versions(),
        "platform": device.platform,
        "device": device.device_kind,
        "devices": len(jax.devices()),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "load_average_1min": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
    }


def header(env: dict) -> str:
    v = env["versions"]
    return (
        f"{env['cpu']}, {env['cores']} cores, {env['platform']} backend with {env['devices']} device(s); "
        f"jax {v['jax']}, MuJoCo {v['mujoco-core']}, numpy {v['numpy']}, Python {v['python']}; commit {env['commit']}, "
        f"{env['date']}. Load average at the start {env['load_average_1min']}."
    )


def options(description: str, smoke: str) -> argparse.ArgumentParser:
    """The options that the speed scripts share."""
    parser = argparse.ArgumentParser(description=description.split("\n")[0])
    parser.add_argument("--smoke", action="store_true", help=f"a few seconds: {smoke}")
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="timed runs of each (default 3)")
    parser.add_argument("--out", type=pathlib.Path, default=None, metavar="DIR", help="default benchmarks/results")
    return parser


def plain(value):
    """JSON without NaN: numpy to Python, non-finite numbers to None."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, (np.ndarray, jax.Array)):
        return plain(np.asarray(value).tolist())
    if isinstance(value, (np.bool_, bool)):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value


def append_lines(path: pathlib.Path, rows) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        for row in rows:
            file.write(json.dumps(plain(row)) + "\n")


def write_json(path: pathlib.Path, data) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(plain(data), indent=1) + "\n", encoding="utf-8")


def table(heads, rows) -> str:
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    return "\n".join(lines + ["| " + " | ".join(str(c) for c in r) + " |" for r in rows])


def number(x, digits=3) -> str:
    if x is None:
        return "-"
    if isinstance(x, str):
        return x
    return f"{x:.{digits}g}" if np.isfinite(x) else "not finite"


def step_text(dt: float) -> str:
    """A step in words: "0.2 ms" or "1/240 s"."""
    return f"{1e3 * dt:g} ms" if abs(1e6 * dt - round(1e6 * dt)) < 1e-6 else f"1/{1 / dt:.0f} s"


def verdict(value, bar, least=False) -> str:
    """Empty without a bar, else "ok" or "MISS"; a value that is missing or not finite misses."""
    if bar is None:
        return ""
    if value is None or not np.isfinite(value):
        return "MISS"
    return "ok" if (value >= bar if least else value <= bar) else "MISS"


def least_seconds(call, repeats: int) -> float:
    """The least time of ``call()`` after a warm-up."""
    call()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


# --- our side ---


class Program:
    """A function of a batch, compiled ahead of time; seconds in ``trace_s``, ``lower_s``, ``compile_s``.

    Cold as long as no program of the same scene, batch and length was traced before in this process; nothing is
    read from disk unless the user has set up JAX's persistent cache.

    Args:
      function: (model, state) -> what is to be timed.
    """

    def __init__(self, function, model, state):
        jax.block_until_ready(jax.jit(lambda x: x + 1)(jnp.zeros(3)))  # the backend itself is up
        begin = time.perf_counter()
        traced = jax.jit(function).trace(model, state)
        self.trace_s = time.perf_counter() - begin
        lowered = traced.lower()
        self.lower_s = time.perf_counter() - begin - self.trace_s
        self._call = lowered.compile()
        self.total_s = time.perf_counter() - begin
        self.compile_s = self.total_s - self.trace_s - self.lower_s

    def __call__(self, model, state):
        return jax.block_until_ready(self._call(model, state))

    def seconds(self, model, state) -> float:
        begin = time.perf_counter()
        self(model, state)
        return time.perf_counter() - begin


def start(state, pos=None, vel=None, omega=None, quat=None):
    """A state with these (B, n, 3 | 4) arrays; what is None is kept."""
    size = next(len(a) for a in (pos, vel, omega, quat) if a is not None)
    given = {"pos": pos, "vel": vel, "omega": omega, "quat": quat}
    return rbd.batch(state, size).replace(**{k: jnp.asarray(v) for k, v in given.items() if v is not None})


def joined(*states):
    return jax.tree.map(lambda *c: jnp.concatenate(c), *states)


def random_quat(rng, *shape):
    q = rng.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def angle(a, b) -> np.ndarray:
    """Angle between attitudes a, b (..., 4) [rad], accurate for small ones."""
    a, b = (np.asarray(q, np.float64) / np.linalg.norm(q, axis=-1, keepdims=True) for q in (a, b))
    b = b * np.sign((a * b).sum(-1, keepdims=True))
    return 4 * np.arcsin(np.minimum(1.0, np.linalg.norm(a - b, axis=-1) / 2))


# --- MuJoCo's side ---


class MuJoCo:
    """A scene, exported through MJCF, in ``mujoco.rollout``: two threads, no checks, arrays allocated before.

    Contact is MuJoCo's default, or what the scene's geoms say; the solver is what the scene asks for
    (Newton, tolerance 1e-8); the cone is elliptic.
    """

    def __init__(self, scene, dt, threads=2):
        self.model, data = compile_mujoco(scene)
        self.model.opt.timestep = dt
        self.dt, self.threads = dt, threads
        self.data = [mujoco.MjData(self.model) for _ in range(threads)]
        for d in self.data:
            d.mocap_pos[:], d.mocap_quat[:] = data.mocap_pos, data.mocap_quat
        self.size = mujoco.mj_stateSize(self.model, PHYSICS)
        self.pool = mj_rollout.Rollout(nthread=threads)

    def initial(self, qpos, qvel) -> np.ndarray:
        """Full physics states (B, size) at time 0."""
        full = np.zeros((len(qpos), self.size))
        full[:, 1 : 1 + self.model.nq] = qpos
        full[:, 1 + self.model.nq : 1 + self.model.nq + self.model.nv] = qvel
        return full

    def allocate(self, worlds: int, steps: int):
        out = np.zeros((worlds, steps, self.size))
        return [self.model] * worlds, out, np.zeros((worlds, steps, self.model.nsensordata))

    def call(self, initial, steps: int, arrays, chunk=None) -> np.ndarray:
        models, out, sensors = arrays
        self.pool.rollout(
            models, self.data, initial, nstep=steps, skip_checks=True, state=out, sensordata=sensors, chunk_size=chunk
        )
        return out

    def tune(self, initial, steps: int) -> int:
        """The fastest chunk size of a short run."""
        worlds, steps = len(initial), min(steps, 50)
        arrays, best = self.allocate(worlds, steps), None
        for parts in (2, 8, 32, 128):
            chunk = max(1, worlds // parts)
            begin = time.perf_counter()
            self.call(initial, steps, arrays, chunk)
            took = time.perf_counter() - begin
            best = min(best or (took, chunk), (took, chunk))
        return best[1]

    def choose_cone(self, initial, steps: int) -> str:
        """Keep the friction cone with which a short run is faster; its name."""
        worlds, steps = len(initial), min(steps, 50)
        arrays, times = self.allocate(worlds, steps), {}
        for cone in (mujoco.mjtCone.mjCONE_ELLIPTIC, mujoco.mjtCone.mjCONE_PYRAMIDAL):
            self.model.opt.cone = cone
            for _ in range(2):  # the first is a warm-up
                begin = time.perf_counter()
                self.call(initial, steps, arrays)
                times[cone] = time.perf_counter() - begin
        self.model.opt.cone = min(times, key=times.get)
        return mujoco.mjtCone(self.model.opt.cone).name.removeprefix("mjCONE_").lower()

    def run(self, qpos, qvel, steps: int, every: int = 1):
        """(qpos, qvel) at samples 0, every, 2 every, ...: (B, T + 1, nq), (B, T + 1, nv)."""
        at = self.initial(np.asarray(qpos, float), np.asarray(qvel, float))
        block = every * max(1, 500 // every)
        seen, done = [at[:, None]], 0
        while done < steps:
            count = min(block, steps - done)
            out = self.call(at, count, self.allocate(len(at), count))
            seen.append(out[:, every - 1 :: every].copy())
            at, done = out[:, -1].copy(), done + count
        states = np.concatenate(seen, axis=1)
        nq = self.model.nq
        return states[..., 1 : 1 + nq], states[..., 1 + nq : 1 + nq + self.model.nv]

    def penetration(self, qpos) -> float:
        """Deepest overlap [m] of poses (..., nq) by MuJoCo's geometry, the common ruler; 0 where nothing touches."""
        data, deepest = mujoco.MjData(self.model), 0.0
        for q in np.asarray(qpos, np.float64).reshape(-1, self.model.nq):
            data.qpos[:] = q
            mujoco.mj_fwdPosition(self.model, data)
            deepest = max(deepest, float(-data.contact.dist.min(initial=0.0)))
        return deepest

    def normal_speeds(self, qpos, qvel, near: float = 1e-5) -> np.ndarray:
        """Largest speed along the normal [m/s] of points closer than ``near`` [m] in each world of (B, nq), (B, nv).

        0 where there are none.
        """
        model = copy.copy(self.model)
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC  # the first row of a contact is its normal there
        model.geom_margin[:] = model.pair_margin[:] = near
        data = mujoco.MjData(model)

        def fastest(q, v):
            data.qpos[:], data.qvel[:] = q, v
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            rows = data.contact.efc_address
            return np.abs(data.efc_vel[rows[rows >= 0]]).max(initial=0.0)

        return np.array([fastest(q, v) for q, v in zip(qpos, qvel, strict=True)])

    def close(self):
        self.pool.close()
