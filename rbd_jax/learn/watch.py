"""What a policy does, as a clip: for a page, a movie or a scene of another program (``rbd_jax.view``)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..checks import whole
from ..record import clip
from ..view import Clip
from .environment import Environment, where


def watch(task: Environment, policy, key: jax.Array, worlds: int = 4) -> Clip:
    """One episode in each of so many worlds, a sample a control step; a world whose episode is over stands still.

    Args:
      policy: (observations (B, k), key) -> actions (B, action_size), as learners return it.

    Raises:
      ValueError: worlds is not an integer >= 1.
    """
    if not whole(worlds, 1):
        raise ValueError(f"watch: worlds = {worlds!r} must be an integer >= 1")
    begin, act = jax.random.split(key)

    @jax.jit
    def run(begin, act):
        state, obs = jax.vmap(task.reset)(jax.random.split(begin, worlds))

        def one(carry, key):
            state, obs, over = carry
            new, out = jax.vmap(task.step)(state, policy(obs, key))
            state = where(over, state, new)
            return (state, out.final_obs, over | out.done), state.sim._with(memory=None)

        start = (state, obs, jnp.zeros(worlds, bool))
        end, later = jax.lax.scan(one, start, jax.random.split(act, task.episode))
        first = state.sim._with(memory=None)
        samples = jax.tree.map(lambda a, b: jnp.moveaxis(jnp.concatenate([a[None], b]), 0, 1), first, later)
        return samples, end[0].numbers

    samples, numbers = run(begin, act)
    return clip(task.model.replace(**numbers), samples, title=task.name, worlds=worlds)
