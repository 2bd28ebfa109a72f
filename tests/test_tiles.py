"""How a batch is cut: one function of the CPU, tiles, cores, devices; the bits of a world do not depend on it."""

import os
import pathlib
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax.memory import _of_machine, available, refuse
from rbd_jax.xla import one_function, piece

ROOT = pathlib.Path(__file__).parents[1]
PLANE = rbd.Geom(rbd.Plane(), friction=0.5)
CUBE = rbd.Box((0.1, 0.1, 0.1))
SCENES = {
    "ball": rbd.Scene([rbd.Body("a", rbd.Sphere(0.1), pos=(0, 0, 0.15), friction=0.5)], [PLANE], dt=0.004),
    "free box": rbd.Scene([rbd.Body("a", rbd.Box((0.1, 0.2, 0.3)), omega=(1, 2, 3))], dt=0.004),
    "two boxes": rbd.Scene(
        [rbd.Body("a", CUBE, pos=(0, 0, 0.1), friction=0.5), rbd.Body("b", CUBE, pos=(0.03, 0, 0.302), friction=0.5)],
        [PLANE],
        dt=0.004,
    ),
    "three balls": rbd.Scene(
        [rbd.Body(f"b{k}", rbd.Sphere(0.1), pos=(0.15 * (k % 2), 0, 0.1 + 0.17 * k), friction=0.5) for k in range(3)],
        [PLANE],
        dt=0.004,
    ),
}
STEPS = 40


@pytest.fixture(scope="module", autouse=True)
def all_cores():
    yield
    rbd.use_cores(None)


@pytest.fixture(scope="module", params=list(SCENES))
def worlds(request):
    model, one = rbd.build(SCENES[request.param], method="fast")
    rng = np.random.default_rng(0)
    state = rbd.batch(one, 300)
    state = state.replace(vel=0.5 * rng.normal(size=(300, one.n, 3)), omega=2 * rng.normal(size=(300, one.n, 3)))
    return request.param, model, state


def cut(tree, count):
    return jax.tree.map(lambda c: c[:count], tree)


def bits(state):
    return [np.asarray(c) for c in jax.tree.leaves(state)]


def same(a, b):
    return all(np.array_equal(x, y, equal_nan=True) for x, y in zip(bits(a), bits(b), strict=True))


def run(model, state, **options):
    return rbd.rollout(model, state, STEPS, every=20, **options)


def test_bits_do_not_depend_on_batch_size_nor_on_cores(worlds):
    name, model, state = worlds
    rbd.use_cores(1)
    final, traj = run(model, state)
    assert np.isfinite(np.asarray(final.pos)).all()
    assert not (np.asarray(final.status) & ~np.uint32(rbd.Status.NOT_CONVERGED)).any()
    for size in (32, 45, 128, 129):
        few, samples = run(model, cut(state, size))
        assert same(few, cut(final, size)), f"{name}: {size} worlds differ from the first of 300"
        assert same(samples, cut(traj, size))
    jitted = jax.jit(run)(model, state)
    assert same(jitted, (final, traj))


def test_bits_do_not_depend_on_threads(worlds, monkeypatch):
    from rbd_jax import spread

    name, model, state = worlds
    monkeypatch.setattr(spread, "LEAST", 0)
    rbd.use_cores(1)
    alone = run(model, state)
    for count in (2, 3):
        monkeypatch.setattr(spread, "cores", lambda count=count: count)
        assert spread._allowed((model, state), 300, STEPS).cores == count
        assert same(run(model, state), alone), f"{name}: {count} threads"


def test_cores_are_used_where_the_work_is_worth_it(monkeypatch):
    """By what a world goes through: steps, substeps, bodies and points of contact."""
    from rbd_jax import spread

    monkeypatch.setattr(spread, "cores", lambda: 2)
    cores = {}
    for name in ("ball", "three balls"):
        args = rbd.build(SCENES[name], dt=0.012, method="fast")
        least = -(-spread.LEAST // (1000 * spread.work(args, 1)))
        cores[name] = [spread._allowed(args, 1000, steps).cores for steps in (least - 1, least)]
        assert spread._allowed(args, 32, 10**6).cores == 1, "a tile is not cut"
    assert cores == {"ball": [1, 2], "three balls": [1, 2]}
    model, one = args
    points = sum(g.slots * len(g.a) for g in model.structure.groups)
    assert spread.work(args, 5) == 5 * 3 * (3 + 5 * points) > 0, "three substeps"


def test_one_program_serves_every_number_of_steps():
    from rbd_jax.rollout import _here

    scene = SCENES["three balls"]
    before = _here._cache_size()
    for dt, steps, every in ((0.012, 8, 4), (0.012, 6, 3), (0.02, 14, 7)):  # three and five substeps
        model, one = rbd.build(scene, dt=dt, method="fast")
        assert model.method.substeps == (3 if dt == 0.012 else 5)
        state = rbd.batch(one, 32)
        final, traj = rbd.rollout(model, state, steps, every=every)
        assert traj.pos.shape == (32, 3, 3, 3) and (np.asarray(final.step) == steps).all()
        for _ in range(steps):
            state = rbd.step(model, state)
        np.testing.assert_allclose(final.pos, state.pos, atol=1e-6)
        np.testing.assert_allclose(final.dt, dt, rtol=1e-6)
    assert _here._cache_size() == before + 1
    finals = [rbd.rollout(model, rbd.batch(one, 32), steps, every=steps)[0] for steps in (1, 2)]
    assert _here._cache_size() == before + 2
    assert [int(f.step[0]) for f in finals] == [1, 2]
    model, one = rbd.build(scene, dt=0.012, method="fast")
    state = rbd.batch(one, 32)
    rests = [rbd.rollout(model, state, steps, every=4)[0] for steps in (9, 11)]  # one, and three, after two samples
    assert _here._cache_size() == before + 3
    assert [int(r.step[0]) for r in rests] == [9, 11]


def test_the_step_runs_as_one_function(worlds):
    _, model, state = worlds
    if jax.default_backend() == "cpu":  # before XLA, which puts the mark on tiny loops itself
        assert 'xla_cpu_small_call = "true"' in jax.jit(run).lower(model, state).as_text()


def test_one_function_gives_what_kernels_give(worlds):
    """The program that is differentiated goes through colours, the direct one through the live points in turn.

    Newton steps end there when a world is solved to 1e-5 of its fastest velocity, which impacts magnify: one step.
    """
    _, model, state = worlds
    few, steps = cut(state, 32), STEPS
    if model.method.solver.name == "newton_lagged":
        few, steps = run(model, few)[0], 1
        few = few._with(status=jnp.zeros_like(few.status))
    go = lambda s: rbd.rollout(model, s, steps, every=steps)[0]
    direct = go(few)
    other = jax.jvp(go, (few,), (jax.tree.map(tangent, few),))[0]
    solved = ~(np.asarray(direct.status | other.status) & np.uint32(rbd.Status.NOT_CONVERGED)).astype(bool)
    assert solved.sum() > 28
    if steps == 1:  # how the points of a face share its friction is not determined to this
        direct, other = direct._with(memory=None), other._with(memory=None)
    for a, b in zip(bits(direct), bits(other), strict=True):
        np.testing.assert_allclose(a[solved], b[solved], rtol=2e-4, atol=2e-4)


def tangent(c):
    return jnp.zeros_like(c) if jnp.issubdtype(c.dtype, jnp.floating) else np.zeros(c.shape, jax.dtypes.float0)


def test_what_has_no_place_in_one_function_runs_as_kernels():
    call = one_function(lambda x: (jnp.sort(x), x.sum()))
    x = jnp.asarray([3.0, 1.0, 2.0])
    assert np.array_equal(jax.jit(call)(x)[0], [1, 2, 3])
    assert "xla_cpu_small_call" not in jax.jit(call).lower(x).as_text()


def test_a_long_program_is_cut_into_pieces():
    part = lambda x: piece(lambda y: jnp.sin(y) * y)(x) + 1
    x = jnp.arange(4.0)
    whole, cut_up = (jax.jit(one_function(part, longest)) for longest in (100, 2))
    assert np.array_equal(whole(x), cut_up(x))
    assert "xla_cpu_small_call" in whole.lower(x).as_text() and "xla_cpu_small_call" in cut_up.lower(x).as_text()
    assert "xla_cpu_small_call" not in jax.jit(part).lower(x).as_text(), "a piece alone is a part of its program"


def test_a_program_that_is_likely_long_is_traced_in_pieces_first():
    """And once only, where it is; what turns out to be short is one function all the same."""
    count = []

    def run(x):
        count.append(1)
        return jax.lax.fori_loop(0, 3, lambda _, y: piece(lambda z: jnp.sin(z) * z)(y) + 1, x), x

    x = jnp.arange(5.0)
    plain = run(x)
    for longest, traces in ((2, 1), (100, 2)):
        count.clear()
        text = jax.jit(one_function(run, longest, long=True)).lower(x).as_text()
        assert (len(count), text.count('xla_cpu_small_call = "true"')) == (traces, 1)
        np.testing.assert_allclose(jax.jit(one_function(run, longest, long=True))(x), plain, rtol=1e-6)


def test_an_argument_that_nothing_uses_is_no_trouble():
    call = jax.jit(one_function(lambda x, y: x * 2), keep_unused=True)
    assert float(call(jnp.float32(3), jnp.arange(5.0))) == 6
    # of no use to XLA, which aborts, though JAX does not know
    folded = jax.jit(one_function(lambda x, y: (x + y * 0, x * 2)))
    np.testing.assert_array_equal(folded(jnp.arange(3), jnp.arange(3)), [[0, 1, 2], [0, 2, 4]])


def test_loops_take_in_and_carry_what_their_results_depend_on():
    """XLA aborts where what reaches such a function turns out to be of no use in a loop of it."""
    from rbd_jax.xla import lean

    def run(x, dead, unused, limit):
        def body(carry):
            k, a, b, c = carry
            inner = jax.lax.while_loop(lambda c: c[0] < 2, lambda c: (c[0] + 1, c[1] + x, c[2] * dead), (0, a, b))
            unused * 2.0
            return k + 1, inner[1] + c, inner[2], c * 1.5

        k, a, *_ = jax.lax.while_loop(lambda c: c[0] < limit, body, (0, x, dead, x))
        return a

    args = jnp.ones(3), jnp.ones(4), jnp.ones(5), jnp.int32(3)
    whole = jax.make_jaxpr(run)(*args)
    short, used = lean(whole.jaxpr)
    assert used == [True, False, False, True]
    outer = short.eqns[-1]
    assert len(outer.outvars) == 3, "the steps, the result and what is added to it"
    got = jax.core.eval_jaxpr(short, whole.consts, args[0], args[3])[0]
    assert np.array_equal(got, run(*args)) and np.array_equal(one_function(run)(*args), got)


def test_a_body_is_searched_once_however_deep_it_lies(monkeypatch):
    """Each level of loops would otherwise double or treble the work of the one inside: five are seconds."""
    from rbd_jax import xla

    def nested(depth, x):
        if not depth:
            return jnp.sin(x)
        step = lambda c: (c[0] + 1, nested(depth - 1, c[1]), c[2] * 2.0)
        return jax.lax.while_loop(lambda c: c[0] < 2, step, (0, x, x))[1]

    searched = []
    monkeypatch.setattr(xla, "dce_jaxpr", lambda *a, _plain=xla.dce_jaxpr, **k: searched.append(1) or _plain(*a, **k))
    count = []
    for depth in (3, 6):
        searched.clear()
        short, _ = xla.lean(jax.make_jaxpr(lambda x, depth=depth: nested(depth, x))(1.0).jaxpr)
        count.append(len(searched))
        assert len(short.eqns[-1].outvars) == 2, "what nothing depends on is not carried"
    assert count[1] < 3 * count[0]


def test_a_large_single_result_is_refused():
    """XLA 0.10 fails to compile it in some programs (64 balls, 1,024 worlds, 25 steps): the sum of reaches was one."""
    x = jnp.ones((64, 128))
    with pytest.raises(TypeError, match="has one result"):
        one_function(lambda x: 0.01 * x + x)(x)
    one_function(lambda x: (0.01 * x, x + 1))(x)


def test_batch_axes_of_model_and_wrench_are_cut_too():
    model, one = rbd.build(SCENES["ball"], method="fast")
    mass = 1.0 + np.arange(300.0, dtype=np.float32)
    push = rbd.Wrench(force=jnp.asarray(np.random.default_rng(0).normal(size=(300, 1, 3)), jnp.float32))
    state = rbd.batch(one, 300)
    final = rbd.rollout(model.replace(mass=mass[:, None]), state, 20, every=20, control=push)[0]
    at = 299
    alone = rbd.rollout(
        model.replace(mass=mass[at:, None]), cut(state, 1), 20, every=20,
        control=rbd.Wrench(force=push.force[at:]),
    )[0]  # fmt: skip
    np.testing.assert_allclose(np.asarray(final.pos)[at], np.asarray(alone.pos)[0], rtol=1e-6, atol=1e-6)
    folded = jax.tree.map(lambda c: c.reshape(3, 100, *c.shape[1:]), state)
    wide = rbd.rollout(
        model.replace(mass=mass.reshape(3, 100, 1)), folded, 20, every=20,
        control=rbd.Wrench(force=push.force.reshape(3, 100, 1, 3)),
    )[0]  # fmt: skip
    assert same(jax.tree.map(lambda c: c.reshape(300, *c.shape[2:]), wide), final)
    rows = model.replace(mass=mass[:3, None])  # one mass for every hundred worlds
    tall = rbd.rollout(rows, folded, 20, every=20, control=rbd.Wrench(force=jnp.ones((1, 3))))[0]
    assert tall.batch_shape == (3, 100) and np.isfinite(np.asarray(tall.pos)).all()


DEVICES = """
    import jax, numpy as np, rbd_jax as rbd, hashlib, sys
    body = rbd.Body("a", rbd.Box((0.1, 0.1, 0.1)), pos=(0, 0, 0.12), friction=0.5)
    scene = rbd.Scene([body], [rbd.Geom(rbd.Plane(), friction=0.5)], dt=0.004)
    model, one = rbd.build(scene, method="fast")
    state = rbd.batch(one, 1001).replace(omega=np.random.default_rng(0).normal(size=(1001, 1, 3)))
    final, traj = rbd.rollout(model, state, 40, every=20)
    assert final.pos.shape == (1001, 1, 3) and traj.pos.shape == (1001, 3, 1, 3)
    if len(jax.devices()) > 1:
        from rbd_jax import spread
        assert len(spread._allowed((model, state), 1001, 40).devices) == len(jax.devices())
        again, _ = rbd.rollout(model, final, 40, every=40)  # already where it belongs
        assert len(final.x.x.sharding.device_set) in (1, len(jax.devices()))
    print(hashlib.sha1(b"".join(np.asarray(c).tobytes() for c in jax.tree.leaves((final, traj)))).hexdigest())
"""


def test_bits_do_not_depend_on_devices():
    """1,001 worlds on one, two and three host devices; the number does not divide."""
    digests = set()
    for count in (1, 2, 3):
        flags = f"--xla_force_host_platform_device_count={count}"
        env = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(DEVICES)], capture_output=True, text=True, env=env, timeout=300
        )
        assert done.returncode == 0, done.stderr[-2000:]
        digests.add(done.stdout.split()[-1])
    assert len(digests) == 1


WAITING = """
    import jax, numpy as np, rbd_jax as rbd
    cubes = [rbd.Body(f"b{k}", rbd.Box((0.1, 0.1, 0.1)), pos=(0, 0, 0.1 + 0.2 * k), friction=0.6) for k in range(5)]
    scene = rbd.Scene(cubes, [rbd.Geom(rbd.Plane(), friction=0.6)], dt=0.004)
    model, one = rbd.build(scene, method="accurate")
    rbd.use_cores(2)
    jax.block_until_ready(rbd.rollout(model, rbd.batch(one, 128), 200, every=200))
    print("done")
"""


@pytest.mark.parametrize("devices", (1, 2))
def test_linear_algebra_does_not_wait_for_itself(devices):
    """Two programs with LAPACK calls at a time wait for each other's threads for ever: such a rollout runs alone."""
    flags = f"--xla_force_host_platform_device_count={devices}"
    env = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    code = textwrap.dedent(WAITING)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, timeout=200)
    assert done.stdout.split() == ["done"], done.stderr[-2000:]


def test_donated_states_are_used_up_or_kept():
    model, one = rbd.build(SCENES["ball"], method="fast")
    kept, given = rbd.batch(one, 8), rbd.batch(one, 8)
    expected = rbd.rollout(model, kept, 10, every=10)[0]
    assert same(rbd.rollout(model, given, 10, every=10, donate=True)[0], expected)
    assert given.x.x.is_deleted() and not kept.x.x.is_deleted()


# --- bad input ---


def test_no_worlds():
    model, one = rbd.build(SCENES["ball"], method="fast")
    with pytest.raises(ValueError, match="batch size 0"):
        rbd.rollout(model, cut(rbd.batch(one, 4), 0), 10)
    with pytest.raises(ValueError, match="batch size = 0"):
        rbd.batch(one, 0)


def test_two_precisions():
    model, one = rbd.build(SCENES["ball"], method="fast")
    wide = one._with(x=one.x.map(lambda c: np.asarray(c, np.float64)))
    with pytest.raises(ValueError, match="float64, the model is float32"):
        rbd.rollout(model, wide, 10)


@pytest.mark.parametrize("count", (0, -1, True, 1.5, "all"))
def test_cores_that_do_not_exist(count):
    with pytest.raises(ValueError, match="use_cores"):
        rbd.use_cores(count)


def test_more_memory_than_there_is():
    model, one = rbd.build(SCENES["ball"], method="fast")
    with pytest.raises(MemoryError, match=r"1,000,000,001 samples of 64 worlds need .* TB, the device has .* left"):
        rbd.rollout(model, rbd.batch(one, 64), 1_000_000_000)
    refuse(one, 1, 1000, 1)


def test_a_control_that_calls_the_host():
    """A host callback is allowed in a control function; it runs as a kernel of its own, once a step."""
    model, one = rbd.build(SCENES["ball"], method="fast")
    seen = []

    def push(pos):
        seen.append(pos.shape)
        return np.asarray([[0.0, 0.0, 1.0]], np.float32)

    def control(model, state):
        shape = jax.ShapeDtypeStruct((1, 3), np.float32)
        return rbd.Wrench(force=jax.pure_callback(push, shape, state.pos))

    final = rbd.rollout(model, one, 5, every=5, control=control)[0]
    jax.block_until_ready(final)
    assert len(seen) >= 5
    steady = rbd.rollout(model, one, 5, every=5, control=rbd.Wrench(force=jnp.asarray([[0.0, 0.0, 1.0]])))[0]
    np.testing.assert_allclose(np.asarray(final.pos), np.asarray(steady.pos), atol=1e-6)


# --- memory ---

MEASURED = """
    import ctypes, gc, os, sys, threading, time, rbd_jax as rbd, jax
    body = rbd.Body("a", rbd.Sphere(0.1), pos=(0, 0, 0.15), friction=0.5)
    model, one = rbd.build(rbd.Scene([body], [rbd.Plane()], dt=0.004), method="fast")
    rbd.use_cores(int(sys.argv[1]))
    state, steps = rbd.batch(one, 4096), 2000
    estimate = rbd.memory_estimate(model, 4096, steps)
    jax.block_until_ready(rbd.rollout(model, state, steps))
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # else what the first call left behind is taken again unseen
    resident = lambda: int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    before, most, done = resident(), 0, False
    def watch():
        global most
        while not done:
            most = max(most, resident())
            time.sleep(0.002)
    thread = threading.Thread(target=watch)
    thread.start()
    out = jax.block_until_ready(rbd.rollout(model, state, steps))
    done = True
    thread.join()
    print(estimate, file=sys.stderr)
    print(estimate.peak, most - before)
"""


@pytest.mark.parametrize("cores", (1, 2))
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_memory_estimate_is_what_the_process_takes(cores):
    env = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", textwrap.dedent(MEASURED), str(cores)]
    for _ in range(3):  # a machine short of memory takes pages from the process while it is measured
        done = subprocess.run(command, capture_output=True, text=True, env=env, timeout=300)
        assert done.returncode == 0, done.stderr[-2000:]
        estimate, measured = map(int, done.stdout.split())
        if 0.8 < estimate / max(measured, 1) < 1.2:
            return
    pytest.fail(f"estimated {estimate}, measured {measured} bytes; {done.stderr}")


def test_available_memory_of_a_container(tmp_path):
    """What counts is the smaller of the machine's and the container's, whose copies of files can be dropped."""
    proc, group = tmp_path / "meminfo", tmp_path / "group"
    group.mkdir()
    assert _of_machine(proc, group) is None
    proc.write_text("MemTotal: 16000 kB\nMemAvailable: 9000 kB\n")
    assert _of_machine(proc, group) == 9000 * 1024
    files = {"max": "8000000", "current": "5000000", "stat": "anon 3000000\ninactive_file 1500000\nactive_file 9\n"}
    for name, text in files.items():
        (group / f"memory.{name}").write_text(text)
    assert _of_machine(proc, group) == 8000000 - 5000000 + 1500000
    (group / "memory.max").write_text("max")  # no limit
    assert _of_machine(proc, group) == 9000 * 1024


def test_memory_estimate_refuses_nonsense():
    model, _ = rbd.build(SCENES["ball"], method="fast")
    for bad in ({"batch": 0}, {"steps": 0}, {"every": 0}, {"batch": 1.5}):
        with pytest.raises(ValueError, match=f"memory_estimate: {next(iter(bad))} = "):
            rbd.memory_estimate(model, **{"batch": 4, "steps": 4, "every": 1, **bad})
    estimate = rbd.memory_estimate(model, (2, 3), 10)
    assert estimate.results > estimate.arguments > 0 and estimate.peak == round(6 * estimate.per_world)
    assert "a world" in str(estimate) and (available() is None or available() > 0)


def test_export_and_load(tmp_path):
    """A rollout as a file, run in a process that builds no scene (docs: performance)."""
    model, one = rbd.build(SCENES["ball"], method="fast")
    state = rbd.batch(one, 64)
    leaves, tree = jax.tree.flatten((model, state))
    pos = lambda *leaves: rbd.rollout(*tree.unflatten(leaves), 20, every=20)[0].pos
    path = tmp_path / "rollout.bin"
    path.write_bytes(jax.export.export(jax.jit(pos))(*leaves).serialize())
    loaded = jax.export.deserialize(bytearray(path.read_bytes()))
    assert np.array_equal(loaded.call(*leaves), pos(*leaves))


def test_the_estimate_compiles_the_program_that_runs():
    """Its shapes were once asked for first: that trace, of kernels, went into the one function, and 16 worlds of a box
    then took all memory there was to compile."""
    jax.clear_caches()
    model, state = rbd.build(rbd.Scene([rbd.Body("box", rbd.Box((0.1, 0.15, 0.2)), pos=(0, 0, 0.3))], [rbd.Plane()]))
    estimate = rbd.memory_estimate(model, 16, 10, 10)
    assert 0 < estimate.work < 1e6
    final, _ = rbd.rollout(model, rbd.batch(state, 16), 10, every=10)
    assert np.isfinite(final.pos).all()
