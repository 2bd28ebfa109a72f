"""Bullet through pybullet: double precision, sequential impulses of 50 sweeps, symplectic Euler.

A free body of pybullet is a ``btMultiBody`` without links, unless maximal coordinates are asked for, which makes it a
``btRigidBody``. Friction and restitution of a pair are products of the two shapes', so that each shape is given the
square root. By default a contact acts before the touch (from 3.4 mm for a ball of 0.1 m on a plane) and stops the
approach there: the smaller the step, the less of a bounce is left, until none is. Once shapes overlap, a fraction of
the depth is pushed out by a velocity that stays: up to 0.1 of the speed of the impact, at any step, unless the impulse
is split.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import math

from ..case import Case, Motion, Part
from ..engine import Engine, Refused, Simulation
from ._worlds import State, WorldByWorld, columns

#: A limit of every coordinate's velocity, 100 by default, that is to bind nothing.
UNLIMITED = 1e6


class BulletEngine(Engine):
    name = "bullet"
    title = "Bullet"
    colour = "#8C564B"
    variants = {
        "default": "pybullet's default: multi-bodies, 50 sweeps; no restitution threshold",
        "touch": "default, but no contact acts before the touch (contactProcessingThreshold 0)",
        "bounce": "rigid bodies in maximal coordinates, much as the author advises for restitution: no contact before "
        "the touch, split impulse at any depth, no slop, no warm start",
    }
    install = "pip install pybullet"
    scales = False

    def missing(self) -> str | None:
        return None if importlib.util.find_spec("pybullet") else "not installed"

    def version(self) -> str:
        return importlib.metadata.version("pybullet")

    def load(self, case: Case, variant: str, dt: float, dtype: str) -> Simulation:
        return _Simulation(case, variant, dt)


class _Simulation(WorldByWorld):
    def __init__(self, case: Case, variant: str, dt: float):
        self.bullet = importlib.import_module("pybullet")
        self.case, self.dt = case, dt
        self.maximal, self.touch = variant == "bounce", variant != "default"
        self.client = self.bullet.connect(self.bullet.DIRECT)
        if self.client < 0:
            raise Refused("no more physics clients")
        self.bodies = []

    def close(self) -> None:
        if self.client >= 0:
            self.bullet.disconnect(self.client)
        self.client = -1

    def begin(self) -> None:
        """An empty world, then the case."""
        b, client = self.bullet, self.client
        b.resetSimulation(client)
        b.setGravity(*self.case.gravity, physicsClientId=client)
        b.setPhysicsEngineParameter(
            fixedTimeStep=self.dt, numSubSteps=0, deterministicOverlappingPairs=1, restitutionVelocityThreshold=0,
            physicsClientId=client,
        )  # fmt: skip
        if self.maximal:
            b.setPhysicsEngineParameter(
                useSplitImpulse=1, splitImpulsePenetrationThreshold=0, contactSlop=0, warmStartingFactor=0,
                physicsClientId=client,
            )  # fmt: skip
        for point, normal in self.case.planes:
            normal = tuple(map(float, normal))
            shape = b.createCollisionShape(b.GEOM_PLANE, planeNormal=normal, physicsClientId=client)
            self._add(shape, 0.0, point)
        self.bodies = [self._add(self._shape(part), part.mass, (0, 0, 0), part.inertia) for part in self.case.parts]

    def _shape(self, part: Part) -> int:
        b = self.bullet
        if part.kind == "sphere":
            return b.createCollisionShape(b.GEOM_SPHERE, radius=part.size[0], physicsClientId=self.client)
        if part.kind == "box":
            return b.createCollisionShape(b.GEOM_BOX, halfExtents=part.size, physicsClientId=self.client)
        raise Refused(f"no shape '{part.kind}'")

    def _add(self, shape: int, mass: float, pos, inertia=None) -> int:
        """A body, static without mass."""
        b, client, case = self.bullet, self.client, self.case
        body = b.createMultiBody(
            mass, shape, basePosition=tuple(map(float, pos)), useMaximalCoordinates=self.maximal, physicsClientId=client
        )
        surface = {"rollingFriction": 0.0, "spinningFriction": 0.0, "physicsClientId": client}
        surface["lateralFriction"] = math.sqrt(case.friction or 0.0)
        surface["restitution"] = math.sqrt(case.restitution or 0.0)
        if self.touch:
            surface["contactProcessingThreshold"] = 0.0
        b.changeDynamics(body, -1, **surface)
        if inertia is not None:
            b.changeDynamics(
                body, -1, mass=mass, localInertiaDiagonal=tuple(map(float, inertia)), linearDamping=0.0,
                angularDamping=0.0, maxJointVelocity=UNLIMITED, physicsClientId=client,
            )  # fmt: skip
        return body

    def place(self, start: Motion, world: int) -> None:
        b, client = self.bullet, self.client
        for k, body in enumerate(self.bodies):
            pos, (w, x, y, z) = start.pos[0, world, k].tolist(), start.quat[0, world, k].tolist()
            b.resetBasePositionAndOrientation(body, pos, (x, y, z, w), physicsClientId=client)
            vel, omega = start.vel[0, world, k].tolist(), start.omega[0, world, k].tolist()
            b.resetBaseVelocity(body, vel, omega, physicsClientId=client)

    def advance(self, steps: int) -> None:
        step, client = self.bullet.stepSimulation, self.client
        for _ in range(steps):
            step(client)

    def state(self) -> State:
        b, rows = self.bullet, []
        for body in self.bodies:
            pos, (x, y, z, w) = b.getBasePositionAndOrientation(body, self.client)
            rows.append((pos, (w, x, y, z), *b.getBaseVelocity(body, self.client)))
        return columns(rows)


ENGINE = BulletEngine()
