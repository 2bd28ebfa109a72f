"""Engines that simulate one world at a time, told world after world."""

from __future__ import annotations

import abc
from collections.abc import Callable

import numpy as np

from ..case import Motion
from ..engine import Simulation

#: (pos, quat, vel, omega) of every body, each (n, 3 | 4).
State = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class WorldByWorld(Simulation):
    """What such an engine must say is how it begins, steps and is read.

    Attributes:
      dt: step [s].
    """

    dt: float

    @abc.abstractmethod
    def begin(self) -> None:
        """Forget everything, also what contacts remember."""

    @abc.abstractmethod
    def place(self, start: Motion, world: int) -> None:
        """Put the bodies where they start in this world."""

    @abc.abstractmethod
    def advance(self, steps: int) -> None: ...

    @abc.abstractmethod
    def state(self) -> State: ...

    def motion(self, start: Motion, samples: int, steps_a_sample: int) -> Motion:
        seen = []
        for world in range(start.pos.shape[1]):
            self.begin()
            self.place(start, world)
            states = [self.state()]
            for _ in range(samples):
                self.advance(steps_a_sample)
                states.append(self.state())
            seen.append(states)
        times = self.dt * steps_a_sample * np.arange(samples + 1)
        return Motion(times, *(np.array(x).swapaxes(0, 1) for x in zip(*map(columns, seen), strict=True)))

    def timer(self, start: Motion, steps: int) -> tuple[Callable[[], None], int, int]:
        self.begin()

        def call():
            self.place(start, 0)
            self.advance(steps)

        return call, 1, steps


def columns(rows) -> tuple[np.ndarray, ...]:
    """One array per column of the rows."""
    return tuple(np.array(c, np.float64) for c in zip(*rows, strict=True))
