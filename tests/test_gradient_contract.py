"""The gradient contract: derivatives against closed forms, forward and reverse, float64."""

import dataclasses

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


# --- smoothing ---


def smoothed(how):
    solver = NewtonLagged(iterations=8, polish=3, smoothing=how)
    return dataclasses.replace(rbd.PRESETS["gradient"], solver=solver, events=0)


def fall(method, speeds=None, height=0.5, steps=12):
    """Final state of a ball that starts ``height`` above the plane, sliding, and its derivative in the height."""
    scene = rbd.Scene([cases._ball((0, 0, 0.1), mu=0.5)], [rbd.Geom(rbd.Plane(), friction=0.5)])
    model, state = rbd.build(scene, dt=1 / 120, method=method)
    if speeds is not None:
        model = model.replace(smoothing=jnp.asarray(speeds))

    def end(h, model):
        s = state.replace(pos=cases._along(2, 0.1 + h), vel=cases._along(0, 1.0))
        final = rbd.rollout(model, s, steps, every=steps)[0]
        return jnp.concatenate([final.pos[0], final.vel[0], final.omega[0]])

    return jax.jit(lambda h: jax.jvp(lambda h: end(h, model), (h,), (jnp.ones_like(h),)))(jnp.asarray(height))


def test_backward_smoothing_leaves_the_values_and_sees_contact_from_a_distance():
    value, slope = fall(smoothed(None), height=0.3)
    soft_value, soft_slope = fall(smoothed("backward"), (0.5, 0.5), height=0.3)
    np.testing.assert_array_equal(soft_value, value)
    assert np.abs(slope[3:]).max() == 0.0, "no contact, no influence of the height on the velocity"
    assert soft_slope[5] < -1e-4, "the plane pushes less from further away"


@pytest.mark.parametrize("how", ["forward", "backward"])
def test_smoothing_is_annealed_to_the_contact_as_it_is(how):
    value, slope = fall(smoothed(None), height=1e-4)
    differences = []
    for speed in (1e-1, 1e-2, 1e-3, 0.0):
        soft_value, soft_slope = fall(smoothed(how), (speed, speed), height=1e-4)
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
