"""A rollout as one kernel of a GPU: its C, compiled for the CPU, gives what JAX gives; on a GPU it is what runs."""

import ctypes
import functools
import math
import shutil
import subprocess
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax import kernel, tiles
from rbd_jax.kernel import emit, nvrtc
from rbd_jax.rollout import _advance, _rollout, _step
from rbd_jax.step import enter, with_memory
from rbd_jax.xla import unset

COMPILER = shutil.which("g++") or shutil.which("c++")
on_cpu = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler")
no_gpu = pytest.mark.skipif(jax.default_backend() != "gpu", reason="no GPU")


def on_gpu(test):
    return pytest.mark.gpu(no_gpu(test))


@pytest.fixture
def run_c(tmp_path):
    """``run(*args)`` of some worlds by the C of its kernel, on the CPU; what no one writes is not a number."""

    def call(run, worlds, *args):
        made, used, shape = kernel.program(run, worlds, *args)
        text, lib = tmp_path / "worlds.cc", tmp_path / f"worlds{len(list(tmp_path.iterdir()))}.so"
        text.write_text(made.text)
        flags = ["-O1", "-ffp-contract=off", "-w", "-shared", "-fPIC"]
        subprocess.run([COMPILER, *flags, "-o", lib, text], check=True)
        given = [np.ascontiguousarray(c) for c, u in zip(jax.tree.leaves(args), used, strict=True) if u]
        junk = lambda dtype: np.nan if np.dtype(dtype).kind == "f" else np.iinfo(dtype).max // 3
        fill = lambda dtype, shape: np.full(shape, True if np.dtype(dtype) == bool else junk(dtype), dtype)
        out = [fill(c.dtype, (*c.shape[:-1], worlds)) for c in jax.tree.leaves(shape)]
        pools = [fill(dtype, size) for dtype, size in made.pools]
        pointers = [np.array([worlds], np.int32), *given, *out, *pools]
        function = getattr(ctypes.CDLL(str(lib)), kernel.NAME)
        function((ctypes.c_void_p * len(pointers))(*(c.ctypes.data for c in pointers)))
        return jax.tree.structure(shape).unflatten(out)

    return call


# --- operations ---


def agree(run_c, f, *args, worlds=1, rtol=1e-6):
    got, want = run_c(f, worlds, *args), jax.jit(lambda *args: f(*args))(*args)  # traced anew
    for g, w in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(g, np.asarray(w).reshape(g.shape), rtol=rtol, atol=1e-7)


@on_cpu
def test_operations_element_by_element(run_c):
    rng = np.random.default_rng(0)
    x, y = (jnp.asarray(rng.normal(size=(7, 1)), jnp.float32) for _ in range(2))
    odd = jnp.asarray([[0.0], [-0.0], [np.nan], [np.inf], [-np.inf], [1e-30], [2.5]], jnp.float32)
    k = jnp.asarray(rng.integers(-9, 9, (7, 1)), jnp.int32)
    u = jnp.asarray(rng.integers(0, 2**31, (7, 1)), jnp.uint32)

    def f(x, y, odd, k, u):
        unit = 0.9 * x / jnp.abs(x).max()
        names = "exp expm1 sin cos tan tanh sinh cosh floor ceil sign abs square cbrt".split()
        out = [getattr(jnp, n)(x) for n in names]
        out += [getattr(jnp, n)(unit) for n in "arcsin arccos arctan arctanh log1p".split()]
        out += [getattr(jnp, n)(jnp.abs(x)) for n in "sqrt log exp2".split()]
        out += [jax.lax.rsqrt(jnp.abs(y)), jax.lax.erf(x), jax.lax.logistic(x), jnp.round(2.5 * jnp.sign(x)), x**3]
        out += [x**-2, jnp.arctan2(x, y), jnp.abs(x) ** y, jnp.clip(x, -0.5, 0.5), x % y, jnp.fmod(x, y), x / y]
        out += [jnp.maximum(odd, x), jnp.minimum(x, odd), jnp.isfinite(odd), jnp.sign(odd), jnp.where(x > y, x, y)]
        out += [k // 4, k % 4, jnp.abs(k), -k, k & 3, k | 8, k ^ 5, ~k, k << 2, k >> 1, k.astype(jnp.float32)]
        out += [u >> jnp.uint32(3), jax.lax.population_count(u), (x > 0) & (y > 0), ~(x > 0), (x > 0) ^ (y > 0)]
        return out + [x.astype(jnp.int32), jax.lax.bitcast_convert_type(x, jnp.int32), (k > 0).astype(jnp.float32)]

    agree(run_c, f, x, y, odd, k, u, rtol=3e-6)


@on_cpu
def test_operations_that_move_elements(run_c):
    rng = np.random.default_rng(1)
    a, b, c = (jnp.asarray(rng.normal(size=s), jnp.float32) for s in ((5, 1), (8, 1), (8, 5, 1)))
    rows = np.array([3, 1, 1, 4, 0, 2, 2])
    table = jnp.asarray(rng.normal(size=(8, 1, 1)), jnp.float32)
    at = jnp.asarray([[4], [0], [7], [2], [9]], jnp.int32)

    def f(a, b, c, at):
        out = [c * a + b[:, None], table * a, a[rows], c[2:7:2, 1:4], jnp.flip(c, 0), jnp.transpose(c, (1, 0, 2))]
        out += [jnp.concatenate([c, c[:3] * 2]), jnp.concatenate([c, b[:, None]], axis=1), jnp.pad(a, ((2, 1), (0, 0)))]
        out += [c.sum(0), c.max(1), c.min((0, 1)), (c > 0).any(0), (c > -1).all((0, 1)), c.prod(1)]
        out += [jnp.take_along_axis(b, jnp.minimum(at, 7), 0), b[:, 0][at], jnp.take(b[:, 0], at, mode="fill")]
        out += [jnp.take_along_axis(c, at[None] % 5, 1)[:, ::2], jnp.arange(8.0)[:, None] * b]
        return out + [jnp.stack([a, 2 * a], 1), *jnp.split(c, [2, 3], axis=1)]

    agree(run_c, f, a, b, c, at)

    def g(a, b, c, at):
        out = [c.at[2, :, 0].set(a[:, 0]), c.at[:, 3].add(b), b.at[at[:, 0]].add(a), b.at[at[:, 0]].set(a, mode="clip")]
        return out + [c.at[rows].multiply(2.0), c.at[:, 1:3].min(0.1), a.at[rows].max(7.0, mode="promise_in_bounds")]

    agree(run_c, g, a, b, c, jnp.asarray([[4], [0], [7], [2], [9]], jnp.int32))


@on_cpu
def test_loops_and_what_they_change_in_place(run_c):
    a = jnp.arange(20.0)[:, None]

    def reversed_twice(a):
        """Reads an element behind the place that was written before it."""

        def body(k, c):
            x, y = c
            old = x[k]
            x = x.at[k].set(x[19 - k])
            return x.at[19 - k].set(old + 1), y.at[k].add(x[k])

        return jax.lax.fori_loop(0, 20, body, (a, a))

    def swapped(a):
        return jax.lax.fori_loop(0, 3, lambda _, c: (c[1], c[0] * 2, c[2] + c[0][:3]), (a, a + 1, a[:3]))[:2]

    def stacked(a):
        carry, rows = jax.lax.scan(lambda c, x: (c + x, (c, c * x)), a[0], a, reverse=True)
        return carry, rows

    def branched(a):
        f = lambda c, x: jax.lax.switch(
            (x[0] % 3).astype(jnp.int32), [lambda c: c, lambda c: c + 1, lambda c: 2 * c], c
        )
        return jax.lax.scan(lambda c, x: (f(c, x), c.sum(0)), a, a)

    def kept(a):
        """The old array is needed after it was changed."""
        new = jax.lax.dynamic_update_slice(a, a[:1] * 7, (a[3, 0].astype(jnp.int32), 0))
        view = new[2:19:3]
        newer = jax.lax.dynamic_update_slice(new, view[:2], (5, 0))
        return a * 2, view + 1, newer, new

    def ended(a):
        return jax.lax.while_loop(lambda c: c[1].sum() < 1e3, lambda c: (c[0] + 1, c[1] * 1.1 + 1), (0, a))

    for f in (reversed_twice, swapped, stacked, branched, kept):
        agree(run_c, f, a)
    n, x = run_c(lambda a: tuple(c.reshape(-1, 1) for c in map(jnp.asarray, ended(a))), 1, a)
    assert n.ravel() == ended(a)[0]
    np.testing.assert_allclose(x, ended(a)[1], rtol=1e-5)


@on_cpu
def test_nothing_is_written_into_memory_that_is_unset(run_c):
    f = lambda a: jax.lax.fori_loop(0, 4, lambda k, c: c.at[k].set(a[k] + 1), unset((20, 1), jnp.float32))[:4]
    a = jnp.arange(20.0)[:, None]
    agree(run_c, f, a)
    assert "= 0.e+00f;" not in kernel.program(f, 1, a)[0].text


def test_what_has_no_place_in_a_kernel_is_named(monkeypatch):
    a = jnp.ones((5, 1))
    with pytest.raises(kernel.Unsupported, match="sort"):
        kernel.program(lambda a: jnp.sort(a, axis=0), 1, a)
    monkeypatch.setattr(emit, "MEMORY", 100)
    with pytest.raises(kernel.Unsupported, match="160 bytes"):
        kernel.program(lambda a: jax.lax.fori_loop(0, 9, lambda k, c: c.at[k].add(1), a), 1, jnp.ones((40, 1)))


# --- scenes ---


def scene(name):
    ball, cube = rbd.Sphere(0.1), rbd.Box((0.1, 0.1, 0.1))
    shapes = {
        "top": [(rbd.Box((0.1, 0.2, 0.3)), (0, 0, 0), (0, 0, 0), (1, 2, 3))],
        "ball": [(ball, (0, 0, 0.102), (1, 0, -1), (0, 0, 0))],
        "box": [(cube, (0, 0, 0.11), (1, 0, -1), (0, 1, 3))],
        "column": [(cube, (0, 0, 0.1 + 0.2 * k), (0, 0, 0), (0, 0, 0)) for k in range(2)],
        "heap": [(ball, (0.12 * (k % 3), 0.12 * (k // 3), 0.1 + 0.05 * k), (0, 0, 0), (0, 0, 0)) for k in range(6)],
        "mixed": [(ball if k % 2 else cube, (0.15 * k, 0, 0.11 + 0.02 * k), (-k, 0, 0), (0, 0, 0)) for k in range(4)],
    }[name]
    bodies = [
        rbd.Body(f"b{k}", shape, pos=pos, vel=vel, omega=omega, friction=0.5)
        for k, (shape, pos, vel, omega) in enumerate(shapes)
    ]
    if name == "top":
        return rbd.Scene(bodies, gravity=(0, 0, 0))
    return rbd.Scene(bodies, [rbd.Geom(rbd.Plane(), friction=0.5)])


@functools.cache
def built(name, method="fast"):
    model, state = rbd.build(scene(name), dt=0.004, method=method)
    turn = np.random.default_rng(0).normal(size=(5, state.n, 3)) * 0.1
    return model, rbd.batch(state, 5).replace(vel=np.asarray(state.vel) + turn)


STEPS = 12


@on_cpu
@pytest.mark.parametrize(
    "name, local",
    [
        ("top", True),
        ("ball", True),
        ("box", True),
        ("heap", True),
        ("heap", False),
        ("column", False),
        ("mixed", False),
    ],
)
def test_scenes_move_as_on_the_cpu(run_c, monkeypatch, name, local):
    if not local:
        monkeypatch.setattr(emit, "LOCAL", 0)
        kernel._program.cache_clear()
    model, state = built(name)
    want, _ = rbd.rollout(model, state, STEPS, every=STEPS)
    p, world = enter(model, with_memory(model, state), (5,))
    many = kernel._many(_advance(model.structure, model.method))
    got = run_c(many, 5, jnp.full((1,), STEPS, jnp.int32), world, p, None)
    for a, b in ((got.bodies.x, want.x), (got.bodies.v, want.v)):
        for c in "xyz":
            np.testing.assert_allclose(getattr(a, c).T, getattr(b, c), atol=2e-4 if name == "column" else 2e-5)
    assert (got.step == STEPS).all() and not np.any(got.status)
    kernel._program.cache_clear()


# --- the call ---


@pytest.fixture
def as_if_gpu(monkeypatch):
    """Programs are made as for a GPU; a stand-in for NVRTC keeps the text."""
    seen = []
    monkeypatch.setattr(kernel, "on_gpu", lambda: True)
    monkeypatch.setattr(tiles, "on_cpu", lambda: False)
    monkeypatch.setattr(kernel, "capability", lambda: "9.0")
    monkeypatch.setattr(kernel, "ptx", lambda text, capability: seen.append(text) or "// PTX")
    jax.clear_caches()
    yield seen
    jax.clear_caches()


def calls(call, *args, static=()):
    return call.trace(*args, *static).lower(lowering_platforms=("cuda",)).as_text().count(kernel.TARGET)


def test_a_rollout_is_one_call_and_so_is_a_step(as_if_gpu):
    model, state = built("ball")
    assert calls(_rollout, model, state, None, static=(50, 50, (), None)) == 1
    assert calls(_rollout, model, state, None, static=(70, 10, (), None)) == 1  # in a loop
    assert calls(_step, model, state, None) == 1
    more = jax.tree.map(lambda c: jnp.concatenate([c, c]), state)
    assert calls(_rollout, model, more, None, static=(9, 9, (), None)) == 1
    assert len(set(as_if_gpu)) == 1  # one kernel for all of them


def test_a_derivative_is_no_kernel(as_if_gpu):
    model, state = built("ball")
    loss = lambda s: rbd.rollout(model, s, 5, every=5)[0].pos.sum()
    lowered = jax.jit(jax.grad(loss, allow_int=True)).trace(state).lower(lowering_platforms=("cuda",))
    assert kernel.TARGET not in lowered.as_text()


def test_what_cannot_be_a_kernel_is_said_and_runs_without(as_if_gpu, monkeypatch):
    def refuse(*_):
        raise nvrtc.CompileError("NVRTC was not found")

    monkeypatch.setattr(kernel, "ptx", refuse)
    model, state = built("ball")
    with pytest.warns(UserWarning, match="NVRTC was not found"):
        assert calls(_step, model, state, None) == 0


def test_ptx_is_kept_beside_the_compilation_cache(tmp_path, monkeypatch):
    runs = []
    monkeypatch.setattr(nvrtc, "compiled", lambda text, capability: runs.append(text) or f"// {text} for {capability}")
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    try:
        for _ in range(3):
            nvrtc.ptx.cache_clear()  # as another process would
            assert nvrtc.ptx("a", "9.0") == "// a for 9.0"
        assert nvrtc.ptx("a", "8.0") == "// a for 8.0"
        assert runs == ["a", "a"]
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache" / next((tmp_path / "cache").iterdir())))
        nvrtc.ptx.cache_clear()
        with pytest.warns(UserWarning, match="was not written"):
            assert nvrtc.ptx("b", "9.0") == "// b for 9.0"
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        nvrtc.ptx.cache_clear()


@on_gpu
@pytest.mark.parametrize("name", ["top", "ball", "box"])
def test_on_a_gpu_it_gives_what_xla_gives(name):
    model, state = built(name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        end, traj = rbd.rollout(model, state, STEPS, every=4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel, "on_gpu", lambda: False)
        jax.clear_caches()
        want, path = rbd.rollout(model, state, STEPS, every=4)
    jax.clear_caches()
    np.testing.assert_allclose(end.pos, want.pos, atol=2e-5)
    np.testing.assert_allclose(end.vel, want.vel, atol=3e-4)
    np.testing.assert_allclose(traj.pos, path.pos, atol=2e-5)
    one, _ = rbd.rollout(model, jax.tree.map(lambda c: c[3], state), STEPS, every=STEPS)
    np.testing.assert_array_equal(one.pos, end.pos[3])  # whatever the others do
    mapped = jax.vmap(lambda s: rbd.rollout(model, s, STEPS, every=STEPS)[0])(state)
    np.testing.assert_array_equal(mapped.pos, end.pos)
    stepped = state
    for _ in range(STEPS):
        stepped = rbd.step(model, stepped)
    np.testing.assert_allclose(stepped.pos, end.pos, atol=1e-6)


@on_gpu
def test_on_a_gpu_forces_lost_worlds_and_derivatives():
    model, state = built("box")
    push = rbd.Wrench(force=np.tile([[2.0, 0, 0]], (5, 1, 1)))
    end, _ = rbd.rollout(model, state, STEPS, every=STEPS, control=push)
    free, _ = rbd.rollout(model, state, STEPS, every=STEPS)
    assert (np.asarray(end.vel - free.vel)[:, 0, 0] > 0.01).all()
    broken = state.replace(vel=np.asarray(state.vel).copy() * np.array([1, np.nan, 1, 1, 1])[:, None, None])
    lost, _ = rbd.rollout(model, broken, STEPS, every=STEPS)
    assert np.asarray(lost.status).tolist() == [0, int(rbd.Status.NOT_FINITE), 0, 0, 0]
    np.testing.assert_array_equal(np.asarray(lost.pos)[2:], np.asarray(free.pos)[2:])
    slope = jax.grad(lambda v: rbd.rollout(model, state.replace(vel=v), STEPS, every=STEPS)[0].pos[..., 0].sum())
    found = slope(jnp.asarray(state.vel))
    assert np.isfinite(found).all() and math.isclose(found[0, 0, 0], 0.048, rel_tol=0.5)
