"""Free motion: order, invariants and closed forms of every integrator; agreement with MuJoCo."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbd_jax.bodies import Bodies, Inertia
from rbd_jax.integrators import INTEGRATORS, make, matrix_to_quat, polar, rotation_maps as maps
from rbd_jax.integrators.euler_top import EulerTop
from rbd_jax.spatial import Quat, Vec3, pack

BOX = np.array([0.13, 0.10, 0.05]) / 3.0  # moments of a box of half-sizes .1 .2 .3 and 1 kg
SPIN = np.array([1.0, 2.0, 3.0])  # case A3(a)
GRAVITY = -9.81
SYMPLECTIC = ("symtop2", "symtop4", "implicit_midpoint")
MATRIX = [
    (name, {"attitude": "matrix", "orthonormalise": o})
    for name, o in (
        ("forward_euler", None),
        ("forward_euler", "gram_schmidt"),
        ("semi_implicit_euler", "polar"),
        ("backward_euler", "polar"),
    )
]
ALL = [(name, {}) for name in INTEGRATORS] + MATRIX
every = pytest.mark.parametrize("name, options", ALL, ids=[n + "".join(f"-{v}" for v in o.values()) for n, o in ALL])


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def bodies(omega, moments=BOX, v=(0.0, 0.0, 0.0), q=None, dtype=float):
    """One body a world: ``omega`` (B, 3) in the principal frame; q (B, 4), default identity."""
    omega = np.atleast_2d(omega)
    count = len(omega)
    moments = np.asarray(moments, float)
    leaf = lambda a: Vec3(*(jnp.asarray(c, dtype)[None, :] for c in np.broadcast_to(a, (count, 3)).T))
    q = np.tile([1.0, 0, 0, 0], (count, 1)) if q is None else np.atleast_2d(q)
    q = Quat(*(jnp.asarray(c, dtype)[None, :] for c in q.T))
    if moments.ndim:
        inertia = Inertia(leaf(moments))
        L = q.rotate(leaf(omega * moments))
    else:
        inertia = Inertia(jnp.full((1, 1), moments, dtype))
        L = q.rotate(leaf(omega * moments))
    return Bodies(leaf(np.zeros(3)), leaf(v), q, L), inertia


@functools.cache
def _runner(name, options):
    integrator = make(name, **dict(options))

    def run(b, inertia, h, steps, a, tau):
        if integrator.carries_matrix and b.R is None:
            b = b._with(R=b.q.mat())
        step = lambda _, c: integrator.advance(c, lambda _: (a, tau), inertia, h)
        return jax.lax.fori_loop(0, steps, step, b)

    return jax.jit(run)


def run(name, b, inertia, h, steps, a=(0.0, 0.0, GRAVITY), tau=None, **options):
    """``steps`` steps of constant a and tau; compiled once per integrator and structure."""
    vector = lambda u: None if u is None else Vec3(*jnp.asarray(u, b.x.x.dtype).reshape(3, 1, 1))
    h = jnp.asarray(h, b.x.x.dtype)
    return _runner(name, tuple(options.items()))(b, inertia, h, steps, vector(a), vector(tau))


def angle(q: Quat, matrix) -> float:
    """Angle [rad] between an attitude and a rotation matrix."""
    m = q.mat()
    m = np.stack([pack(r)[0, 0] for r in (m.a, m.b, m.c)])
    return float(2 * np.arcsin(min(1.0, np.linalg.norm(m - matrix) / np.sqrt(8))))


def energy(b, inertia):
    return 0.5 * b.L.dot(inertia.velocity(b.q, b.L))


def test_closed_form_has_the_golden_numbers():
    top = EulerTop(BOX, SPIN)
    np.testing.assert_allclose(top.rate, 1.92153784566, rtol=1e-11)
    np.testing.assert_allclose(top.modulus, 0.38, rtol=1e-12)
    np.testing.assert_allclose(top.period, 3.67184730265235, rtol=1e-13)
    np.testing.assert_allclose(top.omega_body(0.0), SPIN, rtol=1e-13)
    w = top.omega_body(2.0)
    np.testing.assert_allclose(top.matrix(2.0) @ (BOX * w), BOX * SPIN, atol=1e-15)


@every
def test_order_of_attitude(name, options):
    order = make(name, **options).order
    steps, duration = {1: (4000, 1.0), 2: (200, 2.0), 4: (30, 2.0)}[order]
    b, inertia = bodies(SPIN)
    exact = EulerTop(BOX, SPIN).matrix(duration)
    coarse, fine = (angle(run(name, b, inertia, duration / n, n, **options).q, exact) for n in (steps, 2 * steps))
    assert abs(np.log2(coarse / fine) - order) < 0.15, (coarse, fine)


class Spring:
    """A spring to a point off the centre of mass, gravity, a constant torque, optional drag."""

    constant = False

    def __init__(self, damped):
        self.damped = damped

    def __call__(self, b):
        r = b.q.rotate(Vec3(0.1, -0.2, 0.3))
        a = (b.x + r) * -4.0 + Vec3(0.0, 0.0, GRAVITY)
        tau = r.cross((b.x + r) * -0.3) + Vec3(0.01, 0.02, -0.01)
        return (a - b.v * 0.4 if self.damped else a), tau


@functools.cache
def spring_reference(damped, duration):
    from scipy.integrate import solve_ivp

    def slope(_, y):
        x, v, m, L = y[:3], y[3:6], y[6:15].reshape(3, 3), y[15:]
        r = m @ [0.1, -0.2, 0.3]
        w = m @ ((m.T @ L) / BOX)
        a = -4.0 * (x + r) + [0, 0, GRAVITY] - (0.4 * v if damped else 0.0)
        tau = np.cross(r, -0.3 * (x + r)) + [0.01, 0.02, -0.01]
        return np.concatenate([v, a, np.cross(w, m.T).T.ravel(), tau])

    y0 = np.concatenate([np.zeros(6), np.eye(3).ravel(), BOX * SPIN])
    y = solve_ivp(slope, (0, duration), y0, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    return y[:3], y[6:15].reshape(3, 3)


@pytest.mark.parametrize(
    "name, damped",
    [
        ("backward_euler", True),
        ("buss2", False),
        ("symtop2", True),
        ("symtop4", False),
        ("rk4", True),
        ("mujoco_rk4", False),
    ],
)
def test_order_under_forces_that_depend_on_the_state(name, damped):
    integrator = make(name)
    order = min(2, integrator.order) if damped and name == "symtop4" else integrator.order
    steps = {1: 1000, 2: 200, 4: 30}[order]
    b, inertia = bodies(SPIN)

    @jax.jit
    def go(h, n):
        step = lambda _, c: integrator.advance(c, Spring(damped), inertia, h)
        return jax.lax.fori_loop(0, n, step, b)

    x, m = spring_reference(damped, 1.0)
    errors = []
    for n in (steps, 2 * steps):
        end = go(1.0 / n, n)
        errors.append((np.linalg.norm(pack(end.x)[0, 0] - x), angle(end.q, m)))
    slopes = np.log2(np.array(errors[0]) / np.array(errors[1]))
    least = order - 0.2  # a composition may gain an order on one component
    assert (slopes > least).all() and slopes.min() < order + 1.2, (errors, slopes)


@pytest.mark.parametrize("name", [n for n in INTEGRATORS if not n.startswith("mujoco")])
def test_angular_momentum_is_kept(name):
    b, inertia = bodies(3 * SPIN)
    end = run(name, b, inertia, 0.1, 1000)
    for new, old in zip(jax.tree.leaves(end.L), jax.tree.leaves(b.L)):
        np.testing.assert_array_equal(new, old)


@pytest.mark.parametrize("name, bound", [("symtop4", 1e-7), ("symtop2", 2e-3), ("buss2", 2e-2)])
def test_attitude_after_24_rad(name, bound):
    b, inertia = bodies(SPIN)
    h = 0.1 / np.linalg.norm(SPIN)
    end = run(name, b, inertia, h, 240)
    assert angle(end.q, EulerTop(BOX, SPIN).matrix(240 * h)) < bound


@pytest.mark.parametrize("name", SYMPLECTIC)
def test_energy_does_not_drift_over_1000_periods(name):
    spins = np.array([SPIN, [3.0, 1.0, 0.5], [0.3, 2.0, 2.5], [2.0, -2.0, 1.0]])
    b, inertia = bodies(spins)
    integrator = make(name)
    h = 0.1 / np.linalg.norm(SPIN)
    block, count = 1400, 100  # a block is ten periods of case A3(a)

    @jax.jit
    def go(b):
        e0 = energy(b, inertia)

        def step(_, carry):
            c, worst = carry
            c = integrator.advance(c, lambda _: (None, None), inertia, h)
            return c, jnp.maximum(worst, abs(energy(c, inertia) / e0 - 1))

        def many(c, _):
            return jax.lax.fori_loop(0, block, step, (c, 0 * e0))

        return jax.lax.scan(many, b, None, length=count)[1]

    worst = np.asarray(go(b))[:, 0]
    assert block * count * h > 1000 * EulerTop(BOX, SPIN).period
    assert (worst[-10:].max(0) < 1.1 * worst[:10].max(0) + 1e-11).all(), worst[[0, -1]]


@pytest.mark.parametrize("name", SYMPLECTIC)
def test_fast_gyro(name):
    b, inertia = bodies([20.0, 0.05, 0.05])
    end = run(name, b, inertia, 5e-3, 20000)
    np.testing.assert_allclose(energy(end, inertia), energy(b, inertia), rtol=1e-3)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_parabola(name):
    b, inertia = bodies(SPIN, v=(1.0, 0.0, 5.0))
    n, h = 100, 0.01
    end = run(name, b, inertia, h, n)
    t = n * h
    off = {"forward_euler": -1, "semi_implicit_euler": 1, "backward_euler": 1, "mujoco_euler": 1}
    sign = off.get(name, 1 if name == "mujoco_implicitfast" else 0)
    expected = 5.0 * t + 0.5 * GRAVITY * t * t + sign * 0.5 * GRAVITY * h * t
    np.testing.assert_allclose(end.x.z[0, 0], expected, rtol=0, atol=2e-14)
    np.testing.assert_allclose(end.v.z[0, 0], 5.0 + GRAVITY * t, rtol=0, atol=2e-14)
    np.testing.assert_allclose(end.x.x[0, 0], t, rtol=1e-14)


def test_matrix_update_loses_orthonormality_as_predicted():
    w, h, n = np.array([0.0, 0.0, 2.0]), 0.01, 500
    b, inertia = bodies(w, moments=0.1)
    gram = lambda R: R.T @ R
    drift = gram(run("forward_euler", b, inertia, h, n, attitude="matrix", orthonormalise=None).R)
    grown = (1 + (h * 2.0) ** 2) ** n
    np.testing.assert_allclose([drift.a.x[0, 0], drift.b.y[0, 0]], grown, rtol=1e-11)
    np.testing.assert_allclose(drift.c.z[0, 0], 1.0, rtol=1e-14)
    b, inertia = bodies(SPIN)
    for name, options in MATRIX[1:]:
        kept = gram(run(name, b, inertia, h, n, **options).R)
        m = np.stack([pack(r)[0, 0] for r in (kept.a, kept.b, kept.c)])
        np.testing.assert_allclose(m, np.eye(3), atol=1e-14)


def test_quaternion_stays_unit_in_float32():
    b, inertia = bodies(SPIN[None], dtype=np.float32)
    end = run("symtop2", b, inertia, 0.02, 1_000_000)
    assert end.q.w.dtype == jnp.float32
    q = np.asarray(pack(end.q), np.float64)[0, 0]
    assert abs(np.linalg.norm(q) - 1) < 1e-6
    np.testing.assert_array_equal(pack(end.L), pack(b.L))


@pytest.mark.parametrize("name", ["mujoco_euler", "mujoco_implicitfast", "mujoco_rk4"])
def test_agrees_with_mujoco(name):
    mujoco = pytest.importorskip("mujoco")
    rng = np.random.default_rng(3)
    h, n = 0.002, 1000
    kind = {"mujoco_euler": "Euler", "mujoco_implicitfast": "implicitfast", "mujoco_rk4": "RK4"}[name]
    for turned_by_torque in (False, True):
        for _ in range(3):
            sides = rng.uniform(0.1, 0.5, 3)
            moments = (np.sum(sides**2) - sides**2) / 3
            model = mujoco.MjModel.from_xml_string(
                f"""<mujoco><option timestep="{h}" integrator="{kind}" gravity="0.3 0 {GRAVITY}"/>
                <worldbody><body><freejoint/><inertial pos="0 0 0" mass="1"
                diaginertia="{" ".join(repr(float(i)) for i in moments)}"/></body></worldbody></mujoco>"""
            )
            data = mujoco.MjData(model)
            iq, moments = model.body_iquat[1], model.body_inertia[1]
            assert iq[0] == 1.0  # MuJoCo left the frame as it was
            q, v, w = rng.normal(size=4), rng.normal(size=3), 3 * rng.normal(size=3)
            q /= np.linalg.norm(q)
            data.qpos[3:], data.qvel[:3], data.qvel[3:] = q, v, w
            force, torque = rng.normal(size=3), 0.05 * rng.normal(size=3) * turned_by_torque
            data.xfrc_applied[1] = np.concatenate([force, torque])
            b, inertia = bodies(w, moments, v, q)
            a = force + [0.3, 0, GRAVITY]
            end = run(name, b, inertia, h, n, a, torque if turned_by_torque else None)
            for _ in range(n):
                mujoco.mj_step(model, data)
            ours = np.array(pack(end.q))[0, 0]
            ours *= np.sign(ours @ data.qpos[3:])
            omega = end.q.rotate_inv(end.L) / inertia.moments
            np.testing.assert_allclose(pack(end.x)[0, 0], data.qpos[:3], rtol=0, atol=1e-10)
            np.testing.assert_allclose(ours, data.qpos[3:], rtol=0, atol=1e-10)
            np.testing.assert_allclose(pack(end.v)[0, 0], data.qvel[:3], rtol=0, atol=1e-10)
            np.testing.assert_allclose(pack(omega)[0, 0], data.qvel[3:], rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["buss2", "symtop2", "symtop4"])
def test_isotropic_and_symmetric_bodies_are_exact(name):
    from scipy.spatial.transform import Rotation

    n, h = 50, 0.3
    b, inertia = bodies(SPIN, moments=0.1)
    end = run(name, b, inertia, h, n)
    assert angle(end.q, Rotation.from_rotvec(SPIN * h * n).as_matrix()) < 1e-12
    if name == "buss2":
        return
    moments = np.array([0.1, 0.1, 0.04])
    b, inertia = bodies(SPIN, moments)
    end = run(name, b, inertia, h, n)
    precession = Rotation.from_rotvec(moments * SPIN / 0.1 * h * n)
    spin = Rotation.from_rotvec([0, 0, (1 - 0.04 / 0.1) * SPIN[2] * h * n])
    assert angle(end.q, (precession * spin).as_matrix()) < 1e-12


@pytest.mark.parametrize("dtype, bound", [(np.float32, 3e-7), (np.float64, 2e-15)])
def test_rotation_maps(dtype, bound):
    t = np.concatenate([np.linspace(-np.pi, np.pi, 1001), [0.0, 1e-30]]).astype(dtype)
    s, c = maps.half_angle(jnp.asarray(t))
    assert s.dtype == dtype
    np.testing.assert_allclose(s, np.sin(0.5 * t.astype(float)), atol=bound)
    np.testing.assert_allclose(c, np.cos(0.5 * t.astype(float)), atol=bound)
    t = np.linspace(-40, 40, 1001).astype(dtype)  # many turns: the same rotation
    s, c = maps.half_angle(jnp.asarray(t))
    s2, c2 = maps.double(s, c)
    np.testing.assert_allclose(s2, np.sin(t.astype(float)), atol=20 * bound)
    np.testing.assert_allclose(c2, np.cos(t.astype(float)), atol=20 * bound)
    unit = Vec3(*(jnp.asarray(a, dtype) for a in (0.48, -0.6, 0.64)))
    q = maps.exp(unit * jnp.asarray(t))
    half = 0.5 * t.astype(float)
    sign = np.sign(np.asarray(q.w) * np.cos(half))
    np.testing.assert_allclose(sign * q.y, -0.6 * np.sin(half), atol=20 * bound)
    np.testing.assert_allclose(pack(maps.exp(unit * jnp.asarray(0.0, dtype))), [1, 0, 0, 0])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_turn_by_nothing_has_its_second_derivative(dtype):
    """exp(t) = (1 - t.t / 8, t / 2) to second order."""
    bend = jax.hessian(lambda t: jnp.stack(jax.tree.leaves(maps.exp(Vec3(*t)))))(jnp.zeros(3, dtype))
    np.testing.assert_allclose(bend[0], -0.25 * np.eye(3), atol=1e-6)
    np.testing.assert_array_equal(bend[1:], 0.0)


def test_matrix_to_quat_and_polar():
    rng = np.random.default_rng(0)
    q = rng.normal(size=(200, 4))
    q[:4] = np.eye(4)
    q[4:10] = [[0, 1, 1, 0], [0, 0, 1, 1], [1, 1, 0, 0], [1, 1, 1, 1], [0, 1, 1, 1], [1, 0, 0, 1]]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    q = Quat(*(jnp.asarray(c)[None] for c in q.T))
    back = matrix_to_quat(q.mat(), near=q)
    np.testing.assert_allclose(pack(back), pack(q), atol=1e-15)
    bent = polar(q.mat() * 1.05)
    np.testing.assert_allclose(pack(bent.a), pack(q.mat().a), atol=1e-14)
    size = lambda q: sum(jax.tree.leaves(matrix_to_quat(q.mat()).map(lambda a: (a**3).sum())))
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(jax.jit(jax.grad(size))(q)))


@pytest.mark.parametrize("name, options", [*ALL[: len(INTEGRATORS)], MATRIX[2]])
def test_derivatives_are_finite_at_rest_and_dtype_is_kept(name, options):
    b, inertia = bodies(0 * SPIN, dtype=np.float32)
    integrator = make(name, **options)
    a, tau = Vec3(0.0, 0.0, np.float32(GRAVITY)), Vec3(*3 * (jnp.zeros((1, 1), np.float32),))

    def end(b, inertia):
        if integrator.carries_matrix:
            b = b._with(R=b.q.mat())
        return integrator.advance(b, lambda _: (a, tau), inertia, np.float32(0.01))

    @functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def derivatives(b, inertia):
        out, pull = jax.vjp(end, b, inertia)
        return out, pull(jax.tree.map(jnp.ones_like, out))

    out, gradients = derivatives(b, inertia)
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(out))
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradients))


@pytest.mark.parametrize("name", ["forward_euler", "mujoco_rk4", "rk4", "symtop2", "symtop4"])
def test_bodies_without_attitude(name):
    b, inertia = bodies(SPIN, v=(1.0, 2.0, 3.0))
    end = run(name, b._with(q=None, L=None), inertia, 0.01, 10)
    assert end.q is None and end.L is None
    with_attitude = run(name, b, inertia, 0.01, 10)
    np.testing.assert_allclose(pack(end.x), pack(with_attitude.x), atol=1e-15)


def test_kick_and_move_make_the_advance_of_contact_methods():
    b, inertia = bodies(SPIN)
    a, tau, h = (0.0, 0.0, GRAVITY), (0.01, 0.02, 0.0), 0.01
    for name in ("semi_implicit_euler", "mujoco_euler", "mujoco_implicitfast"):
        integrator = make(name)
        assert integrator.contact
        v, L = integrator.kick(b, Vec3(*a), Vec3(*tau), inertia, h)
        ours, whole = integrator.move(b, v, L, inertia, h), run(name, b, inertia, h, 1, a, tau)
        jax.tree.map(lambda p, q: np.testing.assert_allclose(p, q, atol=1e-15), ours, whole)
    assert not make("rk4").contact
    with pytest.raises(NotImplementedError, match="rk4"):
        make("rk4").move(b, b.v, b.L, inertia, h)


def operations(name, moments, tau=None):
    b, inertia = bodies(SPIN, moments)
    step = lambda b, i: make(name).advance(b, lambda _: (Vec3(0.0, 0.0, GRAVITY), tau), i, 0.01)
    return [str(e.primitive) for e in jax.make_jaxpr(step)(b, inertia).jaxpr.eqns]


def test_cost_of_the_default():
    asymmetric, isotropic = operations("symtop2", BOX), operations("symtop2", 0.1)
    assert not {"sin", "cos", "tan"} & set(asymmetric)
    assert isotropic.count("sqrt") == 1 and len(isotropic) < 110
    assert asymmetric.count("sqrt") == 1 and len(asymmetric) < 330


def test_selection_by_name():
    assert make("symtop2") == make("symtop2") and hash(make("symtop2")) == hash(make("symtop2"))
    integrator = make("forward_euler", attitude="matrix", orthonormalise="polar")
    assert integrator.carries_matrix and make(integrator) is integrator
    with pytest.raises(ValueError, match="known are .*symtop2"):
        make("verlet")
    with pytest.raises(ValueError, match="attitude"):
        make("forward_euler", attitude="euler angles")
    with pytest.raises(ValueError, match="no option"):
        make("symtop2", attitude="matrix")
    with pytest.raises(ValueError, match="orthonormalise"):
        make("forward_euler", orthonormalise="polar")
    for cls in INTEGRATORS.values():
        assert "Order" in cls.__doc__ and cls.order in (1, 2, 4)
