"""rbd_jax: presets, and integrators and solvers one by one."""

from __future__ import annotations

import contextlib
import functools
import math
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
#: A call shorter than this [s] is made longer, so that the cost of calling (about 0.1 ms) is not what is measured.
SHORT = 2e-3
#: A program that compiles in less [s] is made for every number of steps that is asked for.
QUICK = 2.0
#: A call of an error run has so many steps or more, where it can: a call of fewer costs more than they do.
CALLED = 8


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


@functools.cache
def _cost(key) -> list:
    """[seconds a step, seconds to compile] of a program and number of worlds, found by the first timing of a sweep."""
    return []


class _Simulation(Simulation):
    def __init__(self, case, method, dt, dtype):
        self.wide = dtype == "float64"
        self.key = (case.name, method, dtype)
        self.compile_s = {}
        self.counts, self.samples = [case.steps_a_sample(dt) for dt in case.steps], case.samples
        with self._width():
            try:
                self.model, self.one = rbd.build(case.scene(), dt=dt, method=method)
            except ValueError as error:
                raise Refused(str(error).split("\n")[0]) from error

    def _width(self):
        return jax.enable_x64(True) if self.wide else contextlib.nullcontext()

    def _state(self, start: Motion):
        arrays = {k: getattr(start, k)[0] for k in ("pos", "quat", "vel", "omega")}
        return rbd.batch(self.one, len(arrays["pos"])).replace(**arrays)

    def motion(self, start, samples, steps_a_sample):
        with self._width():
            state = self._state(start)
            seen = [state]
            chunk = math.gcd(steps_a_sample, *self.counts)  # one program for all steps of the sweep, or two
            if chunk < CALLED and steps_a_sample % (10 * chunk) == 0:
                chunk *= 10
            if not self.model.structure.groups:
                chunk = steps_a_sample  # quick to compile
            for _ in range(samples):
                for _ in range(steps_a_sample // chunk):
                    state = rbd.rollout(self.model, state, chunk, every=chunk)[0]
                seen.append(state)
            columns = [np.stack([np.asarray(getattr(s, k), np.float64) for s in seen])
                       for k in ("pos", "quat", "vel", "omega")]  # fmt: skip
        times = float(self.model.dt) * steps_a_sample * np.arange(samples + 1)
        return Motion(times, *columns)

    def timer(self, start, steps):
        with self._width():
            first = self._state(start)
        worlds = first.pos.shape[0]
        sample = min(self.counts)  # steps between two samples at the coarsest step, which divide all others
        lengths = [sample * self.samples, 10 * sample * self.samples]  # a program a step would take hours to compile
        if worlds > 1:
            lengths.insert(0, sample)
        cost = _cost((*self.key, worlds))
        if not cost:
            begin = time.perf_counter()
            self._run(first, lengths[0], lengths[0])
            self.compile_s[worlds] = time.perf_counter() - begin
            begin = time.perf_counter()
            self._run(first, lengths[0], lengths[0])
            cost += (time.perf_counter() - begin) / lengths[0], self.compile_s[worlds]
        chunk = lengths[0]
        for longer in lengths[1:]:
            if steps % longer == 0 and chunk * cost[0] < SHORT:
                chunk = longer
        if chunk * cost[0] < SHORT and cost[1] < QUICK:
            chunk = steps
        count = max(steps // chunk, 1) * chunk
        return functools.partial(self._run, first, count, chunk), worlds, count

    def _run(self, state, steps, chunk):
        with self._width():
            for _ in range(steps // chunk):
                state = rbd.rollout(self.model, state, chunk, every=chunk)[0]
            jax.block_until_ready(state)


ENGINE = Ours()
