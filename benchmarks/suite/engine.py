"""Who simulates: one adapter per engine, which is told a case and gives its motion and its time."""

from __future__ import annotations

import abc
from collections.abc import Callable

from .case import Case, Motion


class Refused(Exception):
    """The engine cannot express the case; the message is the reason, in a few words."""


class Simulation(abc.ABC):
    """A case loaded into an engine at one step."""

    @abc.abstractmethod
    def motion(self, start: Motion, samples: int, steps_a_sample: int) -> Motion:
        """Simulate every world of ``start``; ``samples`` + 1 samples, the first read back from the engine itself."""

    @abc.abstractmethod
    def timer(self, start: Motion, steps: int) -> tuple[Callable[[], None], int, int]:
        """(call, worlds, steps): ``call()`` advances the worlds by the steps, recording nothing that can be left out,
        and returns when it is done.

        As many worlds as ``start`` has or fewer, as many steps as asked or fewer, where the rate does not depend on
        the number. A start of one world asks for latency, one of many for throughput with all cores.
        """

    def close(self) -> None:  # noqa: B027 - most have nothing to give back
        """Give back threads and memory."""


class Engine(abc.ABC):
    """An engine and its ways to run.

    Attributes:
      name: of rows and options. title: in legends. colour: the same in every chart.
      variants: name -> what it is, in words; the first is what a user gets without asking.
      widths: dtypes it computes in.
      install: how to get it.
      any_number: whether the time per world of many worlds does not depend on their number, so that fewer may be timed.
      compiles: whether the first run at a step may compile a program.
      scales: whether ``timer`` runs the worlds on all cores; else the time per world of many worlds is divided by the
        number of cores, as if one process a core were started.
    """

    name: str
    title: str
    colour: str
    variants: dict[str, str]
    widths: tuple[str, ...] = ("float64",)
    install: str = ""
    scales: bool = True
    any_number: bool = False
    compiles: bool = False

    def missing(self) -> str | None:
        """None where it can be used here, else why not."""
        return None

    def version(self) -> str:
        return ""

    def most(self, case: Case) -> int:
        """Worlds at most that its programs are made for; errors are taken of no more."""
        return case.worlds

    def order(self, case: Case, variant: str) -> int | None:
        """Order in the step that its error should show above its floor; None: none is claimed."""
        return None

    @abc.abstractmethod
    def load(self, case: Case, variant: str, dt: float, dtype: str) -> Simulation:
        """The case, ready to run.

        Raises:
          Refused: it cannot be expressed.
        """
