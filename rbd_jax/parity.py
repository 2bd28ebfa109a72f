"""Layer 9: agreement with MuJoCo on the same scene, at three levels.

1. one forward: contact geometry and accelerations from the start state;
2. single steps: from every state of a MuJoCo trajectory, one step of each;
3. open loop: both run on; beside it MuJoCo against itself, started one float32 rounding apart,
   which says how much of a difference is the scene's own sensitivity.

Levels 1 and 2 compare the "mujoco" preset, which integrates MuJoCo's own equations. Level 3 shows
the method asked for as well: it has other contact laws, so its difference is that of the models.
Source: the three levels of the parity skill that ships with MuJoCo 4.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from .build import build
from .convert import from_mujoco, to_mujoco
from .diagnostics import contacts
from .mjcf import compile_mujoco
from .model import Model
from .rollout import rollout, step
from .scene import Scene
from .state import State

#: Level 1 and 2 must agree to this, relative to 1 + |value| (f64).
EXACT = 1e-6
#: Level 3, "mujoco" preset: at most this many times MuJoCo's own sensitivity, or EXACT.
SENSITIVITY = 100.0


@dataclasses.dataclass(frozen=True)
class Row:
    """One comparison: what, the largest difference, its bound (None = told, not judged)."""

    level: str
    quantity: str
    value: float
    bound: float | None
    unit: str

    @property
    def ok(self) -> bool:
        return self.bound is None or bool(self.value <= self.bound)


@dataclasses.dataclass(frozen=True)
class Report:
    """Agreement of one scene with MuJoCo."""

    scene: str
    mujoco: str
    dt: float
    steps: int
    method: str
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        return all(r.ok for r in self.rows)

    def table(self) -> str:
        """The rows as a Markdown table."""
        lines = [
            f"{self.scene}: {self.steps} steps of {self.dt:g} s beside MuJoCo {self.mujoco}",
            "",
            "| level | quantity | largest difference | bound | |",
            "|---|---|---|---|---|",
        ]
        for r in self.rows:
            bound = "-" if r.bound is None else f"{r.bound:.1e}"
            verdict = "" if r.bound is None else ("ok" if r.ok else "FAILS")
            lines.append(f"| {r.level} | {r.quantity} | {r.value:.2e} {r.unit} | {bound} | {verdict} |")
        return "\n".join([*lines, *("\n" + n for n in self.notes)])

    def to_dict(self) -> dict:
        return {**dataclasses.asdict(self), "ok": self.ok}


def validate(scene: Scene, method: str | None = None, steps: int | None = None) -> Report:
    """Compare a scene with MuJoCo at the scene's step, in float64.

    Args:
      scene: the scene; it is exported to MJCF and compiled by MuJoCo.
      method: also shown at level 3; None: "accurate".
      steps: length of the trajectory; None: one second.

    Raises:
      ValueError: the scene cannot be expressed by MuJoCo (restitution, drag: named in the notes).
    """
    import mujoco

    method = method or "accurate"
    steps = int(steps or max(1, round(1.0 / scene.dt)))
    notes = []
    if any(g.restitution is not None for b in scene.bodies for g in b.geoms):
        notes.append("MuJoCo has no restitution coefficient: it is left out of the comparison.")
    if scene.kinematic:
        notes.append("MuJoCo's mocap bodies do not move by themselves: kinematic bodies are compared at rest.")
    if scene.drag is not None:
        notes.append("MuJoCo has no drag per mass: it is left out of the comparison.")
    with jax.enable_x64(True):
        mj, data = compile_mujoco(scene)
        mj.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        mj.opt.tolerance, mj.opt.iterations = 0.0, 100
        still = tuple(dataclasses.replace(b, vel=None, omega=None) for b in scene.kinematic)
        plain = dataclasses.replace(scene, drag=None, kinematic=still)
        qpos, qvel = _trajectory(mujoco, mj, data, steps)
        model, start = build(plain, method="mujoco")
        rows = _forward(mujoco, mj, model, start, qpos[0], qvel[0])
        rows += _single_steps(model, start, qpos, qvel)
        rows += _open_loop(mujoco, mj, data, plain, model, start, method, qpos, qvel, scene.dt)
    return Report(scene.name, mujoco.__version__, scene.dt, steps, method, tuple(rows), tuple(notes))


def _trajectory(mujoco, mj, data, steps: int) -> tuple[np.ndarray, np.ndarray]:
    d = mujoco.MjData(mj)
    d.qpos[:], d.qvel[:] = data.qpos, data.qvel
    d.mocap_pos[:], d.mocap_quat[:] = data.mocap_pos, data.mocap_quat
    qpos, qvel = [d.qpos.copy()], [d.qvel.copy()]
    for _ in range(steps):
        mujoco.mj_step(mj, d)
        qpos.append(d.qpos.copy())
        qvel.append(d.qvel.copy())
    return np.array(qpos), np.array(qvel)


def _relative(a, b) -> float:
    a, b = np.asarray(a), np.asarray(b)
    return float(np.max(np.abs(a - b) / (1.0 + np.abs(b)), initial=0.0))


def _forward(mujoco, mj, model, start, qpos, qvel) -> list[Row]:
    d = mujoco.MjData(mj)
    d.qpos[:], d.qvel[:] = qpos, qvel
    mujoco.mj_forward(mj, d)
    rows = [Row("1 forward", "mass", _relative(model.mass, mj.body_mass[mj.body_mass > 0][: model.n]), 1e-12, "kg")]
    if d.ncon:
        ours = contacts(model, from_mujoco(model, qpos, qvel, start))
        points, depth = np.asarray(ours.point), np.asarray(ours.distance)
        near = [np.min(np.abs(points - c.pos).max(axis=1) + np.abs(depth - c.dist)) for c in d.contact]
        rows.append(Row("1 forward", f"{d.ncon} contact points and depths", float(max(near)), EXACT, "m"))
    return rows


def _single_steps(model, start, qpos, qvel) -> list[Row]:
    before = from_mujoco(model, qpos[:-1], qvel[:-1], start)
    after = step(model, before)
    p, v = to_mujoco(model, after)
    return [
        Row("2 single steps", "qpos after one step", _relative(p, qpos[1:]), EXACT, ""),
        Row("2 single steps", "qvel after one step", _relative(v, qvel[1:]), EXACT, ""),
    ]


def _open_loop(mujoco, mj, data, scene, model, start, method, qpos, qvel, dt) -> list[Row]:
    steps = len(qpos) - 1
    shifted = mujoco.MjData(mj)
    rng = np.random.default_rng(0)
    shifted.qpos[:] = data.qpos + 1e-7 * rng.standard_normal(mj.nq)
    shifted.qvel[:] = data.qvel
    shifted.mocap_pos[:], shifted.mocap_quat[:] = data.mocap_pos, data.mocap_quat
    other = _trajectory(mujoco, mj, shifted, steps)[0]
    own = _relative(other, qpos)
    _, traj = rollout(model, start, steps)
    rows = [
        Row("3 open loop", "MuJoCo started 1e-7 apart", own, None, ""),
        Row(
            "3 open loop",
            "mujoco preset",
            _relative(to_mujoco(model, traj)[0], qpos),
            max(EXACT, SENSITIVITY * own),
            "",
        ),
    ]
    if method != "mujoco":
        model, start = build(scene, method=method)
        final, traj = rollout(model, start, steps)
        away = np.asarray(to_mujoco(model, traj)[0])
        rows.append(Row("3 open loop", f'"{method}", another contact law', _relative(away, qpos), None, ""))
    return rows


def ghost(scene: Scene, model: Model, start: State, steps: int, every: int) -> tuple[np.ndarray, np.ndarray]:
    """MuJoCo's run of the scene from the worlds of ``start``, for :func:`rbd_jax.record.clip`.

    Args:
      start: any batch axes, which become one. steps, every: as those of the rollout beside it.

    Returns:
      Origins (worlds, samples, n, 3) and quaternions (worlds, samples, n, 4) of the bodies, dynamic ones first.
    """
    import mujoco

    mj, data = compile_mujoco(scene)
    mj.opt.timestep = float(np.asarray(model.dt).ravel()[0])
    names = model.names.bodies + model.names.kinematic
    rows = [mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_BODY, name) for name in names]
    qpos, qvel = (np.asarray(a, float).reshape(-1, a.shape[-1]) for a in to_mujoco(model, start))
    pos, quat = [], []
    for world in range(len(qpos)):
        mujoco.mj_resetData(mj, data)
        if mj.nkey:
            mujoco.mj_resetDataKeyframe(mj, data, 0)
        data.qpos[: model.n * 7], data.qvel[: model.n * 6] = qpos[world], qvel[world]
        mujoco.mj_forward(mj, data)
        seen = [(data.xpos[rows].copy(), data.xquat[rows].copy())]
        for _ in range(steps // every):
            mujoco.mj_step(mj, data, every)
            mujoco.mj_kinematics(mj, data)
            seen.append((data.xpos[rows].copy(), data.xquat[rows].copy()))
        pos.append([p for p, _ in seen])
        quat.append([q for _, q in seen])
    return np.array(pos), np.array(quat)
