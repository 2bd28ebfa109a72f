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

A body that touches only fixed geometry with one sphere has a closed form (exact Coulomb friction).

Cost: ``iterations`` 6x6 systems a body, or dense 6n x 6n systems where bodies touch each other (up to about 16).
Gradients: exact, of the iteration as it runs, forward and reverse.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from ..struct import struct
from ..xla import materialise
from . import dense
from .base import Problem, Solution, Solver
from .dense import Contacts, Sym3, Sym6
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
      tolerance: a world is ``unconverged`` where the residual of a row, as a velocity, exceeds this
        fraction of the fastest relative velocity (before or wanted) plus slip_speed.
    """

    iterations: int = 3
    event_beta: float = 0.02
    slip_speed: float = 1e-4
    slip_compliance: float = 1e-3
    tolerance: float = 5e-2

    name = "newton_lagged"
    contact = "near_rigid"
    spins = True

    def __post_init__(self):
        if self.iterations < 2:
            raise ValueError(f"NewtonLagged.iterations = {self.iterations}: needs at least 2")

    def solve(self, problem: Problem) -> Solution:
        if _single_sphere(problem):
            return self._closed_form(problem)
        one = problem.one
        cs = tuple(dense.contacts(rows, problem) for rows in problem.rows)
        free = tuple(dense.relative(c, rows, problem.v, problem.w) for c, rows in zip(cs, problem.rows))
        laws = tuple(self._law(c, rows, problem, self.event_beta) for c, rows in zip(cs, problem.rows))
        p = tuple(_start(c, g) for c, g in zip(cs, problem.warm))
        wanted = tuple(x._with(n=x.n - law.vhat) for x, law in zip(free, laws))

        def velocities(p):
            """u of every row, the normal one relative to its target, from the impulses themselves: what the linear
            system leaves over (float32 and stiff contacts) is then part of the next residual."""
            d = materialise(dense.response(problem, *dense.on_bodies(cs, p, problem)), one)
            return materialise(tuple(_plus(x, dense.at_points(c, *d)) for c, x in zip(cs, wanted)), one)

        bound = tuple(_bound(law, warm.n, x) for law, warm, x in zip(laws, p, free))

        def step(carry, k):
            p, bound = materialise(carry, one)
            u = velocities(p)
            learn = (k >= 1) & (k <= max(1, self.iterations // 2))
            bound = tuple(jnp.where(learn, jnp.maximum(q.n, 0.0), g) for q, g in zip(p, bound))
            linear = tuple(self._linearise(c, *rest) for c, *rest in zip(cs, laws, bound, p, u))
            linear = materialise(linear, one)
            residual = tuple(_minus(base, q) for (base, _), q in zip(linear, p))
            d = materialise(dense.newton_step(cs, tuple(g for _, g in linear), residual, problem), one)
            du = materialise(tuple(dense.at_points(c, *d) for c in cs), one)
            p = tuple(_minus(base, g @ dx) for (base, g), dx in zip(linear, du))
            return (p, bound), None

        (p, bound), _ = jax.lax.scan(step, (p, bound), jnp.arange(self.iterations))
        p = materialise(p, one)
        impulse, turn = dense.on_bodies(cs, p, problem)
        return Solution(
            impulse=impulse,
            angular_impulse=turn,
            contacts=p,
            unconverged=self._unconverged(cs, laws, bound, p, velocities(p), free),
        )

    def _law(self, c: Contacts, rows: Rows, problem: Problem, event_beta: float) -> _Law:
        w = dense.inverse_mass(c, problem)
        model = convex(contact_model(self, problem).law(rows, w, problem), rows, w, problem, event_beta)
        count = points(rows, w.dtype)
        law = _Law(
            w=w, r=model.r, vhat=model.vhat, points=count, mu=rows.mu, mu_spin=rows.mu_spin, mu_roll=rows.mu_roll
        )
        return materialise(law, problem.one)

    def final_law(self, rows: Rows, p: Impulses, w, problem: Problem, solution: Solution) -> Law:
        law = self._law(
            dense.contacts(rows, problem), rows, problem, 0.0 if _single_sphere(problem) else self.event_beta
        )
        return Law(law.vhat, law.r)

    def _linearise(self, c: Contacts, law: _Law, bound, p: Impulses, u: Impulses) -> tuple[Impulses, Sym3]:
        """Base and Hessian of the linear model p' = base - G du."""
        gap = -u.n
        active = c.live & (law.w * p.n + gap - law.r * p.n > 0)
        gn = jnp.where(active, 1.0, 0.0) / law.r
        if not c.friction:
            return Impulses(gn * gap), Sym3(gn)
        bound = jnp.where(c.live, bound, 0.0)
        limit, eps = self._friction(law, bound)
        base, (xx, yy, xy) = _drag(limit, _inverse_speed(u.t1, u.t2, eps), (p.t1, p.t2), (u.t1, u.t2))
        base, g = Impulses(gn * gap, *base), Sym3(gn, xx=xx, yy=yy, xy=xy)
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

    def _friction(self, law: _Law, bound):
        """mu g0 and eps."""
        limit = law.mu * bound
        return limit, jnp.maximum(self.slip_compliance * law.w * limit, self.slip_speed)

    def _unconverged(self, cs, laws, bounds, ps, us, frees) -> jax.Array:
        worst = scale = 0.0
        for c, law, bound, p, u, free in zip(cs, laws, bounds, ps, us, frees):
            r = jnp.abs(law.w * p.n - jnp.maximum(law.w * p.n - u.n - law.r * p.n, 0.0))
            speed = jnp.maximum(jnp.abs(free.n), jnp.abs(law.vhat))
            if c.friction:
                limit, eps = self._friction(law, bound)
                drag = limit * _inverse_speed(u.t1, u.t2, eps)
                e1, e2 = p.t1 + drag * u.t1, p.t2 + drag * u.t2
                r = jnp.maximum(r, law.w * jnp.maximum(jnp.abs(e1), jnp.abs(e2)))
                speed = jnp.maximum(speed, jnp.maximum(jnp.abs(free.t1), jnp.abs(free.t2)))
            worst = jnp.maximum(worst, jnp.where(c.live, r, 0.0).max(axis=(0, 1)))
            scale = jnp.maximum(scale, jnp.where(c.live, speed, 0.0).max(axis=(0, 1)))
        return worst > self.tolerance * scale + self.slip_speed

    def _closed_form(self, problem: Problem) -> Solution:
        """One sphere contact a body: the normal row alone gives p_n, then Coulomb friction stops or slows the slip."""
        (rows,) = problem.rows
        one = problem.one
        c = dense.contacts(rows, problem)
        u = dense.relative(c, rows, problem.v, problem.w)
        law = self._law(c, rows, problem, 0.0)
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
class _Law:
    """w inverse mass, r compliance, vhat target of every normal row (S, P, B); points: live points of a pair."""

    w: jax.Array
    r: jax.Array
    vhat: jax.Array
    points: jax.Array
    mu: jax.Array | None
    mu_spin: jax.Array | None = None
    mu_roll: jax.Array | None = None


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
