"""Errors of a motion: distances to the truth, and what needs no truth."""

from __future__ import annotations

import numpy as np

#: Centres farther outside a plane than this many radii have left the scene.
LOST = 1.0


def position(motion, other, case) -> np.ndarray:
    """(B,) root mean square over samples and bodies of the distance of the centres [m]."""
    d = ((motion.pos - other.pos) ** 2).sum(-1)
    return np.sqrt(d[1:].mean(axis=(0, 2)))


def attitude(motion, other, case) -> np.ndarray:
    """(B,) root mean square over samples and bodies of the angle between the attitudes [rad]."""
    unit = lambda q: q / np.linalg.norm(q, axis=-1, keepdims=True)
    a, b = unit(motion.quat), unit(other.quat)
    b = b * np.sign((a * b).sum(-1, keepdims=True))
    angle = 4 * np.arcsin(np.minimum(1.0, np.linalg.norm(a - b, axis=-1) / 2))
    return np.sqrt((angle[1:] ** 2).mean(axis=(0, 2)))


def last_velocity(motion, other, case) -> np.ndarray:
    """(B,) at the last sample: the larger of velocity and spin times size, over the truth's speed [-]."""
    size = np.array([min(p.size) for p in case.parts])
    dv = np.linalg.norm(motion.vel[-1] - other.vel[-1], axis=-1)
    dw = np.linalg.norm(motion.omega[-1] - other.omega[-1], axis=-1) * size
    speed = np.linalg.norm(other.vel[-1], axis=-1)
    return (np.maximum(dv, dw) / speed).max(-1)


def travelled(motion, other, case) -> np.ndarray:
    """(B,) distance of the last horizontal positions over the way the truth has gone [-]."""
    gone = np.linalg.norm(other.pos[-1, :, 0, :2] - other.pos[0, :, 0, :2], axis=-1)
    return np.linalg.norm(motion.pos[-1, :, 0, :2] - other.pos[-1, :, 0, :2], axis=-1) / gone


def energy(motion, case) -> np.ndarray:
    """(T, B) kinetic and potential energy [J]."""
    total = 0.0
    for k, part in enumerate(case.parts):
        q, w = motion.quat[:, :, k], motion.omega[:, :, k]
        body = rotated(q, w, back=True)
        total = total + 0.5 * part.mass * (motion.vel[:, :, k] ** 2).sum(-1) + 0.5 * (body**2 @ np.array(part.inertia))
        total = total - part.mass * motion.pos[:, :, k] @ np.array(case.gravity)
    return total


def energy_change(motion, other, case) -> np.ndarray:
    """(B,) largest change of the energy over the energy at the start [-]."""
    e = energy(motion, case)
    return np.abs(e / e[0] - 1).max(0)


def rest_forces(motion, other, case) -> np.ndarray:
    """(B,) of a column at rest, bodies from the bottom up: the force that carries a body and all above it, over their
    weight, minus 1; root mean square over the bodies and over the last fifth of the intervals between two samples.

    By the balance of momentum, so that any engine can be asked: the mean of the force over an interval.
    """
    mass, g = np.array([p.mass for p in case.parts]), -case.gravity[2]
    late = slice(-max(len(motion.time) // 5, 1) - 1, None)
    gained = np.diff(motion.vel[late, ..., 2], axis=0) / np.diff(motion.time[late])[:, None, None]
    from_top = lambda x: np.cumsum(x[..., ::-1], axis=-1)[..., ::-1]
    carried = from_top(mass * (gained + g)) / from_top(mass * g)
    return np.sqrt(((carried - 1) ** 2).mean(axis=(0, 2)))


def overlap(motion, other, case) -> np.ndarray:
    """(B,) deepest overlap at the last sample over the smallest half-size [-]; infinite where a body has left."""
    from common import MuJoCo  # MuJoCo's geometry is the ruler of every engine

    depth = np.zeros(motion.pos.shape[1])
    size = min(min(p.size) for p in case.parts)
    if all(p.kind == "sphere" for p in case.parts):
        depth = _sphere_overlap(motion.pos[-1], case)
    else:
        ruler = MuJoCo(case.scene(), case.steps[0], threads=1)
        poses = np.concatenate([motion.pos[-1], motion.quat[-1]], -1).reshape(len(depth), -1)
        for world, q in enumerate(poses):
            depth[world] = ruler.penetration(q) if np.isfinite(q).all() else np.inf
        ruler.close()
    for point, normal in case.planes:
        height = (motion.pos[-1] - np.array(point)) @ np.array(normal)
        depth = np.where((height < -LOST * size).any(-1), np.inf, depth)
    return depth / size


def _sphere_overlap(pos, case) -> np.ndarray:
    radius = np.array([p.size[0] for p in case.parts])
    gap = np.linalg.norm(pos[:, :, None] - pos[:, None], axis=-1) - radius[:, None] - radius
    gap[:, np.arange(len(radius)), np.arange(len(radius))] = np.inf
    deepest = -gap.min(axis=(1, 2))
    for point, normal in case.planes:
        deepest = np.maximum(deepest, (radius - (pos - np.array(point)) @ np.array(normal)).max(-1))
    return np.maximum(deepest, 0.0)


def rotated(q, x, back=False) -> np.ndarray:
    """Vectors ``x`` turned by quaternions ``q`` (w, x, y, z), or back."""
    u = -q[..., 1:] if back else q[..., 1:]
    t = 2 * np.cross(u, x)
    return x + q[..., :1] * t + np.cross(u, t)


def random_quat(rng, *shape) -> np.ndarray:
    q = rng.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def yaw(angle) -> np.ndarray:
    """Quaternions (..., 4) of turns about z by ``angle`` [rad]."""
    angle = np.asarray(angle)
    zero = np.zeros_like(angle)
    return np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], -1)


def times(p, q) -> np.ndarray:
    """Product of quaternions (..., 4)."""
    w = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(-1, keepdims=True)
    return np.concatenate([w, p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + np.cross(p[..., 1:], q[..., 1:])], -1)
