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
# # 4. Speed against accuracy: choosing a method
#
# A method is a point on a chart of error against time, and a step is another one. Three questions choose it:
# what does the
# scene use (free flight, impacts, friction, stacks), how large an error do you allow, and of what.

# %%
import os
import time

import jax
import matplotlib.pyplot as plt
import numpy as np

import rbd_jax as rbd

SMALL = bool(os.environ.get("RBD_JAX_SMALL"))
WORLDS = 64 if SMALL else 1024


def timed(model, states, steps):
    run = lambda: jax.block_until_ready(rbd.rollout(model, states, steps, every=steps)[0])
    final = run()
    best = np.inf
    for _ in range(3):
        begin = time.perf_counter()
        run()
        best = min(best, time.perf_counter() - begin)
    return final, best


# %% [markdown]
# ## Free flight: a tumbling box for one second
#
# The truth is a run at a step a hundred times finer. Each line is a method, each point a step.

# %%
box = rbd.Body("box", rbd.Box((0.1, 0.2, 0.3)), mass=1.0, omega=(1, 2, 3), vel=(1, 0, 5))
scene = rbd.Scene(bodies=[box], gravity=(0, 0, -9.81), dt=0.01)
with jax.enable_x64(True):
    model, state = rbd.build(scene, dt=1 / 10000, method=rbd.Method("symtop4"))
    truth = np.asarray(rbd.rollout(model, state, 10000, every=10000)[0].quat[0])

fig, ax = plt.subplots(figsize=(6, 3.6))
found = {}
for name in ["forward_euler", "rk4", "symtop2", "symtop4"]:
    for per_second in [20, 100] if SMALL else [20, 50, 100, 400]:
        model, state = rbd.build(scene, dt=1 / per_second, method=rbd.Method(name))
        final, seconds = timed(model, rbd.batch(state, WORLDS), per_second)
        q = np.asarray(final.quat[0, 0], float)
        found[name, per_second] = (seconds / WORLDS, 2 * np.linalg.norm(q * np.sign(q @ truth) - truth))
    line = np.array([v for (n, _), v in found.items() if n == name])
    ax.loglog(1e6 * line[:, 0], line[:, 1], "o-", label=name)
ax.set(xlabel="wall time of a simulated second [us]", ylabel="attitude error [rad]")
ax.legend(fontsize=8)
plt.show()
assert found["symtop4", 20][1] < found["symtop2", 20][1] < found["forward_euler", 20][1]
assert found["symtop4", 20][1] < found["forward_euler", 100][1] / 10  # a large step of a good method, not the reverse

# %% [markdown]
# ## Contact: a stack that should stand
#
# `"fast"` and `"accurate"` at a coarse and at a fine step: how deep the boxes sink into each other, and what
# it costs.

# %%
boxes = [
    rbd.Body(f"box{k}", rbd.Box((0.1, 0.1, 0.1)), pos=(0, 0, 0.1 + 0.2 * k), vel=(0, 0, 0), mass=1.0, friction=0.6)
    for k in range(3)
]
stack = rbd.Scene(bodies=boxes, static=[rbd.Geom(rbd.Plane(), friction=0.6)], gravity=(0, 0, -9.81), dt=1 / 60)
heights = np.array([0.1, 0.3, 0.5])
sinks = {}
for method in ["fast", "accurate"]:
    for per_second in [60] if SMALL else [60, 240]:
        model, state = rbd.build(stack, dt=1 / per_second, method=method)
        final, seconds = timed(model, rbd.batch(state, WORLDS), per_second)
        sink = np.abs(np.asarray(final.pos[0, :, 2]) - heights).max()
        sinks[method, per_second] = sink
        print(f"{method:9s} 1/{per_second} s: {1e3 * sink:.4f} mm, {1e6 * seconds / WORLDS:.1f} us a simulated second")
assert max(sinks.values()) < 1e-3

# %% [markdown]
# ## Model no more than the scene needs
#
# What a scene does not mention is not in the program: no friction, no friction rows; no spin of a smooth ball,
# no attitude.


# %%
def ball(**more):
    body = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 0.5), vel=(1, 0, 0), mass=1.0, **more)
    ground = rbd.Geom(rbd.Plane(), **more)
    return rbd.Scene(bodies=[body], static=[ground], gravity=(0, 0, -9.81), dt=1 / 240)


for what, scene in [("smooth", ball(friction=None)), ("with friction", ball(friction=0.5))]:
    model, state = rbd.build(scene, method="fast")
    _, seconds = timed(model, rbd.batch(state, WORLDS), 240)
    absent = [name for name in ("friction", "inertia") if getattr(model, name) is None]
    print(f"{what:14s} {1e9 * seconds / (240 * WORLDS):6.2f} ns a step; not in the program: {absent or 'nothing'}")
model, _ = rbd.build(ball(friction=None), method="fast")
assert model.friction is None

# %% [markdown]
# The charts of all cases, beside other engines, are in `benchmarks/results/suite.md`; `python -m rbd_jax bench
# --suite
# standard` measures them on your machine.
