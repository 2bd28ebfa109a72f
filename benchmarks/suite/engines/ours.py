"""rbd_jax: presets, and integrators and solvers one by one."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time

import jax
import numpy as np

import rbd_jax as rbd

from ..case import Case, Motion
from ..engine import Engine, Refused, Simulation

PRESETS = {
    "fast": "preset fast",
    "accurate": "preset accurate",
    "gradient": "preset gradient: impacts at their instant",
    "mujoco": "preset mujoco: MuJoCo's contact law and Euler",
}
#: Impacts at their own instant, in any preset.
EVENTS = 4
#: Bodies of a scene whose errors are measured on one core.
SMALL = 2


def _method(variant: str, case: Case) -> rbd.Method:
    if variant in PRESETS:
        return rbd.PRESETS[variant]
    name, _, what = variant.partition("+")
    if what == "events":
        if case.restitution is None:
            raise Refused("no pair bounces")
        preset = rbd.PRESETS[name]
        return rbd.Method(preset.integrator, preset.contact, preset.solver, events=EVENTS)
    if variant in rbd.SOLVERS:
        return rbd.Method("symtop2", None, variant)
    return rbd.Method(variant)


class Ours(Engine):
    name = "ours"
    title = "rbd_jax"
    colour = "#0072B2"
    widths = ("float32", "float64")
    install = "pip install rbd-jax"
    compiles = True

    @property
    def variants(self) -> dict[str, str]:
        from rbd_jax.integrators import INTEGRATORS as integrators

        return {
            **PRESETS,
            "fast+events": "preset fast, impacts at their instant",
            "accurate+events": "preset accurate, impacts at their instant",
            **{f: f"integrator {f}" for f in integrators if not f.startswith("mujoco")},
            **{s: f"symtop2 with solver {s}" for s in rbd.SOLVERS if s != "mujoco"},
        }

    def version(self) -> str:
        return rbd.__version__

    def order(self, case: Case, variant: str) -> int | None:
        """That of the integrator in free flight, 2 of a slide, 1 where impacts fall between steps.

        None is claimed where the step is not what decides: at rest, in piles, where impacts are hit at their instant,
        and of "fast" in contact, which splits coarse steps.
        """
        if case.group == "free":
            return rbd.build(case.scene(), method=_method(variant, case))[0].method.integrator.order
        if variant != "accurate":
            return None
        return {"impact": 1, "friction": 2}.get(case.group)

    def load(self, case: Case, variant: str, dt: float, dtype: str) -> Simulation:
        return _Simulation(case, _method(variant, case), dt, dtype)


@contextlib.contextmanager
def _cores(count: int | None):
    rbd.use_cores(count)
    try:
        yield
    finally:
        rbd.use_cores(None)


#: Programs that this process has compiled and the seconds that took: (case, method, dtype, worlds), the method without
#: its substeps.
_compiled: dict = {}


class _Simulation(Simulation):
    def __init__(self, case, method, dt, dtype):
        self.wide = dtype == "float64"
        self.compile_s = {}
        with self._width():
            try:
                self.model, self.one = rbd.build(case.scene(), dt=dt, method=method)
            except ValueError as error:
                raise Refused(str(error).split("\n")[0]) from error
        method = self.model.method  # one program serves all numbers of steps, and of substeps but one
        self.key = (case.name, dataclasses.replace(method, substeps=min(method.substeps, 2)), dtype)

    def _width(self):
        return jax.enable_x64(True) if self.wide else contextlib.nullcontext()

    def _state(self, start: Motion):
        arrays = {k: getattr(start, k)[0] for k in ("pos", "quat", "vel", "omega")}
        return rbd.batch(self.one, len(arrays["pos"])).replace(**arrays)

    def motion(self, start, samples, steps_a_sample):
        """On one core where the scene is small: there a few steps would be, with a program of their own."""
        with self._width(), _cores(1 if self.model.n <= SMALL else None):
            state = self._state(start)
            self._compile(state, steps_a_sample)
            seen = [state]
            for _ in range(samples):
                state = self._after(state, steps_a_sample)
                seen.append(state)
            columns = [np.stack([np.asarray(getattr(s, k), np.float64) for s in seen])
                       for k in ("pos", "quat", "vel", "omega")]  # fmt: skip
        times = float(self.model.dt) * steps_a_sample * np.arange(samples + 1)
        return Motion(times, *columns)

    def timer(self, start, steps):
        with self._width():
            first = self._state(start)
        worlds = first.pos.shape[0]
        self.compile_s[worlds] = self._compile(first, steps)
        return functools.partial(self._run, first, steps), worlds, steps

    def _compile(self, state, steps) -> float:
        """Seconds that the program of samples ``steps`` apart takes to compile: its first call without what it runs."""
        key = (*self.key, state.pos.shape[0])
        if key not in _compiled:
            times = [time.perf_counter()]
            for _ in range(2):
                self._run(state, steps)
                times.append(time.perf_counter())
            _compiled[key] = max((times[1] - times[0]) - (times[2] - times[1]), 0.0)
        return _compiled[key]

    def _after(self, state, steps):
        return rbd.rollout(self.model, state, steps, every=steps)[0]

    def _run(self, state, steps):
        with self._width():
            jax.block_until_ready(self._after(state, steps))


ENGINE = Ours()
