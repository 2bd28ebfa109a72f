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
# # 3. Batches and randomised worlds
#
# One program steps one world or a hundred thousand. A batch is a state with batch axes in front; a leaf of the
# model may
# have them too, and then every world has a number of its own, without another compilation.

# %%
import os
import time

import jax
import matplotlib.pyplot as plt
import numpy as np

import rbd_jax as rbd

SMALL = bool(os.environ.get("RBD_JAX_SMALL"))
WORLDS = 256 if SMALL else 4096

scene = rbd.Scene(
    bodies=[rbd.Body("box", rbd.Box((0.1, 0.1, 0.1)), pos=(0, 0, 0.1), vel=(3, 0, 0), mass=1.0, friction=0.5)],
    static=[rbd.Geom(rbd.Plane(), friction=0.5)],
    gravity=(0, 0, -9.81),
    dt=1 / 240,
)
model, state = rbd.build(scene, method="fast")

# %% [markdown]
# ## Every world its own friction
#
# A box that slides at $v$ stops after $v^2 / 2 \mu g$. Draw the coefficient for every world and look at where
# they stop.
# Two geoms touch with the larger of their coefficients, so both are set.

# %%
mu = jax.random.uniform(jax.random.key(0), (WORLDS,), minval=0.2, maxval=0.8)
worlds = model.replace(friction=mu[:, None] * np.ones(2, np.float32))
final, _ = rbd.rollout(worlds, rbd.batch(state, WORLDS), steps=720, every=720)
rbd.check(final)
way = np.asarray(final.pos[:, 0, 0])
closed = 3.0**2 / (2 * np.asarray(mu) * 9.81)
fig, ax = plt.subplots(figsize=(6, 3))
ax.plot(mu, way, ".", ms=2, label="simulated")
grid = np.linspace(0.2, 0.8)
ax.plot(grid, 9 / (2 * grid * 9.81), "k", lw=1, label=r"$v^2 / 2 \mu g$")
ax.set(xlabel="friction", ylabel="way [m]")
ax.legend()
plt.show()
print("largest relative error", np.abs(way / closed - 1).max())
assert np.abs(way / closed - 1).max() < 0.02

# %% [markdown]
# ## What a batch costs
#
# Up to some hundred worlds a step costs what one world costs. `rbd.memory_estimate` says before a run how much
# memory it
# will take.

# %%
sizes = [1, 16, 256] if SMALL else [1, 16, 256, 4096, 65536]
cost = []
for size in sizes:
    many = rbd.batch(state, size)
    jax.block_until_ready(rbd.rollout(model, many, 100, every=100))
    begin = time.perf_counter()
    jax.block_until_ready(rbd.rollout(model, many, 100, every=100))
    cost.append((time.perf_counter() - begin) / (100 * size))
fig, ax = plt.subplots(figsize=(6, 3))
ax.loglog(sizes, 1e9 * np.array(cost), "o-")
ax.set(xlabel="worlds", ylabel="ns a world and step")
plt.show()
print(rbd.memory_estimate(model, sizes[-1], 100))
assert cost[-1] < cost[0]

# %% [markdown]
# ## A world does not know of the others
#
# What becomes of a world does not depend on what is batched with it.

# %%
alone, _ = rbd.rollout(model.replace(friction=np.full((32, 2), mu[7])), rbd.batch(state, 32), steps=240, every=240)
among, _ = rbd.rollout(worlds, rbd.batch(state, WORLDS), steps=240, every=240)
print("world 7 among", WORLDS, "and among copies of itself:", among.pos[7, 0], alone.pos[0, 0])
assert np.array_equal(among.pos[7], alone.pos[0])
