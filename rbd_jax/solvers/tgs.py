"""Layer 5: TGS-soft, one soft Gauss-Seidel sweep and one hard relaxing sweep a (sub)step.

Symbols: n, t1, t2 contact frame; r arm; k effective inverse mass of a row; l accumulated impulse.
Source: Catto, "Solver2D" (2024) and Box2D v3, soft step; Macklin et al. 2019, "Small steps".
Differs: the stiffness is tied to the substep (0.25 / h) without a fixed cap, so that heavy loads
stand; the three rows of a point are one Gauss-Seidel block (normal, then a friction disc).

Cost: about 100 flops a point and sweep. Gradients: of the truncated iteration.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from ..spatial import Vec3
from ..struct import struct
from ..xla import materialise
from . import single
from .base import Problem, Solution, Solver
from .restitution import Events, normal_velocity, targets
from .rows import Impulses, Index, Rows, add_rows, take, take_tree

#: Groups with more rows than this (slots x colours) loop over their slots instead of unrolling them.
UNROLL = 4


@dataclasses.dataclass(frozen=True)
class TGS(Solver):
    """TGS-soft.

    Attributes:
      sweeps: soft sweeps a step, >= 1 (one lets the energy of a tumbling box rise by up to 1.7e-3 m g d a step).
      relax: hard sweeps after the poses have moved, >= 1.
      stiffness: contact frequency times the step [-]; damping_ratio [-].
      push_speed: bound of the speed at which overlap is resolved [m/s]; it moves poses only and is
        taken out of the velocities by the relaxing sweep.
    """

    sweeps: int = 2
    relax: int = 1
    stiffness: float = 0.25
    damping_ratio: float = 10.0
    push_speed: float = 3.0

    name = "tgs"
    contact = "soft"

    def solve(self, problem: Problem) -> Solution:
        if single.applies(problem):
            return single.solve(problem, self._recovery)
        one = problem.one
        groups = [_prepare(rows, problem) for rows in problem.rows]
        lam = list(problem.warm)
        body = (problem.v, problem.w)
        for g, l in zip(groups, lam):
            body = _apply(g, l, body)
        body = materialise(body, one)
        soft = [self._soft(g, problem.h) for g in groups]
        for _ in range(self.sweeps):
            for k, g in enumerate(groups):
                body, lam[k] = _sweep(g, soft[k], lam[k], body, one)
        moving = body
        hard = [_hard(g, l, moving, problem.h) for g, l in zip(groups, lam)]
        for _ in range(self.relax):
            for k, g in enumerate(groups):
                body, lam[k] = _sweep(g, hard[k], lam[k], body, one)
        v, w = body
        return Solution(
            impulse=(v - problem.v) / problem.inv_mass,
            angular_impulse=None if w is None else problem.inertia.momentum(problem.q, w - problem.w),
            contacts=tuple(lam),
            v_move=moving[0],
            w_move=moving[1],
        )

    def _recovery(self, phi, h):
        """Velocity bias of the biased sweep: closes a gap exactly, an overlap softly [m/s]."""
        om = 2.0 * math.pi * self.stiffness  # frequency times h
        recover = om / (2.0 * self.damping_ratio + om) * phi / h
        return jnp.where(phi <= 0, jnp.maximum(recover, -self.push_speed), phi / h)

    def _soft(self, g: _Group, h) -> _Law:
        """Velocity bias, mass scale and impulse scale of the biased sweep."""
        om = 2.0 * math.pi * self.stiffness
        a2 = om * (2.0 * self.damping_ratio + om)
        a3 = 1.0 / (1.0 + a2)
        return _law(g, self._recovery(g.rows.phi, h), g.rows.phi <= 0, a2 * a3, a3)


@struct
class _Group:
    """A group of rows with what every sweep needs: effective masses and, with restitution, events."""

    rows: Rows
    t1: Vec3 | None
    t2: Vec3 | None
    inv_mass_b: jax.Array
    inv_mass_a: jax.Array | None
    inertia_b: object
    inertia_a: object
    mass_n: jax.Array  # 1/k, zero where the slot is not live
    mass_1: jax.Array | None
    mass_2: jax.Array | None
    events: Events | None


@struct
class _Law:
    """l_n' = max(l_n - scale (u + bias) / k - soft l_n, 0); leaves (S, P, B) or scalars."""

    bias: jax.Array
    scale: jax.Array | float
    soft: jax.Array | float


def _law(g: _Group, bias, touching, scale, soft) -> _Law:
    if g.events is None:
        return _Law(
            bias, jnp.where(touching, scale, 1.0).astype(bias.dtype), jnp.where(touching, soft, 0.0).astype(bias.dtype)
        )
    hit = g.events.active
    touching = touching & ~hit
    return _Law(
        jnp.where(hit, -g.events.vhat, bias),
        jnp.where(touching, scale, 1.0).astype(bias.dtype),
        jnp.where(touching, soft, 0.0).astype(bias.dtype),
    )


def _hard(g: _Group, lam: Impulses, body, h) -> _Law:
    """The relaxing sweep: no bias on overlap; gaps as they are after the move.

    A gap that did not close in this step is left alone: its impact belongs to the next step.
    """
    phi = g.rows.phi + h * normal_velocity(g.rows, *body)
    bias = jnp.where(g.rows.phi <= 0, 0.0, jnp.maximum(phi, 0.0) / h)
    idle = (g.rows.phi > 0) & (lam.n <= 0)
    if g.events is not None:
        bias = jnp.where(g.events.active, -g.events.vhat, bias)
        idle = idle & ~g.events.active
    return _Law(bias, jnp.where(idle, 0.0, 1.0).astype(bias.dtype), 0.0)


def _prepare(rows: Rows, problem: Problem) -> _Group:
    one = problem.one
    rows = rows._with(
        rb=materialise(rows.rb, one),
        ra=materialise(rows.ra, one),
        phi=materialise(rows.phi, one),
        n=materialise(rows.n, one),
    )
    t1, t2 = rows.tangents if rows.mu is not None else (None, None)
    spin = problem.w is not None
    sides = []
    for index in (rows.b, rows.a):
        if index is None:
            sides.append((None, None))
        else:
            sides.append((take(problem.inv_mass, index), problem.inv_inertia.take(index) if spin else None))
    (mb, ib), (ma, ia) = sides

    def k(d: Vec3, central_b: bool, central_a: bool):
        total = mb
        if ib is not None and not central_b:
            j = rows.rb.cross(d)
            total = total + j.dot(ib @ j)
        if ma is not None:
            total = total + ma
            if ia is not None and not central_a:
                j = rows.ra.cross(d)
                total = total + j.dot(ia @ j)
        return total

    def mass(d, central_b=False, central_a=False):
        return jnp.where(rows.live, 1.0, 0.0).astype(rows.phi.dtype) / k(d, central_b, central_a)

    return _Group(
        rows,
        t1,
        t2,
        mb,
        ma,
        ib,
        ia,
        mass_n=mass(rows.n, rows.central_b, rows.central_a),
        mass_1=mass(t1) if t1 is not None else None,
        mass_2=mass(t2) if t2 is not None else None,
        events=materialise_events(targets(rows, problem), one) if rows.e is not None else None,
    )


def materialise_events(events: Events, one) -> Events:
    return events._with(vhat=materialise(events.vhat, one), left=materialise(events.left, one))


def _apply(g: _Group, lam: Impulses, body):
    """Velocities after the impulses ``lam`` of one group (warm start)."""
    v, w = body
    rows = g.rows
    p = rows.n * lam.n
    if lam.t1 is not None:
        p = p + g.t1 * lam.t1 + g.t2 * lam.t2
    total = p.map(lambda c: c.sum(0))

    def side(v, w, index, inv_mass, inertia, arm, sign):
        v = Vec3(
            *(add_rows(c, index, sign * inv_mass * d) for c, d in zip((v.x, v.y, v.z), (total.x, total.y, total.z)))
        )
        if w is not None and not (rows.mu is None and (rows.central_b if sign > 0 else rows.central_a)):
            turn = inertia @ arm.cross(p).map(lambda c: c.sum(0))
            w = Vec3(*(add_rows(c, index, sign * d) for c, d in zip((w.x, w.y, w.z), (turn.x, turn.y, turn.z))))
        return v, w

    v, w = side(v, w, rows.b, g.inv_mass_b, g.inertia_b, rows.rb, 1.0)
    if rows.a is not None:
        v, w = side(v, w, rows.a, g.inv_mass_a, g.inertia_a, rows.ra, -1.0)
    return v, w


def _sweep(g: _Group, law: _Law, lam: Impulses, body, one):
    """One Gauss-Seidel sweep over a group: colours one after the other, slots one after the other."""
    rows = g.rows
    pairs = rows.phi.shape[1]
    if not isinstance(rows.b, Index):
        return _sweep_rolled(g, law, lam, body, one)
    colours = rows.colours or ((0, pairs),)
    whole = len(colours) == 1
    if not whole and rows.slots > UNROLL:
        return _sweep_colours(g, law, lam, body, one)
    pieces = []
    for start, stop in colours:

        def cut(x, axis):
            """This colour's pairs; arrays that are the same for all pairs stay as they are."""
            same = lambda c: whole or jnp.ndim(c) <= axis or c.shape[axis] == 1
            return jax.tree.map(lambda c: c if same(c) else jax.lax.slice_in_dim(c, start, stop, axis=axis), x)

        b = Index(rows.b.rows[start:stop])
        a = Index(rows.a.rows[start:stop]) if rows.a is not None else None
        local = (take_tree(body, b), take_tree(body, a) if a is not None else None)
        flat = (rows.n, rows.mu, g.t1, g.t2, g.inv_mass_b, g.inv_mass_a, g.inertia_b, g.inertia_a)
        pair = _pair(rows, *cut(flat, 0), a, b)
        slots = cut((rows.rb, rows.ra, rows.surface, g.mass_n, g.mass_1, g.mass_2, law, lam), 1)
        local, new = _slots(pair, slots, local, one, unroll=rows.slots * len(colours) <= UNROLL)
        body = _write(body, b, local[0])
        if a is not None:
            body = _write(body, a, local[1])
        pieces.append(new)
    if whole:
        return body, pieces[0]
    return body, jax.tree.map(lambda *c: jnp.concatenate(c, axis=1), *pieces)


def _sweep_colours(g: _Group, law: _Law, lam: Impulses, body, one):
    """As ``_sweep``, the colours (all of one width) in a compiled loop: the program does not grow with them.

    A colour may hold dead copies of a pair as padding; their change is exactly zero, so changes are added.
    """
    rows = g.rows
    width = rows.colours[0][1] - rows.colours[0][0]
    count = len(rows.colours)
    table = lambda index: None if index is None else jnp.asarray(index.rows.reshape(count, width))
    table_b, table_a = table(rows.b), table(rows.a)

    def cut(x, axis, k):
        same = lambda c: jnp.ndim(c) <= axis or c.shape[axis] == 1
        part = lambda c: jax.lax.dynamic_slice_in_dim(c, k * width, width, axis=axis)
        return jax.tree.map(lambda c: c if same(c) else part(c), x)

    def colour(carry, k):
        body, lam = carry
        b = table_b[k]
        a = None if table_a is None else table_a[k]
        get = lambda i: jax.tree.map(lambda c: c[i], body)
        old = (get(b), None if a is None else get(a))
        flat = (rows.n, rows.mu, g.t1, g.t2, g.inv_mass_b, g.inv_mass_a, g.inertia_b, g.inertia_a)
        n, mu, t1, t2, mb, ma, ib, ia = cut(flat, 0, k)
        pair = _pair(rows, n, mu, t1, t2, mb, ma, ib, ia)
        slots = cut((rows.rb, rows.ra, rows.surface, g.mass_n, g.mass_1, g.mass_2, law, lam), 1, k)
        new, part = _slots(pair, slots, old, one, unroll=False)
        add = lambda body, i, new, old: jax.tree.map(lambda c, p, q: c.at[i].add(p - q), body, new, old)
        body = add(body, b, new[0], old[0])
        if a is not None:
            body = add(body, a, new[1], old[1])
        put = lambda whole, part: jax.lax.dynamic_update_slice_in_dim(whole, part, k * width, axis=1)
        return (body, jax.tree.map(put, lam, part)), None

    lam = jax.tree.map(lambda c: jnp.broadcast_to(c, rows.phi.shape), lam)
    (body, lam), _ = jax.lax.scan(colour, (body, lam), jnp.arange(count))
    return body, lam


def _pair(rows: Rows, n, mu, t1, t2, inv_mass_b, inv_mass_a, inertia_b, inertia_a, a=None, b=None) -> _Group:
    """What ``_point`` needs of the pairs of one colour."""
    bare = rows._with(
        n=n, mu=mu, rb=None, ra=None, phi=None, live=None, e=None, surface=None, feature=None, law=None, a=a, b=b
    )
    return _Group(bare, t1, t2, inv_mass_b, inv_mass_a, inertia_b, inertia_a, None, None, None, None)


def _write(body, index: Index, values):
    """Put the velocities of a colour back; no row appears twice."""
    rows = index.rows

    def put(x, new):
        if len(rows) == x.shape[0] and np.array_equal(rows, np.arange(len(rows))):
            return new
        return x.at[rows].set(new, unique_indices=True)

    return jax.tree.map(put, body, values)


def _slots(pair: _Group, slots, local, one, unroll: bool):
    """All slots of one colour in order. slots: leaves (S, P, B) or without a slot axis."""
    count = slots[-1].n.shape[0]
    if unroll:
        new = []
        for s in range(count):
            at = jax.tree.map(lambda c: c if jnp.ndim(c) < 3 else c[min(s, c.shape[0] - 1)], slots)
            local, l = _point(pair, at, local, one)
            new.append(l)
        if count == 1:
            return local, jax.tree.map(lambda c: c[None], new[0])
        return local, jax.tree.map(lambda *c: jnp.stack(c), *new)
    leaves, tree = jax.tree.flatten(slots)
    rolled = [jnp.ndim(c) == 3 and c.shape[0] == count for c in leaves]

    def body(local, xs):
        xs = iter(xs)
        at = [next(xs) if r else (c if jnp.ndim(c) < 3 else c[0]) for r, c in zip(rolled, leaves)]
        return _point(pair, jax.tree.unflatten(tree, at), local, one)

    return jax.lax.scan(body, local, [c for r, c in zip(rolled, leaves) if r])


def _point(pair: _Group, at, local, one):
    """Update one slot of every pair of a colour: normal impulse, then the friction disc."""
    rb, ra, surface, mass_n, mass_1, mass_2, law, lam = at
    rows = pair.rows
    n, t1, t2 = rows.n, pair.t1, pair.t2
    (vb, wb), other = local
    va, wa = other if other is not None else (None, None)
    spin = wb is not None

    def velocity(d, central_b, central_a):
        """d . u"""
        u = d.dot(vb)
        if spin and not central_b:
            u = u + rb.cross(d).dot(wb)
        if va is not None:
            u = u - d.dot(va)
            if spin and not central_a:
                u = u - ra.cross(d).dot(wa)
        if surface is not None:
            u = u - d.dot(surface)
        return u

    u = velocity(n, rows.central_b, rows.central_a)
    ln = jnp.maximum(lam.n - mass_n * law.scale * (u + law.bias) - law.soft * lam.n, 0.0)
    ln = materialise(ln, one)
    dn = ln - lam.n
    p = n * dn
    l1 = l2 = None
    if rows.mu is not None:
        u1, u2 = velocity(t1, False, False), velocity(t2, False, False)
        if spin and not rows.central_b:
            j = pair.inertia_b @ rb.cross(n)
            u1, u2 = u1 + rb.cross(t1).dot(j) * dn, u2 + rb.cross(t2).dot(j) * dn
        if spin and va is not None and not rows.central_a:
            j = pair.inertia_a @ ra.cross(n)
            u1, u2 = u1 + ra.cross(t1).dot(j) * dn, u2 + ra.cross(t2).dot(j) * dn
        c1, c2 = materialise((lam.t1 - mass_1 * u1, lam.t2 - mass_2 * u2), one)
        limit, c = rows.mu * ln, c1 * c1 + c2 * c2
        slips = c > limit * limit
        shrink = jnp.where(slips, limit / jnp.sqrt(jnp.where(slips, c, 1.0)), 1.0)
        l1, l2 = c1 * shrink, c2 * shrink
        p = p + t1 * (l1 - lam.t1) + t2 * (l2 - lam.t2)
    p = materialise(p, one)
    vb = vb + p * pair.inv_mass_b
    if spin and not (rows.mu is None and rows.central_b):
        wb = wb + pair.inertia_b @ rb.cross(p)
    new = (materialise((vb, wb), one), None)
    if va is not None:
        va = va - p * pair.inv_mass_a
        if spin and not (rows.mu is None and rows.central_a):
            wa = wa - pair.inertia_a @ ra.cross(p)
        new = (new[0], materialise((va, wa), one))
    return new, Impulses(ln, l1, l2)


def _sweep_rolled(g: _Group, law: _Law, lam: Impulses, body, one):
    """Pairs that differ from world to world: one pair after the other, its slots in order."""
    rows = g.rows
    worlds = rows.b.shape[1]
    pairs = rows.b.shape[0]
    column = jnp.arange(worlds)

    def by_pair(x, axis):
        spread = lambda c: jnp.broadcast_to(c, (*c.shape[:axis], pairs, c.shape[axis + 1]))
        return jax.tree.map(lambda c: c if jnp.ndim(c) == 0 else jnp.moveaxis(spread(c), axis, 0), x)

    static_part = (
        rows.b,
        rows.a,
        by_pair(rows.n, 0),
        by_pair(g.t1, 0),
        by_pair(g.t2, 0),
        by_pair(rows.mu, 0),
        by_pair(g.inv_mass_b, 0),
        by_pair(g.inv_mass_a, 0),
        by_pair(g.inertia_b, 0),
        by_pair(g.inertia_a, 0),
    )
    slots = by_pair((rows.rb, rows.ra, rows.surface, g.mass_n, g.mass_1, g.mass_2, law, lam), 1)
    # scalars of the law are loop constants
    leaves, tree = jax.tree.flatten((static_part, slots))
    rolled = [jnp.ndim(c) > 0 for c in leaves]

    def step(body, xs):
        xs = iter(xs)
        (b, a, n, t1, t2, mu, mb, ma, ib, ia), slot = jax.tree.unflatten(
            tree, [next(xs) if r else c for r, c in zip(rolled, leaves)]
        )
        row = lambda x: jax.tree.map(lambda c: c[None], x)  # a pair axis of one
        pair = _pair(rows, *row((n, mu, t1, t2, mb, ma, ib, ia)))
        get = lambda i: jax.tree.map(lambda c: c[i, column][None], body)
        local = (get(b), get(a) if a is not None else None)
        slot = jax.tree.map(lambda c: c if jnp.ndim(c) == 0 else c[:, None], slot)
        local, new = _slots(pair, slot, local, one, unroll=rows.slots <= 2)
        body = jax.tree.map(lambda c, d: c.at[b, column].set(d[0]), body, local[0])
        if a is not None:
            body = jax.tree.map(lambda c, d: c.at[a, column].set(d[0]), body, local[1])
        return body, jax.tree.map(lambda c: c[:, 0], new)

    body, new = jax.lax.scan(step, body, [c for r, c in zip(rolled, leaves) if r])
    return body, jax.tree.map(lambda c: jnp.moveaxis(c, 0, 1), new)
