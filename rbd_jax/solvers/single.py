"""Layer 5: one contact of a centred sphere with fixed geometry, in closed form.

Where every body has at most one such contact nothing is coupled: the normal impulse follows from the
normal velocity alone, the friction impulse stops the slip or is mu times the normal one. No iteration,
no warm start. With a = 1/m + r^2/I the inverse mass seen by friction:

    l = max(-(n.u* + bias) m, 0)        p_t = -u_t min(1/a, mu l / |u_t|)

Exact: the slip of a sphere keeps its direction while the sphere slides.
"""

from __future__ import annotations

import jax.numpy as jnp

from ..spatial import Vec3, components, zeros_like
from ..xla import materialise, materialise_linear
from .base import Problem, Solution
from .laws import ContactModel
from .restitution import targets
from .rows import Impulses, Index, add_rows, take, take_tree


def applies(problem: Problem) -> bool:
    """One group, one slot, no partner body, the sphere centred, its body isotropic and in one pair only."""
    if len(problem.rows) != 1:
        return False
    rows = problem.rows[0]
    return (
        rows.a is None
        and rows.slots == 1
        and rows.central_b
        and isinstance(rows.b, Index)
        and len(rows.colours) <= 1
        and rows.mu_spin is None
        and (problem.w is None or problem.inertia.isotropic)
    )


def solve(problem: Problem, model: ContactModel) -> Solution:
    """The solution. The compliance of a model counts only where it is the material's."""
    rows, one = problem.rows[0], problem.one
    n, phi, live = rows.n, rows.phi[0], rows.live[0]
    inv_mass = take(problem.inv_mass, rows.b)
    u = take_tree(problem.v, rows.b)
    if problem.w is not None and rows.mu is not None:
        r = rows.rb.map(lambda c: c[0])
        u = u + take_tree(problem.w, rows.b).cross(r)
    if rows.surface is not None:
        u = u - rows.surface.map(lambda c: c[0])
    un = materialise(n.dot(u), one)
    mass = jnp.where(live, 1.0, 0.0).astype(un.dtype) / inv_mass
    law = model.law(rows, inv_mass[None], problem)
    soft = mass / (1.0 + law.r[0] * mass) if model.physical and law.r is not None else mass
    vhat, events = law.vhat, None
    if rows.e is not None:
        events = targets(rows, problem)
        vhat = jnp.minimum(vhat, events.bound)
    moving = jnp.maximum((vhat[0] - un) * soft, 0.0)
    if model.physical:
        end = moving
    else:  # at the end of the step no bias: what closed its gap or overlaps has stopped
        end = jnp.maximum(-un * mass, 0.0)
        end = jnp.where(phi > 0, jnp.where(moving > 0, end, 0.0), end)
    if events is not None:
        bounce = jnp.maximum((events.vhat[0] - un) * mass, 0.0)
        hit = events.active[0]
        moving, end = jnp.where(hit, bounce, moving), jnp.where(hit, bounce, end)
    moving, end = materialise_linear((moving, end), un, one)
    p = n * end
    t1 = t2 = None
    if rows.mu is not None:
        slip = materialise_linear(u - n * un, un, one)
        a = inv_mass + r.dot(r) * take(problem.inv_inertia.xx, rows.b)
        s2 = slip.dot(slip)
        limit = rows.mu * end
        slides = s2 > (limit * a) ** 2
        scale = jnp.where(slides, limit / jnp.sqrt(jnp.where(slides, s2, 1.0)), 1.0 / a)
        friction = slip * -materialise(jnp.where(live, scale, 0.0), one)
        t1, t2 = (friction.dot(t)[None] for t in rows.tangents)
        p = p + friction
    spread = lambda v: Vec3(
        *(add_rows(jnp.zeros_like(z), rows.b, c, unique=True) for z, c in zip(components(problem.v), components(v)))
    )
    impulse = spread(p)
    turn = None
    if problem.w is not None:
        turn = zeros_like(problem.w) if rows.mu is None else spread(r.cross(friction))
    return Solution(
        impulse=impulse,
        angular_impulse=turn,
        contacts=(Impulses(end[None], t1, t2),),
        v_move=problem.v + (impulse + spread(n * (moving - end))) * problem.inv_mass,
        warm=False,
    )
