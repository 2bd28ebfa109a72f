"""Layer 6: the model: static structure (selects the program) and traced numbers.

Absence is None, zero is a value: a leaf that the scene does not mention is None and leaves no
operation in the compiled program; one that it mentions as 0.0 is compiled in.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math

import jax
import jax.numpy as jnp
import numpy as np

from .bodies import Inertia
from .contact import NARROW
from .contact.base import Pose
from .method import Method
from .scene import CONDIMS
from .spatial import Quat, Vec3
from .struct import static, struct


@dataclasses.dataclass(frozen=True)
class Choice:
    """How a group with many pairs chooses them at run time (numpy, static); see ``contact.broadphase`` for keys.

    a, b: geoms of both sides, ascending; one list if ``same`` (pairs i < j). body_a, body_b: their bodies.
    allowed: bits of the pairs of the group among all of them, None = all. candidates: places of the search on
    a grid, None: everything is compared with everything. override_keys: keys of pairs with values of their own,
    ascending; override_rows: rows of the model's pair leaves. priority: of the geoms of both sides, None = equal.
    law_rows: rows of the resolved pairs whose contact laws differ; law_of: which of them a key has, None = the first.
    """

    a: np.ndarray
    b: np.ndarray
    body_a: np.ndarray
    body_b: np.ndarray
    same: bool
    allowed: np.ndarray | None
    candidates: int | None
    override_keys: np.ndarray
    override_rows: np.ndarray
    priority: tuple[np.ndarray, np.ndarray] | None
    law_rows: np.ndarray
    law_of: np.ndarray | None


@dataclasses.dataclass(frozen=True)
class Group:
    """All pairs of one kind and category (numpy, static).

    a, b: geom rows of the pairs in canonical order of kinds. body_a, body_b: rows of the dynamic or
    kinematic body. category: what the partner is. flip: the moving body is A, so the normal of the
    narrow phase points away from it. central_*: the geom is a sphere whose centre is the centre of
    mass. friction, restitution, torsion, rolling: whether its pairs have them. source_a, source_b: geoms
    whose friction combines (``ResolvedScene.pair_sources``). capacity: None, or how many pairs are kept at
    run time, as ``choice`` says. override: rows of the model's pair leaves, -1 = none. rows: rows of the
    resolved pairs.
    padding: pairs that repeat another one to give the colours one width; their slots are dead.
    """

    kind: tuple[str, str]
    category: str
    flip: bool
    a: np.ndarray
    b: np.ndarray
    body_a: np.ndarray
    body_b: np.ndarray
    central_a: bool
    central_b: bool
    friction: bool
    restitution: bool
    torsion: bool
    rolling: bool
    source_a: np.ndarray
    source_b: np.ndarray
    override: np.ndarray
    rows: np.ndarray
    colours: tuple[tuple[int, int], ...] = ()
    capacity: int | None = None
    padding: np.ndarray | None = None
    choice: Choice | None = None

    @property
    def moving(self) -> tuple[np.ndarray | None, np.ndarray]:
        """Body rows (A or None, B) of the contact rows: a single moving body is always B."""
        if self.category == "dynamic":
            return self.body_a, self.body_b
        return None, (self.body_a if self.flip else self.body_b)

    @property
    def slots(self) -> int:
        return NARROW[self.kind].slots

    @property
    def features(self) -> bool:
        """Whether a slot may hold another feature in the next step (else the slot is the feature)."""
        return self.kind == ("box", "box")


class Structure:
    """Everything about a model that selects its program; hashable by content, so equal scenes share one."""

    def __init__(self, **fields):
        self.__dict__.update(fields)
        self._digest = hashlib.sha1(
            repr(sorted((k, _plain(v)) for k, v in fields.items() if k != "names")).encode()
        ).digest()

    @property
    def uncoupled(self) -> bool:
        """Whether nothing touches but single points of bodies and fixed geometry, so that a step is short."""
        return all(g.slots == 1 and g.category != "dynamic" for g in self.groups)

    @property
    def chooses(self) -> bool:
        """Whether a group chooses its pairs at run time by looking at all of them."""
        return any(g.choice is not None and g.choice.candidates is None for g in self.groups)

    def __hash__(self):
        return hash(self._digest)

    def __eq__(self, other):
        return isinstance(other, Structure) and self._digest == other._digest


def _plain(value):
    if isinstance(value, np.ndarray):
        return (value.shape, str(value.dtype), hashlib.sha1(np.ascontiguousarray(value)).hexdigest())
    if dataclasses.is_dataclass(value):
        return tuple(_plain(getattr(value, f.name)) for f in dataclasses.fields(value))
    if isinstance(value, (tuple, list)):
        return tuple(_plain(v) for v in value)
    return value


jax.tree_util.register_static(Structure)

#: Axes of every leaf without batch axes.
BASE_NDIM = dict(
    dt=0,
    gravity=1,
    drag=1,
    smoothing=1,
    mass=1,
    friction=1,
    restitution=1,
    radius=1,
    half_extents=2,
    geom_pos=2,
    geom_quat=2,
    static_pos=2,
    static_quat=2,
    pair_friction=1,
    pair_restitution=1,
    torsional_friction=1,
    rolling_friction=1,
    pair_torsional_friction=1,
    pair_rolling_friction=1,
    com=2,
    principal=2,
)


@struct
class Model:
    """A compiled scene. All leaves but ``structure`` and ``method`` are traced and may be changed with
    :meth:`replace`, batched per world (batch axes first) and differentiated.

    Attributes (n bodies, g geoms in the order of ``names.geoms``):
      dt: [s]. gravity: (3,) [m/s^2]. drag: (2,) linear and angular rate [1/s].
      smoothing: (2,) normal and slip speed [m/s] of a solver that smooths contact; (0, 0) is contact as it is.
      mass: (n,) [kg]. inertia: (n,) when all bodies are isotropic, else (n, 3) principal moments in
        the order of the body's axes [kg m^2].
      friction, restitution: (g,) [-]. pair_friction, pair_restitution: (overridden pairs,).
      torsional_friction, rolling_friction: (g,) [m]. pair_torsional_friction, pair_rolling_friction: likewise.
      radius: (spheres,) [m]. half_extents: (boxes, 3) [m], both in geom order.
      geom_pos, geom_quat: (geoms of bodies, 3 | 4) in the body frame; static_pos, static_quat: of
        static geoms in the world.
      com: (n, 3) centre of mass in the body frame [m]. principal: (n, 4) principal frame in the
        body frame. laws: MuJoCo's softness per group of pairs, with the "mujoco" contact model.
    """

    structure: Structure = static()
    method: Method = static()
    dt: jax.Array = None
    mass: jax.Array = None
    inertia: jax.Array | None = None
    gravity: jax.Array | None = None
    drag: jax.Array | None = None
    friction: jax.Array | None = None
    restitution: jax.Array | None = None
    pair_friction: jax.Array | None = None
    pair_restitution: jax.Array | None = None
    torsional_friction: jax.Array | None = None
    rolling_friction: jax.Array | None = None
    pair_torsional_friction: jax.Array | None = None
    pair_rolling_friction: jax.Array | None = None
    radius: jax.Array | None = None
    half_extents: jax.Array | None = None
    geom_pos: jax.Array | None = None
    geom_quat: jax.Array | None = None
    static_pos: jax.Array | None = None
    static_quat: jax.Array | None = None
    com: jax.Array | None = None
    principal: jax.Array | None = None
    laws: object = None
    smoothing: jax.Array | None = None

    @property
    def names(self):
        return self.structure.names

    @property
    def n(self) -> int:
        return self.structure.n

    def base_ndim(self, field: str) -> int:
        if field == "inertia":
            return 1 if self.structure.isotropic else 2
        return BASE_NDIM[field]

    def leaves(self):
        """(name, array) of every leaf that this scene has, but those of ``laws``."""
        named = ((name, getattr(self, name)) for name in ("inertia", *BASE_NDIM))
        return [(name, value) for name, value in named if value is not None]

    @functools.cached_property
    def batched(self) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """(name, batch axes) of the leaves that have such."""
        axes = [(name, tuple(value.shape[: value.ndim - self.base_ndim(name)])) for name, value in self.leaves()]
        return tuple((name, own) for name, own in axes if own)

    @functools.cached_property
    def with_open_substeps(self) -> Model:
        """The same, whose method leaves the number of substeps to an argument."""
        return self._with(method=dataclasses.replace(self.method, substeps=None))

    def replace(self, **leaves) -> Model:
        """Return a copy with other numbers; never recompiles unless shapes gain batch axes.

        Leaves are independent: a new size does not change the mass.

        Raises:
          ValueError: an unknown field, a field that this scene does not mention (absent, None), or
            a shape that is neither the leaf's nor the leaf's with batch axes in front.
        """
        for name, value in leaves.items():
            if name not in BASE_NDIM and name != "inertia":
                raise ValueError(f"Model has no leaf '{name}'; leaves: {', '.join(sorted([*BASE_NDIM, 'inertia']))}")
            old = getattr(self, name)
            if old is None:
                raise ValueError(
                    f"Model.{name} is absent: the scene does not mention it, so nothing was compiled for it; "
                    "mention it in the scene (0.0 is a value)"
                )
            value = jnp.asarray(value, old.dtype)
            base = old.shape[old.ndim - self.base_ndim(name) :]
            if value.shape[value.ndim - len(base) :] != base or value.ndim < len(base):
                raise ValueError(
                    f"Model.{name} has shape {value.shape}; it needs {base}, with batch axes in front if any"
                )
            if not isinstance(value, jax.core.Tracer):
                _check_number(name, np.asarray(value))
            leaves[name] = value
        return self._with(**leaves)

    def __repr__(self):
        s = self.structure
        shown = ", ".join(name for name, _ in self.leaves())
        return f"Model({s.n} bodies, {len(s.kinds)} geoms, {sum(len(g.a) for g in s.groups)} pairs; {shown})"


def _check_number(name: str, value: np.ndarray) -> None:
    rules = {
        "dt": (value > 0, "> 0 [s]"),
        "mass": (value > 0, "> 0 [kg]"),
        "inertia": (value > 0, "> 0 [kg m^2]"),
        "radius": (value > 0, "> 0 [m]"),
        "half_extents": (value > 0, "> 0 [m]"),
        **{f: (value >= 0, ">= 0") for f in CONDIMS},
        "smoothing": (value >= 0, ">= 0 [m/s]"),
        "restitution": ((value >= 0) & (value <= 1), "in 0..1"),
        **{"pair_" + f: (value >= 0, ">= 0") for f in CONDIMS},
        "pair_restitution": ((value >= 0) & (value <= 1), "in 0..1"),
    }
    ok, rule = rules.get(name, (np.ones_like(value, bool), "finite"))
    bad = ~(ok & np.isfinite(value))
    if bad.any():
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(f"Model.{name}{list(where)} = {value[where] if where else value} must be finite and {rule}")


# --- the hot form of the numbers ---


@struct
class Coefficient:
    """A coefficient of the geoms of both sides, and the values that pairs have of their own: (k, 1 or B)."""

    a: jax.Array
    b: jax.Array
    own: jax.Array | None


@struct
class GroupParams:
    """Numbers of one group, (P, 1) or (P, B). Poses are in the frame of their body or the world.

    Of a group with a ``Choice`` they are those of its geoms: sizes and poses (k, 1 or B), every coefficient a
    ``Coefficient``, the law one entry for each that differs.
    """

    size_a: tuple
    size_b: tuple
    local_a: Pose | None
    local_b: Pose | None
    mu: jax.Array | None
    e: jax.Array | None
    law: object
    mu_spin: jax.Array | None = None
    mu_roll: jax.Array | None = None


@struct
class Params:
    """The numbers of a model in the hot layout: (n, 1), or (n, B) where a leaf has batch axes.

    h: length of a substep; substeps: of a step, where that is no part of the program (int32), else None.
    """

    h: jax.Array
    mass: jax.Array
    inv_mass: jax.Array
    groups: tuple
    one: jax.Array
    inertia: Inertia | None = None
    gravity: Vec3 | None = None
    drag: tuple | None = None
    com: Vec3 | None = None
    principal: Quat | None = None
    smoothing: tuple | None = None
    substeps: jax.Array | None = None


def leaf(model: Model, name: str, batch: tuple[int, ...]) -> jax.Array | None:
    """A leaf as (k..., 1), or (k..., B) when it has batch axes."""
    value = getattr(model, name)
    if value is None:
        return None
    base = model.base_ndim(name)
    own = value.shape[: value.ndim - base]
    if not own:
        return value[..., None]
    tail = value.shape[value.ndim - base :]
    value = value.reshape(*own, *(1,) * (len(batch) - len(own)), *tail)
    value = jnp.broadcast_to(value, (*batch, *tail))
    return jnp.moveaxis(value.reshape(math.prod(batch), *tail), 0, -1)


def _vec3(x: jax.Array) -> Vec3:
    """Vec3 from (k, 3, B)."""
    return Vec3(x[:, 0], x[:, 1], x[:, 2])


def _quat(x: jax.Array) -> Quat:
    return Quat(x[:, 0], x[:, 1], x[:, 2], x[:, 3]).normalised()


def batch_of(model: Model, batch: tuple[int, ...]) -> tuple[int, ...]:
    """Batch axes of a state of ``batch`` under this model: a batched model makes a batch of worlds.

    The batch axes of a leaf are aligned with the first batch axes of the state.

    Raises:
      ValueError: batch sizes that do not match, naming the leaf.
    """
    for name, own in model.batched:
        k = max(len(own), len(batch))
        try:
            batch = np.broadcast_shapes(batch + (1,) * (k - len(batch)), own + (1,) * (k - len(own)))
        except ValueError:
            raise ValueError(
                f"batch sizes do not match: Model.{name} has batch axes {own}, the state has {batch}"
            ) from None
    return tuple(batch)


def params(model: Model, batch: tuple[int, ...], one: jax.Array, substeps: jax.Array | None = None) -> Params:
    """The hot numbers of a model for worlds with batch axes ``batch``.

    substeps: traced, of a method that leaves them open (``Method.substeps`` None).
    """
    s = model.structure
    get = lambda name: leaf(model, name, batch)
    h = get("dt")[0] if model.dt.ndim == 0 else get("dt")
    parts = model.method.substeps if substeps is None else substeps.astype(h.dtype)
    if substeps is not None or parts > 1:  # by a constant XLA would multiply with the reciprocal, which rounds twice
        h = h / (parts * one)
    mass = get("mass")
    inertia = None
    if s.attitude:
        moments = get("inertia")
        if not s.isotropic:
            moments = Vec3(*_reordered((moments[:, 0], moments[:, 1], moments[:, 2]), s.axes))
        inertia = Inertia(moments)
    gravity = get("gravity")
    drag, smoothing = get("drag"), get("smoothing")
    return Params(
        h=h,
        mass=mass,
        inv_mass=1.0 / mass,
        groups=tuple(_group_params(model, g, i, get, batch) for i, g in enumerate(s.groups)),
        one=one,
        inertia=inertia,
        gravity=None if gravity is None else Vec3(gravity[0], gravity[1], gravity[2]),
        drag=None if drag is None else (drag[0], drag[1]),
        com=None if model.com is None else _vec3(get("com")),
        principal=_principal(model, get),
        smoothing=None if smoothing is None else (smoothing[0], smoothing[1]),
        substeps=substeps,
    )


def _reordered(values, axes: np.ndarray):
    """The three arrays (k, B) of a quantity per axis, in the order ``axes`` (k, 3) of the inner frame."""
    pick = lambda k: jnp.where(k == 0, values[0], jnp.where(k == 1, values[1], values[2]))
    return tuple(values[i] if (axes[:, i] == i).all() else pick(axes[:, i][:, None]) for i in range(3))


#: Attitude of a frame whose x, y, z lie along these axes of the body, up to sign (odd orders turn -x).
_H = np.sqrt(0.5)
TURNS = {
    (0, 1, 2): (1.0, 0.0, 0.0, 0.0),
    (1, 2, 0): (0.5, 0.5, 0.5, 0.5),
    (2, 0, 1): (0.5, -0.5, -0.5, -0.5),
    (1, 0, 2): (_H, 0.0, 0.0, -_H),
    (0, 2, 1): (0.0, 0.0, -_H, -_H),
    (2, 1, 0): (_H, 0.0, _H, 0.0),
}


def _principal(model: Model, get) -> Quat | None:
    """Attitude of the (permuted) principal frame in the body frame."""
    s = model.structure
    if not s.attitude:
        return None
    base = None if model.principal is None else _quat(get("principal"))
    if s.axes is None or (s.axes == [0, 1, 2]).all():
        return base
    turn = np.array([TURNS[tuple(a)] for a in s.axes.tolist()], model.mass.dtype)
    turn = Quat(*(jnp.asarray(turn[:, k : k + 1]) for k in range(4)))
    return turn if base is None else base @ turn


def _group_params(model: Model, g: Group, number: int, get, batch) -> GroupParams:
    s = model.structure

    def side(kind: str, geoms: np.ndarray, bodies: np.ndarray, moving: bool, category: str):
        rows = s.row[geoms]
        size = ()
        if kind == "sphere":
            size = (get("radius")[rows],)
        elif kind == "box":
            h = get("half_extents")[rows]
            h = (h[:, 0], h[:, 1], h[:, 2])
            size = _reordered(h, s.axes[bodies]) if moving and s.resized else h
        if category == "static":
            rows = s.static_row[geoms]
            return size, Pose(_vec3(get("static_pos")[rows]), _quat(get("static_quat")[rows]))
        if model.geom_pos is None:
            return size, None
        x = _vec3(get("geom_pos")[geoms])
        q = _quat(get("geom_quat")[geoms])
        if moving:
            if model.com is not None:
                x = x - _vec3(get("com")[bodies])
            frame = _principal(model, get)
            if frame is not None:
                frame = jax.tree.map(lambda c: c[bodies], frame)
                x, q = frame.rotate_inv(x), frame.conj() @ q
        return size, Pose(x, q)

    cat_a = "dynamic" if g.category == "dynamic" or g.flip else g.category
    cat_b = "dynamic" if g.category == "dynamic" or not g.flip else g.category
    listed = g.choice or g
    size_a, local_a = side(g.kind[0], listed.a, listed.body_a, cat_a == "dynamic", cat_a)
    size_b, local_b = side(g.kind[1], listed.b, listed.body_b, cat_b == "dynamic", cat_b)

    def combined(name: str, used: bool, a: np.ndarray, b: np.ndarray):
        """Larger of the two geoms, then the pair's own value."""
        if not used:
            return None
        values = get(name)
        own = get("pair_" + name)
        if values is None:
            values = jnp.zeros((len(s.kinds), 1), model.mass.dtype)
        if g.choice is not None:
            return Coefficient(values[listed.a], values[listed.b], own if len(g.choice.override_keys) else None)
        value = jnp.maximum(values[a], values[b])
        if own is None:
            return value
        rows = g.override
        picked = own[np.maximum(rows, 0)]
        return jnp.where((rows >= 0)[:, None] & ~jnp.isnan(picked), picked, value)

    law = None
    if model.laws is not None:
        law = jax.tree.map(lambda c: c[..., None], model.laws[number])
    return GroupParams(
        size_a,
        size_b,
        local_a,
        local_b,
        combined("friction", g.friction, g.source_a, g.source_b),
        combined("restitution", g.restitution, g.a, g.b),
        law,
        combined("torsional_friction", g.torsion, g.source_a, g.source_b),
        combined("rolling_friction", g.rolling, g.source_a, g.source_b),
    )
