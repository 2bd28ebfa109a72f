"""Scenes: messages of bad input, mass properties, the flat form."""

import dataclasses
import math

import numpy as np
import pytest

from rbd_jax.scene import UNSET, Body, Geom, Pair, Scene, check_geom, mass_properties, resolve, rotation
from rbd_jax.shapes import Box, Plane, Sphere

NAN, INF = float("nan"), float("inf")
BALL = Body("ball", Sphere(0.1))


def body(**fields):
    return lambda: Scene([Body("ball", fields.pop("geoms", Sphere(0.1)), **fields)])


def geom(**fields):
    return lambda: Scene([Body("ball", Geom(fields.pop("shape", Sphere(0.1)), **fields))])


def scene(**fields):
    return lambda: Scene(**{"bodies": [BALL], **fields})


def pair(*args, **fields):
    return lambda: Scene([BALL], static=[Geom(Plane(), name="floor")], pairs=[Pair(*args, **fields)])


BAD = [
    # owner, field, value, rule
    (body(mass=0), "body 'ball': mass = 0.0 must be finite and > 0 [kg]"),
    (body(mass=-1.5), "body 'ball': mass = -1.5 must be finite and > 0 [kg]"),
    (body(mass=NAN), "body 'ball': mass = nan must be finite and > 0 [kg]"),
    (body(density=0.0), "body 'ball': density = 0.0 must be finite and > 0 [kg/m^3]"),
    (body(density=INF), "body 'ball': density = inf must be finite and > 0 [kg/m^3]"),
    (body(geoms=Sphere(-0.1)), "body 'ball': sphere radius = -0.1 must be finite and > 0 [m]"),
    (body(geoms=Sphere(0)), "body 'ball': sphere radius = 0 must be finite and > 0 [m]"),
    (body(geoms=Box((0.1, NAN, 0.1))), "body 'ball': box half_extents = (0.1, nan, 0.1) must be finite and > 0 [m]"),
    (body(geoms=[Sphere(1), Sphere(INF)]), "body 'ball', geom 1: sphere radius = inf must be finite and > 0 [m]"),
    (body(mass=1, inertia=(1, 1, -1)), "body 'ball': inertia = [1.0, 1.0, -1.0] must be positive definite"),
    (body(mass=1, inertia=(0, 0, 0)), "must be positive definite"),
    (body(mass=1, inertia=(1, 1, 2.1)), "breaks the triangle inequality: principal moments 1 + 1 must be >= 2.1"),
    (body(mass=1, inertia=[[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]), "must be symmetric"),
    (body(mass=1, inertia=[[1, 2, 0], [2, 1, 0], [0, 0, 1]]), "must be positive definite; its least moment is -1"),
    (body(mass=1, inertia=(1, NAN, 1)), "inertia = [1.0, nan, 1.0] must be finite"),
    (body(mass=1, inertia=(1, 1)), "inertia = (1, 1) must have shape (3,) or (3, 3), not (2,)"),
    (body(inertia=(1, 1, 1)), "body 'ball': inertia = (1.0, 1.0, 1.0) needs mass"),
    (body(mass=1, density=2), "body 'ball': mass = 1.0 and density = 2.0: give one of them"),
    (body(quat=(0, 0, 0, 0)), "body 'ball': quat = (0.0, 0.0, 0.0, 0.0) must not be zero"),
    (body(quat=(1, 0, NAN, 0)), "body 'ball': quat = (1.0, 0.0, nan, 0.0) must be finite"),
    (body(quat=(1, 0, 0)), "quat = (1.0, 0.0, 0.0) must have 4 entries"),
    (body(pos=(0, 0)), "body 'ball': pos = (0.0, 0.0) must have 3 entries [m], not 2"),
    (body(pos=(0, INF, 0)), "body 'ball': pos = (0.0, inf, 0.0) must be finite [m]"),
    (body(vel=(0, NAN, 0)), "body 'ball': vel = (0.0, nan, 0.0) must be finite [m/s]"),
    (body(omega=(NAN, 0, 0)), "body 'ball': omega = (nan, 0.0, 0.0) must be finite [rad/s]"),
    (body(com=(NAN, 0, 0)), "body 'ball': com = (nan, 0.0, 0.0) must be finite [m]"),
    (body(friction=-0.1), "body 'ball': friction = -0.1 must be finite and >= 0 [-]"),
    (body(restitution=1.1), "body 'ball': restitution = 1.1 must be between 0 and 1 [-]"),
    (body(geoms=Plane()), "body 'ball', geom 0: shape = plane must not be on a dynamic body"),
    (body(geoms=()), "body 'ball': geoms = () and mass = None: a body without geoms needs mass and inertia"),
    (body(geoms=(), mass=1), "body 'ball': inertia = None: a body without geoms needs mass and inertia"),
    (body(geoms=(), density=1), "a body without geoms needs mass and inertia"),
    (geom(name="g", friction=-1), "body 'ball', geom 'g': friction = -1.0 must be finite and >= 0 [-]"),
    (geom(friction=NAN), "body 'ball': friction = nan must be finite and >= 0 [-]"),
    (geom(restitution=-0.5), "body 'ball': restitution = -0.5 must be between 0 and 1 [-]"),
    (geom(restitution=NAN), "body 'ball': restitution = nan must be between 0 and 1 [-]"),
    (geom(quat=(0, 0, 0, 0)), "body 'ball': quat = (0.0, 0.0, 0.0, 0.0) must not be zero"),
    (geom(margin=-1), "body 'ball': margin = -1.0 must be finite and >= 0 [m]"),
    (geom(condim=5), "body 'ball': condim = 5 must be 1, 3, 4 or 6"),
    (geom(condim=4), "body 'ball': condim = 4 needs torsional_friction"),
    (geom(torsional_friction=0.1, condim=6), "body 'ball': condim = 6 needs rolling_friction"),
    (geom(torsional_friction=-1), "body 'ball': torsional_friction = -1.0 must be finite and >= 0 [m]"),
    (geom(torsional_friction=1, rolling_friction=float("nan")), "rolling_friction = nan must be finite and >= 0 [m]"),
    (geom(friction=None, torsional_friction=0.1), "torsional_friction = 0.1 needs friction (0.0 is a value), not None"),
    (geom(rolling_friction=0.1), "body 'ball': rolling_friction = 0.1 needs torsional_friction"),
    (lambda: Pair("a", "b", friction=None, torsional_friction=0.1), "pair ('a', 'b'): torsional_friction = 0.1 needs"),
    (lambda: Pair("a", "b", torsional_friction=0.1, exclude=True), "exclude = True leaves no contact"),
    (
        scene(pairs=[Pair("ball", "static:0", condim=4)], static=[Plane()]),
        "condim = 4, but neither it nor geoms 'ball' and 'static:0' have torsional_friction",
    ),
    (
        scene(pairs=[Pair("ball", "static:0", rolling_friction=0.1)], static=[Plane()]),
        "rolling_friction is given, but neither it nor geoms 'ball' and 'static:0' have torsional_friction",
    ),
    (geom(solref=(0.02, -1)), "solref = (0.02, -1.0) must be (time constant, damping ratio)"),
    (geom(solimp=(0.9, 0.95, 0.001, 0.5)), "solimp = (0.9, 0.95, 0.001, 0.5) must have 5 entries"),
    (geom(solimp=(0.9, 1.95, 0.001, 0.5, 2)), "must be (dmin, dmax, width, midpoint, power)"),
    (geom(group=2**31), "group = 2147483648 must be between"),
    (geom(name=""), "name = '' must not be empty"),
    (lambda: Body(""), "body name = '' must not be empty"),
    (lambda: Body("world"), "body name = 'world' is taken"),
    (scene(bodies=[BALL, BALL]), "body 'ball': name is given twice; body names must be unique"),
    (scene(kinematic=[BALL]), "body 'ball': name is given twice"),
    (scene(static=[Geom(Plane(), name="a"), Geom(Plane(), name="a")]), "geom 'a': name is given twice"),
    (scene(static=[Geom(Plane(), friction=-1)]), "static geom 0: friction = -1.0 must be finite and >= 0 [-]"),
    (scene(static=[Plane(), Box((1, 1, 0))]), "static geom 1: box half_extents = (1.0, 1.0, 0.0) must be"),
    (scene(bodies=[]), "scene: bodies = () must hold at least one dynamic body"),
    (scene(dt=0), "scene: dt = 0.0 must be finite and > 0 [s]"),
    (scene(dt=-0.1), "scene: dt = -0.1 must be finite and > 0 [s]"),
    (scene(dt=NAN), "scene: dt = nan must be finite and > 0 [s]"),
    (scene(gravity=(0, 0, NAN)), "scene: gravity = (0.0, 0.0, nan) must be finite [m/s^2]"),
    (scene(gravity=(0, 0)), "scene: gravity = (0.0, 0.0) must have 3 entries"),
    (scene(drag=-1), "scene: drag = -1.0 must be finite and >= 0"),
    (scene(drag=(0, -1)), "scene: drag = (0.0, -1.0) must be finite and >= 0"),
    (scene(integrator="verlet"), "scene: integrator = 'verlet' must be one of 'euler', 'implicitfast', 'rk4'"),
    (scene(cone="pyramidal"), "scene: cone = 'pyramidal' must be one of 'elliptic'"),
    (scene(solver="x"), "scene: solver = 'x' must be one of"),
    (scene(impratio=0), "scene: impratio = 0.0 must be finite and > 0"),
    (scene(iterations=0), "scene: iterations = 0 must be between 1 and"),
    (pair("ball", "flor"), "pair ('ball', 'flor'): b = 'flor' must be the name of a geom or body of the scene"),
    (pair("ball", "ball"), "pair ('ball', 'ball'): a and b must not be the same"),
    (pair("ball", "floor", friction=-1), "pair ('ball', 'floor'): friction = -1.0 must be finite and >= 0 [-]"),
    (pair("ball", "floor", restitution=2), "pair ('ball', 'floor'): restitution = 2.0 must be between 0 and 1"),
    (pair("ball", "floor", exclude=True, friction=1), "pair ('ball', 'floor'): exclude = True leaves no contact"),
    (scene(static=[Geom(Plane(), name="f")], pairs=[Pair("ball", "f"), Pair("f", "ball")]), "given twice"),
]


@pytest.mark.parametrize("make, message", BAD, ids=[m[:60] for _, m in BAD])
def test_bad_values_name_owner_field_value_and_rule(make, message):
    with pytest.raises(ValueError) as error:
        make()
    assert message in str(error.value)


WRONG_TYPES = [
    (body(mass="1"), "body 'ball': mass = '1' must be a number [kg]"),
    (body(pos=1.0), "body 'ball': pos = 1.0 must be 3 numbers [m]"),
    (body(pos="abc"), "body 'ball': pos = 'abc' must be 3 numbers"),
    (body(geoms=3), "body 'ball': geoms = 3 must be a list"),
    (body(geoms=[3]), "body 'ball': 3 must be a shape or a Geom, not int"),
    (body(geoms=Geom(3)), "body 'ball': shape = 3 must be a Sphere, Box or Plane"),
    (geom(group=1.5), "body 'ball': group = 1.5 must be an integer"),
    (geom(name=3), "name = 3 must be a string or None"),
    (lambda: Body(3), "body name = 3 must be a string"),
    (scene(bodies=[Sphere(1)]), "scene: bodies[0] = Sphere(radius=1) must be a Body, not Sphere"),
    (scene(static=[BALL]), "must be a shape or a Geom, not Body"),
    (scene(kinematic=[Plane()]), "scene: kinematic[0] = Plane() must be a Body, not Plane"),
    (scene(pairs=[("a", "b")]), "must be a Pair, not tuple"),
    (scene(dt=None), "scene: dt = None must be a number [s]"),
    (scene(refsafe=1), "scene: refsafe = 1 must be True or False"),
    (lambda: Pair(1, "b"), "pair a = 1 must be the name"),
    (lambda: resolve(3), "3 must be a Scene"),
]


@pytest.mark.parametrize("make, message", WRONG_TYPES, ids=[m[:60] for _, m in WRONG_TYPES])
def test_wrong_types(make, message):
    with pytest.raises(TypeError) as error:
        make()
    assert message in str(error.value)


def test_inertia_on_the_triangle_bound_passes():
    flat = (0.1, 0.2, 0.30000000000000004)
    assert Body("b", mass=1, inertia=flat).inertia == flat


def test_quaternions_are_normalised_and_unit_ones_kept():
    assert Body("b", quat=(0, 0, 0, 7)).quat == (0, 0, 0, 1)
    assert Body("b", quat=(1e-200, 0, 0, 0)).quat == (1, 0, 0, 0)
    q = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
    assert check_geom(Geom(Sphere(1), quat=q), "geom").quat == q


def test_scene_is_a_value():
    def make():
        return Scene([Body("b", [Sphere(1), Geom(Box((1, 2, 3)))], pos=np.ones(3))], static=Plane())

    assert make() == make() and hash(make()) == hash(make())
    assert dataclasses.replace(make(), dt=0.1).dt == 0.1
    assert repr(UNSET) == "UNSET"


def test_mass_from_density_is_exact_for_one_geom():
    m, com, inertia = mass_properties(Body("b", Box((0.1, 0.2, 0.3)), density=500))
    assert m == 500 * 8 * 0.1 * 0.2 * 0.3
    assert (com == 0).all()
    assert np.allclose(np.diag(inertia), m / 3 * np.array([0.13, 0.10, 0.05]), rtol=1e-15)
    assert (inertia == np.diag(np.diag(inertia))).all()


def test_default_density_is_water():
    assert mass_properties(Body("b", Sphere(0.1)))[0] == pytest.approx(1000 * 4 / 3 * math.pi * 1e-3)


def test_a_turned_sphere_stays_isotropic():
    _, _, inertia = mass_properties(Body("b", Geom(Sphere(0.1), quat=(1, 2, 3, 4))))
    assert inertia[0, 0] == inertia[1, 1] == inertia[2, 2] and inertia[0, 1] == 0


def test_mass_scales_the_inertia_of_the_geoms():
    shape = Box((0.1, 0.2, 0.3))
    _, _, unit = mass_properties(Body("b", shape, density=1))
    m, _, inertia = mass_properties(Body("b", shape, mass=3.0))
    assert m == 3.0
    assert np.allclose(inertia, unit * 3.0 / (8 * 0.006), rtol=1e-14)


def test_compound_against_sampling():
    """Two turned boxes, integrated on a grid of each."""
    geoms = [
        Geom(Box((0.1, 0.2, 0.3)), pos=(0.5, 0, 0), quat=(1, 0.3, 0.2, 0.1)),
        Geom(Box((0.3, 0.1, 0.1)), pos=(-0.5, 0.2, 0.4), quat=(0.2, 1, 0, 0.5)),
    ]
    k = 40
    axis = (np.arange(k) + 0.5) / k * 2 - 1
    points, weights = [], []
    for g in map(lambda g: check_geom(g, "g"), geoms):
        grid = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3) * g.shape.half_extents
        points.append(grid @ rotation(g.quat).T + g.pos)
        weights.append(np.full(k**3, 8 * np.prod(g.shape.half_extents) / k**3))
    x, w = np.concatenate(points), np.concatenate(weights)
    com = w @ x / w.sum()
    d = x - com
    inertia = (w * (d * d).sum(1)).sum() * np.eye(3) - (d * w[:, None]).T @ d
    mass, got_com, got = mass_properties(Body("b", geoms, density=1.0))
    assert mass == pytest.approx(w.sum())
    assert np.allclose(got_com, com, atol=1e-12)
    assert np.allclose(got, inertia, rtol=0, atol=2e-3 * inertia.max())


def test_com_off_the_geom():
    m, com, inertia = mass_properties(Body("b", Sphere(0.1), mass=2, com=(0, 0, -0.05)))
    assert m == 2 and tuple(com) == (0, 0, -0.05)
    assert np.allclose(inertia, 0.4 * 2 * 0.01 * np.eye(3))
    given = np.array([[3, 0.1, 0], [0.1, 4, 0.2], [0, 0.2, 5]])
    m, com, inertia = mass_properties(Body("b", Sphere(0.1), mass=2, com=(0, 1, 0), inertia=given))
    assert (inertia == given).all() and tuple(com) == (0, 1, 0)


def test_a_vanishing_mass_is_refused():
    with pytest.raises(ValueError, match="body 'dust': geoms give mass = 0.0"):
        resolve(Scene([Body("dust", Sphere(1e-120))]))


def test_resolved_order_names_and_parents():
    s = Scene(
        bodies=[Body("a", Sphere(1)), Body("b", [Sphere(1), Geom(Box((1, 1, 1)), name="lid"), Sphere(2)])],
        kinematic=[Body("belt", [Plane(), Box((1, 1, 1))], vel=(1, 0, 0))],
        static=[Plane(), Geom(Box((1, 1, 1)), name="static:0")],
    )
    r = resolve(s)
    assert r.geom_names == ("a", "b:0", "lid", "b:2", "belt:0", "belt:1", "static:0'", "static:0")
    assert r.geom_category.tolist() == [0, 0, 0, 0, 1, 1, 2, 2]
    assert r.geom_body.tolist() == [0, 1, 1, 1, 0, 0, -1, -1]
    assert r.body_names == ("a", "b") and r.kinematic_names == ("belt",)
    assert r.kinematic_vel.tolist() == [[1, 0, 0]] and r.kinematic_vel_mentioned.tolist() == [True]
    assert r.kinematic_omega_mentioned.tolist() == [False]
    assert r.mass.shape == (2,) and r.inertia.shape == (2, 3, 3)
    assert all(i < j and i < 4 for i, j in r.pairs)
    assert {(1, 2), (1, 3), (2, 3), (4, 5), (6, 7)}.isdisjoint(map(tuple, r.pairs.tolist()))
    assert len(r.pairs) == 3 + 4 * 4


def test_shapes_of_a_scene_without_geoms():
    r = resolve(Scene([Body("b", mass=1, inertia=(1, 1, 1))]))
    assert r.pairs.shape == (0, 2) and r.geom_pos.shape == (0, 3) and r.kinematic_pos.shape == (0, 3)
    assert r.pair_friction()[0].shape == (0,) and r.pair_softness()[1].shape == (0, 2)


def test_shorthand_replaces_the_geoms_surface():
    b = Body("b", [Geom(Sphere(1), friction=0.2, restitution=0.3), Sphere(1)], friction=None, restitution=0.5)
    r = resolve(Scene([b, Body("c", Geom(Sphere(1), friction=0.0))]))
    assert r.geom_has_friction.tolist() == [False, False, True]
    assert r.geom_restitution.tolist() == [0.5, 0.5, 0.0]
    assert r.geom_has_restitution.tolist() == [True, True, False]
    assert r.geom_condim.tolist() == [1, 1, 3]


def test_mentioned_zero_is_not_absence():
    r = resolve(Scene([Body("a", Sphere(1)), Body("b", Sphere(1), omega=(0, 0, 0), vel=(0, 0, 0))]))
    assert r.omega_mentioned.tolist() == [False, True] == r.vel_mentioned.tolist()


def test_masks_follow_contype_and_conaffinity():
    kinds = [(1, 1), (2, 1), (4, 2), (0, 0), (1, 0), (0, 1), (-1, 0)]
    bodies = [Body(f"b{i}", Geom(Sphere(1), group=g, mask=m)) for i, (g, m) in enumerate(kinds)]
    expect = [
        [i, j] for i, (g, m) in enumerate(kinds) for j, (h, n) in enumerate(kinds) if i < j and ((g & n) or (h & m))
    ]
    assert resolve(Scene(bodies)).pairs.tolist() == expect


def _one(*pairs, a=None, b=None):
    """Friction, restitution of the pair of a ball and a floor."""
    floor = Geom(Plane(), name="floor") if b is None else b
    r = resolve(Scene([Body("ball", a or Sphere(1))], static=[floor], pairs=pairs))
    (mu,), (has_mu,) = r.pair_friction()
    (e,), (has_e,) = r.pair_restitution()
    return (mu if has_mu else None), (e if has_e else None)


def test_combination_by_the_larger_value():
    def f(mu, e=None, **kw):
        return Geom(Sphere(1), friction=mu, restitution=e, **kw)

    def g(mu, e=None, **kw):
        return Geom(Plane(), friction=mu, restitution=e, name="floor", **kw)

    assert _one(a=f(0.2, 0.5), b=g(0.3, 0.1)) == (0.3, 0.5)
    assert _one(a=f(None), b=g(None)) == (None, None)
    assert _one(a=f(None), b=g(0.3, 0.0)) == (0.3, 0.0)
    assert _one(a=f(0.0), b=g(None)) == (0.0, None)
    assert _one(a=f(0.9, condim=1), b=g(0.3)) == (0.9, None)  # MuJoCo: the larger condim, the larger friction
    assert _one(a=f(0.9, condim=1), b=g(0.3, condim=1)) == (None, None)
    assert _one(a=f(0.9, condim=1), b=g(None)) == (None, None)


def test_overrides():
    assert _one(Pair("ball", "floor", friction=0.1)) == (0.1, None)
    assert _one(Pair("floor", "ball", restitution=0.7)) == (1.0, 0.7)
    assert _one(Pair("ball", "floor", friction=None, restitution=0.0)) == (None, 0.0)
    assert _one(Pair("ball", "floor", condim=1)) == (None, None)
    assert _one(Pair("ball", "floor", condim=3), a=Geom(Sphere(1), condim=1)) == (1.0, None)
    r = resolve(Scene([Body("a", Geom(Sphere(1), solref=(-5, -1), margin=0.1))], static=Geom(Plane(), margin=0.2)))
    margin, solref, solimp = r.pair_softness()
    assert margin[0] == pytest.approx(0.3) and solref.tolist() == [[-5, -1]] and solimp[0, 0] == 0.9


def _turning(*pairs, a, b):
    """condim and the three coefficients of the pair of a ball and a floor."""
    floor = Geom(Plane(), name="floor", **b)
    r = resolve(Scene([Body("ball", Geom(Sphere(1), **a))], static=[floor], pairs=pairs))
    found = (r.pair_friction(), r.pair_torsional_friction(), r.pair_rolling_friction())
    return int(r.pair_condim()[0]), *(float(v[0]) if has[0] else None for v, has in found)


def test_torsional_and_rolling_friction_combine():
    three, four = dict(friction=0.3), dict(friction=0.2, torsional_friction=0.01)
    six = dict(four, rolling_friction=0.001)
    hidden = dict(six, torsional_friction=0.05, condim=3)  # has them, asks for none
    assert _turning(a=four, b=three) == (4, 0.3, 0.01, None)
    assert _turning(a=six, b=four) == (6, 0.2, 0.01, 0.001)
    assert _turning(a=hidden, b=three) == (3, 0.3, None, None)
    assert _turning(a=hidden, b=four) == (4, 0.2, 0.05, None)
    assert _turning(a=dict(friction=None), b=four) == (4, 0.2, 0.01, None)
    # of different priority the higher one alone
    assert _turning(a=dict(three, priority=1), b=six) == (3, 0.3, None, None)
    assert _turning(a=dict(six, priority=-1), b=four) == (4, 0.2, 0.01, None)
    # overrides
    pair = lambda **k: Pair("ball", "floor", **k)
    assert _turning(pair(torsional_friction=0.5), a=three, b=three) == (4, 0.3, 0.5, None)
    assert _turning(pair(torsional_friction=None), a=six, b=six) == (3, 0.2, None, None)
    assert _turning(pair(rolling_friction=0.0), a=four, b=three) == (6, 0.3, 0.01, 0.0)
    assert _turning(pair(friction=None), a=six, b=six) == (1, None, None, None)
    assert _turning(pair(condim=6), a=hidden, b=three) == (6, 0.3, 0.05, 0.001)
    assert _turning(pair(condim=4), a=six, b=six) == (4, 0.2, 0.01, None)
    assert _turning(pair(condim=3, torsional_friction=0.5), a=three, b=three) == (3, 0.3, None, None)
    # a body without friction has none of it
    frictionless = Body("b", Geom(Sphere(1), **six), friction=None)
    assert resolve(Scene([frictionless])).geom_condim.tolist() == [1]
    assert Geom(Sphere(1), **six) != Geom(Sphere(1), **six, condim=4)
    assert Body("b", Geom(Sphere(1), **six, condim=6)) == Body("b", Geom(Sphere(1), **six))


def test_exclusion_and_precedence():
    two = [Sphere(1), Sphere(1)]

    def make(*pairs):
        return resolve(Scene([Body("a", two), Body("b", two)], static=[Geom(Plane(), name="f")], pairs=pairs))

    assert len(make().pairs) == 4 + 4
    assert len(make(Pair("a", "b", exclude=True)).pairs) == 4
    assert len(make(Pair("a:0", "b", exclude=True)).pairs) == 6
    r = make(Pair("a", "b", exclude=True), Pair("a:0", "b:1", friction=0.5))  # the geoms win
    assert len(r.pairs) == 5 and r.pair_friction()[0][list(r.overrides)] == 0.5
    r = make(Pair("a", "f", friction=0.2), Pair("a:1", "f", friction=0.3))
    assert sorted(r.pair_friction()[0][list(r.overrides)]) == [0.2, 0.3]
    with pytest.raises(ValueError, match="given twice"):
        make(Pair("a", "b", exclude=True), Pair("b", "a", friction=1))


def test_a_pair_of_geoms_collides_whatever_the_masks():
    ghost = Body("g", Geom(Sphere(1), group=0, mask=0, name="ghost"))
    floor = Geom(Plane(), name="f")
    assert len(resolve(Scene([ghost], static=floor)).pairs) == 0
    assert len(resolve(Scene([ghost], static=floor, pairs=[Pair("ghost", "f")])).pairs) == 1
    assert len(resolve(Scene([ghost], static=floor, pairs=[Pair("g", "f")])).pairs) == 0  # bodies do not


def test_kinematic_bodies_may_hold_planes_and_ignore_mass():
    r = resolve(Scene([BALL], kinematic=[Body("lift", Plane(), mass=1.0), Body("marker")]))
    assert r.geom_names == ("ball", "lift") and len(r.pairs) == 1


def test_every_pair_of_a_large_scene_is_found():
    bodies = [Body(f"b{i}", Sphere(0.1)) for i in range(100)]
    static = [Geom(Box((1, 1, 1)), pos=(i, 0, 0)) for i in range(100)]
    r = resolve(Scene(bodies, static, pairs=[Pair("b0", f"static:{i}", exclude=True) for i in range(50)]))
    assert len(r.pairs) == 100 * 99 // 2 + 100 * 100 - 50
