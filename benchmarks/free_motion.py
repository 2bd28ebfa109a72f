"""Accuracy, invariants and cost of every integrator in free motion.

    PYTHONPATH=. python benchmarks/free_motion.py          (about 3 minutes on 2 cores)

Writes benchmarks/results/free_motion.json and free_motion.md.
"""

from __future__ import annotations

import json
import os
import pathlib
import platform
import time

if hasattr(os, "sched_setaffinity"):  # one core, so that CPU time is the cost of a body-step
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from rbd_jax.bodies import Bodies, Inertia  # noqa: E402
from rbd_jax.integrators import INTEGRATORS, make  # noqa: E402
from rbd_jax.integrators.euler_top import EulerTop  # noqa: E402
from rbd_jax.spatial import Quat, Vec3, pack  # noqa: E402

RESULTS = pathlib.Path(__file__).parent / "results"
BOX = np.array([0.13, 0.10, 0.05]) / 3.0  # half-sizes .1 .2 .3 m, 1 kg
SPIN = np.array([1.0, 2.0, 3.0])
GYRO = np.array([20.0, 0.05, 0.05])
RATE = np.linalg.norm(SPIN)
GRAVITY = -9.81
MUJOCO = {"mujoco_euler": "Euler", "mujoco_implicitfast": "implicitfast", "mujoco_rk4": "RK4"}
EULER = ("forward_euler", "semi_implicit_euler", "backward_euler")
CASES = [(name, {}) for name in INTEGRATORS] + [
    (name, {"attitude": "matrix", "orthonormalise": how}) for name in EULER for how in (None, "gram_schmidt", "polar")
]


def label(name, options):
    return name if not options else f"{name} R {options['orthonormalise'] or 'raw'}"


def body(omega, dtype=np.float64, v=(0.0, 0.0, 0.0), moments=BOX, q=(1.0, 0.0, 0.0, 0.0)):
    """One body of the given principal-frame angular velocity."""
    leaf = lambda a: Vec3(*(jnp.full((1, 1), c, dtype) for c in a))
    q = Quat(*(jnp.full((1, 1), c, dtype) for c in q))
    b = Bodies(leaf((0, 0, 0)), leaf(v), q, q.rotate(leaf(moments * omega)))
    return b, Inertia(leaf(moments))


def energy(b, inertia):
    return 0.5 * b.L.dot(inertia.velocity(b.q, b.L))


def runner(integrator):
    """f(bodies, inertia, h, steps) -> end, largest |dE/E|, |dL/L| and RtR - 1 on the way."""

    @jax.jit
    def run(b, inertia, h, steps):
        e0, L0 = energy(b, inertia), b.L
        size = jnp.sqrt(L0.dot(L0))

        def step(_, carry):
            c, worst_e, worst_l = carry
            c = integrator.advance(c, lambda _: (Vec3(0.0, 0.0, GRAVITY), None), inertia, h)
            d = c.L - L0
            return (
                c,
                jnp.maximum(worst_e, abs(energy(c, inertia) / e0 - 1)),
                jnp.maximum(worst_l, jnp.sqrt(d.dot(d)) / size),
            )

        return jax.lax.fori_loop(0, steps, step, (b, 0 * e0, 0 * e0))

    def start(b, *args):
        if integrator.carries_matrix:
            b = b._with(R=b.q.mat())
        return run(b, *args)

    return start


def scalar(a):
    return float(np.asarray(a).reshape(()))


def matrix(m):
    return np.stack([pack(r)[0, 0] for r in (m.a, m.b, m.c)])


def angle(q, exact):
    if not np.isfinite(scalar(q.w)):
        return np.nan
    return 2 * np.arcsin(min(1.0, np.linalg.norm(matrix(q.mat()) - exact) / np.sqrt(8)))


def accuracy(integrator, name):
    """Every figure in float64 (float32 where said) of one integrator."""
    run, top, out = runner(integrator), EulerTop(BOX, SPIN), {}
    b, inertia = body(SPIN)
    steps, duration = {1: (4000, 1.0), 2: (200, 2.0), 4: (30, 2.0)}[integrator.order]
    e = [angle(run(b, inertia, duration / n, n)[0].q, top.matrix(duration)) for n in (steps, 2 * steps)]
    out["order"] = np.log2(e[0] / e[1])

    h = 0.1 / RATE
    end, worst_e, worst_l = run(b, inertia, h, 240)
    out["attitude_24rad"] = angle(end.q, top.matrix(240 * h))
    out["energy_24rad"], out["L_24rad"] = scalar(worst_e), scalar(worst_l)

    ten = int(10 * top.period / h)
    end, first, _ = run(b, inertia, h, ten)
    end, _, _ = run(b, inertia, h, 99 * ten)
    e0 = scalar(energy(b, inertia))
    last = run(end, inertia, h, ten)[0]
    drift = [abs(scalar(energy(c, inertia)) / e0 - 1) for c in (end, last)]
    out["energy_first_10_periods"] = scalar(first)
    out["energy_at_1000_periods"] = max(drift)

    b, inertia = body(GYRO)
    _, worst_e, worst_l = run(b, inertia, 5e-3, 20000)
    out["gyro_energy_100s"], out["gyro_L_100s"] = scalar(worst_e), scalar(worst_l)

    b, inertia = body(SPIN, v=(1.0, 0.0, 5.0))
    n, h = 100, 0.01
    end, t = run(b, inertia, h, n)[0], 1.0
    error = scalar(end.x.z) - (5.0 * t + 0.5 * GRAVITY * t * t)
    out["parabola_error_m"] = error
    out["parabola_error_over_ght_2"] = error / (-GRAVITY * h * t / 2)

    b, inertia = body(SPIN, np.float32)
    end = run(b, inertia, jnp.float32(0.002), 1_000_000)[0]
    out["f32_norm_error_1e6_steps"] = abs(np.linalg.norm(np.float64(pack(end.q)[0, 0])) - 1)
    if integrator.carries_matrix:
        b, inertia = body(SPIN)
        for steps in (1, 10, 100, 1000, 10000):
            R = matrix(run(b, inertia, 0.01, steps)[0].R)
            out[f"RtR_error_{steps}_steps"] = np.abs(R.T @ R - np.eye(3)).max()
    if name in MUJOCO:
        out["mujoco_1000_steps"] = mujoco_difference(run, name)
    return {k: float(v) for k, v in out.items()}


def mujoco_difference(run, name):
    """Largest difference of qpos, qvel to MuJoCo over five random bodies, 1,000 steps of 2 ms."""
    import mujoco

    rng, worst = np.random.default_rng(0), 0.0
    for _ in range(5):
        sides = rng.uniform(0.1, 0.5, 3)
        moments = (np.sum(sides**2) - sides**2) / 3
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep="0.002" integrator="{MUJOCO[name]}" gravity="0 0 {GRAVITY}"/>
            <worldbody><body><freejoint/><inertial pos="0 0 0" mass="1"
            diaginertia="{" ".join(repr(float(i)) for i in moments)}"/></body></worldbody></mujoco>"""
        )
        data = mujoco.MjData(model)
        q, v, w = rng.normal(size=4), rng.normal(size=3), 3 * rng.normal(size=3)
        q /= np.linalg.norm(q)
        data.qpos[3:], data.qvel[:3], data.qvel[3:] = q, v, w
        b, inertia = body(w, v=v, moments=np.array(model.body_inertia[1]), q=q)
        end = run(b, inertia, 0.002, 1000)[0]
        for _ in range(1000):
            mujoco.mj_step(model, data)
        ours = np.array(pack(end.q))[0, 0]
        ours *= np.sign(ours @ data.qpos[3:])
        omega = end.q.rotate_inv(end.L) / inertia.moments
        qpos = np.concatenate([pack(end.x)[0, 0], ours])
        qvel = np.concatenate([pack(end.v)[0, 0], pack(omega)[0, 0]])
        worst = max(worst, np.abs(qpos - data.qpos).max(), np.abs(qvel - data.qvel).max())
    return worst


def cost(integrator, dtype, isotropic=False, batch=4096, steps=1000):
    """CPU ns per body-step of a scan (best of 5), its kernels, and seconds to compile."""
    rng = np.random.default_rng(0)
    leaf = lambda s=1.0: jnp.asarray(s * rng.normal(size=(1, batch)), dtype)
    vec = lambda s=1.0: Vec3(leaf(s), leaf(s), leaf(s))
    q = Quat(leaf(), leaf(), leaf(), leaf()).normalised()
    b = Bodies(vec(), vec(), q, vec(0.05), q.mat() if integrator.carries_matrix else None)
    full = lambda c: jnp.full((1, 1), c, dtype)
    inertia = Inertia(full(0.1) if isotropic else Vec3(*map(full, BOX)))

    @jax.jit
    def go(b, inertia, g, h):
        step = lambda c, _: (
            integrator.advance(c, lambda _: (Vec3(0.0, 0.0, g), None), inertia, h),
            None,
        )
        return jax.lax.scan(step, b, None, length=steps)[0]

    args = (b, inertia, full(GRAVITY), jnp.asarray(0.004, dtype))
    begin = time.perf_counter()
    compiled = go.lower(*args).compile()
    compile_s = time.perf_counter() - begin
    jax.block_until_ready(compiled(*args))
    times = []
    for _ in range(5):
        begin = time.process_time()
        jax.block_until_ready(compiled(*args))
        times.append(time.process_time() - begin)
    return {
        "ns": min(times) / steps / batch * 1e9,
        "fusions": compiled.as_text().count(" fusion("),
        "compile_s": compile_s,
    }


def number(x):
    return "-" if x is None else "inf" if not np.isfinite(x) else f"{x:.2g}"


def table(rows, columns):
    lines = ["| method | " + " | ".join(columns.values()) + " |", "|---" * (len(columns) + 1) + "|"]
    for row in rows:
        lines.append(f"| {row['method']} | " + " | ".join(number(row.get(c)) for c in columns) + " |")
    return "\n".join(lines)


def report(data):
    rows = data["methods"]
    text = f"""# Free motion

{data["device"]}, jax {data["jax"]}, MuJoCo {data["mujoco"]}; {data["date"]}. Box of half-sizes .1 .2 .3 m, 1 kg;
float64 unless said; made by `benchmarks/free_motion.py`.

## Accuracy

Order measured on the attitude. A3(a): w = (1, 2, 3) rad/s, h|w| = 0.1, 24 rad; attitude error against the
closed form [rad], then the largest relative errors of energy and world L. Energy over 1,000 periods: largest in the
first ten, then at the end. Gyro: w = (20, .05, .05) rad/s, 5 ms, 100 s. Parabola: error of the height after 1 s at
10 ms, over g h t/2. "inf": diverged.

{
        table(
            rows,
            {
                "order": "order",
                "attitude_24rad": "attitude 24 rad",
                "energy_24rad": "dE/E",
                "L_24rad": "dL/L",
                "energy_first_10_periods": "dE/E 10 periods",
                "energy_at_1000_periods": "dE/E at 1,000 periods",
                "gyro_energy_100s": "gyro dE/E",
                "gyro_L_100s": "gyro dL/L",
                "parabola_error_over_ght_2": "parabola / (g h t/2)",
                "f32_norm_error_1e6_steps": "q norm - 1, f32, 1e6 steps",
                "mujoco_1000_steps": "against MuJoCo, 1,000 steps",
            },
        )
    }

## RtR - 1 (largest element) of the carried matrix, h = 10 ms

{
        table(
            [r for r in rows if " R " in r["method"]],
            {f"RtR_error_{n}_steps": f"{n} steps" for n in (1, 10, 100, 1000, 10000)},
        )
    }

## Cost

CPU time [ns] per body-step on one core, batch 4,096 in a scan of 1,000 steps, under gravity; asymmetric box and
isotropic body. Load average at the end {data["load_average_1min"]:.1f}.

{
        table(
            rows,
            {
                "f32_ns": "f32",
                "f64_ns": "f64",
                "f32_isotropic_ns": "f32 isotropic",
                "f32_fusions": "kernels (f32)",
                "f32_compile_s": "compile [s]",
            },
        )
    }
"""
    return text


def main():
    import mujoco

    begin, rows = time.perf_counter(), []
    for name, options in CASES:
        integrator = make(name, **options)
        row = {"method": label(name, options)} | accuracy(integrator, name)
        for tag, dtype, isotropic in (
            ("f32", np.float32, False),
            ("f64", np.float64, False),
            ("f32_isotropic", np.float32, True),
        ):
            if options and tag != "f32":
                continue
            row |= {f"{tag}_{k}": v for k, v in cost(integrator, dtype, isotropic).items()}
        rows.append(row)
        print(
            f"{row['method']:36s} attitude {number(row['attitude_24rad']):8s} {row['f32_ns']:6.1f} ns"
            f"  ({time.perf_counter() - begin:.0f} s)",
            flush=True,
        )
    data = {
        "date": time.strftime("%Y-%m-%d"),
        "device": f"{jax.devices()[0].device_kind}, {platform.machine()}, {os.cpu_count()} cores",
        "load_average_1min": os.getloadavg()[0],
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "methods": rows,
    }
    finite = lambda v: None if isinstance(v, float) and not np.isfinite(v) else v
    data["methods"] = [{k: finite(v) for k, v in r.items()} for r in rows]
    (RESULTS / "free_motion.json").write_text(json.dumps(data, indent=1) + "\n")
    (RESULTS / "free_motion.md").write_text(report(data | {"methods": rows}))


if __name__ == "__main__":
    main()
