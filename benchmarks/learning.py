"""Learning on the engine: environment steps per second beside Brax and MuJoCo, and reward curves of both learners.

    PYTHONPATH=. python benchmarks/learning.py                          (about 25 minutes on 2 cores)
    PYTHONPATH=. python benchmarks/learning.py --rows throughput
    PYTHONPATH=. python benchmarks/learning.py --rows curves --tasks push,catch --seeds 5
    PYTHONPATH=. python benchmarks/learning.py --smoke --out /tmp/x

throughput: the task "push" under random actions, with restarts, observations and rewards, everywhere alike: ours in
one program; Brax (pipelines spring and positional) in one program, where it is installed; MuJoCo's ``rollout`` on all
cores, its actions as ``xfrc_applied``, observations and rewards in numpy. A control step is five steps of 10 ms.

curves: every task learned by PPO and by gradients through the simulator (those in THROUGH), for so many seconds and
seeds; returns are those of the episodes that end while it learns, final returns those of 256 fresh episodes.

clips: what the first seed of PPO does in four worlds, learning_TASK.gif.

Appends to learning.jsonl and writes learning.md and learning_curves.png under ``--out`` (benchmarks/results).
"""

from __future__ import annotations

import json
import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import common  # noqa: E402
from common import number  # noqa: E402
from mujoco import rollout as mj_rollout  # noqa: E402

from rbd_jax.learn import TASKS, AutoReset, make, ppo, through, training, unroll, watch  # noqa: E402
from rbd_jax.learn.tasks.push import FORCE, RADIUS, REACH  # noqa: E402
from rbd_jax.mjcf import to_mjcf  # noqa: E402
from rbd_jax.view import write_gif  # noqa: E402

ROWS = ("throughput", "curves")
#: Issue bar: environment steps per second on 2 cores.
BAR = 1e6
WORLDS = (256, 1024, 4096, 16384)
#: Wall seconds of learning, by task; ``through`` is left to tasks whose derivative compiles and runs fast.
SECONDS = {"push": 15.0, "catch": 15.0, "balance": 20.0, "topple": 40.0}
THROUGH = ("push", "catch")
LEARNERS = {"ppo": (ppo, ppo.PPO), "through": (through, through.Through)}
TITLES = {"ppo": "PPO", "through": "gradients through the simulator"}


# --- throughput ---


def rate(call, steps: int, repeats: int) -> dict:
    """Steps per second of ``call()``, which does so many."""
    begin = time.perf_counter()
    call()
    cold = time.perf_counter() - begin
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return {"steps_per_s": steps / np.median(times), "best": steps / min(times), "cold_s": cold}


def ours(worlds: int, steps: int):
    task = make("push")
    state, _ = jax.jit(jax.vmap(task.reset))(jax.random.split(jax.random.key(0), worlds))

    @jax.jit
    def run(state, key):
        state, (_, _, out) = unroll(AutoReset(task), training.at_random(task), state, steps, key)
        return state, out.reward.sum(), out.obs.sum()

    return lambda: jax.block_until_ready(run(state, jax.random.key(1)))


def brax(worlds: int, steps: int, pipeline: str):
    """The same scene, force, observation, reward and restart in Brax."""
    import importlib
    import warnings

    from brax.io import mjcf as reader

    pipe = importlib.import_module(f"brax.{pipeline}.pipeline")
    text = f"""<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="0 0 1" friction="0.5 0 0"/>
      <body pos="0 0 {RADIUS}"><freejoint/><geom type="sphere" size="{RADIUS}" mass="1" friction="0.5 0 0"/></body>
      </worldbody></mujoco>"""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        system = reader.loads(text)
    none = jnp.zeros(0)

    def reset(key):
        place, target = jax.random.uniform(key, (2, 2), minval=-REACH, maxval=REACH)
        q = jnp.array([0, 0, RADIUS, 1, 0, 0, 0]).at[:2].set(place)
        return pipe.init(system, q, jnp.zeros(6)), target, jnp.int32(0)

    def observe(state, target):
        return jnp.concatenate([target - state.x.pos[0, :2], state.xd.vel[0, :2], RADIUS * state.xd.ang[0, :2]])

    def step(carry, action, key):
        state, target, count = carry
        for _ in range(5):  # the force as a change of velocity: Brax's pipelines take no external force
            vel = state.xd.vel.at[0, :2].add(0.01 * FORCE * action)
            state = state.replace(xd=state.xd.replace(vel=vel), xd_i=state.xd_i.replace(vel=vel))
            state = pipe.step(system, state, none)
        obs = observe(state, target)
        reward = -jnp.linalg.norm(obs[:2]) - 0.05 * (action**2).sum()
        done = count + 1 >= 100
        fresh = reset(key)
        carry = jax.tree.map(lambda a, b: jnp.where(done, a, b), fresh, (state, target, count + 1))
        return carry, (observe(carry[0], carry[1]), reward)

    first = jax.jit(jax.vmap(reset))(jax.random.split(jax.random.key(0), worlds))

    @jax.jit
    def run(carry, key):
        def one(carry, key):
            act, again = jax.random.split(key)
            action = jax.random.uniform(act, (worlds, 2), minval=-1.0)
            carry, (obs, reward) = jax.vmap(step)(carry, action, jax.random.split(again, worlds))
            return carry, (obs.sum(), reward.sum())

        return jax.lax.scan(one, carry, jax.random.split(key, steps))

    return lambda: jax.block_until_ready(run(first, jax.random.key(1)))


def mujoco_c(worlds: int, steps: int):
    """``rollout`` of five steps after five steps on all cores; the rest in numpy."""
    import os

    model = mujoco.MjModel.from_xml_string(to_mjcf(make("push").scene()))
    model.opt.timestep = 0.01
    threads = os.cpu_count() or 1
    data = [mujoco.MjData(model) for _ in range(threads)]
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    size = mujoco.mj_stateSize(model, full)
    forces = int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
    out, sensors = np.zeros((worlds, 5, size)), np.zeros((worlds, 5, model.nsensordata))
    pool = mj_rollout.Rollout(nthread=threads)

    def begin(n, rng):
        state = np.zeros((n, size))
        place, target = rng.uniform(-REACH, REACH, (2, n, 2))
        state[:, 1:3], state[:, 3], state[:, 4] = place, RADIUS, 1.0
        return state, target

    def call():
        rng = np.random.default_rng(1)
        state, target = begin(worlds, rng)
        applied = np.zeros((worlds, 5, 6 * model.nbody))
        for k in range(steps):
            action = rng.uniform(-1, 1, (worlds, 2))
            applied[:, :, 6:8] = FORCE * action[:, None]
            pool.rollout(model, data, state, applied, control_spec=forces, state=out, sensordata=sensors)
            state = out[:, -1].copy()
            way = target - state[:, 1:3]
            np.concatenate([way, state[:, 8:10], RADIUS * state[:, 11:13]], 1)  # seen
            -np.linalg.norm(way, axis=1) - 0.05 * (action**2).sum(1)  # earned
            if k % 100 == 99:
                state, target = begin(worlds, rng)

    return call


def throughput(smoke: bool, repeats: int):
    steps = 4 if smoke else 100
    engines = {"ours": ours, "mujoco": mujoco_c}
    try:
        import brax as _  # noqa: F401

        engines |= {f"brax {p}": lambda w, s, p=p: brax(w, s, p) for p in ("spring", "positional")}
    except ModuleNotFoundError:
        yield {"row": "throughput", "engine": "brax", "worlds": None, "note": "not installed: pip install brax"}
    for worlds in WORLDS[:1] if smoke else WORLDS:
        for name, engine in engines.items():
            got = rate(engine(worlds, steps), worlds * steps, repeats)
            print(f"{name:16s} {worlds:6d} worlds  {got['steps_per_s']:10.3g} environment steps/s", flush=True)
            yield {"row": "throughput", "engine": name, "worlds": worlds, **got}


# --- curves ---


def curves(smoke: bool, tasks, seeds: int, out: pathlib.Path):
    for name in tasks:
        task = make(name)
        chance = training.evaluate(task, training.at_random(task), jax.random.key(99))
        yield {"row": "curve", "task": name, "learner": "chance", "seed": 0, "final": float(chance.mean())}
        for kind, (learner, settings) in LEARNERS.items():
            if kind == "through" and name not in THROUGH:
                continue
            for seed in range(1 if smoke else seeds):
                end = {"steps": 1} if smoke else {"seconds": SECONDS[name]}
                begin = time.perf_counter()
                got, history = learner.train(task, jax.random.key(seed), settings(), **end)
                total = time.perf_counter() - begin
                final = training.evaluate(task, got.policy, jax.random.key(99))
                seen = [(p.steps, p.seconds, p.mean_return) for p in history if p.episodes]
                every = max(len(seen) // 100, 1)
                print(f"{name:8s} {kind:8s} seed {seed}: {final.mean():8.2f} (chance {chance.mean():.2f})", flush=True)
                yield {
                    "row": "curve", "task": name, "learner": kind, "seed": seed, "final": float(final.mean()),
                    "spread": float(final.std()), "steps": history[-1].steps, "seconds": history[-1].seconds,
                    "compile_s": total - history[-1].seconds, "lost": sum(p.lost_gradient for p in history),
                    "curve": seen[::every],
                }  # fmt: skip
                if kind == "ppo" and seed == 0 and not smoke:
                    film = watch(task, got.policy, jax.random.key(7))
                    write_gif(film, out / f"learning_{name}.gif", world=range(4), fps=10, width=320, height=200)


# --- page ---


def interval(values) -> tuple[float, float]:
    """Mean and the half-width of its 95 % interval (Student's t)."""
    from scipy import stats

    values = np.asarray(values, float)
    if len(values) < 2:
        return float(values.mean()), float("nan")
    return float(values.mean()), float(stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5)


def latest(rows, row: str, keys) -> list[dict]:
    found = {}
    for r in rows:
        if r["row"] == row and not r.get("smoke"):
            found[tuple(r[k] for k in keys)] = r
    return list(found.values())


def page(rows, place: pathlib.Path) -> str:
    out = ["# Learning", "", common.header(rows[-1]["environment"]), "Made by `benchmarks/learning.py`.", ""]
    speed = [r for r in latest(rows, "throughput", ("engine", "worlds")) if r["worlds"]]
    if speed:
        engines = list(dict.fromkeys(r["engine"] for r in speed))
        table = {(r["engine"], r["worlds"]): r["steps_per_s"] for r in speed}
        lines = [[w, *(number(table.get((e, w))) for e in engines)] for w in sorted({r["worlds"] for r in speed})]
        about = "A control step is five steps of 10 ms with observation, reward and restart; median, compilation apart."
        out += ['## Environment steps per second, task "push"', "", about, ""]
        out += [common.table(["worlds", *engines], lines), ""]
        best = max(v for (e, _), v in table.items() if e == "ours")
        out += [
            f"Best of ours {number(best)} per second, bar {number(BAR)}: {common.verdict(best, BAR, least=True)}.",
            "",
        ]
    learned = latest(rows, "curve", ("task", "learner", "seed"))
    if learned:
        heads = [
            "task",
            "learner",
            "seeds",
            "final return (95 %)",
            "chance",
            "control steps",
            "learning [s]",
            "compile [s]",
        ]
        lines = []
        for task in dict.fromkeys(r["task"] for r in learned):
            chance = next((r["final"] for r in learned if r["task"] == task and r["learner"] == "chance"), None)
            for kind in LEARNERS:
                mine = [r for r in learned if (r["task"], r["learner"]) == (task, kind)]
                if mine:
                    mean, half = interval([r["final"] for r in mine])
                    middle = lambda k: number(float(np.median([r[k] for r in mine])))
                    lines.append([task, TITLES[kind], len(mine), f"{mean:.2f} ± {half:.2f}", number(chance, 4),
                                  middle("steps"), middle("seconds"), middle("compile_s")])  # fmt: skip
        about = "Final return: mean over seeds of 256 fresh episodes without exploration."
        picture = "![Reward against wall time and control steps](learning_curves.png)"
        out += ["## What is learned", "", about, "", common.table(heads, lines), "", picture, ""]
        names = [t for t in dict.fromkeys(r["task"] for r in learned) if (place / f"learning_{t}.gif").is_file()]
        out += [f"![{t}, four worlds after learning](learning_{t}.gif)\n" for t in names]
    return "\n".join(out)


def draw(rows, path: pathlib.Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    learned = [r for r in latest(rows, "curve", ("task", "learner", "seed")) if r["learner"] in LEARNERS]
    tasks = list(dict.fromkeys(r["task"] for r in learned))
    if not tasks:
        return
    fig, axes = plt.subplots(2, len(tasks), figsize=(3.4 * len(tasks), 5.6), squeeze=False, layout="constrained")
    for column, task in zip(axes.T, tasks):
        chance = next((r["final"] for r in rows if r.get("task") == task and r.get("learner") == "chance"), None)
        for ax, key in zip(column, (1, 0)):
            for kind, colour in (("ppo", "#0072B2"), ("through", "#D55E00")):
                mine = [np.array(r["curve"], float) for r in learned if (r["task"], r["learner"]) == (task, kind)]
                mine = [c for c in mine if len(c) > 1]
                if not mine:
                    continue
                grid = np.linspace(max(c[0, key] for c in mine), min(c[-1, key] for c in mine), 60)
                all_of = np.array([np.interp(grid, c[:, key], c[:, 2]) for c in mine])
                ax.plot(grid, np.median(all_of, 0), color=colour, label=TITLES[kind])
                ax.fill_between(grid, all_of.min(0), all_of.max(0), color=colour, alpha=0.2, lw=0)
            if chance is not None:
                ax.axhline(chance, color="0.5", ls=":", lw=1, label="chance")
            ax.set_xlabel("wall time of learning [s]" if key else "control steps")
            ax.set_xscale("log")
            ax.xaxis.set_minor_formatter("")  # a chart of one decade would label every tick
            ax.grid(alpha=0.3)
        column[0].set_title(task)
    for row in axes:
        row[0].set_ylabel("return of an episode")
    axes[0, 0].legend(fontsize=8)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main(argv=None) -> int:
    parser = common.options(__doc__, "one size, one iteration")
    parser.add_argument("--rows", default=",".join(ROWS), metavar="A,B", help=f"default all: {','.join(ROWS)}")
    parser.add_argument(
        "--tasks", default=",".join(TASKS), metavar="A,B", help=f"of curves; default all: {','.join(TASKS)}"
    )
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="of curves (default 5)")
    parser.add_argument("--report", action="store_true", help="run nothing, write the page and the chart")
    args = parser.parse_args(argv)
    wanted, tasks = args.rows.split(","), args.tasks.split(",")
    for given, known, what in ((wanted, ROWS, "row"), (tasks, TASKS, "task")):
        for name in given:
            if name not in known:
                parser.error(f"unknown {what} '{name}'; {what}s: {', '.join(known)}")
    tasks = tasks[:1] if args.smoke else tasks
    out = args.out or common.RESULTS
    same = {"environment": common.environment(), **({"smoke": True} if args.smoke else {})}
    parts = {
        "throughput": lambda: throughput(args.smoke, 1 if args.smoke else args.repeats),
        "curves": lambda: curves(args.smoke, tasks, args.seeds, out),
    }
    for name in wanted if not args.report else ():
        for row in parts[name]():
            common.append_lines(out / "learning.jsonl", [{**row, **same}])
    rows = [json.loads(line) for line in (out / "learning.jsonl").read_text().splitlines()]
    (out / "learning.md").write_text(page(rows, out), encoding="utf-8")
    draw(rows, out / "learning_curves.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
