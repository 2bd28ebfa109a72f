"""Layer 5: contact rows, the one language between contact geometry and every solver.

A group of rows covers P pairs with S slots (points) each, in B worlds. For a slot with arms rA, rB
from the centres of mass, the relative velocity at the point is

    u = vB + wB x rB - (vA + wA x rA)        (A absent: u = vB + wB x rB - surface)

with normal part n . u (n points from A to B) and tangential parts t1 . u, t2 . u. An impulse
p = n pn + t1 p1 + t2 p2 acts on B at rB and -p on A at rA.

Torsional and rolling friction add rows of the relative angular velocity wB - wA: its part n . w about the
normal, and t1 . w, t2 . w about the tangents. Their angular impulse n s + t1 r1 + t2 r2 acts on B and its
opposite on A, whatever the arms.

When the partner is not a body (static or kinematic), the moving body is always B: the normal
points from the partner to the body.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..bodies import Inertia
from ..loops import in_blocks, read, repeat, write
from ..spatial import Quat, Vec3, tangent_basis
from ..struct import static, struct
from ..xla import in_one_function


class Index:
    """Rows of the body axis that a group touches: fixed for all worlds (numpy) and hashable."""

    def __init__(self, rows):
        self.rows = np.asarray(rows, np.int32)
        self.column = self.rows[:, None]  # one object: what a loop closes over is one array then
        self._hash = hash(self.rows.tobytes())

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return isinstance(other, Index) and np.array_equal(self.rows, other.rows)

    def __len__(self):
        return len(self.rows)


@struct
class Rows:
    """Contact rows of one group; see the module text.

    Attributes:
      a, b: body of each pair: an ``Index`` (static, (P,)) or an int32 array (P, B) that differs from
        world to world; ``a`` is None when the partner is not a body.
      n: unit normal from A to B, (P, B), or (P, 1) where it is the same in all worlds.
      ra, rb: arms from the centre of mass to the point [m], (S, P, B).
      phi: signed gap [m], negative = overlap, (S, P, B).
      live: slots that hold a point, bool (S, P, B).
      mu: friction coefficient (P, 1) or (P, B), None = frictionless (no tangential rows at all).
      mu_spin: coefficient of torsional friction [m], like mu; None = no row about the normal.
      mu_roll: coefficient of rolling friction [m], None = no rows about the tangents; needs mu_spin, which needs mu.
      e: restitution coefficient, None = absent.
      meets: whether a pair collides within the step, bool (P, B), where that is known better than from the normal
        at its start; None = unknown.
      surface: velocity of a kinematic partner at the points [m/s], (S, P, B), None = at rest.
      surface_spin: its angular velocity [rad/s], (P, B); None = at rest, or no row that needs it.
      filled: of pairs that one world chose in a program of loops: how many there are, int32 (); those from there on
        are empty. None = all may hold one.
      feature: manifold code for warm starting, int32 (P, B) or (1, 1).
      law: per-pair numbers of a contact law that a solver asks for (solref, solimp, ...), or None.
      central_a, central_b: the normal passes through that body's centre of mass (a sphere whose
        centre it is): the normal row has no angular part.
      colours: tuple of (start, stop) slices of the pair axis; inside one no body appears twice.
    """

    n: Vec3
    rb: Vec3
    phi: jax.Array
    live: jax.Array
    b: Index | jax.Array
    a: Index | jax.Array | None = None
    ra: Vec3 | None = None
    mu: jax.Array | None = None
    e: jax.Array | None = None
    meets: jax.Array | None = None
    surface: Vec3 | None = None
    mu_spin: jax.Array | None = None
    mu_roll: jax.Array | None = None
    surface_spin: Vec3 | None = None
    filled: jax.Array | None = None
    feature: jax.Array | None = None
    law: object = None
    central_a: bool = static(default=False)
    central_b: bool = static(default=False)
    colours: tuple = static(default=())

    @property
    def tangents(self) -> tuple[Vec3, Vec3]:
        return tangent_basis(self.n)

    @property
    def slots(self) -> int:
        return self.phi.shape[0]


jax.tree_util.register_static(Index)


@struct
class Impulses:
    """Contact impulses of one group [N s], (S, P, B), and the angular impulses of its angular rows [N m s].

    t1 and t2 are None without friction, s (about the normal) without torsional friction, r1 and r2 (about t1
    and t2) without rolling friction.
    """

    n: jax.Array
    t1: jax.Array | None = None
    t2: jax.Array | None = None
    s: jax.Array | None = None
    r1: jax.Array | None = None
    r2: jax.Array | None = None


@struct
class InverseInertia:
    """World inverse inertia R I^-1 R^T of every body [1/(kg m^2)].

    Either a scalar array (n, 1 or B) for isotropic bodies, or the six entries of a symmetric matrix.
    """

    xx: jax.Array
    yy: jax.Array | None = None
    zz: jax.Array | None = None
    xy: jax.Array | None = None
    xz: jax.Array | None = None
    yz: jax.Array | None = None

    def __matmul__(self, v: Vec3) -> Vec3:
        if self.yy is None:
            return v * self.xx
        return Vec3(
            self.xx * v.x + self.xy * v.y + self.xz * v.z,
            self.xy * v.x + self.yy * v.y + self.yz * v.z,
            self.xz * v.x + self.yz * v.y + self.zz * v.z,
        )

    def take(self, index) -> InverseInertia:
        return jax.tree.map(lambda c: take(c, index), self)


def by_pair(f, rows: Rows, *more):
    """``f(rows, *more)``, arrays over pairs each of which is worked out by itself, without those that are empty."""
    if rows.filled is None:
        return f(rows, *more)
    return in_blocks(f, rows.filled, rows._with(filled=None), *more)


def take(x: jax.Array, index) -> jax.Array:
    """Rows of a body array (n, B or 1): (P, B or 1). No operation when the index is 0, 1, ..., n-1."""
    if isinstance(index, Index):
        rows = index.rows
        if len(rows) == x.shape[0] and np.array_equal(rows, np.arange(len(rows))):
            return x
        if len(rows) and np.array_equal(rows, np.arange(rows[0], rows[0] + len(rows))):
            return x[int(rows[0]) : int(rows[0]) + len(rows)]
        return gathered(x, index.column)
    if x.shape[1] == 1:
        return x[:, 0][index]
    return jnp.take_along_axis(x, index, axis=0)


# ``x[rows]`` and ``x.at[rows].add`` come with the arithmetic of negative and of too large rows: some ten operations
# instead of one, for each component of each group, and again in every derivative.


def gathered(x: jax.Array, column: np.ndarray | jax.Array) -> jax.Array:
    """x[rows], rows as a ``column`` (P, 1)."""
    numbers = jax.lax.GatherDimensionNumbers(tuple(range(1, x.ndim)), (0,), (0,))
    return jax.lax.gather(x, column, numbers, (1, *x.shape[1:]), mode="promise_in_bounds")


def _scatter_added(x: jax.Array, column: np.ndarray, values: jax.Array, unique: bool) -> jax.Array:
    """x.at[rows].add(values), rows as a ``column`` (P, 1)."""
    shape = np.broadcast_shapes(x.shape[1:], values.shape[1:])
    x = jnp.broadcast_to(x, (len(x), *shape))
    values = jnp.broadcast_to(values, (len(column), *shape))
    numbers = jax.lax.ScatterDimensionNumbers(tuple(range(1, x.ndim)), (0,), (0,))
    return jax.lax.scatter_add(x, column, values, numbers, unique_indices=unique, mode="promise_in_bounds")


def take_tree(tree, index):
    return jax.tree.map(lambda x: take(x, index), tree)


def add_rows(x: jax.Array, index, values: jax.Array, unique: bool = False) -> jax.Array:
    """x with ``values`` (P, B) added at the rows of ``index``; unique: no row appears twice."""
    if isinstance(index, Index):
        rows = index.rows
        if len(rows) == x.shape[0] and np.array_equal(rows, np.arange(len(rows))):
            return x + values
        if in_one_function():
            return _added_in_turn([x], rows, [values])[0]
        return _scatter_added(x, index.column, values, unique)
    if in_one_function() and x.shape[1] == 1:
        return _added_in_turn([x], index[:, 0], [values])[0]
    return x.at[index, jnp.arange(x.shape[1])[None, :]].add(values)


def add_trees(tree, index, values, filled: jax.Array | None = None, sign: float = 1.0):
    """As ``add_rows`` of every array of ``tree`` and of ``sign`` times the values, in one loop where it is one.

    filled: pairs from here on are zero.
    """
    fixed = isinstance(index, Index)
    leaves, kind = jax.tree.flatten(tree)
    given = kind.flatten_up_to(values)
    in_order = fixed and len(index) == len(leaves[0]) and np.array_equal(index.rows, np.arange(len(index)))
    if in_one_function() and not in_order and (fixed or index.shape[1] == 1):
        rows = index.rows if fixed else index[:, 0]
        return kind.unflatten(_added_in_turn(leaves, rows, given, filled, sign))
    return kind.unflatten([add_rows(x, index, _times(v, sign)) for x, v in zip(leaves, given)])


def _times(x: jax.Array, sign: float) -> jax.Array:
    return x if sign == 1.0 else x * sign


def _added_in_turn(leaves: list, rows: np.ndarray | jax.Array, values: list, filled=None, sign: float = 1.0) -> list:
    wide = np.broadcast_shapes(*(c.shape[1:] for c in (*leaves, *values)))
    leaves = [jnp.broadcast_to(c, (len(c), *wide)) for c in leaves]
    values = [jnp.broadcast_to(c, (len(rows), *wide)) for c in values]
    rows = jnp.asarray(rows)
    new = lambda x, v, k: write(x, rows[k], read(x, rows[k]) + _times(read(v, k), sign))
    add_one = lambda k, leaves: [new(x, v, k) for x, v in zip(leaves, values)]
    return repeat(0, len(rows) if filled is None else filled, add_one, leaves)


def inverse_inertia(inertia: Inertia, q: Quat) -> InverseInertia:
    """R I^-1 R^T of every body."""
    if inertia.isotropic:
        return InverseInertia(1.0 / inertia.moments)
    r = q.mat()
    d = Vec3(*(1.0 / c for c in (inertia.moments.x, inertia.moments.y, inertia.moments.z)))
    ax, bx, cx = r.a * d, r.b * d, r.c * d
    return InverseInertia(ax.dot(r.a), bx.dot(r.b), cx.dot(r.c), ax.dot(r.b), ax.dot(r.c), bx.dot(r.c))


def spread(total: Vec3, rows: Rows, values: Vec3, sign: float = 1.0) -> Vec3:
    """``total`` (n, B) with ``sign`` times pair values (P, B) added to body B and subtracted from body A."""
    total = add_trees(total, rows.b, values, rows.filled, sign)
    return total if rows.a is None else add_trees(total, rows.a, values, rows.filled, -sign)
