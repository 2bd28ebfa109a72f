"""Gymnasium: a single environment, and a vector environment that runs as one program.

>>> from rbd_jax.learn import make
>>> from rbd_jax.learn.adapters.gymnasium import SingleEnv, VectorEnv
>>> envs = VectorEnv(make("push"), 256)  # doctest: +SKIP
"""

from __future__ import annotations

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ..environment import AutoReset, Environment, where


def spaces(task: Environment) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """(observations, actions)."""
    box = lambda low, n: gymnasium.spaces.Box(-low, low, (n,), np.float32)
    return box(np.inf, task.observation_size), box(1.0, task.action_size)


def _host(tree):
    return jax.tree.map(np.array, tree)  # copies: what the caller keeps is the caller's


class SingleEnv(gymnasium.Env):
    """One world of a task. ``reset(seed=...)`` gives the same episode for the same seed."""

    metadata = {"render_modes": []}

    def __init__(self, task: Environment):
        self.task = task
        self.observation_space, self.action_space = spaces(task)
        self._reset, self._step = jax.jit(task.reset), jax.jit(task.step)
        self._state = None

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        super().reset(seed=seed)
        key = jax.random.key(int(self.np_random.integers(2**31)))
        self._state, obs = self._reset(key)
        return np.array(obs, np.float32), {}

    def step(self, action):
        """
        Raises:
          gymnasium.error.ResetNeeded: before the first ``reset``.
          ValueError: an action of the wrong shape or not finite.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        action = self.task.check(np.asarray(action))
        self._state, out = self._step(self._state, action)
        info = {name: value.item() for name, value in _host(out.info).items()}
        return (
            np.array(out.obs, np.float32), float(out.reward), bool(out.terminated), bool(out.truncated), info,
        )  # fmt: skip


class VectorEnv(gymnasium.vector.VectorEnv):
    """Many worlds of a task in one program.

    autoreset: ``SAME_STEP``: an episode that ends is begun anew in the same step, with what ended it in
    ``info["final_obs"]`` and ``info["final_info"]``; ``NEXT_STEP``, Gymnasium's own habit: in the next step, whose
    action is ignored and whose reward is 0.
    """

    def __init__(self, task: Environment, num_envs: int, autoreset: AutoresetMode = AutoresetMode.SAME_STEP):
        if not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise ValueError(f"num_envs = {num_envs!r} must be an integer >= 1")
        if autoreset not in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP):
            raise ValueError(f"autoreset = {autoreset!r} must be SAME_STEP or NEXT_STEP")
        self.task, self.num_envs, self._mode = task, int(num_envs), autoreset
        self.metadata = {"render_modes": [], "autoreset_mode": autoreset}
        self.single_observation_space, self.single_action_space = spaces(task)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        same = autoreset == AutoresetMode.SAME_STEP
        self._reset = jax.jit(jax.vmap(task.reset))
        self._step = jax.jit(jax.vmap(AutoReset(task).step if same else self._next))
        self._state, self._ended = None, np.zeros(self.num_envs, bool)

    def _next(self, state, action, ended):
        """A step, or the start of the next episode where the last one has ended."""
        fresh, obs = self.task.reset(state.key)
        state, out = self.task.step(state, action)
        nothing = jax.tree.map(lambda c: jax.numpy.zeros_like(c), out)._with(obs=obs, final_obs=obs)
        return where(ended, fresh, state), where(ended, nothing, out)

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict | None = None):
        """Fresh episodes of all worlds, or of those in ``options["reset_mask"]``. seed: one, or one a world."""
        many = isinstance(seed, (list, tuple, np.ndarray))
        if many and len(seed) != self.num_envs:
            raise ValueError(f"seed has {len(seed)} entries, there are {self.num_envs} environments")
        super().reset(seed=None if many else seed)
        drawn = self.np_random.integers(2**31, size=self.num_envs)
        numbers = [d if s is None else s for s, d in zip(seed, drawn)] if many else drawn
        state, obs = self._reset(jax.vmap(jax.random.key)(np.asarray(numbers, np.uint32)))
        mask = (options or {}).get("reset_mask")
        if mask is not None and self._state is not None:
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != bool:
                raise ValueError(f"reset_mask must be {self.num_envs} booleans, got {mask.dtype} {mask.shape}")
            state, obs = where(mask, state, self._state), np.where(mask[:, None], obs, self._obs)
            self._ended = self._ended & ~mask
        else:
            self._ended = np.zeros(self.num_envs, bool)
        self._state, self._obs = state, np.array(obs, np.float32)
        return self._obs.copy(), {}

    def step(self, actions):
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        actions = self.task.check(np.asarray(actions), (self.num_envs,))
        if self._mode == AutoresetMode.SAME_STEP:
            self._state, out = self._step(self._state, actions)
        else:
            self._state, out = self._step(self._state, actions, self._ended)
        out = _host(out)
        self._ended = out.terminated | out.truncated
        self._obs = out.obs.astype(np.float32)
        info = {}
        every = np.ones(self.num_envs, bool)
        for name, value in out.info.items():
            info[name], info[f"_{name}"] = value, every
        if self._mode == AutoresetMode.SAME_STEP and self._ended.any():
            ended = self._ended.copy()
            final = np.full(self.num_envs, None, object)
            for k in np.flatnonzero(ended):
                final[k] = out.final_obs[k].astype(np.float32)
            last = {}
            for name, value in out.info.items():
                last[name], last[f"_{name}"] = np.where(ended, value, 0), ended
            info |= {"final_obs": final, "_final_obs": ended, "final_info": last, "_final_info": ended}
        return self._obs.copy(), out.reward.astype(np.float64), out.terminated.copy(), out.truncated.copy(), info
