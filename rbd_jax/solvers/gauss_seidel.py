"""Layer 5: coloured Gauss-Seidel sweeps over contact rows, the inner loop of TGS and PGS.

The rows of a colour share no body and are solved at once; colours, and the slots of a pair, in order. The three
rows of a point are one block: the normal impulse, then the friction disc |p_t| <= mu p_n around it.
Pairs that differ from world to world are coloured in the step and put into chunks (``colouring``); so are many
pairs of one world, where that takes no time (``lanes``).

Symbols: n, t1, t2 contact frame; r arm; k inverse mass seen by a row; l accumulated impulse.
Cost: about 100 flops a point and sweep.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..loops import Listed, in_blocks, listed, only_if, read, repeat, write
from ..spatial import Vec3
from ..struct import struct
from ..xla import in_a_thread, in_one_function, loops_are_cheap, materialise, piece, summed
from .base import Problem, Solution
from .colouring import Plan, plan
from .lanes import Lanes, lanes
from .laws import Law
from .restitution import Events, normal_velocity, targets
from .rows import Impulses, Index, Rows, add_trees, by_pair, gathered, take, take_tree

#: Groups with more rows than this (slots x colours) loop over their slots instead of unrolling them.
UNROLL = 4
#: Worlds from which on a program need not be short: what it computes takes longer than what it starts.
FEW = 32
#: Pairs from which on those of one world are solved in lanes: to find places for fewer takes as long as it saves.
MANY = 256
#: Groups with more colours than this loop over them too: 16 balls compile in a fifth of the time.
UNROLL_COLOURS = 8


@struct
class Group:
    """A group of rows with what every sweep needs: effective masses and, with restitution, events.

    plan: for pairs that differ from world to world: where they went; the rows are in the order of its places. lanes:
    the same of many pairs of one world. points: those that are live in any world, pair * slots + slot, in the order of
    a sweep: pair by pair, slot by slot.
    """

    rows: Rows
    t1: Vec3 | None
    t2: Vec3 | None
    inv_mass_b: jax.Array
    inv_mass_a: jax.Array | None
    inertia_b: object
    inertia_a: object
    k_n: jax.Array
    mass_n: jax.Array  # 1/k, zero where the slot is not live
    mass_1: jax.Array | None
    mass_2: jax.Array | None
    events: Events | None
    plan: Plan | None = None
    couples: Couples | None = None
    points: Listed | None = None
    lanes: Lanes | None = None


@struct
class Couples:
    """Torsional and rolling friction of every pair: coefficients [m], spin of a kinematic partner, 1/k of the rows."""

    mu_spin: jax.Array
    mass_s: jax.Array
    surface_spin: Vec3 | None = None
    mu_roll: jax.Array | None = None
    mass_1: jax.Array | None = None
    mass_2: jax.Array | None = None


@struct
class Sweep:
    """l_n' = max(l_n - inv (u + bias) - soft l_n, 0); leaves (S, P, B) or scalars.

    bias: minus the target velocity. inv: 1 / (k + r), zero for a row that is left alone. soft: r / (k + r).
    """

    bias: jax.Array
    inv: jax.Array
    soft: jax.Array | float


def biased(g: Group, law: Law) -> Sweep:
    """The sweep of a contact law; an impact hits its target velocity rigidly."""
    bias, r = -law.vhat, law.r
    if g.events is not None:
        hit = g.events.active
        bias = -g.events.target(law.vhat)
        r = None if r is None else jnp.where(hit, 0.0, r)
    if r is None:
        return Sweep(bias, g.mass_n, 0.0)
    share = 1.0 / (1.0 + r * g.mass_n)
    return Sweep(bias, g.mass_n * share, 1.0 - share)


def relaxing(g: Group, lam: Impulses, body, h) -> Sweep:
    """No bias on overlap; gaps as they are after the move.

    A gap that did not close in this step is left alone: its impact belongs to the next step.
    """
    phi = g.rows.phi + h * normal_velocity(g.rows, *body)
    bias = jnp.where(g.rows.phi <= 0, 0.0, jnp.maximum(phi, 0.0) / h)
    idle = (g.rows.phi > 0) & (lam.n <= 0)
    if g.events is not None:
        bias = jnp.where(g.events.active, -g.events.vhat, bias)
        idle = idle & ~g.events.active
    return Sweep(bias, jnp.where(idle, 0.0, g.mass_n), 0.0)


def arranged(tree, source: jax.Array, pairs: int):
    """Arrays over pairs, (C, B) or (S, C, B), at the places of which ``source`` (P, B) says what pair they hold, where
    that is less than ``pairs``; any values in the others. Arrays of one pair stay."""
    source = jnp.minimum(source, pairs - 1)
    return jax.tree.map(lambda c: _places(c, source) if jnp.ndim(c) > 1 and c.shape[-2] == pairs else c, tree)


def _seated(rows: Rows, source: jax.Array) -> Rows:
    """The rows at the places of ``source``; an empty place holds no point."""
    pairs = rows.phi.shape[1]
    rows = arranged(rows, source, pairs)
    return rows._with(live=rows.live & (source < pairs))


def _placed(lam: Impulses, g: Group) -> Impulses:
    """Impulses of the pairs at the places of a group, zero where there is none."""
    where = g.plan or g.lanes
    if where is None:
        return lam
    lam = jax.tree.map(lambda c: jnp.broadcast_to(c, (g.rows.slots, *where.place.shape)), lam)
    return _found(lam, where.source, len(where.place), None if g.lanes is None else g.lanes.filled)


def _restored(lam: Impulses, g: Group, filled: jax.Array | None) -> Impulses:
    """Impulses in the order of the pairs again, of which ``filled`` are filled; zero for a pair that has no place."""
    where = g.plan or g.lanes
    if where is None:
        return lam
    if g.lanes is not None and filled is None:
        filled = len(where.place)
    return _found(lam, where.place, len(where.source), filled)


def _found(lam: Impulses, source: jax.Array, count: int, filled: jax.Array | None) -> Impulses:
    """The impulses that ``source`` names, zero where that is ``count``; of one world the first ``filled`` of them."""
    at = lambda source: jax.tree.map(lambda c: jnp.where(source < count, c, 0.0), arranged(lam, source, count))
    return in_blocks(at, filled, source)


def _places(c: jax.Array, index: jax.Array) -> jax.Array:
    """c (..., P, B or 1) at ``index`` (Q, B) of its pair axis."""
    if c.shape[-1] == 1:
        return jnp.take(c[..., 0], index, axis=-1, mode="clip")
    return jnp.take_along_axis(c, index.reshape((1,) * (c.ndim - 2) + index.shape), axis=-2, mode="clip")


def prepare(rows: Rows, problem: Problem) -> Group:
    """The group in the order in which it is solved: by colours that are known before, or of a plan; in a program that
    is one function point after point, many pairs of one world in lanes."""
    fixed = isinstance(rows.b, Index)
    n, pairs = problem.v.x.shape[0], rows.phi.shape[1]
    if not (in_one_function() and (fixed or rows.b.shape[1] == 1)):
        if fixed:
            return _prepared(rows, problem)
        p = plan(rows.b, rows.a, rows.live.any(axis=0), n)
        return _prepared(_seated(rows, p.source), problem)._with(plan=p)
    if pairs >= MANY and rows.slots == 1 and rows.phi.shape[-1] == 1 and not in_a_thread():
        b, a = (_bodies(i) for i in (rows.b, rows.a))
        places = lanes(b, a, rows.live[0, :, 0], n, rows.filled)
        rows = rows._with(b=b[:, None], a=None if a is None else a[:, None], filled=None, colours=())
        g = in_blocks(lambda source: _prepared(_seated(rows, source), problem), places.filled, places.source)
        return g._with(rows=g.rows._with(filled=places.filled), lanes=places)
    g = by_pair(lambda rows: _prepared(rows, problem), rows)
    return g._with(rows=g.rows._with(filled=rows.filled), points=_listed_points(rows))


def _prepared(rows: Rows, problem: Problem) -> Group:
    """``prepare`` of pairs in the order in which they are solved, each by itself; without what tells that order."""
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
    if not isinstance(rows.b, Index):  # gathers are cheap, but not in every kernel that uses them
        sides, t1, t2 = materialise((sides, t1, t2), one)
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

    def mass(k):
        return jnp.where(rows.live, 1.0, 0.0).astype(rows.phi.dtype) / k

    k_n = k(rows.n, rows.central_b, rows.central_a)

    return Group(
        rows,
        t1,
        t2,
        mb,
        ma,
        ib,
        ia,
        k_n=k_n,
        mass_n=mass(k_n),
        mass_1=mass(k(t1, False, False)) if t1 is not None else None,
        mass_2=mass(k(t2, False, False)) if t2 is not None else None,
        events=materialise_events(targets(rows, problem), one) if rows.e is not None else None,
        couples=None if rows.mu_spin is None else _couples(rows, t1, t2, ib, ia),
    )


def each(f, groups, *more) -> tuple:
    """``f(group, ...)`` of every group, arrays over its pairs; of one that is filled in part in blocks."""
    out = []
    for g, *args in zip(groups, *more):
        if g.rows.filled is None:
            out.append(f(g, *args))
            continue
        bare = g._with(rows=g.rows._with(filled=None), points=None, lanes=None)
        out.append(in_blocks(f, g.rows.filled, bare, *args))
    return tuple(out)


def _listed_points(rows: Rows) -> Listed:
    among = None if rows.filled is None else rows.filled * rows.slots
    return listed(rows.live.any(axis=-1).T.ravel(), among)


def _couples(rows: Rows, t1: Vec3, t2: Vec3, ib, ia) -> Couples:
    def mass(d: Vec3):
        k = d.dot(ib @ d)
        return 1.0 / (k if ia is None else k + d.dot(ia @ d))

    rolls = () if rows.mu_roll is None else (rows.mu_roll, mass(t1), mass(t2))
    return Couples(rows.mu_spin, mass(rows.n), rows.surface_spin, *rolls)


def materialise_events(events: Events, one) -> Events:
    return events._with(vhat=materialise(events.vhat, one), left=materialise(events.left, one))


def apply(g: Group, lam: Impulses, body):
    """Velocities after the impulses ``lam`` of one group (warm start)."""
    rows, spin = g.rows, body[1] is not None
    (changes,) = each(lambda g, lam: _changes(g, lam, spin), (g,), (lam,))
    ends = (rows.b, rows.a)
    for index, change in zip(ends, changes):
        moved = add_trees(
            [c for c, d in zip(body, change) if d is not None], index, [d for d in change if d is not None], rows.filled
        )
        body = (*moved, *body[len(moved) :])
    return body


def _changes(g: Group, lam: Impulses, spin: bool) -> list:
    """(change of velocity, change of spin or None) of body B and, where there is one, A of every pair."""
    rows = g.rows
    # of many pairs of one world XLA's own sum over a slow axis takes 10 times as long as the additions
    slots = lambda c: summed(c) if g.plan is None else sum(c[1:], c[0])
    p = rows.n * lam.n
    if lam.t1 is not None:
        p = p + g.t1 * lam.t1 + g.t2 * lam.t2
    total = p.map(slots)

    def side(inv_mass, inertia, arm, sign):
        w = None
        if spin and not (rows.mu is None and (rows.central_b if sign > 0 else rows.central_a)):
            turn = arm.cross(p).map(slots)
            if lam.s is not None:
                turn = turn + _couple(g, lam).map(slots)
            w = (inertia @ turn) * sign
        return total * (sign * inv_mass), w

    out = [side(g.inv_mass_b, g.inertia_b, rows.rb, 1.0)]
    return out if rows.a is None else [*out, side(g.inv_mass_a, g.inertia_a, rows.ra, -1.0)]


def _couple(g: Group, lam: Impulses) -> Vec3:
    """Angular impulse on B of torsional and rolling friction."""
    c = g.rows.n * lam.s
    return c if lam.r1 is None else c + g.t1 * lam.r1 + g.t2 * lam.r2


def started(problem: Problem):
    """Groups, the impulses to start from, and the velocities that these give."""
    groups = tuple(piece(prepare)(rows, problem.without_rows()) for rows in problem.rows)
    lam = tuple(_placed(l, g) for g, l in zip(groups, problem.warm))
    body = (problem.v, problem.w)
    for g, l in zip(groups, lam):
        body = piece(apply)(g, l, body)
    return groups, lam, materialise(body, problem.one)


def in_phases(groups, soft, relaxed, lam, body, one, counts: tuple[int, int]):
    """``counts[0]`` sweeps with the laws ``soft``, then ``counts[1]`` with ``relaxed(body, lam)``.

    Returns the velocities and impulses of the end, and the velocities after the first phase. Of few worlds, whose
    program is long if it is to be fast, both phases are turns of one loop, which halves it (and takes a tenth longer).
    """
    if not loops_are_cheap() or in_a_thread() or groups[0].rows.phi.shape[-1] >= FEW:
        moving, lam = sweeps(groups, soft, lam, body, one, counts[0])
        body, lam = sweeps(groups, relaxed(moving, lam), lam, moving, one, counts[1])
        return body, lam, moving
    wide = lambda g, tree: jax.tree.map(lambda c: jnp.broadcast_to(c, g.rows.phi.shape).astype(g.rows.phi.dtype), tree)
    whole = lambda trees: tuple(wide(g, tree) for g, tree in zip(groups, trees))
    body = jax.tree.map(lambda c: jnp.broadcast_to(c, (c.shape[0], groups[0].rows.phi.shape[-1])), body)

    def phase(k, carry):
        body, lam, laws, _ = carry
        once = lambda _, carry: _once(groups, laws, one, *carry)
        body, lam = repeat(0, jnp.where(k == 0, *counts), once, (body, lam))
        turn = lambda carry: (whole(relaxed(body, lam)), body)
        laws, moving = only_if((k == 0).astype(jnp.int32), turn, (laws, carry[3]))
        return body, lam, laws, moving

    body, lam, _, moving = repeat(0, 2, phase, (body, whole(lam), whole(soft), body))
    return body, lam, moving


def _once(groups, laws, one, body, lam):
    """One sweep over all groups."""
    lam = list(lam)
    for k, g in enumerate(groups):
        body, lam[k] = piece(sweep)(g, laws[k], lam[k], body, one)
    return body, tuple(lam)


def sweeps(groups, laws, lam, body, one, count: int):
    """``count`` sweeps over all groups; many, or with chunks, whose program is long, in a compiled loop."""

    once = lambda carry, _: (_once(groups, laws, one, *carry), None)

    carry = (body, tuple(lam))
    rolled = any(g.plan or g.points or g.lanes for g in groups)
    if count > UNROLL or (count > 1 and rolled):
        full = lambda l, g: jax.tree.map(lambda c: jnp.broadcast_to(c, g.rows.phi.shape), l)
        carry = (body, tuple(full(l, g) for l, g in zip(lam, groups)))
        return jax.lax.scan(once, carry, length=count)[0]
    for _ in range(count):
        carry, _ = once(carry, None)
    return carry


def loops(slots: int, colours: int) -> bool:
    """Whether a group is swept in a loop over its colours, which have one width then."""
    return colours > 1 and (slots > UNROLL or colours > UNROLL_COLOURS)


def sweep(g: Group, law: Sweep, lam: Impulses, body, one):
    """One Gauss-Seidel sweep over a group: colours one after the other, slots one after the other."""
    rows = g.rows
    pairs = rows.phi.shape[1]
    if g.points is not None:
        return _sweep_points(g, law, lam, body, one)
    if g.lanes is not None:
        return _sweep_lanes(g, law, lam, body, one)
    if not isinstance(rows.b, Index):
        return _sweep_chunks(g, law, lam, body, one)
    colours = rows.colours or ((0, pairs),)
    whole = len(colours) == 1
    if loops(rows.slots, len(colours)):
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
        pair = _pair(rows, *cut(_of_pairs(g), 0), a, b)
        slots = cut(_of_points(g, law, lam), 1)
        local, new = _slots(pair, slots, local, one, unroll=rows.slots * len(colours) <= UNROLL)
        body = _write(body, b, local[0])
        if a is not None:
            body = _write(body, a, local[1])
        pieces.append(new)
    if whole:
        return body, pieces[0]
    return body, jax.tree.map(lambda *c: jnp.concatenate(c, axis=1), *pieces)


def _sweep_colours(g: Group, law: Sweep, lam: Impulses, body, one):
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
        pair = _pair(rows, *cut(_of_pairs(g), 0, k))
        slots = cut(_of_points(g, law, lam), 1, k)
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


def _sweep_points(g: Group, law: Sweep, lam: Impulses, body, one):
    """As ``sweep``, point after point, without those that are dead in every world.

    The pairs are in the order of their colours, so the result is that of ``_sweep_colours``. Those that a world chose
    for itself are in the order of their keys; there is one world then.
    """
    rows = g.rows
    slots, pairs, worlds = rows.phi.shape
    at = lambda c, k, axis: jax.lax.dynamic_slice_in_dim(c, k if c.shape[axis] > 1 else 0, 1, axis)
    row_b, row_a = (_bodies(i) for i in (rows.b, rows.a))

    def of_pair(tree, pair):
        return jax.tree.map(lambda c: c if jnp.ndim(c) < 2 else at(c, pair, 0), tree)

    def of_point(tree, pair, slot):
        cut = lambda c: of_pair(c, pair) if jnp.ndim(c) < 3 else at(at(c, slot, 0), pair, 1)[0]
        return jax.tree.map(cut, tree)

    def point(carry):
        k, body, lam = carry
        number = g.points.order[k]
        pair, slot = number // slots, number % slots
        ends = [r[pair] for r in (row_b, row_a) if r is not None]
        local = [jax.tree.map(lambda c: at(c, end, 0), body) for end in ends]
        own, old = of_point(_of_points(g, law), pair, slot), of_point(lam, pair, slot)
        # read once: what is read later, in the kernels that use it, would have to be copied before it is written
        old, local = materialise((old, local), one)
        new, l = _point(_pair(rows, *of_pair(_of_pairs(g), pair)), (*own, old), (*local, None)[:2], one)
        for end, values in zip(ends, new):
            body = jax.tree.map(lambda c, v: jax.lax.dynamic_update_slice_in_dim(c, v, end, axis=0), body, values)
        put = lambda c, v: jax.lax.dynamic_update_slice(c, v[None], (slot, pair, jnp.zeros_like(slot)))
        return k + 1, body, jax.tree.map(put, lam, l)

    lam = jax.tree.map(lambda c: jnp.broadcast_to(c, rows.phi.shape), lam)
    body = jax.tree.map(lambda c: jnp.broadcast_to(c, (c.shape[0], worlds)), body)
    _, body, lam = jax.lax.while_loop(lambda c: c[0] < g.points.count, point, (jnp.int32(0), body, lam))
    return body, lam


def _sweep_lanes(g: Group, law: Sweep, lam: Impulses, body, one):
    """As ``sweep``, of one world and points of one slot, chunk after chunk of ``lanes``."""
    rows, t = g.rows, g.lanes
    lane = np.arange(t.width, dtype=np.int32)[:, None]
    ones = one + 0.0 * jax.lax.slice_in_dim(rows.phi[0], 0, t.width)
    ends = [i for i in (rows.b, rows.a) if i is not None]

    def cut(tree, first):
        """Arrays (P, 1) or (1, P, 1) at the places of a chunk, (width, 1); what is the same for all pairs stays."""

        def at(c):
            if jnp.ndim(c) < 2:
                return c
            c = c[0] if jnp.ndim(c) == 3 else c
            return c if c.shape[0] == 1 else jax.lax.dynamic_slice_in_dim(c, first, t.width)

        return jax.tree.map(at, tree)

    def chunk(k, carry):
        body, lam = carry
        first, held = t.first[k], t.held[k]
        here = cut(ends, first)
        # read once: what is read later, in the kernels that use it, would have to be copied before it is written
        local = materialise([jax.tree.map(lambda c: gathered(c, end), body) for end in here], ones)
        old = materialise(cut(lam, first), ones)
        own = cut(_of_points(g, law), first)
        new, l = _point(_pair(rows, *cut(_of_pairs(g), first)), (*own, old), (*local, None)[:2], ones)

        def put(i, body):
            for end, values in zip(here, new):
                body = write(body, read(end, i)[0, 0], read(values, i))
            return body

        keep = lambda c, l, old: jax.lax.dynamic_update_slice_in_dim(c, jnp.where(lane < held, l, old)[None], first, 1)
        return repeat(0, held, put, body), jax.tree.map(keep, lam, l, old)

    lam = jax.tree.map(lambda c: jnp.broadcast_to(c, rows.phi.shape), lam)
    body = jax.tree.map(lambda c: jnp.broadcast_to(c, (c.shape[0], 1)), body)
    return repeat(0, t.chunks, chunk, (body, lam))


def _bodies(index) -> jax.Array | None:
    """The bodies of all pairs, (P,), the same in every world."""
    if index is None:
        return None
    return jnp.asarray(index.rows) if isinstance(index, Index) else index[:, 0]


def _of_pairs(g: Group):
    """What ``_pair`` takes of a group, leaves (P, B) or of one pair."""
    rows = g.rows
    return rows.n, rows.mu, g.t1, g.t2, g.inv_mass_b, g.inv_mass_a, g.inertia_b, g.inertia_a, g.couples


def _of_points(g: Group, law: Sweep, *lam: Impulses):
    """What ``_point`` takes of a group, leaves (S, P, B) or without a slot axis."""
    return g.rows.rb, g.rows.ra, g.rows.surface, g.mass_1, g.mass_2, law, *lam


def _pair(rows: Rows, n, mu, t1, t2, inv_mass_b, inv_mass_a, inertia_b, inertia_a, couples, a=None, b=None) -> Group:
    """What ``_point`` needs of the pairs of one colour."""
    bare = rows._with(
        n=n,
        mu=mu,
        rb=None,
        ra=None,
        phi=None,
        live=None,
        e=None,
        surface=None,
        mu_spin=None,
        mu_roll=None,
        surface_spin=None,
        filled=None,
        feature=None,
        law=None,
        meets=None,
        a=a,
        b=b,
    )
    return Group(bare, t1, t2, inv_mass_b, inv_mass_a, inertia_b, inertia_a, *(None,) * 5, couples=couples)


def _write(body, index: Index, values):
    """Put the velocities of a colour back; no row appears twice."""
    rows = index.rows

    def put(x, new):
        if len(rows) == x.shape[0] and np.array_equal(rows, np.arange(len(rows))):
            return new
        return x.at[rows].set(new, unique_indices=True)

    return jax.tree.map(put, body, values)


def _slots(pair: Group, slots, local, one, unroll: bool):
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


def _point(pair: Group, at, local, one):
    """Update one slot of every pair of a colour: normal impulse, then the friction disc."""
    rb, ra, surface, mass_1, mass_2, law, lam = at
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
    ln = jnp.maximum(lam.n - law.inv * (u + law.bias) - law.soft * lam.n, 0.0)
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
        u1, u2 = materialise((u1, u2), one)
        l1, l2 = _on_disc((lam.t1, lam.t2), (u1, u2), (mass_1, mass_2), rows.mu * ln, one)
        p = p + t1 * (l1 - lam.t1) + t2 * (l2 - lam.t2)
    p = materialise(p, one)
    vb = vb + p * pair.inv_mass_b
    if spin and not (rows.mu is None and rows.central_b):
        wb = wb + pair.inertia_b @ rb.cross(p)
    if va is not None:
        va = va - p * pair.inv_mass_a
        if spin and not (rows.mu is None and rows.central_a):
            wa = wa - pair.inertia_a @ ra.cross(p)
    new = Impulses(ln, l1, l2)
    if pair.couples is not None:
        wb, wa, new = _turned(pair, lam, materialise(new, one), wb, wa, one)
    return (materialise((vb, wb), one), None if va is None else materialise((va, wa), one)), new


def _on_disc(lam, u, mass, limit, one):
    """Friction (2,) that stops the slip ``u``, or that of the disc of radius ``limit`` against it.

    What stops it takes each tangent's own mass. On the disc one mass serves both: with two, the impulse would come to
    rest against (m_1 u_1, m_2 u_2), and a sliding body would be pushed aside, however many sweeps there are.
    """
    stop = lam[0] - mass[0] * u[0], lam[1] - mass[1] * u[1]
    slips = stop[0] * stop[0] + stop[1] * stop[1] > limit * limit
    both = 0.5 * (mass[0] + mass[1])
    pick = lambda k: lam[k] - jnp.where(slips, both, mass[k]) * u[k]
    c1, c2 = materialise((pick(0), pick(1)), one)
    size = c1 * c1 + c2 * c2
    slips = size > limit * limit
    shrink = jnp.where(slips, limit / jnp.sqrt(jnp.where(slips, size, 1.0)), 1.0)
    return c1 * shrink, c2 * shrink


def _turned(pair: Group, lam: Impulses, new: Impulses, wb: Vec3, wa: Vec3 | None, one):
    """Spins after torsional friction |s| <= nu_s p_n about the normal and rolling |r| <= nu_r p_n across it."""
    c, n = pair.couples, pair.rows.n
    spin = wb if wa is None else wb - wa
    if c.surface_spin is not None:
        spin = spin - c.surface_spin
    limit = c.mu_spin * new.n
    new = new._with(s=jnp.clip(lam.s - c.mass_s * n.dot(spin), -limit, limit))
    change = n * (new.s - lam.s)
    if c.mu_roll is not None:
        turning = pair.t1.dot(spin), pair.t2.dot(spin)
        r1, r2 = _on_disc((lam.r1, lam.r2), turning, (c.mass_1, c.mass_2), c.mu_roll * new.n, one)
        new = new._with(r1=r1, r2=r2)
        change = change + pair.t1 * (new.r1 - lam.r1) + pair.t2 * (new.r2 - lam.r2)
    wb = wb + pair.inertia_b @ change
    return wb, None if wa is None else wa - pair.inertia_a @ change, new


def _sweep_chunks(g: Group, law: Sweep, lam: Impulses, body, one):
    """Pairs that differ from world to world: chunk after chunk, then the tail place after place.

    Loops of fixed trip count; what is empty in every world is skipped.
    """
    rows, p = g.rows, g.plan
    pairs, worlds, n = *p.source.shape, body[0].x.shape[0]
    column = jnp.arange(worlds)[None, :]
    filled = p.source < p.place.shape[0]
    lam = jax.tree.map(lambda c: jnp.broadcast_to(c, rows.phi.shape), lam)
    slots = _of_points(g, law, lam)

    def run(body, start: int, width: int, active):
        """``width`` places at a time from ``start`` on; the impulses (S, places, B)."""
        idle = jax.tree.map(lambda c: jnp.zeros((c.shape[0], width, worlds), c.dtype), lam)

        def work(body, first):
            cut = lambda c: jax.lax.dynamic_slice_in_dim(c, first, width, axis=c.ndim - 2)
            part = lambda tree: jax.tree.map(lambda c: cut(c) if jnp.ndim(c) and c.shape[-2] == pairs else c, tree)
            index = [cut(i) for i in (rows.b, rows.a) if i is not None]
            local = [take_tree(body, i) for i in index]
            local, new = _slots(_pair(rows, *part(_of_pairs(g))), part(slots), (*local, None)[:2], one, rows.slots <= 2)
            for i, values in zip(index, local):
                target = jnp.where(cut(filled), i, n)
                body = jax.tree.map(lambda c, v: c.at[target, column].set(v, mode="drop"), body, values)
            return body, new

        def entry(body, x):
            first, active = x
            return jax.lax.cond(active, work, lambda body, _: (body, idle), body, first)

        first = jnp.arange(len(active), dtype=jnp.int32) * width + start
        body, new = jax.lax.scan(entry, body, (first, active))
        return body, jax.tree.map(lambda c: jnp.moveaxis(c, 0, 1).reshape(c.shape[1], -1, worlds), new)

    body = jax.tree.map(lambda c: jnp.broadcast_to(c, (n, worlds)), body)
    start = p.chunks * p.width
    body, new = run(body, 0, p.width, p.active)
    if not p.tail:
        return body, new
    rest = jax.tree.map(lambda c: c[:, start:], lam)
    body, rest = jax.lax.cond(p.late.any(), lambda b: run(b, start, 1, p.late), lambda b: (b, rest), body)
    return body, jax.tree.map(lambda *c: jnp.concatenate(c, axis=1), new, rest)


def solution(problem: Problem, groups, body, lam, moving=(None, None)) -> Solution:
    """What the bodies received: their end velocities against the predicted ones."""
    v, w = body
    overflow = None
    for g in groups:
        if g.plan is not None:
            overflow = g.plan.overflow if overflow is None else overflow | g.plan.overflow
    return Solution(
        impulse=(v - problem.v) / problem.inv_mass,
        angular_impulse=None if w is None else problem.inertia.momentum(problem.q, w - problem.w),
        contacts=tuple(_restored(l, g, rows.filled) for l, g, rows in zip(lam, groups, problem.rows)),
        v_move=moving[0],
        w_move=moving[1],
        overflow=overflow,
    )
