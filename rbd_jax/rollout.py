"""Layer 8: ``step`` and ``rollout`` as the user calls them.

Both convert to the hot layout at their edges. Under ``jax.vmap`` they do not run their loops with a
batch axis in front: a batching rule hands the whole batch to the direct call, so that
``vmap(rollout)`` is the same program as ``rollout`` of a batched state. Under differentiation the
plain program is used.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from .model import BASE_NDIM, Model, batch_of
from .spatial import Vec3
from .state import State, World, Wrench
from .step import advance, enter, leave, with_memory


def step(model: Model, state: State, control=None) -> State:
    """Advance the worlds by one step of ``model.dt``.

    Args:
      model: from :func:`rbd_jax.build`; leaves may have batch axes (worlds with their own numbers).
      state: any batch axes.
      control: a :class:`rbd_jax.Wrench` (force [N] and torque [N m] about the centre of mass, world
        frame, (..., n, 3)), a function ``(model, state) -> Wrench``, or None.

    Returns:
      The state after the step.

    Raises:
      ValueError: wrong shapes or batch sizes, naming the field.
    """
    _check_state(model, state)
    if callable(control):
        control = control(model, state)
    _check_wrench(model, state, control)
    return _step(model, with_memory(model, state), control)


def rollout(model: Model, state: State, steps: int, every: int = 1, control=None) -> tuple[State, State]:
    """Advance the worlds by ``steps`` steps in one compiled loop.

    Args:
      model, state: as for :func:`step`.
      steps: number of steps, >= 0.
      every: steps between two samples of the trajectory, >= 1.
      control: as for :func:`step`; a function is called at every step.

    Returns:
      final: state after all steps.
      traj: a State of ``steps // every + 1`` samples, the first the initial state; leaves
        (batch..., samples, n), without memory.

    Raises:
      ValueError: steps < 0, every < 1, wrong shapes or batch sizes.
    """
    for name, value, least in (("steps", steps, 0), ("every", every, 1)):
        if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
            raise ValueError(f"rollout: {name} = {value!r} must be an integer >= {least}")
    _check_state(model, state)
    state = with_memory(model, state)
    if callable(control):
        return _rollout_with(model, state, int(steps), int(every), control)
    _check_wrench(model, state, control)
    return _rollout(model, state, control, int(steps), int(every))


# --- checks, before anything is traced ---


def _check_state(model: Model, state: State) -> None:
    if not isinstance(model, Model) or not isinstance(state, State):
        raise TypeError("expected (model, state) as rbd_jax.build returns them")
    if state.n != model.n:
        raise ValueError(f"state has {state.n} bodies, the model has {model.n}")
    if state.x.x.dtype != model.mass.dtype:
        raise ValueError(
            f"state is {state.x.x.dtype}, the model is {model.mass.dtype}: build both under the same jax_enable_x64"
        )
    batch_of(model, state.batch_shape)


def _check_wrench(model: Model, state: State, wrench) -> None:
    if wrench is None:
        return
    if not isinstance(wrench, Wrench):
        raise ValueError(f"control = {type(wrench).__name__} must be a Wrench, a function that returns one, or None")
    batch = batch_of(model, state.batch_shape)
    for name in ("force", "torque"):
        value = getattr(wrench, name)
        if value is not None and jnp.shape(value) not in ((model.n, 3), (*batch, model.n, 3)):
            raise ValueError(
                f"control.{name} has shape {jnp.shape(value)}; it needs {(model.n, 3)} or {(*batch, model.n, 3)}"
            )


# --- the compiled functions ---


def _hot_wrench(wrench: Wrench | None, batch, dtype) -> Wrench | None:
    """A wrench of Vec3s (n, 1) or (n, B)."""
    if wrench is None:
        return None

    def convert(value):
        if value is None:
            return None
        value = jnp.asarray(value, dtype)
        value = value.reshape(-1, *value.shape[-2:])  # (B or 1, n, 3)
        part = lambda k: value[:, :, k].T
        return Vec3(part(0), part(1), part(2))

    return Wrench(convert(wrench.force), convert(wrench.torque))


def _step_batch(model: Model, state: State, wrench: Wrench | None) -> State:
    batch = batch_of(model, state.batch_shape)
    p, world = enter(model, state, batch)
    world = advance(model, p, world, _hot_wrench(wrench, batch, state.x.x.dtype))
    return leave(model, p, world, batch)


def _sample(model: Model, p, world: World) -> State:
    """The world as a hot State without memory."""
    return leave(model, p, world, None, memory=False)


def _rollout_batch(model: Model, state: State, wrench, steps: int, every: int, control=None) -> tuple[State, State]:
    batch = batch_of(model, state.batch_shape)
    p, world = enter(model, state, batch)
    hot = _hot_wrench(wrench, batch, state.x.x.dtype)

    def one_step(world, _):
        w = hot
        if control is not None:
            seen = leave(model, p, world, batch)
            given = control(model, seen)
            _check_wrench(model, seen, given)
            w = _hot_wrench(given, batch, state.x.x.dtype)
        return advance(model, p, world, w), None

    def run(world, count):
        return jax.lax.scan(one_step, world, None, length=count)[0]

    def block(world, _):
        world = one_step(world, None)[0] if every == 1 else run(world, every)
        return world, _sample(model, p, world)

    first = _sample(model, p, world)
    samples, rest = steps // every, steps % every
    later = None
    if samples:
        world, later = jax.lax.scan(block, world, None, length=samples)
    if rest:
        world = run(world, rest)

    def joined(a, b):
        """(k..., B) and (T, k..., B) -> (batch..., T + 1, k...)."""
        c = a[None] if b is None else jnp.concatenate([a[None], b])
        c = jnp.moveaxis(c, -1, 0)
        return c.reshape(*batch, *c.shape[1:])

    traj = jax.tree.map(lambda a: joined(a, None), first) if later is None else jax.tree.map(joined, first, later)
    return leave(model, p, world, batch), traj


def _batched_call(core):
    """``core(model, state, wrench)`` with a rule for vmap; differentiation goes through ``core`` itself."""

    @jax.custom_batching.custom_vmap
    def direct(model, state, wrench):
        return core(model, state, wrench)

    @jax.custom_jvp
    def call(model, state, wrench):
        return direct(model, state, wrench)

    @call.defjvp
    def _(primals, tangents):
        return jax.jvp(core, primals, tangents)

    @direct.def_vmap
    def _(size, batched, model, state, wrench):
        model_in, state_in, wrench_in = batched
        grow = lambda c, b: c if b else jnp.broadcast_to(c, (size, *jnp.shape(c)))
        state = jax.tree.map(grow, state, state_in)
        wrench = jax.tree.map(grow, wrench, wrench_in)
        if wrench is not None and any(jax.tree.leaves(wrench_in)):
            inner = len(state.batch_shape) - 1
            pad = lambda c: c.reshape(c.shape[0], *(1,) * (inner - (c.ndim - 3)), *c.shape[1:])
            full = lambda c: jnp.broadcast_to(pad(c), (*state.batch_shape, *c.shape[-2:]))
            wrench = jax.tree.map(full, wrench)
        elif wrench is not None:
            wrench = jax.tree.map(lambda c: jnp.broadcast_to(c[0], (*state.batch_shape, *c.shape[-2:])), wrench)
        model = _grow_model(model, model_in, size)
        out = call(model, state, wrench)
        return out, jax.tree.map(lambda _: True, out)

    return call


def _grow_model(model: Model, batched: Model, size: int) -> Model:
    """Leaves that the mapped axis passes by keep their shape, unless they have batch axes of their own."""
    changes = {}
    for name in ("inertia", *BASE_NDIM):
        value, b = getattr(model, name), getattr(batched, name)
        if value is not None and not b and value.ndim > model.base_ndim(name):
            changes[name] = jnp.broadcast_to(value, (size, *value.shape))
    return model._with(**changes) if changes else model


@jax.jit
def _step(model, state, wrench):
    return _batched_call(_step_batch)(model, state, wrench)


@functools.partial(jax.jit, static_argnums=(3, 4))
def _rollout(model, state, wrench, steps, every):
    core = lambda model, state, wrench: _rollout_batch(model, state, wrench, steps, every)
    return _batched_call(core)(model, state, wrench)


@functools.partial(jax.jit, static_argnums=(2, 3, 4))
def _rollout_with(model, state, steps, every, control):
    return _rollout_batch(model, state, None, steps, every, control)
