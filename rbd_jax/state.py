"""Layer 3: the state of the worlds as the user sees it, and its conversion to the hot layout.

Leaves are components with the batch axes first: ``x.x`` is (..., n). The arrays ``pos``, ``vel``,
``quat``, ``omega`` are assembled when they are read. A trajectory is a State too, whose leaves have
the sample axis after the batch axes.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from .bodies import Bodies
from .spatial import Mat3, Quat, Vec3, components, pack
from .struct import struct


@struct
class Wrench:
    """Force [N] and torque [N m] about the centre of mass, world frame, each (..., n, 3) or None."""

    force: jax.Array | None = None
    torque: jax.Array | None = None


@struct
class Kinematic:
    """Bodies whose motion is prescribed: pose and velocity, leaves (..., k)."""

    x: Vec3
    q: Quat
    v: Vec3
    w: Vec3


@struct
class Memory:
    """What a method carries from step to step; every part may be None.

    L: angular momentum the last step ended with, leaves (..., n): the exact value behind omega (anisotropic bodies).
    R: rotation matrix, for integrators that carry one.
    contacts: impulses of the last step per group, leaves (..., S, P); a normal impulse that was an impact is
      stored negative, as the next step must not start from it. feature: their codes (..., P);
    pairs: the candidate pairs of groups that choose theirs at run time, (..., C).
    """

    L: Vec3 | None = None
    R: Mat3 | None = None
    contacts: tuple = ()
    feature: tuple = ()
    pairs: tuple = ()


@struct
class State:
    """State of n bodies in any number of worlds.

    Properties (world frame, SI): ``pos`` and ``vel`` of the centre of mass (..., n, 3), ``quat``
    (..., n, 4) = (w, x, y, z) of the body frame as the scene wrote it, ``omega`` (..., n, 3),
    ``time`` (...) [s] = step x dt, ``kinematic_pos/quat/vel/omega`` of kinematic bodies.
    ``step`` counts steps, ``status`` holds :class:`rbd_jax.Status` bits per world.
    """

    x: Vec3
    v: Vec3
    q: Quat
    w: Vec3
    step: jax.Array
    status: jax.Array
    dt: jax.Array
    kinematic: Kinematic | None = None
    memory: Memory | None = None

    pos = property(lambda s: pack(s.x))
    vel = property(lambda s: pack(s.v))
    quat = property(lambda s: pack(s.q))
    omega = property(lambda s: pack(s.w))
    time = property(lambda s: s.step * s.dt)
    kinematic_pos = property(lambda s: pack(s._prescribed().x))
    kinematic_quat = property(lambda s: pack(s._prescribed().q))
    kinematic_vel = property(lambda s: pack(s._prescribed().v))
    kinematic_omega = property(lambda s: pack(s._prescribed().w))

    def _prescribed(self) -> Kinematic:
        if self.kinematic is None:
            raise AttributeError("this scene has no kinematic bodies")
        return self.kinematic

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return tuple(self.x.x.shape[:-1])

    @property
    def n(self) -> int:
        return self.x.x.shape[-1]

    def replace(self, **changes) -> State:
        """Return a copy with ``pos``, ``vel``, ``quat``, ``omega``, ``kinematic_*``, ``step``, ``status`` changed.

        Arrays have the shape of what they replace, or broadcast to it. Quaternions are normalised. A new ``quat`` keeps
        omega; a new attitude or omega drops the memory of the angular momentum.

        Raises:
          ValueError: unknown field or wrong shape.
        """
        fields = {"pos": "x", "vel": "v", "quat": "q", "omega": "w"}
        new, moved = {}, {}
        for name, value in changes.items():
            prescribed = name.startswith("kinematic_")
            short = fields.get(name.removeprefix("kinematic_"))
            if short is not None:
                owner = self._prescribed() if prescribed else self
                old = getattr(owner, short)
                value = _split(name, value, old)
                (moved if prescribed else new)[short] = value.normalised() if short == "q" else value
            elif name in ("step", "status", "memory", "dt"):
                new[name] = value
            else:
                raise ValueError(
                    f"State has no field '{name}'; fields: pos, vel, quat, omega, kinematic_*, step, status"
                )
        if moved:
            new["kinematic"] = self.kinematic._with(**moved)
        if ("quat" in changes or "omega" in changes) and self.memory is not None and "memory" not in changes:
            memory = self.memory
            if memory.L is not None:
                memory = memory._with(L=memory.L.map(lambda c: jnp.full_like(c, jnp.nan)))
            if memory.R is not None and "quat" in changes:
                memory = memory._with(R=None)
            new["memory"] = memory
        return self._with(**new)

    def __repr__(self):
        shape = lambda a: "x".join(map(str, jnp.shape(a))) or "scalar"
        worlds = "x".join(map(str, self.batch_shape)) or "1 world"
        return f"State({worlds}, {self.n} bodies, leaves {shape(self.x.x)} {self.x.x.dtype}, step {shape(self.step)})"


def _split(name: str, value, old):
    """Components of ``value`` (..., k), which must have the shape of ``old`` or broadcast to it."""
    k = len(components(old))
    value = jnp.asarray(value, old.x.dtype)
    want = (*old.x.shape, k)
    try:
        value = jnp.broadcast_to(value, want)
    except ValueError:
        raise ValueError(f"State.{name} has shape {value.shape}; this state needs {want}") from None
    return type(old)(*(value[..., i] for i in range(k)))


def batch(state: State, *sizes: int) -> State:
    """Return ``state`` repeated along new leading batch axes, e.g. ``batch(state, 1024)``.

    Raises:
      ValueError: a size that is not a positive integer.
    """
    for size in sizes:
        if not isinstance(size, (int, np.integer)) or size < 1:
            raise ValueError(f"batch size = {size!r} must be an integer >= 1")
    return jax.tree.map(lambda c: jnp.broadcast_to(c, (*sizes, *jnp.shape(c))), state)


# --- public (batch first) <-> hot (batch innermost) ---


def to_hot(tree, batch: tuple[int, ...]):
    """Leaves (batch..., k...) -> (k..., B), B = prod(batch)."""
    size = math.prod(batch)

    def convert(c):
        c = c.reshape(size, *c.shape[len(batch) :])
        return jnp.moveaxis(c, 0, -1)

    return jax.tree.map(convert, tree)


def to_public(tree, batch: tuple[int, ...]):
    """Leaves (k..., B) -> (batch..., k...)."""

    def convert(c):
        c = jnp.moveaxis(c, -1, 0)
        return c.reshape(*batch, *c.shape[1:])

    return jax.tree.map(convert, tree)


@struct
class World:
    """The hot state: everything a step changes, batch innermost."""

    bodies: Bodies
    quat: Quat | None  # attitude where bodies.q is None: carried through unchanged
    spin: Vec3 | None
    kinematic: Kinematic | None
    contacts: tuple
    feature: tuple
    pairs: tuple
    step: jax.Array
    status: jax.Array
