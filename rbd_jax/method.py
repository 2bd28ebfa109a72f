"""Layer 6: which program advances a world: integrator, contact model, solver, substeps."""

from __future__ import annotations

import dataclasses

from .integrators import Integrator, make as make_integrator
from .solvers import SOLVERS, NewtonLagged, Solver

#: Longest substep of ``substeps=None`` with the TGS solver [s].
SUBSTEP = 1.0 / 240.0


@dataclasses.dataclass(frozen=True)
class Method:
    """A way to advance a world. Every field is static: changing one compiles another program.

    Attributes:
      integrator: a name of ``rbd_jax.integrators.INTEGRATORS`` or an instance.
      contact: contact model: "soft" (frequency and damping ratio tied to the step), "near_rigid",
        or "mujoco" (solref, solimp).
      solver: "tgs", "newton_lagged", "mujoco", or an instance; each speaks one contact model.
      substeps: steps inside a step of dt; None: 1, or for "tgs" as many as keep a substep within
        1/240 s at the dt of ``build``.
      capacity: pairs kept per world by groups that choose theirs at run time; None: 8 a body.
    """

    integrator: str | Integrator = "symtop2"
    contact: str | None = None
    solver: str | Solver = "tgs"
    substeps: int | None = None
    capacity: int | None = None

    def resolve(self, dt: float, scene_integrator: str | None = None) -> Method:
        """Names replaced by instances and ``substeps`` by a number.

        Raises:
          ValueError: an unknown name, a combination of model and solver that does not exist,
            substeps < 1 or capacity < 1.
        """
        integrator = self.integrator
        if integrator == "scene":
            integrator = "mujoco_" + (scene_integrator or "euler")
        integrator = make_integrator(integrator)
        solver = self.solver
        if isinstance(solver, str):
            if solver not in SOLVERS:
                raise ValueError(f"Method: unknown solver '{solver}'; known: {', '.join(SOLVERS)}")
            solver = SOLVERS[solver]()
        if not isinstance(solver, Solver):
            raise ValueError(f"Method: solver = {solver!r} must be a name or a Solver")
        contact = self.contact or solver.contact
        if contact != solver.contact:
            raise ValueError(f"Method: solver '{solver.name}' speaks contact model '{solver.contact}', not '{contact}'")
        for field in ("substeps", "capacity"):
            value = getattr(self, field)
            if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
                raise ValueError(f"Method: {field} = {value!r} must be an integer >= 1")
        substeps = self.substeps
        if substeps is None:
            substeps = max(1, round(dt / SUBSTEP + 0.49)) if solver.name == "tgs" else 1
        if substeps > MAX_SUBSTEPS:
            raise ValueError(f"Method: dt = {dt} s needs {substeps} substeps, at most {MAX_SUBSTEPS}: use a smaller dt")
        return Method(integrator, contact, solver, substeps, self.capacity)


#: Substeps are a compiled loop, but a step that needs more than this is a wrong dt.
MAX_SUBSTEPS = 1000

PRESETS = {
    "fast": Method("symtop2", "soft", "tgs"),
    "accurate": Method("symtop4", "near_rigid", NewtonLagged(iterations=8)),
    "gradient": Method("symtop2", "near_rigid", NewtonLagged(iterations=8)),
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
