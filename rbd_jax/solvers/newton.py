"""Layer 5: near-rigid contact with lagged friction, a few Newton steps of a convex problem.

The end-of-step velocities minimise (v - v*)' M (v - v*) / 2 + sum_c l_c(J_c v), whose contact impulses are

    normal    p_n = max((vhat - u_n) / R, 0)                R, vhat of the contact model
    friction  p_t = -mu g0 u_t / D,  D = sqrt(|u_t|^2 + eps^2),  eps = max(v_s, mu sigma w g0)
    couples   p_s = -nu g0 s / D_s,  D_s = sqrt(s^2 + (mu eps / nu)^2), s spin about n (torsion) or across it (rolling)

Symbols: u relative velocity of a point; w inverse mass seen by its normal row; N number of live points of
the pair; g0 the normal impulse that bounds friction, frozen while the problem is solved. R is at least
event_beta^2 / (4 pi^2) w N, which is what an impact with restitution has, to hit its target velocity.

Sources: Castro et al. 2022 (SAP, near-rigid regularisation); Castro, Han, Masterjohn 2024 (irrotational
contact fields, "Lagged"). Differs:
* Primal-dual Newton steps: the active set is that of w p_n + vhat - u_n - R p_n > 0 and the friction law is
  linearised as D p_t + mu g0 u_t = 0 (Chan, Golub, Mulet 1999). Same solution; the first does not
  switch a resting contact off for a rounding error of phi, the second needs no line search.
* Impulses p and velocities advance together so that M (v - v*) = J' p after every step, converged or not:
  the bodies receive exactly the impulses that are reported, and two bodies exactly opposite ones.
* g0 is the warm impulse (an estimate from the approach speed where there is none) in the first
  Newton step, the impulse found so far up to the middle of the iteration, then frozen, so that the rest converges:
  friction does not lag by a time step.

* ``polish`` further steps have the bound g0 = p_n as an unknown (a system that is not symmetric) and converge
  quadratically to Coulomb's law as it is regularised above. Where they do not (beyond the Painleve condition) the
  iterate before them stays.

A body that touches only fixed geometry with one sphere has a closed form (exact Coulomb friction).

Smoothing, for derivatives across contact and before it: the normal law becomes the central path

    p_n (u_n - vhat + R p_n) = delta^2 / w

with delta [m/s] a traced number, so that a contact acts from a distance, and eps^2 grows by the square of another. Both
may be zero, which is the law above. "backward" keeps the values of the law above and smooths the derivatives only.
Source: Howell et al. 2022 (Dojo), "Gradients" (the central path of an interior-point method).

Cost: at most ``iterations`` systems in a forward rollout on a CPU (``newton_loop``: of the blocks that are filled, and
none for a world that is solved). Elsewhere that many 6x6 systems a body, or dense 6n x 6n systems where bodies touch
each other (up to about 16).
Gradients: with ``polish`` = 0 exact, of the iteration as it runs. Else implicit, of the converged problem: one more
system, no stored iterates, exact where a world is not ``unconverged``; first and second order, forward and reverse.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from .. import implicit
from ..struct import struct
from ..xla import loops_are_cheap, materialise, materialise_linear, piece
from . import dense, newton_loop
from .base import Problem, Solution, Solver
from .dense import Contacts, Lagging, Sym3, Sym6
from .joined import join
from .laws import Law, contact_model
from .laws.base import points
from .laws.near_rigid import convex
from .rows import Impulses, Index, Rows, take


@dataclasses.dataclass(frozen=True)
class NewtonLagged(Solver):
    """Near-rigid contact with lagged friction.

    Attributes:
      iterations: Newton steps, at least 2 (one is unsafe).
      event_beta: near-rigid parameter (see ``laws.near_rigid``) of impacts and of rows that are rigid in the model [-].
      slip_speed: friction is regularised below this speed v_s [m/s]; a held body creeps at a fraction of it.
      slip_compliance: sigma [-], bounds the stiffness of friction to 1/(sigma w).
      polish: final Newton steps that solve for the bound of friction too, >= 1 makes the derivatives implicit.
      smoothing: None, "forward" (values and derivatives) or "backward" (derivatives only), with the numbers of
        ``Problem.smoothing``.
      tolerance: a world is ``unconverged`` where the residual of a row, as a velocity, exceeds this
        fraction of the fastest relative velocity (before or wanted) plus slip_speed. With ``polish``: the root of
        machine epsilon of their sum.
    """

    iterations: int = 3
    event_beta: float = 0.02
    slip_speed: float = 1e-4
    slip_compliance: float = 1e-3
    tolerance: float = 5e-2
    polish: int = 0
    smoothing: str | None = None

    name = "newton_lagged"
    contact = "near_rigid"
    spins = True

    def __post_init__(self):
        if self.iterations < 2:
            raise ValueError(f"NewtonLagged.iterations = {self.iterations}: needs at least 2")
        if self.polish < 0:
            raise ValueError(f"NewtonLagged.polish = {self.polish}: must be >= 0")
        if self.smoothing not in (None, "forward", "backward"):
            raise ValueError(f"NewtonLagged.smoothing = {self.smoothing!r}: must be None, 'forward' or 'backward'")
        if self.smoothing and not self.polish:
            raise ValueError("NewtonLagged.smoothing needs polish >= 1: its derivatives are implicit")

    def solve(self, problem: Problem) -> Solution:
        closed = _single_sphere(problem)
        if closed and not self.smoothing:
            return self._closed_form(problem)
        if self._loops(problem):
            return self._in_loops(problem)
        system, start, joint = self._system(problem)
        if self.smoothing == "backward":
            soft, system = system, system._with(smooth=None)
            p, bound = (self._closed_form(problem).contacts, None) if closed else self._found(system, start)
            p = _with_derivative(lambda args: self._found(*args)[0])(p, (soft, start))
        else:
            p, bound = self._found(system, start)
        p = materialise(p, problem.one)
        impulse, turn = dense.on_bodies(system.cs, p, problem)
        return Solution(
            impulse=impulse,
            angular_impulse=turn,
            contacts=joint.split(p),
            unconverged=None if bound is None else self._unconverged(system, bound, p),
            warm=not closed,
        )

    def _loops(self, problem: Problem) -> bool:
        """Whether pairs are gone through one by one, until a world is solved."""
        plain = all(isinstance(rows.b, Index) and rows.mu_spin is None for rows in problem.rows)
        return loops_are_cheap() and plain and not self.polish

    def _in_loops(self, problem: Problem) -> Solution:
        bare = problem.without_rows()
        run = piece(functools.partial(newton_loop.group, self._of_group))
        # what the rows of a group do not need must not be among the arguments of its function
        least = bare._with(q=None, inertia=None)
        found = []
        for rows, warm, load in zip(problem.rows, problem.warm, problem.loads):
            asks_back = rows.e is not None or rows.law is not None
            shared = least if asks_back else least._with(v0=None, w0=None)
            found.append(run(rows._with(feature=None), warm, load, shared))
        p, impulse, turn, wrong = newton_loop.solve(self, *zip(*found), bare)
        return Solution(impulse=impulse, angular_impulse=turn, contacts=p, unconverged=wrong)

    def _of_group(self, rows: Rows, warm: Impulses, load, problem: Problem):
        c = dense.contacts(rows, problem)
        free = dense.relative(c, rows, problem.v, problem.w)
        law = self._law(c, rows, problem, self.event_beta, load)
        return c, law, free, _start(c, warm), _bound(law, warm.n, free)

    def _system(self, problem: Problem):
        """What the rows depend on, the impulses and bounds of friction to start from, and whose they are."""
        cs = tuple(dense.contacts(rows, problem) for rows in problem.rows)
        free = tuple(dense.relative(c, rows, problem.v, problem.w) for c, rows in zip(cs, problem.rows))
        groups = zip(cs, problem.rows, problem.loads)
        laws = tuple(self._law(c, rows, problem, self.event_beta, load) for c, rows, load in groups)
        p = tuple(_start(c, g) for c, g in zip(cs, problem.warm))
        bound = tuple(_bound(law, warm.n, x) for law, warm, x in zip(laws, p, free))
        smooth = None
        if self.smoothing:
            if problem.smoothing is None:
                raise ValueError("NewtonLagged.smoothing needs the numbers Problem.smoothing")
            smooth = problem.smoothing
        cs, trees, joint = join(cs, tuple(zip(laws, free, p, bound)), problem.v.x.shape[0], problem.one)
        laws, free, p, bound = zip(*trees)
        return _System(cs, laws, free, problem.without_rows(), smooth), (p, bound), joint

    def _found(self, system: _System, start):
        """Impulses, and the bound of their friction."""
        if not self.polish:
            return self._iterate(system, start)

        def better(new, old, args):
            worst = lambda p: self._violation(args[0], _bound_of(p), p)[0]
            return worst(new) <= worst(old)

        solution = implicit.root(
            lambda args: self._iterate(*args)[0],
            lambda p, args: self._residual(args[0], p),
            lambda p, args, r: self._correction(args[0], p, r),
            self.polish,
            better,
        )
        p = solution((system, start))
        return p, _bound_of(p)

    def _iterate(self, system: _System, start):
        """The lagged iteration."""
        cs, problem = system.cs, system.problem
        one = problem.one

        def step(carry, k):
            p, bound = materialise(carry, one)
            learn = (k >= 1) & (k <= max(1, self.iterations // 2))
            if self.polish:
                learn = k >= 1
            bound = tuple(jnp.where(learn, q, g) for q, g in zip(_bound_of(p), bound))
            linear = materialise(self._linearised(system, bound, p), one)
            residual = tuple(_minus(base, q) for (base, _), q in zip(linear, p))
            d = materialise(dense.newton_step(cs, tuple(g for _, g in linear), residual, problem), one)
            du = materialise(tuple(dense.at_points(c, *d) for c in cs), one)
            p = tuple(_minus(base, g @ dx) for (base, g), dx in zip(linear, du))
            return (p, bound), None

        return jax.lax.scan(step, start, jnp.arange(self.iterations))[0]

    def _residual(self, system: _System, p):
        """Impulses of the law minus p, zero at the solution; friction is bounded by p itself."""
        p = materialise(p, system.problem.one)
        linear = self._linearised(system, _bound_of(p), p)
        return tuple(_minus(base, q) for (base, _), q in zip(linear, p))

    def _correction(self, system: _System, p, residual):
        """The Newton step from p, linear in the residual, with the bound of friction as an unknown."""
        cs, problem, bound = system.cs, system.problem, _bound_of(p)
        u = materialise(system.velocities(p), problem.one)
        keep = lambda tree: tuple(materialise_linear(x, q.n, problem.one) for x, q in zip(tree, p))
        residual = keep(residual)
        ones = tuple(jnp.ones_like(b) for b in bound)
        gs, rs = [], []
        split = lambda bound: zip(*self._linearised(system, bound, p, u))
        _, more, linear = jax.jvp(lambda bound: tuple(split(bound)), (bound,), (ones,), has_aux=True)
        for c, law, g, q, x, e, r in zip(cs, system.laws, linear, p, u, more, residual):
            if c.friction:
                acts = c.live if system.smooth is not None else _acts(c, law, q, x)
                e = jax.tree.map(lambda y: jnp.where(acts, y, 0.0), e)
                normal = g.force.zz if isinstance(g, Sym6) else g.zz
                g = Lagging(g, jax.tree.map(lambda y: y * normal, e))
                r = jax.tree.map(lambda y, z: y + z * r.n, r, e._with(n=jnp.zeros_like(r.n)))
            gs.append(g)
            rs.append(r)
        gs, rs = materialise(tuple(gs), problem.one), keep(rs)
        d = dense.newton_step(cs, gs, rs, problem)
        d = materialise_linear(d, problem.v.x + 0.0 * p[0].n.sum((0, 1)), problem.one)
        return tuple(_minus(r, g @ dense.at_points(c, *d)) for c, g, r in zip(cs, gs, rs))

    def _law(self, c: Contacts, rows: Rows, problem: Problem, event_beta: float, load) -> _Law:
        w = dense.inverse_mass(c, problem)
        model = convex(contact_model(self, problem).law(rows, w, problem, load), rows, w, problem, event_beta)
        count = points(rows, w.dtype)
        law = _Law(
            w=w, r=model.r, vhat=model.vhat, points=count, mu=rows.mu, mu_spin=rows.mu_spin, mu_roll=rows.mu_roll
        )
        return materialise(law, problem.one)

    def final_law(self, rows: Rows, p: Impulses, w, problem: Problem, solution: Solution, load) -> Law:
        rest = (0.0, None) if _single_sphere(problem) else (self.event_beta, load)
        law = self._law(dense.contacts(rows, problem), rows, problem, *rest)
        return Law(law.vhat, law.r)

    def _linearised(self, system: _System, bound, p, u=None) -> tuple[tuple[Impulses, Sym3 | Sym6], ...]:
        """Base and Hessian of the linear model p' = base - G du of every group; base is the impulse of the law."""
        if u is None:
            u = materialise(system.velocities(p), system.problem.one)
        return tuple(
            self._linearise(c, law, system.smooth, *rest) for c, law, *rest in zip(system.cs, system.laws, bound, p, u)
        )

    def _linearise(self, c: Contacts, law: _Law, smooth, bound, p: Impulses, u: Impulses):
        if smooth is None:
            gn = jnp.where(_acts(c, law, p, u), 1.0, 0.0) / law.r
            normal = -gn * u.n
        else:
            normal, gn = _central_path(c, law, smooth[0], p.n, u.n)
        if not c.friction:
            return Impulses(normal), Sym3(gn)
        bound = jnp.where(c.live, bound, 0.0)
        limit, eps = self._friction(law, smooth, bound)
        base, (xx, yy, xy) = _drag(limit, _inverse_speed(u.t1, u.t2, eps), (p.t1, p.t2), (u.t1, u.t2))
        base, g = Impulses(normal, *base), Sym3(gn, xx=xx, yy=yy, xy=xy)
        if not c.torsion:
            return base, g
        # couples: the same law for the velocity nu w / mu, so that a coefficient nu [m] of zero is no special case
        nu = law.mu_spin
        (s,), (zz,) = _drag(nu * bound, nu * _inverse_speed(nu * u.s, 0.0, law.mu * eps), (p.s,), (u.s,))
        if not c.rolling:
            return base._with(s=s), Sym6(g, dense.UNCOUPLED, Sym3(zz))
        nu = law.mu_roll
        inverse = nu * _inverse_speed(nu * u.r1, nu * u.r2, law.mu * eps)
        (r1, r2), (xx, yy, xy) = _drag(nu * bound, inverse, (p.r1, p.r2), (u.r1, u.r2))
        return base._with(s=s, r1=r1, r2=r2), Sym6(g, dense.UNCOUPLED, Sym3(zz, xx=xx, yy=yy, xy=xy))

    def _friction(self, law: _Law, smooth, bound):
        """mu g0 and eps."""
        limit = law.mu * bound
        eps = jnp.maximum(self.slip_compliance * law.w * limit, self.slip_speed)
        return limit, eps if smooth is None else jnp.sqrt(eps * eps + smooth[1] * smooth[1])

    def _unconverged(self, system: _System, bound, p) -> jax.Array:
        worst, scale = self._violation(system, bound, p)
        if self.polish:  # implicit derivatives are as wrong as the residual is large
            return worst > jnp.finfo(worst.dtype).eps ** 0.5 * (scale + self.slip_speed)
        return worst > self.tolerance * scale + self.slip_speed

    def mismatch(self, c: Contacts, law: _Law, p: Impulses, u: Impulses, bound, free: Impulses):
        """Of every row: the velocity that it lacks, its residual as a velocity, its fastest velocity, and the velocity
        that its normal impulse gives [m/s]."""
        normal = jnp.abs(law.w * p.n - jnp.maximum(law.w * p.n - u.n - law.r * p.n, 0.0))
        speed = jnp.maximum(jnp.abs(free.n + law.vhat), jnp.abs(law.vhat))
        load = law.w * p.n
        if not c.friction:
            return normal, normal, speed, load
        limit, eps = self._friction(law, None, bound)
        drag = limit * _inverse_speed(u.t1, u.t2, eps)
        slip = law.w * jnp.maximum(jnp.abs(p.t1 + drag * u.t1), jnp.abs(p.t2 + drag * u.t2))
        speed = jnp.maximum(speed, jnp.maximum(jnp.abs(free.t1), jnp.abs(free.t2)))
        return jnp.maximum(normal, slip / (1.0 + law.w * drag)), jnp.maximum(normal, slip), speed, load

    def _violation(self, system: _System, bounds, ps):
        """Largest residual of a row of a world, as a velocity [m/s] (B,), and the fastest relative velocity."""
        worst = scale = 0.0
        us = system.velocities(ps)
        for c, law, bound, p, u, free in zip(system.cs, system.laws, bounds, ps, us, system.free):
            z = law.w * p.n - u.n - law.r * p.n
            if system.smooth is None:
                r = jnp.abs(law.w * p.n - jnp.maximum(z, 0.0))
            else:
                r = jnp.abs(law.w * p.n - 0.5 * (z + jnp.sqrt(z * z + 4.0 * system.smooth[0] ** 2)))
            speed = jnp.maximum(jnp.abs(free.n), jnp.abs(law.vhat))
            if c.friction:
                limit, eps = self._friction(law, system.smooth, bound)
                drag = limit * _inverse_speed(u.t1, u.t2, eps)
                e1, e2 = p.t1 + drag * u.t1, p.t2 + drag * u.t2
                r = jnp.maximum(r, law.w * jnp.maximum(jnp.abs(e1), jnp.abs(e2)))
                speed = jnp.maximum(speed, jnp.maximum(jnp.abs(free.t1), jnp.abs(free.t2)))
            worst = jnp.maximum(worst, jnp.where(c.live, r, 0.0).max(axis=(0, 1)))
            scale = jnp.maximum(scale, jnp.where(c.live, speed, 0.0).max(axis=(0, 1)))
        return worst, scale

    def _closed_form(self, problem: Problem) -> Solution:
        """One sphere contact a body: the normal row alone gives p_n, then Coulomb friction stops or slows the slip."""
        (rows,) = problem.rows
        one = problem.one
        c = dense.contacts(rows, problem)
        u = dense.relative(c, rows, problem.v, problem.w)
        law = self._law(c, rows, problem, 0.0, None)
        pn = jnp.where(c.live, jnp.maximum((law.vhat - u.n) / (law.r + law.w), 0.0), 0.0)
        p = Impulses(pn)
        if c.friction:
            k = take(problem.inv_mass, rows.b)
            if c.rb is not None:
                k = k + take(problem.inv_inertia.xx, rows.b) * c.rb.z * c.rb.z
            slip = u.t1 * u.t1 + u.t2 * u.t2
            slides = slip > (k * law.mu * pn) ** 2
            s = jnp.where(slides, law.mu * pn / jnp.sqrt(jnp.where(slides, slip, 1.0)), 1.0 / k)
            s = materialise(jnp.where(c.live, s, 0.0), one)
            p = Impulses(pn, -s * u.t1, -s * u.t2)
        p = materialise(p, one)
        impulse, turn = dense.on_bodies((c,), (p,), problem)
        return Solution(impulse=impulse, angular_impulse=turn, contacts=(p,), warm=False)


@struct
class _System:
    """Everything the rows of a problem depend on besides the impulses.

    free: relative velocities without contact. problem: without its rows. smooth: (delta, slip) [m/s] or None.
    """

    cs: tuple[Contacts, ...]
    laws: tuple
    free: tuple[Impulses, ...]
    problem: Problem
    smooth: tuple | None = None

    def velocities(self, p) -> tuple[Impulses, ...]:
        """u of every row, the normal one relative to its target, from the impulses themselves: what a linear
        system leaves over (float32 and stiff contacts) is then part of the next residual."""
        d = materialise(dense.response(self.problem, *dense.on_bodies(self.cs, p, self.problem)), self.problem.one)
        wanted = (x._with(n=x.n - law.vhat) for x, law in zip(self.free, self.laws))
        return tuple(_plus(x, dense.at_points(c, *d)) for c, x in zip(self.cs, wanted))


@struct
class _Law:
    """w inverse mass, r compliance, vhat target of every normal row (S, P, B); points: live points of a pair."""

    w: jax.Array
    r: jax.Array
    vhat: jax.Array
    points: jax.Array
    mu: jax.Array | None
    mu_spin: jax.Array | None = None
    mu_roll: jax.Array | None = None


def _acts(c: Contacts, law: _Law, p: Impulses, u: Impulses) -> jax.Array:
    """The active set of the primal-dual step."""
    return c.live & (law.w * p.n - u.n - law.r * p.n > 0)


def _central_path(c: Contacts, law: _Law, delta, p, u) -> tuple[jax.Array, jax.Array]:
    """Base and slope of the rows w p = (z + sqrt(z^2 + 4 delta^2)) / 2, z = w p - u - r p, linearised in p and u."""
    z = law.w * p - u - law.r * p
    square = z * z + 4.0 * delta * delta
    some = square > 0
    root = jnp.where(some, jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)
    part = 0.5 * (1.0 + jnp.where(some, z / jnp.where(some, root, 1.0), 0.0))
    stiff = (1.0 - part) * law.w + part * law.r
    base = p - (law.w * p - 0.5 * (z + root)) / stiff
    return jnp.where(c.live, base, 0.0), jnp.where(c.live, part / stiff, 0.0)


def _with_derivative(f):
    """(p, args) -> p with the derivative of ``f(args)``, which it may differ from."""

    @jax.custom_jvp
    def value(p, args):
        return p

    value.defjvp(
        lambda primals, tangents: (primals[0], implicit.tangent(f, primals[1], tangents[1])), symbolic_zeros=True
    )
    return value


def _bound_of(p):
    """Normal impulses that bound friction."""
    return tuple(jnp.maximum(q.n, 0.0) for q in p)


def _inverse_speed(a, b, eps) -> jax.Array:
    """1 / D of friction rows with velocities a, b."""
    return 1.0 / jnp.sqrt(a * a + b * b + eps * eps)


def _drag(limit, inverse, p: tuple, u: tuple):
    """Base and Hessian of the rows D p + limit u = 0 linearised in both, for one or two rows: (xx,) or (xx, yy, xy)."""
    m = limit * inverse
    # p inside the disc (so that the symmetric part stays positive), as a fraction of the limit over D
    q = sum(x * x for x in p)
    outside = q > limit * limit
    size = jnp.where(outside, jnp.sqrt(jnp.where(outside, q, 1.0)), jnp.where(limit > 0, limit, 1.0))
    s = jnp.where(limit > 0, inverse, 0.0) / size
    f = tuple(x * s for x in p)
    own = tuple(m * (1.0 + a * b) for a, b in zip(f, u))
    off = (0.5 * m * (f[0] * u[1] + f[1] * u[0]),) if len(p) == 2 else ()
    return tuple(-m * x for x in u), own + off


def _single_sphere(problem: Problem) -> bool:
    """One central contact a body with fixed geometry only: the rows do not see each other."""
    if len(problem.rows) != 1:
        return False
    rows = problem.rows[0]
    alone = rows.a is None and rows.slots == 1 and rows.central_b
    if not alone or not isinstance(rows.b, Index) or len(np.unique(rows.b.rows)) != len(rows.b):
        return False
    if rows.mu_spin is not None:
        return False
    return rows.mu is None or problem.w is None or problem.inertia.isotropic


def _start(c: Contacts, warm: Impulses) -> Impulses:
    live = lambda x: jnp.where(c.live, x, 0.0)
    if not c.friction:
        return Impulses(live(jnp.maximum(warm.n, 0.0)))
    return jax.tree.map(live, warm)._with(n=live(jnp.maximum(warm.n, 0.0)))


def _bound(law: _Law, warm, free: Impulses):
    """First guess of the normal impulse: the warm one, or this point's share of stopping the approach."""
    guess = jnp.maximum((law.vhat - free.n) / (law.r + law.w * law.points), 0.0)
    return jnp.where(warm > 0, warm, guess)


def _plus(a, b):
    return jax.tree.map(lambda x, y: x + y, a, b)


def _minus(a, b):
    return jax.tree.map(lambda x, y: x - y, a, b)
