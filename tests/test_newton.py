"""The two convex contact solvers, on rows built by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbd_jax.bodies import Inertia
from rbd_jax.solvers import dense
from rbd_jax.solvers.base import Problem
from rbd_jax.solvers.newton import NewtonLagged
from rbd_jax.solvers.rows import Impulses, Index, InverseInertia, Rows
from rbd_jax.spatial import Quat, Vec3, qexp, safe_norm, vec3

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
        n=filled((0, 0, 1), shape, dtype), rb=arms, phi=phi, live=phi < margin,
        b=Index(np.arange(shape[0])) if index is None else index, mu=mu, **more,
    )


def stack_rows(x, q, half, mu, margin=0.01):
    """Bottom corners of body k + 1 against the top face of body k."""
    n = x.z.shape[0]
    low = lambda t: jax.tree.map(lambda c: c[:-1], t)
    up = lambda t: jax.tree.map(lambda c: c[1:], t)
    keep = CORNERS[:, 2] < 0
    arms = jax.tree.map(lambda c: c[keep][:, 1:], point_arms(q, half))
    ql, hl = low(q), low(half)
    shape, dtype = x.z[1:].shape, x.z.dtype
    normal = ql.rotate(filled((0, 0, 1), shape, dtype))
    point = arms + up(x) - low(x)
    local = ql.rotate_inv(point)
    phi = local.z - hl.z
    inside = (jnp.abs(local.x) <= hl.x * (1 + 1e-6)) & (jnp.abs(local.y) <= hl.y * (1 + 1e-6))
    return Rows(
        n=normal, ra=point, rb=arms, phi=phi, live=(phi < margin) & inside,
        a=Index(np.arange(n - 1)), b=Index(np.arange(1, n)), mu=mu,
    )


def no_warm(rows):
    z = jnp.zeros_like(rows.phi)
    return Impulses(z) if rows.mu is None else Impulses(z, z, z)


def make_problem(rows, state, mass, inertia, h, warm=None, force=None, gyro=True):
    x, q, v, w = state
    dtype = v.x.dtype
    h = jnp.asarray(h, dtype)
    inv = inverse_inertia(q, inertia)
    L = inertia.momentum(q, w)
    ws = w + (inv @ L.cross(w)) * h if gyro else w
    acc = filled((0, 0, -GRAVITY), v.x.shape, dtype) if force is None else force
    return Problem(
        rows=tuple(rows), v0=v, v=v + acc * h, w0=w, w=ws, inv_mass=1.0 / mass, h=h, q=q, inertia=inertia,
        inv_inertia=inv, warm=tuple(no_warm(r) for r in rows) if warm is None else warm, one=jnp.ones((), dtype),
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
        warm = tuple(jax.tree.map(lambda c: jnp.where(r.live, c, 0.0), w) for r, w in zip(rows, warm))
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


# --- MuJoCo ------------------------------------------------------------------------------------------

mujoco = pytest.importorskip("mujoco")

OPTION = '<option cone="elliptic" jacobian="dense" solver="Newton" tolerance="0" iterations="100" {}/>'


def random_scene(rng, bodies_count=4):
    """XML of a plane, a static box and a few random bodies close to each other."""
    u = rng.uniform

    def law():
        s = f'friction="{u(0.1, 1.2):.3f} 0 0" condim="{rng.choice([1, 3, 3])}" solmix="{u(0.2, 3):.3f}" '
        s += f'priority="{rng.choice([0, 0, 0, 1])}" '
        s += f'solimp="{u(.6, .9):.3f} {u(.9, .99):.3f} {u(.002, .05):.4f} {u(.2, .8):.2f} {u(1, 3):.2f}" '
        if rng.random() < 0.3:
            return s + f'solref="{-u(500, 3000):.1f} {-u(20, 80):.1f}" '
        return s + f'solref="{u(.002, .05):.4f} {u(.3, 1.5):.2f}" margin="{u(0, .01):.4f}" gap="{u(0, .005):.4f}" '

    bodies = ""
    for k in range(bodies_count):
        q = rng.normal(size=4)
        if rng.random() < 0.5:
            shape = f'type="sphere" size="{u(.1, .2):.3f}"'
        else:
            shape = f'type="box" size="{u(.1, .2):.3f} {u(.1, .2):.3f} {u(.1, .2):.3f}"'
            if rng.random() < 0.5:
                q = np.array([1, 0, 0, 0]) + 1e-2 * q
        pos = f"{u(-.15, .15):.3f} {u(-.15, .15):.3f} {u(.1, .15) + .2 * k:.3f}"
        bodies += f'<body pos="{pos}" quat="{" ".join(map(str, q))}"><freejoint/>'
        bodies += f'<geom {shape} mass="{10 ** u(-1, 2):.4f}" {law()}/></body>'
    option = OPTION.format(f'impratio="{10 ** u(0, 1.5):.3f}" timestep="{u(.001, .01):.4f}"')
    return (
        f'<mujoco>{option}<worldbody><geom type="plane" size="5 5 1" {law()}/>'
        f'<geom type="box" size=".1 .1 .1" pos=".3 0 .05" {law()}/>{bodies}</worldbody></mujoco>'
    )


def geom_law(m, g):
    from rbd_jax.solvers.mujoco_law import GeomLaw

    return GeomLaw(
        friction=m.geom_friction[g, 0], solref=tuple(m.geom_solref[g]), solimp=tuple(m.geom_solimp[g]),
        margin=m.geom_margin[g], gap=m.geom_gap[g], solmix=m.geom_solmix[g], priority=int(m.geom_priority[g]),
        condim=int(m.geom_condim[g]),
    )


def mujoco_problem(m, d, pairs=(12, 24), dtype=jnp.float64):
    """One-world Problem of MuJoCo's own contact list, padded to (static, dynamic) pairs of bodies
    given by arrays, and the contact numbers of every group."""
    from rbd_jax.solvers.mujoco_law import PairLaw, combine, law_of_pairs

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
        b1, b2 = (m.geom_bodyid[g] for g in c.geom)
        groups[b1 != 0 and b2 != 0].append((k, b1 - 1, b2 - 1, 1.0) if b2 else (k, b2 - 1, b1 - 1, -1.0))
    rows = []
    for dynamic, (items, size) in enumerate(zip(groups, pairs)):
        assert len(items) <= size
        if not size:
            continue
        pad = size - len(items)
        cs = [d.contact[i] for i, *_ in items]
        a, b = (np.array([x[1 + i] for x in items] + [0] * pad, np.int32) for i in range(2))
        fill = lambda values, zero: np.array(list(values) + [zero] * pad, float)
        normal = fill((x[3] * c.frame[:3] for x, c in zip(items, cs)), np.array([0, 0, 1.0]))
        pos = fill((c.pos for c in cs), np.zeros(3))
        laws = [combine(*(geom_law(m, g) for g in c.geom)) for c in cs]
        laws += [PairLaw(1.0, (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0), 0.0, 0.0, 3)] * pad
        law = jax.tree.map(lambda x: jnp.asarray(x, dtype), law_of_pairs(laws, impratio=m.opt.impratio))
        law = law._with(frictional=jnp.asarray([[p.condim == 3] for p in laws]))
        slot = lambda v: jax.tree.map(lambda x: x[None], arr(v))
        rows.append(Rows(
            n=arr(normal), phi=jnp.asarray(fill((c.dist for c in cs), 0.0), dtype)[None, :, None],
            live=jnp.asarray(np.arange(size) < len(items))[None, :, None], law=law,
            rb=slot(pos - d.xipos[b + 1]), b=jnp.asarray(b)[:, None],
            ra=slot(pos - d.xipos[a + 1]) if dynamic else None, a=jnp.asarray(a)[:, None] if dynamic else None,
            mu=jnp.asarray([[p.friction] for p in laws], dtype),
        ))
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
