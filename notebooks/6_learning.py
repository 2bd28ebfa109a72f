# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 6. Learning a policy
#
# A task is two pure functions of one world, `reset(key)` and `step(state, action)`; `jax.vmap` makes a batch of them.
# Here a ball is pushed to a target by a horizontal force.

# %%
import os

import jax
import matplotlib.pyplot as plt
import numpy as np

from rbd_jax.learn import make, ppo, through, training
from rbd_jax.record import clip

SMALL = bool(os.environ.get("RBD_JAX_SMALL"))
task = make("push")
state, obs = jax.vmap(task.reset)(jax.random.split(jax.random.key(0), 4))
state, out = jax.vmap(task.step)(state, np.zeros((4, task.action_size), np.float32))
print("seen", out.obs.shape, "earned", out.reward, "over", out.terminated, "cut off", out.truncated)

# %% [markdown]
# What chance earns, in 256 episodes:

# %%
chance = training.evaluate(task, training.at_random(task), jax.random.key(9)).mean()
print(f"{chance:.1f}")

# %% [markdown]
# ## Proximal policy optimisation
#
# Worlds, network and update are one compiled program.

# %%
learner, history = ppo.train(task, jax.random.key(0), steps=250_000 if SMALL else 600_000)
score = training.evaluate(task, learner.policy, jax.random.key(9)).mean()
print(f"{history[-1].steps} control steps in {history[-1].seconds:.1f} s: {score:.1f}")
assert score > chance / 2

# %% [markdown]
# ## Gradients through the simulator
#
# The simulator knows how the return depends on the action. Following that gradient takes far fewer steps.

# %%
other, short = through.train(task, jax.random.key(0), steps=30_000 if SMALL else 100_000)
straight = training.evaluate(task, other.policy, jax.random.key(9)).mean()
print(f"{short[-1].steps} control steps in {short[-1].seconds:.1f} s: {straight:.1f}")
assert straight > chance / 2

fig, axes = plt.subplots(1, 2, figsize=(9, 3), sharey=True)
for name, seen in (("PPO", history), ("through the simulator", short)):
    ended = [(p.steps, p.seconds, p.mean_return) for p in seen if p.episodes]
    steps, seconds, mean = np.array(ended).T
    axes[0].semilogx(steps, mean, "o-", ms=3, label=name)
    axes[1].plot(seconds, mean, "o-", ms=3, label=name)
axes[0].set(xlabel="control steps", ylabel="return of an episode")
axes[1].set(xlabel="wall time [s]")
for ax in axes:
    ax.axhline(chance, color="0.5", ls=":")
axes[0].legend()
plt.show()

# %% [markdown]
# ## What it does
#
# One episode of four worlds, played here.

# %%
begin = jax.vmap(task.reset)(jax.random.split(jax.random.key(3), 4))[0]


def watch(state):
    def one(state, _):
        action = jax.vmap(learner.policy)(jax.vmap(task.observe)(state.sim, state.goal))
        state, _ = jax.vmap(task.step)(state, action)
        return state, state.sim._with(memory=None)

    return jax.lax.scan(one, state, length=60)[1]


seen = jax.jit(watch)(begin)
trajectory = jax.tree.map(lambda c: np.moveaxis(np.asarray(c), 0, 1), seen)
clip(task.model, trajectory, title="pushed to a target", worlds=4)

# %%
targets = np.asarray(begin.goal["target"])
left = np.linalg.norm(trajectory.pos[:, -1, 0, :2] - targets, axis=-1)
print("distance left [m]:", np.round(left, 3))
assert np.median(left) < 0.5
