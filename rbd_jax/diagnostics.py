"""Layer 8: what the worlds are doing: energy, momentum, contacts, status. Pure functions of (model, state).

All accept any batch axes and trajectories; model leaves with batch axes are aligned with the first ones.
"""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np

from .bodies import Bodies
from .detect import detect
from .model import Model, Params, batch_of
from .spatial import Vec3, pack
from .state import State, Wrench, to_public
from .status import MESSAGE, Status
from .step import enter, with_memory
from .struct import struct


def _open(model: Model, state: State):
    state = with_memory(model, state)
    batch = batch_of(model, state.batch_shape)
    p, world = enter(model, state, batch)
    return p, world, batch


def energy(model: Model, state: State) -> tuple[jax.Array, jax.Array]:
    """Kinetic and potential energy of every world [J], each (...).

    Potential: - sum of m g . x of the centres of mass; contacts store none.
    """
    p, world, batch = _open(model, state)
    return to_public(energies(p, world.bodies), batch)


def energies(p: Params, b: Bodies) -> tuple[jax.Array, jax.Array]:
    """Kinetic and potential energy of every world in the hot layout [J], (B,)."""
    kinetic = 0.5 * p.mass * b.v.dot(b.v)
    if b.L is not None:
        kinetic = kinetic + 0.5 * b.L.dot(p.inertia.velocity(b.q, b.L))
    potential = jnp.zeros_like(kinetic)
    if p.gravity is not None:
        potential = -p.mass * p.gravity.dot(b.x)
    return kinetic.sum(axis=0), potential.sum(axis=0)


def momentum(model: Model, state: State) -> tuple[jax.Array, jax.Array]:
    """Linear momentum P [N s] and angular momentum L about the world origin [N m s], each (..., 3)."""
    p, world, batch = _open(model, state)
    b = world.bodies
    P = b.v * p.mass
    L = b.x.cross(P)
    if b.L is not None:
        L = L + b.L
    total = lambda v: pack(to_public(v.map(lambda c: jnp.broadcast_to(c, b.x.x.shape).sum(axis=0)), batch))
    return total(P), total(L)


def inertia_world(model: Model, state: State) -> jax.Array:
    """World inertia R I Rᵀ about each centre of mass [kg m^2], (..., n, 3, 3).

    Raises:
      ValueError: the scene models no attitude (frictionless spheres without a mentioned spin).
    """
    p, world, batch = _open(model, state)
    b = world.bodies
    if b.q is None:
        raise ValueError("inertia_world: this scene models no attitude; mention omega or friction in the scene")
    one, zero = jnp.ones_like(b.x.x), jnp.zeros_like(b.x.x)
    columns = [p.inertia.momentum(b.q, Vec3(*(one if i == k else zero for i in range(3)))) for k in range(3)]
    return jnp.stack([pack(to_public(c, batch)) for c in columns], axis=-1)


def wrench_at(force, point, pos) -> Wrench:
    """The wrench about ``pos`` of a ``force`` [N] that acts at ``point`` [m], all (..., n, 3), world frame."""
    force, point, pos = jnp.asarray(force), jnp.asarray(point), jnp.asarray(pos)
    return Wrench(force, jnp.cross(point - pos, force))


@struct
class Contacts:
    """Contact points of every world, c slots in all.

    Attributes:
      body_a, body_b: rows of the bodies, int32 (..., c); -1 = the world or a kinematic body.
      geom_a, geom_b: rows of the geoms, (..., c).
      point: (..., c, 3) [m]. normal: (..., c, 3) from A to B. distance: (..., c) [m], negative = overlap.
      force: (..., c, 3) on B, world frame, mean over the last (sub)step [N].
      kind: int32 (..., c): 0 apart, 1 resting, 2 colliding, 3 separating.
      live: bool (..., c): the surfaces touch or overlap, or carried a force in the last step.
    """

    body_a: jax.Array
    body_b: jax.Array
    geom_a: jax.Array
    geom_b: jax.Array
    point: jax.Array
    normal: jax.Array
    distance: jax.Array
    force: jax.Array
    kind: jax.Array
    live: jax.Array


#: Normal speed below which a contact counts as resting: this many times |g| h, plus 1 mm/s.
RESTING = 2.0


def contacts(model: Model, state: State) -> Contacts:
    """Contact points at the poses of ``state``, with the forces of the last step.

    A slot is live where its gap is at most 0.1 % of the smaller geom or where it carried a force; it is
    colliding or separating when its normal speed exceeds 2 |g| h + 1 mm/s, else resting.
    """
    p, world, batch = _open(model, state)
    b = world.bodies
    w = None if b.L is None else p.inertia.velocity(b.q, b.L)
    parts = []
    for g, gp, c in zip(model.structure.groups, p.groups, detect(model.structure, p, world, "all")):
        parts.append(_points(model, g, gp, c, c.last._with(n=jnp.abs(c.last.n)), p, b, w))
    shape = b.x.x.shape[-1:]
    if not parts:
        none = jnp.zeros((0, *shape))
        v = Vec3(none, none, none)
        parts = [(none, none, none, none, v, v, none, v, none, none > 0)]
    joined = jax.tree.map(lambda *c: jnp.concatenate(c), *parts) if len(parts) > 1 else parts[0]
    ints = lambda c: c.astype(jnp.int32)
    public = to_public(joined, batch)
    body_a, body_b, geom_a, geom_b, point, normal, distance, force, kind, live = public
    return Contacts(
        ints(body_a),
        ints(body_b),
        ints(geom_a),
        ints(geom_b),
        pack(point),
        pack(normal),
        distance,
        pack(force),
        ints(kind),
        live,
    )


def _points(model, g, gp, c, lam, p, b, w):
    """Flat (S P, B) arrays of one group, normal from A to B of the canonical pair."""
    from .detect import geoms_of, min_size
    from .solvers.restitution import normal_velocity

    rows = c.rows
    shape = jnp.broadcast_shapes(rows.phi.shape, (1, 1, b.x.x.shape[-1]))
    flat = lambda x: jnp.broadcast_to(x, shape).reshape(-1, shape[-1])
    sign = -1.0 if g.flip else 1.0
    impulse = rows.n * lam.n
    if lam.t1 is not None:
        t1, t2 = rows.tangents
        impulse = impulse + t1 * lam.t1 + t2 * lam.t2
    force = impulse * (sign / p.h)
    u = normal_velocity(rows, b.v, w)
    g_h = 0.0 if p.gravity is None else jnp.sqrt(p.gravity.dot(p.gravity)) * p.h
    slow = RESTING * g_h + 1e-3
    least = min_size(g.kind, c.numbers.size_a, c.numbers.size_b)
    live = rows.live & ((rows.phi <= 1e-3 * least) | (lam.n > 0))
    kind = jnp.where(live, jnp.where(u < -slow, 2, jnp.where(u > slow, 3, 1)), 0)
    if c.pairs is None:
        geoms = [jnp.asarray(x)[:, None] for x in (g.a, g.b)]
    else:
        geoms = [jnp.asarray(x)[k] for x, k in zip((g.choice.a, g.choice.b), geoms_of(g, c.pairs))]
    moving = lambda side: g.category == "dynamic" or (side == "a") == g.flip
    body = lambda side, geom: jnp.asarray(model.structure.geom_body)[geom] if moving(side) else jnp.full_like(geom, -1)
    vec = lambda v: v.map(flat)
    return (
        flat(body("a", geoms[0])),
        flat(body("b", geoms[1])),
        flat(geoms[0]),
        flat(geoms[1]),
        vec(c.manifold.point),
        vec(c.manifold.normal),
        flat(rows.phi),
        vec(force),
        flat(kind),
        flat(live),
    )


class SimulationError(RuntimeError):
    """Raised by :func:`check`; ``worlds`` holds the flat indices of the worlds concerned."""

    def __init__(self, message: str, worlds: tuple[int, ...]):
        super().__init__(message)
        self.worlds = worlds


def check(state: State) -> State:
    """Return ``state`` if every world is well, else raise, naming world, status and remedy.

    Call it outside jit. A trajectory is checked over all its samples. NOT_CONVERGED alone warns
    (RuntimeWarning): the solver stopped early in some step, the state is sound.

    Raises:
      SimulationError: some world has another status bit set.
    """
    status = np.asarray(state.status)
    bad = np.argwhere(status != 0)
    if not len(bad):
        return state
    lines = []
    for bit, (cause, remedy) in MESSAGE.items():
        where = np.argwhere(status & int(bit))
        if len(where):
            names = ", ".join(str(w.tolist() if len(w) != 1 else int(w[0])) if len(w) else "0" for w in where[:5])
            more = f" and {len(where) - 5} more" if len(where) > 5 else ""
            first = tuple(where[0])
            at = int(np.asarray(state.step)[first])
            lines.append(f"world {names}{more}: {bit.name}: {cause} (step {at}). Remedy: {remedy}.")
    spoilt = status & ~np.asarray(int(Status.NOT_CONVERGED), status.dtype)
    if not spoilt.any():
        warnings.warn("\n".join(lines), RuntimeWarning, stacklevel=2)
        return state
    raise SimulationError("\n".join(lines), tuple(int(i) for i in np.flatnonzero(spoilt)))
