"""Layer 5: the iteration of ``NewtonLagged`` point after point, for programs that are one function of the CPU.

The Newton steps of ``newton``, of the points that are live in some world of the tile only, and of a world until its
rows are solved: a stack at rest takes none. What a world takes does not depend on the others.

A row is solved where the velocity that it lacks (``NewtonLagged.mismatch``) is below SETTLED of the largest one that a
normal impulse of its world gives, or where rounding hides it, ROUNDING of the fastest relative velocity.

Everything of a pair is taken about the centre of its body B, in the contact frame, for which the arm of body A is
that of B and one vector d more: relative velocities are those of one twist (V, W), u = V + W x r with
V = vB - vA - wA x d and W = wB - wA; the sums over the points are K = sum G, C = sum [r]x G, Z = sum [r]x G [r]x'; and
what A sees of them, in world axes, needs no points: C_a = C + [d]x K, [rb]x G [ra]x' = Z + C [d]x', and so on.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from ..loops import Listed, add, each_pair, listed, of_pair, of_point, only_if, over, read, repeat
from ..spatial import Vec3, components
from ..struct import struct
from ..xla import materialise, piece
from . import block_ldl, dense
from .base import Problem
from .block_ldl import Blocks, entry
from .dense import Contacts
from .matrices import across, combined, frame, rotated, transposed, vector
from .rows import Impulses, Index, Rows

#: What a row may lack [-], over the load and over the fastest relative velocity of its world (in float64 1e-3 of that).
SETTLED, ROUNDING = 1e-5, 3e-7


@struct
class Group:
    """A group of pairs: all that its rows depend on besides the impulses.

    law, free: as in ``newton._System``, ``free.n`` relative to its target. apart: d, (P, B) world axes; None without
    two arms. rows_b, rows_a: body of every pair, int32 (P,). live: points that are live in any world, int32 (P, S).
    pairs: those that have such points.
    """

    c: Contacts
    law: object
    free: Impulses
    apart: Vec3 | None
    rows_b: jax.Array
    rows_a: jax.Array | None
    live: jax.Array
    pairs: Listed


def group(make, rows: Rows, warm: Impulses, load, problem: Problem):
    """A group, and its impulses and bounds of friction to start from.

    make(rows, warm, load, problem) -> (contacts, law, free velocities, impulses, bounds).
    """
    live = rows.live.any(axis=-1).T
    index = lambda i: None if i is None else jnp.asarray(i.rows)
    rows_b, rows_a = index(rows.b), index(rows.a)
    of_bodies, leaves = _split(problem)

    def local(pair, rows, warm, load):
        if pair is None:
            return _bare(*make(rows, warm, load, problem))
        ends = [i[pair] for i in (rows_b, rows_a) if i is not None]
        both = jax.tree.map(lambda *c: jnp.concatenate(c), *[read(of_bodies, row) for row in ends])
        rows = rows._with(b=Index([0]), a=None if rows_a is None else Index([1]))
        return _bare(*make(rows, warm, load, leaves(materialise(both, problem.one))))

    c, law, free, p, bound = each_pair(local, live.any(axis=1), rows, warm, load)
    apart = None
    if c.ra is not None:
        apart = Vec3(*(a[0] - b[0] for a, b in zip(components(rows.ra), components(rows.rb))))
    apart = materialise(apart, problem.one)
    free = free._with(n=materialise(free.n - law.vhat, problem.one))
    return Group(c, law, free, apart, rows_b, rows_a, live.astype(jnp.int32), listed(live.any(axis=1))), p, bound


def _bare(c: Contacts, *others):
    return c._with(b=Index([0]), a=None if c.a is None else Index([1])), *others


def _split(problem: Problem):
    """The arrays of bodies (n, B or 1) of a problem, and the problem with others in their place."""
    leaves, tree = jax.tree.flatten(problem)
    wide = [jnp.ndim(c) > 1 for c in leaves]

    def replaced(values):
        values = iter(values)
        return tree.unflatten([next(values) if w else c for w, c in zip(wide, leaves)])

    return [c for w, c in zip(wide, leaves) if w], replaced


def solve(solver, groups, p, bound, problem: Problem):
    """Impulses and their totals.

    Args:
      groups: of ``Group``. p, bound: impulses and bounds of friction to start from, a tuple of them each.

    Returns:
      (p, impulse, angular impulse of every body, whether a world is unconverged).
    """
    one, worlds = problem.one, problem.v.x.shape[-1]
    own, half = piece(own_blocks)(problem), max(1, solver.iterations // 2)
    full = lambda c: jnp.broadcast_to(c, (*c.shape[:-1], worlds))
    p, bound = jax.tree.map(full, (p, bound))
    zero = jnp.zeros(worlds, own.dtype)
    settled, rounding = (x * (1.0 if zero.dtype == jnp.float32 else 1e-3) for x in (SETTLED, ROUNDING))
    on = lambda pass_, *rest: piece(functools.partial(pass_, solver))(*rest, one)

    def step(carry):
        """What the impulses do, and better ones for the worlds that are not solved with them."""
        k, p, bound, _, done, _, _, below = carry
        learn = (k >= 1) & (k <= half) & ~done
        bound = tuple(jnp.where(learn, jnp.maximum(q.n, 0.0), g) for q, g in zip(p, bound))
        total = nothing(own)
        for g, q in zip(groups, p):
            total = on(totals, g, q, total)
        motion = piece(response)(problem, total)
        worst = (zero,) * 4
        for g, q, b in zip(groups, p, bound):
            worst = on(violation, g, q, b, motion, worst)
        verdict = lambda lacks, rest, scale, load: (
            rest > solver.tolerance * scale + solver.slip_speed,
            lacks <= jnp.maximum(settled * load, rounding * scale),
        )
        wrong, solved = piece(verdict)(*worst)
        done = done | solved
        more = (k < solver.iterations) & ~done.all()

        def newton(carry):
            p, below = carry
            h = Blocks(own, nothing(own), below, None if below is None else jnp.zeros(below.shape[0], jnp.int32))
            for g, q, b in zip(groups, p, bound):
                h = on(assembled, g, q, b, motion, h)
            d = vectors(piece(block_ldl.solve)(h, one))
            p = tuple(on(stepped, g, q, b, motion, d, done) for g, q, b in zip(groups, p, bound))
            return p, h.below

        p, below = only_if(more.astype(jnp.int32), newton, (p, below))
        return k + 1, p, bound, total, done, wrong, more, below

    never = jnp.zeros(worlds, bool)
    below = None
    if any(g.rows_a is not None for g in groups):
        n, m, _, _ = own.shape
        below = jnp.zeros((n * (n - 1) // 2, m, m, worlds), own.dtype)
    start = (jnp.int32(0), p, bound, nothing(own), never, never, jnp.asarray(True), below)
    _, p, _, total, _, wrong, *_ = jax.lax.while_loop(lambda carry: carry[6], step, start)
    return p, *vectors(total), wrong


def response(problem: Problem, total):
    """Velocity changes of impulses ``total`` (n, m, B)."""
    return materialise(dense.response(problem, *vectors(total)), problem.one)


def vectors(c) -> tuple[Vec3, Vec3 | None]:
    """The columns (n, m, B) as vectors (n, B): the first three entries, and the next three if there are."""
    part = lambda first: Vec3(*(c[:, first + i] for i in range(3)))
    return part(0), part(3) if c.shape[1] == 6 else None


# --- loops over pairs and their points ---


def over_points(g: Group, pair, body, carry):
    """``carry = body(slot, carry)`` for the points of a pair that are live anywhere."""
    each = lambda slot, carry: only_if(g.live[pair, slot], lambda carry: body(slot, carry), carry)
    return repeat(0, g.live.shape[1], each, carry)


def over_pairs(g: Group, body, carry, *others):
    """``carry = body(pair, bodies, carry, *parts)`` for the pairs that are live anywhere.

    bodies: rows of B and, where there is one, of A. parts: what of ``others`` belongs to the pair.
    """

    def each(pair, carry):
        return body(
            pair, [rows[pair] for rows in (g.rows_b, g.rows_a) if rows is not None], carry, *of_pair(others, pair)
        )

    return over(g.pairs, each, carry)


# --- one pair, about the centre of its body B ---


def twist(g: Group, pair, bodies, motion, one) -> tuple[Vec3, Vec3 | None]:
    """(V, W) in the contact frame, of velocities ``motion`` of the bodies."""
    c = of_pair(g.c, pair)
    v, w = read(motion, bodies[0])
    if len(bodies) > 1:
        va, wa = read(motion, bodies[1])
        v = v - va
        if g.apart is not None:
            v, w = v - wa.cross(of_pair(g.apart, pair)), w - wa
    return materialise((c.turn(v), None if c.rb is None else c.turn(w)), one)


def at_point(c: Contacts, twist, slot) -> Impulses:
    """V + W x r of a point."""
    v, w = twist
    r = of_point(c.rb, slot)
    if r is None:
        return Impulses(v.z, v.x, v.y) if c.friction else Impulses(v.z)
    z = v.z + (w.x * r.y - w.y * r.x)
    if not c.friction:
        return Impulses(z)
    return Impulses(z, v.x + (w.y * r.z - w.z * r.y), v.y + (w.z * r.x - w.x * r.z))


def linear(solver, c: Contacts, law, free: Impulses, p: Impulses, bound, motion, slot, one):
    """Of a point: its impulse, and the law linearised at its velocity (base and Hessian)."""
    u = jax.tree.map(lambda x, y: x + y, of_point(free, slot), at_point(c, motion, slot))
    p = materialise(of_point(p, slot), one)
    part = c._with(live=of_point(c.live, slot))
    return p, materialise(
        solver._linearise(part, of_point(law, slot), None, of_point(bound, slot), p, materialise(u, one)), one
    )


def wrench(c: Contacts, p: Impulses, slot):
    """Impulse and angular impulse r x p of a point in the contact frame, lists of three; None = zero."""
    force = [p.t1, p.t2, p.n]
    r = of_point(c.rb, slot)
    return force, None if r is None else dense._cross(r, force)


def on_bodies(x, q, force, torque, apart, bodies, one):
    """x (n, m, B) with a wrench about the centre of B added to B and taken from A; lists in the contact frame."""
    force = materialise(combined(q, force), one)
    x = add(x, (bodies[0], 0, 0), force)
    if len(bodies) > 1:
        x = add(x, (bodies[1], 0, 0), -force)
    if torque is None:
        return x
    torque = materialise(combined(q, torque), one)
    x = add(x, (bodies[0], 3, 0), torque)
    if len(bodies) > 1:
        x = add(x, (bodies[1], 3, 0), -torque - _crossed(apart, force))
    return x


def _crossed(columns, x):
    """d x x of a column x (1, 3, B), with the columns of [d]x."""
    return sum(columns[i] * entry(x, i) for i in range(3))


def cross_columns(d: Vec3 | None, one):
    """The columns of [d]x, (1, 3, B) each."""
    if d is None:
        return None
    zero = 0.0 * d.x
    columns = ((zero, d.z, -d.y), (-d.z, zero, d.x), (d.y, -d.x, zero))
    return [materialise(vector(c), one) for c in columns]


# --- passes over the pairs ---


def totals(solver, g: Group, p: Impulses, total, one):
    """``total`` (n, m, B) with impulse and angular impulse of p on every body."""

    def add(pair, bodies, total, c, p, apart):
        zero = jnp.zeros((1, 1, total.shape[-1]), total.dtype)
        plus = lambda slot, sums: jax.tree.map(jnp.add, sums, wrench(c, of_point(p, slot), slot))
        shape = jax.eval_shape(lambda: wrench(c, of_point(p, 0), 0))
        force, torque = over_points(g, pair, plus, jax.tree.map(lambda _: zero, shape))
        return on_bodies(total, frame(c.t1, c.t2, c.n, one), force, torque, cross_columns(apart, one), bodies, one)

    return over_pairs(g, add, total, g.c, p, g.apart)


def violation(solver, g: Group, p: Impulses, bound, motion, worst, one):
    """The largest of ``worst`` and of all rows, (B,) each: ``NewtonLagged.mismatch``."""

    def add(pair, bodies, worst, c, law, p, bound, free):
        moves = twist(g, pair, bodies, motion, one)

        def point(slot, worst):
            mine = of_point(free, slot)
            u = materialise(jax.tree.map(lambda x, y: x + y, mine, at_point(c, moves, slot)), one)
            found = solver.mismatch(c, of_point(law, slot), of_point(p, slot), u, of_point(bound, slot), mine)
            live = of_point(c.live, slot)
            return tuple(jnp.maximum(x, jnp.where(live, y, 0.0)[0, 0]) for x, y in zip(worst, found))

        return over_points(g, pair, point, worst)

    return over_pairs(g, add, worst, g.c, g.law, p, bound, g.free)


def stepped(solver, g: Group, p: Impulses, bound, motion, d, done, one) -> Impulses:
    """Impulses after a Newton step d of the velocities, in worlds that are not done."""

    def step(pair, bodies, p, c, law, free, bound):
        moves, change = (twist(g, pair, bodies, x, one) for x in (motion, d))

        def point(slot, p):
            old, (base, hessian) = linear(solver, c, law, free, of_pair(p, pair), bound, moves, slot, one)
            less = hessian @ materialise(at_point(c, change, slot), one)
            new = jax.tree.map(lambda o, x, y: jnp.where(done, o, x - y), old, base, less)
            at = (slot, pair, jnp.int32(0))
            put = lambda c, v: jax.lax.dynamic_update_slice(c, v, at, allow_negative_indices=False)
            return jax.tree.map(put, p, new)

        return over_points(g, pair, point, p)

    return over_pairs(g, step, p, g.c, g.law, g.free, bound)


def own_blocks(problem: Problem):
    """Mass matrix of every body, (n, m columns, m rows, B), from the diagonal down."""
    n, worlds = problem.v.x.shape[0], problem.v.x.shape[-1]
    zero = jnp.zeros((n, worlds), problem.v.x.dtype)
    mass = zero + 1.0 / problem.inv_mass
    entries = {(i, i): mass for i in range(3)}
    if problem.w is not None:
        for i, row in enumerate(dense.world_inertia(problem)):
            entries.update({(3 + i, 3 + j): zero + x for j, x in enumerate(row) if x is not None})
    m = 3 if problem.w is None else 6
    own = jnp.zeros((n, m, m, worlds), zero.dtype)
    for (r, c), x in entries.items():
        own = jax.lax.dynamic_update_slice(own, x[:, None, None], (0, c, r, 0))
    return own


def nothing(own):
    return jnp.zeros((own.shape[0], *own.shape[2:]), own.dtype)


def assembled(solver, g: Group, p: Impulses, bound, motion, h: Blocks, one) -> Blocks:
    """(M + J' G J) d = J' (law - p): ``h`` with the part of a group."""
    add = functools.partial(_add_pair, solver, g, motion, one)
    return over_pairs(g, add, h, g.c, g.law, g.free, g.apart, p, bound)


def _sums(c: Contacts, hessian, residual: Impulses, slot):
    """What a point adds to the sums over a pair: wrench of its residual, lower triangles of K and Z, C between them."""
    m = dense.full(hessian)
    lower = lambda m: [row[: i + 1] for i, row in enumerate(m)]
    r = of_point(c.rb, slot)
    if r is None:
        return wrench(c, residual, slot), lower(m), None, None
    columns = [dense._cross(r, [m[i][j] for i in range(3)]) for j in range(3)]  # of C = [r]x G
    rows = [[columns[j][i] for j in range(3)] for i in range(3)]
    return wrench(c, residual, slot), lower(m), rows, lower([dense._cross(r, row) for row in rows])


def _add_pair(solver, g: Group, motion, one, pair, bodies, h: Blocks, c, law, free, apart, p, bound) -> Blocks:
    moves = twist(g, pair, bodies, motion, one)

    def of(slot):
        old, (base, hessian) = linear(solver, c, law, free, p, bound, moves, slot, one)
        return _sums(c, hessian, jax.tree.map(lambda x, y: x - y, base, old), slot)

    zero = jnp.zeros((1, 1, h.b.shape[-1]), h.b.dtype)
    start = jax.tree.map(lambda _: zero, jax.eval_shape(lambda: of(0)))
    plus = lambda slot, sums: jax.tree.map(jnp.add, sums, of(slot))
    (force, torque), k, cross, spin = over_points(g, pair, plus, start)

    q = frame(c.t1, c.t2, c.n, one)
    full = lambda low: None if low is None else [[low[max(i, j)][min(i, j)] for j in range(3)] for i in range(3)]
    k, cross, spin = (None if x is None else rotated(q, x, one) for x in (full(k), cross, full(spin)))
    apart = cross_columns(apart, one)
    h = h._with(b=on_bodies(h.b, q, force, torque, apart, bodies, one))
    h = h._with(diagonal=_added_block(h.diagonal, bodies[0], k, cross, spin))
    if len(bodies) == 1:
        return h
    cross_a = cross_ba = spin_ba = spin_a = None
    if spin is not None:
        turn = lambda m: sum(apart[i][:, None] * m[:, :, i : i + 1] for i in range(3))  # [d]x M
        back = lambda m: sum(m[:, i : i + 1] * across(apart[i]) for i in range(3))  # M [d]x'
        cross_a = materialise(cross + turn(k), one)  # [ra]x G
        spin_ba = materialise(spin + back(cross), one)  # [rb]x G [ra]x'
        cross_ba = materialise(transposed(cross_a), one)  # G [ra]x'
        spin_a = spin_ba + turn(cross_ba)
    h = h._with(diagonal=_added_block(h.diagonal, bodies[1], k, cross_a, spin_a))
    row_b, row_a = bodies
    later = row_b > row_a  # the block below the diagonal is that of the later body's rows and the earlier one's columns
    at = block_ldl.place(jnp.maximum(row_b, row_a), jnp.minimum(row_b, row_a))
    minus = lambda x, y: None if x is None else jnp.where(later, -x, -y)
    ab = (None, None, None) if spin is None else (cross_a, transposed(cross), transposed(spin_ba))
    block = -k, minus(cross, ab[0]), minus(spin_ba, ab[2]), minus(cross_ba, ab[1])
    for corner, part in zip(CORNERS, block if h.b.shape[1] == 6 else block[:1]):
        h = block_ldl.put(h, at, jnp.zeros_like(k) if part is None else part, *corner)  # what is there does not count
    return block_ldl.fill(h, at)


#: Column and row at which K, C, Z and U of a block [[K, U], [C, Z]] start.
CORNERS = ((0, 0), (0, 3), (3, 3), (3, 0))


def _added_block(blocks, row, *parts):
    """Blocks on the diagonal with [[K, .], [C, Z]] added at ``row``."""
    for (column, first), part in zip(CORNERS, parts):
        if part is None:
            continue
        blocks = add(blocks, (row, column, first, 0), part)
    return blocks
