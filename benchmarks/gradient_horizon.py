"""How the error of a derivative grows with the horizon: a bouncing ball, a box that slides to rest, a tumbling box.

    PYTHONPATH=. python benchmarks/gradient_horizon.py            (two minutes on 2 cores)
    PYTHONPATH=. python benchmarks/gradient_horizon.py --smoke --out /tmp/x

d y(T) / d x for all horizons T of one rollout (forward mode, which gives what reverse mode gives; steps of 1/240 s):

* bounce: height over the height of the start, e = 0.8, up to six bounces; truth: the closed form between exact impacts;
* slide: place over the speed at the start, friction 0.5, comes to rest after 0.6 s; truth: Coulomb's closed form;
* tumble: a direction of the body over the spin at the start, free flight; truth: Euler's equations by DOP853 at 1e-13,
  differentiated by central differences whose two widths agree to 1e-8.

MuJoCo stands beside where it can express the scene: central differences of its own rollout, which is what its users
have (Euler and RK4, default contact). Writes gradient_horizon.json, .md and .png under ``--out`` (benchmarks/results).
"""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
from common import MuJoCo, number  # noqa: E402

import rbd_jax as rbd  # noqa: E402

DT, EVERY, SAMPLES = 1 / 240, 24, 30
RADIUS, E, MU, SPEED = 0.1, 0.8, 0.5, 3.0
HALF, SPIN, MASS = (0.1, 0.2, 0.3), np.array([2.0, 4.0, 6.0]), 1.0
METHODS = {
    "gradient, float64": ("gradient", True),
    "gradient, float32": ("gradient", False),
    "accurate, float64": ("accurate", True),
    "fast, float32": ("fast", False),
}
#: A derivative that is wrong by more than this is no guide.
WRONG = 0.1


@dataclasses.dataclass(frozen=True)
class Case:
    """What is differentiated.

    Attributes:
      x: the parameter's value; start(state, x): the start state with it. seen(traj): what is seen of samples, (T,).
      truth(t): the derivative (T,).
      mujoco(qpos, qvel, x): sets the parameter there; read(qpos): what is seen. None: MuJoCo cannot be asked.
    """

    what: str
    scene: Callable
    x: float
    start: Callable
    seen: Callable
    truth: Callable
    mujoco: Callable | None = None
    read: Callable | None = None


# --- a ball that bounces ---


def bounced(t: np.ndarray) -> np.ndarray:
    """d z(t) / d z(0): every piece is z = v s - g s^2 / 2 from an impact on; its instant and speed are followed."""
    h, g = 1.0, common.G
    fall, slope = np.sqrt(2 * h / g), 1 / np.sqrt(2 * h * g)  # of the first impact and its derivative
    out = []
    for now in t:
        if now < fall:
            out.append(1.0)
            continue
        at, d_at, speed, d_speed = fall, slope, E * g * fall, E * g * slope
        while now >= at + 2 * speed / g:
            at, d_at = at + 2 * speed / g, d_at + 2 * d_speed / g
            speed, d_speed = E * speed, E * d_speed
        s = now - at
        out.append(d_speed * s - (speed - g * s) * d_at)
    return np.array(out)


def ball() -> rbd.Scene:
    body = rbd.Body("ball", rbd.Sphere(RADIUS), pos=(0, 0, 1 + RADIUS), mass=MASS, restitution=E)
    return rbd.Scene([body], [rbd.Plane()], dt=DT)


# --- a box that slides to rest ---


def slid(t: np.ndarray) -> np.ndarray:
    """d x(t) / d v(0): t while it slides, then the time that it slid."""
    return np.minimum(t, SPEED / (MU * common.G))


def box() -> rbd.Scene:
    body = rbd.Body("box", rbd.Box((0.2, 0.15, 0.1)), pos=(0, 0, 0.1), vel=(SPEED, 0, 0), mass=MASS, friction=MU)
    return rbd.Scene([body], [rbd.Geom(rbd.Plane(), friction=MU)], dt=DT)


# --- a box that tumbles ---


def tumbling(spin, t: np.ndarray) -> np.ndarray:
    """x of the body's third axis; Euler's equations in the body frame."""
    from scipy.integrate import solve_ivp

    a, b, c = HALF
    inertia = MASS / 3 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])

    def rate(_, y):
        q, w = y[:4], y[4:]
        dq = 0.5 * np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))])
        return np.concatenate([dq, -np.cross(w, inertia * w) / inertia])

    y = solve_ivp(rate, (0, t[-1]), [1, 0, 0, 0, *spin], "DOP853", t, rtol=1e-13, atol=1e-13).y
    return 2 * (y[1] * y[3] + y[0] * y[2])


def tumbled(t: np.ndarray) -> np.ndarray:
    """d of that / d of the spin about x at the start."""

    def slope(width):
        up, down = (tumbling(SPIN + [d, 0, 0], t) for d in (width, -width))
        return (up - down) / (2 * width)

    wide, narrow = slope(2e-4), slope(1e-4)
    assert np.abs(wide - narrow).max() < 4e-6, "the truth's own differences do not agree"
    return narrow + (narrow - wide) / 3  # Richardson: the next term of the difference


def free_box() -> rbd.Scene:
    body = rbd.Body("box", rbd.Box(HALF), pos=(0, 0, 0), omega=tuple(SPIN), mass=MASS)
    return rbd.Scene([body], [], gravity=None, dt=DT)


def _third_axis(q):
    return 2 * (q[..., 1] * q[..., 3] + q[..., 0] * q[..., 2])


def _put(column: int, of: str) -> Callable:
    def put(qpos, qvel, x):
        (qpos if of == "qpos" else qvel)[:, column] = x

    return put


CASES = {
    "bounce": Case(
        "height of a bouncing ball, e = 0.8, over its height at the start", ball, 1 + RADIUS,
        lambda s, x: s.replace(pos=s.pos.at[0, 2].set(x)), lambda t: t.pos[:, 0, 2], bounced,
    ),
    "slide": Case(
        "place of a box that slides to rest, over its speed at the start", box, SPEED,
        lambda s, x: s.replace(vel=s.vel.at[0, 0].set(x)), lambda t: t.pos[:, 0, 0], slid,
        _put(0, "qvel"), lambda qpos: qpos[..., 0],
    ),
    "tumble": Case(
        "a direction of a tumbling box, over its spin at the start", free_box, SPIN[0],
        lambda s, x: s.replace(omega=s.omega.at[0, 0].set(x)), lambda t: _third_axis(t.quat[:, 0]), tumbled,
        _put(3, "qvel"), lambda qpos: _third_axis(qpos[..., 3:7]),
    ),
}  # fmt: skip


def ours(case: Case, method: str, wide: bool, samples: int) -> np.ndarray:
    """(T,) derivative at every sample but the first."""
    with jax.enable_x64(wide):
        model, state = rbd.build(case.scene(), method=method)
        run = lambda x: case.seen(rbd.rollout(model, case.start(state, x), EVERY * samples, every=EVERY)[1])
        x = jnp.asarray(case.x, state.pos.dtype)
        return np.asarray(jax.jit(lambda x: jax.jvp(run, (x,), (jnp.ones_like(x),))[1])(x), float)[1:]


def mujoco(case: Case, integrator: str, samples: int, width: float = 1e-4) -> np.ndarray:
    import mujoco as mj

    engine = MuJoCo(case.scene(), DT, threads=1)
    engine.model.opt.integrator = {"Euler": mj.mjtIntegrator.mjINT_EULER, "RK4": mj.mjtIntegrator.mjINT_RK4}[integrator]
    _, data = common.compile_mujoco(case.scene())
    qpos, qvel = np.repeat(data.qpos[None], 2, axis=0), np.repeat(data.qvel[None], 2, axis=0)
    case.mujoco(qpos, qvel, np.array([case.x - width, case.x + width]))
    steps = EVERY * samples
    states = engine.call(engine.initial(qpos, qvel), steps, engine.allocate(2, steps))
    low, high = case.read(states[:, EVERY - 1 :: EVERY, 1 : 1 + engine.model.nq])
    return (high - low) / (2 * width)


def measure(samples: int, say=print) -> list[dict]:
    rows = []
    for name, case in CASES.items():
        t = DT * EVERY * np.arange(1, samples + 1)
        truth = case.truth(t)
        scale = np.maximum.accumulate(np.abs(truth))

        def row(method, seen, case=case, name=name, t=t, truth=truth, scale=scale):
            error = np.abs(seen - truth) / scale
            wrong = np.flatnonzero(~(error <= WRONG))
            first = float(t[wrong[0]]) if len(wrong) else None
            rows.append({"case": name, "what": case.what, "method": method, "horizon": t, "truth": truth,
                         "derivative": seen, "error": error, "wrong_from_s": first})  # fmt: skip
            say(
                f"{name} {method}: {number(error[0])} at {t[0]:.1f} s, {number(error[-1])} at {t[-1]:.1f} s", flush=True
            )

        for label, (method, wide) in METHODS.items():
            row(label, ours(case, method, wide, samples))
        if case.mujoco is not None:
            for integrator in ("Euler", "RK4"):
                row(f"MuJoCo {integrator}, differences", mujoco(case, integrator, samples))
    return rows


def page(rows: list[dict], env: dict) -> str:
    lines = []
    for r in rows:
        at = lambda s, r=r: number(r["error"][int(np.argmin(np.abs(r["horizon"] - s)))])
        wrong = "-" if r["wrong_from_s"] is None else f"{r['wrong_from_s']:.1f} s"
        end = float(r["horizon"][-1])
        lines.append([r["case"], r["method"], at(0.1), at(1.0), at(end), number(float(np.median(r["error"]))), wrong])
    heads = [
        "case",
        "method",
        "error at 0.1 s",
        "at 1 s",
        f"at {end:.0f} s",
        "median",
        f"wrong by more than {WRONG:g} from",
    ]
    return "\n".join([
        "# Error of a derivative against its horizon", "", common.header(env),
        "Made by `benchmarks/gradient_horizon.py`; scenes and truths in its head. Steps of 1/240 s. Errors are over "
        "the largest derivative up to the horizon.", "",
        *(f"* {name}: {case.what}." for name, case in CASES.items()), "",
        common.table(heads, lines), "", "![errors against horizon](gradient_horizon.png)", "",
    ])  # fmt: skip


STYLES = {
    "gradient, float64": ("#0072B2", "o", "-"), "gradient, float32": ("#56B4E9", "s", "-"),
    "accurate, float64": ("#009E73", "^", "--"), "fast, float32": ("#E69F00", "v", "--"),
    "MuJoCo Euler, differences": ("#D55E00", "D", ":"), "MuJoCo RK4, differences": ("#D55E00", "x", "-."),
}  # fmt: skip


def draw(rows: list[dict], path: pathlib.Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(9.5, 3.9), layout="constrained", dpi=150, sharey=True)
    for ax, name in zip(axes, CASES):
        for r in rows:
            if r["case"] == name:
                colour, marker, line = STYLES[r["method"]]
                ax.semilogy(r["horizon"], np.maximum(r["error"], 1e-15), line, marker=marker, color=colour,
                            markersize=3.5, linewidth=1.2, label=r["method"])  # fmt: skip
        ax.set_title(name, fontsize=10)
        ax.set_xlabel("horizon [s]", fontsize=9)
        ax.grid(True, which="major", color="0.9", linewidth=0.6)
        ax.tick_params(labelsize=8)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("relative error of the derivative", fontsize=9)
    handles, labels = axes[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.savefig(path)
    plt.close(figure)


def main(argv=None) -> int:
    args = common.options(__doc__, "three horizons").parse_args(argv)
    out = args.out or common.RESULTS
    env = common.environment()
    rows = measure(3 if args.smoke else SAMPLES)
    common.write_json(out / "gradient_horizon.json", {"environment": env, "rows": rows})
    (out / "gradient_horizon.md").write_text(page(rows, env))
    try:
        draw(rows, out / "gradient_horizon.png")
    except ImportError:
        print("no chart: matplotlib is not installed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
