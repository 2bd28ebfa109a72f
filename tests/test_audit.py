"""Residuals of the contact problem, penetration and the energy ledger of a step."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from test_absence import operations

import rbd_jax as rbd
from rbd_jax.rollout import _step_batch
from rbd_jax.solvers import PGS, TGS
from rbd_jax.solvers.base import Solver
from rbd_jax.step import advance, enter, watched, with_memory

G = 9.81
RESIDUALS = ("signorini", "complementarity", "cone", "dissipation", "momentum")
LEDGER = ("work", "dissipated", "dissipated_friction", "dissipated_normal")


@functools.cache
def compiled(steps):
    """``steps`` audited steps in one program: the last state and audits (steps, batch...)."""

    def run(model, state, control):
        one = lambda s, _: rbd.audit(model, s, control)
        return jax.lax.scan(one, state, length=steps)

    return jax.jit(run)


def audited(scene, method, steps, control=None, **leaves):
    model, state = rbd.build(scene, method=method)
    model = model.replace(**leaves)
    state = with_memory(model, state)
    if leaves:
        state = rbd.batch(state, max(len(v) for v in leaves.values()))
    final, seen = compiled(steps)(model, state, control)
    return model, state, final, jax.tree.map(np.asarray, seen)


def total(seen, name):
    return getattr(seen, name).astype(np.float64).sum(axis=0)


def same(a, b):
    return all(np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in zip(*map(jax.tree.leaves, (a, b))))


# --- the step is that of step ---


def stepped(scene, method, steps):
    """The same steps by ``step`` and by ``audit``."""
    model, state = rbd.build(scene, method=method)
    for _ in range(steps):
        state, (audited, seen) = rbd.step(model, state), rbd.audit(model, state)
        assert same(jax.tree.map(np.asarray, state), jax.tree.map(np.asarray, audited))
    kinetic, potential = rbd.energy(model, state)
    assert float(seen.kinetic) == pytest.approx(float(kinetic), rel=1e-5)
    assert float(seen.potential) == pytest.approx(float(potential), rel=1e-5)
    return model, seen


def test_state_is_that_of_step_to_the_bit():
    stepped(scenes.box(0.18), "fast", 24)


def test_so_it_is_with_mujoco_which_stores_its_load():
    model, seen = stepped(scenes.ball(0.1, vel=(1.0, 0, 0), friction=0.5), "mujoco", 240)
    assert float(seen.signorini) < 1e-6 and float(seen.penetration) > 0
    load = float(model.mass[0]) * G * float(seen.penetration)
    assert float(seen.stored) == pytest.approx(0.5 * load, rel=0.1)


def test_a_batch_is_its_worlds_and_vmap_is_a_batch():
    model, state = rbd.build(scenes.ball(0.3), method="fast")
    states = rbd.batch(state, 2)
    states, _ = rbd.rollout(model, states.replace(vel=states.vel + jnp.array([[[0.3, 0, 0]], [[0, 0, -2.0]]])), 23)
    once = compiled(1)
    _, seen = once(model, states, None)
    assert (seen.points[0] > 0).any()
    _, mapped = jax.vmap(lambda s: once(model, s, None))(states)
    for k in range(2):
        _, one = once(model, jax.tree.map(lambda c: c[k], states), None)
        for field in dataclasses.fields(rbd.Audit):
            want, single, many = (np.asarray(getattr(a, field.name)) for a in (seen, one, mapped))
            assert want.shape == (1, 2) and single.shape == (1,) and many.shape == (2, 1)
            np.testing.assert_allclose([single[0], many[k, 0]], want[0, k], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("method", ["fast", rbd.Method("symtop2", "hertz", "tgs", substeps=2), "mujoco"])
def test_a_step_does_not_pay_for_it(method, monkeypatch):
    model, state = rbd.build(scenes.box(0.18), method=method)
    state = with_memory(model, rbd.batch(state, 2))
    count = lambda f: len(list(operations(jax.make_jaxpr(f)(model, state).jaxpr)))

    def bare(model, state, step):
        p, world = enter(model, state, state.batch_shape)
        return step(model, p, world, None)

    plain = count(lambda m, s: bare(m, s, advance))
    assert count(lambda m, s: bare(m, s, lambda *a: watched(*a, lambda *_: None)[0])) == plain
    assert count(lambda m, s: rbd.audit(m, s)) > plain + 100

    def asked(*_):
        raise AssertionError("a step asks for the law of its residuals")

    monkeypatch.setattr(Solver, "final_law", asked)
    monkeypatch.setattr(TGS, "final_law", asked)
    jax.make_jaxpr(lambda m, s: _step_batch(m, s, None))(model, state)


def test_bad_arguments_are_refused():
    model, state = rbd.build(scenes.ball(0.3), method="fast")
    with pytest.raises(ValueError, match="control.force has shape"):
        rbd.audit(model, state, rbd.Wrench(force=jnp.zeros((2, 3))))


# --- residuals ---


@pytest.mark.parametrize("method", ["fast", "accurate"])
def test_a_box_at_rest_has_none(method):
    scene = scenes.box(0.1, omega=(0.0, 0, 0), half=(0.1, 0.1, 0.1))
    model, _, _, seen = audited(scene, method, 120)
    weight = float(model.mass[0]) * G / 240
    assert seen.signorini[-1] < 1e-6 and seen.complementarity[-1] < 1e-6
    assert seen.cone.max() <= 1e-6 * weight
    assert seen.dissipation[-1] < 1e-6 * weight * 1.0
    assert seen.momentum.max() < 1e-5 * weight
    assert seen.points[-1] == 4
    assert 0 <= seen.mean_penetration[-1] <= seen.penetration[-1] < 2e-3
    assert np.abs(seen.dissipated[-1]) < 1e-5 * float(model.mass[0]) * G * 0.1


def tower(n=3):
    """Spheres on top of each other: every row sees its neighbours."""
    ball = rbd.Sphere(0.1)
    bodies = [rbd.Body(f"b{i}", ball, pos=(0, 0, 0.1 * (2 * i + 1)), vel=(0.1, 0, -1.0)) for i in range(n)]
    return rbd.Scene(bodies, static=[rbd.Plane()], dt=1 / 240)


def first_step_of(solver):
    _, _, _, seen = audited(tower(), rbd.Method("symtop2", "near_rigid", solver), 1)
    assert seen.momentum[0] < 1e-5
    return {name: float(getattr(seen, name)[0]) for name in RESIDUALS}


def test_residuals_fall_as_sweeps_converge():
    few, many = first_step_of(PGS(1)), first_step_of(PGS(300))
    for name, above, below in (("signorini", 1e-1, 1e-4), ("complementarity", 1e-1, 1e-3), ("dissipation", 1e-3, 1e-4)):
        assert few[name] > above > below > many[name], (name, few, many)
    assert few["cone"] < 1e-6 and many["cone"] < 1e-6


# --- energy ---


@pytest.mark.parametrize("method", ["fast", "accurate"])
def test_sliding_dissipates_mu_m_g_times_the_distance(method):
    model, first, final, seen = audited(scenes.cube_sliding(), method, 120)
    distance = float(final.pos[0, 0] - first.pos[0, 0])
    want = scenes.MU * float(model.mass[0]) * G * distance
    np.testing.assert_allclose(total(seen, "dissipated"), want, rtol=2e-3)
    np.testing.assert_allclose(total(seen, "dissipated_friction"), want, rtol=2e-3)
    assert method != "fast" or seen.cone.max() < 1e-5
    assert abs(total(seen, "dissipated_normal")) < 2e-3 * want
    assert (seen.work == 0).all() and (seen.stored == 0).all()


def test_a_drop_dissipates_its_height_or_nothing():
    """e = 0 and e = 1 from 0.5 m in one batch."""
    e = jnp.array([[0.0, 0.0], [1.0, 1.0]])
    model, _, _, seen = audited(scenes.ball(0.6, restitution=0.5), "fast", 120, restitution=e)
    fall = float(model.mass[0]) * G * 0.5
    lost = total(seen, "dissipated")
    np.testing.assert_allclose(lost, [fall, 0.0], atol=2e-5 * fall)
    landing = float(model.mass[0]) * G / 240 * np.sqrt(2 * G * 0.5)  # m g h |v|: the instant of landing is not resolved
    np.testing.assert_allclose(total(seen, "dissipated_normal"), lost, atol=0.5 * landing)
    assert (seen.signorini < 1e-5).all()


def test_events_keep_the_energy_of_an_elastic_ball():
    method = rbd.Method("symtop2", None, "tgs", events=1)
    model, _, final, seen = audited(scenes.ball(0.6, restitution=1.0), method, 120)
    fall = float(model.mass[0]) * G * 0.5
    assert abs(total(seen, "dissipated")) < 1e-4 * fall
    assert float(final.pos[0, 2]) > 0.1


def test_the_ledger_closes():
    """A tumbling box comes down: what the rows take is what is lost, to the truncation of the step."""
    scene, steps = scenes.box(0.25, vel=(1.0, 0, 0), half=(0.1, 0.1, 0.1)), 120
    model, first, final, seen = audited(scene, "accurate", steps)
    before, after = (float(sum(rbd.energy(model, s))) for s in (first, final))
    lost = total(seen, "dissipated")
    assert lost == pytest.approx(before - after, abs=1e-4 * before)
    rows = total(seen, "dissipated_friction") + total(seen, "dissipated_normal")
    assert rows == pytest.approx(lost, rel=0.05)
    assert seen.dissipated.min() > -1e-3 * float(model.mass[0]) * G * 0.1


def test_work_of_a_control():
    scene = rbd.Scene([rbd.Body("b", rbd.Box((0.1, 0.2, 0.3)), omega=(1.0, 2.0, 3.0), vel=(1.0, 0, 0))], gravity=None)
    wrench = rbd.Wrench(force=jnp.array([[3.0, 0, 4.0]]), torque=jnp.array([[0.2, -0.1, 0.3]]))
    model, first, final, seen = audited(scene, "accurate", 50, control=wrench)
    gain = float(rbd.energy(model, final)[0] - rbd.energy(model, first)[0])
    assert total(seen, "work") == pytest.approx(gain, rel=2e-3)
    assert abs(total(seen, "dissipated")) < 2e-3 * gain
    assert all((getattr(seen, k) == 0).all() for k in (*RESIDUALS, "points", "penetration"))


def test_work_of_a_belt():
    """A ball laid on a belt of speed v slips until it rolls: half of the work m v^2 2/7 is lost, half is its energy."""
    scene = rbd.Scene(
        bodies=[rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 0.1), friction=0.5)],
        kinematic=[rbd.Body("belt", rbd.Box((5.0, 1.0, 0.1)), pos=(0, 0, -0.1), vel=(1.0, 0, 0), friction=0.5)],
        dt=1 / 240,
    )
    model, _, _, seen = audited(scene, "fast", 60)
    part = float(model.mass[0]) / 7
    assert total(seen, "work") == pytest.approx(2 * part, rel=5e-3)
    assert seen.kinetic[-1] == pytest.approx(part, rel=5e-3)
    for name in ("dissipated", "dissipated_friction"):
        assert total(seen, name) == pytest.approx(part, rel=5e-3)


@pytest.mark.parametrize("solver", ["tgs", "penalty"])
def test_a_spring_stores_its_load(solver):
    k, tau = 1e4, 0.02
    method = rbd.Method("symtop2", rbd.CONTACT_MODELS["spring"](k, tau), solver, substeps=4)
    model, first, _, seen = audited(scenes.ball(0.1), method, 240)
    weight = float(model.mass[0]) * G
    assert seen.stored[-1] == pytest.approx(0.5 * weight**2 / k, rel=1e-3)
    assert seen.penetration[-1] == pytest.approx(weight / k, rel=1e-3)
    # potential energy of the settling: half of it is stored, half dissipated
    assert total(seen, "dissipated") == pytest.approx(0.5 * weight**2 / k, rel=2e-2)


# --- odd worlds ---


def test_a_frozen_world_made_no_step():
    model, state = rbd.build(scenes.ball(0.0999), method="fast")
    state = rbd.batch(state, 2)
    push = jnp.array([[[0.0, 0, 0]], [[jnp.nan, 0, 0]]])
    frozen, seen = rbd.audit(model, state, rbd.Wrench(force=push))
    assert int(frozen.status[1]) == int(rbd.Status.NOT_FINITE) and int(frozen.status[0]) == 0
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(seen))
    assert all(float(getattr(seen, k)[1]) == 0 for k in (*RESIDUALS, *LEDGER))
    assert int(seen.points[0]) == 1 and int(seen.points[1]) == 0


def test_pairs_chosen_at_run_time(monkeypatch):
    import sys

    for name in ("DENSE_PAIRS", "COLOURED_PAIRS", "FLOATING_PAIRS"):
        monkeypatch.setattr(sys.modules["rbd_jax.build"], name, {("sphere", "sphere"): 0})
    _, _, _, seen = audited(scenes.two_spheres(restitution=1.0), "fast", 120)
    assert (seen.points > 0).any()
    lost = total(seen, "dissipated")
    assert lost == pytest.approx(0.5 - seen.kinetic[-1], abs=1e-6) and lost > 5e-3
    # the couple of an impact within a step, which keeps angular momentum, changes the energy by 0.05 %
    assert total(seen, "dissipated_friction") == pytest.approx(lost, rel=3e-2)
    assert abs(total(seen, "dissipated_normal")) < 1e-5 and seen.signorini.max() < 1e-5
