"""Layer 8: ``step`` and ``rollout`` as the user calls them.

Both convert to the hot layout at their edges. Under ``jax.vmap`` they do not run their loops with a
batch axis in front: a batching rule hands the whole batch to the direct call, so that
``vmap(rollout)`` is the same program as ``rollout`` of a batched state. Under differentiation
another program is used (``_derived``): its loop comes in the blocks of ``checkpoint``, and worlds that
are lost from the start are replaced by harmless ones. Its values are those of the direct program.
"""

from __future__ import annotations

import functools
import math
import types
import typing

import jax
import jax.numpy as jnp
import numpy as np

from .checks import whole
from .kernel import repeated
from .memory import refuse
from .model import Model, batch_of
from .spatial import Vec3
from .spread import any_traced, first_changing, lowered_share, means, over_cores, over_devices
from .state import State, World, Wrench
from .step import (
    advance,
    advance_in_blocks,
    enter,
    grown,
    harmless,
    held,
    leave,
    marked,
    moving,
    opened,
    restored,
    substeps,
    unfit,
    with_memory,
)
from .tiles import tiled
from .xla import loops_are_cheap, no_collections, on_cpu


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
    changing = first_changing((model, state, control))
    if changing is None:
        return _step(model, state, control)
    with no_collections():
        return _differentiated_step(model, state, control, changing)


def rollout(
    model: Model,
    state: State,
    steps: int,
    every: int = 1,
    control=None,
    checkpoint: int | tuple[int, ...] | None = None,
    truncate: int | None = None,
    donate: bool = False,
) -> tuple[State, State]:
    """Advance the worlds by ``steps`` steps in one compiled loop.

    Args:
      model, state: as for :func:`step`.
      steps: number of steps, >= 0.
      every: steps between two samples of the trajectory, >= 1.
      control: as for :func:`step`; a function is called at every step.
      checkpoint: memory of reverse mode. None: the state at the start of every step is kept, and what its solver
        found; the rest of a step is computed again when it is differentiated. K: the state at the start of every block
        of K steps is kept, and a block is run again when it is differentiated; this needs steps / K states and
        what None needs for K steps, so take K = sqrt(steps) or less. (K1, K2, ...), decreasing: blocks of K1 steps in
        blocks of K2 and so on, each level computing its steps once more;
        K1 = steps^(2/3), K2 = steps^(1/3) for very long rollouts. A block ends at a sample: K is rounded down to a
        multiple of ``every``, or the steps between two samples are divided. What is left over is a block of its
        own, and compiles the step once more. Values, forward mode and forward cost are those of None.
      truncate: None, or after how many steps the derivative is cut (truncated back-propagation through time): step
        k K takes its state as a constant for k = 1, 2, ... Values are unchanged; the final state depends on
        the model and the control of the last block only, on the initial state only where steps <= K, and a sample on
        what happened since the last cut before it.
      donate: let the result take the memory of ``state``, which must not be used again.

    A call that is made rather than traced, without a control function, runs on a CPU a program that serves every
    number of steps between two samples and of substeps. Such a call of many worlds is spread over all local devices of
    JAX, or over the cores of its only CPU (:func:`rbd_jax.use_cores`); it then waits for the result. What
    becomes of a world does not depend on that, nor on how many others there are if there are 32 or more.

    Returns:
      final: state after all steps.
      traj: a State of ``steps // every + 1`` samples, the first the initial state; leaves
        (batch..., samples, n), without memory.

    A world that is not finite, or whose state exceeds 2.6e6 (float32; 2.4e51 in float64) in norm, is frozen at its last
    state in range, from the start if it was so given, with the status NOT_FINITE. Its derivative is that of this
    state: the identity with respect to the state at which it froze, zero with respect to model and control
    since. Derivatives of other worlds and of numbers that all worlds share are not affected (up to second derivatives
    in forward over reverse mode); only a ``control`` function whose own derivative is not finite at the state of a
    frozen world gives NaN for what it closes over.

    Raises:
      ValueError: steps < 0, every < 1, checkpoint or truncate not as above, wrong shapes or batch sizes.
      MemoryError: the samples cannot fit into what the device has left.
    """
    for name, value, least in (("steps", steps, 0), ("every", every, 1), ("truncate", truncate, 1)):
        if not (name == "truncate" and value is None) and not whole(value, least):
            raise ValueError(f"rollout: {name} = {value!r} must be an integer >= {least}")
    blocks = blocks_of("rollout", checkpoint)
    truncate = None if truncate is None else int(truncate)
    batch = _check_state(model, state)
    if callable(control):
        return _rollout_with(model, state, int(steps), int(every), control, blocks, truncate)
    _check_wrench(model, state, control)
    steps, every = int(steps), int(every)
    traced = any_traced((model, state, control))
    core, args = _forward(model, state, control, steps, every, traced)
    use = means(core, args, batch, steps)
    refuse(state, math.prod(batch), steps // every + 1, 1 + (use.cores > 1), use.devices)
    if use.devices:
        return over_devices(core, use.devices, *args, batch, donate)
    if use.cores > 1:
        return over_cores(core, use.cores, *args, batch)
    if not traced:
        return (_here_donated if donate else _here)(core, *args)
    changing = first_changing((model, state, control))
    if changing is None:
        return _rollout(model, state, control, steps, every, blocks, truncate)
    with no_collections():
        return _differentiated(model, state, control, steps, every, blocks, truncate, changing)


# --- checks, before anything is traced ---


def blocks_of(name: str, checkpoint) -> tuple[int, ...]:
    """Sizes of the blocks of ``checkpoint``, outer first; () for None.

    Raises:
      ValueError: neither None nor an integer >= 1 nor decreasing ones, in the name of function ``name``.
    """
    sizes = () if checkpoint is None else checkpoint if isinstance(checkpoint, tuple) else (checkpoint,)
    falls = all(whole(size, 1) for size in sizes) and all(a > b for a, b in zip(sizes, sizes[1:]))
    if not falls or checkpoint == ():
        raise ValueError(
            f"{name}: checkpoint = {checkpoint!r} must be None, an integer >= 1 or a tuple of decreasing ones, "
            "outer first"
        )
    return tuple(int(size) for size in sizes)


def _check_state(model: Model, state: State) -> tuple[int, ...]:
    """The batch axes of the worlds."""
    if not isinstance(model, Model) or not isinstance(state, State):
        raise TypeError("expected (model, state) as rbd_jax.build returns them")
    if state.n != model.n:
        raise ValueError(f"state has {state.n} bodies, the model has {model.n}")
    if state.x.x.dtype != model.mass.dtype:
        raise ValueError(
            f"state is {state.x.x.dtype}, the model is {model.mass.dtype}: build both under the same jax_enable_x64"
        )
    batch = batch_of(model, state.batch_shape)
    if 0 in batch:
        raise ValueError(f"batch size 0: the state has batch axes {state.batch_shape}; there is no world to step")
    return batch


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


def _step_batch(model: Model, state: State, wrench: Wrench | None, safe: bool = False) -> State:
    batch = batch_of(model, state.batch_shape)

    def run(model, state):
        p, world = enter(model, state, batch, control=wrench)
        hot = _hot_wrench(wrench, batch, state.x.x.dtype)
        world = repeated(_advance(model.structure, model.method), world, p, hot, worlds=math.prod(batch), count=1)
        return leave(model, p, world, batch)

    return _from_start(run, model, state, batch, safe)


def _from_start(run, model: Model, state: State, batch, safe: bool):
    """``run(model, state)``, a tree of States, with the worlds that cannot be stepped frozen from the start.

    safe: for differentiation: such worlds are replaced before they enter, and handed back as they were.
    """
    state = grown(state, batch)
    lost = unfit(model, state)
    if not safe:
        return run(model, marked(state, lost))
    out = run(*harmless(model, state, lost))
    return jax.tree.map(lambda s: restored(s, state, lost), out, is_leaf=lambda s: isinstance(s, State))


@functools.lru_cache(maxsize=64)
def _advance(structure, method):
    """``advance`` of models of this kind, with the world first; one object for each."""
    kind = types.SimpleNamespace(structure=structure, method=method)
    return lambda world, p, wrench: advance(kind, p, world, wrench)


def _sample(model: Model, p, world: World) -> State:
    """The world as a hot State without memory."""
    return leave(model, p, world, None, memory=False)


class Length(typing.NamedTuple):
    """How long a rollout is: ``samples`` times ``every`` steps, and ``rest``.

    ``every``, ``rest`` and ``substeps`` may be traced, of what is not differentiated. rest None: none; substeps None:
    those of the method.
    """

    samples: int
    every: int | jax.Array
    rest: int | jax.Array | None = None
    substeps: jax.Array | None = None

    @classmethod
    def of(cls, steps: int, every: int) -> Length:
        samples = steps // every
        return cls(samples, every if samples else 1, steps % every or None)


def _rollout_batch(
    model: Model,
    state: State,
    wrench,
    length: Length,
    ask=None,
    blocks: tuple[int, ...] = (),
    truncate: int | None = None,
    safe: bool = False,
    nudge=None,
) -> tuple[State, State]:
    """Final state and trajectory.

    Args:
      wrench: of all steps, or with ``ask`` what ``ask(model, state, *wrench) -> Wrench`` takes.
      blocks, truncate: as in ``rollout``.
      safe: see ``_from_start``.
      nudge: (function (p, world, d) -> world, tree of d with an axis of samples in front): what happens to the world
        of each sample.
    """
    batch = batch_of(model, state.batch_shape)
    run = lambda model, state: _loop(model, state, batch, wrench, length, ask, blocks, truncate, nudge)
    return _from_start(run, model, state, batch, safe)


def _loop(model, state, batch, wrench, length, ask, blocks, truncate, nudge):
    samples, every, rest, parts = length
    p, world = enter(model, state, batch, parts, control=wrench)
    dtype = state.x.x.dtype
    hot = None if ask is not None else _hot_wrench(wrench, batch, dtype)

    def controlled(p, world, _, model, closed):
        seen = leave(model, p, world, batch)
        return substeps(model, p, world, _hot_wrench(ask(model, seen, *closed), batch, dtype))

    def one_step(world, cut):
        if cut is not None:
            world = jax.tree.map(lambda c: jnp.where(cut, jax.lax.stop_gradient(c), c), world)
        if ask is not None:
            return held(controlled, p, world, None, model, wrench)[0], None
        return advance(model, p, world, hot), None

    def run(world, cuts, count, blocks):
        """``count`` steps."""
        while blocks and blocks[0] >= count:
            blocks = blocks[1:]
        if blocks:
            return _in_blocks(run, world, cuts, count, blocks[0], blocks[1:])
        if ask is None and cuts is None:
            single = isinstance(count, int) and count == 1
            if loops_are_cheap() and model.structure.uncoupled and not single:
                return advance_in_blocks(model, p, world, hot, count), None
            once = _advance(model.structure, model.method)
            return repeated(once, world, p, hot, worlds=math.prod(batch), count=count), None
        if count == 1:
            return one_step(world, None if cuts is None else cuts[0])
        return jax.lax.scan(one_step, world, cuts, length=count)[0], None

    def interval(world, x, blocks):
        """The steps to the next sample."""
        cuts, change = x
        world = run(world, cuts, every, blocks)[0]
        if nudge is not None:
            world = nudge[0](p, world, change)
        return world, _sample(model, p, world)

    def sampled(world, xs, count, blocks):
        """The steps to the next ``count`` samples."""
        while blocks and blocks[0] // every >= count:
            blocks = blocks[1:]
        if count == 1:  # a loop around a loop takes twice as long to differentiate and to compile
            world, out = interval(world, jax.tree.map(lambda c: c[0], xs), blocks)
            return world, jax.tree.map(lambda c: c[None], out)
        if not blocks or blocks[0] < every:
            return jax.lax.scan(lambda world, x: interval(world, x, blocks), world, xs, length=count)
        return _in_blocks(sampled, world, xs, count, blocks[0] // every, blocks[1:])

    cuts = None
    if truncate is not None and truncate < samples * every + (rest or 0):
        cuts = np.arange(samples * every + (rest or 0)) % truncate == 0
        cuts[0] = False
    changes = None
    if nudge is not None:
        world = nudge[0](p, world, jax.tree.map(lambda c: c[0], nudge[1]))
        changes = jax.tree.map(lambda c: c[1:], nudge[1])
    first = _sample(model, p, world)
    later = None
    if samples:
        inside = None if cuts is None else cuts[: samples * every].reshape(samples, every)
        world, later = sampled(world, (inside, changes), samples, blocks)
    if rest is not None:
        world = run(world, None if cuts is None else cuts[samples * every :], rest, blocks)[0]

    def joined(a, b):
        """(k..., B) and (T, k..., B) -> (batch..., T + 1, k...)."""
        c = a[None] if b is None else jnp.concatenate([a[None], b])
        c = jnp.moveaxis(c, -1, 0)
        return c.reshape(*batch, *c.shape[1:])

    traj = jax.tree.map(lambda a: joined(a, None), first) if later is None else jax.tree.map(joined, first, later)
    return leave(model, p, world, batch), traj


def _in_blocks(run, world, xs, count: int, size: int, inner: tuple[int, ...]):
    """``run(world, xs, count, inner)`` in blocks of ``size`` that reverse mode computes again, and a shorter one.

    Only the world that enters a block is kept. Within a loop nothing else need be done for that: forward and reverse
    pass are two loops, between which XLA finds no common subexpressions. Outside one it would merge the block
    with what is to be computed again, and keep its intermediate values after all, hence ``prevent_cse``; inside that
    would only cost, as its barriers stop fusion.
    """
    whole = count // size
    fold = lambda c: jnp.reshape(c[: whole * size], (whole, size, *c.shape[1:]))
    block = lambda world, xs: run(world, xs, size, inner)
    if whole > 1:
        block = jax.checkpoint(block, prevent_cse=False)
        world, out = jax.lax.scan(block, world, jax.tree.map(fold, xs), length=whole)
        out = jax.tree.map(lambda c: c.reshape(-1, *c.shape[2:]), out)
    else:
        world, out = jax.checkpoint(block)(world, jax.tree.map(lambda c: c[:size], xs))
    rest = count - whole * size
    if rest:
        last = jax.checkpoint(lambda world, xs: run(world, xs, rest, inner))
        world, more = last(world, jax.tree.map(lambda c: c[whole * size :], xs))
        out = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), out, more)
    return world, out


def asked(model: Model, state: State, control):
    """``control`` as a function (model, state, *closed) that closes over no traced value, and what it closed over."""
    batch = batch_of(model, state.batch_shape)
    seen = jax.eval_shape(lambda model, state: leave(model, *enter(model, state, batch), batch), model, state)

    def checked(model, state):
        wrench = control(model, state)
        _check_wrench(model, state, wrench)
        return wrench

    return opened(checked, model, seen)


def _derived(direct, core):
    """``direct``, whose derivative is that of ``core``."""
    call = jax.custom_jvp(direct)

    def rule(primals, tangents):  # what does not change has no tangent: a gradient of the state costs none of the model
        values, changes, put, _ = moving(primals, tangents)

        def run(*values):
            model, state, *rest = put(values)
            return core(model, _touched(state, model, values), *rest)

        out, change = jax.jvp(run, values, changes)
        return _mapped_like(primals, out), change

    call.defjvp(rule, symbolic_zeros=True)
    return call


def _touched(state: State, model: Model, values) -> State:
    """``state``, of which JAX believes that all that a step changes depends on ``values``.

    It soon does. JAX differentiates the body of a loop once more each time that it finds another part of the carry to
    have a tangent, which is half the time that tracing the gradient of a stack takes.
    """
    some = next((c for c in values if c.size), None)
    if some is None:
        return state
    spark = jnp.ravel(some)[0]
    touch = lambda c: jnp.where(False, spark.astype(c.dtype), c) if jnp.issubdtype(c.dtype, jnp.floating) else c
    moved = ["x", "v"] + ["q", "w"] * model.structure.attitude + ["memory"] * (state.memory is not None)
    return state._with(**{k: jax.tree.map(touch, getattr(state, k)) for k in moved})


def _mapped_like(given, out):
    """``out``, mapped by every ``vmap`` that maps a part of ``given``.

    The batching rule of ``direct`` maps all results; JAX wants the same of the rule of its derivative, in which
    ``dt``, say, need not depend on what is mapped.
    """
    first = [jnp.ravel(c)[0] for c in jax.tree.leaves(given) if jnp.issubdtype(c.dtype, jnp.number) and c.size]
    never = functools.reduce(jnp.logical_or, (c != c for c in first)) & False
    return jax.tree.map(lambda c: jnp.where(never, c, c), out)


def _batched_call(core, derived=None):
    """``core(model, state, wrench)`` with a rule for vmap; derivatives are those of ``derived`` (None: ``core``)."""

    @jax.custom_batching.custom_vmap
    def direct(model, state, wrench):
        return core(model, state, wrench)

    call = _derived(direct, derived or core)

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
    for name, value in model.leaves():
        if not getattr(batched, name) and value.ndim > model.base_ndim(name):
            changes[name] = jnp.broadcast_to(value, (size, *value.shape))
    return model._with(**changes) if changes else model


def _in_tiles(core, model, state, wrench, counts):
    """``core(model, state, wrench, counts)``, a batch of worlds cut into tiles."""
    return tiled(core, model, state, wrench, counts, batch_of(model, state.batch_shape))


def _forward(model: Model, state: State, wrench: Wrench | None, steps: int, every: int, traced: bool = False):
    """``core`` and ``args``: ``core(*args)`` is the rollout, not to be differentiated.

    Numbers of steps and of substeps are arguments where the call is made rather than traced, so that one program serves
    all; not a single substep, nor single steps between several samples. Not on a GPU, which asks the host before each
    turn of a loop whose end it is not told before.
    """
    length, open_ = Length.of(steps, every), {}
    if on_cpu() and not traced:
        if length.every > 1 or length.samples == 1:
            open_["every"] = length.every
        if length.rest is not None:
            open_["rest"] = length.rest
        if model.method.substeps > 1:
            open_["substeps"] = model.method.substeps
            model = model.with_open_substeps
    core = _core(length._replace(**dict.fromkeys(open_)))
    return core, (model, state, wrench, {name: np.int32(count) for name, count in open_.items()})


@functools.cache
def _core(length: Length):
    """``core(model, state, wrench, counts)`` of a rollout, counts: numbers in the place of those of ``length``."""

    def core(model, state, wrench, counts):
        return _rollout_batch(model, with_memory(model, state), wrench, length._replace(**counts))

    return core


@jax.jit
def _step(model, state, wrench):
    one = lambda model, state, wrench, _: _step_batch(model, state, wrench)
    call = _batched_call(functools.partial(_in_tiles, one, counts={}), functools.partial(_step_batch, safe=True))
    return call(model, with_memory(model, state), wrench)


@functools.partial(jax.jit, static_argnums=3)
def _differentiated_step(model, state, wrench, changing: int):
    """``_step``, as ``_differentiated`` is a rollout."""
    return _step_batch(model, _changing(model, state, wrench, changing), wrench, safe=True)


@functools.partial(jax.jit, static_argnums=(3, 4, 5, 6))
def _rollout(model, state, wrench, steps, every, blocks, truncate):
    length = Length.of(steps, every)
    direct = functools.partial(_in_tiles, _core(length), counts={})
    call = _batched_call(direct, functools.partial(_safe_rollout, length, blocks, truncate))
    return call(model, with_memory(model, state), wrench)


def _safe_rollout(length, blocks, truncate, model, state, wrench):
    return _rollout_batch(model, state, wrench, length, blocks=blocks, truncate=truncate, safe=True)


@functools.partial(jax.jit, static_argnums=(3, 4, 5, 6, 7))
def _differentiated(model, state, wrench, steps, every, blocks, truncate, changing: int):
    """``_rollout`` of which a derivative is being taken, with respect to leaf ``changing`` of (model, state, wrench)
    and perhaps others; JAX would trace the program that is not differentiated as well, which takes as long.
    """
    state = _changing(model, state, wrench, changing)
    return _safe_rollout(Length.of(steps, every), blocks, truncate, model, state, wrench)


def _changing(model, state, wrench, number: int) -> State:
    """``state`` with memory, as ``_touched`` by leaf ``number`` of (model, state, wrench)."""
    return _touched(with_memory(model, state), model, jax.tree.leaves((model, state, wrench))[number : number + 1])


_here = jax.jit(_in_tiles, static_argnums=0)
_here_donated = jax.jit(_in_tiles, static_argnums=0, donate_argnums=2)


@functools.partial(jax.jit, static_argnums=(2, 3, 4, 5, 6))
def _rollout_with(model, state, steps, every, control, blocks, truncate):
    state = with_memory(model, state)
    ask, closed = asked(model, state, control)
    core = functools.partial(_rollout_batch, length=Length.of(steps, every), ask=ask)
    return _derived(core, functools.partial(core, blocks=blocks, truncate=truncate, safe=True))(model, state, closed)


def program(model: Model, state: State, steps: int, every: int):
    """The compiled program of ``rollout(model, state, steps, every)``, how many run at once, and what they give.

    model, state: arrays or their shapes.
    """
    batch = state.batch_shape
    core, args = _forward(model, state, None, steps, every)
    parts = means(core, args, batch, steps).cores
    lowered = lowered_share(core, *args, batch, parts) if parts > 1 else _here.lower(core, *args)
    # not the shape of ``core`` by itself: JAX would keep that trace, of kernels, and put it into the one function
    return lowered.compile(), parts, _here.eval_shape(core, *args)
