"""Three uses of gradients: hit a target, find the parameters of a scene, stop a box on a mark.

    PYTHONPATH=. python benchmarks/gradient_uses.py            (about 3 minutes on 2 cores)
    PYTHONPATH=. python benchmarks/gradient_uses.py --uses aim --out /tmp/x
    PYTHONPATH=. python benchmarks/gradient_uses.py --quick --out /tmp/x

Each use is one function to copy: it builds a scene and returns a loss. ``descend`` minimises it with
``jax.value_and_grad`` and optax, ``search`` with Nelder and Mead's simplex, which sees values only. Writes
gradient_uses.json, .md and .png under ``--out`` (benchmarks/results). Float32 is enough for all three.
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.optimize

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
from common import number  # noqa: E402

import rbd_jax as rbd  # noqa: E402

DT = 1 / 240
#: Impacts at their own instant: without them the derivative of a bounce is that of the time step, which is wrong.
METHOD = rbd.PRESETS["gradient"]
if not METHOD.events:
    METHOD = dataclasses.replace(METHOD, events=2)
#: A box that slides has no impacts; without events its program is a third as long, its gradient several times faster.
SLIDING = dataclasses.replace(METHOD, events=0)


@dataclasses.dataclass(frozen=True)
class Use:
    """What there is to minimise.

    Attributes:
      what: one line for the page.
      parameters: what ``x`` means.
      loss: x -> scalar, differentiable.
      start: first guess of x, of order one in every entry.
      goal: the loss at which a search ends.
      error: (x, loss at x) -> what is judged, in ``unit``; ``tolerance``: its bar.
      read: x -> the same in SI units, by name.
      truth: what ``read`` should give, where that is known.
    """

    what: str
    parameters: str
    loss: Callable
    start: np.ndarray
    goal: float
    error: Callable
    tolerance: float
    unit: str
    read: Callable
    truth: dict | None = None


# --- 1: hit a target ---


def aim(dt: float = DT) -> Use:
    """Launch velocity with which a ball that bounces off the floor and the wall is at the target after 1.2 s.

    The loss has one valley for every number of bounces. A descent stays in the one it begins in: begin with a launch
    that hits what it should.
    """
    seconds, target = 1.2, jnp.array([2.5, 1.0, 0.6])
    ball = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 1), friction=None, restitution=0.8)
    half = np.sqrt(0.5)
    wall = rbd.Geom(rbd.Plane(), pos=(4, 0, 0), quat=(half, 0, -half, 0), friction=None, name="wall")  # faces -x
    floor = rbd.Geom(rbd.Plane(), friction=None, name="floor")
    model, state = rbd.build(rbd.Scene([ball], [floor, wall], dt=dt), method=METHOD)
    steps = round(seconds / dt)

    def loss(velocity):
        final, _ = rbd.rollout(model, state.replace(vel=velocity[None]), steps, every=steps)
        return jnp.sum((final.pos[0] - target) ** 2)

    return Use(
        what="a ball bounces off the floor and a wall and is at the target after 1.2 s",
        parameters="launch velocity (3)",
        loss=loss,
        start=np.array([6.2, -1.0, 3.0]),
        goal=1e-3**2,
        error=lambda x, loss: float(np.sqrt(loss)),
        tolerance=1e-3,
        unit="m",
        read=lambda x: dict(zip(("vx [m/s]", "vy [m/s]", "vz [m/s]"), map(float, x))),
    )


# --- 2: find parameters ---


def identify(dt: float = DT, noise: float = 0.0, seed: int = 0) -> Use:
    """Mass, friction and restitution of a ball from its way when it is thrown with spin and a known force pushes it.

    Heights give restitution, the kick that spin gives at a bounce gives friction, the force gives mass. Four worlds
    with different spins and forces. The first guess of friction is low: with too much of it the ball grips at every
    bounce, more would change nothing, and the derivative is rightly zero.

    Args:
      dt: step [s].
      noise: standard deviation of the observed positions [m].
      seed: of the noise.
    """
    seconds, every = 1.2, 4
    ball = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 1), vel=(1, 0, 0), omega=(0, 0, 0), mass=1.0, friction=0.5,
                    restitution=0.5)  # fmt: skip
    scene = rbd.Scene([ball], [rbd.Geom(rbd.Plane(), friction=0.0, restitution=0.0)], dt=dt)
    model, state = rbd.build(scene, method=METHOD)
    spin = np.array([[0, -80, 0], [60, 60, 0], [-80, 0, 0], [0, 80, 0]], np.float32)  # [rad/s]
    force = np.array([[0, 2, 0], [1, 0, 0], [2, 0, 0], [-1, -1, 0]], np.float32)  # [N]
    states = rbd.batch(state, len(spin)).replace(omega=spin[:, None])
    push = rbd.Wrench(force=force[:, None])

    def numbers(x):
        """Positive, positive, between 0 and 1, whatever x is."""
        return jnp.exp(x[0]), jnp.exp(x[1]), jax.nn.sigmoid(x[2])

    def watch(x):
        """Positions (worlds, samples, bodies, 3)."""
        mass, friction, restitution = numbers(x)
        changed = model.replace(
            mass=mass[None],
            inertia=model.inertia * (mass / model.mass),  # leaves are independent: the inertia grows with the mass
            friction=jnp.stack([friction, 0.0]),  # of ball and floor; a pair has the larger one
            restitution=jnp.stack([restitution, 0.0]),
        )
        return rbd.rollout(changed, states, round(seconds / dt), every, control=push)[1].pos

    truth = np.array([2.3, 0.15, 0.72])
    hidden = jnp.array([np.log(truth[0]), np.log(truth[1]), np.log(truth[2] / (1 - truth[2]))], model.mass.dtype)
    seen = np.asarray(jax.jit(watch)(hidden))
    seen = seen + (noise * np.random.default_rng(seed).normal(size=seen.shape)).astype(seen.dtype)

    def loss(x):
        return jnp.mean((watch(x) - seen) ** 2)

    def errors(x):
        return np.abs(np.array(numbers(x)) / truth - 1)

    names = ("mass [kg]", "friction [-]", "restitution [-]")
    return Use(
        what="mass, friction and restitution of a ball from four throws with spin, pushed by a known force",
        parameters="mass, friction, restitution (3)",
        loss=loss,
        start=np.array([np.log(1.0), np.log(0.05), 0.0]),
        goal=0.0 if noise else 1e-5**2,
        error=lambda x, loss: float(errors(x).max()),
        tolerance=2e-2 if noise else 1e-3,
        unit="relative",
        read=lambda x: dict(zip(names, map(float, numbers(x)))),
        truth=dict(zip(names, truth)),
    )


# --- 3: stop on a mark ---


def stop(dt: float = DT) -> Use:
    """Force and torque of a push of 0.4 s after which a box slides and stops on the middle of a line, square to it."""
    seconds, push, line, size = 1.6, 0.4, 2.0, (0.2, 0.15, 0.1)
    unit = jnp.array([10.0, 10.0, 1.0])  # [N, N, N m]
    turned = (np.cos(0.3), 0, 0, np.sin(0.3))  # 0.6 rad
    box = rbd.Body("box", rbd.Box(size), pos=(0, 0.3, size[2]), quat=turned, mass=2.0, friction=0.4)
    scene = rbd.Scene([box], [rbd.Geom(rbd.Plane(), friction=0.4)], dt=dt)
    model, state = rbd.build(scene, method=SLIDING)
    steps = round(seconds / dt)

    def end(x):
        fx, fy, turn = x * unit

        def control(model, state):
            on = jnp.where(state.time < push - dt / 2, 1.0, 0.0)
            return rbd.Wrench(force=on * jnp.array([[fx, fy, 0.0]]), torque=on * jnp.array([[0.0, 0.0, turn]]))

        return rbd.rollout(model, state, steps, every=steps, control=control)[0]

    def loss(x):
        final = end(x)
        w, _, _, z = final.quat[0]
        return (final.pos[0, 0] - line) ** 2 + final.pos[0, 1] ** 2 + (size[0] * 2 * w * z) ** 2  # sin(yaw) = 2 w z

    return Use(
        what="push a box for 0.4 s so that it slides and stops on the middle of a line, square to it",
        parameters="force x, y, torque (3)",
        loss=loss,
        start=np.array([1.5, 0.0, 0.0]),
        goal=1e-3**2,
        error=lambda x, loss: float(np.sqrt(loss)),
        tolerance=1e-3,
        unit="m",
        read=lambda x: dict(zip(("force x [N]", "force y [N]", "torque [N m]"), map(float, x * unit))),
    )


USES = {"aim": aim, "identify": identify, "stop": stop}


# --- the two ways ---


class Counted:
    """A compiled function of x, float32 unless ``jax_enable_x64``, that counts its calls.

    Attributes: compile_s; losses: of every call; seconds: in the calls.
    """

    def __init__(self, function, x):
        begin = time.perf_counter()
        self._call = jax.jit(function).lower(jnp.asarray(x, float)).compile()
        self.compile_s = time.perf_counter() - begin
        jax.block_until_ready(self._call(jnp.asarray(x, float)))
        self.losses, self.seconds = [], 0.0

    def __call__(self, x):
        begin = time.perf_counter()
        out = jax.block_until_ready(self._call(jnp.asarray(x, float)))
        self.seconds += time.perf_counter() - begin
        self.losses.append(float(out[0] if isinstance(out, tuple) else out))
        return out


def descend(evaluate, x, goal: float, limit: int = 200):
    """Minimise with optax's L-BFGS; a step that does not lower the loss is halved.

    Args:
      evaluate: x -> (loss, gradient).
      x: start.
      goal: end at this loss; it also ends where no step helps.
      limit: evaluations at most.

    Returns:
      The best x and its loss.
    """
    optimizer = optax.lbfgs(linesearch=None)
    update = jax.jit(optimizer.update)
    x = jnp.asarray(x, float)
    state = optimizer.init(x)
    value, grad = evaluate(x)
    count, stuck = 1, False
    while value > goal and count < limit and not stuck:
        step, state = update(grad, state, x)
        if not jnp.vdot(step, grad) < 0:  # the curvature seen so far is of no use here: begin again
            step, state = update(grad, optimizer.init(x), x)
        stuck = True
        for k in range(12):
            new_value, new_grad = evaluate(x + 0.5**k * step)
            count += 1
            if new_value < value:
                stuck = value - new_value < 1e-6 * value
                x, value, grad = x + 0.5**k * step, new_value, new_grad
                break
    return x, float(value)


def search(evaluate, x, goal: float, limit: int = 1000):
    """Minimise with Nelder and Mead's simplex, first of size one half; ``evaluate``: x -> loss. Else as ``descend``."""

    class Found(Exception):
        pass

    best = [np.inf, x]

    def watched(x):
        value = float(evaluate(x))
        if value < best[0]:
            best[:] = value, np.array(x)
        if value <= goal:
            raise Found
        return value

    simplex = np.concatenate([[x], x + 0.5 * np.eye(len(x))])
    options = {"initial_simplex": simplex, "maxfev": limit, "maxiter": limit, "xatol": 1e-6, "fatol": 1e-12}
    try:
        scipy.optimize.minimize(watched, x, method="Nelder-Mead", options=options)
    except Found:
        pass
    return best[1], best[0]


def compare(use: Use, limit: int = 1000) -> dict:
    """Both ways on one use."""
    rows = {}
    for name, way, function in (
        ("gradient", descend, jax.value_and_grad(use.loss)),
        ("zeroth_order", search, use.loss),
    ):
        evaluate = Counted(function, use.start)
        x, least = way(evaluate, use.start, use.goal, limit)
        error = use.error(x, least)
        rows[name] = {
            "evaluations": len(evaluate.losses),
            "seconds": evaluate.seconds,
            "compile_s": evaluate.compile_s,
            "loss": least,
            "error": error,
            "verdict": common.verdict(error, use.tolerance),
            "found": use.read(x),
            "losses": list(evaluate.losses),
        }
        if way is descend:
            rows[name]["floor"] = use.error(*descend(evaluate, use.start, 0.0, limit))
    return {
        "what": use.what,
        "parameters": use.parameters,
        "goal": use.goal,
        "tolerance": use.tolerance,
        "unit": use.unit,
        "start_error": use.error(use.start, rows["gradient"]["losses"][0]),
        "start": use.read(use.start),
        "truth": use.truth,
        **rows,
    }


def precisely(make, step: float = 1e-6) -> dict:
    """In float64: the gradient at the start against central differences of the loss (largest difference over the
    largest entry), and the error where the descent can go no further.
    """
    with jax.enable_x64(True):
        use = make()
        evaluate = Counted(jax.value_and_grad(use.loss), use.start)
        loss = lambda x: float(evaluate(x)[0])
        grad = np.asarray(evaluate(use.start)[1])
        slopes = [(loss(use.start + d) - loss(use.start - d)) / (2 * step) for d in step * np.eye(len(use.start))]
        difference = float(np.abs(grad - slopes).max() / np.abs(grad).max())
        return {"difference": difference, "floor": use.error(*descend(evaluate, use.start, 0.0))}


# --- page and picture ---

BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#808080"  # told apart by the colour-blind; and the lines differ


def draw(rows: dict, path: pathlib.Path) -> None:
    """Lowest loss so far against evaluations, a panel a use."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(rows), figsize=(3.1 * len(rows), 2.9), layout="constrained", dpi=150)
    for ax, (name, row) in zip(np.atleast_1d(axes), rows.items()):
        for key, label, colour, style in (
            ("gradient", "gradient (L-BFGS)", BLUE, "-"),
            ("zeroth_order", "values only (Nelder-Mead)", ORANGE, "--"),
        ):
            losses = np.minimum.accumulate(row[key]["losses"])
            ax.plot(np.arange(1, len(losses) + 1), losses, style, color=colour, drawstyle="steps-post", label=label)
            ax.plot(len(losses), losses[-1], "o", color=colour, markersize=4)
        ax.axhline(row["goal"], color=GREY, linewidth=0.8, linestyle=":", label="goal")
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_title(name, fontsize=9)
        ax.set_xlabel("evaluations", fontsize=8)
        ax.tick_params(labelsize=7)
        ax.spines[["top", "right"]].set_visible(False)
    first = np.atleast_1d(axes)[0]
    first.set_ylabel("lowest loss so far [m$^2$]", fontsize=8)
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.savefig(path)
    plt.close(figure)


def report(data: dict) -> str:
    rows, found = [], []
    for name, r in data["uses"].items():
        cells = []
        for key in ("gradient", "zeroth_order"):
            k = r[key]
            bad = k["verdict"] == "MISS" and not data["quick"]
            cells.append(
                f"{k['evaluations']}, {number(k['seconds'], 2)} s, {number(k['error'], 2)} {r['unit']}"
                + (" **MISS**" if bad else "")
            )
        rows.append([name, r["parameters"], *cells])
        for quantity, value in r["gradient"]["found"].items():
            true = number(r["truth"][quantity], 5) if r["truth"] else "-"
            found.append([name, quantity, number(r["start"][quantity], 4), number(value, 5), true])
        found.append([name, f"error [{r['unit']}]", number(r["start_error"]), number(r["gradient"]["error"], 2), "0"])
    cost = lambda k: k["seconds"] / k["evaluations"]
    what = "\n".join(
        f"* `{name}`: {r['what']}. To {r['tolerance']:g} {r['unit']}; compile {r['gradient']['compile_s']:.1f} s with "
        f"the gradient, {r['zeroth_order']['compile_s']:.1f} s without. With its gradient an evaluation takes "
        f"{cost(r['gradient']) / cost(r['zeroth_order']):.0f} times as long."
        + (
            f" Gradient at the start, float64: {number(r['float64']['difference'], 2)} from central differences. "
            f"Without a goal the error goes down to {number(r['gradient']['floor'], 1)} {r['unit']}, in float64 to "
            f"{number(r['float64']['floor'], 1)}."
            if r["float64"]
            else ""
        )
        for name, r in data["uses"].items()
    )
    quick = " Quick run: nothing is judged." if data["quick"] else ""
    rate = 1 / data["dt"]
    noisy = ""
    if data["noise"]:
        noisy = "\n## With measurement noise\n\n" + "\n".join(
            f"Positions observed to {n['noise'] * 1e3:g} mm (standard deviation): "
            + ", ".join(f"{q.split(' ')[0]} {number(e * 100, 2)} %" for q, e in n["errors"].items())
            + f" off after {n['evaluations']} evaluations."
            for n in data["noise"]
        )
        noisy += "\n"
    return f"""# Uses of gradients

{common.header(data["environment"])}
Made by `benchmarks/gradient_uses.py` in {data["seconds"]:.0f} s. Float32, which is enough for all three,
step 1/{rate:.0f} s, method `"gradient"`, impacts at their own instant (`events={data["events"]}`; `stop` has no
impacts: 0).{quick}

An evaluation is one simulation, with its gradient or without. Seconds are those of the evaluations; compile time is
apart. Gradient: optax's L-BFGS. Zeroth order: Nelder and Mead's simplex (scipy). Both begin at the same point and end
at the same loss.

{common.table(["use", "parameters", "gradient: evaluations, seconds, error", "zeroth order: the same"], rows)}

{what}

![Lowest loss against evaluations, three uses](gradient_uses.png)

## What the gradient found

{common.table(["use", "quantity", "start", "found", "true"], found)}
{noisy}"""


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--uses", default=",".join(USES), metavar="A,B", help=f"default {','.join(USES)}")
    parser.add_argument("--noise", default="0.001,0.005", metavar="M,M", help="[m], of `identify`; empty: none")
    parser.add_argument("--quick", action="store_true", help="steps of 1/60 s, at most 8 evaluations, nothing judged")
    parser.add_argument("--out", type=pathlib.Path, default=None, metavar="DIR", help="default benchmarks/results")
    args = parser.parse_args(argv)
    names = [n for n in args.uses.split(",") if n]
    for name in names:
        if name not in USES:
            parser.error(f"unknown use '{name}'; uses: {', '.join(USES)}")
    begin, out = time.perf_counter(), args.out or common.RESULTS
    out.mkdir(parents=True, exist_ok=True)
    env = common.environment()
    print(common.header(env), flush=True)
    dt = 1 / 60 if args.quick else DT
    data = {"environment": env, "quick": args.quick, "dt": dt, "events": METHOD.events, "uses": {}, "noise": []}
    for name in names:
        row = compare(USES[name](dt), 8 if args.quick else 1000)
        row["float64"] = None if args.quick else precisely(lambda: USES[name](dt))
        data["uses"][name] = row
        told = "; ".join(
            f"{k} {row[k]['evaluations']}, error {row[k]['error']:.2g}" for k in ("gradient", "zeroth_order")
        )
        print(f"  {name}: {told}  ({time.perf_counter() - begin:.0f} s)", flush=True)
    for noise in map(float, filter(None, args.noise.split(","))) if "identify" in names and not args.quick else ():
        use = identify(dt, noise)
        evaluate = Counted(jax.value_and_grad(use.loss), use.start)
        found = use.read(descend(evaluate, use.start, use.goal)[0])
        truth = data["uses"]["identify"]["truth"]
        errors = {q: abs(v / truth[q] - 1) for q, v in found.items()}
        data["noise"].append({"noise": noise, "evaluations": len(evaluate.losses), "found": found, "errors": errors})
    data["seconds"] = time.perf_counter() - begin
    common.write_json(out / "gradient_uses.json", data)
    (out / "gradient_uses.md").write_text(report(common.plain(data)), encoding="utf-8")
    draw(data["uses"], out / "gradient_uses.png")
    print(f"wrote gradient_uses.json, .md and .png under {out}  ({data['seconds']:.0f} s)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
