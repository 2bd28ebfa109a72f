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
# # 1. First drop
#
# A scene is a list of bodies. `build` compiles it into a *model* (the numbers and the program) and a *state* (where
# everything is). `rollout` advances the state and hands back a trajectory. Units are SI, z is up.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbd_jax as rbd
from rbd_jax.record import clip

scene = rbd.Scene(
    bodies=[
        rbd.Body("ball", rbd.Sphere(0.15), pos=(0, 0, 1.2), mass=1.0, restitution=0.8, friction=0.5),
        rbd.Body("box", rbd.Box((0.2, 0.15, 0.1)), pos=(0.8, 0, 1.0), omega=(2, 1, 3), mass=2.0, friction=0.5),
    ],
    static=[rbd.Geom(rbd.Plane(), friction=0.5, restitution=0.8)],
    gravity=(0, 0, -9.81),
    dt=1 / 240,
)
model, state = rbd.build(scene, method="fast")
print(model)
print(state)

# %% [markdown]
# Two seconds, a sample every fourth step. Everything that a trajectory has, it has with the time axis in front of the
# bodies: `traj.pos` is (samples, bodies, 3).

# %%
final, traj = rbd.rollout(model, state, steps=480, every=4)
rbd.check(final)  # raises, and names the world, if one went wrong
print(traj.pos.shape, "final heights", np.round(np.asarray(final.pos[:, 2]), 4))

# %% [markdown]
# Look at it: in a notebook a clip plays where it stands. `rbd_jax.view.write_html` makes the same page as a file.

# %%
clip(model, traj, title="first drop")

# %% [markdown]
# ## Energy
#
# Between impacts nothing takes energy away, so the total is a staircase. Every step down is an impact: a ball with
# restitution $e$ keeps the share $e^2$ of its kinetic energy.

# %%
kinetic, potential = rbd.energy(model, traj)
total = np.asarray(kinetic + potential)
time = np.asarray(traj.time)
fig, ax = plt.subplots(figsize=(7, 3))
ax.plot(time, kinetic, label="kinetic")
ax.plot(time, potential, label="potential")
ax.plot(time, total, "k", label="total")
ax.set(xlabel="time [s]", ylabel="energy [J]")
ax.legend()
plt.show()

# %% [markdown]
# What that says, as assertions: energy never grows, nothing sinks into the ground, and the ball's first apex is
# $e^2$ of the drop.

# %%
assert np.all(np.diff(total) < 1e-3 * total[0])
heights = np.asarray(traj.pos[:, 0, 2]) - 0.15
fell = int(np.argmax(heights < 0.1))
apex = heights[fell:].max()
print(f"dropped from {heights[0]:.3f} m, comes back to {apex:.3f} m, e^2 h = {0.8**2 * heights[0]:.3f} m")
assert abs(apex - 0.8**2 * heights[0]) < 0.01
assert heights.min() > -1e-3

# %% [markdown]
# ## One step at a time
#
# `step` is what `rollout` repeats. States are never changed in place; `replace` makes another one.

# %%
lifted = state.replace(pos=state.pos + jnp.array([0.0, 0.0, 1.0]))
print("before", state.pos[0], "after", rbd.step(model, lifted).pos[0])
assert abs(float(lifted.pos[0, 2] - state.pos[0, 2]) - 1.0) < 1e-6
