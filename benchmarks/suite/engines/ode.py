"""ODE through pyode: symplectic Euler with an implicit gyroscopic torque; Baumgarte's term against penetration.

Contacts are found and made by a Python callback, a pair at a time, because pyode has no other way: much of the time
of a world with many contacts is Python's. Friction is a pyramid along two tangents that ODE picks by the normal, in
x and y for a level plane: up to sqrt(2) mu between them, whatever the step.
"""

from __future__ import annotations

import ctypes
import importlib
import importlib.util

import numpy as np

from ..case import Case, Motion, Part
from ..engine import Engine, Refused, Simulation
from ._worlds import State, WorldByWorld, columns

#: What collides with what: bodies with all, planes with bodies.
BODY, PLANE = 1, 2


class OdeEngine(Engine):
    name = "ode"
    title = "ODE"
    colour = "#7F7F7F"
    variants = {
        "step": "dWorldStep, direct (Dantzig's LCP); ERP 0.2, default CFM",
        "quick": "dWorldQuickStep, 20 sweeps; ERP 0.2, default CFM",
    }
    install = "apt install python3-pyode (Debian; or pip install ode-python with libode)"
    scales = False

    def missing(self) -> str | None:
        if not importlib.util.find_spec("ode"):
            return "not installed"
        return None if _double() else "built in single precision"

    def version(self) -> str:
        return _release()

    def load(self, case: Case, variant: str, dt: float, dtype: str) -> Simulation:
        return _Simulation(case, variant, dt)


class _Simulation(WorldByWorld):
    def __init__(self, case: Case, variant: str, dt: float):
        self.ode = ode = importlib.import_module("ode")
        self.dt = dt
        self.world = ode.World()
        self.world.setGravity(case.gravity)
        self.world.setERP(0.2)
        self.step = self.world.quickStep if variant == "quick" else self.world.step
        self.space = ode.HashSpace()
        self.contacts = ode.JointGroup()
        self.seed = getattr(_library(), "dRandSetSeed", None)
        # Approx1: the friction's bound is mu times the normal force, else it would be the force mu itself
        self.mode = ode.ContactApprox1 | (ode.ContactBounce if case.restitution else 0)
        self.friction, self.restitution = case.friction or 0.0, case.restitution or 0.0
        self.shapes = [self._plane(*plane) for plane in case.planes]
        self.bodies = [self._body(part) for part in case.parts]

    def begin(self) -> None:
        if self.seed:
            self.seed(0)  # quickStep shuffles its rows: the same way in every run

    def _plane(self, point, normal):
        normal = np.asarray(normal, np.float64)
        shape = self.ode.GeomPlane(self.space, tuple(normal.tolist()), float(normal @ np.asarray(point, np.float64)))
        shape.setCategoryBits(PLANE)
        shape.setCollideBits(BODY)
        return shape

    def _body(self, part: Part):
        ode = self.ode
        body, mass = ode.Body(self.world), ode.Mass()
        mass.setParameters(part.mass, 0, 0, 0, *map(float, part.inertia), 0, 0, 0)
        body.setMass(mass)
        if part.kind == "sphere":
            shape = ode.GeomSphere(self.space, part.size[0])
        elif part.kind == "box":
            shape = ode.GeomBox(self.space, tuple(2 * s for s in part.size))
        else:
            raise Refused(f"no shape '{part.kind}'")
        shape.setBody(body)
        shape.setCategoryBits(BODY)
        shape.setCollideBits(BODY | PLANE)
        self.shapes.append(shape)
        return body

    def place(self, start: Motion, world: int) -> None:
        for k, body in enumerate(self.bodies):
            body.setPosition(start.pos[0, world, k].tolist())
            body.setQuaternion(start.quat[0, world, k].tolist())
            body.setLinearVel(start.vel[0, world, k].tolist())
            body.setAngularVel(start.omega[0, world, k].tolist())

    def _near(self, _, one, other) -> None:
        """Contacts of a pair that may touch, as joints that last a step."""
        ode, mode, friction, restitution = self.ode, self.mode, self.friction, self.restitution
        for contact in ode.collide(one, other):
            contact.setMode(mode)
            contact.setMu(friction)
            if restitution:
                contact.setBounce(restitution)
                contact.setBounceVel(0.0)
            ode.ContactJoint(self.world, self.contacts, contact).attach(one.getBody(), other.getBody())

    def advance(self, steps: int) -> None:
        collide, near, step, dt, forget = self.space.collide, self._near, self.step, self.dt, self.contacts.empty
        for _ in range(steps):
            collide(None, near)
            step(dt)
            forget()

    def state(self) -> State:
        return columns([(b.getPosition(), b.getQuaternion(), b.getLinearVel(), b.getAngularVel()) for b in self.bodies])


def _library():
    """libode itself, through the module that is linked to it."""
    return ctypes.CDLL(importlib.import_module("ode").__file__)


def _double() -> bool:
    """Whether libode was built in double precision."""
    ode = importlib.import_module("ode")
    body = ode.Body(ode.World())
    body.setPosition((0.1, 0.0, 0.0))
    return body.getPosition()[0] == 0.1


def _release() -> str:
    """The file name of the libode in use, "libode.so.8.0.2", as neither it nor pyode knows its version."""
    importlib.import_module("ode")
    try:
        with open("/proc/self/maps") as maps:
            return next((line.rsplit("/", 1)[1].strip() for line in maps if "/libode.so" in line), "")
    except OSError:
        return ""


ENGINE = OdeEngine()
