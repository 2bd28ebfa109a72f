"""Layer 9: trajectories as files (.npz) and as clips for the page and the picture."""

from __future__ import annotations

import contextlib
import json
import os
import platform
from collections.abc import Iterator
from importlib import metadata
from typing import Any

import jax
import numpy as np

from .build import build
from .diagnostics import contacts, energy
from .model import BASE_NDIM, Model, batch_of
from .rollout import step
from .scene import Scene
from .state import State
from .tiles import flattened, per_world
from .view import Clip
from .view.clip import rotate

FORMAT = 1
PACKAGES = ("jax", "jaxlib", "numpy", "mujoco-core")


def versions() -> dict[str, str | None]:
    """Versions of Python and of the packages that numbers depend on; None = not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found


def seconds(step: Any, dt: Any) -> np.ndarray:
    """Time [s] = step x dt in float64, dt taken as the decimal number it was written as (0.004, not 0.00400000019)."""
    return np.asarray(step) * np.asarray(dt).astype(str).astype(np.float64)


def save(path: str | os.PathLike[str], model: Model, traj: State, **notes: Any) -> None:
    """Write a trajectory (or a state) to one ``.npz`` file at exactly ``path``.

    Arrays: ``pos, vel, quat, omega`` (batch..., samples, n, 3 | 4), as the properties of :class:`rbd_jax.State`;
    ``step, status`` and ``time`` [s] (batch..., samples); ``kinematic_pos, kinematic_quat, kinematic_vel,
    kinematic_omega`` where there are such bodies; ``bodies``, ``kinematic`` and ``geoms`` are names. ``header`` is
    JSON text: format version, package versions, dt, method, dtype and the ``notes``. No pickles.

    The file appears when it is complete: it is written beside ``path`` and then renamed.

    Raises:
      OSError: it cannot be written; a file that was there stays as it was.
      TypeError: a note that JSON cannot hold.
    """
    from . import __version__

    names = model.names
    header = {
        "format": FORMAT,
        "rbd_jax": __version__,
        "versions": versions(),
        "dt": np.asarray(model.dt).astype(str).astype(float).tolist(),
        "dtype": str(model.mass.dtype),
        "method": repr(model.method),
        **notes,
    }
    arrays = {name: np.asarray(getattr(traj, name)) for name in ("pos", "vel", "quat", "omega", "step", "status")}
    arrays["time"] = seconds(traj.step, traj.dt)
    if traj.kinematic is not None:
        for name in ("kinematic_pos", "kinematic_quat", "kinematic_vel", "kinematic_omega"):
            arrays[name] = np.asarray(getattr(traj, name))
    for name, labels in (("bodies", names.bodies), ("kinematic", names.kinematic), ("geoms", names.geoms)):
        arrays[name] = np.array(labels, dtype=np.str_)
    arrays["header"] = np.array(json.dumps(header))
    with whole_or_not_at_all(path) as file:
        np.savez(file, **arrays)


@contextlib.contextmanager
def whole_or_not_at_all(path: str | os.PathLike[str]) -> Iterator[Any]:
    """A file to write into that takes the place of ``path`` once it is complete and on the disk."""
    aside = f"{os.fspath(path)}.{os.getpid()}.part"
    try:
        with open(aside, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.remove(aside)


def load(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a file of :func:`save`: its arrays by name, ``header`` as a dict.

    Raises:
      OSError: it cannot be read.
      ValueError: it is not such a file, or of a newer format.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            content: dict[str, Any] = dict(file)
        content["header"] = json.loads(str(content["header"]))
        version = content["header"]["format"]
    except OSError:
        raise
    except Exception as error:
        raise ValueError(f"{os.fspath(path)}: not a trajectory file of rbd_jax ({type(error).__name__})") from None
    if version > FORMAT:
        raise ValueError(f"{os.fspath(path)}: format {version} is newer than this rbd_jax reads ({FORMAT})")
    return content


def first_worlds(model: Model, state: State, count: int, samples: bool = True) -> tuple[Model, State]:
    """The first ``count`` worlds, batch axes flattened to one (made if there is none), as numpy leaves.

    ``samples``: the state is a trajectory, whose last axis before the bodies is not a batch axis. Memory is dropped.
    """
    state = state._with(memory=None)
    inner = 1 if samples else 0
    batch = state.batch_shape[: len(state.batch_shape) - inner]
    if batch_of(model, batch) != batch:
        raise ValueError(f"the model's leaves have batch axes that the state, {batch}, does not have")
    model, state, _ = flattened(model, state, None, batch)
    own, _, _ = per_world(model, state, None)
    cut = lambda c, mine=True: np.asarray(c)[:count] if mine else c
    return jax.tree.map(cut, model, own), jax.tree.map(cut, state)


def clip(model: Model, traj: State, title: str = "rbd_jax", worlds: int = 16, forces: bool = False, ghost=None) -> Clip:
    """What :func:`rbd_jax.view.write_html` and ``write_png`` draw: the first ``worlds`` worlds of a trajectory.

    Args:
      model: the one that made it; sizes and poses of geoms are taken from its leaves, per world if batched.
      traj: of :func:`rbd_jax.rollout`, any batch axes (they become one). Samples after which no shown world
        moves on (all frozen) are left out.
      title: of the page.
      worlds: at most so many.
      forces: with the forces of contact: those of one more step from every sample, as a trajectory has no memory of its
        own; warm starting is left out of them.
      ghost: (pos, quat) of the origins of the bodies in another run (worlds, samples, n, 3 | 4), e.g. of
        :func:`rbd_jax.parity.ghost`.

    Raises:
      ValueError: worlds < 1, or batch sizes of model and trajectory that do not match.
    """
    if worlds < 1:
        raise ValueError(f"clip: worlds = {worlds} must be >= 1")
    model, traj = first_worlds(model, traj, worlds)
    total = np.asarray(sum(jax.jit(energy)(model, traj)))
    pushes = None
    if forces:
        seen = jax.jit(lambda model, traj: contacts(model, step(model, traj)))(model, traj)
        pushes = np.asarray(seen.point), np.where(seen.live[..., None], seen.force, np.nan)
    time = seconds(traj.step, traj.dt)
    time = time[np.argmax(time[:, -1])]  # a frozen world's clock stands still
    kept = np.flatnonzero(np.diff(time, prepend=-np.inf) > 0)
    quat = np.asarray(traj.quat, float)
    pos = np.asarray(traj.pos, float)
    if model.com is not None:
        com = np.asarray(model.com, float)
        pos = pos - rotate(quat, com[:, None] if com.ndim == 3 else com)
    if traj.kinematic is not None:
        pos = np.concatenate([pos, traj.kinematic_pos], axis=-2)
        quat = np.concatenate([quat, traj.kinematic_quat], axis=-2)
    names = model.names
    return Clip(
        geoms=_geoms(model),
        time=time[kept],
        pos=pos[:, kept],
        quat=quat[:, kept],
        names=names.bodies + names.kinematic,
        title=title,
        energy=total[:, kept] if np.isfinite(total).all() else None,
        dynamic=model.n,
        contacts=None if pushes is None else tuple(a[:, kept] for a in pushes),
        ghost=None if ghost is None else tuple(np.asarray(a)[: len(pos), kept] for a in ghost),
    )


def film(scene: Scene, content: dict[str, Any], title: str = "rbd_jax", worlds: int = 16) -> Clip:
    """The clip of a file that :func:`load` read, made from ``scene``; arguments as for :func:`clip`.

    Raises:
      ValueError: the bodies of the file are not those of the scene.
    """
    model, state = build(scene, method="fast")
    for what in ("bodies", "kinematic"):
        own, seen = list(getattr(model.names, what)), content[what].tolist()
        if own != seen:
            raise ValueError(f"the file has {what} {seen}, the scene {own}")
    pos = content["pos"].reshape(-1, *content["pos"].shape[-3:])
    shape = pos.shape[:2]
    fields = ("pos", "vel", "quat", "omega")
    fields += tuple(f"kinematic_{f}" for f in fields) if state.kinematic is not None else ()
    rows = {f: content[f].reshape(*shape, *content[f].shape[-2:]) for f in fields}
    grown = jax.tree.map(lambda c: np.broadcast_to(np.asarray(c), (*shape, *np.shape(c))), state._with(memory=None))
    traj = grown.replace(**rows)
    dt = np.float64(content["header"]["dt"])
    step = np.broadcast_to(content["step"], content["pos"].shape[:-2]).reshape(shape)
    return clip(model, traj._with(step=step, dt=np.broadcast_to(dt, shape)), title, worlds)


def _geoms(model: Model) -> list[dict[str, Any]]:
    """The geoms as :class:`rbd_jax.view.Clip` wants them: a leading axis of worlds where the leaf has one."""
    s = model.structure

    def entry(name: str, row: int):
        return np.asarray(getattr(model, name))[(..., row) if BASE_NDIM[name] == 1 else (..., row, slice(None))]

    geoms = []
    for i, (kind, category, name) in enumerate(zip(s.kinds, s.category, s.names.geoms)):
        geom: dict[str, Any] = {"kind": kind, "name": name, "body": -1}
        if kind == "sphere":
            geom["size"] = entry("radius", s.row[i])[..., None]
        elif kind == "box":
            geom["size"] = entry("half_extents", s.row[i])
        if category == "static":
            geom["pos"], geom["quat"] = entry("static_pos", s.static_row[i]), entry("static_quat", s.static_row[i])
        else:
            geom["body"] = int(s.geom_body[i]) + (model.n if category == "kinematic" else 0)
            if model.geom_pos is not None:
                geom["pos"], geom["quat"] = entry("geom_pos", i), entry("geom_quat", i)
        geoms.append(geom)
    return geoms
