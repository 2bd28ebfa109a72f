"""What both learners share: advantages, returns, the loop on the host, and what a policy is worth."""

from __future__ import annotations

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np

from .environment import Environment, Step, unroll


@dataclasses.dataclass(frozen=True)
class Progress:
    """After an iteration: simulated control steps, wall seconds (without those to compile), mean return of the
    episodes that ended (NaN if none did) and their number; whether its gradient was not finite and left out."""

    iteration: int
    steps: int
    seconds: float
    mean_return: float
    episodes: int
    lost_gradient: int = 0


def advantages(reward, value, after, terminated, done, discount, trace):
    """Generalised advantages, time axis first. ``after``: value of the state that a step led to, before any restart."""
    delta = reward + discount * jnp.where(terminated, 0.0, after) - value

    def back(gain, x):
        delta, done = x
        gain = delta + discount * trace * jnp.where(done, 0.0, gain)
        return gain, gain

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, done), reverse=True)[1]


def tally(ran, out: Step):
    """Return so far of the episodes that run, and the sum of those that ended in (time, worlds) steps."""

    def one(ran, x):
        reward, done = x
        ran = ran + reward
        return jnp.where(done, 0.0, ran), jnp.where(done, ran, 0.0)

    ran, ended = jax.lax.scan(one, ran, (out.reward, out.done))
    return ran, {"return": ended.sum(), "episodes": out.done.sum()}


def go_on(iterate, learner, each: int, seconds, steps, report):
    """``iterate(learner) -> (learner, numbers)`` until time or steps are used up; ``each``: steps of an iteration."""
    if seconds is None and steps is None:
        raise ValueError("train: give seconds, steps, or both; else it has no end")
    run = jax.jit(iterate).lower(learner).compile()
    history, clock = [], time.perf_counter()
    while True:
        learner, numbers = run(learner)
        numbers = jax.device_get(numbers)
        k, episodes = int(learner.iteration), int(numbers["episodes"])
        mean = float(numbers["return"]) / episodes if episodes else float("nan")
        lost = int(numbers.get("lost_gradients", 0))
        history.append(Progress(k, k * each, time.perf_counter() - clock, mean, episodes, lost))
        if report is not None:
            report(history[-1])
        out_of_time = seconds is not None and history[-1].seconds >= seconds
        if out_of_time or (steps is not None and history[-1].steps >= steps):
            return learner, history


def evaluate(task: Environment, policy, key: jax.Array, episodes: int = 256) -> np.ndarray:
    """(episodes,) returns of one whole episode each; policy: (observations, key) -> actions."""
    begin, act = jax.random.split(key)

    @jax.jit
    def run(begin, act):
        state = jax.vmap(task.reset)(jax.random.split(begin, episodes))[0]
        _, (_, _, out) = unroll(task, policy, state, task.episode, act)
        alive = jnp.cumsum(out.terminated, 0) - out.terminated == 0  # up to the step that ended it
        return (out.reward * alive).sum(0)

    return np.asarray(run(begin, act))


def at_random(task: Environment):
    """The policy to beat: uniform actions."""
    return lambda obs, key: jax.random.uniform(key, (obs.shape[0], task.action_size), minval=-1.0)
