"""Narrow phases: against MuJoCo, against exact polygons, at degenerate poses, and their symmetries."""

import pathlib
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))

from benchmarks import contact_geometry as harness
from rbd_jax.contact import NARROW, Pose
from rbd_jax.shapes import SHAPES
from rbd_jax.spatial import Quat, Vec3

KINDS = tuple(NARROW)
BOXES = ("box", "box")


@pytest.fixture(autouse=True, scope="module")
def double():
    old = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", old)


# --- poses by hand ---


def turn(axis, angle):
    """Quaternions (count, 4) of turns by ``angle`` about ``axis``."""
    half = 0.5 * np.asarray(angle, float)[:, None]
    return np.concatenate([np.cos(half), np.sin(half) * harness.unit(np.asarray(axis, float))], axis=-1)


def product(p, q):
    xp = np if isinstance(p, np.ndarray) else jnp
    w = p[:, :1] * q[:, :1] - (p[:, 1:] * q[:, 1:]).sum(-1, keepdims=True)
    return xp.concatenate([w, p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + xp.cross(p[:, 1:], q[:, 1:])], axis=-1)


def rotate(q, v):
    t = 2 * np.cross(q[:, 1:], v)
    return v + q[:, :1] * t + np.cross(q[:, 1:], t)


def stacked(count, seed, depth, tilt=0.0, size=None):
    """Box B on top of box A: sizes, positions, quaternions, in a common random attitude.

    B is turned about the vertical, shifted sideways, tilted by ``tilt`` and sunk by ``depth``.
    """
    rng = np.random.default_rng(seed)
    sizes = [rng.uniform(0.1, 0.3, (count, 3)) if size is None else np.tile(size, (count, 1)) for _ in "ab"]
    yaw = turn([0, 0, 1], rng.uniform(0, 2 * np.pi, count))
    angle = rng.uniform(0, 2 * np.pi, count)
    tilted = turn(np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1), np.broadcast_to(tilt, count))
    shift = rng.uniform(-0.8, 0.8, (count, 2)) * sizes[0][:, :2]
    xb = np.concatenate([shift, (sizes[0][:, 2] + sizes[1][:, 2] - depth)[:, None]], axis=-1)
    common = harness.unit(rng.normal(size=(count, 4)))
    xa = rng.uniform(-1, 1, (count, 3))
    return sizes, [xa, xa + rotate(common, xb)], [common, product(common, product(tilted, yaw))]


# --- agreement with MuJoCo ---


@pytest.mark.parametrize("kind", KINDS)
def test_agrees_with_mujoco(kind):
    """The full 10,000 poses per kind are in benchmarks/contact_geometry.py."""
    row = harness.compare(kind, 1000, seed=100)
    assert row["touching"] > 300
    assert row["deepest missed [m]"] <= 1e-6 and row["extra"] == 0
    needed = 0.995 if kind == BOXES else 1.0  # box-box: MuJoCo's choice of axis near ties
    assert row["depth and normal within 1e-9"] >= needed
    assert row["points within 1e-9"] >= needed
    if kind != ("plane", "box"):  # MuJoCo lists at most four corners there
        assert row["same set of points"] >= needed


def test_table_of_pairs():
    order = [s.kind for s in SHAPES]
    wanted = {(p, q) for i, p in enumerate(order) for q in order[i:]} - {("plane", "plane")}
    assert set(NARROW) == wanted
    for kind in KINDS:
        sizes, x, q = harness.random_pairs(kind, 500, np.random.default_rng(0))
        assert harness.ours(kind, sizes, x, q)["live"].shape == (500, NARROW[kind].slots)


# --- box-box: what MuJoCo cannot tell ---


def clip(polygon, h):
    """Sutherland-Hodgman: polygon (n, 2) within |x| <= h[0], |y| <= h[1]."""
    for axis in (0, 1):
        for side in (1, -1):
            out = []
            for p, q in zip(polygon, np.roll(polygon, -1, axis=0)):
                fp, fq = h[axis] - side * p[axis], h[axis] - side * q[axis]
                if fp >= 0:
                    out.append(p)
                if fp * fq < 0:
                    out.append(p + (q - p) * fp / (fp - fq))
            polygon = np.array(out)
            if not len(out):
                return polygon
    return polygon


def area(polygon):
    x, y = polygon.T
    return 0.5 * abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


def test_supported_area_of_stacked_boxes():
    count = 400
    sizes, x, q = stacked(count, seed=1, depth=1e-3, tilt=np.random.default_rng(9).choice([0, 1e-9, 1e-4], count))
    m = harness.ours(BOXES, sizes, x, q)
    back = q[0] * [1, -1, -1, -1]
    ratio = []
    for k in range(count):
        live = m["live"][k]
        points = rotate(np.tile(back[k], (live.sum(), 1)), m["point"][k][live] - x[0][k])[:, :2]
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * sizes[1][k, :2]
        corners = np.append(corners, np.full((4, 1), -sizes[1][k, 2]), 1)
        corners = rotate(np.tile(q[1][k], (4, 1)), corners) + x[1][k] - x[0][k]
        corners = rotate(np.tile(back[k], (4, 1)), corners)[:, :2]
        true = area(clip(corners, sizes[0][k, :2]))
        assert 3 <= live.sum() <= 8
        ratio.append(ConvexHull(points).volume / true)
    assert np.abs(np.array(ratio) - 1).max() < 0.01


@pytest.mark.parametrize("equal", [False, True])
def test_small_tilts_give_the_face_normal(equal):
    count = 500
    tilt = 10 ** np.random.default_rng(2).uniform(-9, -3, count)
    depth = 10 ** np.random.default_rng(3).uniform(-6, -2, count)
    sizes, x, q = stacked(count, seed=4, depth=depth, tilt=tilt, size=(0.1, 0.1, 0.1) if equal else None)
    m = harness.ours(BOXES, sizes, x, q)
    up = [rotate(v, np.tile([0.0, 0, 1], (count, 1))) for v in q]
    off = np.minimum(*(np.abs(m["normal"] - u).max(-1) for u in up))
    assert off.max() < 1e-14
    # deeper than the tilt can lift the far side: the whole overlap is live
    assert (m["live"].sum(1) >= 3)[depth > tilt].all()
    assert m["live"].any(1).all()


def test_swapping_mirrors():
    rng = np.random.default_rng(5)
    sizes, x, q = harness.random_pairs(BOXES, 1000, rng)
    margin = 0.05
    m, s = harness.ours(BOXES, sizes, x, q, margin), harness.ours(BOXES, sizes[::-1], x[::-1], q[::-1], margin)
    same = np.abs(m["normal"] + s["normal"]).max(-1) < 1e-12
    assert same.mean() > 0.998  # ties between axes go by their order
    for k in np.flatnonzero(same):
        p, r = m["point"][k][m["live"][k]], s["point"][k][s["live"][k]]
        d, e = m["distance"][k][m["live"][k]], s["distance"][k][s["live"][k]]
        assert len(p) == len(r)
        if len(p):
            gap = np.maximum(np.abs(p[:, None] - r[None]).max(-1), np.abs(d[:, None] - e[None]))
            assert gap.min(0).max() < 1e-9 and gap.min(1).max() < 1e-9


def test_aligned_cubes_touch_in_four_points():
    size, count = 0.1, 3
    sizes = [np.full((count, 3), size)] * 2
    q = np.tile([1.0, 0, 0, 0], (count, 1))
    up = np.array([[0, 0, 2 * size - 1e-3], [0, 2 * size - 1e-3, 0], [-2 * size + 1e-3, 0, 0]])
    m = harness.ours(BOXES, sizes, [0 * up, up], [q, q])
    np.testing.assert_array_equal(m["live"].sum(1), 4)
    np.testing.assert_allclose(m["distance"][m["live"]], -1e-3, atol=1e-15)
    np.testing.assert_allclose(m["normal"], np.sign(up), atol=1e-15)


def true_distance(sizes, x, q):
    """MuJoCo's distance between two separated boxes (GJK)."""
    model = harness.mujoco_model(BOXES)
    data = mujoco.MjData(model)
    out = []
    for k in range(len(x[0])):
        for g in (0, 1):
            model.geom_size[g] = sizes[g][k]
            model.geom_rbound[g] = np.linalg.norm(sizes[g][k])
            model.geom_aabb[g, 3:] = sizes[g][k]
        data.qpos[:] = np.r_[x[0][k], q[0][k], x[1][k], q[1][k]]
        mujoco.mj_kinematics(model, data)
        out.append(mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None))
    return np.array(out)


def test_margin_keeps_every_box_closer_than_it():
    sizes, x, q = harness.random_pairs(BOXES, 1000, np.random.default_rng(6))
    x[1] = x[0] + 1.1 * (x[1] - x[0])
    gap = true_distance(sizes, x, q)
    margin = 0.05
    m = harness.ours(BOXES, sizes, x, q, margin)
    least = np.where(m["live"], m["distance"], np.inf).min(1)
    near = (gap > 1e-6) & (gap < margin)
    assert near.sum() > 50
    assert m["live"][near].any(1).all()
    assert (least[near] > 0).all() and (least[near] <= gap[near] + 1e-6).all()
    assert not m["live"][gap > 2 * margin].any()


@pytest.mark.parametrize("kind", [k for k in KINDS if k != BOXES])
def test_margin_of_the_other_pairs(kind):
    sizes, x, q = harness.random_pairs(kind, 500, np.random.default_rng(7))
    m = harness.ours(kind, sizes, x, q, margin=0.03)
    np.testing.assert_array_equal(m["live"], m["distance"] < 0.03)
    assert ((m["distance"] > 0) & m["live"]).any()


# --- degenerate poses, derivatives, precision ---


def degenerate(kind):
    """Poses with coincident centres, aligned faces, corners and edges in contact, and a padded row of zeros."""
    h = 0.2
    quats = [[1, 0, 0, 0], [0.5**0.5, 0, 0, 0.5**0.5], [0.5**0.5, 0.5**0.5, 0, 0], [0.5, 0.5, 0.5, 0.5]]
    quats += [list(v) for v in turn([[1, 1, 0]], np.array([np.pi / 4]))] + [[np.cos(5e-7), np.sin(5e-7), 0, 0]]
    offsets = [[0, 0, 0]] + [[2 * h * i, 2 * h * j, 2 * h * k] for i in (0, 1) for j in (0, 1) for k in (0, -1, 0.5)]
    offsets += [[h, h, h], [h, 0, 0], [h, h, 0], [1e-25, 0, 0], [0, 0, 2 * h - 1e-3]]
    pairs = np.array([[*o, *q] for o in offsets for q in quats])
    count = len(pairs)
    x, q = [np.zeros((count, 3)), pairs[:, :3]], [np.tile([1.0, 0, 0, 0], (count, 1)), pairs[:, 3:]]
    sizes = [np.full((count, harness.SIZE_COUNT[k]), h) for k in kind]
    for v in (*x, *q, *sizes):
        v[-1] = 0.0  # a padded row
    q[0][-1, 0] = q[1][-1, 0] = 1.0
    return sizes, x, q


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_values_and_gradients_finite_when_degenerate(kind, dtype):
    sizes, x, q = degenerate(kind)

    def total(args):
        a, b, sa, sb = args
        m = NARROW[kind].function(a, b, sa, sb, dtype(0.01))
        leaves = [*jax.tree.leaves(m.normal), *jax.tree.leaves(m.point), m.distance]
        return sum(jnp.sum(v) for v in leaves), m

    cast = lambda tree: jax.tree.map(lambda v: jnp.asarray(v, dtype), tree)
    args = cast((*(harness.to_pose(*p) for p in zip(x, q)), *(tuple(s.T[:, None]) for s in sizes)))
    gradient, m = jax.jit(jax.grad(total, has_aux=True))(args)
    for leaf in (*jax.tree.leaves(gradient), *jax.tree.leaves((m.normal, m.point, m.distance))):
        assert leaf.dtype == dtype and np.isfinite(leaf).all()
    assert np.abs(m.normal.dot(m.normal) - 1).max() < 1e-5
    assert (np.asarray(m.live).sum(0)[0, :-1] <= 8).all()
    assert (np.asarray(jnp.abs(m.distance)) < 2).all()


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_against_finite_differences(kind):
    """Forward mode along a random motion of B, where no slot, axis or feature changes within the step."""
    sizes, x, q = harness.random_pairs(kind, 500, np.random.default_rng(8))
    rng = np.random.default_rng(10)
    dx, spin = rng.normal(size=(500, 3)), rng.normal(size=(500, 3))

    def values(s):
        w, u = jnp.ones((500, 1)), 0.5 * s * spin
        dq = jnp.concatenate([w, u], axis=-1)
        turned = product(dq / jnp.linalg.norm(dq, axis=-1, keepdims=True), jnp.asarray(q[1]))
        size = [tuple(jnp.asarray(c)[None] for c in v.T) for v in sizes]
        m = NARROW[kind].function(harness.to_pose(x[0], q[0]), harness.to_pose(x[1] + s * dx, turned), *size, 0.05)
        return jnp.concatenate([m.distance[:, 0], m.point.x[:, 0], m.normal.x]), (m.live[:, 0], m.feature)

    @jax.jit
    def both(s):
        v, dv = jax.jvp(lambda s: values(s)[0], (s,), (1.0,))
        return v, dv, values(s)[1]

    h = 1e-6
    (_, dv, (live, _)), low, high = both(0.0), both(-h), both(h)
    (live_low, feature_low), (live_high, feature_high) = low[2], high[2]
    steady = np.all(feature_low == feature_high, axis=0) & np.all(live_low == live_high, axis=0)
    slots = NARROW[kind].slots
    use = np.concatenate([np.tile(live, (2, 1)), live.any(0)[None]]) & steady
    numeric = (high[0] - low[0]) / (2 * h)
    error = np.abs(numeric - dv) / (1 + np.abs(dv))
    assert use.sum() > 100 * (2 + 1 / slots)
    assert (error[use] < 1e-6).mean() > 0.995 and np.isfinite(dv).all()


def test_float32_follows_float64():
    sizes, x, q = harness.random_pairs(BOXES, 500, np.random.default_rng(11))
    wide = harness.ours(BOXES, sizes, x, q)
    cast = lambda tree: jax.tree.map(lambda v: jnp.asarray(v, jnp.float32), tree)
    size = cast([tuple(v.T[:, None]) for v in sizes])
    poses = cast([harness.to_pose(*p) for p in zip(x, q)])
    m = jax.jit(NARROW[BOXES].function)(*poses, *size, jnp.float32(0))
    assert m.distance.dtype == jnp.float32 and m.feature.dtype == jnp.int32
    deepest = np.where(m.live, m.distance, np.inf).min(0)[0]
    expected = np.where(wide["live"], wide["distance"], np.inf).min(1)
    both = np.isfinite(deepest) & np.isfinite(expected)
    assert (np.isfinite(deepest) == np.isfinite(expected)).mean() > 0.995
    assert np.quantile(np.abs(deepest[both] - expected[both]), 0.99) < 1e-5


def test_program_has_no_sort_gather_or_dynamic_index():
    leaf = jnp.ones((2, 4))
    pose = Pose(Vec3(leaf, leaf, leaf), Quat(leaf, 0 * leaf, 0 * leaf, 0 * leaf))
    for kind in KINDS:
        size = [(leaf,) * harness.SIZE_COUNT[k] for k in kind]
        text = str(jax.make_jaxpr(NARROW[kind].function)(pose, pose, *size, 0.0))
        for word in ("sort", "gather", "dynamic_slice", "scatter", "while", "scan["):
            assert word not in text, (kind, word)
        assert text.count("concatenate") <= 3  # along slots
