"""Rapier through its Python bindings: float32, four substeps of one sweep a step, soft contacts.

Friction and restitution of a pair are averages of the two shapes', which are alike here. Rapier allows 5 mm of
penetration, predicts contacts over 20 mm and limits the speed of a correction; these lengths do not shrink with the
step. One thread: rayon's pool takes its size from the environment when it is first used.
"""

from __future__ import annotations

import importlib
import importlib.util
import os

from ..case import Case, Motion, Part
from ..engine import Engine, Refused, Simulation
from ._worlds import State, WorldByWorld, columns


class RapierEngine(Engine):
    name = "rapier"
    title = "Rapier"
    colour = "#CC79A7"
    variants = {"default": "default: 4 substeps, friction of up to four contacts at once"}
    widths = ("float32",)
    install = "pip install rapier3d"
    scales = False

    def missing(self) -> str | None:
        return None if importlib.util.find_spec("rapier3d") else "not installed"

    def version(self) -> str:
        return _rapier().__version__

    def load(self, case: Case, variant: str, dt: float, dtype: str) -> Simulation:
        return _Simulation(case, variant, dt)


class _Simulation(WorldByWorld):
    def __init__(self, case: Case, variant: str, dt: float):
        self.rapier = _rapier()
        self.case, self.dt = case, dt

    def begin(self) -> None:
        rapier, case = self.rapier, self.case
        world = rapier.PhysicsWorld(tuple(map(float, case.gravity)))
        world.integration_parameters.dt = self.dt
        for point, normal in case.planes:
            plane = rapier.Collider.halfspace(tuple(map(float, normal))).translation(tuple(map(float, point)))
            world.add_collider(self._surface(plane))
        handles = [world.add_body(self._body(), [self._shape(part)]) for part in case.parts]
        self.world, self.bodies = world, [world.rigid_bodies[h] for h in handles]

    def _body(self):
        """Without damping and with gyroscopic forces, as is the default."""
        return self.rapier.RigidBody.dynamic().can_sleep(False).allow_fast_rotation(True)

    def _shape(self, part: Part):
        rapier = self.rapier
        if part.kind == "sphere":
            shape = rapier.Collider.ball(part.size[0])
        elif part.kind == "box":
            shape = rapier.Collider.cuboid(*part.size)
        else:
            raise Refused(f"no shape '{part.kind}'")
        inertia = tuple(map(float, part.inertia))
        return self._surface(shape).mass_properties(rapier.MassProperties((0.0, 0.0, 0.0), part.mass, inertia))

    def _surface(self, shape):
        return shape.friction(self.case.friction or 0.0).restitution(self.case.restitution or 0.0)

    def place(self, start: Motion, world: int) -> None:
        rapier = self.rapier
        for k, body in enumerate(self.bodies):
            rotation = rapier.Rotation3(*start.quat[0, world, k].tolist())
            body.position = rapier.Isometry3(tuple(start.pos[0, world, k].tolist()), rotation)
            body.linvel = tuple(start.vel[0, world, k].tolist())
            body.angvel = tuple(start.omega[0, world, k].tolist())

    def advance(self, steps: int) -> None:
        step = self.world.step
        for _ in range(steps):
            step()

    def state(self) -> State:
        rows = []
        for body in self.bodies:
            turn = body.rotation
            quat = (turn.w, turn.i, turn.j, turn.k)
            rows.append((tuple(body.translation), quat, tuple(body.linvel), tuple(body.angvel)))
        return columns(rows)


def _rapier():
    os.environ.setdefault("RAYON_NUM_THREADS", "1")
    return importlib.import_module("rapier3d")


ENGINE = RapierEngine()
