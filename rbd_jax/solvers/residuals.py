"""Layer 5: how well a solution solves its contact problem, and the work the contacts do.

Residuals compare impulses p and end-of-step velocities u with the law of the contact model (``Solver.final_law``):

    Signorini            0 <= p_n  complementary to  g = u_n - vhat + r p_n >= 0      |min(w p_n, g)| [m/s], |p_n g| [J]
    cone                 |p_t| <= mu p_n                                              max(|p_t| - mu p_n, 0) [N s]
    maximum dissipation  p_t minimises p_t . u_t in the cone                          |mu p_n |u_t| + p_t . u_t| [J]

w is the inverse mass seen by the row; r = 0 and vhat = 0 is the rigid contact. Torsional and rolling friction have a
cone of their own each, |p_i| <= mu_i p_n (counted as p_i mu / mu_i), and add to the power; where the solver is
``elliptic``, |(p_i / mu_i)| <= p_n over all friction rows of a point is the one cone.

Sources: Acary, Cadoux 2013 ("Applications of an existence result for the Coulomb friction problem"), natural map and
maximum dissipation; Le Lidec et al. 2023 ("Contact models in robotics: a comparative analysis"), one number each.
Differs: in the units of the row, and against the model's own law, so that a compliant model that is solved has none.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..struct import struct
from . import dense
from .base import Problem, Solution, Solver
from .dense import Contacts
from .restitution import targets
from .rows import Impulses, Rows


@struct
class Residuals:
    """Of one solved problem, per world (B,): the worst of all rows, and sums over them.

    signorini [m/s], complementarity [J], cone [N s], dissipation [J]: see the module text.
    momentum: impulse that a body received against those of its contacts [N s]. points: contact points with an impulse.
    friction, normal: work that the bodies lose in the friction and normal rows [J]. surfaces: work that kinematic
    surfaces do [J].
    """

    signorini: jax.Array
    complementarity: jax.Array
    cone: jax.Array
    dissipation: jax.Array
    momentum: jax.Array
    points: jax.Array
    friction: jax.Array
    normal: jax.Array
    surfaces: jax.Array


def nothing(worlds: int, dtype) -> Residuals:
    """Of a world without contact."""
    zero = jnp.zeros(worlds, dtype)
    return Residuals(zero, zero, zero, zero, zero, jnp.zeros(worlds, jnp.int32), zero, zero, zero)


def residuals(solver: Solver, problem: Problem, solution: Solution) -> Residuals:
    """Residuals and work of a solution; rounding of u is that of the body velocities."""
    cs = tuple(dense.contacts(rows, problem) for rows in problem.rows)
    parts = [
        _group(solver, c, rows, p, problem, solution, load)
        for c, rows, p, load in zip(cs, problem.rows, solution.contacts, problem.loads)
    ]
    impulse, _ = dense.on_bodies(cs, solution.contacts, problem)
    miss = impulse - solution.impulse
    momentum = _length((miss.x, miss.y, miss.z)).max(axis=0)
    total = parts[0]
    for part in parts[1:]:
        worst = {k: jnp.maximum(total[k], part[k]) for k in WORST}
        total = {k: worst[k] if k in WORST else total[k] + part[k] for k in total}
    return Residuals(momentum=momentum, **total)


WORST = ("signorini", "complementarity", "cone", "dissipation")


def _group(solver: Solver, c: Contacts, rows: Rows, p: Impulses, problem: Problem, solution: Solution, load) -> dict:
    v, w = solution.velocities(problem)
    shape = jnp.broadcast_shapes(rows.live.shape, (1, 1, problem.v.x.shape[-1]))
    live = jnp.broadcast_to(rows.live, shape)
    u = dense.relative(c, rows, v, w)
    k = dense.inverse_mass(c, problem)
    law = solver.final_law(rows, p, k, problem, solution, load)
    gap = u.n - law.vhat if law.r is None else u.n - law.vhat + law.r * p.n
    worst = lambda x: jnp.where(live, x, 0.0).max(axis=(0, 1))
    total = lambda x: jnp.where(live, x, 0.0).sum(axis=(0, 1))
    zero = jnp.zeros(shape[-1], problem.v.x.dtype)
    work, surfaces = _work(c, rows, p, problem, v, w)
    work_n, work_t = work
    out = dict(
        signorini=worst(jnp.abs(jnp.minimum(k * p.n, gap))),
        complementarity=worst(jnp.abs(p.n * gap)),
        cone=zero,
        dissipation=zero,
        points=(live & (p.n > 0)).sum(axis=(0, 1), dtype=jnp.int32),
        friction=zero if work_t is None else total(-work_t),
        normal=total(-work_n),
        surfaces=zero if surfaces is None else total(surfaces),
    )
    if rows.mu is None:
        return out
    rows_of = dict(t1=rows.mu, t2=rows.mu, s=rows.mu_spin, r1=rows.mu_roll, r2=rows.mu_roll)
    blocks = [b for b in (("t1", "t2"), ("s",), ("r1", "r2")) if rows_of[b[0]] is not None]
    if solver.elliptic:
        blocks = [sum(blocks, ())]
    cone = dissipation = 0.0
    for block in blocks:
        nu = {e: rows_of[e] for e in block}
        # an angular impulse in the units of sliding: p_i mu / mu_i
        share = {e: 1.0 if e in ("t1", "t2") else jnp.where(m > 0, rows.mu / jnp.where(m > 0, m, 1.0), 0.0)
                 for e, m in nu.items()}  # fmt: skip
        friction = _length([getattr(p, e) * share[e] for e in block])
        slip = _length([getattr(u, e) * nu[e] for e in block])
        cone = jnp.maximum(cone, friction - rows.mu * p.n)
        dissipation = dissipation + p.n * slip + sum(getattr(p, e) * getattr(u, e) for e in block)
    out["cone"] = worst(jnp.maximum(cone, 0.0))
    out["dissipation"] = worst(jnp.abs(dissipation))
    return out


def _work(c: Contacts, rows: Rows, p: Impulses, problem: Problem, v, w):
    """Work of every slot on its bodies relative to their partner, normal and friction, and that of the surface [J].

    An impulse p at an instant does the work p . (u- + u+) / 2. An impact acts at its own instant; a resting
    contact acts over the whole step, so at its middle.
    """
    half = lambda a, b: None if a is None else (a + b) * 0.5
    u = dense.relative(c, rows, half(problem.v, v), half(problem.w, w))
    dv, dw = problem.v - problem.v0, None if problem.w is None else problem.w - problem.w0
    kick = dense.at_points(c, dv, dw)
    left = 0.5
    if rows.e is not None:
        events = targets(rows, problem)
        left = jnp.where(events.active, events.left / problem.h, left)
    u = jax.tree.map(lambda a, b: a - b * left, u, kick)
    normal = p.n * u.n
    friction = None if rows.mu is None else dense.row_dot(p, u) - normal
    surfaces = None
    if rows.surface is not None:
        zero = jax.tree.map(jnp.zeros_like, (problem.v, problem.w))
        surfaces = -dense.row_dot(p, dense.relative(c, rows, *zero))
    return (normal, friction), surfaces


def _length(parts) -> jax.Array:
    """Euclidean length with derivative 0 (not NaN) at 0."""
    s = sum(x * x for x in parts)
    ok = s > 0
    return jnp.where(ok, jnp.sqrt(jnp.where(ok, s, 1.0)), 0.0)
