"""Learning through the simulator: the gradient of the return itself, short horizon by short horizon.

The loss of an iteration is minus the discounted reward of a window of steps from where the worlds are, plus a value
of what follows if there is a critic (SHAC; Xu et al. 2022, eq. 4). ``jax.grad`` goes through policy, task and engine.
Restarts are not differentiated.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from ..struct import struct
from .environment import AutoReset, Environment, EnvState
from .policy import Policy, apply, fresh, perceptron
from .training import Progress, advantages, go_on, tally


@dataclasses.dataclass(frozen=True)
class Through:
    """Settings: as those of :class:`PPO`; ``critic_steps`` of gradient descent on the value an iteration."""

    worlds: int = 64
    unroll: int = 16
    rate: float = 5e-3
    critic_rate: float = 5e-3
    critic_steps: int = 8
    discount: float = 0.97
    trace: float = 0.95
    largest_gradient: float = 1.0
    std: float = 0.1
    hidden: tuple[int, ...] = (64, 64)


@struct
class Learner:
    """Everything that learning carries on."""

    policy: Policy
    critic: list
    moments: tuple
    worlds: EnvState
    key: jax.Array
    ran: jax.Array
    iteration: jax.Array


def _optimisers(s: Through):
    import optax

    clip = optax.clip_by_global_norm(s.largest_gradient)
    return optax.chain(clip, optax.adam(s.rate, b1=0.7)), optax.chain(clip, optax.adam(s.critic_rate))


def begin(task: Environment, key: jax.Array, settings: Through) -> Learner:
    key, worlds, actor, critic = jax.random.split(key, 4)
    policy = fresh(task, actor, settings.hidden, settings.std)
    values = perceptron(critic, (task.observation_size, *settings.hidden, 1), 1.0)
    state = jax.vmap(AutoReset(task).reset)(jax.random.split(worlds, settings.worlds))[0]
    of_actor, of_critic = _optimisers(settings)
    moments = of_actor.init(policy.layers), of_critic.init(values)
    return Learner(policy, values, moments, state, key, jnp.zeros(settings.worlds), jnp.int32(0))


def window(layers, learner: Learner, task: Environment, key, s: Through):
    """Minus the mean return of a window, and what happened in it."""
    policy, auto = learner.policy._with(layers=layers), AutoReset(task)
    value = lambda obs: apply(learner.critic, learner.policy.seen(obs))[..., 0]
    state = jax.tree.map(jax.lax.stop_gradient, learner.worlds)
    obs = jax.vmap(task.observe)(state.sim, state.goal)

    def one(carry, key):
        state, obs, weight, total = carry
        state, out = jax.vmap(auto.step)(state, policy.sample(obs, key))
        after = jnp.where(out.terminated, 0.0, value(out.final_obs))
        total = total + weight * (out.reward + jnp.where(out.done, s.discount * after, 0.0))
        weight = jnp.where(out.done, 1.0, weight * s.discount)
        return (state, out.obs, weight, total), (obs, out)

    ones = jnp.ones(s.worlds)
    carry = state, obs, ones, 0 * ones
    (state, obs, weight, total), seen = jax.lax.scan(one, carry, jax.random.split(key, s.unroll))
    total = total + weight * value(obs)
    return -total.mean() / s.unroll, (state, seen)


def iterate(learner: Learner, task: Environment, settings: Through) -> tuple[Learner, dict]:
    """One iteration; the numbers of the episodes that ended in it."""
    s = settings
    of_actor, of_critic = _optimisers(s)
    key, explore = jax.random.split(learner.key)
    slope, (worlds, (obs, out)) = jax.grad(window, has_aux=True)(learner.policy.layers, learner, task, explore, s)
    good = jnp.isfinite(sum(jnp.abs(c).sum() for c in jax.tree.leaves(slope)))
    slope = jax.tree.map(lambda c: jnp.where(good, c, 0.0), slope)  # counted below, not hidden
    actor, critic = learner.moments
    change, actor = of_actor.update(slope, actor)
    layers = jax.tree.map(jnp.add, learner.policy.layers, change)
    view = learner.policy.seen
    before, after = (apply(learner.critic, view(o))[..., 0] for o in (obs, out.final_obs))
    target = before + advantages(out.reward, before, after, out.terminated, out.done, s.discount, s.trace)
    miss = lambda weights: ((apply(weights, view(obs))[..., 0] - target) ** 2).mean()

    def descend(carry, _):
        weights, moments = carry
        change, moments = of_critic.update(jax.grad(miss)(weights), moments)
        return (jax.tree.map(jnp.add, weights, change), moments), None

    (values, critic), _ = jax.lax.scan(descend, (learner.critic, critic), length=s.critic_steps)

    ran, numbers = tally(learner.ran, out)
    policy = learner.policy._with(seen=view.merged(obs), layers=layers)
    numbers["lost_gradients"] = ~good
    return Learner(policy, values, (actor, critic), worlds, key, ran, learner.iteration + 1), numbers


def train(
    task: Environment,
    key: jax.Array,
    settings: Through = Through(),
    seconds: float | None = None,
    steps: int | None = None,
    learner: Learner | None = None,
    report: Callable[[Progress], None] | None = None,
) -> tuple[Learner, list[Progress]]:
    """As :func:`rbd_jax.learn.ppo.train`."""
    learner = begin(task, key, settings) if learner is None else learner
    once = functools.partial(iterate, task=task, settings=settings)
    return go_on(once, learner, settings.worlds * settings.unroll, seconds, steps, report)
