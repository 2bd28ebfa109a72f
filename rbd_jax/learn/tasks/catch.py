"""Catch a thrown ball with a tray."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ...scene import Body, Scene
from ...shapes import Box, Plane, Sphere
from ..environment import Environment

RADIUS = 0.05
TRAY = (0.2, 0.2, 0.02)
HEIGHT = 0.3
#: Fastest motion of the tray [m/s].
SPEED = 2.0
#: The ball comes down within so much of the origin [m], after so long [s].
REACH, EARLIEST, LATEST = 0.8, 0.7, 1.1
#: The ball is thrown from so high [m].
ABOVE = 1.0
GRAVITY = 9.81


class Catch(Environment):
    """Action: horizontal velocity of the tray, 1 = 2 m/s. Seen: tray's place, ball's place relative to it, velocity.

    Reward of a step: minus the horizontal distance of ball and tray [m]; 1 for every step with the ball on the tray.
    Over when the ball is below the tray.
    """

    name = "catch"
    observation_size = 8
    action_size = 2
    episode = 40

    def scene(self):
        tray = Body("tray", Box(TRAY), pos=(0, 0, HEIGHT), vel=(0, 0, 0), friction=0.8)
        ball = Body("ball", Sphere(RADIUS), pos=(0, 0, 2.0), vel=(0, 0, 0), mass=0.2, friction=0.8)
        return Scene(bodies=[ball], kinematic=[tray], static=[Plane()], gravity=(0, 0, -GRAVITY), dt=0.01)

    def begin(self, key):
        far, land, when = jax.random.split(key, 3)
        kind = self.model.mass.dtype
        start = jax.random.uniform(far, (2,), kind, -2.0, 2.0)
        end = jax.random.uniform(land, (2,), kind, -REACH, REACH)
        t = jax.random.uniform(when, (), kind, EARLIEST, LATEST)
        fall = ABOVE - (HEIGHT + TRAY[2] + RADIUS)
        pos = jnp.append(start, ABOVE)
        vel = jnp.append((end - start) / t, 0.5 * GRAVITY * t - fall / t)
        return self.start.replace(pos=pos, vel=vel), {}

    def act(self, sim, goal, action):
        return sim.replace(kinematic_vel=SPEED * jnp.append(action, 0.0)), None

    def observe(self, sim, goal):
        tray = sim.kinematic_pos[0]
        return jnp.concatenate([tray[:2], sim.pos[0] - tray, 0.3 * sim.vel[0]])

    def judge(self, before, sim, goal, action):
        away = sim.pos[0] - sim.kinematic_pos[0]
        distance = jnp.sqrt((away[:2] ** 2).sum() + 1e-6)
        low = TRAY[2] + RADIUS
        held = (jnp.abs(away[2] - low) < 0.5 * RADIUS) & (jnp.abs(away[:2]) < TRAY[0]).all()
        return held.astype(away.dtype) - distance, away[2] < 0.0, {"held": held}


TASK = Catch
