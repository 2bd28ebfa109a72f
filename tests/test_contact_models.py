"""Contact models with every solver: the overlap and the friction that the law of each says."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax.method import SWEPT
from rbd_jax.solvers import TGS
from rbd_jax.solvers.laws import Hertz, NearRigid, Soft, Spring
from rbd_jax.solvers.laws.base import recovery

G, H = 9.81, 1 / 240
SOLVERS = ["tgs", "pgs", "newton_lagged", "newton_cone", "penalty"]


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def resting(half=0.1, mass=8.0):
    body = rbd.Body("cube", rbd.Box((half, half, half)), pos=(0, 0, half), mass=mass, friction=0.5)
    return rbd.Scene([body], [rbd.Geom(rbd.Plane(), friction=0.5)], dt=H)


def overlap(method, steps=720):
    model, state = rbd.build(resting(), method=method)
    final, _ = rbd.rollout(model, state, steps, every=steps)
    assert np.abs(final.vel).max() < 1e-6 and int(final.status) == 0
    return 0.1 - float(final.pos[0, 2])


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_spring_yields_by_its_load(solver):
    """m g / k, whatever the solver and however many points share the load."""
    spring = Spring(stiffness=2e4, relaxation=0.02)
    assert overlap(rbd.Method("symtop2", spring, solver)) == pytest.approx(8.0 * G / 2e4, rel=1e-3)


@pytest.mark.parametrize("solver", ["tgs", "newton_lagged"])
def test_a_contact_of_a_frequency_yields_by_its_period(solver):
    """g / (2 pi f)^2 times m w, where w = 4 / m is the inverse mass that a corner of a cube has."""
    assert overlap(rbd.Method("symtop2", Hertz(hertz=15.0), solver)) == pytest.approx(
        4 * G / (2 * np.pi * 15) ** 2, rel=1e-3
    )


@pytest.mark.parametrize("soft", [Soft(), Soft.uniform(0.25, 10.0)])
def test_a_soft_contact_yields_by_its_step(soft):
    """As ``Hertz``, of a frequency that is given by the step: g h^2 / (2 pi f h)^2."""
    expected = G * H**2 / (2 * np.pi * soft.face[0]) ** 2
    assert overlap(rbd.Method("symtop2", soft, "tgs")) == pytest.approx(expected, rel=1e-3)


def test_a_near_rigid_contact_yields_by_beta():
    beta = 0.2
    expected = beta**2 / (4 * np.pi**2) * 4 * G * H**2
    assert overlap(rbd.Method("symtop2", NearRigid(beta=beta), "newton_lagged")) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("solver", ["newton_lagged", "newton_cone", "pgs"])
def test_mujocos_softness_at_the_velocity_level(solver):
    """The overlap of the preset "mujoco", whose law it is."""
    assert overlap(rbd.Method("symtop2", "mujoco", solver)) == pytest.approx(overlap("mujoco"), rel=2e-2)


@pytest.mark.parametrize(
    "method",
    ["accurate", rbd.Method(solver="newton_cone"), rbd.Method(solver="tgs")],
    ids=["newton_lagged", "newton_cone", "tgs"],
)
def test_torsional_and_rolling_friction_slow_a_ball(method):
    """Spin about the normal falls by nu_s m g / I, rolling by nu_r g / (1.4 r)."""
    numbers = dict(friction=0.5, torsional_friction=0.02, rolling_friction=0.005)
    ball = lambda name, **kwargs: rbd.Body(name, [rbd.Geom(rbd.Sphere(0.1), **numbers)], mass=1.0, **kwargs)
    bodies = [
        ball("spins", pos=(0, 0, 0.1), omega=(0, 0, 10.0)),
        ball("rolls", pos=(1, 0, 0.1), vel=(1.0, 0, 0), omega=(0, 10.0, 0)),
    ]
    model, state = rbd.build(rbd.Scene(bodies, [rbd.Geom(rbd.Plane(), **numbers)], dt=1 / 500), method=method)
    final, traj = rbd.rollout(model, state, 150, every=100)
    spin = 10 - 0.02 * G / (0.4 * 0.01) * 0.2
    assert float(traj.omega[1, 0, 2]) == pytest.approx(spin, abs=0.015)
    assert float(final.omega[0, 2]) == pytest.approx(0.0, abs=1e-3)
    assert float(traj.vel[1, 1, 0]) == pytest.approx(1 - 0.005 * G / 0.14 * 0.2, abs=3e-3)


def test_the_exit_speed_from_overlap_is_bounded():
    """Cubes placed half inside each other part at ``push_speed`` at most, and no heavier load is refused."""
    for preset in ("accurate", rbd.Method(solver="tgs")):
        bodies = [rbd.Body(f"c{i}", rbd.Box((0.5, 0.5, 0.5)), pos=(0.0, 0, 0.5 * i)) for i in range(2)]
        model, state = rbd.build(rbd.Scene(bodies, gravity=None, dt=1 / 60), method=preset)
        _, traj = rbd.rollout(model, state, 60)
        speed = np.diff(np.asarray(traj.vel)[:, :, 2], axis=1)
        assert 0.1 < speed.max() <= 1.01 * model.method.contact.push_speed


def test_a_stack_that_starts_in_overlap_is_not_thrown_up():
    """Five cubes askew in each other by up to 17 mm: what pushes them out gives them 4 % of their energy, not as much
    again (the top one flew 0.9 m)."""
    cube = lambda k: rbd.Body(
        f"c{k}",
        rbd.Box((0.1, 0.1, 0.1)),
        pos=(0.01 * k, 0, 0.1 + 0.199 * k),
        quat=(1, 0.02 * k, 0.01 * k, 0),
        mass=1.0,
        friction=0.6,
    )
    scene = rbd.Scene([cube(k) for k in range(5)], [rbd.Geom(rbd.Plane(), friction=0.6)], dt=1 / 240)
    model, state = rbd.build(scene, method="fast")
    assert model.method.solver.name == "newton_lagged"
    final, traj = rbd.rollout(model, state, 120)
    energy = np.asarray(sum(rbd.energy(model, traj)))
    assert energy.max() < 1.05 * energy[0]
    assert 0.88 < float(final.pos[4, 2]) < 0.91


def test_what_a_tumbling_box_sinks_in_is_given_back_slowly():
    """Else a stiff spring raises the energy of a box that hits the ground by 0.7 % of m g d in a step."""
    half = (0.05, 0.1, 0.15)
    body = rbd.Body("box", rbd.Box(half), mass=1.0, friction=0.5)
    scene = rbd.Scene([body], [rbd.Geom(rbd.Plane(), friction=0.5)], dt=H)
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(128, 1, 4))

    def rise(soft):
        with jax.enable_x64(False):
            model, state = rbd.build(scene, method=rbd.Method("symtop2", soft, TGS(sweeps=2)))
            start = rbd.batch(state, len(quat)).replace(
                pos=np.zeros((len(quat), 1, 3)) + [0, 0, 0.5],
                quat=quat / np.linalg.norm(quat, axis=-1, keepdims=True),
                vel=np.random.default_rng(1).normal(size=(len(quat), 1, 3)),
                omega=4 * np.random.default_rng(2).normal(size=(len(quat), 1, 3)),
            )
            final, traj = rbd.rollout(model, start, 360)
            energy = np.asarray(sum(rbd.energy(model, traj)), np.float64)
        assert not np.asarray(final.status).any()
        return np.diff(energy).max() / (G * half[0])

    assert rise(Soft()) < 1.5e-3 < 5e-3 < rise(Soft(deep=None))


def test_a_spring_softer_than_what_deep_overlap_gives_back_stays_as_it_is():
    """Soft(face=...) takes back less than ``deep`` says: a steeper line above it would pull at small overlaps."""
    problem = types.SimpleNamespace(h=H, nominal=None)
    phi = jnp.array([-0.01, -1e-3, -1e-5, 0.0, 0.01])
    with_deep, without = (recovery(phi, problem, 0.01, 2.0, deep) for deep in ((0.003, 0.03), None))
    np.testing.assert_array_equal(with_deep, without)


def test_boxes_that_are_pushed_seldom_rock():
    """A cube that is pushed with 90 to 98 % of what moves it loads its corners 1 : 10, and rounding may make it rock on
    them. With the springs of boxes 7 % of the worlds do (with those of Box2D, 8 %), with that of spheres 40 %."""
    body = rbd.Body("cube", rbd.Box((0.5, 0.5, 0.5)), pos=(0, 0, 0.5), mass=1000.0, friction=0.6)
    scene = rbd.Scene([body], [rbd.Geom(rbd.Plane(), friction=0.6)], dt=H)
    angle, part = (c.ravel() for c in np.meshgrid(np.radians(np.arange(0, 90, 2.5)), [0.9, 0.95, 0.97, 0.98]))
    toward = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    force = ((part * 0.6 * 1000.0 * G)[:, None] * toward)[:, None]

    def rocking(soft):
        with jax.enable_x64(False):
            model, state = rbd.build(scene, method=rbd.Method("symtop2", soft, TGS(sweeps=2)))
            start = rbd.batch(state, len(force))
            _, traj = rbd.rollout(model, start, 1440, every=4, control=rbd.Wrench(force=force))
        return (np.abs(np.asarray(traj.omega)[:, 180:, 0, :2]).max(axis=(1, 2)) > 1e-4).mean()

    assert rocking(Soft()) < 0.15 < 0.25 < rocking(Soft.uniform(0.75, 30.0))


@pytest.mark.parametrize("count, rocks", [(3, False), (4, False), (8, False), (4, True)])
def test_a_column_of_boxes_beside_a_ball_stands_still(count, rocks):
    """Sweeps and springs of preset "fast" suit each other: with the springs of a lone box a column of four rocks."""
    rng = np.random.default_rng(0)
    box = lambda i: rbd.Body(
        f"b{i}", rbd.Box((0.1, 0.1, 0.1)), pos=(*rng.uniform(-4e-3, 4e-3, 2), 0.1 + 0.201 * i), mass=8.0, friction=0.6
    )
    ball = rbd.Body("ball", rbd.Sphere(0.1), pos=(1.0, 0, 0.1), mass=8.0, friction=0.6)
    scene = rbd.Scene([*(box(i) for i in range(count)), ball], [rbd.Geom(rbd.Plane(), friction=0.6)], dt=H)
    model, state = rbd.build(scene, method="fast")
    assert model.method.solver == TGS(sweeps={3: 3, 4: 3, 8: 4}[count]) and model.method.contact == SWEPT
    if rocks:
        soft = Soft(stacked=(Soft().face, Soft().face))
        model, state = rbd.build(scene, method=dataclasses.replace(model.method, contact=soft))
    final, traj = rbd.rollout(model, state, 960, every=8)
    speed = np.abs(np.asarray(traj.vel)[90:, :count]).max()
    assert speed > 1e-2 if rocks else speed < 2e-3
    assert np.abs(final.pos - state.pos)[:count, :2].max() < 0.02


@pytest.mark.parametrize(
    "method, message",
    [
        (rbd.Method(contact="jelly"), "unknown contact model 'jelly'"),
        (rbd.Method(solver="magic"), "unknown solver 'magic'"),
        (rbd.Method(contact="soft", solver="mujoco"), "speaks contact model 'mujoco'"),
        (rbd.Method(contact=3), "must be a name or a ContactModel"),
        (rbd.Method(substeps=0), "substeps = 0"),
    ],
)
def test_combinations_that_do_not_exist_are_refused(method, message):
    with pytest.raises(ValueError, match=message):
        rbd.build(resting(), method=method)
    with pytest.raises(ValueError, match="Spring"):
        Spring(stiffness=-1.0)


def test_fast_picks_the_cheapest_solver_that_stands():
    """Sweeps for bodies on the ground and mixed scenes in small steps, a direct solve for boxes on boxes."""

    def solver(n, dt, half=0.5, heavy=1.0, balls=0):
        box = lambda i: rbd.Body(
            f"b{i}", rbd.Box((half, half, half)), pos=(0, 0, half * (2 * i + 1)), mass=heavy if i else 1.0
        )
        ball = lambda i: rbd.Body(f"s{i}", rbd.Sphere(half), pos=(3 * half * (i + 1), 0, half))
        bodies = [box(i) for i in range(n)] + [ball(i) for i in range(balls)]
        scene = rbd.Scene(bodies, [rbd.Geom(rbd.Plane())])
        return rbd.build(scene, dt=dt, method="fast")[0].method.solver.name

    assert [solver(1, 1 / 60), solver(3, 1 / 240, balls=2), solver(0, 1 / 240, balls=3)] == ["tgs"] * 3
    direct = [solver(5, 1 / 240), solver(10, 1 / 60), solver(3, 1 / 60, balls=2), solver(2, 1 / 500, heavy=100.0)]
    assert direct == ["newton_lagged"] * 4
    assert solver(65, 1 / 240) == "tgs", "too many for one system"
    pile = lambda *masses: (
        rbd.build(
            rbd.Scene([rbd.Body(f"s{k}", rbd.Sphere(0.1), pos=(0, 0, 0.3 * k), mass=m) for k, m in enumerate(masses)]),
            method="fast",
        )[0].method.contact
    )
    assert (pile(1.0, 4.9), pile(1.0, 2.0, 5.1)) == (SWEPT, Soft.uniform(0.25, 10.0)), "heavy loads: softer contacts"
    chosen = rbd.build(resting(), dt=1 / 60, method=dataclasses.replace(rbd.PRESETS["fast"], substeps=3))[0].method
    assert (chosen.solver.name, chosen.substeps) == ("tgs", 3)
