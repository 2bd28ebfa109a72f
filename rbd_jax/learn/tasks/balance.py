"""Keep a sliding box on a tilting plate."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ...scene import Body, Scene
from ...shapes import Box
from ..environment import Environment

BOX = (0.06, 0.06, 0.04)
PLATE = (0.5, 0.5, 0.02)
#: Fastest turn of the plate [rad/s], and how far it may tilt [rad].
RATE, TILT = 2.0, 0.3
TOP = PLATE[2] + BOX[2]


class Balance(Environment):
    """Action: rate at which the plate tilts towards x and towards y, 1 = 2 rad/s, up to 0.3 rad.

    Seen: box's place on the plate and velocity, tilt of the plate. Reward of a step: one minus the distance from the
    middle over the half-width. Over when the box is off the plate.
    """

    name = "balance"
    observation_size = 6
    action_size = 2

    def scene(self):
        plate = Body("plate", Box(PLATE), omega=(0, 0, 0), friction=0.1)
        box = Body("box", Box(BOX), pos=(0, 0, TOP), vel=(0, 0, 0), mass=0.5, friction=0.1)
        return Scene(bodies=[box], kinematic=[plate], gravity=(0, 0, -9.81), dt=0.01)

    def begin(self, key):
        place, speed = jax.random.uniform(key, (2, 2), self.model.mass.dtype, -1.0, 1.0)
        pos = jnp.append(0.25 * place, TOP)
        return self.start.replace(pos=pos, vel=jnp.append(0.6 * speed, 0.0)), {}

    def act(self, sim, goal, action):
        tilt = _tilt(sim)
        # What of the rate would tilt it too far within the period is left out.
        rate = jnp.clip(RATE * action, (-TILT - tilt) / self.period, (TILT - tilt) / self.period)
        return sim.replace(kinematic_omega=jnp.stack([-rate[1], rate[0], jnp.zeros_like(rate[0])])), None

    def observe(self, sim, goal):
        return jnp.concatenate([2.0 * sim.pos[0, :2], sim.vel[0, :2], 3.0 * _tilt(sim)])

    def judge(self, before, sim, goal, action):
        away = jnp.sqrt((sim.pos[0, :2] ** 2).sum() + 1e-6)
        off = (jnp.abs(sim.pos[0, :2]) > PLATE[0]).any() | (sim.pos[0, 2] < -0.3)
        return 1.0 - away / PLATE[0], off, {"distance": away}


def _tilt(sim):
    """How far the plate leans towards x and y: its normal's parts along them."""
    w, x, y, z = jnp.moveaxis(sim.kinematic_quat[0], -1, 0)
    return 2.0 * jnp.stack([x * z + w * y, y * z - w * x])


TASK = Balance
