"""Knock over a stack of boxes with a ball."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ...scene import Body, Scene
from ...shapes import Box, Plane, Sphere
from ...state import Wrench
from ..environment import Environment

HALF = (0.08, 0.08, 0.12)
COUNT = 3
#: The ball meets the second box as well: the lowest alone is pushed along with all that stands on it.
RADIUS = 0.3
#: Largest force [N], on 2 kg.
FORCE = 20.0
TOP = 2 * COUNT * HALF[2]


class Topple(Environment):
    """Action: horizontal force on the ball, 1 = 20 N. Seen: ball's way to the stack and velocity, heights and
    horizontal places of the boxes.

    Reward of a step: 10 times what the boxes have come down in it, over their height at the start, minus 0.1 (so it had
    better be soon), minus a tenth of the ball's distance from the stack [m], minus 0.02 |action|^2. Over, with 5 more,
    when no box is on another. What comes down must be knocked down: standing boxes near fallen ones earn nothing.
    """

    name = "topple"
    observation_size = 4 + 3 * COUNT
    action_size = 2

    def scene(self):
        boxes = [
            Body(f"box{k}", Box(HALF), pos=(0, 0, HALF[2] * (2 * k + 1)), vel=(0, 0, 0), mass=0.5, friction=0.6)
            for k in range(COUNT)
        ]
        ball = Body("ball", Sphere(RADIUS), pos=(1, 0, RADIUS), vel=(0, 0, 0), mass=2.0, friction=0.6)
        return Scene(bodies=[*boxes, ball], static=[Plane()], drag=(0.1, 0.1), gravity=(0, 0, -9.81), dt=0.01)

    def begin(self, key):
        side, far = jax.random.uniform(key, (2,), self.model.mass.dtype)
        angle, away = 2 * jnp.pi * side, 0.6 + 0.6 * far
        pos = self.start.pos.at[COUNT, :2].set(away * jnp.stack([jnp.cos(angle), jnp.sin(angle)]))
        return self.start.replace(pos=pos), {}

    def act(self, sim, goal, action):
        force = jnp.zeros((COUNT + 1, 3), action.dtype).at[COUNT, :2].set(FORCE * action)
        return sim, Wrench(force=force)

    def observe(self, sim, goal):
        boxes = sim.pos[:COUNT] / TOP
        return jnp.concatenate([-sim.pos[COUNT, :2], 0.3 * sim.vel[COUNT, :2], boxes.ravel()])

    def judge(self, before, sim, goal, action):
        heights = sim.pos[:COUNT, 2]
        fallen = (heights < 1.2 * HALF[2]).all()  # a box on its side lies lower still
        down = (before.pos[:COUNT, 2] - heights).sum() / (COUNT * TOP / 2)
        away = sim.pos[COUNT, :2] - sim.pos[:COUNT, :2].mean(0)
        distance = jnp.sqrt((away**2).sum() + 1e-6)
        reward = 10.0 * down - 0.1 - 0.1 * distance - 0.02 * (action**2).sum() + 5.0 * fallen
        return reward, fallen, {"fallen": fallen}


TASK = Topple
