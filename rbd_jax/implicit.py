"""Layer 1: derivatives of the solution of an equation that do not go through the iteration that found it.

With F(p, theta) = 0 the solution p(theta) has the derivative dp = -(dF/dp)^-1 (dF/dtheta) dtheta. The rule below is
itself made of differentiable operations, evaluated at p(theta), so that its derivative is right too: F(p(theta), theta)
vanishes identically, hence so does what the neglected part of the rule would add. (A custom reverse rule would forbid
forward mode, and a one-step form alone, whose second derivatives are wrong, is no substitute.)

Where JAX splits a loop for reverse mode it takes the functions in what is known without their rules. So the last
step of the iteration is one whose own derivative is right to first order (the one-step form), which makes
second derivatives right there as well, to the accuracy of the iterate before it.

Source: implicit function theorem; Blondel et al. 2022, "Efficient and modular implicit differentiation"; Bolte,
Pauwels, Vaiter 2023, "One-step differentiation of iterative algorithms".
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import SymbolicZero

_FOUND = "found"


def found(tree):
    """``tree``, which ``recomputed`` keeps: the result of a search that is not differentiated itself."""
    return jax.tree.map(lambda c: checkpoint_name(c, _FOUND), tree)


def recomputed(f):
    """``f``, of which reverse mode keeps the arguments and what is ``found``; it computes the rest again."""
    return jax.checkpoint(f, prevent_cse=False, policy=jax.checkpoint_policies.save_only_these_names(_FOUND))


def root(solve, residual, correction, steps: int = 1, better=None):
    """A function theta -> p with ``residual(p, theta) = 0`` and its implicit derivative, forward and reverse.

    Args:
      solve: theta -> p to within ``steps`` Newton steps, any program; it is not differentiated.
      residual: (p, theta) -> r, a tree like p.
      correction: (p, theta, r) -> dp, linear in r: solves (d residual / d p) dp = -r. The last steps are such.
      better: (new, old, theta) -> whether to take those steps, judged before the last one, or None: always.
      All may close over static values only.
    """

    @jax.custom_jvp
    def solution(theta):
        fixed = jax.lax.stop_gradient(theta)
        old = jax.lax.stop_gradient(solve(fixed))

        def step(p, k):
            p, last = jax.lax.stop_gradient(p), k == steps - 1
            take = True
            if better is not None:
                take = jax.lax.cond(last, lambda: better(p, old, fixed), lambda: every)
                p = jax.tree.map(lambda p, q: jnp.where(take, p, q), p, old)
            d = correction(p, fixed, residual(p, theta))
            # an iterate that is kept has the derivative of a step too
            none = lambda d: jnp.where(jnp.isfinite(d), d - jax.lax.stop_gradient(d), 0.0)
            return jax.tree.map(lambda p, d: p + jnp.where(take, d, none(d)), p, d), None

        if better is not None:
            every = jnp.ones(jax.eval_shape(better, old, old, fixed).shape, bool)
        return jax.lax.scan(step, old, jnp.arange(steps))[0]

    def rule(primals, tangents):
        (theta,), (change,) = primals, tangents
        p = found(solution(theta))
        r = tangent(lambda theta: residual(p, theta), theta, change)
        return p, correction(p, theta, r)

    solution.defjvp(rule, symbolic_zeros=True)
    return solution


def tangent(f, theta, change):
    """d f(theta) along ``change``, whose leaves may be symbolic zeros (they cost nothing)."""
    leaves, tree = jax.tree.flatten(theta)
    changes = jax.tree.leaves(change, is_leaf=lambda c: isinstance(c, SymbolicZero))
    moving = [i for i, c in enumerate(changes) if not isinstance(c, SymbolicZero)]

    def of_moving(values):
        merged = list(leaves)
        for i, value in zip(moving, values):
            merged[i] = value
        return f(jax.tree.unflatten(tree, merged))

    _, out = jax.jvp(of_moving, ([leaves[i] for i in moving],), ([changes[i] for i in moving],))
    return out
