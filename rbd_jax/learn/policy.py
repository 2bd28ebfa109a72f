"""A small policy: normalised observations through a perceptron; numbers in plain dicts and tuples."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..struct import struct


@struct
class Normaliser:
    """Running mean and variance of observations (Welford's, merged batch by batch: Chan, Golub and LeVeque 1979)."""

    count: jax.Array
    mean: jax.Array
    m2: jax.Array

    def __call__(self, obs):
        spread = jnp.sqrt(self.m2 / jnp.maximum(self.count, 1.0) + 1e-6)
        return jnp.clip((obs - self.mean) / jnp.where(self.count > 1, spread, 1.0), -10.0, 10.0)

    def merged(self, obs) -> Normaliser:
        """With the observations (..., k) added."""
        obs = obs.reshape(-1, obs.shape[-1])
        n, mean = obs.shape[0], obs.mean(0)
        total = self.count + n
        off = mean - self.mean
        m2 = self.m2 + ((obs - mean) ** 2).sum(0) + off**2 * self.count * n / total
        return Normaliser(total, self.mean + off * n / total, m2)


def normaliser(size: int) -> Normaliser:
    return Normaliser(jnp.zeros(()), jnp.zeros(size), jnp.zeros(size))


def perceptron(key: jax.Array, sizes: tuple[int, ...], last: float) -> list[dict]:
    """Orthogonal weights, those of the last layer times ``last``."""
    layers = []
    for k, (a, b) in enumerate(zip(sizes, sizes[1:])):
        key, draw = jax.random.split(key)
        gain = last if k == len(sizes) - 2 else 2.0**0.5
        layers.append({"w": jax.nn.initializers.orthogonal(gain)(draw, (a, b)), "b": jnp.zeros(b)})
    return layers


def apply(layers: list[dict], x: jax.Array) -> jax.Array:
    for layer in layers[:-1]:
        x = jnp.tanh(x @ layer["w"] + layer["b"])
    return x @ layers[-1]["w"] + layers[-1]["b"]


@struct
class Policy:
    """What was learned: ``policy(obs)`` is the action in [-1, 1]; ``policy.sample(obs, key)`` explores."""

    seen: Normaliser
    layers: list
    log_std: jax.Array

    def __call__(self, obs: jax.Array, key: jax.Array | None = None) -> jax.Array:
        return jnp.clip(apply(self.layers, self.seen(obs)), -1.0, 1.0)

    def sample(self, obs: jax.Array, key: jax.Array) -> jax.Array:
        """Not clipped: the density is that of the Gaussian; the task clips."""
        mean = apply(self.layers, self.seen(obs))
        return mean + jnp.exp(self.log_std) * jax.random.normal(key, mean.shape)


def fresh(task, key: jax.Array, hidden: tuple[int, ...], std: float = 0.6) -> Policy:
    """A policy that does nothing yet but explore."""
    layers = perceptron(key, (task.observation_size, *hidden, task.action_size), 0.01)
    return Policy(normaliser(task.observation_size), layers, jnp.full(task.action_size, jnp.log(std)))


def log_density(layers, log_std, obs, action):
    """Of ``action`` under the Gaussian of normalised ``obs``."""
    z = (action - apply(layers, obs)) * jnp.exp(-log_std)
    return -0.5 * (z**2).sum(-1) - log_std.sum() - 0.5 * action.shape[-1] * jnp.log(2 * jnp.pi)
