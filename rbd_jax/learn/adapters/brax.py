"""Brax's trainers: ``brax.training.agents.ppo.train(environment=BraxEnv(make("push")), ...)``.

What Brax wraps around it cuts the episodes off (its ``episode_length``) and restarts them, so ``done`` here is the
task's own end. Its wrappers need raw keys (``jax.random.PRNGKey``); this environment takes either kind.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from ...struct import struct
from ..environment import Environment, EnvState


@struct
class BraxState:
    """Brax's State: ``done`` is 0.0 or 1.0, ``metrics`` and ``info`` are dicts that wrappers write into."""

    pipeline_state: EnvState
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict
    info: dict

    def replace(self, **changes) -> BraxState:
        return dataclasses.replace(self, **changes)


class BraxEnv:
    """A task as Brax sees it. ``sys`` is the model, which Brax's domain randomisation reads and assigns."""

    backend = "rbd_jax"

    def __init__(self, task: Environment):
        self.task = task
        self.observation_size, self.action_size = task.observation_size, task.action_size

    @property
    def sys(self):
        return self.task.model

    @sys.setter
    def sys(self, model):
        self.task.model = model

    @property
    def unwrapped(self):
        return self

    @property
    def dt(self) -> float:
        return self.task.period

    def reset(self, rng: jax.Array) -> BraxState:
        state, obs = self.task.reset(rng)
        zero = jnp.zeros((), obs.dtype)
        seen = jax.eval_shape(self.task.step, state, jnp.zeros(self.action_size, obs.dtype))[1]
        return BraxState(state, obs, zero, zero, {name: zero for name in seen.info}, {})

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        inner, out = self.task.step(state.pipeline_state, action)
        metrics = {**state.metrics, **{name: value.astype(out.obs.dtype) for name, value in out.info.items()}}
        return state.replace(
            pipeline_state=inner, obs=out.obs, reward=out.reward, done=out.terminated.astype(out.obs.dtype),
            metrics=metrics,
        )  # fmt: skip


def mend_brax() -> None:
    """Give JAX back ``device_put_replicated``, which Brax 0.14.2 calls and JAX 0.10 took away."""
    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = lambda tree, devices: jax.tree.map(
            lambda leaf: jnp.stack([leaf] * len(devices)), tree
        )
