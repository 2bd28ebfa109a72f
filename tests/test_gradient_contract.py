"""The gradient contract: derivatives against closed forms, forward and reverse, float64."""

import dataclasses
import functools

import gradient_cases as cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbd_jax as rbd
from rbd_jax.solvers import NewtonLagged


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("name", cases.CASES)
def test_derivatives_are_those_of_the_physics(name, contract):
    case = cases.CASES[name]
    errors = []
    for dt in case.steps:
        found, truth, difference = cases.jacobians(case, dt, case.reverse and dt == case.steps[-1])
        errors.append(cases.error(found, truth))
        assert difference is None or difference <= 1e-9 * np.abs(found).max()
    contract(
        "closed",
        event=case.event,
        derivatives=f"d({', '.join(case.outputs)})/d({', '.join(case.inputs)})",
        formula=case.text,
        steps=case.steps,
        errors=errors,
        bar=case.bar,
    )
    if case.order is None:
        assert max(errors) <= case.bar, errors
    else:
        assert errors[-1] <= case.bar, errors
        order = np.log(errors[0] / errors[-1]) / np.log(case.steps[0] / case.steps[-1])
        assert order >= case.order or max(errors) < 1e-9, (order, errors)


def test_simultaneous_impacts_of_two_pairs():
    """Two balls that land at the same instant: each has the derivative it has alone."""
    bodies = [cases._ball((x, 0, 1.1), e=0.8, name=f"ball{x}") for x in (0, 1)]
    model, state = rbd.build(rbd.Scene(bodies, [rbd.Plane()], gravity=(0, 0, -cases.G)), dt=1 / 240, method="gradient")

    def heights(z):
        return rbd.rollout(model, state.replace(pos=state.pos.at[:, 2].set(0.1 + z)), 180, every=180)[0].pos[:, 2]

    alone = jax.jacfwd(lambda z: cases._drop((z, 0.0, 0.8), 0.75, 1)[0])(1.0)
    np.testing.assert_allclose(jax.jacfwd(heights)(jnp.ones(2)), alone * np.eye(2), atol=1e-9)


def test_impact_at_the_very_end_of_a_step():
    """A ball that reaches the wall at the end of step 144, to rounding: the derivative has the impact in it."""
    f = cases._bounce(1 / 240, 0.0, 1.0)
    J = jax.jacfwd(f)(jnp.array([1.5, -2.5, 0.8]))  # hits at 0.6 s
    np.testing.assert_allclose(J[0], [-0.8, -0.8, 1.0], atol=1e-8)


def test_second_derivatives_across_an_impact():
    f = cases._bounce(1 / 240, cases.G, 0.75)
    i = jnp.array([1.0, 0.2, 0.7])
    truth = jax.hessian(lambda i: cases._drop(i, 0.75, 1)[0])(i)
    np.testing.assert_allclose(jax.jit(jax.hessian(lambda i: f(i)[0]))(i), truth, rtol=1e-8, atol=1e-8)
    twice = jax.jit(jax.jacrev(jax.grad(lambda i: f(i)[0])))(i)
    np.testing.assert_allclose(twice, truth, rtol=1e-8, atol=1e-8)


def test_a_push_below_the_limit_of_friction_moves_nothing(contract):
    """dx/dF of a held body, relative to that of a sliding one, falls with the speed that regularises friction."""
    speeds = (1e-4, 1e-6)
    found = []
    box = rbd.Body("box", rbd.Box((0.1, 0.1, 0.1)), pos=(0, 0, 0.1), mass=1.0, friction=0.5)
    for speed in speeds:
        solver = dataclasses.replace(rbd.PRESETS["gradient"].solver, slip_speed=speed, slip_compliance=10 * speed)
        run = cases.slider(1 / 240, 0.5, dataclasses.replace(rbd.PRESETS["gradient"], solver=solver), box)
        slope = jax.jit(jax.jacfwd(lambda F, run=run: run(jnp.stack([0.0 * F, 0.5 + 0.0 * F, F]))[0]))(2.5)
        found.append(float(slope) / 0.125)
    contract(
        "closed",
        event="stick: pushed below the limit of friction",
        derivatives="d(x)/d(F)",
        formula="0; box, slip speeds 1e-4 and 1e-6 m/s (sigma ten times that), relative to T^2 / (2 m)",
        steps=(1 / 240, 1 / 240),
        errors=found,
        bar=1e-3,
    )
    assert 0 < found[0] <= 1e-3 and abs(found[1]) <= 0.1 * found[0], found


# --- where there is no derivative ---


def test_the_switch_from_stick_to_slip_has_one_sided_derivatives(contract):
    run = cases.slider(1 / 240, 0.5)
    slope = jax.jit(jax.jacfwd(lambda F: run(jnp.stack([0.0 * F, 0.5 + 0.0 * F, F]))[0]))
    limit = 0.5 * cases.G
    held, slides = float(slope(0.98 * limit)), float(slope(1.02 * limit))
    contract(
        "none",
        event="push at exactly the limit of friction",
        why="sticking on one side, sliding on the other",
        found=f"d(x)/d(F) = {held:.1e} at 98 %, {slides:.3f} at 102 % (T^2 / 2 m = 0.125)",
    )
    assert held < 2e-3 and abs(slides - 0.125) < 0.01


def test_the_derivative_grows_without_bound_towards_a_grazing_impact(contract):
    f = cases.CASES["spheres"].function(1 / 10)
    truth = cases.CASES["spheres"].truth
    slope, exact = (jax.jit(jax.jacfwd(lambda y, g=g: g(jnp.stack([y, 3.0 + 0.0 * y]))[1])) for g in (f, truth))
    gaps = (1e-2, 1e-4, 1e-6)
    found = [float(slope(0.3 - gap)) for gap in gaps]
    np.testing.assert_allclose(found, [float(exact(0.3 - gap)) for gap in gaps], rtol=1e-6)
    missed = float(slope(0.3 + 1e-6))
    contract(
        "none",
        event="grazing impact",
        why="the instant of the impact is the root of a square root that vanishes",
        found=f"d(yA)/d(offset) = {', '.join(f'{s:.3g}' for s in found)} at 1e-2, 1e-4, 1e-6 m inside, "
        f"{missed:.3g} for a miss",
    )
    assert abs(found[2]) > 5 * abs(found[1]) > 25 * abs(found[0]) / 2 and missed == 0.0


def test_the_order_of_two_impacts_decides_what_follows(contract):
    """A ball hits two touching ones: one that is hit first takes more. The derivative is that of the order that is."""
    bodies = [
        cases._ball((x, 0, y), 1.0, None, 0.1, f"ball{k}") for k, (x, y) in enumerate([(-0.4, 0), (0, 0.1), (0, -0.1)])
    ]
    model, state = rbd.build(rbd.Scene(bodies, gravity=None), dt=1 / 30, method="gradient")

    def after(offset):
        s = state.replace(
            pos=state.pos.at[1, 2].add(0.001).at[0, 2].add(offset), vel=jnp.zeros((3, 3)).at[0, 0].set(3.0)
        )
        return rbd.rollout(model, s, 8, every=8)[0].vel[0, 2]

    both = jax.jit(jax.value_and_grad(after))
    (low, _), (high, _) = both(0.0005 - 1e-5), both(0.0005 + 1e-5)
    contract(
        "none",
        event="one body meets two others at the same instant",
        why="their order decides the outcome, which jumps",
        found=f"vz of the first = {float(low):.3f} and {float(high):.3f} m/s for offsets 20 um apart",
    )
    assert abs(high - low) > 0.1


# --- smoothing ---


def smoothed(how):
    solver = NewtonLagged(iterations=4, polish=8, smoothing=how)
    return dataclasses.replace(rbd.PRESETS["gradient"], solver=solver, events=0)


@functools.cache
def faller(how):
    """(height, smoothing) -> end state of a ball that starts above the plane, sliding, and its derivative in height."""
    scene = rbd.Scene([cases._ball((0, 0, 0.1), mu=0.5)], [rbd.Geom(rbd.Plane(), friction=0.5)])
    model, state = rbd.build(scene, dt=1 / 120, method=smoothed(how))

    def end(h, speeds):
        s = state.replace(pos=cases._along(2, 0.1 + h), vel=cases._along(0, 1.0))
        final = rbd.rollout(model if how is None else model.replace(smoothing=speeds), s, 12, every=12)[0]
        return jnp.concatenate([final.pos[0], final.vel[0], final.omega[0]])

    return jax.jit(lambda h, speeds: jax.jvp(lambda h: end(h, speeds), (h,), (jnp.ones_like(h),)))


def fall(how, speed=0.0, height=0.5):
    return faller(how)(jnp.asarray(height), jnp.array([speed, speed]))


def test_backward_smoothing_leaves_the_values_and_sees_contact_from_a_distance():
    value, slope = fall(None, height=0.3)
    soft_value, soft_slope = fall("backward", 0.5, height=0.3)
    np.testing.assert_array_equal(soft_value, value)
    assert np.abs(slope[3:]).max() == 0.0, "no contact, no influence of the height on the velocity"
    assert soft_slope[5] < -1e-4, "the plane pushes less from further away"


@pytest.mark.parametrize("how", ["forward", "backward"])
def test_smoothing_is_annealed_to_the_contact_as_it_is(how):
    value, slope = fall(None, height=1e-4)
    differences = []
    for speed in (1e-1, 1e-2, 1e-3, 0.0):
        soft_value, soft_slope = fall(how, speed, height=1e-4)
        differences.append(float(np.abs(soft_slope - slope).max()))
        if how == "backward":
            np.testing.assert_array_equal(soft_value, value)
    assert differences[-1] < 1e-3 and differences[-1] <= differences[0], differences


def test_smoothing_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="polish"):
        NewtonLagged(smoothing="backward")
    with pytest.raises(ValueError, match="forward"):
        NewtonLagged(smoothing="both", polish=1)
    scene = rbd.Scene([cases._ball()], [rbd.Plane()])
    with pytest.raises(ValueError, match="smoothing"):
        rbd.build(scene)[0].replace(smoothing=jnp.zeros(2))
    model, _ = rbd.build(scene, method=smoothed("forward"))
    with pytest.raises(ValueError, match=">= 0"):
        model.replace(smoothing=jnp.array([-1.0, 0.0]))
