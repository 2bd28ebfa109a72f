"""Layer 3: scenes as the user writes them, all validation of them, and their flat form.

Plain Python and numpy; no JAX array is made here. ``Scene`` is checked when it is made (a ``ValueError``
names body or geom, field, value and rule), ``resolve`` flattens it for the builder.

Absence is ``None``, zero is a value: what the scene does not mention leaves no operation in the program,
what it mentions as 0.0 is compiled in.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from .shapes import Shape

DEFAULT_DENSITY = 1000.0  # [kg/m^3] water, MuJoCo's default
UNIT_TOLERANCE = 1e-15  # [-] a quaternion this near to norm 1 is left as it is, as MuJoCo does (mjMINVAL)
INERTIA_TOLERANCE = 1e-9  # [-] relative; asymmetry and triangle inequality up to the rounding of typed digits
INTEGRATORS = ("euler", "implicitfast", "rk4")  # MuJoCo's integrators that rbd_jax reproduces
SOLVERS = ("pgs", "cg", "newton")  # MuJoCo's solvers; they only matter to an exported file
CATEGORIES = ("dynamic", "kinematic", "static")

DYNAMIC, KINEMATIC, STATIC = range(3)

#: Coefficients of friction in the order in which a contact gains them, with the contact dimension (MuJoCo's
#: condim) from which each acts: sliding, torsion about the normal, rolling about the tangents.
CONDIMS = {"friction": 3, "torsional_friction": 4, "rolling_friction": 6}


class _Unset(enum.Enum):
    UNSET = "unset"

    def __repr__(self):
        return "UNSET"


UNSET = _Unset.UNSET
"""Not given, where an explicit ``None`` means absent."""


# ---------------------------------------------------------------------------------------------------------
# What the user writes
# ---------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Geom:
    """A shape placed on a body or in the world, with its surface.

    It is checked when a ``Body`` or ``Scene`` takes it (so that messages can name the owner).

    Attributes:
      shape: ``Sphere``, ``Box`` or ``Plane``.
      pos: position in the body frame, or in the world for a static geom [m].
      quat: attitude (w, x, y, z) in the body frame or the world; normalised.
      friction: coefficient of friction [-], >= 0; ``None`` is frictionless, no operation compiled.
      restitution: coefficient of restitution [-], 0 to 1; ``None`` is absent.
      group: collision bits of this geom, MuJoCo's contype.
      mask: bits it collides with, MuJoCo's conaffinity. Two geoms collide if
        ``group_a & mask_b`` or ``group_b & mask_a``.
      name: unique among geoms; ``None`` takes one from the body (``"ball"``, or ``"ball:0"``, ``"ball:1"``).
      margin: distance at which a contact becomes active in the ``"mujoco"`` method [m]; the margins of a pair add.
      solref: MuJoCo's (time constant [s], damping ratio), or (-stiffness, -damping), of that method.
      solimp: MuJoCo's impedance (dmin, dmax, width [m], midpoint, power), of that method.
      condim: contact dimension the geom asks for: 1 frictionless, 3 sliding, 4 and torsional, 6 and rolling friction.
        ``None`` follows from the coefficients given; a smaller number leaves those beyond it to partners that ask
        for more. A pair has the larger condim and the larger of each coefficient, as in MuJoCo.
      torsional_friction: coefficient of friction against spin about the normal [m], >= 0: the couple is at most
        this times the normal force. ``None`` is absent; needs ``friction``. So far the ``"mujoco"`` method only.
      rolling_friction: the same against rolling, about the tangents [m]; needs ``torsional_friction``.
      priority: of two geoms that differ in it, the higher one alone gives condim, friction (all three coefficients),
        solref and solimp of the pair, as in MuJoCo; restitution and margin combine as ever.
    """

    shape: Shape
    pos: Any = (0.0, 0.0, 0.0)
    quat: Any = (1.0, 0.0, 0.0, 0.0)
    friction: float | None = 1.0
    restitution: float | None = None
    group: int = 1
    mask: int = 1
    name: str | None = None
    margin: float = 0.0
    solref: Any = (0.02, 1.0)
    solimp: Any = (0.9, 0.95, 0.001, 0.5, 2.0)
    condim: int | None = None
    torsional_friction: float | None = None
    rolling_friction: float | None = None
    priority: int = 0


@dataclasses.dataclass(frozen=True)
class Body:
    """A rigid body: dynamic in ``Scene.bodies``, with prescribed motion in ``Scene.kinematic``.

    Mass: ``mass`` with ``inertia``; or ``mass`` alone, with the inertia of the geoms at uniform density scaled
    to it; or ``density`` (1000 kg/m^3 if nothing is given). Geoms that overlap count twice, as in MuJoCo.
    A ``com`` given without ``inertia`` moves the centre of mass only: the inertia about it is then that of the
    geoms about their own centre.

    A kinematic body keeps ``vel`` and ``omega``; mass, density, com and inertia are ignored there.

    Attributes:
      name: unique among dynamic and kinematic bodies.
      geoms: a shape, a ``Geom``, or a list of either; a bare shape is a ``Geom`` at the origin.
      pos: position of the body frame in the world [m].
      quat: attitude (w, x, y, z) of the body frame in the world; normalised.
      vel: velocity of the centre of mass (kinematic: of the body frame's origin), world [m/s]; ``None`` is zero
        and not mentioned.
      omega: angular velocity, world [rad/s]; ``None`` is zero and not mentioned.
      mass: [kg].
      density: of all geoms [kg/m^3].
      com: centre of mass in the body frame [m]; ``None`` takes it from the geoms.
      inertia: about the centre of mass in body axes, 3 or 3x3 [kg m^2]; needs ``mass``.
      friction: shorthand that replaces the friction of all geoms (``None``: frictionless, without torsional or
        rolling friction either).
      restitution: shorthand that replaces the restitution of all geoms (``None``: absent).
    """

    name: str
    geoms: Any = ()
    pos: Any = (0.0, 0.0, 0.0)
    quat: Any = (1.0, 0.0, 0.0, 0.0)
    vel: Any = None
    omega: Any = None
    mass: float | None = None
    density: float | None = None
    com: Any = None
    inertia: Any = None
    friction: Any = UNSET
    restitution: Any = UNSET

    def __post_init__(self):
        if not isinstance(self.name, str):
            raise TypeError(f"body name = {self.name!r} must be a string")
        if not self.name:
            raise ValueError("body name = '' must not be empty")
        if self.name == "world":
            raise ValueError("body name = 'world' is taken: MuJoCo calls the fixed world so")
        who = f"body '{self.name}'"
        put = _setter(self)
        many = [self.geoms] if isinstance(self.geoms, (Shape, Geom)) else _items(self.geoms, f"{who}: geoms")
        put(
            "geoms",
            tuple(
                check_geom(g, f"{who}, {_geom_label(g, i)}" if len(many) > 1 or _name_of(g) else who)
                for i, g in enumerate(many)
            ),
        )
        put("pos", _vector(self.pos, 3, who, "pos", "[m]"))
        put("quat", _unit(self.quat, who))
        put("vel", None if self.vel is None else _vector(self.vel, 3, who, "vel", "[m/s]"))
        put("omega", None if self.omega is None else _vector(self.omega, 3, who, "omega", "[rad/s]"))
        put("mass", None if self.mass is None else _positive(self.mass, who, "mass", "[kg]"))
        put("density", None if self.density is None else _positive(self.density, who, "density", "[kg/m^3]"))
        put("com", None if self.com is None else _vector(self.com, 3, who, "com", "[m]"))
        put("inertia", None if self.inertia is None else _inertia(self.inertia, who))
        put("friction", _friction(self.friction, who, UNSET))
        put("restitution", _restitution(self.restitution, who, UNSET))
        if self.mass is not None and self.density is not None:
            raise ValueError(f"{who}: mass = {self.mass} and density = {self.density}: give one of them")
        if self.inertia is not None and self.mass is None:
            raise ValueError(f"{who}: inertia = {self.inertia} needs mass")

    @property
    def vel_mentioned(self) -> bool:
        """Whether the scene gives a velocity, even zero."""
        return self.vel is not None

    @property
    def omega_mentioned(self) -> bool:
        """Whether the scene gives an angular velocity, even zero."""
        return self.omega is not None


@dataclasses.dataclass(frozen=True)
class Pair:
    """What holds between two geoms, or between all geoms of two bodies, instead of the combination of both.

    Names are looked up as MJCF does: in an override a geom comes before a body of the same name, in an exclusion
    a body before a geom. An override between two geoms also makes them collide whatever their masks say,
    and wins over an exclusion or override that names a body.

    Attributes:
      a, b: names; a geom, or a body for all its geoms.
      friction: coefficient [-]; ``None`` is frictionless; ``UNSET`` combines the two geoms (larger value).
      torsional_friction, rolling_friction: coefficients [m], likewise.
      restitution: coefficient [-]; ``None`` is absent; ``UNSET`` combines the two geoms (larger value).
      exclude: the two never collide.
      solref, solimp, margin: as in ``Geom``, of the pair; ``None`` combines the two geoms.
      condim: contact dimension; ``None`` follows from the coefficients of the pair and the two geoms.
    """

    a: str
    b: str
    friction: Any = UNSET
    restitution: Any = UNSET
    exclude: bool = False
    solref: Any = None
    solimp: Any = None
    margin: float | None = None
    condim: int | None = None
    torsional_friction: Any = UNSET
    rolling_friction: Any = UNSET

    def __post_init__(self):
        for field in ("a", "b"):
            if not isinstance(getattr(self, field), str):
                raise TypeError(f"pair {field} = {getattr(self, field)!r} must be the name of a geom or body")
        who = f"pair ('{self.a}', '{self.b}')"
        put = _setter(self)
        put("friction", _friction(self.friction, who, UNSET))
        for field in ("torsional_friction", "rolling_friction"):
            put(field, _length_of_friction(getattr(self, field), who, field, UNSET))
        _check_nested(self, who)
        put("restitution", _restitution(self.restitution, who, UNSET))
        put("solref", None if self.solref is None else _solref(self.solref, who))
        put("solimp", None if self.solimp is None else _solimp(self.solimp, who))
        put("margin", None if self.margin is None else _nonnegative(self.margin, who, "margin", "[m]"))
        put("condim", None if self.condim is None else _condim(self.condim, who))
        if not isinstance(self.exclude, (bool, np.bool_)):
            raise TypeError(f"{who}: exclude = {self.exclude!r} must be True or False")
        given = [f.name for f in dataclasses.fields(self)[2:] if getattr(self, f.name) != f.default]
        if self.exclude and given != ["exclude"]:
            raise ValueError(f"{who}: exclude = True leaves no contact to set friction, restitution, ... of")


@dataclasses.dataclass(frozen=True)
class Scene:
    """Bodies, fixed geometry, and what acts on all of them. Checked when made.

    Attributes:
      bodies: dynamic bodies, at least one.
      static: shapes and ``Geom`` fixed in the world.
      kinematic: bodies that keep their given velocities whatever touches them (MJCF mocap).
      pairs: overrides and exclusions.
      gravity: acceleration [m/s^2]; ``None`` is absent.
      dt: time step [s].
      drag: rate of drag [1/s], >= 0, one for both or (linear, angular); ``None`` is absent.
        MJCF has no such field.
      name: of the scene; the model name in MJCF.
      integrator: MuJoCo's integrator, ``"euler"``, ``"implicitfast"`` or ``"rk4"``; used by the ``"mujoco"`` method.
      cone: friction cone; only ``"elliptic"``.
      impratio: MuJoCo's ratio of frictional to normal impedance [-].
      solver: MuJoCo's solver in an exported file: ``"newton"``, ``"cg"`` or ``"pgs"``.
      iterations: its limit of iterations.
      tolerance: its tolerance [-].
      refsafe: MuJoCo keeps solref's time constant at or above 2 dt.
    """

    bodies: Any = ()
    static: Any = ()
    kinematic: Any = ()
    pairs: Any = ()
    gravity: Any = (0.0, 0.0, -9.81)
    dt: float = 0.002
    drag: Any = None
    name: str = "scene"
    integrator: str = "euler"
    cone: str = "elliptic"
    impratio: float = 1.0
    solver: str = "newton"
    iterations: int = 100
    tolerance: float = 1e-8
    refsafe: bool = True

    def __post_init__(self):
        put = _setter(self)
        if not isinstance(self.name, str):
            raise TypeError(f"scene name = {self.name!r} must be a string")
        put("bodies", _typed(self.bodies, Body, "bodies"))
        put("kinematic", _typed(self.kinematic, Body, "kinematic"))
        put("pairs", _typed(self.pairs, Pair, "pairs"))
        many = [self.static] if isinstance(self.static, (Shape, Geom)) else _items(self.static, "scene: static")
        put("static", tuple(check_geom(g, f"static {_geom_label(g, i)}") for i, g in enumerate(many)))
        put("gravity", None if self.gravity is None else _vector(self.gravity, 3, "scene", "gravity", "[m/s^2]"))
        put("dt", _positive(self.dt, "scene", "dt", "[s]"))
        put("drag", None if self.drag is None else _drag(self.drag))
        put("impratio", _positive(self.impratio, "scene", "impratio", "[-]"))
        put("tolerance", _nonnegative(self.tolerance, "scene", "tolerance", "[-]"))
        put("integrator", _choice(self.integrator, INTEGRATORS, "integrator"))
        put("cone", _choice(self.cone, ("elliptic",), "cone"))
        put("solver", _choice(self.solver, SOLVERS, "solver"))
        put("iterations", _integer(self.iterations, 1, 2**31 - 1, "scene", "iterations"))
        if not isinstance(self.refsafe, (bool, np.bool_)):
            raise TypeError(f"scene: refsafe = {self.refsafe!r} must be True or False")
        put("refsafe", bool(self.refsafe))
        if not self.bodies:
            raise ValueError("scene: bodies = () must hold at least one dynamic body")
        _check_unique([b.name for b in self.bodies + self.kinematic], "body")
        owned = [g for b in self.bodies + self.kinematic for g in b.geoms]
        _check_unique([g.name for g in owned + list(self.static) if g.name is not None], "geom")
        for body in self.bodies:
            _check_dynamic(body)
        table = _geom_table(self)
        _check_pair_condims(table, *_find_pairs(self, table))


# ---------------------------------------------------------------------------------------------------------
# Checks of single values: each returns the canonical value or raises with owner, field, value and rule
# ---------------------------------------------------------------------------------------------------------


def check_geom(geom: Shape | Geom, owner: str) -> Geom:
    """Return ``geom`` (or a ``Geom`` of a bare shape) with canonical fields, or raise naming ``owner``."""
    if isinstance(geom, Shape):
        geom = Geom(geom)
    if not isinstance(geom, Geom):
        raise TypeError(f"{owner}: {geom!r} must be a shape or a Geom, not {type(geom).__name__}")
    if not isinstance(geom.shape, Shape):
        raise TypeError(f"{owner}: shape = {geom.shape!r} must be a Sphere, Box or Plane")
    if geom.name is not None and not isinstance(geom.name, str):
        raise TypeError(f"{owner}: name = {geom.name!r} must be a string or None")
    if geom.name == "":
        raise ValueError(f"{owner}: name = '' must not be empty")
    geom.shape.check(owner)
    _check_nested(geom, owner)
    return Geom(
        shape=geom.shape,
        pos=_vector(geom.pos, 3, owner, "pos", "[m]"),
        quat=_unit(geom.quat, owner),
        friction=_friction(geom.friction, owner),
        torsional_friction=_length_of_friction(geom.torsional_friction, owner, "torsional_friction"),
        rolling_friction=_length_of_friction(geom.rolling_friction, owner, "rolling_friction"),
        restitution=_restitution(geom.restitution, owner),
        group=_integer(geom.group, -(2**31), 2**31 - 1, owner, "group"),
        mask=_integer(geom.mask, -(2**31), 2**31 - 1, owner, "mask"),
        name=geom.name,
        margin=_nonnegative(geom.margin, owner, "margin", "[m]"),
        solref=_solref(geom.solref, owner),
        solimp=_solimp(geom.solimp, owner),
        condim=_geom_condim(geom, owner),
        priority=_integer(geom.priority, -(2**31), 2**31 - 1, owner, "priority"),
    )


def _setter(obj):
    return lambda field, value: object.__setattr__(obj, field, value)


def _name_of(geom):
    return geom.name if isinstance(geom, Geom) else None


def _geom_label(geom, i):
    name = _name_of(geom)
    return f"geom {i}" if name is None else f"geom '{name}'"


def _items(value, what):
    if isinstance(value, (str, bytes, dict)) or not isinstance(value, Iterable):
        raise TypeError(f"{what} = {value!r} must be a list")
    return list(value)


def _typed(value, kind, field):
    many = [value] if isinstance(value, kind) else _items(value, f"scene: {field}")
    for i, item in enumerate(many):
        if not isinstance(item, kind):
            raise TypeError(f"scene: {field}[{i}] = {item!r} must be a {kind.__name__}, not {type(item).__name__}")
    return tuple(many)


def _number(value, who, field, unit):
    if isinstance(value, (bool, np.bool_, str, bytes)) or value is None or np.ndim(value) != 0:
        raise TypeError(f"{who}: {field} = {value!r} must be a number {unit}".rstrip())
    try:
        return float(value)
    except (TypeError, ValueError):
        raise TypeError(f"{who}: {field} = {value!r} must be a number {unit}".rstrip()) from None


def _positive(value, who, field, unit):
    v = _number(value, who, field, unit)
    if not (math.isfinite(v) and v > 0):
        raise ValueError(f"{who}: {field} = {v} must be finite and > 0 {unit}".rstrip())
    return v


def _nonnegative(value, who, field, unit):
    v = _number(value, who, field, unit)
    if not (math.isfinite(v) and v >= 0):
        raise ValueError(f"{who}: {field} = {v} must be finite and >= 0 {unit}".rstrip())
    return v


def _friction(value, who, *also):
    if value is None or any(value is a for a in also):
        return value
    return _nonnegative(value, who, "friction", "[-]")


def _length_of_friction(value, who, field, *also):
    if value is None or any(value is a for a in also):
        return value
    return _nonnegative(value, who, field, "[m]")


def _check_nested(owner, who):
    """Each coefficient of friction needs those before it: a contact gains them in this order."""
    fields = list(CONDIMS)
    for before, field in zip(fields, fields[1:]):
        value = getattr(owner, field)
        if value is not None and value is not UNSET and getattr(owner, before) is None:
            raise ValueError(f"{who}: {field} = {value} needs {before} (0.0 is a value), not None")


def _restitution(value, who, *also):
    if value is None or any(value is a for a in also):
        return value
    v = _number(value, who, "restitution", "[-]")
    if not 0.0 <= v <= 1.0:
        raise ValueError(f"{who}: restitution = {v} must be between 0 and 1 [-]")
    return v


def _drag(value):
    if np.ndim(value) == 0:
        return _nonnegative(value, "scene", "drag", "[1/s]")
    v = _vector(value, 2, "scene", "drag", "[1/s]")
    if min(v) < 0:
        raise ValueError(f"scene: drag = {v} must be finite and >= 0 [1/s]")
    return v


def _vector(value, n, who, field, unit):
    try:
        v = tuple(float(x) for x in value)
    except (TypeError, ValueError):
        raise TypeError(f"{who}: {field} = {value!r} must be {n} numbers {unit}".rstrip()) from None
    if len(v) != n:
        raise ValueError(f"{who}: {field} = {v} must have {n} entries {unit}, not {len(v)}".replace(" ,", ","))
    if not all(map(math.isfinite, v)):
        raise ValueError(f"{who}: {field} = {v} must be finite {unit}".rstrip())
    return v


def _unit(value, who):
    q = _vector(value, 4, who, "quat", "(w, x, y, z)")
    norm = math.hypot(*q)
    if not norm > 0:
        raise ValueError(f"{who}: quat = {q} must not be zero")
    if abs(norm - 1.0) <= UNIT_TOLERANCE:
        return q
    scaled = tuple(x / max(map(abs, q)) for x in q)  # a tiny or huge quaternion would lose digits in its norm
    norm = math.hypot(*scaled)
    return tuple(x / norm for x in scaled)


def _inertia(value, who):
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise TypeError(f"{who}: inertia = {value!r} must be 3 or 3x3 numbers [kg m^2]") from None
    if array.shape not in ((3,), (3, 3)):
        raise ValueError(f"{who}: inertia = {value!r} must have shape (3,) or (3, 3), not {array.shape}")
    shown = array.tolist()
    if not np.isfinite(array).all():
        raise ValueError(f"{who}: inertia = {shown} must be finite [kg m^2]")
    full = np.diag(array) if array.ndim == 1 else array
    scale = np.abs(full).max()
    if np.abs(full - full.T).max() > INERTIA_TOLERANCE * scale:
        raise ValueError(f"{who}: inertia = {shown} must be symmetric")
    low, mid, high = np.linalg.eigvalsh((full + full.T) / 2) if array.ndim == 2 else np.sort(array)
    if not low > 0:
        raise ValueError(f"{who}: inertia = {shown} must be positive definite; its least moment is {low:.6g} [kg m^2]")
    if high - (low + mid) > INERTIA_TOLERANCE * high:
        raise ValueError(
            f"{who}: inertia = {shown} breaks the triangle inequality: principal moments "
            f"{low:.6g} + {mid:.6g} must be >= {high:.6g} [kg m^2]"
        )
    return tuple(shown) if array.ndim == 1 else tuple(map(tuple, shown))


def _solref(value, who):
    v = _vector(value, 2, who, "solref", "")
    if (v[0] > 0) != (v[1] > 0):
        raise ValueError(
            f"{who}: solref = {v} must be (time constant, damping ratio), both > 0, "
            "or (-stiffness, -damping), both <= 0"
        )
    return v


def _solimp(value, who):
    v = _vector(value, 5, who, "solimp", "")
    dmin, dmax, width, midpoint, power = v
    if not (0 <= dmin <= 1 and 0 <= dmax <= 1 and width >= 0 and 0 <= midpoint <= 1 and power >= 1):
        raise ValueError(
            f"{who}: solimp = {v} must be (dmin, dmax, width, midpoint, power) "
            "with dmin, dmax and midpoint in 0..1, width >= 0 [m], power >= 1"
        )
    return v


def _condim(value, who):
    v = _integer(value, 1, 6, who, "condim")
    if v not in (1, *CONDIMS.values()):
        raise ValueError(f"{who}: condim = {v} must be 1, 3, 4 or 6")
    return v


def _geom_condim(geom, who):
    """None where the number says no more than the coefficients do, so that equal geoms compare equal."""
    if geom.condim is None:
        return None
    v = _condim(geom.condim, who)
    given = max([3, *(d for f, d in CONDIMS.items() if getattr(geom, f) is not None)])
    for field, least in CONDIMS.items():
        if least > 3 and v >= least > given:
            raise ValueError(f"{who}: condim = {v} needs {field} (0.0 is a value), not None")
    return v if v < given else None


def _integer(value, low, high, who, field):
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{who}: {field} = {value!r} must be an integer")
    if not low <= value <= high:
        raise ValueError(f"{who}: {field} = {value} must be between {low} and {high}")
    return int(value)


def _choice(value, allowed, field):
    if value not in allowed:
        raise ValueError(f"scene: {field} = {value!r} must be one of {', '.join(map(repr, allowed))}")
    return value


def _check_unique(names, what):
    seen = set()
    for name in names:
        if name in seen:
            raise ValueError(f"{what} '{name}': name is given twice; {what} names must be unique")
        seen.add(name)


def _check_dynamic(body):
    who = f"body '{body.name}'"
    for i, g in enumerate(body.geoms):
        if not g.shape.solid:
            raise ValueError(
                f"{who}, {_geom_label(g, i)}: shape = {g.shape.kind} must not be on a dynamic body; "
                "it is infinite: make it static or kinematic"
            )
    if not body.geoms and body.mass is None:
        raise ValueError(f"{who}: geoms = () and mass = None: a body without geoms needs mass and inertia")
    if not body.geoms and body.inertia is None:
        raise ValueError(f"{who}: inertia = None: a body without geoms needs mass and inertia")


# ---------------------------------------------------------------------------------------------------------
# The flat form
# ---------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class ResolvedScene:
    """A scene flattened into numpy arrays, f64; n dynamic bodies, k kinematic ones, g geoms, p geom pairs.

    Geoms come in the order of dynamic bodies, kinematic bodies, static geoms. Where a value is absent the
    array holds 0 (an absent coefficient counts as 0 beside a given one) and the ``has`` array False.

    Attributes:
      scene: what was resolved.
      body_names: n names.
      mass: (n,) [kg].
      com: (n, 3) centre of mass in the body frame [m].
      inertia: (n, 3, 3) about the centre of mass in body axes [kg m^2], symmetric.
      pos: (n, 3) body frame in the world [m].
      quat: (n, 4) body frame in the world.
      vel: (n, 3) of the centre of mass, world [m/s].
      omega: (n, 3) world [rad/s].
      vel_mentioned: (n,) bool.
      omega_mentioned: (n,) bool.
      kinematic_names: k names.
      kinematic_pos: (k, 3) body frame [m].
      kinematic_quat: (k, 4).
      kinematic_vel: (k, 3) of the body frame's origin, world [m/s].
      kinematic_omega: (k, 3) world [rad/s].
      kinematic_vel_mentioned: (k,) bool.
      kinematic_omega_mentioned: (k,) bool.
      geom_names: g unique names.
      geom_shapes: g shapes.
      geom_category: (g,) index into ``CATEGORIES``.
      geom_body: (g,) index of the dynamic or kinematic body; -1 for static.
      geom_pos: (g, 3) in the body frame, or the world for static [m].
      geom_quat: (g, 4).
      geom_friction: (g,) [-].
      geom_has_friction: (g,) bool: not ``None``.
      geom_torsional_friction, geom_rolling_friction: (g,) [m].
      geom_has_torsional_friction, geom_has_rolling_friction: (g,) bool.
      geom_restitution: (g,) [-].
      geom_has_restitution: (g,) bool.
      geom_group: (g,) int64.
      geom_mask: (g,) int64.
      geom_margin: (g,) [m].
      geom_solref: (g, 2).
      geom_solimp: (g, 5).
      geom_condim: (g,) 1, 3, 4 or 6; 1 for a geom without friction.
      geom_priority: (g,) int64.
      pairs: (p, 2) geom indices, first < second, sorted; at least one side is dynamic.
      overrides: row of ``pairs`` -> the ``Pair`` that holds there.
    """

    scene: Scene
    body_names: tuple[str, ...]
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    pos: np.ndarray
    quat: np.ndarray
    vel: np.ndarray
    omega: np.ndarray
    vel_mentioned: np.ndarray
    omega_mentioned: np.ndarray
    kinematic_names: tuple[str, ...]
    kinematic_pos: np.ndarray
    kinematic_quat: np.ndarray
    kinematic_vel: np.ndarray
    kinematic_omega: np.ndarray
    kinematic_vel_mentioned: np.ndarray
    kinematic_omega_mentioned: np.ndarray
    geom_names: tuple[str, ...]
    geom_shapes: tuple[Shape, ...]
    geom_category: np.ndarray
    geom_body: np.ndarray
    geom_pos: np.ndarray
    geom_quat: np.ndarray
    geom_friction: np.ndarray
    geom_has_friction: np.ndarray
    geom_torsional_friction: np.ndarray
    geom_has_torsional_friction: np.ndarray
    geom_rolling_friction: np.ndarray
    geom_has_rolling_friction: np.ndarray
    geom_restitution: np.ndarray
    geom_has_restitution: np.ndarray
    geom_group: np.ndarray
    geom_mask: np.ndarray
    geom_margin: np.ndarray
    geom_solref: np.ndarray
    geom_solimp: np.ndarray
    geom_condim: np.ndarray
    geom_priority: np.ndarray
    pairs: np.ndarray
    overrides: dict[int, Pair]

    def pair_sources(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (p,) and (p,) geoms whose surfaces combine: those of the pair, or twice the one of higher priority."""
        return _sources(self.pairs, self.geom_priority)

    def pair_condim(self) -> np.ndarray:
        """Return (p,) contact dimensions 1, 3, 4 or 6: the larger of both geoms', or what the override gives."""
        has = {f: getattr(self, "geom_has_" + f) for f in CONDIMS}
        return _pair_condims(self.pair_sources(), self.geom_condim, has, self.overrides)

    def _pair_coefficient(self, field: str) -> tuple[np.ndarray, np.ndarray]:
        a, b = self.pair_sources()
        values = getattr(self, "geom_" + field)
        value = np.maximum(values[a], values[b])
        for row, pair in self.overrides.items():
            own = getattr(pair, field)
            if own is not UNSET:
                value[row] = own or 0.0
        has = self.pair_condim() >= CONDIMS[field]
        return np.where(has, value, 0.0), has

    def pair_friction(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (p,) friction [-] and (p,) bool whether there is any: the larger value, or the override's.

        As in MuJoCo the pair is frictionless when the larger condim is 1.
        """
        return self._pair_coefficient("friction")

    def pair_torsional_friction(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (p,) torsional friction [m] and (p,) bool whether there is any (condim 4 or 6)."""
        return self._pair_coefficient("torsional_friction")

    def pair_rolling_friction(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (p,) rolling friction [m] and (p,) bool whether there is any (condim 6)."""
        return self._pair_coefficient("rolling_friction")

    def pair_restitution(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (p,) restitution [-] and (p,) bool whether there is any: the larger value, or the override's."""
        a, b = self.pairs.T
        value = np.maximum(self.geom_restitution[a], self.geom_restitution[b])
        has = self.geom_has_restitution[a] | self.geom_has_restitution[b]
        for row, pair in self.overrides.items():
            if pair.restitution is not UNSET:
                value[row] = 0.0 if pair.restitution is None else pair.restitution
                has[row] = pair.restitution is not None
        return value, has

    def pair_softness(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (p,) margin [m], (p, 2) solref, (p, 5) solimp as MuJoCo combines them.

        Margins add; solref and solimp are averaged, but solref is the smaller of each entry if one is in the
        direct (non-positive) format.
        """
        margin = self.geom_margin[self.pairs].sum(axis=1)
        a, b = self.pair_sources()
        ra, rb = self.geom_solref[a], self.geom_solref[b]
        direct = (ra[:, :1] <= 0) | (rb[:, :1] <= 0)
        solref = np.where(direct, np.minimum(ra, rb), 0.5 * ra + 0.5 * rb)
        solimp = 0.5 * self.geom_solimp[a] + 0.5 * self.geom_solimp[b]
        for row, pair in self.overrides.items():
            if pair.margin is not None:
                margin[row] = pair.margin
            if pair.solref is not None:
                solref[row] = pair.solref
            if pair.solimp is not None:
                solimp[row] = pair.solimp
        return margin, solref, solimp


def resolve(scene: Scene) -> ResolvedScene:
    """Flatten a scene for the builder.

    Args:
      scene: a checked scene.

    Returns:
      Its numbers as numpy arrays and the geom pairs that may collide.

    Raises:
      ValueError: the mass of a body, computed from its geoms, is zero or overflows.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"{scene!r} must be a Scene")
    table = _geom_table(scene)
    pairs, overrides = _find_pairs(scene, table)
    inertial = [mass_properties(b) for b in scene.bodies]
    geoms = table.geoms
    return ResolvedScene(
        scene=scene,
        body_names=tuple(b.name for b in scene.bodies),
        mass=np.array([m for m, _, _ in inertial]),
        com=np.array([c for _, c, _ in inertial]),
        inertia=np.array([i for _, _, i in inertial]),
        **_motion(scene.bodies, ""),
        kinematic_names=tuple(b.name for b in scene.kinematic),
        **_motion(scene.kinematic, "kinematic_"),
        geom_names=table.names,
        geom_shapes=tuple(g.shape for g in geoms),
        geom_category=table.category,
        geom_body=table.body,
        geom_pos=_rows([g.pos for g in geoms], 3),
        geom_quat=_rows([g.quat for g in geoms], 4),
        **{f"geom_{f}": np.array([getattr(g, f) or 0.0 for g in geoms]) for f in CONDIMS},
        **{f"geom_has_{f}": has for f, has in _given(geoms).items()},
        geom_restitution=np.array([g.restitution or 0.0 for g in geoms]),
        geom_has_restitution=np.array([g.restitution is not None for g in geoms], dtype=bool),
        geom_group=table.group,
        geom_mask=table.mask,
        geom_margin=np.array([g.margin for g in geoms]),
        geom_solref=_rows([g.solref for g in geoms], 2),
        geom_solimp=_rows([g.solimp for g in geoms], 5),
        geom_condim=_condims(geoms),
        geom_priority=np.array([g.priority for g in geoms], dtype=np.int64),
        pairs=pairs,
        overrides=overrides,
    )


def mass_properties(body: Body) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass [kg], (3,) centre of mass in the body frame [m], (3, 3) inertia about it in body axes [kg m^2]."""
    if body.inertia is not None:
        mass, full = body.mass, np.array(body.inertia)
        full = np.diag(full) if full.ndim == 1 else (full + full.T) / 2
        com = body.com
        if com is None:
            com = _uniform(body.geoms, 1.0)[1] if body.geoms else (0.0, 0.0, 0.0)
        return mass, np.array(com, dtype=float), full
    density = DEFAULT_DENSITY if body.density is None else body.density
    mass, com, full = _uniform(body.geoms, density)
    if not (math.isfinite(mass) and mass > 0 and np.isfinite(full).all() and np.diag(full).min() > 0):
        raise ValueError(
            f"body '{body.name}': geoms give mass = {mass} [kg] and inertia = {np.diag(full).tolist()} [kg m^2], "
            "which must be finite and > 0; change sizes or density, or give mass and inertia"
        )
    if body.mass is not None:
        full = full * (body.mass / mass)
        mass = body.mass
    return mass, com if body.com is None else np.array(body.com), full


def rotation(quat) -> np.ndarray:
    """Return the (3, 3) matrix of a unit quaternion (w, x, y, z); the identity is exact."""
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _uniform(geoms, density):
    """Mass, centre and inertia about the centre of solid geoms of one density."""
    parts = [(g, *g.shape.mass_properties(density)) for g in geoms]
    mass = sum(m for _, m, _ in parts)
    if len(parts) == 1:
        com = np.array(parts[0][0].pos)
    else:
        com = sum(m * np.array(g.pos) for g, m, _ in parts) / (mass or 1.0)
    total = np.zeros((3, 3))
    for g, m, principal in parts:
        # An isotropic inertia is left unrotated, so that it stays isotropic to the last digit.
        r = np.eye(3) if len(set(principal)) == 1 else rotation(g.quat)
        d = np.array(g.pos) - com
        total += r @ np.diag(principal) @ r.T + m * (d @ d * np.eye(3) - np.outer(d, d))
    return mass, com, (total + total.T) / 2


def _motion(bodies, prefix):
    zero = (0.0, 0.0, 0.0)
    return {
        f"{prefix}pos": _rows([b.pos for b in bodies], 3),
        f"{prefix}quat": _rows([b.quat for b in bodies], 4),
        f"{prefix}vel": _rows([zero if b.vel is None else b.vel for b in bodies], 3),
        f"{prefix}omega": _rows([zero if b.omega is None else b.omega for b in bodies], 3),
        f"{prefix}vel_mentioned": np.array([b.vel_mentioned for b in bodies], dtype=bool),
        f"{prefix}omega_mentioned": np.array([b.omega_mentioned for b in bodies], dtype=bool),
    }


def _rows(values, width):
    return np.array(values, dtype=float).reshape(len(values), width)


@dataclasses.dataclass(frozen=True, eq=False)
class _GeomTable:
    """All geoms in resolved order, with unique names."""

    geoms: tuple[Geom, ...]
    names: tuple[str, ...]
    category: np.ndarray
    body: np.ndarray
    group: np.ndarray
    mask: np.ndarray


def _geom_table(scene):
    geoms, wanted, category, owner = [], [], [], []
    for cat, bodies in ((DYNAMIC, scene.bodies), (KINEMATIC, scene.kinematic)):
        for i, body in enumerate(bodies):
            for j, g in enumerate(body.geoms):
                if body.friction is None:
                    g = dataclasses.replace(g, **dict.fromkeys(CONDIMS))
                elif body.friction is not UNSET:
                    g = dataclasses.replace(g, friction=body.friction)
                if body.restitution is not UNSET:
                    g = dataclasses.replace(g, restitution=body.restitution)
                geoms.append(g)
                wanted.append(body.name if len(body.geoms) == 1 else f"{body.name}:{j}")
                category.append(cat)
                owner.append(i)
    for j, g in enumerate(scene.static):
        geoms.append(g)
        wanted.append(f"static:{j}")
        category.append(STATIC)
        owner.append(-1)
    taken = {g.name for g in geoms}
    names = []
    for g, name in zip(geoms, wanted):
        if g.name is None:
            while name in taken:
                name += "'"
            taken.add(name)
        names.append(g.name or name)
    group, mask = [g.group for g in geoms], [g.mask for g in geoms]
    ints = [np.array(v, dtype=np.int64) for v in (category, owner, group, mask)]
    return _GeomTable(tuple(geoms), tuple(names), *ints)


def _given(geoms):
    """Whether each geom has each coefficient of friction."""
    return {f: np.array([getattr(g, f) is not None for g in geoms], dtype=bool) for f in CONDIMS}


def _condims(geoms):
    """Contact dimension each geom asks for."""
    most = lambda g: max([1, *(d for f, d in CONDIMS.items() if getattr(g, f) is not None)])
    return np.array([most(g) if g.condim is None else min(g.condim, most(g)) for g in geoms], dtype=np.int64)


def _sources(pairs, priority):
    a, b = pairs.T
    return np.where(priority[b] > priority[a], b, a), np.where(priority[a] > priority[b], a, b)


def _pair_condims(sources, condim, has, overrides):
    """(p,) contact dimensions.

    A coefficient that the override gives is there, one that it gives as ``None`` is not; the others are there
    where the geoms ask for them or, if the override gives a condim, where a geom has them at all. An override's
    condim caps what acts.
    """
    a, b = sources
    out = np.maximum(condim[a], condim[b])
    for row, pair in overrides.items():
        asked, dim = out[row], 1
        for field, least in CONDIMS.items():
            own = getattr(pair, field)
            if own is not UNSET:
                there = own is not None
            else:
                there = asked >= least if pair.condim is None else bool(has[field][[a[row], b[row]]].any())
            if not there or (pair.condim is not None and pair.condim < least):
                break
            dim = least
        out[row] = dim
    return out


def _check_pair_condims(table, pairs, overrides):
    """An override that asks for torsional or rolling friction must be able to have it."""
    if not overrides:
        return
    priority = np.array([g.priority for g in table.geoms])
    dims = _pair_condims(_sources(pairs, priority), _condims(table.geoms), _given(table.geoms), overrides)
    for row, pair in overrides.items():
        wanted = {f: d for f, d in CONDIMS.items() if d > 3 and getattr(pair, f) not in (UNSET, None)}
        least = pair.condim if pair.condim is not None else max(wanted.values(), default=1)
        if dims[row] < least and least > 3:
            lacks = next(f for f, d in CONDIMS.items() if d > dims[row])
            what = f"condim = {pair.condim}" if pair.condim is not None else f"{max(wanted, key=wanted.get)} is given"
            names = " and ".join(f"'{table.names[g]}'" for g in pairs[row])
            raise ValueError(f"pair ('{pair.a}', '{pair.b}'): {what}, but neither it nor geoms {names} have {lacks}")


def _find_pairs(scene, table):
    """Return (p, 2) pairs that may collide and the override of each row that has one."""
    n = len(table.geoms)
    moving = table.category == DYNAMIC
    dynamic = int(moving.sum())  # they come first
    i, j = np.triu_indices(dynamic, 1, n)
    allowed = ((table.group[i] & table.mask[j]) != 0) | ((table.group[j] & table.mask[i]) != 0)
    different = (table.category[i] != table.category[j]) | (table.body[i] != table.body[j])
    keep = allowed & different
    if not scene.pairs:
        return np.stack([i[keep], j[keep]], axis=1), {}

    key = i * n + j  # ascending: the order of triu_indices

    def row(pair):
        return int(np.searchsorted(key, pair[0] * n + pair[1]))

    bodies = {}
    for k, (cat, b) in enumerate(zip(table.category, table.body)):
        if cat != STATIC:
            owner = (scene.bodies if cat == DYNAMIC else scene.kinematic)[b].name
            bodies.setdefault(owner, []).append(k)
    for b in scene.bodies + scene.kinematic:
        bodies.setdefault(b.name, [])
    index = {name: k for k, name in enumerate(table.names)}
    found = {}  # (first, second) -> (is it between two geoms, Pair)
    for pair in scene.pairs:
        sides, fine = [], True
        for field in ("a", "b"):
            name = getattr(pair, field)
            order = (bodies, index) if pair.exclude else (index, bodies)
            hit = order[0].get(name, order[1].get(name))
            if hit is None:
                raise ValueError(
                    f"pair ('{pair.a}', '{pair.b}'): {field} = '{name}' must be the name of a geom or body of the scene"
                )
            fine &= not isinstance(hit, list)
            sides.append(hit if isinstance(hit, list) else [hit])
        if any(k in sides[1] for k in sides[0]):
            raise ValueError(f"pair ('{pair.a}', '{pair.b}'): a and b must not be the same geom or body")
        for a in sides[0]:
            for b in sides[1]:
                ordered = (a, b) if a < b else (b, a)
                if ordered[0] >= dynamic or not different[row(ordered)]:
                    continue  # two fixed geoms, or two of one body, never touch
                before = found.get(ordered)
                if before is not None and before[0] == fine:
                    raise ValueError(
                        f"pair ('{pair.a}', '{pair.b}'): given twice; also ('{before[1].a}', '{before[1].b}') names "
                        f"geoms '{table.names[a]}' and '{table.names[b]}'"
                    )
                if before is None or fine:
                    found[ordered] = (fine, pair)
    for ordered, (fine, pair) in found.items():
        if pair.exclude:
            keep[row(ordered)] = False
        elif fine:
            keep[row(ordered)] = True
    pairs = np.stack([i[keep], j[keep]], axis=1)
    rows = {tuple(p): r for r, p in enumerate(pairs.tolist())}
    return pairs, {rows[o]: p for o, (_, p) in found.items() if o in rows}
