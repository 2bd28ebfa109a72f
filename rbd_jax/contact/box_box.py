"""Layer 4: box (A) and box (B): separating axes, then the complete manifold by clipping.

Symbols: R = RaᵀRb (entry ij = axis i of A . axis j of B), t = Raᵀ(xB - xA), h half-extents [m],
s separation along a unit axis [m] (negative = overlap). The pair's 15 axes are numbered
0-2 faces of A, 3-5 faces of B, 6 + 3i + j the cross product of axis i of A and axis j of B.

Face contact: the reference box owns the chosen face (axis m, its other two axes X, Y); of the
other, incident box the face most nearly opposed to it (axis c, its other two axes u, w) is the
parallelogram c0 + alpha U + beta W, alpha and beta in [-1, 1]. Its overlap with the reference
rectangle, seen along m, is a polygon of at most eight corners. They are

* slots 0-7: the two ends of each incident edge clipped to the rectangle, of which the second
  counts only where it was clipped (it is the next edge's first end otherwise),
* slots 8-11: the rectangle's corners inside the parallelogram.

Edge contact: slot 0 holds the closest points of the two supporting edges.

Source: Gottschalk, Lin, Manocha 1996 (axes); the face preference is the rule that MuJoCo 4 shows.
Differs from the usual Sutherland-Hodgman clipping: edges are clipped in parameter space, so the
slots are fixed, nothing is sorted and no loop runs.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..spatial import Vec3, components, where
from ..xla import materialise
from .base import Manifold, Pose

SLOTS = 12
# An edge axis within acos(0.99) = 8 degrees of the face normal must win by 5 %, any edge axis by 1e-6.
NEAR_SIN2, NEAR_GAIN, EDGE_GAIN = 1.0 - 0.99**2, 0.05, 1e-6
# An edge axis within 2e-3 rad of the face normal never wins: the clipped faces say the same with more points.
SAME_SIN2 = 4e-6
# Edges closer to parallel than 1e-3 rad have no axis of their own.
PARALLEL_SIN2 = 1e-6
# B's face must win by this fraction of the size; in nearly parallel faces, where the two
# separations differ by rounding and small tilts, by the larger one, which stops flicker.
FACE_TIE, PARALLEL_FACE_TIE = 1e-6, 1e-3

# Corners closer than this part of the reference face's half-widths are one, in a manifold with a margin.
SNAP = 1e-3

BOTH = np.array([-1.0, 1.0])[:, None, None]
CORNER_X = np.array([-1.0, 1.0, 1.0, -1.0])[:, None, None]
CORNER_Y = np.array([-1.0, -1.0, 1.0, 1.0])[:, None, None]
FIRST_SLOT = (np.arange(SLOTS) == 0)[:, None, None]


def _pick(masks, values):
    """values[k] by the first two of three one-hot masks."""
    first, second, _ = masks
    x, y, z = values
    return jnp.where(first, x, jnp.where(second, y, z))


def _one_hot(index):
    return index == 0, index == 1, index == 2


def _sign(v):
    return jnp.where(v < 0, -1.0, 1.0).astype(v.dtype)


def _axis(a: Pose, b: Pose, ha, hb):
    """Number of the axis with the largest separation, with the preferences above, as a float array."""
    R = (a.q.conj() @ b.q).mat()
    t = a.q.rotate_inv(b.x - a.x)
    tb = R.tmul(t)
    t, tb = (t.x, t.y, t.z), (tb.x, tb.y, tb.z)
    r = [[row.x, row.y, row.z] for row in (R.a, R.b, R.c)]
    size = ha[0] + ha[1] + ha[2] + hb[0] + hb[1] + hb[2]
    ar = [[jnp.abs(v) for v in row] for row in r]
    sq = [[v * v for v in row] for row in r]

    def best(values):
        s, k = values[0], jnp.zeros_like(values[0])
        for i in (1, 2):
            better = values[i] > s
            s, k = jnp.where(better, values[i], s), jnp.where(better, float(i), k)
        return s, k

    sa, ka = best([jnp.abs(t[i]) - ha[i] - sum(hb[j] * ar[i][j] for j in range(3)) for i in range(3)])
    sb, kb = best([jnp.abs(tb[j]) - hb[j] - sum(ha[i] * ar[i][j] for i in range(3)) for j in range(3)])
    on_a, on_b = _one_hot(ka), _one_hot(kb)
    same = _pick(on_a, [_pick(on_b, row) for row in sq]) > 1.0 - SAME_SIN2
    b_wins = sb > sa + jnp.where(same, PARALLEL_FACE_TIE, FACE_TIE) * size
    face = jnp.where(b_wins, sb, sa)
    code = jnp.where(b_wins, kb + 3.0, ka)
    one, zero = jnp.ones_like(sa), jnp.zeros_like(sa)
    on_a = [jnp.where(m & ~b_wins, one, zero) for m in on_a]
    on_b = [jnp.where(m & b_wins, one, zero) for m in on_b]

    # the best edge axis; whether it is near the chosen face's normal, or all but the same
    best_edge, number = jnp.full_like(sa, -jnp.inf), jnp.full_like(sa, 6.0)
    near = merged = jnp.zeros(sa.shape, bool)
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            sin2 = sq[i1][j] + sq[i2][j]
            exists = sin2 > PARALLEL_SIN2
            overlap = ha[i1] * ar[i2][j] + ha[i2] * ar[i1][j] + hb[j1] * ar[i][j2] + hb[j2] * ar[i][j1]
            gap = jnp.abs(t[i2] * r[i1][j] - t[i1] * r[i2][j]) - overlap
            s = gap * jax.lax.rsqrt(jnp.where(exists, sin2, 1.0))
            # squared sine of the angle to the chosen face's normal, times sin2
            off = (
                (on_a[i] + on_b[j]) * sin2
                + on_a[i1] * sq[i1][j]
                + on_a[i2] * sq[i2][j]
                + on_b[j1] * sq[i][j1]
                + on_b[j2] * sq[i][j2]
            )
            better = exists & (s > best_edge)
            best_edge, number = jnp.where(better, s, best_edge), jnp.where(better, 6.0 + 3 * i + j, number)
            near = jnp.where(better, off < NEAR_SIN2 * sin2, near)
            merged = jnp.where(better, off < SAME_SIN2 * sin2, merged)
    gain = jnp.where(near, NEAR_GAIN, EDGE_GAIN) * jnp.abs(face) + 8 * jnp.finfo(sa.dtype).eps * size
    return jnp.where((best_edge > face + gain) & ~merged, number, code)


def box_box(a: Pose, b: Pose, size_a, size_b, margin, one=1.0) -> Manifold:
    """Twelve slots, at most eight live; see the module's docstring.

    With a margin, separated boxes keep the manifold of the best face: the rectangle grows by the
    separation, so boxes closer than the margin always have a live point.
    feature: 12 (axis) + 2 (incident axis) + its sign for faces, plus one offset per side; edges
    from 72 with the four signs that select them.
    Gradients: of points, distances and normal for the chosen axis; the choice itself is constant.
    """
    ha, hb = tuple(size_a), tuple(size_b)
    dtype = (a.x.x + b.x.x).dtype
    code = materialise(jax.lax.stop_gradient(_axis(a, b, ha, hb)), one)
    edge = code > 5.5
    ref_b = (code > 2.5) & ~edge
    pair = code - 6.0
    edge_i = jnp.where(pair > 5.5, 2.0, jnp.where(pair > 2.5, 1.0, 0.0)).astype(dtype)
    k = jnp.where(edge, edge_i, jnp.where(ref_b, code - 3.0, code))
    on_k = _one_hot(k)

    # reference box: the chosen axis m and, in cyclic order, X and Y
    q_ref, q_inc = where(ref_b, b.q, a.q), where(ref_b, a.q, b.q)
    x_ref = where(ref_b, b.x, a.x)
    d = where(ref_b, a.x, b.x) - x_ref
    h_ref = tuple(jnp.where(ref_b, p, q) for p, q in zip(hb, ha))
    h_inc = tuple(jnp.where(ref_b, q, p) for p, q in zip(hb, ha))

    def axes(q, masks):
        """Columns k, k + 1 and k + 2 (cyclic) of the rotation matrix of q."""
        R = q.mat()
        rows = [(row.x, row.y, row.z) for row in (R.a, R.b, R.c)]
        first = Vec3(*(_pick(masks, row) for row in rows))
        second = Vec3(*(_pick(masks, row[1:] + row[:1]) for row in rows))
        first, second = materialise((first, second), one)
        return first, second, materialise(first.cross(second), one)

    def sizes(h, masks):
        return tuple(_pick(masks, h[s:] + h[:s]) for s in range(3))

    m, X, Y = axes(q_ref, on_k)
    hm, hX, hY = sizes(h_ref, on_k)
    d = materialise(d, one)

    # incident box: the face most nearly opposed to m (or the edge), c, and its other axes u and w
    g = q_inc.mat().tmul(m).map(jnp.abs)
    opposed = jnp.where((g.x >= g.y) & (g.x >= g.z), 0.0, jnp.where(g.y >= g.z, 1.0, 2.0))
    f = jnp.where(edge, pair - 3.0 * edge_i, opposed.astype(dtype))
    f = materialise(jax.lax.stop_gradient(f), one)
    on_f = _one_hot(f)
    c, u, w = axes(q_inc, on_f)
    hc, hu, hw = sizes(h_inc, on_f)

    # normal from the reference to the incident box: the face's, or m x c of the two edges
    cross = m.cross(c)
    length2 = jnp.where(edge, cross.dot(cross), 1.0)
    n = where(edge, cross * jax.lax.rsqrt(length2), m)
    side = _sign(n.dot(d))
    n = materialise(n * side, one)
    reach, nu, nw, nX, nY = materialise((n.dot(d), n.dot(u), n.dot(w), n.dot(X), n.dot(Y)), one)

    # face: centre of the incident parallelogram, and its height above the reference face
    nc = n.dot(c)
    facing = _sign(nc)
    centre = d - c * (facing * hc)
    height = reach - jnp.abs(nc) * hc - hm
    separation = height - hu * jnp.abs(nu) - hw * jnp.abs(nw)

    # edges: midpoint of the points of A's edge (along m) and B's (along c) closest to each other,
    # kept on the edges, which they can leave only when the boxes are apart
    sX, sY, su, sw = hX * _sign(nX), hY * _sign(nY), hu * _sign(nu), hw * _sign(nw)
    mc = m.dot(c)
    vm = m.dot(d) - su * m.dot(u) - sw * m.dot(w)
    vc = c.dot(d) - sX * c.dot(X) - sY * c.dot(Y)
    on_b = materialise((mc * vm - vc) / length2, one)
    on_a = materialise(jnp.clip(vm + mc * on_b, -hm, hm), one)
    middle = (X * sX + Y * sY + m * on_a + d - u * su - w * sw + c * jnp.clip(on_b, -hc, hc)) * 0.5
    gap = reach - jnp.abs(nX) * hX - jnp.abs(nY) * hY - jnp.abs(nu) * hu - jnp.abs(nw) * hw

    # what the slots need: distance and midpoint are linear in alpha and beta
    z0 = materialise(jnp.where(edge, gap, height), one)
    Uh, Wh = jnp.where(edge, 0.0, hu), jnp.where(edge, 0.0, hw)
    Uz, Wz = materialise((Uh * nu, Wh * nw), one)
    P0 = materialise(x_ref + where(edge, middle, centre - n * (0.5 * z0)), one)
    PU = materialise(u * Uh - n * (0.5 * Uz), one)
    PW = materialise(w * Wh - n * (0.5 * Wz), one)

    # the parallelogram and the rectangle in the plane (X, Y); in an edge contact anything regular
    # Where the manifold feeds a solver (margin > 0), corners that agree within SNAP are one corner: the slots of
    # aligned boxes must not come and go with rounding, or their warm-start impulses are lost.
    slack = jnp.where(margin > 0, SNAP, jnp.finfo(dtype).eps ** 0.75).astype(dtype) * (hX + hY)
    grow = slack + jnp.where(separation > 0, 1.05 * separation, 0.0)
    HX, HY = materialise((hX + grow, hY + grow), one)
    cx, cy = materialise((X.dot(centre), Y.dot(centre)), one)
    Ux, Wx = materialise((jnp.where(edge, hX, hu * X.dot(u)), Wh * X.dot(w)), one)
    Uy, Wy = materialise((Uh * Y.dot(u), jnp.where(edge, hY, hw * Y.dot(w))), one)
    alpha, beta = materialise(_clip(cx, cy, Ux, Uy, Wx, Wy, HX, HY, jnp.finfo(dtype).eps * slack), one)
    inside = jnp.where(edge, FIRST_SLOT, _corners(alpha, beta))

    distance = z0 + alpha * Uz + beta * Wz

    def at_slots(p, pu, pw):
        return p + alpha * pu + beta * pw

    def bit(s, value):
        return jnp.where(s < 0, value, 0)

    face_code = 12 * code.astype(jnp.int32) + 2 * f.astype(jnp.int32) + bit(side, 6) + bit(nc, 1)
    edge_code = 72 + 16 * pair.astype(jnp.int32) + bit(nX, 1) + bit(nY, 2) + bit(nu, 4) + bit(nw, 8)
    return Manifold(
        normal=where(ref_b, -n, n),
        point=Vec3(*map(at_slots, components(P0), components(PU), components(PW))),
        distance=distance,
        live=inside & (distance < margin),
        feature=jnp.where(edge, edge_code, face_code),
    )


def _clip(cx, cy, Ux, Uy, Wx, Wy, HX, HY, tiny):
    """Slots of the overlap of the parallelogram c + alpha U + beta W with |x| <= HX, |y| <= HY.

    Returns alpha and beta, (12, P, B), clipped to [-1, 1] (an empty edge has both ends at one): of
    the edges beta = -1, 1 the lower ends (2), then the upper ends (2); of the edges alpha = -1, 1
    likewise (4); of the rectangle's corners (4). Edges within ``tiny`` [m] of parallel count as parallel.
    """
    tiny = jnp.maximum(tiny, 1e-15)

    def interval(x, y, dx, dy):
        """Ends, lower > upper if none, of the part of the line (x, y) + s (dx, dy) in the rectangle."""
        ix = 1.0 / jnp.where(jnp.abs(dx) < tiny, tiny, dx)
        iy = 1.0 / jnp.where(jnp.abs(dy) < tiny, tiny, dy)
        rx, ry = HX * jnp.abs(ix), HY * jnp.abs(iy)
        mx, my = -x * ix, -y * iy
        return jnp.maximum(mx - rx, my - ry), jnp.minimum(mx + rx, my + ry)

    s = jnp.asarray(BOTH, cx.dtype)
    u_ends = interval(cx + s * Wx, cy + s * Wy, Ux, Uy)
    w_ends = interval(cx + s * Ux, cy + s * Uy, Wx, Wy)
    x = jnp.asarray(CORNER_X, cx.dtype) * HX - cx
    y = jnp.asarray(CORNER_Y, cx.dtype) * HY - cy
    det = Ux * Wy - Uy * Wx
    inverse = 1.0 / jnp.where(jnp.abs(det) > 1e-15, det, 1.0)
    sides = s + jnp.zeros_like(u_ends[0])
    alpha = jnp.concatenate([*u_ends, sides, sides, (x * Wy - y * Wx) * inverse])
    beta = jnp.concatenate([sides, sides, *w_ends, (y * Ux - x * Uy) * inverse])
    return jnp.clip(alpha, -1.0, 1.0), jnp.clip(beta, -1.0, 1.0)


def _corners(alpha, beta):
    """Which slots of ``_clip`` are corners of the overlap, each corner once.

    Walking round the parallelogram, the edges beta = -1 and alpha = 1 run upwards, the others
    downwards; an edge's second end counts only where it was clipped.
    """
    down = BOTH > 0

    def ends(lo, hi, down):
        crosses = lo < hi
        return crosses & (~down | (lo > -1.0)), crosses & (down | (hi < 1.0))

    inside = (jnp.abs(alpha[8:]) < 1.0) & (jnp.abs(beta[8:]) < 1.0)
    return jnp.concatenate([*ends(alpha[:2], alpha[2:4], down), *ends(beta[4:6], beta[6:8], ~down), inside])
