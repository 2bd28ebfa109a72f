"""Layer 1: component-wise vectors, quaternions and matrices.

A vector is three arrays, a quaternion four, a matrix nine: never one array with a component
axis. XLA's CPU backend recomputes the producers of a stacked array for every consumer, so
inside a step nothing is stacked, sliced or indexed along components.

Symbols: v, w vectors; q unit quaternion (w, x, y, z), body to world; R = R(q) its rotation
matrix; t rotation vector [rad]. All functions broadcast over the array shapes, and are finite
with finite derivatives everywhere, including at zero (the argument is made safe inside
``where`` before the singular function sees it).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from .struct import struct


@struct
class Vec3:
    """A vector as three arrays of one shape."""

    x: jax.Array
    y: jax.Array
    z: jax.Array

    def __add__(self, o: Vec3) -> Vec3:
        return Vec3(self.x + o.x, self.y + o.y, self.z + o.z)

    def __sub__(self, o: Vec3) -> Vec3:
        return Vec3(self.x - o.x, self.y - o.y, self.z - o.z)

    def __neg__(self) -> Vec3:
        return Vec3(-self.x, -self.y, -self.z)

    def __mul__(self, s) -> Vec3:
        """Scale by a scalar array, or multiply component by component with a Vec3."""
        if isinstance(s, Vec3):
            return Vec3(self.x * s.x, self.y * s.y, self.z * s.z)
        return Vec3(self.x * s, self.y * s, self.z * s)

    __rmul__ = __mul__

    def __truediv__(self, s) -> Vec3:
        if isinstance(s, Vec3):
            return Vec3(self.x / s.x, self.y / s.y, self.z / s.z)
        return Vec3(self.x / s, self.y / s, self.z / s)

    def dot(self, o: Vec3) -> jax.Array:
        return self.x * o.x + self.y * o.y + self.z * o.z

    def cross(self, o: Vec3) -> Vec3:
        return Vec3(
            self.y * o.z - self.z * o.y,
            self.z * o.x - self.x * o.z,
            self.x * o.y - self.y * o.x,
        )

    def map(self, f) -> Vec3:
        return Vec3(f(self.x), f(self.y), f(self.z))


@struct
class Quat:
    """A quaternion (w, x, y, z), body to world, as four arrays."""

    w: jax.Array
    x: jax.Array
    y: jax.Array
    z: jax.Array

    def __matmul__(self, o: Quat) -> Quat:
        """Hamilton product: rotate by ``o`` first, then by ``self``."""
        return Quat(
            self.w * o.w - self.x * o.x - self.y * o.y - self.z * o.z,
            self.w * o.x + self.x * o.w + self.y * o.z - self.z * o.y,
            self.w * o.y - self.x * o.z + self.y * o.w + self.z * o.x,
            self.w * o.z + self.x * o.y - self.y * o.x + self.z * o.w,
        )

    def conj(self) -> Quat:
        return Quat(self.w, -self.x, -self.y, -self.z)

    def vec(self) -> Vec3:
        return Vec3(self.x, self.y, self.z)

    def rotate(self, v: Vec3) -> Vec3:
        """R v, for a unit quaternion: v + 2 u x (u x v + w v)."""
        u = self.vec()
        t = u.cross(v) * 2.0
        return v + t * self.w + u.cross(t)

    def rotate_inv(self, v: Vec3) -> Vec3:
        """Rᵀ v, for a unit quaternion."""
        return self.conj().rotate(v)

    def mat(self) -> Mat3:
        """Rotation matrix of a unit quaternion."""
        w, x, y, z = self.w, self.x, self.y, self.z
        xx, yy, zz = 2 * x * x, 2 * y * y, 2 * z * z
        xy, xz, yz = 2 * x * y, 2 * x * z, 2 * y * z
        wx, wy, wz = 2 * w * x, 2 * w * y, 2 * w * z
        return Mat3(
            Vec3(1 - yy - zz, xy - wz, xz + wy),
            Vec3(xy + wz, 1 - xx - zz, yz - wx),
            Vec3(xz - wy, yz + wx, 1 - xx - yy),
        )

    def normalised(self) -> Quat:
        """q / |q|; the identity where q is zero (padded rows), with finite derivatives."""
        s = self.w * self.w + self.x * self.x + self.y * self.y + self.z * self.z
        ok = s > 0
        r = jax.lax.rsqrt(jnp.where(ok, s, 1.0))
        return Quat(jnp.where(ok, self.w * r, 1.0), self.x * r, self.y * r, self.z * r)

    def map(self, f) -> Quat:
        return Quat(f(self.w), f(self.x), f(self.y), f(self.z))


@struct
class Mat3:
    """A 3x3 matrix as three row vectors."""

    a: Vec3
    b: Vec3
    c: Vec3

    def __matmul__(self, o):
        if isinstance(o, Vec3):
            return Vec3(self.a.dot(o), self.b.dot(o), self.c.dot(o))
        t = o.T
        return Mat3(*(Vec3(r.dot(t.a), r.dot(t.b), r.dot(t.c)) for r in (self.a, self.b, self.c)))

    @property
    def T(self) -> Mat3:
        a, b, c = self.a, self.b, self.c
        return Mat3(Vec3(a.x, b.x, c.x), Vec3(a.y, b.y, c.y), Vec3(a.z, b.z, c.z))

    def tmul(self, v: Vec3) -> Vec3:
        """Mᵀ v."""
        return self.a * v.x + self.b * v.y + self.c * v.z

    def __add__(self, o: Mat3) -> Mat3:
        return Mat3(self.a + o.a, self.b + o.b, self.c + o.c)

    def __sub__(self, o: Mat3) -> Mat3:
        return Mat3(self.a - o.a, self.b - o.b, self.c - o.c)

    def __mul__(self, s) -> Mat3:
        return Mat3(self.a * s, self.b * s, self.c * s)

    __rmul__ = __mul__

    def map(self, f) -> Mat3:
        return Mat3(self.a.map(f), self.b.map(f), self.c.map(f))


def zeros_like(v: Vec3) -> Vec3:
    return v.map(jnp.zeros_like)


def safe_norm(v: Vec3) -> jax.Array:
    """|v|, with derivative 0 (not NaN) at v = 0."""
    s = v.dot(v)
    ok = s > 0
    return jnp.where(ok, jnp.sqrt(jnp.where(ok, s, 1.0)), 0.0)


def unit_or(v: Vec3, fallback: Vec3) -> Vec3:
    """v / |v|, or ``fallback`` where v is exactly zero; finite derivatives."""
    s = v.dot(v)
    ok = s > 0
    r = jax.lax.rsqrt(jnp.where(ok, s, 1.0))
    return Vec3(*(jnp.where(ok, c * r, f) for c, f in zip(components(v), components(fallback))))


def where(mask, a, b):
    """``jnp.where`` over two trees of the same structure."""
    return jax.tree.map(lambda p, q: jnp.where(mask, p, q), a, b)


def qexp(t: Vec3) -> Quat:
    """Quaternion of the rotation vector t [rad]: (cos |t|/2, t sin(|t|/2)/|t|)."""
    t2 = t.dot(t)
    small = t2 < 1e-8
    a = jnp.sqrt(jnp.where(small, 1.0, t2))
    s = jnp.where(small, 0.5 - t2 / 48.0, jnp.sin(0.5 * a) / a)
    c = jnp.where(small, 1.0 - t2 / 8.0, jnp.cos(0.5 * a))
    return Quat(c, t.x * s, t.y * s, t.z * s)


def tangent_basis(n: Vec3) -> tuple[Vec3, Vec3]:
    """Two unit vectors that make a right-handed frame (t1, t2, n) with the unit normal n.

    Source: Duff et al. 2017, "Building an Orthonormal Basis, Revisited" (branch-free).
    """
    sign = jnp.where(n.z >= 0, 1.0, -1.0).astype(n.z.dtype)
    a = -1.0 / (sign + n.z)
    b = n.x * n.y * a
    t1 = Vec3(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x)
    t2 = Vec3(b, sign + n.y * n.y * a, -n.y)
    return t1, t2


# --- arrays with a trailing component axis <-> components (the edges of the program only) ---


def components(v) -> tuple[jax.Array, ...]:
    """The leaf arrays of a Vec3, Quat or Mat3 in order."""
    return tuple(jax.tree.leaves(v))


def vec3(a) -> Vec3:
    """Vec3 from an array (..., 3)."""
    return Vec3(a[..., 0], a[..., 1], a[..., 2])


def quat(a) -> Quat:
    """Quat from an array (..., 4)."""
    return Quat(a[..., 0], a[..., 1], a[..., 2], a[..., 3])


def pack(v) -> jax.Array:
    """Array (..., k) from a Vec3 (k = 3) or Quat (k = 4); numpy in, numpy out."""
    c = components(v)
    stack = np.stack if all(isinstance(a, np.ndarray) for a in c) else jnp.stack
    return stack(c, axis=-1)
