"""Layer 7: from the poses of a step to contact rows, group by group.

Poses of geoms -> (broad phase) -> narrow phase -> rows.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from .contact import NARROW
from .contact.base import Manifold, Pose
from .contact.broadphase import compact, half_widths, lookup, separation
from .model import Group, GroupParams, Params, Structure
from .solvers.rows import Impulses, Index, Rows, take, take_tree
from .spatial import safe_norm
from .state import World
from .struct import struct

#: Slots up to this part of a box's size above the surface count as contact points of the manifold.
SLOP = 0.02


@struct
class Contact:
    """A group in one step: its manifold, rows, impulses of the last step, those to start from, the chosen pairs."""

    manifold: Manifold
    rows: Rows
    last: Impulses
    warm: Impulses
    pairs: jax.Array | None
    overflow: jax.Array | None


def detect(s: Structure, p: Params, world: World, model_of_contact: str | None) -> tuple[Contact, ...]:
    """Contacts of every group, with the slots alive that the contact model wants.

    "soft": every slot, however far (a distant row does nothing); "near_rigid": those that may touch
    within the step; "mujoco" and None: those that touch, or are closer than MuJoCo's margin.
    """
    reach = _reach(p, world) if model_of_contact == "near_rigid" or any(g.capacity for g in s.groups) else None
    return tuple(
        _group(g, gp, p, world, i, reach, model_of_contact) for i, (g, gp) in enumerate(zip(s.groups, p.groups))
    )


def _reach(p: Params, world: World) -> jax.Array:
    """How far the surface of a body may come in a step, without its spin [m], (n, B)."""
    bodies = world.bodies
    g = 0.0 if p.gravity is None else p.h * safe_norm(p.gravity)
    return p.h * (safe_norm(bodies.v) + g)


def _group(g: Group, gp: GroupParams, p: Params, world: World, number: int, reach, model_of_contact) -> Contact:
    pairs = overflow = None
    local_a, local_b, size_a, size_b = gp.local_a, gp.local_b, gp.size_a, gp.size_b
    body_a, body_b = Index(g.body_a), Index(g.body_b)
    mu, e, law = gp.mu, gp.e, gp.law
    if g.capacity is not None:
        pairs, overflow = _choose(g, gp, world, reach)
        chosen = jnp.minimum(pairs, len(g.a) - 1)
        body_a, body_b = (jnp.asarray(rows)[chosen] for rows in (np.maximum(g.body_a, 0), np.maximum(g.body_b, 0)))
        local_a, local_b, size_a, size_b, mu, e, law = take_tree((local_a, local_b, size_a, size_b, mu, e, law), chosen)
    pose_a = _pose(world, _side(g, "a"), body_a, local_a)
    pose_b = _pose(world, _side(g, "b"), body_b, local_b)
    margin = jnp.inf if model_of_contact == "soft" else 0.0
    if law is not None:
        margin = law.margin
    if model_of_contact == "near_rigid":
        near = SLOP * min_size(g.kind, size_a, size_b)
        margin = near + sum(
            take(reach, i) for c, i in ((_side(g, "a"), body_a), (_side(g, "b"), body_b)) if c == "dynamic"
        )
    m = NARROW[g.kind].function(pose_a, pose_b, size_a, size_b, margin, one=p.one)
    if pairs is not None:
        m = m._with(live=m.live & (pairs < len(g.a))[None])
    if g.padding is not None:
        m = m._with(live=m.live & ~g.padding[:, None])
    # the moving body of a one-body row is B, and the normal points to it
    flip = g.flip
    n = -m.normal if flip else m.normal
    index_b = body_a if flip else body_b
    index_a = body_a if g.category == "dynamic" else None
    arm = lambda index: m.point - take_tree(world.bodies.x, index)
    surface = None
    if g.category == "kinematic":
        index = body_b if flip else body_a
        k = world.kinematic
        r = m.point - take_tree(k.x, index)
        surface = take_tree(k.v, index) + take_tree(k.w, index).cross(r)
    feature = m.feature if g.features else None
    rows = Rows(
        n=n,
        rb=arm(index_b),
        phi=m.distance,
        live=m.live,
        b=index_b,
        a=index_a,
        ra=arm(index_a) if index_a is not None else None,
        mu=mu,
        e=e,
        surface=surface,
        feature=feature,
        law=law,
        central_a=g.central_a and index_a is not None,
        central_b=g.central_a if flip else g.central_b,
        colours=g.colours,
    )
    last = _last(g, world, number, pairs, feature)
    again = m.live & (last.n > 0)  # negative: an impact
    warm = jax.tree.map(lambda c: jnp.where(again, c, 0.0), last)
    return Contact(m, rows, last, warm, pairs, overflow)


def min_size(kind, size_a, size_b):
    """Smallest half-size of the two geoms of a pair [m]."""
    least = None
    for size in (*size_a, *size_b):
        least = size if least is None else jnp.minimum(least, size)
    return least


def _side(g: Group, side: str) -> str:
    if g.category == "dynamic" or (side == "a") == g.flip:
        return "dynamic"
    return g.category


def _pose(world: World, category: str, index, local: Pose | None) -> Pose:
    """World pose of geoms, (P, B) or (P, 1)."""
    if category == "static":
        return local
    frame = world.bodies if category == "dynamic" else world.kinematic
    x = take_tree(frame.x, index)
    q = None if frame.q is None else take_tree(frame.q, index)
    if local is None:
        return Pose(x, q)
    return Pose(x + q.rotate(local.x), q @ local.q)


def _choose(g: Group, gp: GroupParams, world: World, reach):
    """Pairs whose bounding boxes, grown by the reach of their bodies, overlap."""
    a = _pose(world, _side(g, "a"), Index(g.body_a), gp.local_a)
    b = _pose(world, _side(g, "b"), Index(g.body_b), gp.local_b)
    gap = separation(a, half_widths(g.kind[0], gp.size_a, a), b, half_widths(g.kind[1], gp.size_b, b))
    grown = SLOP * min_size(g.kind, gp.size_a, gp.size_b)
    for side, rows in (("a", g.body_a), ("b", g.body_b)):
        if _side(g, side) == "dynamic":
            grown = grown + take(reach, Index(rows))
    worlds = world.bodies.x.x.shape[-1]
    return compact(jnp.broadcast_to(gap < grown, (len(g.a), worlds)), g.capacity)


def _last(g: Group, world: World, number: int, pairs, feature) -> Impulses:
    """Impulses of the last step for the same pair and the same features, zero elsewhere."""
    last = world.contacts[number]
    if pairs is not None:
        place = lookup(pairs, world.pairs[number], len(g.a))
        known = place < pairs.shape[0]
        safe = jnp.where(known, place, 0)
        last = jax.tree.map(lambda c: jnp.where(known[None], jnp.take_along_axis(c, safe[None], axis=1), 0.0), last)
        if feature is not None:
            same = jnp.take_along_axis(world.feature[number], safe, axis=0) == feature
            last = jax.tree.map(lambda c: jnp.where(same[None], c, 0.0), last)
    elif feature is not None:
        same = world.feature[number] == feature
        last = jax.tree.map(lambda c: jnp.where(same[None], c, 0.0), last)
    return last
