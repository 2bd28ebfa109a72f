"""Layer 7: from the poses of a step to contact rows, group by group.

Poses of geoms -> (broad phase) -> narrow phase -> rows.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from .contact import NARROW
from .contact.base import Manifold, Pose
from .contact.broadphase import (
    SLOP,
    Bounds,
    all_pairs,
    at,
    below,
    close,
    grid_pairs,
    half_widths,
    key_of,
    lookup,
    lookup_of_one,
    no_key,
    pairs_of_one,
    rows_of_key,
)
from .loops import BLOCK, Listed, block_of, each_pair, in_blocks, listed, repeat
from .model import Coefficient, Group, GroupParams, Params, Structure
from .solvers.rows import Impulses, Index, Rows, take, take_tree
from .spatial import Quat, Vec3, safe_norm
from .state import World
from .struct import struct
from .xla import in_a_thread, in_one_function, largest, materialise, piece


@struct
class Contact:
    """A group in one step: its manifold, rows, impulses of the last step, those to start from, the keys of the
    pairs that were chosen and whether there were too many, and the numbers of its pairs. places: of one world, of a
    group that looks at all its pairs: which of them these are.
    """

    manifold: Manifold
    rows: Rows
    last: Impulses
    warm: Impulses
    pairs: jax.Array | None
    overflow: jax.Array | None
    numbers: GroupParams
    places: jax.Array | None = None


def detect(s: Structure, p: Params, world: World, reach_of_model: str) -> tuple[Contact, ...]:
    """Contacts of every group, with the slots alive that the contact model wants.

    "all": every slot, however far (a distant row does nothing); "nearby": those that may touch within the step
    whatever hits what in it; "step": those that may touch at the velocities of its start; "margin": those that
    touch, or are closer than MuJoCo's margin.
    """
    alone = world.step.shape == (1,) and (in_a_thread() or s.chooses and in_one_function())
    reach = fastest = None
    if reach_of_model == "nearby":
        if sum(len(g.a) * g.slots for g in s.groups) > FEW:
            fastest = piece(_fastest)(p, world)
        else:
            reach_of_model = "all"
    if reach_of_model == "step" or any(g.capacity for g in s.groups):
        reach, fall = piece(_reach)(p, world)
        reach = reach if fall is None else reach + fall
    return tuple(
        _group(g, gp, p, world, i, reach, fastest, reach_of_model, alone)
        for i, (g, gp) in enumerate(zip(s.groups, p.groups))
    )


#: "nearby" looks at all slots of a scene that has no more: to find out which are near costs as much.
FEW = 8
#: "nearby": how much faster than the fastest of its world a collision may make a body (twice: a light one, hit by a
#: heavy one).
FLUNG = 2.0


def _fastest(p: Params, world: World) -> tuple[jax.Array, jax.Array]:
    """The way of the fastest body of every world in the step, with its fall, [m], and the largest turn [rad]; (B,)."""
    bodies = world.bodies
    fall = 0.0 if p.gravity is None else p.h * safe_norm(p.gravity)
    way = FLUNG * p.h * (largest(safe_norm(bodies.v)) + fall)
    if bodies.L is None:
        return way, 0.0 * way
    moments = p.inertia.moments
    least = moments if p.inertia.isotropic else jnp.minimum(jnp.minimum(moments.x, moments.y), moments.z)
    return way, FLUNG * p.h * largest(safe_norm(bodies.L) / least)


def _reach(p: Params, world: World) -> tuple[jax.Array, jax.Array | None]:
    """How far the surface of a body may come in a step, without its spin [m], (n, B), and how much farther by gravity.

    Two results: a ``piece`` with one alone would not compile where it is large (see ``xla.one_function``).
    """
    return p.h * safe_norm(world.bodies.v), None if p.gravity is None else p.h * (p.h * safe_norm(p.gravity))


def _sweep_of(p: Params, world: World) -> jax.Array:
    """How far a kinematic body goes in a step [m], (k, B)."""
    return p.h * safe_norm(world.kinematic.v)


@struct
class Selected:
    """The pairs of a group that are looked at: their bodies and numbers, (P, 1 or B).

    body_a, body_b: as in ``Rows``, of the geoms A and B. places: which of the group's pairs they are where
    that differs from world to world, (P, B), else None. filled: places that hold a pair, None = all.
    """

    body_a: Index | jax.Array
    body_b: Index | jax.Array
    numbers: GroupParams
    places: jax.Array | None = None
    filled: jax.Array | None = None


def everything(g: Group, gp: GroupParams) -> Selected:
    """All pairs of a group."""
    if g.choice is not None:
        i, j = np.searchsorted(g.choice.a, g.a), np.searchsorted(g.choice.b, g.b)
        gp = _numbers(g, gp, *(jnp.asarray(x, jnp.int32)[:, None] for x in (i, j)))
    return Selected(Index(g.body_a), Index(g.body_b), gp)


def chosen(g: Group, gp: GroupParams, keys: jax.Array) -> Selected:
    """The pairs of these keys (C, B) of a group that chooses its pairs at run time."""
    i, j = geoms_of(g, keys)
    body = lambda rows, k: jnp.asarray(np.maximum(rows, 0), jnp.int32)[k]
    c = g.choice
    none = no_key(len(c.a), len(c.b))
    return Selected(body(c.body_a, i), body(c.body_b, j), _numbers(g, gp, i, j), keys, keys < none)


def geoms_of(g: Group, keys: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rows of the geoms of keys in the lists of ``g.choice``; an empty place has any."""
    c = g.choice
    i, j = rows_of_key(keys, len(c.b))
    return jnp.minimum(i, len(c.a) - 1), j


def _numbers(g: Group, gp: GroupParams, i: jax.Array, j: jax.Array) -> GroupParams:
    """Numbers of the pairs of rows i and j (P, B) of the lists of ``g.choice``."""
    c = g.choice
    key = key_of(i, j, len(c.b))
    count = len(c.override_keys)
    if count:
        known = jnp.asarray(c.override_keys, jnp.int32)[:, None]
        place = jnp.minimum(below(known, key), count - 1)
        given = at(known, place) == key
        row = at(jnp.asarray(c.override_rows, jnp.int32)[:, None], place)

    def coefficient(x: Coefficient | None, priority=None):
        """Larger of the two geoms (or that of the higher priority), then the pair's own value."""
        if x is None:
            return None
        a, b = take(x.a, i), take(x.b, j)
        value = jnp.maximum(a, b)
        if priority is not None:
            pa, pb = (jnp.asarray(p, jnp.int32)[k] for p, k in zip(priority, (i, j)))
            value = jnp.where(pa > pb, a, jnp.where(pb > pa, b, value))
        if x.own is None:
            return value
        own = take(x.own, row)
        return jnp.where(given & ~jnp.isnan(own), own, value)

    law = gp.law
    if law is not None:
        which = jnp.zeros_like(key) if c.law_of is None else jnp.asarray(c.law_of, jnp.int32)[key]
        law = take_tree(law, which)
    return GroupParams(
        take_tree(gp.size_a, i),
        take_tree(gp.size_b, j),
        take_tree(gp.local_a, i),
        take_tree(gp.local_b, j),
        coefficient(gp.mu, c.priority),
        coefficient(gp.e),
        law,
        coefficient(gp.mu_spin, c.priority),
        coefficient(gp.mu_roll, c.priority),
    )


def pick(selected: Selected, places: jax.Array) -> Selected:
    """The pairs at ``places`` (P, B) of ``selected``, each world its own."""
    body = lambda i: (
        jnp.asarray(np.maximum(i.rows, 0))[places] if isinstance(i, Index) else jnp.take_along_axis(i, places, axis=0)
    )
    filled = selected.filled
    return Selected(
        body(selected.body_a),
        body(selected.body_b),
        take_tree(selected.numbers, places),
        places,
        None if filled is None else jnp.take_along_axis(filled, places, axis=0),
    )


def manifold(g: Group, selected: Selected, world: World, margin, one) -> Manifold:
    """Contact points of the selected pairs at the poses of ``world``."""
    n = selected.numbers
    pose_a = pose_of(world, side_of(g, "a"), selected.body_a, n.local_a)
    pose_b = pose_of(world, side_of(g, "b"), selected.body_b, n.local_b)
    args = pose_a, pose_b, n.size_a, n.size_b, margin
    function = NARROW[g.kind].function
    if g.kind == ("box", "box") and g.choice is None and in_one_function() and isinstance(margin, jax.Array):
        m = each_pair(lambda _, *args: function(*args, one=one), _near(*args).any(axis=-1), *args)
    else:
        m = function(*args, one=one)
    if g.features:  # that of what does not touch must not depend on other worlds, which decide what is looked at
        m = m._with(feature=jnp.where(m.live.any(axis=0), m.feature, 0))
    return m if selected.filled is None else m._with(live=m.live & selected.filled[None])


def _near(a: Pose, b: Pose, size_a, size_b, margin) -> jax.Array:
    """Whether the bounding boxes of two boxes, grown by ``margin``, overlap, (P, B)."""
    grown = half_widths("box", size_a, a).map(lambda c: c + margin)
    return close(Bounds(a.x, grown), Bounds(b.x, half_widths("box", size_b, b)), False)


def rows_of(g: Group, selected: Selected, m: Manifold, world: World) -> Rows:
    """Contact rows of a manifold. The moving body of a one-body row is B, and the normal points to it."""
    numbers = selected.numbers
    flip = g.flip
    index_b = selected.body_a if flip else selected.body_b
    index_a = selected.body_a if g.category == "dynamic" else None
    arm = lambda index: m.point - take_tree(world.bodies.x, index)
    surface = surface_spin = None
    if g.category == "kinematic":
        index = selected.body_b if flip else selected.body_a
        k = world.kinematic
        r = m.point - take_tree(k.x, index)
        surface = take_tree(k.v, index) + take_tree(k.w, index).cross(r)
        surface_spin = take_tree(k.w, index) if g.torsion else None
    return Rows(
        n=-m.normal if flip else m.normal,
        rb=arm(index_b),
        phi=m.distance,
        live=m.live,
        b=index_b,
        a=index_a,
        ra=arm(index_a) if index_a is not None else None,
        mu=numbers.mu,
        e=numbers.e,
        surface=surface,
        mu_spin=numbers.mu_spin,
        mu_roll=numbers.mu_roll,
        surface_spin=surface_spin,
        feature=m.feature if g.features else None,
        law=numbers.law,
        central_a=g.central_a and index_a is not None,
        central_b=g.central_a if flip else g.central_b,
        colours=g.colours,
    )


def _group(
    g: Group, gp: GroupParams, p: Params, world: World, number: int, reach, fastest, reach_of_model, alone
) -> Contact:
    pairs = overflow = None
    if g.choice is not None:
        pairs, overflow = _choose(g, gp, p, world, reach)

    def looked_at(keys):
        """Pairs that are looked at, and how far each side may come in the step."""
        selected = everything(g, gp) if keys is None else chosen(g, gp, keys)
        if fastest is not None and g.capacity is None:
            return selected, _ways(g, selected, p, world, fastest)
        if reach_of_model == "margin" or (reach_of_model != "step" and g.capacity is None):
            return selected, None
        sides = ((side_of(g, "a"), selected.body_a), (side_of(g, "b"), selected.body_b))
        reaches = [take(reach, i) for c, i in sides if c == "dynamic"]
        if g.choice is not None and g.category == "kinematic":
            reaches.append(take(_sweep_of(p, world), selected.body_b if g.flip else selected.body_a))
        return selected, reaches

    def narrow(selected, world, reaches, one):
        margin = jnp.inf if reach_of_model == "all" else 0.0
        if reaches is not None:
            margin = SLOP * min_size(g.kind, selected.numbers.size_a, selected.numbers.size_b) + sum(reaches)
        elif gp.law is not None:
            margin = selected.numbers.law.margin
        return manifold(g, selected, world, margin, one)

    if alone and pairs is not None:
        count = below(pairs, jnp.full((1, 1), no_key(len(g.choice.a), len(g.choice.b)), jnp.int32))[0, 0]
        before = lookup_of_one(pairs, world.pairs[number], count)
        return _in_blocks_of(g, p, world, number, looked_at, narrow, (pairs, before), count)._with(
            pairs=pairs, overflow=overflow
        )
    selected, reaches = looked_at(pairs)
    if alone and fastest is not None and g.choice is None:
        near = _near_ones(g, narrow(selected, world, reaches, p.one))

        def again(places):
            return pick(selected, places), [c if c.shape[0] == 1 else at(c, places) for c in reaches]

        places = near.order[:, None]
        return _in_blocks_of(g, p, world, number, again, narrow, (places, places), near.count)._with(places=places)
    m = piece(narrow)(selected, world, reaches, p.one)
    if g.choice is not None:  # the solver gathers from the rows: not the narrow phase again for each of them
        m = m._with(**materialise(dict(normal=m.normal, point=m.point, distance=m.distance), p.one))
    if g.padding is not None:
        m = m._with(live=m.live & ~g.padding[:, None])
    rows = piece(lambda *args: rows_of(g, *args))(selected, m, world)
    last, warm = _kept(m, _last(g, world, number, pairs, rows.feature))
    return Contact(m, rows, last, warm, pairs, overflow, selected.numbers)


def _kept(m: Manifold, last: Impulses) -> tuple[Impulses, Impulses]:
    """Impulses of the last step, and those of them to start from."""
    again = m.live & (last.n > 0)  # negative: an impact
    return last, jax.tree.map(lambda c: jnp.where(again, c, 0.0), last)


# --- one world in a program of loops: what does not touch costs nothing ---


def _near_ones(g: Group, m: Manifold) -> Listed:
    """The pairs of a group that looks at all its pairs which have a live slot, in their order."""
    live = m.live.any(axis=(0, 2))
    return listed(live if g.padding is None else live & ~g.padding)


def _in_blocks_of(g, p, world, number, looked_at, narrow, listed, count) -> Contact:
    """A contact of listed pairs, of which the first ``count`` are filled.

    listed: what ``looked_at`` takes, and the places of the pairs in the last step, (P, 1).
    """

    def block(keys, before, filled):
        selected, reaches = looked_at(keys)
        if filled is not None:
            selected = selected._with(filled=filled)
        m = narrow(selected, world, reaches, p.one)
        m = m._with(**materialise(dict(normal=m.normal, point=m.point, distance=m.distance), p.one))
        rows = rows_of(g, selected, m, world)
        last = _found(g, world, number, before, rows.feature)
        return m, rows, *_kept(m, last), selected.numbers

    width = _width(g)
    filled = None if width == 1 else jnp.arange(len(listed[0]))[:, None] < count
    m, rows, last, warm, numbers = in_blocks(block, count, *listed, filled, width=width)
    return Contact(m, rows._with(filled=count), last, warm, None, None, numbers)


def _width(g: Group) -> int:
    """Pairs of a block: fewer where each costs more."""
    return block_of(1 if g.kind == ("box", "box") else max(BLOCK // g.slots, 1))


def of_places(contact: Contact, x):
    """Of an array (P, B) over all pairs of a group what belongs to the rows of ``contact``."""
    return x if contact.places is None else at(x, contact.places)


def put_back(contact: Contact, tree, world_tree):
    """Arrays (..., C, 1) of a contact in the order of its group, (..., P, 1), zero where it has none."""
    if contact.places is None:
        return tree
    axis = lambda c: c.ndim - 2

    def one(k, out):
        at = contact.places[k, 0]
        value = lambda c: jax.lax.dynamic_slice_in_dim(c, k, 1, axis(c), allow_negative_indices=False)
        put = lambda c, v: jax.lax.dynamic_update_slice_in_dim(c, v, at, axis(c), allow_negative_indices=False)
        return jax.tree.map(lambda c, v: put(c, value(v)), out, tree)

    return repeat(0, contact.rows.filled, one, jax.tree.map(jnp.zeros_like, world_tree))


def _ways(g: Group, selected: Selected, p: Params, world: World, fastest) -> list[jax.Array]:
    """How far the surface of each geom that moves may come in the step, whatever hits its body [m]."""
    n, ways = selected.numbers, []
    for side, size, local in (("a", n.size_a, n.local_a), ("b", n.size_b, n.local_b)):
        category = side_of(g, side)
        if category == "dynamic":
            way, turn = fastest
            ways.append(way[None])
            radius = _radius(g.kind["ab".index(side)], size, local)
            if radius is not None:
                ways.append(turn[None] * radius)
        elif category == "kinematic":
            ways.append(_swept_at(g, selected, p, world))
    return ways


def _swept_at(g: Group, selected: Selected, p: Params, world: World) -> jax.Array:
    """How far a kinematic body goes in a step where the other body of the pair is [m], its turn with it; (P, B)."""
    ends, sizes = (selected.body_a, selected.body_b), (selected.numbers.size_a, selected.numbers.size_b)
    mine, other = (1, 0) if g.flip else (0, 1)
    k = take_tree(world.kinematic, ends[mine])
    arm = safe_norm(take_tree(world.bodies.x, ends[other]) - k.x) + _extent(sizes[other])
    return p.h * (safe_norm(k.v) + safe_norm(k.w) * arm)


def _extent(size) -> jax.Array:
    """Distance from the centre of a sphere or box to its farthest point [m]."""
    return size[0] if len(size) == 1 else safe_norm(Vec3(*size))


def _radius(kind: str, size, local: Pose | None):
    """Distance from the centre of mass to the farthest point of a geom that a turn moves [m]; None = none does."""
    radius = None if kind == "sphere" else _extent(size)
    if local is None:
        return radius
    return safe_norm(local.x) + (0.0 if radius is None else radius)


def min_size(kind, size_a, size_b):
    """Smallest half-size of the two geoms of a pair [m]."""
    least = None
    for size in (*size_a, *size_b):
        least = size if least is None else jnp.minimum(least, size)
    return least


def side_of(g: Group, side: str) -> str:
    if g.category == "dynamic" or (side == "a") == g.flip:
        return "dynamic"
    return g.category


def place(x: Vec3, q: Quat | None, local: Pose | None) -> Pose:
    """World pose of geoms at ``local`` on bodies at x, q."""
    if local is None:
        return Pose(x, q)
    return Pose(x + q.rotate(local.x), q @ local.q)


def pose_of(world: World, category: str, index, local: Pose | None) -> Pose:
    """World pose of geoms, (P, B) or (P, 1)."""
    if category == "static":
        return local
    frame = world.bodies if category == "dynamic" else world.kinematic
    x = take_tree(frame.x, index)
    q = None if frame.q is None else take_tree(frame.q, index)
    return place(x, q, local)


def _choose(g: Group, gp: GroupParams, p: Params, world: World, reach):
    """Keys of the pairs that may touch within the step, and whether there are too many."""
    c = g.choice

    def bounds(side: str, bodies, local, size) -> Bounds:
        category = side_of(g, side)
        pose = pose_of(world, category, Index(bodies), local)
        half = half_widths(g.kind["ab".index(side)], size, pose)
        grown = 0.5 * SLOP * min_size(g.kind, size, ())
        if category != "static":
            grown = grown + take(reach if category == "dynamic" else _sweep_of(p, world), Index(bodies))
        return Bounds(pose.x, half.map(lambda c: c + grown))

    balls = g.kind == ("sphere", "sphere")
    a = bounds("a", c.body_a, gp.local_a, gp.size_a)
    b = a if c.same else bounds("b", c.body_b, gp.local_b, gp.size_b)
    worlds = world.bodies.x.x.shape[-1]
    if c.candidates is None and in_one_function() and worlds == 1:
        keys, overflow = pairs_of_one(a, b, balls, c.allowed, g.capacity)
    elif c.candidates is None:
        keys, overflow = all_pairs(a, b, balls, c.allowed, g.capacity)
    else:
        keys, overflow = grid_pairs(a, None if c.same else b, balls, c.allowed, g.capacity, c.candidates)
    return jnp.broadcast_to(keys, (g.capacity, worlds)), jnp.broadcast_to(overflow, (worlds,))


def _last(g: Group, world: World, number: int, pairs, feature) -> Impulses:
    """Impulses of the last step for the same pair and the same features, zero elsewhere."""
    place = None if pairs is None else lookup(pairs, world.pairs[number])
    return _found(g, world, number, place, feature)


def _found(g: Group, world: World, number: int, place, feature) -> Impulses:
    """``_last`` of the pairs at ``place`` of the arrays of the last step; None: of all in their order."""
    last = world.contacts[number]
    if place is not None:
        known = place < last.n.shape[1]
        safe = jnp.where(known, place, 0)
        last = jax.tree.map(lambda c: jnp.where(known[None], jnp.take_along_axis(c, safe[None], axis=1), 0.0), last)
        if feature is not None:
            same = jnp.take_along_axis(world.feature[number], safe, axis=0) == feature
            last = jax.tree.map(lambda c: jnp.where(same[None], c, 0.0), last)
    elif feature is not None:
        same = world.feature[number] == feature
        last = jax.tree.map(lambda c: jnp.where(same[None], c, 0.0), last)
    return last
