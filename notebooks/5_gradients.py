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
# # 5. Gradients: aim, identify, and where they fail
#
# `jax.grad` goes through `step` and `rollout`. The preset `"gradient"` solves contact to convergence,
# differentiates it
# implicitly, and finds the instant of an impact, which is what makes the derivative that of the physics.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbd_jax as rbd

DT, E, G = 1 / 120, 0.8, 9.81


def scene():
    ball = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 0.6), vel=(1, 0, 0), mass=1.0, restitution=E)
    return rbd.Scene([ball], [rbd.Geom(rbd.Plane(), restitution=E)], gravity=(0, 0, -G), dt=DT)


# %% [markdown]
# ## The height after a bounce
#
# A ball falls from $h$, bounces, and is looked at at time $T$. With $t = \sqrt{2h/g}$ its height is
# $e\,g\,t\,(T - t) - g (T - t)^2 / 2$, which has a derivative with respect to $h$ that we can write down.

# %%
T = 0.5


def height(z0, method):
    model, state = rbd.build(scene(), method=method)
    steps = round(T / DT)
    final, _ = rbd.rollout(model, state.replace(pos=jnp.array([0.0, 0.0, 1.0]) * z0), steps, every=steps)
    return final.pos[0, 2] - 0.1


def closed(z0):
    t = jnp.sqrt(2 * (z0 - 0.1) / G)
    return E * G * t * (T - t) - G * (T - t) ** 2 / 2


with jax.enable_x64(True):
    truth = float(jax.grad(closed)(0.6))
    slopes = {}
    for name, method in {
        "gradient": "gradient",
        "fast": "fast",
        "lecture": rbd.Method("semi_implicit_euler", contact="soft", solver="tgs", substeps=1),
    }.items():
        slopes[name] = float(jax.grad(lambda z: height(z, method))(0.6))
    print(f"closed form {truth:.6f}")
    for name, slope in slopes.items():
        print(f"{name:10s} {slope:.6f}   error {abs(slope - truth):.1e}")
assert abs(slopes["gradient"] - truth) < 1e-8
assert abs(slopes["lecture"] - truth) > 0.5

# %% [markdown]
# That is where gradients fail. The lecture's scheme, semi-implicit Euler with an impulse at the end of the step in
# which the
# ball touches, gives nearly the right *height* and a wrong *derivative*: it differentiates another ball, one that
# hits at
# fixed times. No small step mends it; the instant must depend on the height, as it does in the world. Our presets
# put an
# impact at its instant; `"gradient"` does so for several in a step, and where they touch.
#
# ## Aim
#
# With the right derivative, hitting a target is a few Newton steps. Find the vertical speed with which a ball, thrown
# forward at 1 m/s, is at height 0.35 m after one bounce and 0.7 s.

# %%
model, state = rbd.build(scene(), method="gradient")
steps = round(0.7 / DT)


@jax.jit
@jax.value_and_grad
def miss(up):
    vel = jnp.array([[1.0, 0.0, 0.0]]) + up * jnp.array([[0.0, 0.0, 1.0]])
    final, _ = rbd.rollout(model, state.replace(vel=vel), steps, every=steps)
    return final.pos[0, 2] - 0.35


up, seen = 0.0, []
for _ in range(8):
    value, slope = miss(up)
    seen.append(abs(float(value)))
    up -= float(value / slope)
print("miss [m]:", [f"{v:.1e}" for v in seen], "up", up)
fig, ax = plt.subplots(figsize=(5, 3))
ax.semilogy(np.maximum(seen, 1e-9), "o-")
ax.set(xlabel="Newton step", ylabel="miss [m]")
plt.show()
assert seen[-1] < 1e-5

# %% [markdown]
# ## Identify
#
# Given where a box stopped, how large is the friction? One derivative with respect to a leaf of the model.

# %%
sliding = rbd.Scene(
    bodies=[rbd.Body("box", rbd.Box((0.1, 0.1, 0.1)), pos=(0, 0, 0.1), vel=(2, 0, 0), mass=1.0, friction=0.5)],
    static=[rbd.Geom(rbd.Plane(), friction=0.5)],
    gravity=(0, 0, -G),
    dt=DT,
)
model, state = rbd.build(sliding, method="gradient")


def way(mu):
    final, _ = rbd.rollout(model.replace(friction=mu * jnp.ones(2)), state, 120, every=120)
    return final.pos[0, 0]


seen_way = 2.0**2 / (2 * 0.37 * G)  # a box with friction 0.37
slope = jax.jit(jax.value_and_grad(way))
mu = 0.5
for _ in range(6):
    value, d = slope(mu)
    mu -= float((value - seen_way) / d)
print(f"friction {mu:.4f}, true 0.37")
assert abs(mu - 0.37) < 0.005

# %% [markdown]
# What every derivative is, and where there is none, is on one page: `docs/gradients.md`.
