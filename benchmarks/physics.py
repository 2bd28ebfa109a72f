"""Contact response and agreement with MuJoCo, as numbers with their bars.

    PYTHONPATH=. python benchmarks/physics.py                    (about 6 minutes on 2 cores)
    PYTHONPATH=. python benchmarks/physics.py --examples all     (every shipped example; several minutes more)
    PYTHONPATH=. python benchmarks/physics.py --smoke --out /tmp/x

Writes physics.json and physics.md under ``--out`` (benchmarks/results). Float32 at 1/240 s unless said. The column
"MuJoCo" is MuJoCo itself at a tenth of the step, through the same MJCF.
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import sys
import time

import jax
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
from common import G, MuJoCo, number  # noqa: E402

import rbd_jax as rbd  # noqa: E402
from rbd_jax import examples, parity  # noqa: E402

DT = 1 / 240
MU = 0.5
FINE = 10  # MuJoCo's step is ours over this
HALF = (0.1, 0.15, 0.2)
PRESETS = ("fast", "accurate", "mujoco")
SHOWN = ("box_stack", "tumbling_box", "conveyor")
ZETA = 0.07436  # damping ratio of MuJoCo's contact whose restitution is 0.8

#: key: (what, unit, bar per method or one for all, section of the issue). "mujoco" is told, not judged, in section 4.
FIGURES = {
    "rest_speed_box": ("box dropped spinning: largest speed from 2 s on", "m/s", 1e-4),
    "rest_speed_sphere": ("sphere dropped: largest speed from 2 s on", "m/s", 1e-4),
    "rest_speed_boxes": ("64 boxes dropped tumbling: largest speed at 3 s", "m/s", None),
    "rest_speed_boxes_95": ("same, 95th percentile", "m/s", None),
    "slide_error": ("slide to stop, mu 0.5, 3 m/s: relative error", "-", 5e-3),
    "slide_error_range": ("same, 1 to 4 m/s, worst", "-", None),
    "roll_error": ("slip to roll, speed over 5/7 v0: relative error", "-", 1e-3),
    "apex_error": ("first five apexes, e 0.8, 1 m: largest relative error", "-", {"fast": 5e-2, "accurate": 1e-2}),
    "stack_drift": ("five-box stack, 10 s: sideways, largest", "m", 0.02),
    "stack_sag": ("same: sinking of the top box", "m", None),
    "stack_speed": ("same: speed at 10 s", "m/s", None),
    "stack_tilt": ("same: tilt or turn of a box", "rad", None),
    "stack_force": ("same: force of the ground over 5 m g, minus 1", "-", 1e-3),
    "linear_momentum": ("two spheres collide, e 0.5: change of P / P", "-", 1e-6),
    "angular_momentum": ("same: change of L about the origin / (P 0.1 m)", "-", 1e-5),
    "linear_momentum_f64": ("same in float64: change of P / P", "-", 1e-14),
    "angular_momentum_f64": ("same in float64: change of L / (P 0.1 m)", "-", 1e-13),
    "energy_rise": ("64 tumbling boxes: largest rise of energy in a step / (m g d)", "-", 1e-3),
    "energy_rise_e": ("same with e = 0, 0.25, 0.5, 0.9", "-", 1e-3),
    "rest_pose": ("box laid down from 2 cm: centre of mass against MuJoCo", "m", 1e-3),
    "stack_pose": ("stack: positions against MuJoCo", "m", 1e-3),
    "bad_worlds": ("worlds with a status bit, of all above", "", 0),
}


# --- scenes ---


def _one(body, friction=MU, **kwargs):
    return rbd.Scene(bodies=[body], static=[rbd.Geom(rbd.Plane(), friction=friction, **kwargs)], dt=DT)


def ball(e=None, friction=MU):
    return _one(rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 1.1), friction=friction, restitution=e), friction)


def box(e=None):
    return _one(rbd.Body("box", rbd.Box(HALF), pos=(0, 0, 0.5), omega=(1, 2, 3), friction=MU, restitution=e))


def stack(n=5, half=0.1):
    bodies = [rbd.Body(f"box{i}", rbd.Box((half,) * 3), pos=(0, 0, half * (2 * i + 1)), friction=0.6) for i in range(n)]
    return rbd.Scene(bodies=bodies, static=[rbd.Geom(rbd.Plane(), friction=0.6)], dt=DT)


def spheres(e=0.5):
    return rbd.Scene(
        bodies=[
            rbd.Body("a", rbd.Sphere(0.1), vel=(1, 0, 0), mass=1.0, restitution=e),
            rbd.Body("b", rbd.Sphere(0.2), pos=(0.5, 0.1, 0), mass=3.0, restitution=e),
        ],
        gravity=None,
        dt=DT,
    )


def soft_ball(steps_per_omega=20, dt=DT / FINE):
    """A ball whose MuJoCo contact bounces with e = 0.8: frequency times step = 1 / steps_per_omega."""
    omega, d = 1.0 / (steps_per_omega * dt), 0.9999
    law = {"solref": (-(omega**2), -2 * ZETA * omega), "solimp": (d, d, 0.001, 0.5, 2.0)}
    geom = rbd.Geom(rbd.Sphere(0.1), friction=None, **law)
    return _one(rbd.Body("ball", geom, pos=(0, 0, 1.1)), None, **law)


# --- our runs ---


class Runs:
    """Trajectories of one method; ``bad`` counts worlds with a status bit."""

    def __init__(self, method, smoke):
        self.method, self.smoke, self.bad, self.worlds = method, smoke, 0, 0

    def __call__(self, scene, seconds, make, every=1, dt=None, **leaves):
        """(model, start state, final, traj) of the worlds ``make(state)``."""
        dt = dt or scene.dt
        model, state = rbd.build(scene, dt=dt, method=self.method)
        state = make(state)
        steps = round((0.1 if self.smoke else seconds) / dt / every) * every
        if leaves:
            model = model.replace(**leaves)
        final, traj = jax.block_until_ready(rbd.rollout(model, state, steps, every=every))
        self.bad += int(np.count_nonzero(np.asarray(final.status)))
        self.worlds += int(np.asarray(final.status).size)
        return model, state, final, traj


def apexes(z, v) -> np.ndarray:
    """Heights of the first five apexes of a path (T,), to second order in the sampling step."""
    k = [i for i in range(1, len(z) - 1) if z[i] > z[i - 1] and z[i] >= z[i + 1] and z[i] > 0.01]
    return np.array([z[i] + v[i] ** 2 / (2 * G) for i in k[:5]])


def five(heights):
    return np.concatenate([heights, np.full(5 - len(heights), np.nan)])


def tumbling(state, worlds):
    rng = np.random.default_rng(0)
    pos = np.stack([np.zeros(worlds), np.zeros(worlds), rng.uniform(0.3, 0.8, worlds)], -1)[:, None]
    return common.start(
        state, pos, rng.normal(size=(worlds, 1, 3)), 4 * rng.normal(size=(worlds, 1, 3)),
        common.random_quat(rng, worlds, 1),
    )  # fmt: skip


def lying(state, speeds, height):
    """Boxes on their largest side (the body's x up), ``height`` above the plane, sliding."""
    n, h = len(speeds), np.sqrt(0.5)
    pos = np.zeros((n, 1, 3)) + [0, 0, HALF[0] + height]
    vel = np.asarray(speeds)[:, None, None] * [0.0, 1.0, 0.0]
    return common.start(state, pos, vel, np.zeros((n, 1, 3)), np.zeros((n, 1, 4)) + [h, 0, -h, 0])


def energy_rise(model, traj) -> float:
    """Largest rise in a step over m g d, d the smallest half-size; batched (B, T)."""
    total = np.asarray(sum(rbd.energy(model, traj)), np.float64)
    return float(np.diff(total, axis=-1).max() / (float(np.ravel(model.mass)[0]) * G * min(HALF)))


def contact_response(method, smoke):
    """Every figure of section 4 of one preset, and the poses that MuJoCo's are compared with."""
    run, out, keep = Runs(method, smoke), {}, {}
    parts = [_ball, _spheres] if smoke else [_ball, _box, _stack, _spheres]
    if method != "mujoco":  # which has no restitution coefficient
        parts += [_apexes] if smoke else [_apexes, _bouncing_boxes]
    for part in parts:
        begin = time.perf_counter()
        part(run, out, keep)
        print(f"    {method} {part.__name__[1:]} {time.perf_counter() - begin:.1f} s", flush=True)
    out["bad_worlds"], out["worlds"] = run.bad, run.worlds
    return out, keep


SPEEDS = np.array([3.0, 1.0, 2.0, 4.0])
MANY = 64


def _late(run, traj):
    return np.asarray(traj.time)[0] >= (0.0 if run.smoke else 2.0 - 1e-6)


def _box(run, out, keep):
    make = lambda s: common.joined(
        rbd.batch(s, 1), lying(s, SPEEDS, 0.0), lying(s, [0.0], 0.02), tumbling(s, MANY)
    )  # fmt: skip
    model, state, final, traj = run(box(), 3.0, make)
    v = np.linalg.norm(np.asarray(traj.vel)[:, :, 0], axis=-1)
    out["rest_speed_box"] = v[0, _late(run, traj)].max()
    out["rest_speed_boxes"], out["rest_speed_boxes_95"] = v[6:, -1].max(), np.percentile(v[6:, -1], 95)
    slid = np.asarray(final.pos)[1:5, 0, 1] / (SPEEDS**2 / (2 * MU * G)) - 1
    out["slide_error"], out["slide_error_range"] = abs(slid[0]), np.abs(slid).max()
    out["energy_rise"] = energy_rise(model, jax.tree.map(lambda c: c[6:], traj))
    keep["box"] = rbd.to_mujoco(model, state), np.asarray(final.pos)[:, 0]


def _ball(run, out, keep):
    make = lambda s: common.joined(
        common.start(s, np.array([[[0, 0, 0.5]]]), np.zeros((1, 1, 3))),
        common.start(s, np.zeros((4, 1, 3)) + [0, 0, 0.1], SPEEDS[:, None, None] * [1.0, 0, 0]),
    )
    model, state, final, traj = run(ball(), 3.0, make, every=4)
    v = np.linalg.norm(np.asarray(traj.vel)[:, :, 0], axis=-1)
    out["rest_speed_sphere"] = v[0, _late(run, traj)].max()
    out["roll_error"] = np.abs(np.asarray(final.vel)[1:, 0, 0] / (5 / 7 * SPEEDS) - 1).max()
    keep["ball"] = rbd.to_mujoco(model, state), np.asarray(final.pos)[:, 0]


def _stack(run, out, keep):
    model, state, final, traj = run(stack(), 10.0, lambda s: rbd.batch(s, 1), every=24)
    pos, first = np.asarray(traj.pos)[0], np.asarray(state.pos)[0]
    out["stack_drift"] = np.abs(pos[..., :2]).max()
    out["stack_sag"] = first[-1, 2] - pos[-1, -1, 2]
    out["stack_speed"] = np.abs(np.asarray(final.vel)).max()
    out["stack_tilt"] = common.angle(np.asarray(traj.quat)[0, -1], np.asarray(state.quat)[0]).max()
    seen = rbd.contacts(model, final)
    ground = (np.asarray(seen.body_a) < 0) | (np.asarray(seen.body_b) < 0)
    weight = float(np.asarray(model.mass).sum()) * G
    out["stack_force"] = abs(np.abs(np.asarray(seen.force)[..., 2][ground].sum()) / weight - 1)
    keep["stack"] = rbd.to_mujoco(model, state), pos[-1]


def _spheres(run, out, keep):
    scene = spheres() if run.method != "mujoco" else spheres(None)
    for tag, wide in (("", False), ("_f64", True))[: 1 if run.smoke else 2]:
        with jax.enable_x64(wide):
            model, state, _, traj = run(scene, 1.0, lambda s: rbd.batch(s, 1))
            P, L = (np.asarray(a, np.float64)[0] for a in rbd.momentum(model, traj))
        size = np.linalg.norm(P[0])
        out["linear_momentum" + tag] = np.linalg.norm(P - P[0], axis=-1).max() / size
        out["angular_momentum" + tag] = np.linalg.norm(L - L[0], axis=-1).max() / size / 0.1


def _apexes(run, out, keep):
    _, _, _, traj = run(ball(0.8, None), 4.5, lambda s: rbd.batch(s, 1))
    heights = five(apexes(np.asarray(traj.pos)[0, :, 0, 2] - 0.1, np.asarray(traj.vel)[0, :, 0, 2]))
    keep["apexes"] = heights
    out["apex_error"] = np.abs(heights / 0.8 ** (2 * np.arange(1, 6)) - 1).max()


def _bouncing_boxes(run, out, keep):
    e = np.tile([0.0, 0.25, 0.5, 0.9], MANY // 4)[:, None]
    model, _ = rbd.build(box(0.5), method=run.method)
    leaves = {"restitution": np.repeat(e, model.restitution.shape[-1], axis=-1)}
    model, _, _, traj = run(box(0.5), 2.0, lambda s: tumbling(s, MANY), **leaves)
    out["energy_rise_e"] = energy_rise(model, traj)


# --- MuJoCo at a small step, and the presets beside it ---


def small_step(keep, smoke):
    """MuJoCo's own figures at dt / 10 from the same start states, and end positions."""
    out, ends = {}, {}
    for name, scene, seconds in (("box", box(), 3.0), ("ball", ball(), 3.0), ("stack", stack(), 10.0)):
        if name not in keep:
            continue
        (qpos, qvel), _ = keep[name]
        rival = MuJoCo(scene, DT / FINE)
        steps = round((0.1 if smoke else seconds) / DT) * FINE
        p, v = rival.run(qpos, qvel, steps, every=12 * FINE)
        n = len(scene.bodies)
        pos = p.reshape(*p.shape[:2], n, 7)[..., :3]
        vel = v.reshape(*v.shape[:2], n, 6)[..., :3]
        ends[name] = pos[:, -1] if n > 1 else pos[:, -1, 0]
        speed = np.linalg.norm(vel, axis=-1).max(-1)
        after = speed[:, round(2.0 / (12 * DT)) :] if not smoke else speed
        if name == "box":
            out["rest_speed_box"] = after[0].max()
            out["rest_speed_boxes"], out["rest_speed_boxes_95"] = speed[6:, -1].max(), np.percentile(speed[6:, -1], 95)
            slid = ends[name][1:5, 1] / (SPEEDS**2 / (2 * MU * G)) - 1
            out["slide_error"], out["slide_error_range"] = abs(slid[0]), np.abs(slid).max()
        elif name == "ball":
            out["rest_speed_sphere"] = after[0].max()
            out["roll_error"] = np.abs(vel[1:, -1, 0, 0] / (5 / 7 * SPEEDS) - 1).max()
        else:
            out["stack_drift"] = np.abs(pos[..., :2]).max()
            out["stack_sag"] = pos[0, 0, -1, 2] - pos[0, -1, -1, 2]
            out["stack_speed"] = speed[0, -1]
        rival.close()
    # MuJoCo has no restitution coefficient: the damping ratio that gives 0.8, at two stiffnesses
    heights = {}
    for parts in (FINE, 10 * FINE) if not smoke else (FINE,):
        dt = DT / parts
        scene = soft_ball(dt=dt)
        rival = MuJoCo(scene, dt)
        p, v = rival.run([[0, 0, 1.1, 1, 0, 0, 0]], np.zeros((1, 6)), round((4.5 if not smoke else 0.6) / dt))
        heights[parts] = five(apexes(p[0, :, 2] - 0.1, v[0, :, 2]))
        rival.close()
    finest = heights[max(heights)]
    out["apex_error"] = np.abs(heights[FINE] / 0.8 ** (2 * np.arange(1, 6)) - 1).max()
    return out, ends, finest


def equal_step(smoke):
    """The "mujoco" preset in float64 beside MuJoCo at the same step: list of (what, largest difference, bar)."""
    rows, steps = [], 20 if smoke else 1000

    def compare(what, scene, bar, count=steps):
        with jax.enable_x64(True):
            model, state = rbd.build(scene, method="mujoco")
            q, v = (np.asarray(a)[None] for a in rbd.to_mujoco(model, state))
            _, traj = rbd.rollout(model, state, count)
            ours = [np.asarray(a) for a in rbd.to_mujoco(model, traj)]
        rival = MuJoCo(scene, scene.dt)
        theirs = [a[0] for a in rival.run(q, v, count)]
        rival.close()
        rows.append((what, max(float(np.abs(a - b).max()) for a, b in zip(ours, theirs, strict=True)), bar))

    for integrator in ("euler", "implicitfast", "rk4") if not smoke else ("euler",):
        scene = rbd.Scene(
            bodies=[rbd.Body("box", rbd.Box(HALF), vel=(1, 2, 3), omega=(1.0, -2.0, 3.0), quat=(0.5, 0.1, 0.7, -0.5))],
            dt=0.002,
            integrator=integrator,
        )
        compare(f"free flight, {integrator}, {steps} steps: qpos and qvel", scene, 1e-10)
    bouncing = dataclasses.replace(soft_ball(dt=0.002), dt=0.002, tolerance=0.0)
    compare(f"sphere on a plane, bouncing (e 0.8), {steps} steps", bouncing, 1e-6)
    default = dataclasses.replace(ball(), dt=0.002, tolerance=0.0)
    compare(f"sphere on a plane, default solref and solimp, friction, {steps} steps", default, 1e-6)
    if not smoke:
        two = rbd.Scene(
            bodies=[
                rbd.Body("a", rbd.Sphere(0.1), pos=(0, 0, 0.1)),
                rbd.Body("b", rbd.Sphere(0.15), pos=(0.02, 0.01, 0.8), omega=(0, 1, 0)),
            ],
            static=[rbd.Plane()],
            dt=0.002,
            tolerance=0.0,
        )
        compare(f"sphere dropped on a sphere on a plane, {steps} steps", two, 1e-6)
    return rows


def shipped(names, begin, budget):
    """``parity.validate`` of shipped examples: {name: report or why there is none}."""
    out = {}
    for name in names:
        if time.perf_counter() - begin > budget:
            out[name] = {"skipped": f"time ran out ({budget:g} s)"}
            continue
        t = time.perf_counter()
        try:
            report = parity.validate(rbd.load_mjcf(examples.path(name)))
            out[name] = report.to_dict() | {"seconds": time.perf_counter() - t}
        except Exception as error:  # MuJoCo's FatalError derives from Exception alone
            out[name] = {"skipped": str(error).splitlines()[0]}
        result = out[name].get("ok", out[name].get("skipped"))
        print(f"  {name}: {result}  ({time.perf_counter() - begin:.0f} s)", flush=True)
    return out


# --- the page ---


def bar_of(key, method):
    bar = FIGURES[key][2]
    if isinstance(bar, dict):
        return bar.get(method)
    poses = ("rest_pose", "stack_pose")
    return bar if method in ("fast", "accurate") or (key in poses and method == "mujoco") else None


def misses(data):
    found = [
        f"{k}: {number(v[k])} in {m}, bar {bar_of(k, m):g}"
        for m, v in data["figures"].items()
        if m != "MuJoCo"
        for k in FIGURES
        if k in v and common.verdict(v[k], bar_of(k, m)) == "MISS"
    ]
    found += [f"{w}: {number(v)}, bar {b:g}" for w, v, b in data["equal_step"] if common.verdict(v, b) == "MISS"]
    return found + [f"example {k}: a judged row fails" for k, v in data["examples"].items() if v.get("ok") is False]


def report(data):
    methods = list(data["figures"])

    def cell(key, method):
        value = data["figures"][method].get(key)
        bad = not data["smoke"] and value is not None and common.verdict(value, bar_of(key, method)) == "MISS"
        return f"**{number(value)} MISS**" if bad else number(value)

    def bars(key):
        bar = FIGURES[key][2]
        if isinstance(bar, dict):
            return " / ".join(f"{b:g}" for b in bar.values())
        return "-" if bar is None else f"{bar:g}"

    rows = [[w, u, bars(k), *(cell(k, m) for m in methods)] for k, (w, u, _) in FIGURES.items()]
    heights = [[str(k + 1), number(0.64 ** (k + 1), 5)] for k in range(5)]
    for values in data["apexes"].values():
        for row, h in zip(heights, values, strict=True):
            row.append(number(h, 5))
    equal = [[w, number(v), f"{b:g}", common.verdict(v, b)] for w, v, b in data["equal_step"]]
    parts = []
    for name, r in data["examples"].items():
        if "skipped" in r:
            parts.append([name, "", "not run", r["skipped"], "", ""])
            continue
        for k in r["rows"]:
            ok = "" if k["bound"] is None else "ok" if k["value"] <= k["bound"] else "FAILS"
            bound = "-" if k["bound"] is None else number(k["bound"], 2)
            parts.append([name, k["level"], k["quantity"], f"{number(k['value'])} {k['unit']}".strip(), bound, ok])
    missed = data["misses"]
    verdict = f"{len(missed)} misses" + (": " + "; ".join(missed) if missed else "") + "."
    if data["smoke"]:
        verdict = "Smoke run: much too short, nothing is judged."
    return f"""# Contact response and agreement with MuJoCo

{common.header(data["environment"])}
Made by `benchmarks/physics.py` in {data["seconds"]:.0f} s. Float32, 1/240 s unless said. MuJoCo: itself at a
tenth of the step with its default contact (float64, elliptic cone, Newton); it is shown, not judged. The "mujoco"
preset has MuJoCo's contact, soft and without restitution: judged on poses alone in this table, and at equal step below.

{verdict}

## Figures

{common.table(["what", "unit", "bar", *methods], rows)}

The bars of drift (0.02 m: it stands) and of momentum (rounding) are this script's own; those of poses are 1 mm;
the others are the issue's. MuJoCo's contact is soft: its stack sinks by the figure above, and a rigid one differs
by that. d is the smallest half-size. Apexes of MuJoCo: solref of damping ratio {ZETA},
which bounces with e = 0.8 in the limit of a stiff contact.

## Apex heights [m], e = 0.8 from 1 m

{common.table(["apex", "exact", *data["apexes"]], heights)}

## "mujoco" preset at equal step, float64: largest difference of qpos and qvel

{common.table(["what", "difference", "bar", ""], equal)}

## Shipped examples (`rbd_jax.parity.validate`, float64, one second)

{common.table(["scene", "level", "quantity", "largest difference", "bound", ""], parts)}
"""


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--smoke", action="store_true", help='a few seconds: "fast" alone, 0.1 s each, no examples')
    parser.add_argument("--methods", default=",".join(PRESETS), help=f"default {','.join(PRESETS)}")
    parser.add_argument("--examples", default=",".join(SHOWN), metavar="A,B", help='names, "all" or "none"')
    parser.add_argument("--budget", type=float, default=300.0, help="no further example is begun after so many seconds")
    parser.add_argument("--out", type=pathlib.Path, default=None, metavar="DIR", help="default benchmarks/results")
    args = parser.parse_args(argv)
    begin, out = time.perf_counter(), args.out or common.RESULTS
    env = common.environment()
    print(common.header(env), flush=True)
    methods = ["fast"] if args.smoke else args.methods.split(",")
    names = {"all": examples.names(), "none": ()}.get(args.examples, [s for s in args.examples.split(",") if s])
    budget = args.budget if args.examples != "all" else float("inf")
    figures, kept = {}, {}
    for method in methods:
        figures[method], kept[method] = contact_response(method, args.smoke)
        print(f"  {method}  ({time.perf_counter() - begin:.0f} s)", flush=True)
    # a tenth of the step, from the start states of the first method (they are equal)
    figures["MuJoCo"], ends, finest = small_step(kept[methods[0]], args.smoke)
    for method in methods if not args.smoke else ():
        figures[method]["rest_pose"] = np.abs(kept[method]["box"][1][5] - ends["box"][5]).max()
        figures[method]["stack_pose"] = np.abs(kept[method]["stack"][1] - ends["stack"][0]).max()
    apex = {m: kept[m]["apexes"] for m in methods if "apexes" in kept[m]} | {"MuJoCo, stiff": finest}
    data = {
        "environment": env,
        "smoke": args.smoke,
        "dt": DT,
        "figures": figures,
        "apexes": apex,
        "equal_step": equal_step(args.smoke),
        "examples": {} if args.smoke else shipped(names, begin, budget),
    }
    data["misses"] = misses(common.plain(data)) if not args.smoke else []
    data["seconds"] = time.perf_counter() - begin
    data = common.plain(data)
    common.write_json(out / "physics.json", data)
    (out / "physics.md").write_text(report(data), encoding="utf-8")
    print(*(f"MISS {m}" for m in data["misses"]), sep="\n")
    print(f"wrote {out / 'physics.json'}, {out / 'physics.md'}  ({data['seconds']:.0f} s)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
