"""Layer 8: the memory of a rollout, from its compiled program, before it is run."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from .memory import MemoryEstimate, available, bytes_of
from .model import Model
from .rollout import program
from .spatial import Quat, Vec3
from .state import Kinematic, State


def memory_estimate(model: Model, batch: int | tuple[int, ...], steps: int, every: int = 1) -> MemoryEstimate:
    """Memory of ``rollout(model, state, steps, every)`` for this many worlds.

    Compiles the program (seconds) and runs nothing.

    Raises:
      ValueError: batch, steps or every is not a positive integer.
    """
    batch = batch if isinstance(batch, tuple) else (batch,)
    for name, values in (("batch", batch), ("steps", (steps,)), ("every", (every,))):
        for value in values:
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"memory_estimate: {name} = {value!r} must be an integer >= 1")
    worlds = math.prod(batch)
    state = jax.eval_shape(lambda: blank(model, batch))
    abstract = jax.tree.map(lambda c: jax.ShapeDtypeStruct(c.shape, c.dtype), model)
    compiled, parts, out = program(abstract, state, steps, every)
    plan = compiled.memory_analysis()
    arguments, results = bytes_of((model, state)), bytes_of(out)
    work = parts * plan.temp_size_in_bytes
    copies = results if parts > 1 else 0
    peak = arguments + results + max(work, copies)  # the work is done when the results are put together
    return MemoryEstimate(arguments, results, work, copies, peak, peak / worlds, available())


def blank(model: Model, batch: tuple[int, ...]) -> State:
    """A state of zeros with the leaves of this model's states, without memory."""
    dtype = model.mass.dtype
    vector = lambda n: Vec3(*(jnp.zeros((*batch, n), dtype) for _ in range(3)))
    quat = lambda n: Quat(*(jnp.zeros((*batch, n), dtype) for _ in range(4)))
    k = len(model.names.kinematic)
    moving = Kinematic(vector(k), quat(k), vector(k), vector(k)) if k else None
    n, each = model.n, lambda kind: jnp.zeros(batch, kind)
    return State(vector(n), vector(n), quat(n), vector(n), each(jnp.int32), each(jnp.uint32), each(dtype), moving)
