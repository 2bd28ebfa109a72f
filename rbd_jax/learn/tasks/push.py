"""Push a ball to a target on the floor."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ...scene import Body, Scene
from ...shapes import Plane, Sphere
from ...state import Wrench
from ..environment import Environment

RADIUS = 0.1
#: Largest force [N], on 1 kg.
FORCE = 3.0
#: Start and target lie within so much of the origin [m].
REACH = 1.0


class Push(Environment):
    """Action: horizontal force, 1 = 3 N. Seen: way to the target [m], velocity [m/s], spin times radius [m/s].

    Reward of a step: minus the distance [m], minus 0.05 |action|^2.
    """

    name = "push"
    observation_size = 6
    action_size = 2

    def scene(self):
        ball = Body("ball", Sphere(RADIUS), pos=(0, 0, RADIUS), vel=(0, 0, 0), omega=(0, 0, 0), mass=1.0, friction=0.5)
        return Scene(bodies=[ball], static=[Plane()], drag=(0.2, 0.2), gravity=(0, 0, -9.81), dt=0.01)

    def begin(self, key):
        place, target = jax.random.uniform(key, (2, 2), self.model.mass.dtype, -REACH, REACH)
        pos = jnp.append(place, self.start.pos[0, 2])
        return self.start.replace(pos=pos), {"target": target}

    def act(self, sim, goal, action):
        return sim, Wrench(force=FORCE * jnp.append(action, 0.0)[None])

    def observe(self, sim, goal):
        way = goal["target"] - sim.pos[0, :2]
        return jnp.concatenate([way, sim.vel[0, :2], RADIUS * sim.omega[0, :2]])

    def judge(self, before, sim, goal, action):
        way = goal["target"] - sim.pos[0, :2]
        distance = jnp.sqrt((way**2).sum() + 1e-6)  # smooth at the target
        return -distance - 0.05 * (action**2).sum(), jnp.bool(False), {"distance": distance}


TASK = Push
