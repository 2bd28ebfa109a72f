"""Gymnax's interface, for trainers in the manner of purejaxrl: ``obs, state, reward, done, info``.

gymnax 1.0 gives ``terminated`` and ``truncated`` apart instead of ``done``: ``GymnaxEnv(task, outputs=6)``.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from ..environment import AutoReset, Environment, as_kind_of


@dataclasses.dataclass(frozen=True)
class Space:
    """Numbers in [low, high]."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: type = jnp.float32

    def sample(self, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, self.shape, self.dtype, max(self.low, -1e3), min(self.high, 1e3))

    def contains(self, x) -> jax.Array:
        return jnp.logical_and((x >= self.low).all(), (x <= self.high).all())


class GymnaxEnv:
    """A task with gymnax's ``reset(key, params)`` and ``step(key, state, action, params)``; episodes restart by
    themselves, ``info["final_obs"]`` is what ended one. ``params`` is not used: worlds are randomised by the task."""

    default_params = None

    def __init__(self, task: Environment, outputs: int = 5):
        if outputs not in (5, 6):
            raise ValueError(f"outputs = {outputs!r} must be 5 or 6")
        self.task, self.outputs, self._auto = task, outputs, AutoReset(task)

    @property
    def name(self) -> str:
        return self.task.name

    @property
    def num_actions(self) -> int:
        return self.task.action_size

    def reset(self, key, params=None):
        state, obs = self.task.reset(key)
        return obs, state

    def step(self, key, state, action, params=None):
        """key: makes the next start, if this step ends the episode."""
        state, out = self._auto.step(state._with(key=as_kind_of(key, state.key)), action)
        info = {**out.info, "final_obs": out.final_obs, "discount": 1.0 - out.terminated.astype(out.obs.dtype)}
        if self.outputs == 6:
            return out.obs, state, out.reward, out.terminated, out.truncated, info
        return out.obs, state, out.reward, out.done, info

    def observation_space(self, params=None) -> Space:
        return Space(-np.inf, np.inf, (self.task.observation_size,))

    def action_space(self, params=None) -> Space:
        return Space(-1.0, 1.0, (self.task.action_size,))
