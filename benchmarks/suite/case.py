"""What is simulated: a scene, its start states, the truth that an engine's motion is judged by."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

import rbd_jax as rbd


@dataclasses.dataclass(frozen=True)
class Motion:
    """Bodies at sample times, float64, the first sample being the start.

    Attributes:
      time: (T,) [s]. pos: (T, B, n, 3) centres of mass [m]. quat: (T, B, n, 4) w, x, y, z, body to world.
      vel: (T, B, n, 3) of the centres [m/s]. omega: (T, B, n, 3) in the world frame [rad/s].
    """

    time: np.ndarray
    pos: np.ndarray
    quat: np.ndarray
    vel: np.ndarray
    omega: np.ndarray

    @property
    def start(self) -> Motion:
        """The first sample alone, which is what an engine is given."""
        return Motion(*(np.asarray(getattr(self, f.name))[:1] for f in dataclasses.fields(self)))

    def worlds(self, n: int) -> Motion:
        """The first ``n`` worlds, repeated where there are fewer."""
        pick = np.arange(n) % self.pos.shape[1]
        return Motion(self.time, *(getattr(self, k)[:, pick] for k in ("pos", "quat", "vel", "omega")))

    @property
    def finite(self) -> np.ndarray:
        """(B,) worlds whose numbers are all finite."""
        good = [np.isfinite(getattr(self, k)).all(axis=(0, 2, 3)) for k in ("pos", "quat", "vel", "omega")]
        return np.logical_and.reduce(good)


@dataclasses.dataclass(frozen=True)
class Part:
    """A moving body as every engine can be told it: one shape at its centre of mass.

    Attributes:
      kind: "sphere" or "box". size: (1,) radius or (3,) half-extents [m]. mass: [kg]. inertia: (3,) principal
        moments along the axes of the shape [kg m^2].
    """

    kind: str
    size: tuple[float, ...]
    mass: float
    inertia: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Case:
    """One problem.

    Attributes:
      name: of the row; title: of the chart; group: "free", "impact", "friction", "rest" or "pile".
      parts: the moving bodies; planes: (point, unit normal) of the static half-spaces, solid below.
      friction, restitution: of every pair alike; None: frictionless, or as inelastic as the engine can.
      gravity: (3,) [m/s^2].
      starts: (worlds, generator) -> (pos, quat, vel, omega), each (B, n, 3 | 4).
      seconds: simulated; samples: equal parts it is looked at.
      truth: start -> Motion of the rigid bodies; None where only statistics are judged (``error`` then gets None).
      reference: where the truth comes from; bound: its error, in the unit of ``error``.
      error: (motion, truth, case) -> (B,) error of each world; unit: in words.
      distance: (motion, other, case) -> (B,) between two runs of one engine; None: a chaotic case, not asked.
      steps: the sweep [s], coarse to fine; every one divides seconds / samples.
      features: what the scene uses, of "attitude", "contact", "friction", "restitution", "pairs".
      worlds: random starts whose error is taken.
    """

    name: str
    title: str
    group: str
    parts: tuple[Part, ...]
    planes: tuple[tuple, ...]
    friction: float | None
    restitution: float | None
    gravity: tuple[float, float, float]
    starts: Callable
    seconds: float
    samples: int
    truth: Callable | None
    reference: str
    bound: float
    error: Callable
    unit: str
    distance: Callable | None
    steps: tuple[float, ...]
    features: frozenset
    worlds: int = 64

    def __post_init__(self):
        for dt in self.steps:
            self.steps_a_sample(dt)
        unknown = self.features - {"attitude", "contact", "friction", "restitution", "pairs"}
        if unknown:
            raise ValueError(f"case '{self.name}': unknown feature {sorted(unknown)[0]!r}")

    def steps_a_sample(self, dt: float) -> int:
        """Steps of ``dt`` [s] between two samples.

        Raises:
          ValueError: the samples do not lie on the grid of dt.
        """
        count = self.seconds / self.samples / dt
        if abs(count - round(count)) > 1e-6 * count or round(count) < 1:
            raise ValueError(f"case '{self.name}': dt = {dt:g} s does not divide {self.seconds / self.samples:g} s")
        return round(count)

    def start(self, worlds: int | None = None, seed: int = 1) -> Motion:
        """Start states of ``worlds`` worlds (default: those whose error is taken)."""
        arrays = self.starts(worlds or self.worlds, np.random.default_rng(seed))
        return Motion(np.zeros(1), *(np.asarray(a, np.float64)[None] for a in arrays))

    def scene(self) -> rbd.Scene:
        """The case as a scene of ours, at the first start state."""
        start = self.start(1)
        contact = {"friction": self.friction, "restitution": self.restitution}
        bodies = [
            rbd.Body(
                f"body{k}", rbd.Box(p.size) if p.kind == "box" else rbd.Sphere(*p.size), mass=p.mass,
                inertia=tuple(p.inertia), pos=tuple(start.pos[0, 0, k]), quat=tuple(start.quat[0, 0, k]), **contact,
            )
            for k, p in enumerate(self.parts)
        ]  # fmt: skip
        static = [
            rbd.Geom(rbd.Plane(), pos=tuple(map(float, point)), quat=upright(normal), **contact)
            for point, normal in self.planes
        ]
        return rbd.Scene(bodies, static, gravity=self.gravity, dt=self.steps[0], name=self.name)


def upright(normal) -> tuple[float, ...]:
    """Quaternion that turns z into the unit vector ``normal``."""
    x, y, z = normal
    if z < -1 + 1e-12:
        return (0.0, 1.0, 0.0, 0.0)
    q = np.array([1 + z, -y, x, 0.0])
    return tuple(q / np.linalg.norm(q))


def sphere(radius: float, mass: float = 1.0) -> Part:
    return Part("sphere", (radius,), mass, (0.4 * mass * radius**2,) * 3)


def box(half, mass: float = 1.0) -> Part:
    a, b, c = half
    moments = (b * b + c * c, a * a + c * c, a * a + b * b)
    return Part("box", tuple(map(float, half)), mass, tuple(mass / 3 * m for m in moments))
