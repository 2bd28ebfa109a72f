"""Proximal policy optimisation (Schulman et al. 2017, eq. 7) with generalised advantages (Schulman et al. 2016).

An iteration, worlds and network, is one compiled program. An episode that the clock cuts off is worth the value of
what it ended with; one that is over is worth nothing more.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from ..struct import struct
from .environment import AutoReset, Environment, EnvState, unroll
from .policy import Policy, apply, fresh, log_density, perceptron
from .training import Progress, advantages, go_on, tally


@dataclasses.dataclass(frozen=True)
class PPO:
    """Settings. worlds times unroll steps are an iteration; the discount is that of a control step."""

    worlds: int = 256
    unroll: int = 32
    epochs: int = 6
    minibatches: int = 4
    rate: float = 2e-3
    discount: float = 0.97
    trace: float = 0.95
    clip: float = 0.2
    entropy: float = 1e-3
    value: float = 0.5
    largest_gradient: float = 0.5
    hidden: tuple[int, ...] = (64, 64)

    def __post_init__(self):
        for field in ("worlds", "unroll", "epochs", "minibatches"):
            value = getattr(self, field)
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"PPO: {field} = {value!r} must be an integer >= 1")
        if self.worlds * self.unroll % self.minibatches:
            raise ValueError(
                f"PPO: minibatches = {self.minibatches} must divide worlds x unroll = {self.worlds * self.unroll}"
            )


@struct
class Learner:
    """Everything that learning carries on: save it and go on with it."""

    policy: Policy
    critic: list
    optimiser: tuple
    worlds: EnvState
    key: jax.Array
    ran: jax.Array  # return so far of the episode that runs in each world
    iteration: jax.Array


def _optimiser(settings: PPO):
    import optax

    return optax.chain(optax.clip_by_global_norm(settings.largest_gradient), optax.adam(settings.rate, eps=1e-5))


def begin(task: Environment, key: jax.Array, settings: PPO) -> Learner:
    key, worlds, actor, critic = jax.random.split(key, 4)
    policy = fresh(task, actor, settings.hidden)
    values = perceptron(critic, (task.observation_size, *settings.hidden, 1), 1.0)
    state = jax.vmap(AutoReset(task).reset)(jax.random.split(worlds, settings.worlds))[0]
    weights = (policy.layers, policy.log_std, values)
    return Learner(policy, values, _optimiser(settings).init(weights), state, key, jnp.zeros(settings.worlds),
                   jnp.int32(0))  # fmt: skip


def loss(weights, batch, settings: PPO):
    """Clipped surrogate, squared error of the value, entropy."""
    layers, log_std, critic = weights
    ratio = jnp.exp(log_density(layers, log_std, batch["obs"], batch["action"]) - batch["density"])
    gain = batch["gain"]
    gain = (gain - gain.mean()) / (gain.std() + 1e-8)
    surrogate = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - settings.clip, 1 + settings.clip) * gain).mean()
    miss = ((apply(critic, batch["obs"])[..., 0] - batch["target"]) ** 2).mean()
    return -surrogate + settings.value * 0.5 * miss - settings.entropy * log_std.sum()


def iterate(learner: Learner, task: Environment, settings: PPO) -> tuple[Learner, dict]:
    """One iteration; the numbers of the episodes that ended in it."""
    s, policy = settings, learner.policy
    key, explore, shuffle = jax.random.split(learner.key, 3)
    worlds, (obs, action, out) = unroll(AutoReset(task), policy.sample, learner.worlds, s.unroll, explore)
    view = policy.seen  # of the data that the policy acted on
    value, after = (apply(learner.critic, view(o))[..., 0] for o in (obs, out.final_obs))
    gain = advantages(out.reward, value, after, out.terminated, out.done, s.discount, s.trace)
    data = {
        "obs": view(obs), "action": action, "gain": gain, "target": gain + value,
        "density": log_density(policy.layers, policy.log_std, view(obs), action),
    }  # fmt: skip
    data = jax.tree.map(lambda c: c.reshape(-1, *c.shape[2:]), data)
    optimiser = _optimiser(s)

    def minibatch(carry, rows):
        weights, moments = carry
        slope = jax.grad(loss)(weights, jax.tree.map(lambda c: c[rows], data), s)
        change, moments = optimiser.update(slope, moments)
        return (jax.tree.map(jnp.add, weights, change), moments), None

    count = s.worlds * s.unroll
    rows = jnp.concatenate(
        [jax.random.permutation(k, count).reshape(s.minibatches, -1) for k in jax.random.split(shuffle, s.epochs)]
    )
    weights = (policy.layers, policy.log_std, learner.critic)
    (weights, moments), _ = jax.lax.scan(minibatch, (weights, learner.optimiser), rows)
    layers, log_std, critic = weights

    ran, numbers = tally(learner.ran, out)
    policy = Policy(view.merged(obs), layers, log_std)
    return Learner(policy, critic, moments, worlds, key, ran, learner.iteration + 1), numbers


def train(
    task: Environment,
    key: jax.Array,
    settings: PPO = PPO(),
    seconds: float | None = None,
    steps: int | None = None,
    learner: Learner | None = None,
    report: Callable[[Progress], None] | None = None,
) -> tuple[Learner, list[Progress]]:
    """Learn until the time or the steps are used up.

    Args:
      seconds: wall time, that to compile apart. steps: control steps of all worlds together. At least one is given.
      learner: what an earlier call returned; then ``key`` is not used. report: is told of every iteration.

    Returns:
      The learner, whose ``policy`` acts, and the progress.

    Raises:
      ValueError: no end given. ModuleNotFoundError: optax is not installed (``pip install 'rbd-jax[rl]'``).
    """
    learner = begin(task, key, settings) if learner is None else learner
    once = functools.partial(iterate, task=task, settings=settings)
    return go_on(once, learner, settings.worlds * settings.unroll, seconds, steps, report)
