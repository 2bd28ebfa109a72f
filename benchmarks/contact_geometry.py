"""Contact geometry against MuJoCo on random poses, and its cost.

    python benchmarks/contact_geometry.py [--poses 10000] [--out benchmarks/results]

Writes contact_geometry.json and .md. ``compare`` is also what the tests run, on fewer poses.
Two geoms of random size per pose; poses from far apart to deeply overlapping, f64.
"""

from __future__ import annotations

import argparse
import functools
import json
import pathlib
import platform
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rbd_jax.contact import NARROW, Pose
from rbd_jax.spatial import Quat, Vec3, pack

KINDS = tuple(NARROW)
BATCH = 500  # poses a call; one shape, so each kind compiles once
TIMING_PAIRS, TIMING_WORLDS, TIMING_STEPS = (1, 16), 1024, 100
SIZE_COUNT = {"plane": 0, "sphere": 1, "box": 3}


# --- random pairs and the two engines' answers ---


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def reach(kind, size):
    """Radius of a sphere about the origin that holds each geom (0 for planes) [m]."""
    return np.linalg.norm(size, axis=-1) if SIZE_COUNT[kind] else np.zeros(len(size))


def random_pairs(kind, count, rng):
    """Sizes (count, k), positions (count, 3) and quaternions (count, 4) of A and B."""
    sizes = [rng.uniform(0.05, 0.4, (count, SIZE_COUNT[k])) for k in kind]
    quats = [unit(rng.normal(size=(count, 4))) for _ in kind]
    xa = rng.uniform(-1, 1, (count, 3))
    far = (reach(kind[0], sizes[0]) + reach(kind[1], sizes[1])) * rng.uniform(0, 1.2, count)
    xb = xa + unit(rng.normal(size=(count, 3))) * far[:, None]
    return sizes, [xa, xb], quats


def to_pose(x, q):
    """Pose with leaves (1, count) from (count, 3) and (count, 4)."""
    return Pose(
        Vec3(*(jnp.asarray(c)[None] for c in np.moveaxis(x, -1, 0))),
        Quat(*(jnp.asarray(c)[None] for c in np.moveaxis(q, -1, 0))),
    )


@functools.cache
def compiled(kind):
    return jax.jit(NARROW[kind].function, static_argnames="one")


def ours(kind, sizes, x, q, margin=0.0):
    """Our manifolds of (count) pairs as numpy: normal (count, 3), point (count, S, 3), distance, live (count, S)."""
    count = len(x[0])
    pad = -count % BATCH

    def padded(v):
        return np.concatenate([v, np.repeat(v[-1:], pad, axis=0)]) if pad else v

    chunks = []
    sizes, x, q = ([padded(np.asarray(v)) for v in pair] for pair in (sizes, x, q))
    for start in range(0, count, BATCH):
        s = slice(start, start + BATCH)
        size = [tuple(jnp.asarray(c)[None] for c in v[s].T) for v in sizes]
        m = compiled(kind)(to_pose(x[0][s], q[0][s]), to_pose(x[1][s], q[1][s]), *size, margin)
        chunks.append(
            dict(
                normal=np.asarray(pack(m.normal))[0],
                point=np.moveaxis(np.asarray(pack(m.point))[:, 0], 0, 1),
                distance=np.asarray(m.distance)[:, 0].T,
                live=np.asarray(m.live)[:, 0].T,
                feature=np.broadcast_to(np.asarray(m.feature), (1, BATCH))[0],
            )
        )
    return {k: np.concatenate([c[k] for c in chunks])[:count] for k in chunks[0]}


def mujoco_model(kind):
    """Two geoms: B on a free body, A too unless it is a plane (mocap; a plane cannot fall)."""
    one = {"plane": "1 1 1", "sphere": "1", "box": "1 1 1"}
    attributes = {True: ' mocap="true"', False: ""}
    joints = {True: "", False: "<freejoint/>"}
    bodies = "".join(
        f"<body{attributes[k == 'plane']}>{joints[k == 'plane']}<geom type='{k}' size='{one[k]}'/></body>" for k in kind
    )
    return mujoco.MjModel.from_xml_string(f'<mujoco><option gravity="0 0 0"/><worldbody>{bodies}</worldbody></mujoco>')


def mujoco_contacts(kind, sizes, x, q):
    """Per pair the arrays (distance (n,), normal (n, 3), point (n, 3)) that MuJoCo lists."""
    model = mujoco_model(kind)
    data = mujoco.MjData(model)
    out = []
    for k in range(len(x[0])):
        for g, name in enumerate(kind):
            n = SIZE_COUNT[name]
            if n:
                size = np.resize(sizes[g][k], 3) if n == 1 else sizes[g][k]
                model.geom_size[g] = size
                model.geom_rbound[g] = size[0] if n == 1 else np.linalg.norm(size)
                model.geom_aabb[g, 3:] = size
        if kind[0] == "plane":
            data.mocap_pos[0], data.mocap_quat[0] = x[0][k], q[0][k]
            data.qpos[:] = np.r_[x[1][k], q[1][k]]
        else:
            data.qpos[:] = np.r_[x[0][k], q[0][k], x[1][k], q[1][k]]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        c = data.contact
        out.append((c.dist.copy(), c.frame[:, :3].copy(), c.pos.copy()))
    return out


def compare(kind, count, seed):
    """Differences on ``count`` random poses; lengths relative to the largest edge (or diameter) of the pair."""
    rng = np.random.default_rng(seed)
    sizes, x, q = random_pairs(kind, count, rng)
    mine = ours(kind, sizes, x, q)
    theirs = mujoco_contacts(kind, sizes, x, q)
    touching = missed = extra = 0
    deepest_missed = 0.0
    errors = {"depth": [], "normal": [], "point": [], "deepest": []}
    same_set = 0
    for k, (dist, normal, point) in enumerate(theirs):
        live = mine["live"][k]
        if not len(dist) or not live.any():
            missed += bool(len(dist))
            extra += bool(live.any())
            if len(dist):
                deepest_missed = max(deepest_missed, -dist.min())
            continue
        touching += 1
        scale = 2 * max(s[k].max() for s in sizes if s.shape[1])
        d, p = mine["distance"][k][live], mine["point"][k][live]
        errors["depth"].append(abs(d.min() - dist.min()) / scale)
        errors["normal"].append(abs(normal - mine["normal"][k]).max())
        # each of MuJoCo's points: the nearest of ours, in place and in depth
        gap = np.maximum(np.abs(p[:, None] - point[None]).max(-1), np.abs(d[:, None] - dist[None])).min(0) / scale
        errors["point"].append(gap.max())
        same_set += bool(len(d) == len(dist) and gap.max() < 1e-9)
    good = (np.array(errors["depth"]) < 1e-9) & (np.array(errors["normal"]) < 1e-9)
    return {
        "pair": "-".join(kind),
        "poses": count,
        "touching": touching,
        "missed": missed,
        "deepest missed [m]": deepest_missed,
        "extra": extra,
        "depth and normal within 1e-9": float(good.mean()),
        "points within 1e-9": float((np.array(errors["point"]) < 1e-9).mean()),
        "same set of points": same_set / touching,
        "max depth error": max(errors["depth"]),
        "max normal error": max(errors["normal"]),
        "max point error": max(errors["point"]),
        "most live points": int(mine["live"].sum(1).max()),
    }


# --- cost ---


def timing(kind, pairs, one):
    """ns per pair (best of 30) and seconds to compile, f32: a scan of evaluations with changing input."""
    rng = np.random.default_rng(0)
    shape = (pairs, TIMING_WORLDS)
    half = {"plane": (), "sphere": (0.15,), "box": (0.15, 0.2, 0.25)}

    def poses():
        q = rng.normal(size=(4, *shape))
        q /= np.linalg.norm(q, axis=0)
        x = rng.uniform(-0.15, 0.15, (3, *shape))
        return Pose(Vec3(*jnp.asarray(x, jnp.float32)), Quat(*jnp.asarray(q, jnp.float32)))

    a, b = poses(), poses()
    sizes = [tuple(jnp.full((pairs, 1), s, jnp.float32) for s in half[k]) for k in kind]
    margin = jnp.float32(0.01)
    function = NARROW[kind].function

    def run(a, b, sa, sb):
        def body(m, _):
            moved = Pose(Vec3(b.x.x + 1e-7 * m.distance[0], b.x.y, b.x.z), b.q)
            return function(a, moved, sa, sb, margin, one=one), None

        shapes = jax.eval_shape(lambda: function(a, b, sa, sb, margin))
        start = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
        return jax.lax.scan(body, start, None, length=TIMING_STEPS)[0]

    start = time.perf_counter()
    program = jax.jit(run).lower(a, b, *sizes).compile()
    compile_time = time.perf_counter() - start
    jax.block_until_ready(program(a, b, *sizes))
    best = np.inf
    for _ in range(30 if one else 2):
        start = time.perf_counter()
        jax.block_until_ready(program(a, b, *sizes))
        best = min(best, time.perf_counter() - start)
    return best / TIMING_STEPS / pairs / TIMING_WORLDS * 1e9, compile_time


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--poses", type=int, default=10_000)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path(__file__).parent / "results")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = [compare(kind, args.poses, seed=k) for k, kind in enumerate(KINDS)]
    costs = []
    for kind in KINDS:
        for pairs in TIMING_PAIRS:
            (with_ns, with_s), (plain_ns, plain_s) = timing(kind, pairs, 1.0), timing(kind, pairs, None)
            costs.append(
                {
                    "pair": "-".join(kind),
                    "pairs x worlds": f"{pairs} x {TIMING_WORLDS}",
                    "ns per pair": round(with_ns, 1),
                    "without waists": round(plain_ns, 1),
                    "compile [s]": round(with_s, 2),
                    "without waists [s]": round(plain_s, 2),
                }
            )
    versions = {
        "mujoco": mujoco.__version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "device": jax.devices()[0].platform,
    }
    args.out.mkdir(parents=True, exist_ok=True)
    result = {"versions": versions, "against MuJoCo": rows, "cost": costs}
    (args.out / "contact_geometry.json").write_text(json.dumps(result, indent=1) + "\n")
    (args.out / "contact_geometry.md").write_text(report(result))
    print(report(result))


def table(rows):
    def cell(v):
        return f"{v:.3g}" if isinstance(v, float) and v < 0.1 else f"{v:.6g}" if isinstance(v, float) else str(v)

    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    return "\n".join(lines + ["| " + " | ".join(cell(v) for v in r.values()) + " |" for r in rows])


def report(result):
    versions = ", ".join(f"{k} {v}" for k, v in result["versions"].items())
    return f"""# Contact geometry

Written by `python benchmarks/contact_geometry.py`. {versions}.

## Against MuJoCo, f64, random sizes and poses

Errors are relative to the largest edge or diameter; fractions are of the touching poses. "Points": each
of MuJoCo's points is among ours; "same set": and we list no others (MuJoCo lists at most four for box-plane).

{table(result["against MuJoCo"])}

## Cost, f32, one evaluation inside a scan

Best of 30; the machine was shared, so good to about a factor 1.5.

{table(result["cost"])}
"""


if __name__ == "__main__":
    main()
