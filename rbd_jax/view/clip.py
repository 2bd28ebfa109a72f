"""Layer 9: what is needed to draw a trajectory, and the look that page and picture share."""

from __future__ import annotations

import dataclasses
import html
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

KINDS = {"sphere": 1, "box": 3, "plane": 0}  # kind -> how many sizes it has
STATIC = -1

# Okabe and Ito's colour-blind safe palette, without black; static and kinematic geoms are grey.
PALETTE = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#E8D33A")
STATIC_COLOUR, KINEMATIC_COLOUR = "#B4BAC4", "#6B7482"
GROUND_COLOURS = ("#F7F8FA", "#E3E7ED")
SKY_COLOURS = ("#DCE5EF", "#F8FAFC")  # top and bottom of the background
LIGHT = (-0.38, -0.52, 1.0)  # towards the light; need not be a unit vector
FIELD_OF_VIEW = 32.0  # vertical [deg]
AZIMUTH, ELEVATION = -62.0, 21.0  # of the camera as seen from the scene [deg]


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vector(s) ``v`` rotated by unit quaternion(s) ``q`` (w, x, y, z); leading axes broadcast."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * np.cross(u, v)
    return v + w * t + np.cross(u, t)


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton product of quaternions (w, x, y, z)."""
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    w = pw * qw - np.sum(pv * qv, -1, keepdims=True)
    return np.concatenate([w, pw * qv + qw * pv + np.cross(pv, qv)], -1)


def matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    return np.stack([rotate(q, e) for e in np.eye(3)], -1)


@dataclasses.dataclass
class Clip:
    """The motion of the bodies of W worlds at T instants. Lengths in metres, time in seconds.

    ``geoms``: one dict a geom: ``kind`` ('sphere', 'box', 'plane'), ``size`` (radius,), (hx, hy, hz)
    or (), ``body`` (row of ``pos``; -1 is the world), ``pos`` (3), ``quat`` (4; w, x, y, z) in the body's
    frame, ``name``. ``size``, ``pos`` and ``quat`` may have a leading axis W where worlds differ.
    ``time`` (T,), ``pos`` (W, T, n, 3), ``quat`` (W, T, n, 4): the *origin* and attitude of the frame of
    ``n`` bodies, dynamic ones first, then kinematic ones; a geom is at ``pos + R(quat) geom_pos``.
    ``dynamic``: how many of the n are dynamic (default: all). ``names``: of the n bodies.
    ``worlds``: names of worlds (default 'world 0', ...). ``energy`` (W, T) in joules, optional.
    ``contacts``, optional: (points (W, T, c, 3) [m], forces (W, T, c, 3) [N]), a force of NaN where there is none.
    ``ghost``, optional: (pos, quat) of the same bodies in another run, ``ghost_name``, shown as outlines. Both are
    on the page only.
    """

    geoms: Sequence[dict[str, Any]]
    time: Any
    pos: Any
    quat: Any
    names: Sequence[str] | None = None
    title: str = "rbd_jax"
    energy: Any = None
    dynamic: int | None = None
    worlds: Sequence[str] | None = None
    contacts: Any = None
    ghost: Any = None
    ghost_name: str = "MuJoCo"

    def __post_init__(self):
        self.time = _finite("time", self.time)
        self.pos = _finite("pos", self.pos)
        self.quat = _finite("quat", self.quat)
        if self.time.ndim != 1 or self.pos.ndim != 4 or self.pos.shape[-1] != 3:
            raise ValueError(f"clip: time {self.time.shape} and pos {self.pos.shape} must be (T,) and (W, T, n, 3)")
        W, T, n = self.pos.shape[:3]
        if self.quat.shape != (W, T, n, 4) or self.time.shape != (T,):
            raise ValueError(
                f"clip: time {self.time.shape} and quat {self.quat.shape} do not go with pos "
                f"{self.pos.shape}; expected ({T},) and {(W, T, n, 4)}"
            )
        if not (W and T and len(self.geoms)):
            raise ValueError(f"clip: nothing to show ({W} worlds, {T} instants, {len(self.geoms)} geoms)")
        if np.any(np.diff(self.time) <= 0):
            raise ValueError("clip: time must increase from sample to sample")
        norm = np.linalg.norm(self.quat, axis=-1, keepdims=True)
        if np.any(norm == 0):
            raise ValueError("clip: quat has a zero quaternion")
        self.quat = self.quat / norm
        if self.energy is not None:
            self.energy = _finite("energy", self.energy)
            if self.energy.shape != (W, T):
                raise ValueError(f"clip: energy {self.energy.shape} must be (W, T) = {(W, T)}")
        self.dynamic = n if self.dynamic is None else int(self.dynamic)
        if not 0 <= self.dynamic <= n:
            raise ValueError(f"clip: dynamic = {self.dynamic} must be 0..{n}")
        if self.contacts is not None:
            points, forces = (np.asarray(a, np.float64) for a in self.contacts)
            if points.shape != forces.shape or points.ndim != 4 or points.shape[:2] != (W, T) or points.shape[3] != 3:
                raise ValueError(f"clip: contacts {points.shape}, {forces.shape} must both be {(W, T)} + (c, 3)")
            self.contacts = points, forces
        if self.ghost is not None:
            pos, quat = _finite("ghost pos", self.ghost[0]), _finite("ghost quat", self.ghost[1])
            if pos.shape != self.pos.shape or quat.shape != self.quat.shape:
                raise ValueError(f"clip: ghost {pos.shape}, {quat.shape} must be {self.pos.shape}, {self.quat.shape}")
            self.ghost = pos, quat / np.linalg.norm(quat, axis=-1, keepdims=True)
        self.names = _labels("names", self.names, n, "body")
        self.worlds = _labels("worlds", self.worlds, W, "world")
        self.kind = [g["kind"] for g in self.geoms]
        self.body = np.array([int(g.get("body", STATIC)) for g in self.geoms])
        self.geom_size = self._per_world("size", 3)
        self.geom_pos = self._per_world("pos", 3)
        self.geom_quat = self._per_world("quat", 4)

    def _per_world(self, field: str, width: int) -> np.ndarray:
        """One field of all geoms as (W, G, width); sizes are padded with ones (a sphere repeats its radius)."""
        W, _, n = self.pos.shape[:3]
        out = np.ones((W, len(self.geoms), width))
        default = {"size": (), "pos": (0, 0, 0), "quat": (1, 0, 0, 0)}[field]
        for i, g in enumerate(self.geoms):
            owner = f"clip: geom {i} ({g.get('name') or g['kind']})"
            if g["kind"] not in KINDS:
                raise ValueError(f"{owner}: kind = {g['kind']!r} must be one of {sorted(KINDS)}")
            if not -1 <= self.body[i] < n:
                raise ValueError(f"{owner}: body = {self.body[i]} must be -1 (the world) or 0..{n - 1}")
            value = _finite(f"geom {i} {field}", g.get(field, default))
            expected = KINDS[g["kind"]] if field == "size" else width
            if value.ndim not in (1, 2) or value.shape[-1] != expected or value.shape[:-1] not in ((), (W,)):
                raise ValueError(f"{owner}: {field} has shape {value.shape}, expected ({expected},)")
            if not value.shape[-1]:
                continue
            if field == "size" and np.any(value <= 0):
                raise ValueError(f"{owner}: size = {value} must be > 0 [m]")
            if field == "quat":
                norm = np.linalg.norm(value, axis=-1, keepdims=True)
                if np.any(norm == 0):
                    raise ValueError(f"{owner}: quat = {value} must not be zero")
                value = value / norm
            out[:, i] = value
        return out

    @property
    def shape(self) -> tuple[int, int, int]:
        """Worlds, instants, bodies."""
        return self.pos.shape[:3]

    @property
    def radius(self) -> np.ndarray:
        """Bounding radius (W, G) of each geom [m]; zero for planes."""
        full = np.linalg.norm(self.geom_size, axis=-1)
        kind = np.array(self.kind)
        return np.where(kind == "sphere", self.geom_size[..., 0], np.where(kind == "box", full, 0.0))

    def poses(self, world: int, frames: Any) -> tuple[np.ndarray, np.ndarray]:
        """World pose of each geom: position (F, G, 3) and quaternion (F, G, 4) at the F ``frames``."""
        frames = np.atleast_1d(frames)
        fixed = self.body < 0
        body = np.where(fixed, 0, self.body)
        if self.shape[2]:
            pos, quat = self.pos[world, frames][:, body], self.quat[world, frames][:, body]
        else:
            pos, quat = np.zeros((len(frames), len(body), 3)), np.zeros((len(frames), len(body), 4))
        pos = np.where(fixed[:, None], 0.0, pos)
        quat = np.where(fixed[:, None], np.array([1.0, 0, 0, 0]), quat)
        return pos + rotate(quat, self.geom_pos[world]), multiply(quat, self.geom_quat[world])

    def frame(self, worlds: Sequence[int], frames: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Corners (lo, hi) of a box around what is worth looking at.

        Bodies that run far beyond both where they started and where most of them are do not count, nor do
        static geoms much larger than what moves. The ground counts if it is not far below.
        """
        at, radius, half, moving = [], [], [], []
        solid = np.array([k != "plane" for k in self.kind])
        box = np.array([k == "box" for k in self.kind])[solid]
        for w in worlds:
            p, q = self.poses(w, frames)
            size = self.geom_size[w, solid]
            reach = np.abs(matrix(q[:, solid])) @ size[:, :, None]  # of a turned box along the world's axes
            at.append(p[:, solid].reshape(-1, 3))
            half.append(np.where(box[:, None], reach[..., 0], size).reshape(-1, 3))
            radius.append(np.tile(self.radius[w, solid], len(p)))
            moving.append(np.tile(self.body[solid] >= 0, len(p)))
        at, radius, half, moving = (np.concatenate(a) for a in (at, radius, half, moving))
        if not len(at):
            points, _ = self.poses(worlds[0], frames[:1])
            return points[0].min(0) - 1.0, points[0].max(0) + 1.0
        if moving.any():
            centre = np.median(at[moving], 0)
            away = np.linalg.norm(at - centre, axis=-1)
            start = [np.linalg.norm(self.poses(w, 0)[0][0] - centre, axis=-1)[solid & (self.body >= 0)] for w in worlds]
            limit = max(1.3 * np.max(start), 2.0 * np.quantile(away[moving], 0.75))
            near = moving & (away <= limit + radius)
            reach = (away + radius)[near].max()
            keep = near | (~moving & (away + radius < 1.6 * reach))
            at, half = at[keep], half[keep]
        lo, hi = (at - half).min(0), (at + half).max(0)
        ground = self._ground(worlds[0])
        if np.any(moving) and lo[2] - 2.0 * np.max(hi - lo) <= ground < lo[2]:
            lo[2] = ground
        return lo, hi

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """``frame`` of all worlds and of at most 60 instants."""
        W, T, _ = self.shape
        return self.frame(range(W), np.unique(np.linspace(0, T - 1, min(T, 60)).round().astype(int)))

    def _ground(self, world: int) -> float:
        """Height of the highest level plane that is fixed to the world; -inf if there is none."""
        flat = (np.array(self.kind) == "plane") & (self.body < 0)
        flat &= rotate(self.geom_quat[world], np.array([0.0, 0, 1]))[:, 2] > 0.9999
        return float(np.max(self.geom_pos[world, flat, 2], initial=-np.inf))

    def colours(self) -> list[str]:
        """Colour of each geom: the body's from the palette, grey for the world and kinematic bodies."""
        return [
            STATIC_COLOUR if b < 0 else PALETTE[b % len(PALETTE)] if b < self.dynamic else KINEMATIC_COLOUR
            for b in self.body
        ]

    def _repr_html_(self) -> str:
        """In a notebook a clip plays where it is the value of a cell."""
        from .html import page_of

        page = html.escape(page_of(self), quote=True)
        style = "width:100%;height:440px;border:0"
        return f'<iframe srcdoc="{page}" style="{style}" title="{html.escape(self.title)}"></iframe>'

    def world_index(self, world: int) -> int:
        """``world`` checked, negative ones counted from the end."""
        return _index("world", world, self.shape[0])

    def frame_index(self, frame: int) -> int:
        """``frame`` checked, negative ones counted from the end."""
        return _index("frame", frame, self.shape[1])


def square(lo: np.ndarray, hi: np.ndarray) -> float:
    """Side of a ground square [m]: 1, 2 or 5 times a power of ten, about a sixth of the scene."""
    want = max(float(np.max(hi - lo)) / 6.0, 1e-9)
    power = 10.0 ** np.floor(np.log10(want))
    return float(max(m * power for m in (1, 2, 5) if m * power <= want * 1.0000001))


def grid_offsets(count: int, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Offsets (count, 3) that put worlds with bounds (lo, hi) side by side, row by row from the back left."""
    cols = int(np.ceil(np.sqrt(count)))
    rows = -(-count // cols)
    gap = 0.3 * float(np.max(hi - lo))
    step = (hi - lo) + gap
    i = np.arange(count)
    x, y = i % cols - (cols - 1) / 2, (rows - 1) / 2 - i // cols
    return np.stack([x * step[0], y * step[1], 0.0 * x], -1)


def continuous(quat: np.ndarray) -> np.ndarray:
    """Signs of quaternions (W, T, n, 4) chosen so that none jumps from sample to sample."""
    flip = np.sum(quat[:, 1:] * quat[:, :-1], -1, keepdims=True) < 0
    sign = np.where(np.cumsum(flip, 1) % 2 == 1, -1.0, 1.0)
    return np.concatenate([quat[:, :1], quat[:, 1:] * sign], 1)


def unique_names(labels) -> list[str]:
    """Labels as identifiers (letters, digits and _, no digit first), made unique."""
    seen, names = set(), []
    for label in labels:
        name = re.sub(r"\W", "_", str(label), flags=re.ASCII)
        name = name if name and not name[0].isdigit() else f"_{name}"
        unique, k = name, 1
        while unique in seen:
            k += 1
            unique = f"{name}_{k}"
        seen.add(unique)
        names.append(unique)
    return names


def linear(colour: str) -> np.ndarray:
    """'#rrggbb' as linear light (3,)."""
    return np.array([int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]) ** 2.2


def _index(what: str, value: int, count: int) -> int:
    if not -count <= value < count:
        raise ValueError(f"{what} = {value}: the clip has {count} of them (0..{count - 1})")
    return int(value) % count


def _finite(what: str, value: Any) -> np.ndarray:
    value = np.asarray(value, dtype=np.float64)
    if not np.all(np.isfinite(value)):
        first = tuple(int(i) for i in np.argwhere(~np.isfinite(value))[0])
        raise ValueError(f"clip: {what}{list(first)} = {value[first]} is not finite")
    return value


def _labels(what: str, labels: Sequence[str] | None, count: int, stem: str) -> list[str]:
    if labels is None:
        return [f"{stem} {i}" for i in range(count)]
    if len(labels) != count:
        raise ValueError(f"clip: {len(labels)} {what} for {count}")
    return [str(s) or f"{stem} {i}" for i, s in enumerate(labels)]
