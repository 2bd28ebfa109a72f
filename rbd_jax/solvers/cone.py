"""Layer 5: Newton's method for convex contact with the true (second-order) friction cone.

Minimises (v - v*)' M (v - v*) / 2 + sum_c s(x_c), x = J v - reference, where s is the squared distance to the
cone in the metric of the compliances. With D = 1 / r, mu' = mu sqrt(r_t / r_n), N = mu' x_n, T = mu |x_t|:

    N >= mu' T        0                                                   separating
    mu' N + T <= 0    -D_n x_n, -D_t x_t                                  sticking
    else              p_n = D_n (mu' T - N) / (mu' (1 + mu'^2)), p_t = -mu p_n x_t / |x_t|    sliding

With torsional and rolling friction T = |(mu_i x_i)| over all friction rows i (two of sliding, one about the normal, two
about the tangents; mu_i in [m] for the last three), D_i = D_t (mu_i / mu)^2, and p_i = -mu_i^2 p_n x_i / T.

Source: Todorov 2014 (MuJoCo documentation, "Computation: solver"); Castro et al. 2022 (SAP), the same cone.
Differs: fixed iteration counts; the last iteration is a full Newton step. Where no two bodies touch, every body
has its own step length.

Cost: ``iterations`` linear systems as in ``newton``, and ``iterations x search`` evaluations of the law.
Gradients: implicit, of the converged problem: exact where a world is not ``unconverged``; first and second
order, forward and reverse.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from .. import implicit
from ..spatial import Vec3
from ..struct import struct
from ..xla import materialise
from . import dense
from .base import Problem, Solution, Solver
from .dense import Contacts, Sym3, Sym6
from .joined import join
from .rows import Impulses, Rows, add_rows, take

#: Bound of the line search [Newton steps].
LONGEST = 4.0


@dataclasses.dataclass(frozen=True)
class ConeNewton(Solver):
    """The solver of cone problems; a subclass says what x and the stiffness are (``law``, ``free``).

    Attributes:
      iterations: Newton steps, the last without line search, at least 2. search: line search steps of each.
      A world is ``unconverged`` where impulses differ from the law at the solution by more than
      sqrt(machine epsilon) of the largest impulse.
    """

    iterations: int = 20
    search: int = 8

    spins = True
    elliptic = True

    def __post_init__(self):
        if self.iterations < 2 or self.search < 1:
            name = type(self).__name__
            raise ValueError(f"{name}({self.iterations}, {self.search}): needs 2 iterations and 1 search step")

    def law(self, c: Contacts, rows: Rows, problem: Problem, load) -> ConeLaw:
        """Stiffness, friction and reference of one group."""
        raise NotImplementedError

    def free(self, c: Contacts, rows: Rows, law: ConeLaw, problem: Problem) -> Impulses:
        """x of one group without contact impulses."""
        raise NotImplementedError

    def solve(self, problem: Problem) -> Solution:
        cs = tuple(dense.contacts(rows, problem) for rows in problem.rows)
        laws = tuple(self.law(c, rows, problem, load) for c, rows, load in zip(cs, problem.rows, problem.loads))
        free = tuple(self.free(c, rows, law, problem) for c, rows, law in zip(cs, problem.rows, laws))
        start = tuple(_masked(c, warm) for c, warm in zip(cs, problem.warm))
        cs, trees, joint = join(cs, tuple(zip(laws, free, start)), problem.v.x.shape[0], problem.one)
        laws, free, start = zip(*trees)
        system = _System(cs, laws, free, problem.without_rows())

        solution = implicit.root(
            lambda args: self._search_minimum(*args),
            lambda p, args: _residual(args[0], p),
            lambda p, args, r: _correction(args[0], p, r),
        )
        p = materialise(solution((system, start)), problem.one)
        impulse, turn = dense.on_bodies(cs, p, problem)
        unconverged = _unconverged(system, p)
        return Solution(impulse=impulse, angular_impulse=turn, contacts=joint.split(p), unconverged=unconverged)

    def _search_minimum(self, system: _System, start):
        """Newton's method with an exact line search; returns the impulses."""
        cs, laws, problem = system.cs, system.laws, system.problem
        one = problem.one
        lines = _Lines(cs, problem)

        def newton(p, _):
            p = materialise(p, one)
            # from p itself: what a step rounds away is in the next residual
            x = materialise(system.velocities(p), one)
            linear = materialise(tuple(cone(law, y) for law, y in zip(laws, x)), one)
            residual = minus(tuple(f for f, _ in linear), p)
            d = materialise(dense.newton_step(cs, tuple(g for _, g in linear), residual, problem), one)
            dx = materialise(tuple(dense.at_points(c, *d) for c in cs), one)
            slope, bend = lines.total(p, dx), lines.mass(d)

            def search(_, bracket):
                t, low, high = bracket
                linear = tuple(cone(law, _along(y, lines.at(t, c), dy)) for c, law, y, dy in zip(cs, laws, x, dx))
                f = slope + t * bend - lines.total(tuple(f for f, _ in linear), dx)
                df = bend + lines.total(tuple(g @ dy for (_, g), dy in zip(linear, dx)), dx)
                low, high = jnp.where(f < 0, t, low), jnp.where(f >= 0, t, high)
                new = t - f / jnp.where(df > 0, df, 1.0)
                return jnp.where((new > low) & (new < high), new, 0.5 * (low + high)), low, high

            zero = jnp.zeros_like(slope)
            t, _, _ = jax.lax.fori_loop(0, self.search, search, (zero + 1.0, zero, zero + LONGEST))
            target = tuple(minus(f, g @ dy) for (f, g), dy in zip(linear, dx))
            p = tuple(_along(q, lines.at(t, c), minus(new, q)) for c, q, new in zip(cs, p, target))
            return p, None

        return jax.lax.scan(newton, start, length=self.iterations - 1)[0]


@struct
class ConeLaw:
    """Normal and friction stiffness dn, dt = 1/R (zero where no contact acts), mu, mu', reference;
    stiffness and coefficients of the rows of torsion (ds, mu_spin) and rolling (dr, mu_roll)."""

    dn: jax.Array
    reference: Impulses
    dt: jax.Array | None = None
    mu: jax.Array | None = None
    mu_reg: jax.Array | None = None
    ds: jax.Array | None = None
    mu_spin: jax.Array | None = None
    dr: jax.Array | None = None
    mu_roll: jax.Array | None = None


@struct
class _System:
    """Everything the rows of a problem depend on besides the impulses; ``problem`` is without its rows."""

    cs: tuple[Contacts, ...]
    laws: tuple[ConeLaw, ...]
    free: tuple[Impulses, ...]
    problem: Problem

    def velocities(self, p) -> tuple[Impulses, ...]:
        """x of every row when the impulses p act."""
        d = dense.response(self.problem, *dense.on_bodies(self.cs, p, self.problem))
        return tuple(_plus(y, dense.at_points(c, *d)) for c, y in zip(self.cs, self.free))


def _residual(system: _System, p):
    """Impulses of the law minus p, zero at the solution."""
    x = materialise(system.velocities(p), system.problem.one)
    return tuple(minus(cone(law, y)[0], q) for law, y, q in zip(system.laws, x, p))


def _correction(system: _System, p, residual):
    """The Newton step from p, linear in the residual."""
    cs, one = system.cs, system.problem.one
    x = materialise(system.velocities(p), one)
    gs = materialise(tuple(cone(law, y)[1] for law, y in zip(system.laws, x)), one)
    d = dense.newton_step(cs, gs, residual, system.problem)
    return tuple(minus(r, g @ dense.at_points(c, *d)) for c, g, r in zip(cs, gs, residual))


def cone(law: ConeLaw, x: Impulses) -> tuple[Impulses, Sym3 | Sym6]:
    """Impulse of every point and G = -d impulse / dx."""
    if law.dt is None:
        g = jnp.where(x.n < 0, law.dn, 0.0)
        return Impulses(-g * x.n), Sym3(g)
    if law.ds is not None:
        return _full_cone(law, x)
    mu, reg = law.mu, law.mu_reg
    s = x.t1 * x.t1 + x.t2 * x.t2
    moves = (s > 0) & (mu > 0)
    t = jnp.sqrt(jnp.where(moves, s, 1.0))
    e1, e2 = jnp.where(moves, x.t1 / t, 0.0), jnp.where(moves, x.t2 / t, 0.0)
    slip = jnp.where(moves, mu * t, 0.0)
    normal = reg * x.n
    separates = jnp.where(mu > 0, normal >= reg * slip, x.n >= 0)
    sticks = ~separates & (reg * normal + slip <= 0)
    slides = ~separates & ~sticks
    # sliding: f_n = c (mu' T - N), c = D / (mu' (1 + mu'^2))
    c = jnp.where(slides, law.dn, 0.0) / (jnp.where(mu > 0, reg, 1.0) * (1.0 + reg * reg))
    fn = c * (reg * slip - normal)
    kn, kt = jnp.where(sticks, law.dn, 0.0), jnp.where(sticks, law.dt, 0.0)
    force = Impulses(fn - kn * x.n, -mu * fn * e1 - kt * x.t1, -mu * fn * e2 - kt * x.t2)
    c = c * reg
    radial = c * mu * mu
    around = mu * fn / t
    g = Sym3(
        kn + c,
        xx=kt + radial * e1 * e1 + around * e2 * e2,
        yy=kt + radial * e2 * e2 + around * e1 * e1,
        xy=(radial - around) * e1 * e2,
        xz=-c * mu * e1,
        yz=-c * mu * e2,
    )
    return force, g


def _full_cone(law: ConeLaw, x: Impulses) -> tuple[Impulses, Sym6]:
    """``_cone`` with the rows of torsion and, where there are any, of rolling."""
    reg = law.mu_reg
    # axes of the friction rows: velocity, coefficient, stiffness; sliding along x and y, then turning about them
    rows = {"x": (x.t1, law.mu, law.dt), "y": (x.t2, law.mu, law.dt), "s": (x.s, law.mu_spin, law.ds)}
    if law.dr is not None:
        rows |= {"p": (x.r1, law.mu_roll, law.dr), "q": (x.r2, law.mu_roll, law.dr)}
    scaled = {k: mu * u for k, (u, mu, _) in rows.items()}
    s = sum(u * u for u in scaled.values())
    moves = s > 0
    t = jnp.sqrt(jnp.where(moves, s, 1.0))
    e = {k: jnp.where(moves, u / t, 0.0) for k, u in scaled.items()}
    slip = jnp.where(moves, t, 0.0)
    normal = reg * x.n
    separates = jnp.where(law.mu > 0, normal >= reg * slip, x.n >= 0)
    sticks = ~separates & (reg * normal + slip <= 0)
    slides = ~separates & ~sticks
    c = jnp.where(slides, law.dn, 0.0) / (jnp.where(law.mu > 0, reg, 1.0) * (1.0 + reg * reg))
    fn = c * (reg * slip - normal)
    kn = jnp.where(sticks, law.dn, 0.0)
    k = {i: jnp.where(sticks, d, 0.0) for i, (_, _, d) in rows.items()}
    f = {i: -mu * fn * e[i] - k[i] * u for i, (u, mu, _) in rows.items()}
    c = c * reg
    around = jnp.where(moves, fn / t, 0.0)

    def own(i):
        mu = rows[i][1]
        return k[i] + mu * mu * (c * e[i] * e[i] + around * (1.0 - e[i] * e[i]))

    def between(i, j):
        return rows[i][1] * rows[j][1] * (c - around) * e[i] * e[j]

    with_normal = {i: -c * mu * e[i] for i, (_, mu, _) in rows.items()}
    linear = Sym3(kn + c, xx=own("x"), yy=own("y"), xy=between("x", "y"), xz=with_normal["x"], yz=with_normal["y"])
    if law.dr is None:
        cross = tuple((None, None, z) for z in (between("x", "s"), between("y", "s"), with_normal["s"]))
        return Impulses(fn - kn * x.n, f["x"], f["y"], f["s"]), Sym6(linear, cross, Sym3(own("s")))
    cross = (
        *(tuple(between(i, j) for j in "pqs") for i in "xy"),
        tuple(with_normal[j] for j in "pqs"),
    )
    angular = Sym3(own("s"), xx=own("p"), yy=own("q"), xy=between("p", "q"), xz=between("p", "s"), yz=between("q", "s"))
    return Impulses(fn - kn * x.n, *(f[i] for i in "xyspq")), Sym6(linear, cross, angular)


class _Lines:
    """Sums over what one step length governs: a body where no two bodies touch, else a world."""

    def __init__(self, cs, problem: Problem):
        self.cs, self.problem, self.coupled = cs, problem, dense.is_coupled(cs)

    def total(self, p, x):
        """sum p . x over rows: (n, B) or (1, B)."""
        total = jnp.zeros((self.problem.v.x.shape[0], self.cs[0].live.shape[-1]), self.problem.v.x.dtype)
        if self.coupled:
            total = total[:1]
        for c, q, y in zip(self.cs, p, x):
            s = dense.row_dot(q, y).sum(0)
            total = total + s.sum(0, keepdims=True) if self.coupled else add_rows(total, c.b, s)
        return total

    def mass(self, d: tuple[Vec3, Vec3 | None]):
        """d' M d."""
        v, w = d
        s = v.dot(v) / self.problem.inv_mass
        if w is not None:
            s = s + w.dot(self.problem.inertia.momentum(self.problem.q, w))
        return s.sum(0, keepdims=True) if self.coupled else s

    def at(self, t, c: Contacts):
        return t if self.coupled else take(t, c.b)


def _masked(c: Contacts, p: Impulses) -> Impulses:
    return jax.tree.map(lambda q: jnp.where(c.live, q, 0.0), p if c.friction else Impulses(p.n))


def _along(x: Impulses, t, d: Impulses) -> Impulses:
    return jax.tree.map(lambda a, b: a + t * b, x, d)


def minus(a, b):
    return jax.tree.map(lambda x, y: x - y, a, b)


def _plus(a, b):
    return jax.tree.map(lambda x, y: x + y, a, b)


def _unconverged(system: _System, ps) -> jax.Array:
    worst = largest = 0.0
    for c, law, p, x in zip(system.cs, system.laws, ps, system.velocities(ps)):
        force, _ = cone(law, x)
        for q, f in zip(jax.tree.leaves(p), jax.tree.leaves(force)):
            worst = jnp.maximum(worst, jnp.where(c.live, jnp.abs(q - f), 0.0).max(axis=(0, 1)))
            largest = jnp.maximum(largest, jnp.where(c.live, jnp.abs(f), 0.0).max(axis=(0, 1)))
    return worst > jnp.sqrt(jnp.finfo(ps[0].n.dtype).eps) * largest + jnp.finfo(ps[0].n.dtype).tiny
