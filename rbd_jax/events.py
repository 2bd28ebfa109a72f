"""Layer 7: impacts at their own instant, several per step and world.

Before a step is solved, every world is advanced to its next impact: bodies fly ballistically (those that
rest on something keep the forces of the last step), the first pair that closes faster than the threshold is
moved to the instant at which it touches, and receives its impulse there: position, normal and speed are those
of the impact. This repeats ``Method.events`` times; what is left of the step is a step of that length.

The instant solves phi(t) = 0 by ITERATIONS of t <- t + root of phi + u dt + a dt^2 / 2, which is exact at once for a
sphere and a plane and converges quadratically elsewhere; phi(t) is convex for spheres and for the straight path
of a sphere to a box, so no thin wall is jumped over. The search is not differentiated: the instant of the pair that
collides has the derivative dt = -(dphi/dtheta) dtheta / (dphi/dt), as phi(t(theta), theta) = 0.

Groups whose pairs mention no restitution have no events: their impacts are resolved within the step. (Zero is a value:
restitution=0.0 has them.) An approach slower than max((1 - e) / 2, REST) h |a| (a: what the forces but contact give
both bodies) is left to the
step: the bodies have come to rest. One pair at a time: of simultaneous impacts the order is that of the groups.
Gradients: exact, of the event map; where the number or the order of the impacts changes, the motion is
discontinuous and has none.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from . import implicit
from .bodies import Bodies, Inertia
from .contact import NARROW, Pose
from .detect import Selected, manifold, min_size, pick, place, rows_of, side_of
from .model import Group, Model, Params
from .solvers.base import Problem
from .solvers.gauss_seidel import Sweep, prepare, sweep
from .solvers.restitution import normal_velocity
from .solvers.rows import Impulses, Index, Rows, add_rows, inverse_inertia, take_tree
from .spatial import Vec3, components, qexp, safe_norm, zeros_like
from .state import Kinematic, World
from .struct import struct

#: Steps of the search for the instant of an impact.
ITERATIONS = 6
#: Gauss-Seidel sweeps over the points of a pair that collides in more than one, or off its centres.
SWEEPS = 20
#: Least threshold, as a part of what the forces give in a step.
REST = 0.02


@struct
class Flight:
    """Bodies with their constant acceleration [m/s^2] and torque [N m], and the part of it that is not contact."""

    bodies: Bodies
    a: Vec3
    tau: Vec3 | None
    free: jax.Array  # |a| without contact


def advance_to_impacts(
    model: Model, p: Params, world: World, selected: tuple[Selected, ...], a: Vec3 | None, tau: Vec3 | None, support
):
    """Every world at its last impact of this step, the time that is left of the step [s], (B,), and the pairs of
    every group that meet in that time nevertheless (P, B): there were more impacts than events.

    Args:
      selected: the pairs of every group that may touch in the step, None for a group that has no events.
      a, tau: acceleration [m/s^2] and torque [N m] of all forces but contact.
      support: impulse and angular impulse that the contacts gave in the last step.
    """
    zero = zeros_like(world.bodies.v)
    a = zero if a is None else a
    free = safe_norm(a)
    push, turn = support
    a = a + push * (p.inv_mass / p.h)
    if world.bodies.L is not None:
        tau = (zeros_like(a) if tau is None else tau) + turn * (1.0 / p.h)
    taking_part = [(g, sel) for g, sel in zip(model.structure.groups, selected) if sel is not None]
    groups = [g for g, _ in taking_part]
    pairs = tuple(sel for _, sel in taking_part)
    step = jnp.broadcast_to(p.h, world.step.shape).astype(zero.x.dtype)
    last = jnp.finfo(zero.x.dtype).eps ** 0.5 * step

    def event(carry, _):
        bodies, kinematic, left = carry
        world_now = world._with(bodies=bodies, kinematic=kinematic)
        flight = Flight(bodies, a, tau, free)
        found = jax.lax.stop_gradient((p, pairs, world_now, flight, left - last))
        hits = implicit.found(
            [_soonest(_search(model, found[0], g, sel, *found[2:])) for g, sel in zip(groups, found[1])]
        )
        soonest = hits[0][0]
        for t, _ in hits[1:]:
            soonest = jnp.minimum(soonest, t)
        any_hit = jnp.isfinite(soonest)
        t = jnp.where(any_hit, soonest, 0.0)
        free_hit, colliding = any_hit, []
        for g, sel, (mine, where_) in zip(groups, pairs, hits):
            wins = free_hit & (mine == soonest)
            free_hit = free_hit & ~wins
            pair = pick(sel, where_[None])
            t = jnp.where(wins, _instant(model, g)(t, (p, pair, world_now, flight)), t)
            colliding.append((g, pair, wins))
        moved = _fly(model, p.inertia, flight, t)
        bodies = jax.tree.map(lambda new, old: jnp.where(any_hit, new, old), moved, bodies)
        kinematic = carried(kinematic, t)
        for g, pair, wins in colliding:
            world_now = world._with(bodies=bodies, kinematic=kinematic)
            bodies = _collide(p, g, pair, world_now, flight, wins)
        return (bodies, kinematic, left - t), None

    carry = (world.bodies, world.kinematic, step)
    (bodies, kinematic, left), _ = jax.lax.scan(event, carry, length=model.method.events)
    world = world._with(bodies=bodies, kinematic=kinematic)
    flight = Flight(bodies, a, tau, free)
    found = jax.lax.stop_gradient((p, selected, world, flight, left))
    meets = lambda g, sel: None if sel is None else jnp.isfinite(_search(model, found[0], g, sel, *found[2:]))
    return world, left, tuple(meets(g, sel) for g, sel in zip(model.structure.groups, found[1]))


def _instant(model: Model, g: Group):
    """(t, (params, pair, world, flight)) -> t (B,), as the instant at which the first of the pair's points touches.

    Zero derivative where the pair overlaps: what touched before the start of the step cannot have touched earlier.
    """

    def gap(t, args):
        p, pair, world, flight = args
        phi, u, _, live = _gaps(model, p, g, pair, world, flight)(t[None])
        first = jnp.argmin(jax.lax.stop_gradient(jnp.where(live, phi, jnp.inf)), axis=0)
        return tuple(jnp.take_along_axis(jnp.broadcast_to(c, phi.shape), first[None], axis=0)[0, 0] for c in (phi, u))

    def shift(phi, change, rate, args):
        closes = (phi > -_tolerance(g, args[1])[0]) & (rate < 0)
        return jnp.where(closes, -change, 0.0) / jnp.where(closes, rate, 1.0)

    @jax.custom_jvp
    def instant(t, args):  # see ``implicit``: its own derivative is right to first order
        phi, u = gap(t, args)
        d = shift(jax.lax.stop_gradient(phi), phi, jax.lax.stop_gradient(u), args)
        return t + (d - jax.lax.stop_gradient(d))

    def rule(primals, tangents):
        t, args = instant(*primals), primals[1]
        change = implicit.tangent(lambda args: gap(t, args)[0], args, tangents[1])
        phi, rate = jax.jvp(lambda t: gap(t, args)[0], (t,), (jnp.ones_like(t),))
        return t, shift(phi, change, rate, args)

    instant.defjvp(rule, symbolic_zeros=True)
    return instant


def _fly(model: Model, inertia: Inertia | None, f: Flight, t) -> Bodies:
    """Bodies after t [s] at constant acceleration and torque."""
    b = f.bodies
    L = None if b.L is None else b.L + f.tau * (0.5 * t)
    new = model.method.integrator.move(b, b.v + f.a * (0.5 * t), L, inertia, t)
    return new._with(v=b.v + f.a * t, L=None if b.L is None else b.L + f.tau * t)


def carried(k: Kinematic | None, t) -> Kinematic | None:
    """Kinematic bodies after t [s] at their constant velocities."""
    return None if k is None else k._with(x=k.x + k.v * t, q=(qexp(k.w * t) @ k.q).normalised())


def _threshold(p: Params, g: Group, selected: Selected, free: jax.Array) -> jax.Array:
    """Approach speed of an impact [m/s], (P, B)."""
    speed = 0.0
    for side, index in (("a", selected.body_a), ("b", selected.body_b)):
        if side_of(g, side) == "dynamic":
            speed = speed + take_tree(free, index)
    e = selected.numbers.e
    part = 0.5 if e is None else jnp.maximum(0.5 * (1.0 - e), REST)
    return part * p.h * speed


def _tolerance(g: Group, selected: Selected) -> jax.Array:
    """Gap that counts as closed [m], (P, B)."""
    size = min_size(g.kind, selected.numbers.size_a, selected.numbers.size_b)
    return jnp.finfo(size.dtype).eps ** 0.5 * size


def _soonest(t: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Instant of the first impact of a group [s] (B,), infinite if there is none, and its pair (B,)."""
    pair = jnp.argmin(t, axis=0)
    return jnp.take_along_axis(t, pair[None], axis=0)[0], pair


def _moving(model: Model, p: Params, g: Group, selected: Selected, world: World, flight: Flight) -> dict:
    """side -> (flight or kinematic motion, inertia) of the geoms that move."""
    sides = {}
    for side, index in (("a", selected.body_a), ("b", selected.body_b)):
        category = side_of(g, side)
        if category == "dynamic":
            inertia = None if p.inertia is None else take_tree(p.inertia, index)
            sides[side] = (take_tree(flight, index), inertia)
        elif category == "kinematic":
            sides[side] = (take_tree(world.kinematic, index), None)
    return sides


def _gaps(model: Model, p: Params, g: Group, selected: Selected, world: World, flight: Flight):
    """t -> gap, closing speed and normal acceleration of every slot, (S, P, B), and which hold a point."""
    n = selected.numbers
    sides = _moving(model, p, g, selected, world, flight)

    def at(t):
        poses, velocity, accel = [], [], []
        for side, local in (("a", n.local_a), ("b", n.local_b)):
            if side not in sides:
                poses.append(local)
                velocity.append(None)
                continue
            frame, inertia = sides[side]
            if isinstance(frame, Flight):
                accel.append((frame.a, 1.0 if side == "b" else -1.0))
                b = _fly(model, inertia, frame, t)
                poses.append(place(b.x, b.q, local))
                velocity.append((b.x, b.v, None if b.L is None else inertia.velocity(b.q, b.L)))
            else:
                k = carried(frame, t)
                poses.append(place(k.x, k.q, local))
                velocity.append((k.x, k.v, k.w))
        m = NARROW[g.kind].function(*poses, n.size_a, n.size_b, jnp.inf, one=p.one)
        u = 0.0
        for frame, sign in zip(velocity, (-1.0, 1.0)):
            if frame is not None:
                x, v, w = frame
                point = v if w is None else v + w.cross(m.point - x)
                u = u + sign * m.normal.dot(point)
        a = sum(sign * m.normal.dot(acc) for acc, sign in accel)
        return m.distance, u, jnp.broadcast_to(a, m.distance.shape), m.live

    return at


def _search(model: Model, p: Params, g: Group, selected: Selected, world: World, flight: Flight, left) -> jax.Array:
    """Instant of the first impact of every pair of a group [s] (P, B), infinite if there is none in ``left``."""
    n = selected.numbers
    sides = _moving(model, p, g, selected, world, flight)
    at = _gaps(model, p, g, selected, world, flight)
    start = jnp.zeros(jnp.broadcast_shapes(_shape(selected, g), left.shape), left.dtype)
    first = NARROW[g.kind].first
    if first is not None and len(sides) == 2:
        (pa, va), (pb, vb) = (_frame(sides[k][0], local) for k, local in (("a", n.local_a), ("b", n.local_b)))
        start = start + jnp.clip(first(pa, pb, va, vb, n.size_a, n.size_b), 0.0, left)
    tolerance, threshold = _tolerance(g, selected), _threshold(p, g, selected, flight.free)

    def search(carry, _):
        _, t, _ = carry
        phi, u, a, live = at(t)
        hit = (live & (phi <= tolerance) & (u < -threshold)).any(axis=0)
        dt, closes = _root(phi, u, a)
        dt = jnp.where(closes & live, dt, jnp.inf).min(axis=0)
        found = jnp.isfinite(dt)
        return (t, jnp.where(found, jnp.clip(t + jnp.where(found, dt, 0.0), 0.0, left), t), hit), None

    # what the last turn finds is asked for at the instant that the turns before it found
    (t, _, hit), _ = jax.lax.scan(search, (start, start, jnp.zeros(start.shape, bool)), length=ITERATIONS + 1)
    if selected.filled is not None:
        hit = hit & selected.filled
    if g.padding is not None:
        hit = hit & ~g.padding[:, None]
    return jnp.where(hit, t, jnp.inf)


def _frame(frame, local) -> tuple[Pose, Vec3]:
    """Pose of a geom and velocity of its body."""
    b = frame.bodies if isinstance(frame, Flight) else frame
    return place(b.x, b.q, local), b.v


def _shape(selected: Selected, g: Group) -> tuple[int, int]:
    return (len(g.a), 1) if selected.places is None else selected.places.shape


def _root(phi, u, a):
    """First time at which phi + u t + a t^2 / 2 = 0 while it falls, and whether there is one.

    A gap that is already closed gives the (negative) time at which it closed.
    """
    s2 = u * u - 2.0 * a * phi
    closes = (s2 > 0) & ((u < 0) | (a < 0))
    s = jnp.sqrt(jnp.where(closes, s2, 1.0))
    leaving = u > 0
    up = (s + u) / jnp.where(closes & leaving, -a, 1.0)
    down = 2.0 * phi / jnp.where(closes & ~leaving, s - u, 1.0)
    return jnp.where(leaving, up, down), closes


def _collide(p: Params, g: Group, pair: Selected, world: World, flight: Flight, wins) -> Bodies:
    """The impulse of one pair of each world where ``wins`` (B,)."""
    bodies = world.bodies
    m = manifold(g, pair, world, jnp.inf, p.one)
    rows = rows_of(g, pair, m, world)
    index = [i for i in (rows.a, rows.b) if i is not None]
    join = lambda *parts: parts[0] if len(parts) == 1 else jnp.concatenate(parts)
    local = lambda tree: jax.tree.map(lambda *c: join(*c), *(take_tree(tree, i) for i in index))
    own = local(bodies)
    own = jax.tree.map(lambda c: jnp.broadcast_to(c, (len(index), wins.shape[0])), own)
    inertia = None if p.inertia is None else local(p.inertia)
    inverse = w = None
    if own.L is not None:
        inverse = inverse_inertia(inertia, own.q)
        w = inverse @ own.L
    threshold, tolerance = _threshold(p, g, pair, flight.free), _tolerance(g, pair)
    rows = rows._with(a=None if rows.a is None else Index([0]), b=Index([len(index) - 1]), e=None, colours=())
    problem = Problem(
        rows=(rows,),
        v0=own.v,
        v=own.v,
        w0=w,
        w=w,
        inv_mass=local(p.inv_mass),
        h=p.h,
        warm=(),
        one=p.one,
        q=own.q,
        inertia=inertia,
        inv_inertia=inverse,
    )
    u = normal_velocity(rows, own.v, w)
    touches = rows.live & (rows.phi <= tolerance) & wins
    hits = touches & (u < -threshold)
    e = 0.0 if pair.numbers.e is None else pair.numbers.e
    target = jnp.where(hits, -e * u, 0.0)
    group = prepare(rows, problem)
    inv = jnp.where(touches, group.mass_n, 0.0)
    group = group._with(
        mass_1=None if group.mass_1 is None else jnp.where(touches, group.mass_1, 0.0),
        mass_2=None if group.mass_2 is None else jnp.where(touches, group.mass_2, 0.0),
    )
    law = Sweep(-target, inv, 0.0)
    zero = jnp.zeros_like(u)
    lam = Impulses(zero, zero, zero) if rows.mu is not None else Impulses(zero)
    alone = rows.slots == 1 and rows.central_b and (rows.a is None or rows.central_a)
    body = (own.v, w)
    if alone:
        body, lam = sweep(group, law, lam, body, p.one)
    else:
        once = lambda carry, _: (sweep(group, law, carry[1], carry[0], p.one), None)
        (body, lam), _ = jax.lax.scan(once, (body, lam), length=SWEEPS)
    dv = body[0] - own.v
    dw = None if w is None else body[1] - w
    if not alone:
        theta = _passive(group, rows, lam, own.v, w, dv, dw, e)
        dv = dv * theta
        dw = None if dw is None else dw * theta
    dL = None if dw is None else inertia.momentum(own.q, dw)

    def spread(total: Vec3, change: Vec3) -> Vec3:
        for k, i in enumerate(index):
            part = change.map(lambda c, k=k: c[k : k + 1])
            total = Vec3(
                *(add_rows(t, i, jnp.where(wins, c, 0.0)) for t, c in zip(components(total), components(part)))
            )
        return total

    bodies = bodies._with(v=spread(bodies.v, dv))
    return bodies if dL is None else bodies._with(L=spread(bodies.L, dL))


def _passive(group, rows: Rows, lam: Impulses, v: Vec3, w, dv: Vec3, dw, e) -> jax.Array:
    """Part of the impulses p that is given, (1, B): the largest that adds no more energy than p.u+ = -e p.u-.

    Newton's law with friction, at several points or off the centre, can (Kane 1985); see ``step._passive``.
    """
    p = rows.n * lam.n
    if lam.t1 is not None:
        p = p + group.t1 * lam.t1 + group.t2 * lam.t2

    def work(v, w):
        def side(index, arm):
            u = take_tree(v, index)
            return u if w is None else u + take_tree(w, index).cross(arm)

        u = side(rows.b, rows.rb)
        if rows.a is not None:
            u = u - side(rows.a, rows.ra)
        return p.dot(u if rows.surface is None else u - rows.surface)

    before, after = work(v, w), work(v + dv, None if w is None else w + dw)
    total = lambda c: c.sum(axis=0)
    before, after, most = total(before), total(after), total(-e * before)
    change = after - before
    gains = (after > most) & (change > 0)
    return jnp.where(gains, jnp.clip((most - before) / jnp.where(gains, change, 1.0), 0.0, 1.0), 1.0)
