"""Layer 5: MuJoCo's soft contact law of a row. (``ResolvedScene.pair_softness`` combines the numbers of two geoms.)

A row with impedance d(r), regularisation R and reference acceleration

    a_ref = -b u_n - k d r  (normal),  -b u_t  (friction),     r = phi - margin,  R = (1 - d) / d * A

stands for a constraint whose force is f = (a_ref - a) / R, limited to the friction cone. A is the sum of the
translational inverse masses; friction rows have R / impratio, those of torsion and rolling, with the coefficient
nu [m], R / impratio (mu / nu)^2.

Source: MuJoCo documentation, "Computation: constraint model", and the numbers of ``MjData`` (efc_KBIP, efc_R,
efc_aref) of version 4.0.1, in which a contact acts where phi < margin and margins of two geoms add.

Symbols: solref (timeconst, dampratio), or (-stiffness, -damping) where negative; solimp (dmin, dmax, width,
midpoint, power).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..struct import static, struct

#: MuJoCo's limits of impedance and friction, and its smallest divisor.
MIN_IMPEDANCE, MAX_IMPEDANCE, MIN_FRICTION, MIN_VALUE = 1e-4, 0.9999, 1e-5, 1e-15


@struct
class MujocoLaw:
    """Law of every pair of a group (``Rows.law``); leaves (P, 1) or (P, B), impratio any such shape.

    timeconst, dampratio: solref, or -stiffness, -damping where they are negative.
    dmin, dmax, width, midpoint, power: solimp.
    margin: a contact acts where phi < margin [m]. impratio: ratio of friction to normal impedance.
    timeconst_friction, dampratio_friction: solreffriction, None = solref.
    condim: contact dimension of each pair; None = all that the group has rows for.
    refsafe: the time constant is at least two steps.
    """

    timeconst: jax.Array
    dampratio: jax.Array
    dmin: jax.Array
    dmax: jax.Array
    width: jax.Array
    midpoint: jax.Array
    power: jax.Array
    margin: jax.Array
    impratio: jax.Array
    timeconst_friction: jax.Array | None = None
    dampratio_friction: jax.Array | None = None
    condim: jax.Array | None = None
    refsafe: bool = static(default=True)


# --- one row ---------------------------------------------------------------------------------------


def impedance(law: MujocoLaw, phi: jax.Array) -> jax.Array:
    """d(r) [-], between dmin at the margin and dmax at the width."""
    dmin, dmax = (jnp.clip(d, MIN_IMPEDANCE, MAX_IMPEDANCE) for d in (law.dmin, law.dmax))
    mid = jnp.clip(law.midpoint, MIN_IMPEDANCE, MAX_IMPEDANCE)
    power = jnp.maximum(law.power, 1.0)
    flat = (dmin == dmax) | (law.width <= MIN_VALUE)
    x = jnp.abs(phi - law.margin) / jnp.where(flat, 1.0, law.width)
    inside = (x > 0) & (x < 1)
    x = jnp.where(inside, x, 0.5)
    low = x <= mid
    base = jnp.where(low, x / mid, (1.0 - x) / (1.0 - mid)) ** power
    y = jnp.where(low, mid * base, 1.0 - (1.0 - mid) * base)
    d = jnp.where(inside, dmin + y * (dmax - dmin), jnp.where(jnp.abs(phi - law.margin) > 0, dmax, dmin))
    return jnp.where(flat, 0.5 * (dmin + dmax), d)


def stiffness_damping(law: MujocoLaw, h: jax.Array, timeconst, dampratio) -> tuple[jax.Array, jax.Array]:
    """k [1/s^2] and b [1/s] of a_ref = -b u - k d r."""
    dmax = jnp.clip(law.dmax, MIN_IMPEDANCE, MAX_IMPEDANCE)
    direct = timeconst <= 0
    tc = jnp.where(direct, 1.0, jnp.maximum(timeconst, 2.0 * h) if law.refsafe else timeconst)
    ratio = jnp.where(direct, 1.0, dampratio)
    k = 1.0 / jnp.maximum(dmax * dmax * tc * tc * ratio * ratio, MIN_VALUE)
    b = 2.0 / jnp.maximum(dmax * tc, MIN_VALUE)
    return jnp.where(direct, -timeconst / (dmax * dmax), k), jnp.where(dampratio <= 0, -dampratio / dmax, b)
