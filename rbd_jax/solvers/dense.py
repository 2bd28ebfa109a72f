"""Layer 5: the Newton systems of the convex contact solvers.

A convex contact problem minimises (v - v*)' M (v - v*) / 2 + sum_c l_c(J_c v). Its Newton step needs
(M + J' G J) d = r, G = the Hessian of l in the contact frame of every point. When no group couples two
bodies this is one system a body, solved component by component; else one dense matrix a world, from whole rows
of J in world axes (``jacobian``).

All rows live in the contact frame of their pair, x along t1, y along t2, z along n, which the slots
of a pair share: the sums over slots are done there and only their results are turned to world axes.

Symbols: r arm in the contact frame; G 3x3 (``Sym3``); K = sum G, C = sum [r]x G, W = sum [r]x G [r]x'
the force-velocity, torque-velocity and torque-spin blocks of a pair. Row vectors (velocities,
impulses) are ``Impulses``: the entries t1 and t2 are None without friction. Where a pair has angular rows
(torsional and rolling friction) G is 6x6 (``Sym6``) with blocks F, X, T of force-velocity, force-spin and
torque-spin, and K = sum F, C = sum [r]x F + X', W = sum [r]x F [r]x' + [r]x X + X' [r]x' + T.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from ..loops import repeat
from ..spatial import Mat3, Vec3, components
from ..struct import static, struct
from ..xla import materialise, materialise_linear, on_cpu, one_function, summed, unit
from .base import Problem
from .matrices import vector
from .rows import Impulses, Index, Rows, add_rows, take, take_tree


@struct
class Sym3:
    """A symmetric matrix in the contact frame; an entry that is None is zero."""

    zz: jax.Array
    xx: jax.Array | None = None
    yy: jax.Array | None = None
    xy: jax.Array | None = None
    xz: jax.Array | None = None
    yz: jax.Array | None = None

    def __matmul__(self, u: Impulses) -> Impulses:
        n = _add(self.zz * u.n, _mul(self.xz, u.t1), _mul(self.yz, u.t2))
        if u.t1 is None:
            return Impulses(n)
        return Impulses(
            n,
            _add(self.xx * u.t1, _mul(self.xy, u.t2), _mul(self.xz, u.n)),
            _add(self.yy * u.t2, _mul(self.xy, u.t1), _mul(self.yz, u.n)),
        )


@struct
class Sym6:
    """A symmetric matrix over the rows of force (n, t1, t2) and of torque (s, r1, r2) in the contact frame.

    force: force to velocity. cross: row i, column j = force along axis i to spin about axis j, nested tuples with
    structural zeros. torque: torque to spin. Axes x, y, z are t1, t2, n.
    """

    force: Sym3
    cross: tuple
    torque: Sym3

    def __matmul__(self, u: Impulses) -> Impulses:
        velocity, spin = (u.t1, u.t2, u.n), (u.r1, u.r2, u.s)
        f = self.force @ Impulses(u.n, u.t1, u.t2)
        t = self.torque @ Impulses(u.s, u.r1, u.r2)
        f = [_add(x, *map(_mul, row, spin)) for x, row in zip((f.t1, f.t2, f.n), self.cross)]
        t = [None if x is None else _add(x, *map(_mul, column, velocity))
             for x, column in zip((t.t1, t.t2, t.n), zip(*self.cross))]  # fmt: skip
        return Impulses(f[2], f[0], f[1], t[2], t[0], t[1])


@struct
class Lagging:
    """G of rows whose friction follows their normal impulse: ``symmetric``, and in the column of the normal velocity
    the     entries ``column`` of the friction rows (its n is not used). Its Newton systems are not symmetric.
    """

    symmetric: Sym3 | Sym6
    column: Impulses

    def __matmul__(self, u: Impulses) -> Impulses:
        p, k = self.symmetric @ u, self.column
        return p._with(
            **{name: getattr(p, name) + getattr(k, name) * u.n for name in FRICTION if getattr(k, name) is not None}
        )


#: Friction rows of ``Impulses``.
FRICTION = ("t1", "t2", "s", "r1", "r2")


@struct
class Contacts:
    """A group of rows in the contact frames of its pairs.

    n, t1, t2: the frame in world axes, (P, B). ra, rb: arms in the frame, (S, P, B), None without
    attitude. a, b: as in ``Rows``. friction, torsion, rolling: which rows there are beside the normal one.
    shapes: (S, P) of the groups of which this one is joined (``joined``), whose points are those of the groups one
    after the other, (1, K, B); anchored: some of its bodies A are number n, which does not move.
    """

    n: Vec3
    t1: Vec3 | None
    t2: Vec3 | None
    live: jax.Array
    b: Index | jax.Array
    a: Index | jax.Array | None = None
    rb: Vec3 | None = None
    ra: Vec3 | None = None
    friction: bool = static(default=True)
    torsion: bool = static(default=False)
    rolling: bool = static(default=False)
    shapes: tuple = static(default=())
    anchored: bool = static(default=False)
    jacobian: dict | None = None

    @property
    def point_shapes(self) -> tuple:
        """(S, P) of the groups of pairs that have equally many points each."""
        return self.shapes or (self.live.shape[:2],)

    def to_points(self, tree):
        """Of arrays (P, B) of the pairs those of the points: arrays that broadcast to (S, P, B)."""
        if not self.shapes:
            return tree
        return jax.tree.map(lambda x: take(x, pair_of_point(self.shapes))[None], tree)

    def by_point(self, x) -> list:
        """Of an array (m, K, B) of all points, group after group, the lists of those (m, P, B) of its slots."""
        cut, starts = jax.lax.slice_in_dim, np.cumsum([0, *(s * p for s, p in self.point_shapes)])
        slots = lambda at, s, p: [cut(x, at + k * p, at + (k + 1) * p, axis=1) for k in range(s)]
        return [slots(int(at), s, p) for at, (s, p) in zip(starts, self.point_shapes)]

    def over_points(self, entries: list, one) -> list:
        """The sums over the points of every pair, (P, B), of arrays (S, P, B); None for None. Linear, for JAX too."""
        if not self.shapes:
            return [_slots(x) for x in entries]
        starts = np.cumsum([0, *(s * p for s, p in self.shapes)])
        part = lambda x, at, s, p: jax.lax.slice_in_dim(x[0], at, at + s * p).reshape(s, p, -1)
        of_group = lambda x: [summed(part(x, int(at), s, p)) for at, (s, p) in zip(starts, self.shapes)]
        sums = [jnp.concatenate(of_group(x)) for x in entries if x is not None]
        sums = iter(materialise_linear(sums, self.n.x, one))
        return [None if x is None else next(sums) for x in entries]

    def turn(self, v: Vec3) -> Vec3:
        """World components -> contact frame; the tangential ones are None where nothing uses them."""
        if self.t1 is None:
            return Vec3(None, None, self.n.dot(v))
        return Vec3(self.t1.dot(v), self.t2.dot(v), self.n.dot(v))

    @property
    def basis(self) -> Mat3:
        """Rows are world axes, columns the contact frame."""
        n, a, b = self.n, self.t1, self.t2
        return Mat3(Vec3(a.x, b.x, n.x), Vec3(a.y, b.y, n.y), Vec3(a.z, b.z, n.z))


@functools.lru_cache(maxsize=256)
def pair_of_point(shapes: tuple) -> Index:
    """The pair of every point of a joined group."""
    pairs = np.cumsum([0, *(p for _, p in shapes)])
    return Index(np.concatenate([at + np.tile(np.arange(p), s) for at, (s, p) in zip(pairs, shapes)]))


def contacts(rows: Rows, problem: Problem) -> Contacts:
    """Put one group into contact frames."""
    friction = rows.mu is not None
    central = rows.central_b and (rows.a is None or rows.central_a)
    spin = problem.w is not None and (friction or not central)
    t1 = t2 = ra = rb = None
    if friction or spin:
        t1, t2 = materialise(rows.tangents, problem.one)
    if spin:
        arm = lambda r: materialise(Vec3(t1.dot(r), t2.dot(r), rows.n.dot(r)), problem.one)
        rb = arm(rows.rb)
        ra = None if rows.a is None else arm(rows.ra)
    torsion, rolling = rows.mu_spin is not None, rows.mu_roll is not None
    return Contacts(rows.n, t1, t2, rows.live, rows.b, rows.a, rb, ra, friction, torsion, rolling)


# --- row vectors ---------------------------------------------------------------------------------


def row_dot(p: Impulses, u: Impulses) -> jax.Array:
    return _add(p.n * u.n, _mul(p.t1, u.t1), _mul(p.t2, u.t2), _mul(p.s, u.s), _mul(p.r1, u.r1), _mul(p.r2, u.r2))


def ends(c: Contacts, v: Vec3, w: Vec3 | None) -> list:
    """(v, w) of body B of every pair, and of body A where there is one, (P, B)."""
    one = lambda i, v, w: (take_tree(v, i), None if w is None else take_tree(w, i))
    if c.a is None:
        return [one(c.b, v, w)]
    rest = lambda x: jnp.pad(x, ((0, 1), (0, 0))) if c.anchored else x
    return [one(c.b, v, w), one(c.a, *jax.tree.map(rest, (v, w)))]


def at_points(c: Contacts, v: Vec3, w: Vec3 | None) -> Impulses:
    """Relative velocity J (v, w) of every slot; v, w are body velocities (n, B)."""
    return between(c, ends(c, v, w))


def between(c: Contacts, bodies) -> Impulses:
    """Relative velocity of every slot, of the velocities of ``ends``."""

    def side(body, r):
        u = c.to_points(c.turn(body[0]))
        if r is None:
            return u
        s = c.to_points(c.turn(body[1]))
        z = u.z + (s.x * r.y - s.y * r.x)
        if not c.friction:
            return Vec3(None, None, z)
        return Vec3(u.x + (s.y * r.z - s.z * r.y), u.y + (s.z * r.x - s.x * r.z), z)

    u = side(bodies[0], c.rb)
    if len(bodies) > 1:
        ua = side(bodies[1], c.ra)
        u = Vec3(*(None if p is None else p - q for p, q in zip((u.x, u.y, u.z), (ua.x, ua.y, ua.z))))
    full = lambda x: jnp.broadcast_to(x, jnp.broadcast_shapes(x.shape, c.live.shape))
    if not c.friction:
        return Impulses(full(u.z))
    angular = c.to_points(_angular(c, _relative_spin(c, bodies)))
    return Impulses(full(u.z), full(u.x), full(u.y), *map(full, angular))


def _relative_spin(c: Contacts, bodies) -> Vec3 | None:
    """wB - wA of every pair, (P, B) world axes; None where no row needs it."""
    if not c.torsion:
        return None
    return bodies[0][1] if len(bodies) == 1 else bodies[0][1] - bodies[1][1]


def _angular(c: Contacts, spin: Vec3 | None) -> tuple:
    """The angular entries (s, r1, r2) of ``Impulses`` that the group has, of an angular velocity of its pairs."""
    if not c.torsion:
        return ()
    spin = c.turn(spin)
    return (spin.z, spin.x, spin.y) if c.rolling else (spin.z,)


def relative(c: Contacts, rows: Rows, v: Vec3, w: Vec3 | None) -> Impulses:
    """Velocity of the points relative to the partner, which may move as prescribed."""
    u = at_points(c, v, w)
    if rows.surface is None:
        return u
    s = c.turn(rows.surface)
    s = Impulses(s.z, s.x, s.y, *_angular(c, rows.surface_spin)) if c.friction else Impulses(s.z)
    return jax.tree.map(jnp.subtract, u, s)


def on_bodies(cs, ps, problem: Problem) -> tuple[Vec3, Vec3 | None]:
    """Total impulse and angular impulse J' p on every body, (n, B), from slot impulses of all groups."""
    n = problem.v.x.shape[0]
    anchored = any(c.anchored for c in cs)
    zero = jnp.zeros((n + anchored, cs[0].live.shape[-1]), problem.v.x.dtype)
    force = Vec3(zero, zero, zero)
    torque = None if problem.w is None else force
    for c, p in zip(cs, ps):
        world, turns = on_pair(c, p, problem.one)
        for index, turn, sign in zip((c.b, c.a), turns, (1.0, -1.0)):
            force = _scatter(force, index, world * sign)
            if turn is not None:
                torque = _scatter(torque, index, turn * sign)
    return jax.tree.map(lambda x: x[:n], (force, torque)) if anchored else (force, torque)


def on_pair(c: Contacts, p: Impulses, one) -> tuple[Vec3, list]:
    """Impulse on body B of every pair, and the angular impulses [on B, minus that on A] (None: no arm), (P, B)."""
    arms = (c.rb,) if c.a is None else (c.rb, c.ra)
    entries = [p.t1, p.t2, p.n] if c.friction else [None, None, p.n]
    for r in arms:
        if r is None:
            entries += [None] * 3
            continue
        x, y, z = r.y * p.n, -r.x * p.n, None
        if c.friction:
            x, y, z = x - r.z * p.t2, y + r.z * p.t1, r.x * p.t2 - r.y * p.t1
        entries += [_add(x, p.r1), _add(y, p.r2), _add(z, p.s)]
    t1, t2, n, *turns = c.over_points(entries, one)
    world = c.n * n
    if c.friction:
        world = world + c.t1 * t1 + c.t2 * t2

    def turn(x, y, z):
        total = c.t1 * x + c.t2 * y
        return total if z is None else total + c.n * z

    turns = [turns[i : i + 3] for i in range(0, len(turns), 3)]
    return world, [None if x is None else turn(x, y, z) for x, y, z in turns]


def response(problem: Problem, impulse: Vec3, turn: Vec3 | None) -> tuple[Vec3, Vec3 | None]:
    """Velocity changes M^-1 (impulse, angular impulse) of every body."""
    return impulse * problem.inv_mass, None if turn is None else problem.inv_inertia @ turn


def inverse_mass(c: Contacts, problem: Problem) -> jax.Array:
    """n' (J M^-1 J') n of every slot [1/kg], (S, P, B)."""

    def side(index, r):
        k = take(problem.inv_mass, index)
        if r is None:
            return k
        inv = take_tree(problem.inv_inertia, index)
        if inv.yy is None:
            return k + inv.xx * (r.x * r.x + r.y * r.y)
        j1, j2 = inv @ c.t1, inv @ c.t2
        # r x n = t1 r.y - t2 r.x
        return k + c.t1.dot(j1) * (r.y * r.y) + c.t2.dot(j2) * (r.x * r.x) - 2.0 * c.t1.dot(j2) * (r.x * r.y)

    k = side(c.b, c.rb)
    if c.a is not None:
        k = k + side(c.a, c.ra)
    return jnp.broadcast_to(k, jnp.broadcast_shapes(k.shape, c.live.shape))


# --- Newton systems ------------------------------------------------------------------------------


def is_coupled(cs) -> bool:
    return any(c.a is not None for c in cs)


def world_inertia(problem: Problem) -> list:
    """Lower triangle of R I R' of every body, (n, B or 1); None = structural zero."""
    m = problem.inertia.moments
    if problem.inertia.isotropic:
        return [[m], [None, m], [None, None, m]]
    r = problem.q.mat()
    a, b, c = r.a, r.b, r.c
    p, q, s = a * m, b * m, c * m
    return [[p.dot(a)], [q.dot(a), q.dot(b)], [s.dot(a), s.dot(b), s.dot(c)]]


def newton_step(cs, gs, residuals, problem: Problem) -> tuple[Vec3, Vec3 | None]:
    """d = (M + J' G J)^-1 J' residual, as velocity changes of every body; linear in the residuals."""
    rhs = on_bodies(cs, residuals, problem)
    if is_coupled(cs):
        return _coupled(cs, gs, rhs, problem)
    return _uncoupled(cs, gs, rhs, problem)


def _uncoupled(cs, gs, rhs, problem: Problem):
    """One 3x3 or 6x6 system a body."""
    one = problem.one
    zero = jnp.zeros_like(rhs[0].x)
    spin = any(c.rb is not None for c in cs)
    size = 6 if spin else 3
    own = _own_block(problem, zero + 1.0 / problem.inv_mass, spin)
    h = [[None if x is None else zero + x for x in row] for row in own]
    for c, g in zip(cs, gs):
        block = _own_pair_block(c, g, one, size)
        for i in range(size):
            for j in range(size):
                if block[i][j] is not None:
                    h[i][j] = add_rows(zero if h[i][j] is None else h[i][j], c.b, block[i][j])
    b = components(rhs[0]) + (components(rhs[1]) if spin else ())
    if any(isinstance(g, Lagging) for g in gs):
        x = _small_general_solve(tuple(tuple(r) for r in h), b, one)
    else:
        x = _small_solve(tuple(tuple(r[: i + 1]) for i, r in enumerate(h)), b, one)
    if spin:
        return Vec3(*x[:3]), Vec3(*x[3:])
    return Vec3(*x), rhs[1]  # no row turns a body: its zero torque is its zero spin


def _coupled(cs, gs, rhs, problem: Problem):
    """One dense system a world: (B, N, N), N = 6 n or, without attitude, 3 n."""
    n, worlds = rhs[0].x.shape
    spin = any(c.rb is not None for c in cs)
    size = 6 if spin else 3
    rows = n + any(c.anchored for c in cs)
    own = _own_blocks(problem, n, worlds, spin)
    h = jnp.zeros((rows * rows, worlds, size, size), rhs[0].x.dtype)
    h = add_rows(h, Index(np.arange(n) * (rows + 1)), own, unique=True)
    for c, g in zip(cs, gs):
        for p, q, block in _pair_blocks(c, g, problem.one, size):
            fixed = isinstance(p, Index)
            h = add_rows(h, Index(p.rows * rows + q.rows) if fixed else p * rows + q, block)
    h = h.reshape(rows, rows, worlds, size, size)[:n, :n]
    h = jnp.transpose(h, (2, 0, 3, 1, 4)).reshape(worlds, n * size, n * size)
    b = vector(components(rhs[0]) + (components(rhs[1]) if spin else ()))  # (n, size, B)
    solve = _dense_general_solve if any(isinstance(g, Lagging) for g in gs) else _dense_solve
    x = solve(h, jnp.transpose(b, (2, 0, 1)).reshape(worlds, n * size))
    x = jnp.transpose(x.reshape(worlds, n, size), (2, 1, 0))
    if spin:
        return Vec3(*x[:3]), Vec3(*x[3:])
    return Vec3(*x), rhs[1]


def _own_block(problem: Problem, mass, spin: bool) -> list:
    """Rows of M of every body, entries (n, B or 1); None = structural zero."""
    own = [[None] * (6 if spin else 3) for _ in range(6 if spin else 3)]
    for i in range(3):
        own[i][i] = mass
    if spin:
        inertia = world_inertia(problem)
        for i in range(3):
            for j in range(i + 1):
                own[3 + i][3 + j] = own[3 + j][3 + i] = inertia[i][j]
    return own


def _own_blocks(problem: Problem, n: int, worlds: int, spin: bool):
    """M of every body, (n, B, size, size)."""
    diagonal = lambda x: jnp.broadcast_to(x, (n, worlds))[..., None, None] * np.eye(3, dtype=x.dtype)
    mass = diagonal(1.0 / problem.inv_mass)
    if not spin:
        return mass
    low = world_inertia(problem)
    if problem.inertia.isotropic:
        inertia = diagonal(low[0][0])
    else:
        entries = [low[max(i, j)][min(i, j)] for i in range(3) for j in range(3)]
        inertia = jnp.moveaxis(vector([jnp.broadcast_to(x, (n, worlds)) for x in entries]), 1, 2)
        inertia = inertia.reshape(n, worlds, 3, 3)
    pad = lambda m, low, high: jnp.pad(m, ((0, 0), (0, 0), (low, high), (low, high)))
    return pad(mass, 0, 3) + pad(inertia, 3, 0)


def _pair_blocks(c: Contacts, g: Sym3 | Sym6 | Lagging, one, size: int):
    """(body row, body column, block) of every block of J' G J of one group; blocks (P, B, size rows, size columns).

    Columns of a row are an array, which is several times fewer operations than entry by entry: they are what a program
    takes its time to compile for. Sums over points are written out: XLA's own, and its products of small matrices, take
    four to eight times as long.
    """
    rows, entries = c.jacobian, _entries(g)
    flat = lambda x: jnp.broadcast_to(x, c.live.shape).reshape(-1, c.live.shape[-1])
    turned = {i: _add(*(flat(entries[i, k]) * rows[k] for k in rows if (i, k) in entries)) for i in rows}
    turned = materialise(turned, one)
    outer = lambda x, y: x[:, None] * y[None]
    # columns (spin of A,) velocity(, spin of B): those of A in the order of the others
    of_a = (lambda x, *axes: jnp.roll(x, 3, axes)) if size == 6 else lambda x, *axes: x
    start = 0
    for group in zip(*(zip(c.by_point(rows[name]), c.by_point(turned[name])) for name in rows)):
        h = materialise(_add(*(outer(x, y) for points in group for x, y in zip(*points))), one)
        h = jnp.transpose(h, (2, 3, 0, 1))
        a, b = (i if i is None else _cut(i, start, start + len(h)) for i in (c.a, c.b))
        yield b, b, h[:, :, -size:, -size:]
        if a is not None:
            yield a, a, of_a(h[:, :, :size, :size], 2, 3)
            yield a, b, -of_a(h[:, :, :size, -size:], 2)
            yield b, a, -of_a(h[:, :, -size:, :size], 3)
        start += len(h)


def _cut(index, start: int, stop: int):
    return Index(index.rows[start:stop]) if isinstance(index, Index) else index[start:stop]


def jacobian(c: Contacts, size: int, one) -> dict:
    """The rows of J of all points by name, (columns, K, B): derivatives of a relative velocity by the velocity and the
    spin of body B, and before them, with the opposite sign, by the spin of A.
    """
    worlds = c.live.shape[-1]
    of_point = pair_of_point(c.point_shapes).rows
    axis = lambda v: None if v is None else jnp.stack(jnp.broadcast_arrays(*components(v)))[:, of_point]
    t1, t2, n = (axis(v) for v in (c.t1, c.t2, c.n))
    axes = {"n": n} if t1 is None else {"t1": t1, "t2": t2, "n": n}
    full = lambda x: jnp.broadcast_to(x, (3, len(of_point), worlds))
    none = jnp.zeros((3, len(of_point), worlds), c.n.x.dtype)

    def turns(r: Vec3 | None) -> dict:
        """r x axis of every axis."""
        if r is None:
            return {}
        x, y, z = (jnp.broadcast_to(q, c.live.shape).reshape(-1, worlds) for q in components(r))
        about_n = {"n": full(t1 * y - t2 * x)}
        return {"t1": full(t2 * z - n * y), "t2": full(n * x - t1 * z)} | about_n if c.friction else about_n

    arms = [] if size == 3 else [turns(c.rb)] if c.a is None else [turns(c.ra), turns(c.rb)]
    row = lambda velocity, spins: jnp.concatenate([*spins[:-1], velocity, *spins[-1:]])
    linear = ("t1", "t2", "n") if c.friction else ("n",)
    rows = {name: row(full(axes[name]), [arm.get(name, none) for arm in arms]) for name in linear}
    if c.torsion:
        angular = {"s": "n"} | ({"r1": "t1", "r2": "t2"} if c.rolling else {})
        rows |= {name: row(none, [full(axes[axis])] * len(arms)) for name, axis in angular.items()}
    return materialise(rows, one)


def _entries(g: Sym3 | Sym6 | Lagging) -> dict:
    """The entries of G by the names of row and column; what is missing is zero."""
    force, cross, torque, column = _split(g)
    linear, angular = ("t1", "t2", "n"), ("r1", "r2", "s")
    entries = {}
    for i in range(3):
        for j in range(3):
            entries[linear[i], linear[j]] = force[i][j]
            entries[angular[i], angular[j]] = torque[i][j]
            entries[linear[i], angular[j]] = entries[angular[j], linear[i]] = cross[i][j]
    if column is not None:
        for name in FRICTION:
            entries[name, "n"] = _add(entries[name, "n"], getattr(column, name))
    return {names: x for names, x in entries.items() if x is not None}


def _own_pair_block(c: Contacts, g: Sym3 | Sym6 | Lagging, one, size: int) -> list:
    """The block of body B of every pair, rows of entries (P, B)."""
    block = [[None] * size for _ in range(size)]

    def put(row: int, column: int, m):
        m = _rotate(c, materialise(m, one), one)
        for i in range(3):
            block[row + i][column : column + 3] = m[i]
        return m

    put(0, 0, _force_velocity(g))
    if c.rb is None:
        return block
    lower = put(3, 0, _torque_velocity(g, c.rb))
    put(3, 3, _torque_spin(g, c.rb, c.rb))
    if isinstance(g, Lagging):
        put(0, 3, _force_spin(g, c.rb))
        return block
    for i in range(3):
        block[i][3:] = [lower[j][i] for j in range(3)]
    return block


# --- sums over the points of a pair in its contact frame: rows of entries (P, B), None = zero ---


def _split(g: Sym3 | Sym6 | Lagging):
    """F, X and T of the symmetric part as rows of entries, and what is added to the column of the normal velocity:
    force (x, y) of the friction rows and their couples, None where there is none.
    """
    column = None
    if isinstance(g, Lagging):
        column, g = g.column, g.symmetric
    if isinstance(g, Sym6):
        return _full3(g.force), g.cross, _full3(g.torque), column
    return _full3(g), UNCOUPLED, UNCOUPLED, column


def _force_velocity(g):
    """sum F"""
    force, _, _, column = _split(g)
    force = [[_slots(x) for x in row] for row in force]
    if column is not None:
        for row, x in zip(force, (column.t1, column.t2)):
            row[2] = _add(row[2], _slots(x))
    return force


def _torque_velocity(g, r: Vec3):
    """sum [r]x F + X'"""
    force, cross, _, column = _split(g)
    torque = [_cross(r, [force[i][j] for i in range(3)]) for j in range(3)]  # columns of [r]x F
    m = [[_add(torque[j][i], cross[j][i]) for j in range(3)] for i in range(3)]
    if column is not None:
        for row, x in zip(m, _couple(column, r)):
            row[2] = _add(row[2], x)
    return [[_slots(x) for x in row] for row in m]


def _force_spin(g: Lagging, r: Vec3):
    """sum F [r]x' + X"""
    back = _torque_velocity(g.symmetric, r)
    m = [[back[j][i] for j in range(3)] for i in range(3)]
    for row, x in zip(m, (g.column.t1, g.column.t2)):
        for j, arm in enumerate((r.y, -r.x)):  # r x n
            row[j] = _add(row[j], _slots(x * arm))
    return m


def _torque_spin(g, left: Vec3, right: Vec3):
    """sum [left]x F [right]x' + [left]x X + X' [right]x' + T"""
    force, x, t, column = _split(g)
    torque = [_cross(left, [force[i][j] for i in range(3)]) for j in range(3)]
    # ([left]x F + X') [right]x' , then [left]x X + T
    w = [_cross(right, [_add(torque[j][i], x[j][i]) for j in range(3)]) for i in range(3)]
    arm = [_cross(left, [x[i][j] for i in range(3)]) for j in range(3)]
    m = [[_add(w[i][j], arm[j][i], t[i][j]) for j in range(3)] for i in range(3)]
    if column is not None:
        for row, c in zip(m, _couple(column, left)):
            for j, arm in enumerate((right.y, -right.x)):
                row[j] = _add(row[j], c * arm)
    return [[_slots(x) for x in row] for row in m]


def _couple(column: Impulses, r: Vec3):
    """Angular impulses (x, y, z) of friction impulses at r."""
    x, y = column.t1, column.t2
    return _add(-r.z * y, column.r1), _add(r.z * x, column.r2), _add(r.x * y - r.y * x, column.s)


def _slots(x):
    return None if x is None else summed(x)


UNCOUPLED = ((None,) * 3,) * 3


def full(g: Sym3 | Sym6):
    """The block F."""
    return _full3(g.force if isinstance(g, Sym6) else g)


def _full3(g: Sym3):
    """Rows of entries."""
    return [[g.xx, g.xy, g.xz], [g.xy, g.yy, g.yz], [g.xz, g.yz, g.zz]]


def _mul(a, b):
    return None if a is None or b is None else a * b


def _add(*terms):
    terms = [t for t in terms if t is not None]
    return sum(terms[1:], terms[0]) if terms else None


def _sub(a, b):
    if b is None:
        return a
    return -b if a is None else a - b


def _cross(r: Vec3, u):
    """r x u for a list u with structural zeros."""
    return [
        _sub(_mul(r.y, u[2]), _mul(r.z, u[1])),
        _sub(_mul(r.z, u[0]), _mul(r.x, u[2])),
        _sub(_mul(r.x, u[1]), _mul(r.y, u[0])),
    ]


def _rotate(c: Contacts, m, one):
    """Q m Q' with Q from the contact frame to world axes; rows of entries (P, B)."""
    if c.t1 is None:  # no tangents at all, and only m_zz
        n = components(c.n)
        return [[n[i] * n[j] * m[2][2] for j in range(3)] for i in range(3)]
    q = [components(row) for row in components_rows(c.basis)]
    half = [[_add(*(_mul(q[i][k], m[k][j]) for k in range(3))) for j in range(3)] for i in range(3)]
    half = materialise(half, one)
    return [[_add(*(_mul(half[i][k], q[j][k]) for k in range(3))) for j in range(3)] for i in range(3)]


def components_rows(m: Mat3) -> tuple[Vec3, Vec3, Vec3]:
    return m.a, m.b, m.c


def _scatter(total: Vec3, index, v: Vec3) -> Vec3:
    return Vec3(*(add_rows(x, index, y) for x, y in zip(components(total), components(v))))


# --- linear solves with cheap derivatives ----------------------------------------------------------


@jax.custom_jvp
def _dense_solve(h, b):
    """h^-1 b for symmetric positive definite h (B, N, N), b (B, N)."""
    return _substitute(jax.lax.linalg.cholesky(h, symmetrize_input=False), b)


@_dense_solve.defjvp
def _dense_solve_jvp(primals, tangents):
    (h, b), (dh, db) = primals, tangents
    factor = jax.lax.linalg.cholesky(h, symmetrize_input=False)
    x = _substitute(factor, b)
    return x, _substitute(factor, db - jnp.einsum("bij,bj->bi", dh, x))


@jax.custom_jvp
def _dense_general_solve(h, b):
    """h^-1 b for any h (B, N, N), b (B, N)."""
    lu, pivots, order = jax.lax.linalg.lu(h)
    if on_cpu():  # there JAX makes the order of the rows in a loop of N turns of eight kernels: half of the time
        order = one_function(_order)(pivots)
    solve = functools.partial(jax.lax.linalg.triangular_solve, lu, left_side=True)
    y = solve(jnp.take_along_axis(b, order, axis=1)[..., None], lower=True, unit_diagonal=True)
    return solve(y, lower=False)[..., 0]


def _order(pivots):
    """The order of the rows of (B, N) matrices of which row k was exchanged with row pivots[k], one after the other."""
    worlds, n = pivots.shape
    zero = jnp.int32(0)
    read = lambda x, *at: jax.lax.dynamic_slice(x, at, (1, 1))
    rows = jax.lax.broadcasted_iota(pivots.dtype, (1, n), 1)

    def of_world(world):
        def exchange(k, order):  # of one world, as XLA copies what it changes here
            other = read(pivots, world, k)[0, 0]
            mine, its = read(order, zero, k), read(order, zero, other)
            order = jax.lax.dynamic_update_slice(order, its, (zero, k))
            return jax.lax.dynamic_update_slice(order, mine, (zero, other))

        return repeat(0, n, exchange, rows)

    if worlds == 1:
        return of_world(zero)
    put = lambda world, orders: jax.lax.dynamic_update_slice(orders, of_world(world), (world, zero))
    return repeat(0, worlds, put, jnp.zeros_like(pivots))


@_dense_general_solve.defjvp
def _dense_general_solve_jvp(primals, tangents):
    (h, b), (dh, db) = primals, tangents
    x = _dense_general_solve(h, b)
    return x, _dense_general_solve(h, db - jnp.einsum("bij,bj->bi", dh, x))


def _substitute(factor, b):
    solve = jax.lax.linalg.triangular_solve
    y = solve(factor, b[..., None], left_side=True, lower=True)
    return solve(factor, y, left_side=True, lower=True, transpose_a=True)[..., 0]


@jax.custom_jvp
def _small_solve(h, b, one):
    """x = h^-1 b component by component: h a lower triangle as nested tuples, b a tuple of arrays."""
    return _small_substitute(_small_factor(h, one), b, one)


@_small_solve.defjvp
def _small_solve_jvp(primals, tangents):
    (h, b, one), (dh, db, _) = primals, tangents
    factor = _small_factor(h, one)
    x = _small_substitute(factor, b, one)
    n = len(b)
    at = lambda i, j: dh[i][j] if j <= i else dh[j][i]
    r = tuple(_sub(db[i], _add(*(_mul(at(i, j), x[j]) for j in range(n)))) for i in range(n))
    return x, _small_substitute(factor, r, one)


def _small_factor(h, one):
    """h = L D L', L unit lower triangular; every entry is computed once (see ``materialise``)."""
    n = len(h)
    low = [[None] * i for i in range(n)]
    d = []
    for j in range(n):
        scaled = [_mul(low[j][k], d[k]) for k in range(j)]
        d.append(materialise(_sub(h[j][j], _add(*(_mul(low[j][k], scaled[k]) for k in range(j)))), one))
        for i in range(j + 1, n):
            x = _sub(h[i][j], _add(*(_mul(low[i][k], scaled[k]) for k in range(j))))
            low[i][j] = None if x is None else x / d[j]
    return low, d


def _small_substitute(factor, b, one):
    """x = h^-1 b from the factor; linear in b also in the eyes of JAX, so the divisor that materialises the
    entries is made of the factor."""
    low, d = factor
    n = len(b)
    ones = None if one is None else jax.lax.stop_gradient(unit(d[0], one))
    keep = lambda x: x if ones is None else x / ones
    y = []
    for i in range(n):
        y.append(keep(_sub(b[i], _add(*(_mul(low[i][k], y[k]) for k in range(i))))))
    x = [None] * n
    for i in reversed(range(n)):
        x[i] = keep(_sub(y[i] / d[i], _add(*(_mul(low[k][i], x[k]) for k in range(i + 1, n)))))
    return tuple(x)


@jax.custom_jvp
def _small_general_solve(h, b, one):
    """x = h^-1 b component by component: h any matrix (its leading minors are not singular) as nested tuples."""
    n = len(b)
    h = [list(row) for row in h]
    for k in range(n):
        for i in range(k + 1, n):
            if h[i][k] is None:
                continue
            h[i][k] = materialise(h[i][k] / h[k][k], one)  # L below the diagonal, U on and above it
            for j in range(k + 1, n):
                less = _mul(h[i][k], h[k][j])
                h[i][j] = h[i][j] if less is None else materialise(_sub(h[i][j], less), one)
    ones = None if one is None else jax.lax.stop_gradient(unit(h[0][0], one))
    keep = lambda x: x if ones is None else x / ones
    y = []
    for i in range(n):
        y.append(keep(_sub(b[i], _add(*(_mul(h[i][k], y[k]) for k in range(i))))))
    x = [None] * n
    for i in reversed(range(n)):
        x[i] = keep(_sub(y[i], _add(*(_mul(h[i][k], x[k]) for k in range(i + 1, n)))) / h[i][i])
    return tuple(x)


@_small_general_solve.defjvp
def _small_general_solve_jvp(primals, tangents):
    (h, b, one), (dh, db, _) = primals, tangents
    x = _small_general_solve(h, b, one)
    r = tuple(_sub(db[i], _add(*map(_mul, dh[i], x))) for i in range(len(b)))
    return x, _small_general_solve(h, r, one)
