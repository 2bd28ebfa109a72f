"""The two convex contact solvers, on rows built by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco_pairs import GeomLaw, PairLaw, combine, law_of_pairs

import rbd_jax as rbd
from rbd_jax.bodies import Inertia
from rbd_jax.solvers import dense, joined
from rbd_jax.solvers.base import Problem
from rbd_jax.solvers.laws import NearRigid
from rbd_jax.solvers.mujoco import MujocoNewton
from rbd_jax.solvers.newton import NewtonLagged
from rbd_jax.solvers.newton_cone import NewtonCone
from rbd_jax.solvers.rows import Impulses, Index, InverseInertia, Rows
from rbd_jax.spatial import Quat, Vec3, qexp, tangent_basis

GRAVITY = 9.81
CORNERS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], float)


@pytest.fixture(autouse=True, scope="module")
def _x64():
    old = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", old)


# --- a small engine: boxes and spheres in the hot layout, rows by hand ---------------------------


def filled(value, shape, dtype):
    return Vec3(*(jnp.broadcast_to(jnp.asarray(c, dtype), shape) for c in value))


def inverse_inertia(q, inertia):
    m = inertia.moments
    if inertia.isotropic:
        return InverseInertia(1.0 / m)
    r = q.mat()
    f = lambda a, b: (a / m).dot(b)
    return InverseInertia(f(r.a, r.a), f(r.b, r.b), f(r.c, r.c), f(r.a, r.b), f(r.a, r.c), f(r.b, r.c))


def point_arms(q, half):
    """World arms of the 8 corners (8, n, B); half Vec3 (n, 1)."""
    one = lambda k: jnp.asarray(CORNERS[:, k], q.w.dtype)[:, None, None]
    local = Vec3(one(0) * half.x, one(1) * half.y, one(2) * half.z)
    return q.rotate(local)


def plane_rows(x, q, half, mu, margin=0.01, index=None, **more):
    """Every body's 8 corners against z = 0."""
    arms = point_arms(q, half)
    phi = x.z + arms.z
    shape, dtype = phi.shape[1:], phi.dtype
    return Rows(
        n=filled((0, 0, 1), shape, dtype),
        rb=arms,
        phi=phi,
        live=phi < margin,
        b=Index(np.arange(shape[0])) if index is None else index,
        mu=mu,
        **more,
    )


def stack_rows(x, q, half, mu, margin=0.01):
    """Bottom corners of body k + 1, drawn into the top face of body k, against that face."""
    n = x.z.shape[0]
    low = lambda t: jax.tree.map(lambda c: c[:-1], t)
    up = lambda t: jax.tree.map(lambda c: c[1:], t)
    keep = CORNERS[:, 2] < 0
    arms = jax.tree.map(lambda c: c[keep][:, 1:], point_arms(q, half))
    ql, hl = low(q), low(half)
    shape, dtype = x.z[1:].shape, x.z.dtype
    normal = ql.rotate(filled((0, 0, 1), shape, dtype))
    local = ql.rotate_inv(arms + up(x) - low(x))
    phi = local.z - hl.z
    clip = lambda c, limit: jnp.clip(c, -limit, limit)
    point = ql.rotate(Vec3(clip(local.x, hl.x), clip(local.y, hl.y), local.z))
    return Rows(
        n=normal,
        ra=point,
        rb=point + low(x) - up(x),
        phi=phi,
        live=phi < margin,
        a=Index(np.arange(n - 1)),
        b=Index(np.arange(1, n)),
        mu=mu,
    )


def no_warm(rows):
    z = jnp.zeros_like(rows.phi)
    entries = 1 + 2 * (rows.mu is not None) + (rows.mu_spin is not None) + 2 * (rows.mu_roll is not None)
    return Impulses(*[z] * entries)


def masked(live, tree):
    return jax.tree.map(lambda c: jnp.where(live, c, 0.0), tree)


def make_problem(rows, state, mass, inertia, h, warm=None, force=None, gyro=True):
    x, q, v, w = state
    dtype = v.x.dtype
    h = jnp.asarray(h, dtype)
    inv = inverse_inertia(q, inertia)
    L = inertia.momentum(q, w)
    ws = w + (inv @ L.cross(w)) * h if gyro else w
    acc = filled((0, 0, -GRAVITY), v.x.shape, dtype) if force is None else force
    return Problem(
        rows=tuple(rows),
        v0=v,
        v=v + acc * h,
        w0=w,
        w=ws,
        inv_mass=1.0 / mass,
        h=h,
        q=q,
        inertia=inertia,
        inv_inertia=inv,
        warm=tuple(no_warm(r) for r in rows) if warm is None else warm,
        one=jnp.ones((), dtype),
    )


def advance(problem, solution, state):
    x, q, _, _ = state
    dv, dw = dense.response(problem, solution.impulse, solution.angular_impulse)
    v, w = problem.v + dv, problem.w + dw
    return x + v * problem.h, (qexp(w * problem.h) @ q).normalised(), v, w


def box_inertia(mass, half):
    m = lambda a, b: mass / 3.0 * (a * a + b * b)
    return Inertia(Vec3(m(half.y, half.z), m(half.x, half.z), m(half.x, half.y)))


def stack_state(n, worlds, half, dtype, gap=0.0, offset=0.0):
    z = jnp.zeros((n, worlds), dtype)
    level = (jnp.arange(n, dtype=dtype)[:, None] * (2 * half + gap)) + half + gap
    k = jnp.asarray(offset * (-1.0) ** np.arange(n), dtype)[:, None]
    return Vec3(z + k, z, z + level), Quat(z + 1, z, z, z), Vec3(z, z, z), Vec3(z, z, z)


def simulate(solver, state, steps, h, mass, half, mu, stack=True, every=None):
    """Boxes on the plane z = 0 and, if ``stack``, each on the one below it. Returns state and history."""
    inertia = box_inertia(mass, half)
    n = state[0].x.shape[0]

    def make(state):
        x, q, _, _ = state
        first = lambda t: jax.tree.map(lambda c: c[:1], t)
        if stack and n > 1:
            return [plane_rows(first(x), first(q), first(half), mu, index=Index([0])), stack_rows(x, q, half, mu)]
        return [plane_rows(x, q, half, mu)]

    def step(carry, _):
        state, warm = carry
        rows = make(state)
        warm = tuple(masked(r.live, w) for r, w in zip(rows, warm))
        problem = make_problem(rows, state, mass, inertia, h, warm)
        s = solver.solve(problem)
        new = advance(problem, s, state)
        low = jnp.stack([jnp.min(jnp.where(r.live, r.phi, 1.0)) for r in rows]).min()
        worst = jnp.stack([jnp.min(c.n) for c in s.contacts]).min()
        flag = jnp.zeros(()) if s.unconverged is None else s.unconverged.mean()
        return (new, s.contacts), (new[0], new[1], new[2], low, flag, worst)

    warm = tuple(no_warm(r) for r in make(state))
    (state, _), history = jax.jit(lambda s, w: jax.lax.scan(step, (s, w), length=steps))(state, warm)
    return state, history


# --- independent evaluation of the rows ------------------------------------------------------------


def cube_half(a, n, dtype=jnp.float64):
    return Vec3(*(jnp.full((n, 1), a, dtype) for _ in range(3)))


def rows_index(index):
    return np.asarray(index.rows)[:, None] if isinstance(index, Index) else np.asarray(index)


def world_velocity(rows, v, w):
    """Relative velocity of the points as (n, t1, t2), by numpy in world axes."""
    arr = lambda a: np.stack(np.broadcast_arrays(*(np.asarray(c) for c in (a.x, a.y, a.z))), -1)
    worlds = rows.phi.shape[-1]
    column = np.arange(worlds)[None]

    def side(index, arm):
        k = np.broadcast_to(rows_index(index), (rows.phi.shape[1], worlds))
        return arr(v)[k, column] + np.cross(arr(w)[k, column], arr(arm))

    u = side(rows.b, rows.rb)
    if rows.a is not None:
        u = u - side(rows.a, rows.ra)
    return tuple((u * arr(d)).sum(-1) for d in (rows.n, *tangent_basis(rows.n)))


def final_velocity(problem, s):
    dv, dw = dense.response(problem, s.impulse, s.angular_impulse)
    return problem.v + dv, problem.w + dw


def random_boxes(rng, n, worlds, dtype=jnp.float64, speed=1.0):
    """Columns of n cubes (half 0.1) slightly turned and overlapping, moving at random."""
    half = cube_half(0.1, n, dtype)
    x, q, v, w = stack_state(n, worlds, 0.1, dtype, offset=0.01)
    r = lambda s: Vec3(*(jnp.asarray(s * rng.normal(size=(n, worlds)), dtype) for _ in range(3)))
    return (x + r(1e-3), qexp(r(0.02)), r(speed), r(2 * speed)), half


def column_problem(state, half, mass, mu, h=1 / 240):
    x, q, _, _ = state
    first = lambda t: jax.tree.map(lambda c: c[:1], t)
    rows = [plane_rows(first(x), first(q), first(half), mu, index=Index([0])), stack_rows(x, q, half, mu)]
    return make_problem(rows, state, mass, box_inertia(mass, half), h)


def dynamic_index(problem):
    """The same problem with the bodies of every pair given per world."""
    worlds = problem.v.x.shape[1]
    full = lambda i: None if i is None else jnp.broadcast_to(jnp.asarray(i.rows)[:, None], (len(i), worlds))
    return problem._with(rows=tuple(r._with(a=full(r.a), b=full(r.b)) for r in problem.rows))


def leaves_finite(tree):
    return all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(tree))


def plane_law(worlds=1, **numbers):
    pair = combine(GeomLaw(**numbers), GeomLaw(**numbers))
    return jax.tree.map(jnp.asarray, law_of_pairs([pair]))


MU = jnp.full((1, 1), 0.6)


# --- NewtonLagged ------------------------------------------------------------------------------------


@pytest.mark.parametrize("known", [False, True], ids=["load unknown", "load known"])
def test_lagged_optimality(known):
    """A converged solution of random columns obeys the laws of the module text."""
    state, half = random_boxes(np.random.default_rng(0), 3, 24)
    problem = column_problem(state, half, jnp.asarray([[2.0], [1.0], [50.0]]), MU)
    if known:
        problem = problem._with(load=tuple(jnp.abs(jnp.sin(1e3 * r.phi)) for r in problem.rows))
    model = NearRigid(push_speed=2.0)  # lower, one world of these goes round in circles and says so
    problem = problem._with(contact=model)
    solver = NewtonLagged(iterations=40)
    s = jax.jit(solver.solve)(problem)
    assert not np.asarray(s.unconverged).any()
    v, w = final_velocity(problem, s)
    slid = 0
    for rows, p in zip(problem.rows, s.contacts):
        u = world_velocity(rows, v, w)
        live = np.asarray(rows.live)
        k = np.asarray(dense.inverse_mass(dense.contacts(rows, problem), problem))
        r = model.beta**2 / (4 * np.pi**2) * k * np.maximum(live.sum(0), 1)
        vhat = -np.asarray(rows.phi) * 240
        if known:  # a bound of speed, not of load
            vhat = np.minimum(vhat, model.push_speed + r * np.abs(np.sin(1e3 * np.asarray(rows.phi))))
        else:
            slow = np.minimum(1.0, model.push_speed / np.maximum(vhat, 1e-12))
            vhat, r = vhat * slow, r * slow
        law = np.where(live, np.maximum((vhat - u[0]) / r, 0), 0)
        np.testing.assert_allclose(p.n, law, rtol=1e-7, atol=1e-8)
        # friction opposes the slip, whatever its bound
        t, ut = np.stack([p.t1, p.t2]), np.stack(u[1:])
        speed = np.hypot(*ut)
        cross = t[0] * ut[1] - t[1] * ut[0]
        size = np.hypot(*t)
        assert np.abs(cross).max() < 1e-7 * max(1.0, (size * speed).max())
        assert ((t * ut).sum(0) <= 1e-12).all()
        assert (size[~live] == 0).all() and (np.asarray(p.n) >= -1e-12).all()
        slid += (size > 1e-3).sum()
    assert slid > 50


def test_lagged_momentum_of_two_bodies():
    """The impulses on two bodies are opposite to the last bit, their moments about the origin to rounding."""
    state, half = random_boxes(np.random.default_rng(1), 2, 16)
    mass = jnp.asarray([[1.0], [30.0]])
    x, q, _, _ = state
    rows = [stack_rows(x, q, half, MU)]
    problem = make_problem(rows, state, mass, box_inertia(mass, half), 1 / 240)
    s = jax.jit(NewtonLagged().solve)(dynamic_index(problem))
    p, turn = s.impulse, s.angular_impulse
    assert float(jnp.abs(p.z).max()) > 0.1
    for c in (p.x, p.y, p.z):
        assert (np.asarray(c[0]) == -np.asarray(c[1])).all()
    total = turn + x.cross(p)
    for c in (total.x, total.y, total.z):
        np.testing.assert_allclose(c.sum(0), 0, atol=1e-13)


def column_overlap(solver, mass, h):
    """Overlap at rest of every interface of a column of cubes: beta^2/(4 pi^2) w load g h^2."""
    mass = np.asarray(mass)
    load = np.cumsum(mass[::-1], axis=0)[::-1]
    w = 4 / mass + np.r_[0 * mass[:1], 4 / mass[:-1]]
    return NearRigid().beta ** 2 / (4 * np.pi**2) * w * load * GRAVITY * np.asarray(h) ** 2


def test_lagged_column_stands():
    """Equal masses at 1/240 s, and 1:100 on top at 1/60 s with the cubes shifted by 10 mm to and fro."""
    n, solver = 5, NewtonLagged()
    mass = jnp.full((n, 2), 8.0).at[-1, 1].set(800.0)
    h = jnp.asarray([1 / 240, 1 / 60])
    half = cube_half(0.1, n)
    x, q, v, w = stack_state(n, 2, 0.1, jnp.float64, gap=5e-4, offset=0.01)
    x = x._with(x=x.x * jnp.asarray([0.0, 1.0]))
    state, history = simulate(solver, (x, q, v, w), 240, h, mass, half, MU)
    x, _, v, _ = state
    overlap = 0.2 - np.diff(np.r_[np.full((1, 2), -0.1), np.asarray(x.z)], axis=0)
    expected = column_overlap(solver, mass, h)
    np.testing.assert_allclose(overlap[:, 0], expected[:, 0], rtol=1e-4)
    np.testing.assert_allclose(overlap[:, 1], expected[:, 1], rtol=0.15)
    assert float(jnp.abs(v.z).max()) < 1e-6 and float(jnp.abs(v.x).max()) < 1e-4
    assert not np.asarray(history[4][-60:]).any()


def test_lagged_column_f32():
    n, h, solver = 5, 1 / 240, NewtonLagged()
    f32 = lambda t: jax.tree.map(lambda c: c.astype(jnp.float32), t)
    mass, half = f32(jnp.full((n, 1), 8.0).at[-1].set(80.0)), cube_half(0.1, n, jnp.float32)
    state = stack_state(n, 2, 0.1, jnp.float32, gap=5e-4, offset=0.01)
    state, history = simulate(solver, state, 480, h, mass, half, f32(MU))
    x, _, v, _ = state
    assert x.z.dtype == jnp.float32
    assert float(jnp.abs(v.z).max()) < 1e-4 and float(jnp.abs(v.x).max()) < 1e-4
    overlap = 0.2 - np.diff(np.r_[-0.1, np.asarray(x.z[:, 0])])
    assert (np.abs(overlap) < 2e-5).all()


def test_lagged_friction_on_an_incline():
    """A cube, mu = 0.5, in three worlds: held on a slope of 0.45, sliding down one of 0.6, stopping from 3 m/s."""
    solver, h, worlds = NewtonLagged(), 1 / 240, 3
    mu, mass, half = jnp.full((1, 1), 0.5), jnp.full((1, 1), 8.0), cube_half(0.1, 1)
    x, q, v, w = stack_state(1, worlds, 0.1, jnp.float64)
    state = (x, q, v._with(x=jnp.asarray([[0.0, 0.0, 3.0]])), w)
    a = np.arctan([[0.45, 0.6, 0.0]])
    force = Vec3(jnp.asarray(GRAVITY * np.sin(a)), jnp.zeros((1, worlds)), jnp.asarray(-GRAVITY * np.cos(a)))

    def step(carry, _):
        state, warm = carry
        rows = [plane_rows(state[0], state[1], half, mu)]
        problem = make_problem(rows, state, mass, box_inertia(mass, half), h, warm, force)
        s = solver.solve(problem)
        new = advance(problem, s, state)
        return (new, s.contacts), (new[0].x[0], new[2].x[0], new[0].z[0])

    warm = (no_warm(plane_rows(x, q, half, mu)),)
    (_, p), (x, speed, z) = jax.jit(lambda c: jax.lax.scan(step, c, length=240))((state, warm))
    held, slides, stops = range(3)
    assert 0 < speed[-1, held] < 20 * solver.slip_speed  # creeps
    rate = (speed[-1, slides] - speed[100, slides]) / (139 * h)
    assert rate == pytest.approx(GRAVITY * (np.sin(a[0, 1]) - 0.5 * np.cos(a[0, 1])), rel=1e-5)
    assert abs(z[-1, slides] - 0.1) < 1e-5
    np.testing.assert_allclose(np.hypot(p[0].t1, p[0].t2)[..., slides], 0.5 * p[0].n[..., slides], rtol=1e-5, atol=1e-9)
    # semi-implicit steps of a uniform deceleration fall short by v0 h / 2
    assert x[-1, stops] == pytest.approx(9 / (2 * 0.5 * GRAVITY) - 3.0 * h / 2, rel=1e-3)
    assert abs(speed[-1, stops]) < 1e-9
    # the cone holds everywhere at the end
    assert (np.hypot(p[0].t1, p[0].t2) <= 0.5 * p[0].n * (1 + 1e-6) + 1e-9).all()


def spheres(rng, worlds, mu=0.4, e=None, slots=1):
    """One sphere a world near the plane; a second, dead slot forces the general path."""
    one = lambda s=0.0, m=0.0: jnp.asarray(m + s * rng.normal(size=(1, worlds)))
    radius = 0.1
    x = Vec3(one(), one(), one(0.01, radius))
    q = Quat(one(m=1.0), one(), one(), one())
    state = (x, q, Vec3(one(1), one(1), one(1, -1)), Vec3(one(3), one(3), one(3)))
    phi = (x.z - radius)[None]
    arm = filled((0, 0, -radius), phi.shape, phi.dtype)
    rows = Rows(
        n=filled((0, 0, 1), (1, worlds), phi.dtype),
        rb=arm,
        phi=phi,
        live=phi < 0.01,
        b=Index([0]),
        mu=None if mu is None else jnp.full((1, 1), mu),
        e=e,
        central_b=True,
        law=plane_law(),
    )
    if slots == 2:
        two = lambda c: jnp.concatenate([c, c])
        rows = rows._with(
            rb=jax.tree.map(two, rows.rb), phi=two(phi), live=jnp.concatenate([rows.live, jnp.zeros_like(rows.live)])
        )
    return rows, state


@pytest.mark.parametrize("mu, e", [(0.4, None), (None, None), (0.4, 0.7)])
def test_lagged_closed_form(mu, e):
    """A single sphere contact by its closed form and by the Newton iteration."""
    mass, inertia = jnp.full((1, 1), 3.0), Inertia(jnp.full((1, 1), 0.4 * 3.0 * 0.01))
    e = None if e is None else jnp.full((1, 1), e)
    out = []
    for slots in (1, 2):
        rows, state = spheres(np.random.default_rng(3), 64, mu, e, slots)
        problem = make_problem([rows], state, mass, inertia, 1 / 240)
        solver = NewtonLagged(iterations=12, slip_speed=1e-10, slip_compliance=1e-7, event_beta=1e-4)
        out.append(jax.jit(solver.solve)(problem))
    assert out[0].unconverged is None and not np.asarray(out[1].unconverged).any()
    for a, b in zip(jax.tree.leaves(out[0].contacts), jax.tree.leaves(out[1].contacts)):
        np.testing.assert_allclose(a[0], b[0], atol=3e-6)
    assert np.asarray(out[0].contacts[0].n).max() > 1


@pytest.mark.parametrize("boxes", [False, True])
def test_lagged_restitution_reaches_its_target(boxes):
    from rbd_jax.solvers.restitution import targets

    e = jnp.full((1, 1), 0.8)
    if boxes:
        half, mass = cube_half(0.1, 1), jnp.full((1, 1), 8.0)
        x, q, v, w = stack_state(1, 1, 0.1, jnp.float64)
        state = (x._with(z=x.z + 0.004), q, v._with(z=v.z - 2.0), w)
        rows = plane_rows(state[0], q, half, MU, margin=0.02, e=e)
        problem = make_problem([rows], state, mass, box_inertia(mass, half), 1 / 240)
    else:
        rows, state = spheres(np.random.default_rng(5), 64, 0.4, e)
        mass = jnp.full((1, 1), 3.0)
        problem = make_problem([rows], state, mass, Inertia(jnp.full((1, 1), 0.012)), 1 / 240)
    events = targets(rows, problem)
    assert np.asarray(events.active).any()
    v, w = final_velocity(problem, NewtonLagged().solve(problem))
    u = world_velocity(rows, v, w)[0]
    active = np.asarray(events.active)
    np.testing.assert_allclose(u[active], np.asarray(events.vhat)[active], rtol=1e-4)


# --- both solvers ------------------------------------------------------------------------------------


def tumbling(worlds=4, dtype=jnp.float64, mu=0.5, height=0.0):
    rng = np.random.default_rng(7)
    half = Vec3(*(jnp.full((1, 1), a, dtype) for a in (0.1, 0.15, 0.05)))
    mass = jnp.full((1, 1), 6.0, dtype)
    one = lambda s, m=0.0: jnp.asarray(m + s * rng.normal(size=(1, worlds)), dtype)
    x = Vec3(one(0), one(0), one(1e-3, 0.05 + height))
    turn, v, w = Vec3(one(0.02), one(0.02), one(1)), Vec3(one(1), one(1), one(0.3, -0.3)), Vec3(one(1), one(1), one(1))
    state = (x, qexp(turn), v, w)
    mu = None if mu is None else jnp.full((1, 1), mu, dtype)
    law = jax.tree.map(lambda c: c if c.dtype == bool else c.astype(dtype), plane_law())

    def make(state, mu=mu, mass=mass):
        rows = plane_rows(state[0], state[1], half, mu, law=law)
        return make_problem([rows], state, mass, box_inertia(mass, half), 1 / 240)

    return state, make, mu, mass


SOLVERS = [NewtonLagged(), MujocoNewton()]
by_name = pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: s.name)


@by_name
def test_gradient(solver):
    """Against central differences in f64, and forward against reverse mode."""
    state, make, mu, mass = tumbling()
    if solver.name == "newton_lagged":  # smooth enough for a difference quotient
        solver = NewtonLagged(slip_speed=1e-2)
    c = np.random.default_rng(0).normal(size=(6, 1, 4))
    leaves, tree = jax.tree.flatten((state, mu, mass))
    rng = np.random.default_rng(1)
    way = jax.tree.unflatten(tree, [jnp.asarray(rng.normal(size=x.shape)) for x in leaves])

    def loss(args):
        s = solver.solve(make(*args))
        f, t = s.impulse, s.angular_impulse
        return sum((k * x).sum() for k, x in zip(c, (f.x, f.y, f.z, t.x, t.y, t.z)))

    args = (state, mu, mass)
    derivatives = jax.jit(lambda a, w: (jax.grad(loss)(a), jax.jvp(loss, (a,), (w,))))
    g, (_, forward) = derivatives(args, way)
    slope = sum((a * b).sum() for a, b in zip(jax.tree.leaves(g), jax.tree.leaves(way)))
    d = 1e-6
    go = lambda s: derivatives(jax.tree.map(lambda a, b: a + s * b, args, way), way)[1][0]
    assert leaves_finite(g)
    np.testing.assert_allclose(slope, forward, rtol=1e-9)
    np.testing.assert_allclose(slope, (go(d) - go(-d)) / (2 * d), rtol=2e-5)


@by_name
@pytest.mark.parametrize("mu", [MU, None], ids=["friction", "frictionless"])
def test_finite_at_the_edges(solver, mu):
    """Values and gradients where nothing slips or overlaps (world 0) and where nothing is live (world 1)."""
    half, mass, law = cube_half(0.1, 1), jnp.full((1, 1), 8.0), plane_law()
    x, q, v, w = stack_state(1, 2, 0.1, jnp.float64)
    x = x._with(z=x.z + jnp.asarray([0.0, 1.0]))

    def loss(state, h, mu):
        rows = plane_rows(state[0], state[1], half, mu, law=law)
        s = solver.solve(make_problem([rows], state, mass, box_inertia(mass, half), h))
        return (s.impulse.z + s.impulse.x + s.angular_impulse.x).sum() + s.contacts[0].n.sum(), s

    args = ((x, q, v, w), jnp.asarray(1 / 240), mu)
    (_, s), g = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True))(*args)
    assert leaves_finite(s) and leaves_finite(g)
    assert s.impulse.z[0, 1] == 0.0
    if solver.name == "newton_lagged":
        np.testing.assert_allclose(s.impulse.z[0, 0], 8 * GRAVITY / 240, rtol=1e-2)


def test_mujoco_f32_close_to_f64():
    solver, out = MujocoNewton(), []
    for dtype in (jnp.float32, jnp.float64):
        state, make, _, _ = tumbling(16, dtype)
        s = jax.jit(solver.solve)(make(state))
        assert s.impulse.x.dtype == dtype
        out.append(s)
    a, b = (np.asarray(s.impulse.z, float) for s in out)
    np.testing.assert_allclose(a, b, atol=2e-3 * np.abs(b).max())


@by_name
def test_rows_without_friction_or_attitude(solver):
    """The reduced rows give what the full rows give: a frictionless sphere needs no attitude."""
    mass, inertia = jnp.full((1, 1), 3.0), Inertia(jnp.full((1, 1), 0.012))
    rows, state = spheres(np.random.default_rng(3), 16, None)
    full = make_problem([rows], state, mass, inertia, 1 / 240)
    a = jax.jit(solver.solve)(full)
    b = jax.jit(solver.solve)(full._with(w0=None, w=None, q=None, inertia=None, inv_inertia=None))
    assert b.angular_impulse is None and not np.asarray(a.angular_impulse.x).any()
    np.testing.assert_allclose(a.impulse.z, b.impulse.z, rtol=1e-12)
    # two such spheres touching each other
    pair = rows._with(a=Index([0]), b=Index([1]), ra=rows.rb * -1.0, central_a=True)
    two = lambda t: jax.tree.map(lambda c: jnp.concatenate([c, -c]), t)
    x, q, v, w = state
    state = (two(x), two(q), two(v * -1.0), two(w))
    full = make_problem([pair], state, jnp.ones((2, 1)), Inertia(jnp.full((2, 1), 0.012)), 1 / 240)
    a = jax.jit(solver.solve)(full)
    b = jax.jit(solver.solve)(full._with(w0=None, w=None, q=None, inertia=None, inv_inertia=None))
    assert (np.asarray(a.impulse.z) == -np.asarray(a.impulse.z)[::-1]).all() and np.asarray(a.impulse.z).any()
    np.testing.assert_allclose(a.impulse.z, b.impulse.z, rtol=1e-10)


def test_kinematic_partner_drags_by_friction():
    """A surface moving at 1 m/s pulls a resting cube with mu g."""
    half, mass = cube_half(0.1, 1), jnp.full((1, 1), 8.0)
    state = stack_state(1, 1, 0.1, jnp.float64)
    rows = plane_rows(state[0], state[1], half, MU)
    rows = rows._with(surface=filled((1.0, 0, 0), rows.phi.shape, jnp.float64))
    problem = make_problem([rows], state, mass, box_inertia(mass, half), 1 / 240)
    s = NewtonLagged(iterations=10).solve(problem)
    np.testing.assert_allclose(s.impulse.x, 0.6 * s.impulse.z, rtol=0.05)


# --- MuJoCo ------------------------------------------------------------------------------------------

mujoco = pytest.importorskip("mujoco")

OPTION = '<option cone="elliptic" jacobian="dense" solver="Newton" tolerance="0" iterations="100" {}/>'


def random_scene(rng, touch=True, condims=(1, 3, 3)):
    """XML of a plane, a static box and four random bodies; ``touch``: piled up, else side by side."""
    u = rng.uniform

    def law():
        friction = f"{u(0.1, 1.2):.3f} {10 ** u(-4, -1):.6f} {10 ** u(-5, -2):.6f}"
        s = f'friction="{friction}" condim="{rng.choice(condims)}" solmix="{u(0.2, 3):.3f}" '
        s += f'priority="{rng.choice([0, 0, 0, 1])}" '
        s += f'solimp="{u(0.6, 0.9):.3f} {u(0.9, 0.99):.3f} {u(0.002, 0.05):.4f} {u(0.2, 0.8):.2f} {u(1, 3):.2f}" '
        if rng.random() < 0.3:
            return s + f'solref="{-u(500, 3000):.1f} {-u(20, 80):.1f}" '
        return s + f'solref="{u(0.002, 0.05):.4f} {u(0.3, 1.5):.2f}" margin="{u(0, 0.01):.4f}" gap="{u(0, 0.005):.4f}" '

    bodies = ""
    for k in range(4):
        q = rng.normal(size=4)
        if rng.random() < 0.5:
            shape = f'type="sphere" size="{u(0.1, 0.2):.3f}"'
        else:
            shape = f'type="box" size="{u(0.1, 0.2):.3f} {u(0.1, 0.2):.3f} {u(0.1, 0.2):.3f}"'
            if rng.random() < 0.5:
                q = np.array([1, 0, 0, 0]) + 1e-2 * q
        away, up = (0.0, 0.2 * k) if touch else (0.4 * k, 0.0)
        pos = f"{u(-0.15, 0.15) + away:.3f} {u(-0.15, 0.15):.3f} {u(0.1, 0.15) + up:.3f}"
        bodies += f'<body pos="{pos}" quat="{" ".join(map(str, q))}"><freejoint/>'
        bodies += f'<geom {shape} mass="{10 ** u(-1, 2):.4f}" conaffinity="{int(touch)}" {law()}/></body>'
    option = OPTION.format(f'impratio="{10 ** u(0, 1.5):.3f}" timestep="{u(0.001, 0.01):.4f}"')
    return (
        f'<mujoco>{option}<worldbody><geom type="plane" size="5 5 1" {law()}/>'
        f'<geom type="box" size=".1 .1 .1" pos=".3 0 .05" {law()}/>{bodies}</worldbody></mujoco>'
    )


def geom_law(m, g):
    return GeomLaw(
        friction=m.geom_friction[g, 0],
        solref=tuple(m.geom_solref[g]),
        solimp=tuple(m.geom_solimp[g]),
        margin=m.geom_margin[g],
        gap=m.geom_gap[g],
        solmix=m.geom_solmix[g],
        priority=int(m.geom_priority[g]),
        condim=int(m.geom_condim[g]),
        torsional=m.geom_friction[g, 1],
        rolling=m.geom_friction[g, 2],
    )


def mujoco_problem(m, d, pairs=(12, 24), dtype=jnp.float64, angular_rows=False):
    """One-world Problem of MuJoCo's own contact list, padded to (static, dynamic) pairs of bodies
    given by arrays, and the contact numbers of every group; ``angular_rows``: with torsional and rolling friction."""
    n = m.nbody - 1
    arr = lambda a: Vec3(*(jnp.asarray(np.asarray(a)[:, k : k + 1], dtype) for k in range(3)))
    quat = np.zeros((n, 4))  # of the principal frame
    for k in range(n):
        mujoco.mju_mat2Quat(quat[k], d.ximat[k + 1])
    q = Quat(*(jnp.asarray(quat[:, k : k + 1], dtype) for k in range(4)))
    qvel = d.qvel.reshape(n, 6)
    omega = np.einsum("nij,nj->ni", d.xmat[1:].reshape(n, 3, 3), qvel[:, 3:])
    vel = qvel[:, :3] + np.cross(omega, d.xipos[1:] - d.xpos[1:])
    groups = [[], []]
    for k, c in enumerate(d.contact):
        if c.efc_address < 0:
            continue
        b1, b2 = (int(m.geom_bodyid[g]) for g in c.geom)
        groups[b1 != 0 and b2 != 0].append((k, b1 - 1, b2 - 1, 1.0) if b2 else (k, b2 - 1, b1 - 1, -1.0))
    rows = []
    for dynamic, (items, size) in enumerate(zip(groups, pairs)):
        assert len(items) <= size
        if not size:
            continue
        pad = size - len(items)
        cs = [d.contact[i] for i, *_ in items]
        a = np.array([x[1] for x in items] + [0] * pad, np.int32)
        b = np.array([x[2] for x in items] + [0] * pad, np.int32)
        fill = lambda values, zero, pad=pad: np.array(list(values) + [zero] * pad, float)
        normal = fill([item[3] * c.frame[:3] for item, c in zip(items, cs)], np.array([0, 0, 1.0]))
        pos = fill([c.pos for c in cs], np.zeros(3))
        laws = [combine(*(geom_law(m, g) for g in c.geom)) for c in cs]
        laws += [PairLaw(1.0, (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0), 0.0, 0.0, 3)] * pad
        law = jax.tree.map(lambda x: jnp.asarray(x, dtype), law_of_pairs(laws, impratio=m.opt.impratio))
        law = law._with(condim=jnp.asarray([[p.condim] for p in laws]))
        angular = {}
        if angular_rows:
            angular = {f"mu_{k}": jnp.asarray([[v] for v in c], dtype) for k, c in (
                ("spin", [p.torsional for p in laws]), ("roll", [p.rolling for p in laws]))}  # fmt: skip
        slot = lambda v: jax.tree.map(lambda leaf: leaf[None], arr(v))
        rows.append(
            Rows(
                n=arr(normal),
                phi=jnp.asarray(fill([c.dist for c in cs], 0.0), dtype)[None, :, None],
                live=jnp.asarray(np.arange(size) < len(items))[None, :, None],
                law=law,
                rb=slot(pos - d.xipos[b + 1]),
                b=jnp.asarray(b)[:, None],
                ra=slot(pos - d.xipos[a + 1]) if dynamic else None,
                a=jnp.asarray(a)[:, None] if dynamic else None,
                mu=jnp.asarray([[p.friction] for p in laws], dtype),
                **angular,
            )
        )
    state = (arr(d.xipos[1:]), q, arr(vel), arr(omega))
    mass = jnp.asarray(m.body_mass[1:, None], dtype)
    problem = make_problem(rows, state, mass, Inertia(arr(m.body_inertia[1:])), np.array([m.opt.timestep]))
    return problem, [[i for i, *_ in g] for g, size in zip(groups, pairs) if size]


def batch_problems(problems):
    """Worlds side by side; the scalar ``one`` stays."""
    joined = jax.tree.map(lambda *c: jnp.concatenate(c, axis=-1) if c[0].ndim else c[0], *problems)
    return joined


def mujoco_forces(m, d, ids):
    """World contact forces on the second geom's body."""
    out = []
    for k in ids:
        f = np.zeros(6)
        mujoco.mj_contactForce(m, d, k, f)
        out.append(d.contact[k].frame.reshape(3, 3).T @ f[:3])
    return np.array(out).reshape(-1, 3)


def mujoco_state(rng, xml):
    m = mujoco.MjModel.from_xml_string(xml)
    d = mujoco.MjData(m)
    d.qvel[:] = rng.normal(size=m.nv) * rng.choice([0.1, 1.0, 5.0])
    mujoco.mj_forward(m, d)
    return m, d


def assert_same_forces(cases, problem, solution, ids_of):
    h = np.asarray(problem.h)
    for world, ((m, d), ids) in enumerate(zip(cases, ids_of)):
        size = max(np.abs(d.efc_force).max(), 1.0) if d.nefc else 1.0
        col = lambda a, n, world=world: np.stack([np.asarray(c)[:n, world] for c in (a.x, a.y, a.z)], -1)
        flat = lambda c, n, world=world: np.asarray(c)[0, :n, world, None] / h[world]
        for rows, p, group in zip(problem.rows, solution.contacts, ids):
            n = len(group)
            if not n:
                continue
            t1, t2 = rows.tangents
            ours = col(rows.n, n) * flat(p.n, n) + col(t1, n) * flat(p.t1, n) + col(t2, n) * flat(p.t2, n)
            theirs = mujoco_forces(m, d, group)
            sign = np.sign((theirs * ours).sum(-1, keepdims=True))
            normal = np.array([d.contact[k].frame[:3] for k in group])
            assert (sign * (normal * col(rows.n, n)).sum(-1, keepdims=True) >= 0).all()
            np.testing.assert_allclose(ours, np.where(sign < 0, -1, 1) * theirs, atol=1e-8 * size)
        # every body's acceleration, spin included
        dv, dw = dense.response(problem, solution.impulse, solution.angular_impulse)
        rot = d.xmat[1:].reshape(-1, 3, 3)
        extra = (d.qacc - d.qacc_smooth).reshape(-1, 6)
        want = np.concatenate([extra[:, :3], np.einsum("nij,nj->ni", rot, extra[:, 3:])], 1)
        got = np.stack([np.asarray(c)[:, world] for c in (dv.x, dv.y, dv.z, dw.x, dw.y, dw.z)], -1) / h[world]
        np.testing.assert_allclose(got, want, atol=1e-8 * max(1.0, np.abs(want).max()))


@pytest.mark.parametrize("condims", [(1, 3, 3), (1, 3, 4, 6)], ids=["sliding", "torsion and rolling"])
@pytest.mark.parametrize("bodies_touch", [True, False])
def test_mujoco_forces(bodies_touch, condims):
    """Random spheres and boxes, contact by contact, against ``mj_forward`` (MuJoCo 4.0.1)."""
    cases, problems, ids = [], [], []
    for seed in range(48 if bodies_touch else 24):
        rng = np.random.default_rng(seed)
        xml, pairs = random_scene(rng, bodies_touch, condims), (32, 48 if bodies_touch else 0)
        m, d = mujoco_state(rng, xml)
        problem, group = mujoco_problem(m, d, pairs, angular_rows=6 in condims)
        cases.append((m, d)), problems.append(problem), ids.append(group)
    problem = batch_problems(problems)
    solution = jax.jit(MujocoNewton().solve)(problem)
    assert not np.asarray(solution.unconverged).any()
    assert sum(d.ncon for _, d in cases) > 3 * len(cases)
    assert_same_forces(cases, problem, solution, ids)


def test_mujoco_law_numbers():
    """combine(), impedance and reference against MuJoCo's compiled contacts and efc arrays."""
    from rbd_jax.solvers import mujoco as module

    seen = set()
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        m, d = mujoco_state(rng, random_scene(rng, condims=(1, 1, 1, 3, 4, 6)))
        problem, ids = mujoco_problem(m, d, (32, 48), angular_rows=True)
        for rows, group in zip(problem.rows, ids):
            law = module._law(dense.contacts(rows, problem), rows, problem)
            for k, c in enumerate(d.contact[i] for i in group):
                pair = combine(*(geom_law(m, g) for g in c.geom))
                five = [pair.friction] * 2 + [pair.torsional] + [pair.rolling] * 2
                assert pair.condim == c.dim and five == pytest.approx(c.friction, abs=1e-15)
                assert pair.margin == pytest.approx(c.includemargin, abs=1e-15)
                np.testing.assert_allclose(pair.solref, c.solref, rtol=1e-14)
                np.testing.assert_allclose(pair.solimp, c.solimp, rtol=1e-14)
                row = c.efc_address
                np.testing.assert_allclose(law.dn[0, k, 0], d.efc_D[row], rtol=1e-10)
                reference = np.asarray(law.reference.n[0, k, 0]) / m.opt.timestep
                np.testing.assert_allclose(reference, d.efc_aref[row], rtol=1e-9, atol=1e-9)
                stiffness = [law.dt, law.dt, law.ds, law.dr, law.dr][: c.dim - 1]
                np.testing.assert_allclose([x[0, k, 0] for x in stiffness], d.efc_D[row + 1 : row + c.dim], rtol=1e-10)
                seen.add((c.dim, bool(c.solref[0] > 0)))
    assert len(seen) == 8  # all dimensions, both formats of solref
    assert combine(GeomLaw(), GeomLaw(), {"friction": 0.3}).friction == 0.3
    with pytest.raises(ValueError, match="unknown fields"):
        combine(GeomLaw(), GeomLaw(), {"fiction": 0.3})


def test_mujoco_bouncing_sphere():
    """1000 steps of a spinning ball with friction, MuJoCo's Euler: 1e-6."""
    law = 'friction=".4 0 0" solref=".02 .2"'
    xml = f"""<mujoco>{OPTION.format('impratio="2"')}<worldbody><geom type="plane" size="5 5 1" {law}/>
      <body pos="0 0 .5"><freejoint/><geom type="sphere" size=".1" {law}/></body></worldbody></mujoco>"""
    m = mujoco.MjModel.from_xml_string(xml)
    d = mujoco.MjData(m)
    d.qvel[:] = [1, 0.5, 0, 3, -8, 5]
    pair = combine(geom_law(m, 0), geom_law(m, 1))
    law = jax.tree.map(jnp.asarray, law_of_pairs([pair], impratio=2.0))
    mass, inertia = jnp.full((1, 1), m.body_mass[1]), Inertia(jnp.full((1, 1), m.body_inertia[1, 0]))
    o = jnp.zeros((1, 1))
    state = (Vec3(o, o, o + 0.5), Quat(o + 1, o, o, o), Vec3(o + 1, o + 0.5, o), Vec3(o + 3, o - 8, o + 5))
    solver = MujocoNewton()

    def step(carry, _):
        state, warm = carry
        phi = (state[0].z - 0.1)[None]
        z = jnp.zeros_like(phi)
        rows = Rows(
            n=filled((0, 0, 1), (1, 1), phi.dtype),
            rb=Vec3(z, z, -0.1 - 0.5 * phi),
            phi=phi,
            live=phi < 0,
            b=Index([0]),
            mu=jnp.full((1, 1), 0.4),
            law=law,
            central_b=True,
        )
        problem = make_problem([rows], state, mass, inertia, m.opt.timestep, warm)
        s = solver.solve(problem)
        new = advance(problem, s, state)
        return (new, s.contacts), (new, s.unconverged)

    z = jnp.zeros((1, 1, 1))
    _, ((x, _, v, w), flags) = jax.jit(lambda c: jax.lax.scan(step, c, length=1000))((state, (Impulses(z, z, z),)))
    assert not np.asarray(flags).any()
    ours = np.stack([np.asarray(c)[:, 0, 0] for c in (x.x, x.y, x.z, v.x, v.y, v.z, w.x, w.y, w.z)], -1)
    theirs = []
    for _ in range(1000):
        mujoco.mj_step(m, d)
        spin = d.qvel[3:]
        theirs.append(np.r_[d.qpos[:3], d.qvel[:3], spin])
    # MuJoCo's spin is in body axes: compare its length, and world axes at the end
    theirs = np.array(theirs)
    np.testing.assert_allclose(ours[:, :6], theirs[:, :6], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(ours[:, 6:], axis=1), np.linalg.norm(theirs[:, 6:], axis=1), atol=1e-6)
    end = np.zeros(9)
    mujoco.mju_quat2Mat(end, d.qpos[3:])
    np.testing.assert_allclose(ours[-1, 6:], end.reshape(3, 3) @ d.qvel[3:], atol=1e-6)
    assert (theirs[:, 2] < 0.1).sum() > 100


# --- groups that are solved as one ---------------------------------------------------------------


def mixed():
    """Boxes and balls on and beside each other: five kinds of pairs, which all touch."""
    box, ball = rbd.Box((0.1,) * 3), rbd.Sphere(0.1)
    bodies = [
        rbd.Body("low", box, pos=(0, 0, 0.0995), vel=(0.3, 0, 0), omega=(0, 0, 0.5)),
        rbd.Body("high", box, pos=(0.03, 0.01, 0.299)),
        rbd.Body("left", ball, pos=(-0.199, 0, 0.0995), vel=(0.1, 0.2, 0)),
        rbd.Body("far", ball, pos=(-0.398, 0, 0.0995)),
    ]
    return rbd.Scene(bodies, [rbd.Plane()], dt=1 / 240)


@pytest.mark.parametrize("solver", [NewtonCone(30), NewtonLagged(polish=9)], ids=["cone", "lagged"])
def test_groups_solved_as_one_are_solved_as_they_are_alone(solver, monkeypatch):
    model, state = rbd.build(mixed(), method=rbd.Method("symtop2", "near_rigid", solver))
    assert len(model.structure.groups) == 5

    def step(vel, state):
        after = rbd.rollout(model, state.replace(vel=vel), 1)[0]
        return (after.vel**2).sum() + (after.omega**2).sum(), (after.memory.contacts, after.status)

    def of(kind):
        monkeypatch.setattr(joined, "_kind", kind)
        jax.clear_caches()
        (_, (contacts, status)), slope = jax.jit(jax.value_and_grad(step, has_aux=True))(state.vel, state)
        assert not status.any()
        return contacts, slope

    of_kind, count = joined._kind, []
    together = of(lambda *args: count.append(of_kind(*args)) or count[-1])
    assert 0 < len(set(count)) < 5
    alone = of(lambda number, *_: number)
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9)
    assert all(np.abs(c.n).max() > 0 for c in together[0])


@pytest.mark.parametrize("worlds", [1, 3])
def test_a_system_that_is_not_symmetric_is_solved(worlds):
    h = jax.random.normal(jax.random.key(0), (worlds, 18, 18))
    b = jax.random.normal(jax.random.key(1), (worlds, 18))
    solved = jax.jit(jax.value_and_grad(lambda h, b: (dense._dense_general_solve(h, b) ** 2).sum(), argnums=(0, 1)))
    value, slopes = solved(h, b)
    x = np.linalg.solve(h, b[..., None])
    np.testing.assert_allclose(value, (x**2).sum(), rtol=1e-9)
    db = np.linalg.solve(np.swapaxes(h, 1, 2), 2 * x)
    np.testing.assert_allclose(slopes[1], db[..., 0], rtol=1e-8)
    np.testing.assert_allclose(slopes[0], -db * np.swapaxes(x, 1, 2), rtol=1e-8)
