"""Layer 7: from a scene to a model (structure and numbers) and its start state.

Sorts, groups, counts and decides what the program needs; everything here is numpy on the host.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from .contact import NARROW
from .contact.broadphase import SLOP, bits, key_of, no_key
from .method import SMOOTHING, Method, Touching, find
from .model import Choice, Group, Model, Structure
from .scene import Scene, resolve, rotation
from .shapes import SHAPES
from .solvers.gauss_seidel import loops
from .solvers.mujoco_law import MujocoLaw
from .spatial import Quat, Vec3
from .state import Kinematic, State

#: Groups with more pairs than this choose their pairs at run time (a box pair costs far more than a ball pair).
DENSE_PAIRS = {("box", "box"): 100, ("sphere", "box"): 600, ("sphere", "sphere"): 2100}
#: The same for a solver that goes through pairs: of fewer most touch in some world of a tile, and arrays are faster.
COLOURED_PAIRS = {("box", "box"): 100, ("sphere", "box"): 500, ("sphere", "sphere"): 500}
#: The same for such a solver where nothing pulls bodies together: few touch at a time.
FLOATING_PAIRS = {("box", "box"): 100, ("sphere", "box"): 50, ("sphere", "sphere"): 50}
#: From this many places on (geoms of side A times geoms of side B) the pairs are searched on a grid, if that has less.
GRID_PAIRS = 8_000_000
RANK = {shape.kind: i for i, shape in enumerate(SHAPES)}
ISOTROPIC = 1e-9


@dataclasses.dataclass(frozen=True)
class Names:
    """Names of bodies, kinematic bodies and geoms in the order of the model's arrays."""

    bodies: tuple[str, ...]
    kinematic: tuple[str, ...]
    geoms: tuple[str, ...]


def build(scene: Scene, dt: float | None = None, method: str | Method = "accurate") -> tuple[Model, State]:
    """Compile a scene into a model and its start state.

    Args:
      scene: a :class:`rbd_jax.Scene` (bad scenes are refused when they are made).
      dt: step [s], > 0; None: the scene's.
      method: "fast", "accurate", "gradient", "mujoco", or a :class:`rbd_jax.Method`.

    Returns:
      model, state: of one world; leaves are float32, or float64 under ``jax_enable_x64``.

    Raises:
      ValueError: dt <= 0, unknown method, a combination of parts that does not exist.
    """
    dt = float(scene.dt if dt is None else dt)
    if not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"build: dt = {dt} must be finite and > 0 [s]")
    r = resolve(scene)
    method = find(method).resolve(dt, scene.integrator, _touching(r))
    dtype = jnp.result_type(float)
    n = len(r.mass)

    category = np.array(["dynamic", "kinematic", "static"])[r.geom_category]
    kinds = np.array([s.kind for s in r.geom_shapes])
    frames = _principal_frames(r)
    centred = (category != "dynamic") | _near(r.geom_pos, r.com[np.maximum(r.geom_body, 0)])
    groups = _groups(r, kinds, category, centred, method, scene, dt)
    if any(g.torsion for g in groups) and not method.solver.spins:
        raise ValueError(
            f"Method: solver '{method.solver.name}' has no torsional or rolling friction, which this scene gives; "
            "use method='mujoco', or leave them out (condim 3)"
        )
    attitude = _needs_attitude(r, groups, kinds, category, centred)
    if groups and method.solver.level == "velocity" and not method.integrator.contact:
        raise ValueError(
            f"Method: integrator '{method.integrator.name}' is for free motion; this scene has contact pairs. "
            "Use symtop2, symtop4, buss2 or an Euler method, or a scene without pairs"
        )

    row = np.full(len(kinds), -1)
    for kind in RANK:
        row[kinds == kind] = np.arange((kinds == kind).sum())
    is_static = category == "static"
    static_row = np.where(is_static, np.cumsum(is_static) - 1, -1)
    posed = ~is_static
    local = posed & (~centred | ~_near(r.geom_quat, [1, 0, 0, 0]))
    local |= (category == "kinematic") & ~_near(r.geom_pos, 0)
    plain = not local.any() and frames.principal is None
    has = lambda flags, values: jnp.asarray(values, dtype) if np.any(flags) else None
    box = kinds == "box"
    any_friction = any(g.friction for g in groups)
    any_torsion, any_rolling = any(g.torsion for g in groups), any(g.rolling for g in groups)
    any_restitution = any(g.restitution for g in groups)
    overrides = list(r.overrides.values())
    own = lambda name: jnp.asarray(_override_values(overrides, name), dtype)
    overridden = any((g.override >= 0).any() for g in groups)
    structure = Structure(
        n=n,
        n_kinematic=len(r.kinematic_names),
        names=Names(r.body_names, r.kinematic_names, r.geom_names),
        kinds=tuple(kinds.tolist()),
        category=tuple(category.tolist()),
        geom_body=r.geom_body,
        row=row,
        static_row=static_row,
        groups=groups,
        attitude=attitude,
        isotropic=frames.isotropic,
        axes=frames.axes if attitude and not frames.isotropic else None,
        resized=bool(attitude and not frames.isotropic and plain),
    )
    if plain:
        geom_pos = geom_quat = None
    else:
        geom_pos, geom_quat = jnp.asarray(r.geom_pos[posed], dtype), jnp.asarray(r.geom_quat[posed], dtype)
    mujoco = method.contact.name == "mujoco"
    model = Model(
        structure,
        method,
        dt=jnp.asarray(dt, dtype),
        mass=jnp.asarray(r.mass, dtype),
        inertia=jnp.asarray(frames.moments, dtype),
        gravity=None if scene.gravity is None else jnp.asarray(scene.gravity, dtype),
        drag=None if scene.drag is None else jnp.asarray(np.broadcast_to(scene.drag, 2), dtype),
        friction=jnp.asarray(r.geom_friction, dtype) if any_friction else None,
        restitution=jnp.asarray(r.geom_restitution, dtype) if any_restitution else None,
        pair_friction=own("friction") if overridden and any_friction else None,
        pair_restitution=own("restitution") if overridden and any_restitution else None,
        torsional_friction=jnp.asarray(r.geom_torsional_friction, dtype) if any_torsion else None,
        rolling_friction=jnp.asarray(r.geom_rolling_friction, dtype) if any_rolling else None,
        pair_torsional_friction=own("torsional_friction") if overridden and any_torsion else None,
        pair_rolling_friction=own("rolling_friction") if overridden and any_rolling else None,
        radius=has(kinds == "sphere", [s.radius for s in r.geom_shapes if s.kind == "sphere"]),
        half_extents=has(box, [s.half_extents for s in r.geom_shapes if s.kind == "box"]),
        geom_pos=geom_pos,
        geom_quat=geom_quat,
        static_pos=has(is_static, r.geom_pos[is_static]),
        static_quat=has(is_static, r.geom_quat[is_static]),
        com=None if _near(r.com, 0).all() else jnp.asarray(r.com, dtype),
        principal=None if frames.principal is None else jnp.asarray(frames.principal, dtype),
        laws=_mujoco_laws(r, groups, scene, dtype) if mujoco and groups else None,
        smoothing=jnp.asarray(SMOOTHING, dtype) if method.solver.smoothing else None,
    )
    return model, _start(model, r, dtype)


def _near(a, b) -> np.ndarray:
    """Rows of ``a`` that equal ``b`` to 1e-12 [m or -]."""
    return np.abs(np.asarray(a, float) - np.asarray(b, float)).max(axis=-1, initial=0.0) <= 1e-12


def _override_values(overrides, name: str) -> list[float]:
    """The pairs' own coefficients; NaN = not given (the geoms' are used), absent counts as 0."""
    values = [getattr(p, name) for p in overrides]
    return [0.0 if v is None else (v if isinstance(v, (int, float)) else np.nan) for v in values]


# --- bodies ---


@dataclasses.dataclass
class _Frames:
    isotropic: bool
    moments: np.ndarray
    principal: np.ndarray | None
    axes: np.ndarray  # (n, 3): which body (or principal) axis is the x, y, z of the inner frame


def _principal_frames(r) -> _Frames:
    """Moments, principal frames and the order of their axes."""
    n = len(r.mass)
    diagonal = np.diagonal(r.inertia, axis1=1, axis2=2).copy()
    moments, frame = diagonal.copy(), np.tile([1.0, 0, 0, 0], (n, 1))
    for i in range(n):
        off = r.inertia[i] - np.diag(diagonal[i])
        if np.abs(off).max() > 1e-12 * diagonal[i].max():
            values, axes = np.linalg.eigh(r.inertia[i])
            if np.linalg.det(axes) < 0:
                axes[:, 2] *= -1
            moments[i], frame[i] = values, _quat_of(axes)
    equal = np.ptp(moments, axis=1) <= ISOTROPIC * moments.max(axis=1)
    if equal.all():
        return _Frames(True, moments.mean(axis=1), None, np.tile([0, 1, 2], (n, 1)))
    # z: 1/I farthest from the other two; y: the middle one; x: the other extreme (what symtop wants)
    order = np.argsort(1.0 / moments, axis=1)
    inverse = np.take_along_axis(1.0 / moments, order, axis=1)
    low_far = inverse[:, 1] - inverse[:, 0] > inverse[:, 2] - inverse[:, 1]
    axes = np.where(low_far[:, None], order[:, ::-1], order)
    axes = np.where(equal[:, None], [0, 1, 2], axes)
    principal = None if _near(frame, [1, 0, 0, 0]).all() else frame
    return _Frames(False, moments, principal, axes)


def _quat_of(R: np.ndarray) -> np.ndarray:
    """Unit quaternion of a rotation matrix (largest component first, so it never divides by ~0)."""
    t = np.trace(R)
    q = np.empty(4)
    k = int(np.argmax([t, R[0, 0], R[1, 1], R[2, 2]]))
    if k == 0:
        q[0] = 1 + t
        q[1:] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i, j, m = k - 1, k % 3, (k + 1) % 3
        q[0] = R[m, j] - R[j, m]
        q[1 + i] = 1 + R[i, i] - R[j, j] - R[m, m]
        q[1 + j] = R[i, j] + R[j, i]
        q[1 + m] = R[i, m] + R[m, i]
    return q / np.linalg.norm(q)


def _needs_attitude(r, groups, kinds, category, centred) -> bool:
    """Attitude is carried unless all bodies are centred spheres, without friction and without a mentioned spin."""
    moving = category == "dynamic"
    plain = (kinds[moving] == "sphere").all() and centred[moving].all()
    if not moving.any():
        plain = False
    return not (plain and not any(g.friction for g in groups) and not r.omega_mentioned.any() and bool(groups))


# --- pairs ---


def _touching(r) -> Touching:
    if not len(r.pairs):
        return Touching(anything=False)
    box = np.array([s.kind == "box" for s in r.geom_shapes])
    moving = np.array(["dynamic", "kinematic", "static"])[r.geom_category] == "dynamic"
    between = r.pairs[moving[r.pairs].all(axis=1)]
    if not len(between):
        return Touching()
    alone = box[between].all(axis=1)
    ratio = lambda geoms: (lambda m: float(m.max() / m.min()))(r.mass[r.geom_body[geoms]])
    if not alone.any():
        return Touching(ratio=ratio(between))
    geoms = np.unique(between[alone])
    return Touching(
        boxes=len(np.unique(r.geom_body[geoms])),
        size=2.0 * min(min(r.geom_shapes[g].half_extents) for g in geoms),
        box_ratio=ratio(geoms),
        ratio=ratio(between),
        alone=bool(alone.all()),
    )


def _groups(r, kinds, category, centred, method: Method, scene: Scene, dt: float) -> tuple[Group, ...]:
    if not len(r.pairs):
        return ()
    _, friction = r.pair_friction()
    _, torsion = r.pair_torsional_friction()
    _, rolling = r.pair_rolling_friction()
    _, restitution = r.pair_restitution()
    override = np.full(len(r.pairs), -1)
    for k, row in enumerate(r.overrides):
        override[row] = k
    sphere_at_com = (kinds == "sphere") & centred & (category == "dynamic")
    rank = np.array([RANK[k] for k in kinds])
    first, second = r.pairs.T
    # canonical order of kinds; of two equal kinds the one that does not move comes first
    fixed = category != "dynamic"
    swap = (rank[first] > rank[second]) | ((rank[first] == rank[second]) & ~fixed[first] & fixed[second])
    a, b = np.where(swap, second, first), np.where(swap, first, second)
    partner = np.where(fixed[a], category[a], np.where(fixed[b], category[b], "dynamic"))
    flip = fixed[b]
    one, two = r.pair_sources()
    source_a, source_b = np.where(swap, two, one), np.where(swap, one, two)
    same = (kinds[a], kinds[b], partner, flip, sphere_at_com[a], sphere_at_com[b], friction, restitution)
    # the pairs of every combination: one number a pair, as there may be a million
    values, code = [], np.zeros(len(a), np.int64)
    for column in (*same, torsion, rolling):
        value, inverse = np.unique(column, return_inverse=True)
        values.append(value)
        code = code * len(value) + inverse
    key = {}
    for c in np.unique(code).tolist():
        left, parts = c, []
        for value in reversed(values):
            left, i = divmod(left, len(value))
            parts.append(value[i])
        key[tuple(reversed(parts))] = np.flatnonzero(code == c)
    groups, sizes = [], _sizes(r)
    for k in sorted(key, key=lambda k: (k[2] == "dynamic", *map(str, k))):
        rows = key[k]
        kind = (str(k[0]), str(k[1]))
        if kind not in NARROW:
            raise ValueError(
                f"no narrow phase for the pair {kind[0]}-{kind[1]} "
                f"({r.geom_names[a[rows[0]]]}, {r.geom_names[b[rows[0]]]})"
            )
        ga, gb = a[rows], b[rows]
        body_a, body_b = r.geom_body[ga], r.geom_body[gb]
        capacity = choice = None
        floating = scene.gravity is None or not np.any(scene.gravity)
        limits = DENSE_PAIRS if not method.solver.coloured else FLOATING_PAIRS if floating else COLOURED_PAIRS
        limit = limits.get(kind, 10**9)
        if len(rows) > limit:
            choice = _choice(r, kind, a, b, rows, override, sizes, method)
            capacity = _capacity(r, kind, (a[rows], b[rows]), sizes, category, method, scene, dt)
        if k[2] == "dynamic":
            ends = np.stack([body_a, body_b], 1)
        else:
            ends = (body_a if k[3] else body_b)[:, None]
        order, colours, padding = np.arange(len(rows)), (), None
        if capacity is None and method.solver.coloured:
            order, colours, padding = _padded(*_colour(ends), NARROW[kind].slots)
        groups.append(
            Group(
                kind,
                str(k[2]),
                bool(k[3]),
                ga[order],
                gb[order],
                body_a[order],
                body_b[order],
                bool(k[4]),
                bool(k[5]),
                bool(k[6]),
                bool(k[7]),
                bool(k[8]),
                bool(k[9]),
                source_a[rows][order],
                source_b[rows][order],
                override[rows][order],
                rows[order],
                colours,
                capacity,
                padding,
                choice,
            )
        )
    return tuple(groups)


def _sizes(r) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Half-extents (g, 3), radius of the enclosing ball (g,) and volume (g,) of spheres and boxes, else zero."""
    half, radius, volume = np.zeros((len(r.geom_shapes), 3)), np.zeros(len(r.geom_shapes)), np.zeros(len(r.geom_shapes))
    for k, shape in enumerate(r.geom_shapes):
        if shape.kind == "sphere":
            half[k], radius[k], volume[k] = shape.radius, shape.radius, 4.19 * shape.radius**3
        elif shape.kind == "box":
            half[k] = shape.half_extents
            radius[k], volume[k] = np.linalg.norm(half[k]), 8.0 * np.prod(half[k])
    return half, radius, volume


def _choice(r, kind, a, b, rows, override, sizes, method: Method) -> Choice:
    """How a group chooses among its pairs ``rows`` (of geoms a, b) at run time."""
    a, b = a[rows], b[rows]
    list_a, list_b = np.unique(a), np.unique(b)
    same = kind[0] == kind[1] and len(np.intersect1d(list_a, list_b)) > 0
    if same:
        list_a = list_b = np.union1d(list_a, list_b)
        a, b = np.minimum(a, b), np.maximum(a, b)
    i, j = np.searchsorted(list_a, a), np.searchsorted(list_b, b)
    count_a, count_b = len(list_a), len(list_b)
    keys = key_of(i, j, count_b)
    # a cell as wide as the largest geom holds so many of the usual ones, and a geom looks at 27 cells
    _, radius, volume = sizes
    both = np.union1d(list_a, list_b)
    crowd = 1.0 + 0.7 * (2.2 * radius[both].max()) ** 3 / np.median(volume[both])
    candidates = int(27 * crowd * (0.5 * count_a if same else count_b))
    full = len(rows) == (count_a * (count_a - 1) // 2 if same else count_a * count_b)
    if count_a * count_b < GRID_PAIRS or candidates > count_a * count_b // 8:
        candidates = None
    own = np.flatnonzero(override[rows] >= 0)
    own = own[np.argsort(keys[own])]
    priority = (r.geom_priority[list_a], r.geom_priority[list_b])
    equal = len(np.unique(np.concatenate(priority))) == 1
    law_rows, law_of = rows[:1], None
    if method.contact.name == "mujoco":
        margin, solref, solimp = (x[rows] for x in r.pair_softness())
        _, first, which = np.unique(
            np.column_stack([margin, solref, solimp]), axis=0, return_index=True, return_inverse=True
        )
        law_rows = rows[first]
        if len(first) > 1:
            law_of = np.zeros(no_key(count_a, count_b) + 1, np.int32)
            law_of[keys] = which.ravel()
    return Choice(
        a=list_a,
        b=list_b,
        body_a=r.geom_body[list_a],
        body_b=r.geom_body[list_b],
        same=same,
        allowed=None if full and not (same and candidates is None) else bits(i, j, count_a, count_b),
        candidates=candidates,
        override_keys=keys[own],
        override_rows=override[rows][own],
        priority=None if equal else priority,
        law_rows=law_rows,
        law_of=law_of,
    )


def _capacity(r, kind, pair, sizes, category, method: Method, scene: Scene, dt: float) -> int:
    """Places for pairs: what the method says, or 8 a moving geom and half as many again as start close.

    Raises:
      ValueError: more start close than the method gives places.
    """
    used = np.unique(np.concatenate(pair))
    x, turn = np.zeros((len(category), 3)), np.zeros((len(category), 3, 3))
    reach = np.zeros(len(category))
    h = dt / method.substeps
    fall = 0.0 if scene.gravity is None else h * np.linalg.norm(scene.gravity)
    for k in used.tolist():
        x[k], turn[k], body = r.geom_pos[k], rotation(r.geom_quat[k]), r.geom_body[k]
        if category[k] != "static":
            name = "" if category[k] == "dynamic" else "kinematic_"
            frame = rotation(getattr(r, name + "quat")[body])
            x[k], turn[k] = getattr(r, name + "pos")[body] + frame @ x[k], frame @ turn[k]
            reach[k] = h * (np.linalg.norm(getattr(r, name + "vel")[body]) + (fall if name == "" else 0.0))
    half, radius, _ = sizes
    balls = kind == ("sphere", "sphere")
    spread = np.array([s.kind == "sphere" for s in r.geom_shapes])[:, None]
    wide = np.where(spread, half, np.einsum("kij,kj->ki", np.abs(turn), half))
    count = 0
    for start in range(0, len(pair[0]), 1_000_000):
        a, b = (side[start : start + 1_000_000] for side in pair)
        grown = 0.5 * SLOP * (half[a].min(1) + half[b].min(1)) + reach[a] + reach[b]
        d = np.abs(x[b] - x[a])
        if balls:
            near = (d * d).sum(1) < (radius[a] + radius[b] + grown) ** 2
        else:
            near = (d - wide[a] - wide[b]).max(1) < grown
        count += int(near.sum())
    if method.capacity is None:
        moving = int((category[used] == "dynamic").sum())
        return min(len(pair[0]), max(8 * moving, count + count // 2))
    if count > method.capacity:
        raise ValueError(
            f"Method: capacity = {method.capacity} is too small: {count} {kind[0]}-{kind[1]} pairs are close to each "
            f"other at the start; it must be at least {count}, with room for those that come"
        )
    return min(len(pair[0]), method.capacity)


def _colour(ends: np.ndarray) -> tuple[np.ndarray, tuple[tuple[int, int], ...]]:
    """Order pairs so that each slice (colour) holds every body at most once.

    Greedy edge colouring, or the round-robin (i + j) mod n where that needs fewer colours.
    """
    used: dict[int, set[int]] = {}
    colour = np.empty(len(ends), int)
    for k, pair in enumerate(ends.tolist()):
        taken = set().union(*(used.setdefault(i, set()) for i in pair))
        c = next(c for c in range(len(taken) + 1) if c not in taken)
        colour[k] = c
        for i in pair:
            used[i].add(c)
    if ends.shape[1] == 2:
        n = ends.max() + 1
        size = n if n % 2 else n - 1
        if size <= colour.max():
            i, j = ends.min(1), ends.max(1)
            # odd n: (i + j) mod n; even n: the last body meets i in round 2 i mod (n - 1)
            robin = np.where((n % 2 == 0) & (j == n - 1), (2 * i) % size, (i + j) % size)
            if len({(c, e) for c, p in zip(robin.tolist(), ends.tolist()) for e in p}) == 2 * len(ends):
                colour = robin
    order = np.lexsort((ends[:, 0], colour))
    _, counts = np.unique(colour[order], return_counts=True)
    stops = np.cumsum(counts)
    return order, tuple((int(e - c), int(e)) for c, e in zip(counts, stops))


def _padded(order: np.ndarray, colours, slots: int):
    """Colours of one width for groups that loop over them: short ones repeat a pair, marked as padding (dead)."""
    if not loops(slots, len(colours)) or len({e - s for s, e in colours}) <= 1:
        return order, colours, None
    width = max(e - s for s, e in colours)
    rows, dead = [], []
    for s, e in colours:
        rows.append(np.concatenate([order[s:e], np.repeat(order[s], width - (e - s))]))
        dead.append(np.arange(width) >= e - s)
    k = len(colours)
    return np.concatenate(rows), tuple((i * width, (i + 1) * width) for i in range(k)), np.concatenate(dead)


def _mujoco_laws(r, groups, scene: Scene, dtype) -> tuple[MujocoLaw, ...]:
    """MuJoCo's softness of the pairs of every group, leaves (P,); of a ``Choice`` its different ones."""
    margin, solref, solimp = r.pair_softness()
    column = lambda a: jnp.asarray(a, dtype)
    return tuple(
        MujocoLaw(
            *(column(solref[rows, k]) for k in range(2)),
            *(column(solimp[rows, k]) for k in range(5)),
            margin=column(margin[rows]),
            impratio=column([scene.impratio]),
            refsafe=bool(scene.refsafe),
        )
        for rows in (g.rows if g.choice is None else g.choice.law_rows for g in groups)
    )


# --- the start state ---


def _start(model: Model, r, dtype) -> State:
    n = len(r.mass)
    part = lambda a: tuple(
        jnp.asarray(np.ascontiguousarray(np.asarray(a, float)[:, k]), dtype) for k in range(a.shape[1])
    )
    com = np.stack([p + rotation(q) @ c for p, q, c in zip(r.pos, r.quat, r.com)]) if n else np.zeros((0, 3))
    kinematic = None
    if len(r.kinematic_names):
        kinematic = Kinematic(
            Vec3(*part(r.kinematic_pos)),
            Quat(*part(r.kinematic_quat)),
            Vec3(*part(r.kinematic_vel)),
            Vec3(*part(r.kinematic_omega)),
        )
    state = State(
        Vec3(*part(com)),
        Vec3(*part(r.vel)),
        Quat(*part(r.quat)),
        Vec3(*part(r.omega)),
        step=jnp.zeros((), jnp.int32),
        status=jnp.zeros((), jnp.uint32),
        dt=jnp.asarray(model.dt, dtype),
        kinematic=kinematic,
    )
    from .step import with_memory

    return with_memory(model, state)
