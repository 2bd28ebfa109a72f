"""One world with many bodies: does the cost follow the live contacts, and is the answer still right?

    PYTHONPATH=. python benchmarks/large_worlds.py                     (more than ten minutes on 2 cores)
    PYTHONPATH=. python benchmarks/large_worlds.py --quick --out /tmp/x

Blocks of touching spheres (n x n x n, each pushed at random) and boxes on pedestals (n x n), preset "fast", float32,
beside MuJoCo on one thread with the same MJCF and the same start. Beside every time: live contacts, the deepest
overlap at the end by MuJoCo's geometry (the same ruler for both), status bits. Writes large_worlds.json and
large_worlds.md under ``--out`` (benchmarks/results).
"""

from __future__ import annotations

import argparse
import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
from common import MuJoCo, Program, number  # noqa: E402

import rbd_jax as rbd  # noqa: E402

DT = 1 / 240
#: MuJoCo, which takes seconds a step there, is timed over few steps of more bodies than this, and once.
LARGE, FEW = 250, 3


def spheres(n: int) -> rbd.Scene:
    place = lambda i, j, k: (0.2005 * i, 0.2005 * j, 0.1 + 0.2005 * k)
    bodies = [
        rbd.Body(f"b{i}_{j}_{k}", rbd.Sphere(0.1), pos=place(i, j, k), friction=0.5)
        for i in range(n) for j in range(n) for k in range(n)
    ]  # fmt: skip
    return rbd.Scene(bodies, [rbd.Geom(rbd.Plane(), friction=0.5)], dt=DT)


def pedestals(n: int) -> rbd.Scene:
    every = [(0.25 * i, 0.25 * j) for i in range(n) for j in range(n)]
    bodies = [rbd.Body(f"b{k}", rbd.Box((0.1, 0.1, 0.1)), pos=(*at, 0.13), friction=0.6) for k, at in enumerate(every)]
    return rbd.Scene(bodies, [rbd.Geom(rbd.Box((0.05, 0.05, 0.02)), pos=(*at, 0.01)) for at in every], dt=DT)


#: (name, scene, size, steps)
CASES = [
    *(("spheres", spheres, n, 60) for n in (2, 3, 4, 5, 6, 8, 10)),
    *(("boxes on static boxes", pedestals, n, 60) for n in (2, 4, 6, 8, 10)),
]


def measured(name, scene, steps, repeats) -> dict:
    model, state = rbd.build(scene, method="fast")
    vel = 0.1 * np.random.default_rng(0).normal(size=(1, state.n, 3)) * (name == "spheres")
    start = common.start(state, vel=vel)
    run = Program(lambda m, s: rbd.rollout(m, s, steps, every=steps)[0], model, start)
    rival = MuJoCo(scene, DT, threads=1)
    q, v = rbd.to_mujoco(model, start)
    begin = rival.initial(np.asarray(q, float), np.asarray(v, float))
    whole = state.n <= LARGE
    rival_steps = steps if whole else min(FEW, steps)
    arrays = rival.allocate(1, rival_steps)
    ours, theirs = [], []
    for k in range(repeats):
        ours.append(run.seconds(model, start) / steps)
        if whole or k == 0:
            clock = time.perf_counter()
            out = rival.call(begin, rival_steps, arrays)
            theirs.append((time.perf_counter() - clock) / rival_steps)
    end = run(model, start)
    seen = jax.jit(rbd.contacts)(model, end)
    row = {
        "scene": name, "bodies": state.n, "static": len(scene.static), "solver": model.method.solver.name,
        "steps": steps, "compile_s": run.total_s,
        "ours_s": min(ours), "mujoco_s": min(theirs), "ratio": min(ours) / min(theirs),
        "contacts": int(np.asarray(seen.live).sum()), "status": int(np.asarray(end.status)[0]),
        "ours_overlap": rival.penetration(rbd.to_mujoco(model, end)[0]),
        "mujoco_overlap": rival.penetration(out[:, -1, 1 : 1 + rival.model.nq]) if whole else None,
        "finite": bool(jnp.isfinite(end.pos).all()),
    }  # fmt: skip
    rival.close()
    return row


def slope(rows, of) -> float:
    """Exponent of a power law of ``of`` in the number of bodies."""
    x, y = (np.log([r[k] for r in rows]) for k in ("bodies", of))
    return float(np.polyfit(x, y, 1)[0])


def report(rows, env) -> str:
    heads = ["scene", "bodies", "solver", "contacts", "compile [s]", "ours [ms/step]", "MuJoCo, 1 thread [ms/step]",
             "ratio", "ours, us per contact", "deepest overlap, ours [mm]", "MuJoCo [mm]", "status"]  # fmt: skip
    lines = [
        [r["scene"], r["bodies"], r["solver"], r["contacts"], number(r["compile_s"]), number(1e3 * r["ours_s"]),
         number(1e3 * r["mujoco_s"]), number(r["ratio"]), number(1e6 * r["ours_s"] / max(r["contacts"], 1)),
         number(1e3 * r["ours_overlap"]),
         number(r["mujoco_overlap"] and 1e3 * r["mujoco_overlap"]), r["status"]]
        for r in rows
    ]  # fmt: skip
    text = []
    for name in dict.fromkeys(r["scene"] for r in rows):
        own = [r for r in rows if r["scene"] == name]
        own = [r for r in own if r["solver"] == own[-1]["solver"]]  # preset "fast" solves few boxes by another
        own = own[len(own) // 2 :]
        if len(own) > 2:
            text.append(
                f"* {name}, the larger half: time grows like bodies^{slope(own, 'ours_s'):.2f} (ours) and "
                f"bodies^{slope(own, 'mujoco_s'):.2f} (MuJoCo); contacts like bodies^{slope(own, 'contacts'):.2f}."
            )
    return "\n".join(
        ["# Large worlds", "", common.header(env), "Made by `benchmarks/large_worlds.py`.", "",
         'One world, preset "fast", float32, dt 1/240 s; best of three, compile apart. Of more than '
         f"{LARGE} bodies MuJoCo is timed once over {FEW} steps, so there is no overlap of its end.", "",
         common.table(heads, lines), "", *text, ""]
    )  # fmt: skip


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=pathlib.Path, default=common.RESULTS)
    parser.add_argument("--quick", action="store_true", help="the smallest of each scene, a few steps")
    args = parser.parse_args(argv)
    env = common.environment()
    rows = []
    for name, scene, n, steps in CASES:
        if args.quick and n > 2:
            continue
        rows.append(measured(name, scene(n), 5 if args.quick else steps, 1 if args.quick else 3))
        print({k: v if isinstance(v, (str, int)) else float(f"{v:.3g}") for k, v in rows[-1].items()}, flush=True)
    common.write_json(args.out / "large_worlds.json", {"environment": env, "rows": rows})
    (args.out / "large_worlds.md").write_text(report(rows, env), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
