"""Layer 9: a task for a learner: reset and step as pure functions of one world; ``jax.vmap`` makes a batch of them.

A task says how it starts, what an action does, what is seen and what it is worth; ``reset`` and ``step`` are made of
that. Actions are in [-1, 1] and clipped to it, as Brax and Gymnasium do; what unit they have is the task's to say.
"""

from __future__ import annotations

import abc
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..build import build
from ..checks import whole
from ..method import Method
from ..model import Model
from ..rollout import rollout
from ..scene import Scene
from ..state import State, Wrench
from ..status import Status
from ..step import with_memory
from ..struct import struct


@struct
class EnvState:
    """What a step needs of the last one, of one world.

    sim: the bodies. goal: what the task drew when it began. numbers: leaves of the model that this world has for
    itself. steps: control steps since the start. key: makes the next start.
    """

    sim: State
    goal: dict
    numbers: dict
    steps: jax.Array
    key: jax.Array


@struct
class Step:
    """What a step shows the learner.

    obs: (k,) of the state that is handed on: of the next episode if this one has ended and is restarted.
    final_obs: (k,) after the step, before any restart. reward: (). terminated: the task is over, there is no future to
    value. truncated: cut off by the clock alone, so that what follows is worth the value of ``final_obs``.
    info: a dict of numbers: ``status``, the :class:`rbd_jax.Status` bits of the world, and the task's own.
    """

    obs: jax.Array
    final_obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    info: dict

    done = property(lambda s: s.terminated | s.truncated)


class Environment(abc.ABC):
    """A task.

    A subclass has the four methods of a task and these numbers:

    Attributes:
      name: of the task. observation_size, action_size: lengths of the vectors.
      period: [s] an action is held. episode: control steps until it is cut off.
    """

    name: str
    observation_size: int
    action_size: int
    period: float = 0.05
    episode: int = 100
    substeps: int = 5

    def __init__(
        self,
        method: str | Method = "fast",
        substeps: int | None = None,
        episode: int | None = None,
        randomise: Callable[[jax.Array, Model], dict] | None = None,
    ):
        """
        Args:
          method: of the engine. substeps: steps of the engine to an action. episode: control steps.
          randomise: (key, model) -> leaves of the model for one world, as ``Model.replace`` takes them, drawn anew at
            every start, e.g. ``lambda key, model: {"mass": model.mass * jax.random.uniform(key, (), minval=0.5)}``.

        Raises:
          ValueError: substeps or episode < 1; a leaf that the model has not, or of another shape.
        """
        for field, value in (("substeps", substeps), ("episode", episode)):
            if value is None:
                continue
            if not whole(value, 1):
                raise ValueError(f"task '{self.name}': {field} = {value!r} must be an integer >= 1")
            setattr(self, field, int(value))
        self.model, start = build(self.scene(), dt=self.period / self.substeps, method=method)
        self.start = with_memory(self.model, start)
        self.randomise = randomise
        if randomise is not None:
            drawn = jax.eval_shape(lambda key: randomise(key, self.model), jax.random.key(0))
            if not isinstance(drawn, dict):
                raise ValueError(
                    f"task '{self.name}': randomise gives {type(drawn).__name__}, it needs a dict of leaves"
                )
            jax.eval_shape(lambda leaves: self.model.replace(**leaves), drawn)

    # --- the task ---

    @abc.abstractmethod
    def scene(self) -> Scene:
        """The bodies."""

    @abc.abstractmethod
    def begin(self, key: jax.Array) -> tuple[State, dict]:
        """A random start and its goal."""

    @abc.abstractmethod
    def act(self, sim: State, goal: dict, action: jax.Array) -> tuple[State, Wrench | None]:
        """What an action in [-1, 1] does: the state it acts on, and the wrench that is held for ``period``."""

    @abc.abstractmethod
    def observe(self, sim: State, goal: dict) -> jax.Array:
        """What the learner sees, numbers of order one."""

    @abc.abstractmethod
    def judge(self, before: State, sim: State, goal: dict, action: jax.Array) -> tuple[jax.Array, jax.Array, dict]:
        """Reward of a step, whether the task is over, and numbers worth keeping."""

    # --- what learners call ---

    def reset(self, key: jax.Array) -> tuple[EnvState, jax.Array]:
        """A fresh start: (state, observation). key: of either kind that JAX has."""
        key, begin, numbers = jax.random.split(key, 3)
        sim, goal = self.begin(begin)
        own = {} if self.randomise is None else dict(self.randomise(numbers, self.model))
        state = EnvState(sim, goal, own, jnp.int32(0), key)
        return state, self.observe(sim, goal)

    def step(self, state: EnvState, action: jax.Array) -> tuple[EnvState, Step]:
        """Hold an action for ``period``. A world that is lost ends the episode and says so in ``info["status"]``.

        Raises:
          ValueError: an action of another shape than (action_size,), or one that is not finite. While it is traced,
            JAX cannot look: such a world ends with the status NOT_FINITE.
        """
        action = self.check(action)
        model = self.model.replace(**state.numbers)
        moved, wrench = self.act(state.sim, state.goal, jnp.clip(action, -1.0, 1.0))
        sim = rollout(model, moved, self.substeps, every=self.substeps, control=wrench)[0]
        obs = self.observe(sim, state.goal)
        reward, over, info = self.judge(state.sim, sim, state.goal, action)
        lost = (sim.status & Status.NOT_FINITE) != 0
        steps = state.steps + 1
        over = over | lost
        out = Step(
            obs,
            obs,
            jnp.where(lost, 0.0, reward),
            over,
            (steps >= self.episode) & ~over,
            {**info, "status": sim.status},
        )
        return state._with(sim=sim, steps=steps), out

    def check(self, action, batch: tuple[int, ...] = ()) -> jax.Array:
        """``action`` as an array of the dtype of the model.

        Raises:
          ValueError: shape or value.
        """
        shape, want = jnp.shape(action), (*batch, self.action_size)
        if shape != want:
            raise ValueError(f"task '{self.name}': action has shape {shape}, it needs {want}")
        if not isinstance(action, jax.core.Tracer) and not np.isfinite(np.asarray(action)).all():
            raise ValueError(f"task '{self.name}': action = {np.asarray(action)} must be finite")
        return jnp.asarray(action, self.model.mass.dtype)


def is_typed(key) -> bool:
    return jnp.issubdtype(key.dtype, jax.dtypes.prng_key)


def as_kind_of(key: jax.Array, other: jax.Array) -> jax.Array:
    """``key`` as a raw or typed key, as ``other`` is."""
    if is_typed(key) == is_typed(other):
        return key
    return jax.random.key_data(key) if is_typed(key) else jax.random.wrap_key_data(key)


def where(mask: jax.Array, new, old):
    """Leaves of ``new`` where ``mask`` (batch axes), else of ``old``; keys of either kind are leaves too."""

    def pick(a, b):
        if is_typed(b):
            return jax.random.wrap_key_data(pick(*map(jax.random.key_data, (a, b))), impl=jax.random.key_impl(b))
        return jnp.where(jnp.reshape(mask, (*jnp.shape(mask), *(1,) * (b.ndim - jnp.ndim(mask)))), a, b)

    return jax.tree.map(pick, new, old)


class AutoReset:
    """A task that starts anew, from a fresh random start, in the step in which an episode ends.

    The observation that ended it is ``Step.final_obs``. With ``first`` a world returns to the start it began with.
    """

    def __init__(self, task: Environment, first: bool = False):
        self.task, self.first = task, first

    def __getattr__(self, name):
        if name.startswith("__") or "task" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.task, name)

    def reset(self, key: jax.Array) -> tuple[EnvState, jax.Array]:
        state, obs = self.task.reset(key)
        return (state._with(key=key) if self.first else state), obs

    def step(self, state: EnvState, action) -> tuple[EnvState, Step]:
        state, out = self.task.step(state, action)
        again, obs = self.task.reset(state.key)
        if self.first:
            again = again._with(key=state.key)  # draws the same once more
        return where(out.done, again, state), out._with(obs=where(out.done, obs, out.obs))


def unroll(task, policy, state: EnvState, steps: int, key: jax.Array):
    """Steps of a batch in one loop: (state, (observations before, actions, Steps)), each with the time axis first.

    policy: (observations (B, k), key) -> actions (B, action_size). state: of a batch, from ``jax.vmap(task.reset)``.
    """

    def one(carry, key):
        state, obs = carry
        action = policy(obs, key)
        state, out = jax.vmap(task.step)(state, action)
        return (state, out.obs), (obs, action, out)

    obs = jax.vmap(task.observe)(state.sim, state.goal)
    (state, _), seen = jax.lax.scan(one, (state, obs), jax.random.split(key, steps))
    return state, seen
