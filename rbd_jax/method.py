"""Layer 6: which program advances a world: integrator, contact model, solver, substeps."""

from __future__ import annotations

import dataclasses
import math

from .integrators import Integrator, Splitting, make as make_integrator
from .solvers import CONTACT_MODELS, SOLVERS, TGS, ContactModel, NewtonLagged, Solver
from .solvers.laws import Soft

#: Longest substep of ``substeps=None`` with a solver that is better split than solved harder [s].
SUBSTEP = 1.0 / 240.0
#: ``solver=None``: sweeps carry the load of a stack of this many boxes of this size [m] in a step of SUBSTEP,
STACK, STACK_SIZE = 8, 0.2
#: and masses up to this ratio;
RATIO = 10.0
#: The springs of soft contact that so many sweeps (``MOST_SWEEPS``) bear, and those for larger ratios of mass: balls,
#: four of 100 on twelve of 1 in a bin, overlap by 4 mm and jump about at 0.1 m/s with the former. With the latter they
#: come to rest (and overlap by 13 mm).
SWEPT = Soft(stacked=((0.43, 17.0), (0.25, 10.0)))
HEAVY_RATIO, HEAVY = 5.0, Soft.uniform(0.25, 10.0)
#: a direct solve costs less than the substeps of a larger one up to this many boxes.
DIRECT = 64
#: Two sweeps, and one more for every two boxes after the first, up to so many: with one less a stack of three or four
#: rocks at 0.05 m/s for seconds.
MOST_SWEEPS = 4
#: Newton steps of a direct solve: with six, two stacks that collide gain 0.0012 M g d in a step instead of 0.0006, and
#: the speed at which dominoes fall changes by 3.9 % with half the step instead of 1.1; with eight a bin of boxes and
#: balls takes a third longer than with six for the same overlap.
NEWTON = 7


@dataclasses.dataclass(frozen=True)
class Touching:
    """What of a scene decides which solver is the cheapest that stands.

    Attributes:
      anything: whether anything may touch anything.
      boxes, size, box_ratio: number of bodies whose boxes may touch another body's, the smallest edge of one of these
        boxes [m], the largest of their masses over the smallest.
      ratio: the same of all bodies that may touch another body.
      alone: whether bodies touch each other with nothing but boxes.
    """

    anything: bool = True
    boxes: int = 0
    size: float = 1.0
    box_ratio: float = 1.0
    ratio: float = 1.0
    alone: bool = False


@dataclasses.dataclass(frozen=True)
class Method:
    """A way to advance a world. Every field is static: changing one compiles another program.

    Attributes:
      integrator: a name of ``rbd_jax.integrators.INTEGRATORS`` or an instance.
      contact: contact model, a name of ``rbd_jax.CONTACT_MODELS`` ("soft", "hertz", "near_rigid", "baumgarte",
        "spring", "mujoco") or an instance; None: the solver's own.
      solver: a name of ``rbd_jax.SOLVERS`` ("tgs", "pgs", "newton_lagged", "newton_cone", "penalty", "mujoco") or an
        instance. Any goes with any model, but "mujoco", which speaks its own only. None: the cheapest that stands:
        "newton_lagged" with up to seven Newton steps where 2 to 64 boxes may touch each other and bodies may touch
        each other with nothing else, or where sweeps would need substeps for these boxes, which is where
        dt > 1/240 s min(1, 8 / boxes) min(1, sqrt(size / 0.2 m)) or where their masses differ by more than 10 : 1; else
        "tgs", with two sweeps, three from three boxes on and four from five on, and contacts that yield more where
        masses of bodies that may touch each other differ by more than 5 : 1.
      substeps: steps inside a step of dt; None: 1, or for "tgs" and "penalty" as many as keep a substep within
        1/240 s at the dt of ``build`` where anything may touch anything.
      events: with pairs that mention restitution, impacts a world may have in a (sub)step at their own instant, with
        the position and normal they
        have there; what follows the last of them is a step of the remaining length. 0: none, an impact is
        resolved at the normal of the start of the step. An approach slower than max((1 - e) / 2, 0.02) h |a| is no
        event: the body has come to rest.
      capacity: pairs kept per world by groups that choose theirs at run time; None: 8 a moving geom, or half as many
        again as start close.
    """

    integrator: str | Integrator = "symtop2"
    contact: str | ContactModel | None = None
    solver: str | Solver | None = "tgs"
    substeps: int | None = None
    capacity: int | None = None
    events: int = 0

    @property
    def reach(self) -> str:
        """Which contact slots are alive, see ``detect.detect``: smoothed contact acts from a distance."""
        return "all" if self.solver.smoothing else self.contact.reach

    def resolve(self, dt: float, scene_integrator: str | None = None, touching: Touching | None = None) -> Method:
        """Names replaced by instances and ``substeps`` by a number.

        Args:
          dt: step [s]. scene_integrator: what "scene" stands for. touching: None: any two things may, none is a box.

        Raises:
          ValueError: an unknown name, a combination of model and solver that does not exist,
            substeps < 1 or capacity < 1.
        """
        t = touching or Touching()
        integrator = self.integrator
        if integrator == "scene":
            integrator = "mujoco_" + (scene_integrator or "euler")
        integrator = make_integrator(integrator)
        solver, contact = self.solver, self.contact
        if solver is None:
            longest = SUBSTEP * min(1.0, STACK / max(t.boxes, 1)) * min(1.0, math.sqrt(t.size / STACK_SIZE))
            direct = 2 <= t.boxes <= DIRECT and (t.alone or dt > longest or t.box_ratio > RATIO)
            if direct and contact in (None, "near_rigid"):
                solver = NewtonLagged(iterations=NEWTON)
            else:
                solver = TGS(sweeps=min(2 + max(t.boxes - 1, 0) // 2, MOST_SWEEPS))
                contact = contact or (HEAVY if t.ratio > HEAVY_RATIO else SWEPT)
        if isinstance(solver, str):
            if solver not in SOLVERS:
                raise ValueError(f"Method: unknown solver '{solver}'; known: {', '.join(SOLVERS)}")
            solver = SOLVERS[solver]()
        if not isinstance(solver, Solver):
            raise ValueError(f"Method: solver = {solver!r} must be a name or a Solver")
        contact = contact or solver.contact
        if isinstance(contact, str):
            if contact not in CONTACT_MODELS:
                raise ValueError(f"Method: unknown contact model '{contact}'; known: {', '.join(CONTACT_MODELS)}")
            contact = CONTACT_MODELS[contact]()
        if not isinstance(contact, ContactModel):
            raise ValueError(f"Method: contact = {contact!r} must be a name or a ContactModel")
        if solver.models is not None and contact.name not in solver.models:
            known = ", ".join(solver.models)
            raise ValueError(f"Method: solver '{solver.name}' speaks contact model '{known}', not '{contact.name}'")
        for field in ("substeps", "capacity"):
            value = getattr(self, field)
            if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
                raise ValueError(f"Method: {field} = {value!r} must be an integer >= 1")
        if not isinstance(self.events, int) or isinstance(self.events, bool) or self.events < 0:
            raise ValueError(f"Method: events = {self.events!r} must be an integer >= 0")
        if self.events and (solver.level != "velocity" or not isinstance(integrator, Splitting)):
            raise ValueError(
                f"Method: events need a solver of velocities and a splitting integrator (symtop2, symtop4, buss2), not "
                f"'{solver.name}' with '{integrator.name}'"
            )
        substeps = self.substeps
        if substeps is None:
            substeps = max(1, round(dt / SUBSTEP + 0.49)) if solver.substeps and t.anything else 1
        if substeps > MAX_SUBSTEPS:
            raise ValueError(f"Method: dt = {dt} s needs {substeps} substeps, at most {MAX_SUBSTEPS}: use a smaller dt")
        return Method(integrator, contact, solver, substeps, self.capacity, self.events)


#: ``Model.smoothing`` of a solver that smooths, until it is replaced: normal and slip speed [m/s].
SMOOTHING = (0.05, 0.05)

#: Substeps are a compiled loop, but a step that needs more than this is a wrong dt.
MAX_SUBSTEPS = 1000

PRESETS = {
    "fast": Method("symtop2", None, None),
    "accurate": Method("symtop4", "near_rigid", NewtonLagged(iterations=8)),
    "gradient": Method("symtop2", "near_rigid", NewtonLagged(iterations=4, polish=9), events=2),
    "mujoco": Method("scene", "mujoco", "mujoco"),
}


def find(method: str | Method) -> Method:
    """The preset of that name, or the method itself.

    Raises:
      ValueError: unknown name or type.
    """
    if isinstance(method, Method):
        return method
    if method in PRESETS:
        return PRESETS[method]
    raise ValueError(f"unknown method {method!r}; presets: {', '.join(PRESETS)}, or an rbd_jax.Method")
