"""Layer 8: how the derivative of the end of a rollout grows or fades with the time before it."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from .checks import whole
from .model import Model, Params, batch_of
from .rollout import Length, _check_state, _check_wrench, _rollout_batch, asked, blocks_of
from .spatial import Vec3, components, qexp
from .state import State, World
from .step import with_memory
from .struct import struct


@struct
class GradientNorms:
    """Euclidean norms, over all bodies and axes, of the derivative of an objective J by the state at each sample.

    Attributes:
      steps_left: from the sample to the end, int32 (samples,), falling from all steps.
      position: of dJ/dpos [J per m], (..., samples). velocity: of dJ/dvel [J per m/s].
      attitude: of the derivative by a rotation about the world's axes [J per rad].
      omega: of dJ/domega [J per rad/s]. Both are None where the scene models no attitude.

    Each holds the others still: ``position`` and ``attitude`` at the same vel and omega, ``omega`` at the same quat,
    and all at the impulses that the solver remembers.
    """

    steps_left: jax.Array
    position: jax.Array
    velocity: jax.Array
    attitude: jax.Array | None
    omega: jax.Array | None


def gradient_norms(
    model: Model,
    state: State,
    steps: int,
    objective,
    every: int = 1,
    control=None,
    checkpoint: int | tuple[int, ...] | None = None,
) -> GradientNorms:
    """Norms of the derivative of the end of a rollout by every state on the way, in one reverse pass.

    Norms that grow with ``steps_left`` say that gradients explode (a chaotic or a stiff motion), norms that fall that
    they vanish (friction, inelastic impacts), and where: ``rollout(truncate=...)`` may then cut them in time.

    Args:
      model, state, steps, every, control, checkpoint: as for :func:`rbd_jax.rollout`; samples are those of its
        trajectory.
      objective: final State -> scalar; or an array of the batch axes, one number for each world.

    Returns:
      Norms with axes (batch..., samples), of the sum of the objective: worlds do not act on each other, so each has
      those of its own. Those of a frozen world are of its held state.

    Raises:
      ValueError: as ``rollout``, or an objective that is no function or returns another shape.
    """
    for name, value, least in (("steps", steps, 0), ("every", every, 1)):
        if not whole(value, least):
            raise ValueError(f"gradient_norms: {name} = {value!r} must be an integer >= {least}")
    blocks = blocks_of("gradient_norms", checkpoint)
    if not callable(objective):
        raise ValueError(f"gradient_norms: objective = {objective!r} must be a function of the final State")
    _check_state(model, state)
    state = with_memory(model, state)
    constant = None if callable(control) else control
    _check_wrench(model, state, constant)
    function = control if callable(control) else None
    return _norms(model, state, constant, int(steps), int(every), objective, function, blocks)


@functools.partial(jax.jit, static_argnums=(3, 4, 5, 6, 7))
def _norms(model, state, wrench, steps, every, objective, control, blocks) -> GradientNorms:
    batch = batch_of(model, state.batch_shape)
    ask = None
    if control is not None:
        ask, wrench = asked(model, state, control)

    def value(changes):
        length, nudge = Length.of(steps, every), (nudged, changes)
        final, _ = _rollout_batch(model, state, wrench, length, ask, blocks, safe=True, nudge=nudge)
        J = jnp.asarray(objective(final))
        if J.shape not in ((), batch) or not jnp.issubdtype(J.dtype, jnp.floating):
            raise ValueError(
                f"gradient_norms: objective returned {J.dtype} {J.shape}; it must be a real number, or one for each "
                f"world {batch}"
            )
        return J.sum()

    samples = steps // every + 1
    worlds = 1
    for size in batch:
        worlds *= size
    zero = jnp.zeros((samples, state.n, worlds), state.x.x.dtype)
    none = Vec3(zero, zero, zero)
    changes = Changes(none, none, *((none, none) if model.structure.attitude else (None, None)))
    slope = jax.grad(value)(changes)

    def norm(v: Vec3 | None):
        if v is None:
            return None
        # scaled: the squares of a gradient that explodes leave the range long before it does
        most = functools.reduce(jnp.maximum, (jnp.abs(c).max(axis=1) for c in components(v)))
        unit = jnp.where((most > 0) & jnp.isfinite(most), most, 1.0)
        size = unit * jnp.sqrt(sum(((c / unit[:, None]) ** 2).sum(axis=1) for c in components(v)))
        return size.T.reshape(*batch, samples)

    left = steps - every * jnp.arange(samples, dtype=jnp.int32)
    return GradientNorms(left, *(norm(v) for v in (slope.x, slope.v, slope.turn, slope.w)))


@struct
class Changes:
    """Of position, velocity, attitude (a rotation vector, world frame) and omega, (samples, n, B)."""

    x: Vec3
    v: Vec3
    turn: Vec3 | None
    w: Vec3 | None


def nudged(p: Params, world: World, d: Changes) -> World:
    """``world`` with its bodies changed by ``d``; to the bit as it was where ``d`` is zero."""
    b = world.bodies
    bodies = b._with(x=b.x + d.x, v=b.v + d.v)
    if d.turn is not None:
        w = p.inertia.velocity(b.q, b.L)
        q = qexp(d.turn) @ b.q
        L = b.L + (p.inertia.momentum(q, w + d.w) - p.inertia.momentum(b.q, w))
        R = b.R if b.R is None else b.R + (q.mat() - b.q.mat())
        bodies = bodies._with(q=q, L=L, R=R)
    return world._with(bodies=bodies)
