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
# # 2. The lecture: rigid bodies from momentum
#
# The state of a free rigid body is its place $x$, its attitude $R$, and its two momenta
#
# $$P = m v, \qquad L = I \omega, \qquad I = R\, I_b\, R^T .$$
#
# Without forces both momenta are constant. That does **not** make $\omega$ constant: as the body turns, $I$
# turns with
# it, and $\omega = I^{-1} L$ must wander. The lecture integrates $\dot x = v$ and $\dot R = [\omega]_\times R$
# step by
# step, and the question is what each way of stepping does to energy and attitude.

# %%
import os

import jax
import matplotlib.pyplot as plt
import numpy as np

import rbd_jax as rbd
from rbd_jax import integrators

SMALL = bool(os.environ.get("RBD_JAX_SMALL"))
jax.config.update("jax_enable_x64", True)  # so that rounding is not what we look at

box = rbd.Body("box", rbd.Box((0.1, 0.2, 0.3)), mass=1.0, omega=(1, 2, 3))
scene = rbd.Scene(bodies=[box], gravity=(0, 0, 0), dt=0.01)
STEPS = 500


def fly(integrator, steps=STEPS, dt=0.01):
    model, state = rbd.build(scene, dt=dt, method=rbd.Method(integrator))
    _, traj = rbd.rollout(model, state, steps)
    return model, traj


# %% [markdown]
# ## Momentum and the inertia tensor
#
# `rbd.momentum` adds up all bodies; `rbd.inertia_world` is $R I_b R^T$. Its eigenvalues do not move, its axes do.

# %%
model, traj = fly("symtop4")
P, L = rbd.momentum(model, traj)
tensor = np.asarray(rbd.inertia_world(model, traj))[:, 0]
print("L at the start and the end:", np.asarray(L[0]), np.asarray(L[-1]))
print("moments [kg m^2]:", np.linalg.eigvalsh(tensor[0]), np.linalg.eigvalsh(tensor[-1]))
assert np.abs(np.asarray(L - L[0])).max() < 1e-12
assert np.abs(np.linalg.eigvalsh(tensor) - np.linalg.eigvalsh(tensor[0])).max() < 1e-12
assert np.abs(tensor - tensor[0]).max() > 1e-3  # but the tensor itself has turned
omega = np.asarray(traj.omega[:, 0])
assert np.abs(np.linalg.norm(omega, axis=1) - np.linalg.norm(omega[0])).max() > 0.05  # and omega has wandered

# %% [markdown]
# ## Euler, three times
#
# * **forward**: the attitude moves with the old $\omega$,
# * **semi-implicit**: momenta first, then poses with the new ones,
# * **backward**: everything at the end of the step, which is an equation to solve.
#
# On a spinning box the kinetic energy should be constant. Beside them Runge and Kutta's fourth-order method and two
# splittings that turn the body about its symmetric part exactly.

# %%
NAMES = ["forward_euler", "semi_implicit_euler", "backward_euler", "rk4", "symtop2", "symtop4"]
energy = {}
for name in NAMES:
    model, traj = fly(name)
    energy[name] = np.asarray(rbd.energy(model, traj)[0])
time = 0.01 * np.arange(STEPS + 1)
fig, ax = plt.subplots(figsize=(7, 3))
for name, e in energy.items():
    ax.plot(time, e / e[0], label=name)
ax.set(xlabel="time [s]", ylabel="energy / energy at the start")
ax.legend(fontsize=8, ncol=2)
plt.show()

# %% [markdown]
# Forward Euler drifts one way, backward Euler the other. Semi-implicit Euler, which saves a spring, does not save a
# spinning box: without forces it *is* forward Euler, as there are no new momenta to be first with.

# %%
drift = {name: e[-1] / e[0] - 1 for name, e in energy.items()}
for name, d in drift.items():
    print(f"{name:20s} {d:+.2e}")
assert abs(drift["forward_euler"]) > 0.01 and abs(drift["backward_euler"]) > 0.01
assert drift["forward_euler"] * drift["backward_euler"] < 0
assert abs(drift["semi_implicit_euler"] - drift["forward_euler"]) < 1e-9
assert abs(drift["symtop2"]) < 1e-3 and abs(drift["symtop4"]) < 1e-8

# %% [markdown]
# ## Order
#
# Halve the step: the error of a method of order $p$ falls by $2^p$. The attitude after two seconds, against a
# finer run.


# %%
def attitude(name, dt):
    _, traj = fly(name, steps=round(2 / dt), dt=dt)
    return np.asarray(traj.quat[-1, 0])


truth = attitude("symtop4", 1 / 2000)
angle = lambda q: 2 * np.linalg.norm(q * np.sign(q @ truth) - truth)
steps = [1 / 50, 1 / 100] if SMALL else [1 / 50, 1 / 100, 1 / 200]
fig, ax = plt.subplots(figsize=(5, 3.4))
order = {}
for name in ["forward_euler", "symtop2", "symtop4"]:
    errors = [angle(attitude(name, dt)) for dt in steps]
    order[name] = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    ax.loglog(steps, errors, "o-", label=f"{name}: order {order[name]:.1f}")
ax.set(xlabel="step [s]", ylabel="attitude error [rad]")
ax.legend(fontsize=8)
plt.show()
print(order)
assert 0.7 < order["forward_euler"] < 1.3 and 1.8 < order["symtop2"] < 2.2 and order["symtop4"] > 3.5

# %% [markdown]
# ## Rotation matrix or quaternion
#
# The lecture's state holds the matrix $R$. Stepping $\dot R = [\omega]_\times R$ does not keep $R^T R = 1$:
# $R$ stretches,
# and the "rigid" body with it. So it is re-orthonormalised, column by column (Gram and Schmidt) or to the
# nearest rotation
# (polar decomposition); or one carries a quaternion, of which only the length can go wrong, and that is one division.

# %%
CARRIED = {
    "R, left alone": integrators.make("forward_euler", attitude="matrix"),
    "R, Gram-Schmidt": integrators.make("forward_euler", attitude="matrix", orthonormalise="gram_schmidt"),
    "R, polar": integrators.make("forward_euler", attitude="matrix", orthonormalise="polar"),
    "quaternion": integrators.make("forward_euler"),
}


def stretch(state):
    """Largest element of R^T R - 1 of the matrix that is carried, or of the quaternion's own."""
    if state.memory is not None and state.memory.R is not None:
        R = np.array([[float(getattr(row, c)[0]) for c in "xyz"] for row in (state.memory.R.a, state.memory.R.b,
                                                                             state.memory.R.c)])  # fmt: skip
        return np.abs(R.T @ R - np.eye(3)).max()
    return abs(float((state.quat[0] ** 2).sum()) - 1)


fig, ax = plt.subplots(figsize=(7, 3))
grown = {}
for name, integrator in CARRIED.items():
    model, state = rbd.build(scene, method=rbd.Method(integrator))
    values = []
    for _ in range(10):
        state, _ = rbd.rollout(model, state, 20, every=20)
        values.append(stretch(state))
    grown[name] = values[-1]
    ax.semilogy(0.2 * np.arange(1, 11), np.maximum(values, 1e-17), "o-", label=name)
ax.set(xlabel="time [s]", ylabel=r"$\max |R^T R - 1|$")
ax.legend(fontsize=8)
plt.show()
print(grown)
assert grown["R, left alone"] > 0.05
assert max(v for k, v in grown.items() if k != "R, left alone") < 1e-12

# %% [markdown]
# ## Resting and colliding contact
#
# Two bodies that touch either *collide* (they approach: an impulse turns the normal velocity round, in no
# time) or *rest*
# (the normal velocity is zero: a force keeps it there). A ball that is dropped does the first ever more gently
# and ends
# with the second. `rbd.contacts` says which, with the force.

# %%
ball = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 0.6), mass=1.0, restitution=0.6)
drop = rbd.Scene(bodies=[ball], static=[rbd.Geom(rbd.Plane(), restitution=0.6)], gravity=(0, 0, -9.81), dt=1 / 240)
model, state = rbd.build(drop, method="accurate")
final, traj = rbd.rollout(model, state, 720)
kinetic, potential = rbd.energy(model, traj)
total = np.asarray(kinetic + potential) - 0.1 * 9.81
fig, ax = plt.subplots(1, 2, figsize=(8, 3))
ax[0].plot(traj.time, traj.pos[:, 0, 2])
ax[0].set(xlabel="time [s]", ylabel="height [m]")
ax[1].semilogy(traj.time, np.maximum(total, 1e-9))
ax[1].set(xlabel="time [s]", ylabel="energy above rest [J]")
plt.tight_layout()
plt.show()
touching = rbd.contacts(model, final)
print(touching)
assert np.all(np.diff(total) < 1e-5 * total[0])  # an impact takes energy, nothing gives any
assert abs(float(final.vel[0, 2])) < 1e-3 and abs(float(final.pos[0, 2]) - 0.1) < 1e-3  # it has come to rest
