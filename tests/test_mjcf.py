"""MJCF in and out, against the compiled MuJoCo model. References: MuJoCo 4.0.1."""

import dataclasses
import math
import warnings

import mujoco
import numpy as np
import pytest

from rbd_jax import examples
from rbd_jax.mjcf import compile_mujoco, load_mjcf, to_mjcf
from rbd_jax.scene import Body, Geom, Pair, Scene, mass_properties, resolve, rotation
from rbd_jax.shapes import Box, Plane, Sphere


@pytest.fixture(autouse=True)
def _log_elsewhere(monkeypatch, tmp_path):
    """MuJoCo writes its warnings to MUJOCO_LOG.TXT in the working directory."""
    monkeypatch.chdir(tmp_path)


def mjcf(world, rest="", option='<option cone="elliptic"/>'):
    return f"<mujoco>{option}<worldbody>{world}</worldbody>{rest}</mujoco>"


BALL = '<body name="ball"><freejoint/><geom name="ball" size="0.1"/></body>'
FLOOR = '<geom name="floor" type="plane" size="0 0 1"/>'


def random_scene(seed):
    """Compound bodies, turned inertias, offsets, all fields."""
    rng = np.random.default_rng(seed)

    def number():
        return float(rng.normal() * 10.0 ** rng.integers(-2, 3))

    def vec(n=3):
        return tuple(number() for _ in range(n))

    def pick(*options):
        return options[rng.integers(len(options))]

    def surface():
        friction = pick(None, 0.0, abs(number()), 1.0)
        spin = None if friction is None else pick(None, 0.0, abs(number()))
        roll = None if spin is None else pick(None, 0.0, abs(number()))
        most = 3 + (spin is not None) + 2 * (roll is not None)
        return {
            "friction": friction,
            "torsional_friction": spin,
            "rolling_friction": roll,
            "priority": pick(0, 0, 1),
            "restitution": pick(None, 0.0, float(rng.random())),
            "group": int(rng.integers(0, 4)),
            "mask": int(rng.integers(0, 4)),
            "margin": pick(0.0, abs(number())),
            "solref": pick((0.02, 1.0), (abs(number()), abs(number())), (-abs(number()), -abs(number()))),
            "solimp": (float(rng.random()), float(rng.random()), abs(number()), float(rng.random()), 1 + abs(number())),
            # without friction it means nothing and comes back as None
            "condim": None if friction is None else pick(None, *(d for d in (1, 3, 4, 6) if d <= most)),
        }

    def geom(name=None, planes=False):
        shape = pick(Sphere(abs(number())), Box(tuple(abs(v) for v in vec())), *([Plane()] if planes else []))
        return Geom(shape, pos=vec(), quat=vec(4), name=name, **surface())

    def body(i):
        fields = pick("density", "mass", "com", "full", "diagonal")
        a = rng.normal(size=(3, 3))
        spread = a @ a.T
        inertia = (np.trace(spread) * np.eye(3) - spread) * 10.0 ** rng.integers(-3, 3)
        mass = {
            "density": {"density": abs(number())},
            "mass": {"mass": abs(number())},
            "com": {"mass": abs(number()), "com": vec()},
            "full": {"mass": abs(number()), "inertia": inertia, "com": vec()},
            "diagonal": {"mass": abs(number()), "inertia": np.linalg.eigvalsh(inertia)},
        }[fields]
        return Body(
            f"body {i}",
            [geom(pick(None, f"g<{i}>&{j}")) for j in range(rng.integers(1, 4))],
            pos=vec(),
            quat=vec(4),
            vel=pick(None, (0.0, 0.0, 0.0), vec()),
            omega=pick(None, (0.0, 0.0, 0.0), vec()),
            **mass,
        )

    def belt(i):
        return Body(
            f"belt{i}",
            [geom(planes=True)],
            pos=vec(),
            quat=vec(4),
            vel=pick(None, vec()),
            omega=pick(None, vec()),
            mass=pick(None, abs(number())),
        )

    bodies = [body(i) for i in range(4)]
    return Scene(
        bodies=bodies,
        static=[geom(planes=True) for _ in range(3)],
        kinematic=[belt(i) for i in range(2)],
        pairs=[
            Pair("body 0", "body 1", exclude=True),
            Pair("body 2", "static:1", exclude=True),
            Pair("body 1", "static:0", friction=pick(None, 0.0, abs(number())), restitution=pick(None, 0.25)),
            Pair("body 3", "static:0", friction=0.5, torsional_friction=pick(0.0, 0.3, None)),
            Pair("body 3", "body 2", margin=abs(number()), solref=(abs(number()), 1.0)),
        ],
        gravity=pick(None, (0.0, 0.0, 0.0), vec()),
        dt=abs(number()),
        drag=pick(None, 0.0, abs(number()), (abs(number()), 0.0)),
        name=f"scene {seed}",
        integrator=pick("euler", "implicitfast", "rk4"),
        impratio=abs(number()),
        solver=pick("pgs", "cg", "newton"),
        iterations=int(rng.integers(1, 300)),
        tolerance=abs(number()),
        refsafe=bool(rng.integers(2)),
    )


# Round trip


@pytest.mark.parametrize("seed", range(40))
def test_round_trip_keeps_every_number(seed):
    scene = random_scene(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = load_mjcf(to_mjcf(scene))
    assert again == scene
    assert to_mjcf(again) == to_mjcf(scene)
    a, b = resolve(scene), resolve(again)
    for field in dataclasses.fields(a):
        if field.name not in ("scene", "overrides"):
            assert np.array_equal(getattr(a, field.name), getattr(b, field.name)), field.name


def test_round_trip_of_shorthand_is_that_of_its_geoms():
    scene = Scene([Body("b", [Sphere(1), Sphere(2)], friction=0.0, restitution=0.3)], static=Plane())
    a, b = resolve(scene), resolve(load_mjcf(to_mjcf(scene)))
    assert np.array_equal(a.geom_friction, b.geom_friction) and np.array_equal(a.geom_has_friction, b.geom_has_friction)
    assert np.array_equal(a.geom_restitution, b.geom_restitution)


def test_an_edited_file_wins_over_its_custom_digits():
    scene = Scene([Body("b", Box((0.1, 0.2, 0.3)), density=500, vel=(1, 2, 3), omega=(0, 0, 1))], static=Plane())
    xml = to_mjcf(scene)
    mass = repr(mass_properties(scene.bodies[0])[0])
    heavy = load_mjcf(xml.replace(f'mass="{mass}"', 'mass="77"'))
    assert heavy.bodies[0].mass == 77 and heavy.bodies[0].density is None
    faster = load_mjcf(xml.replace('qvel="1.0 2.0 3.0', 'qvel="9.0 2.0 3.0'))
    assert faster.bodies[0].vel == (9, 2, 3)
    big = load_mjcf(xml.replace('size="0.1 0.2 0.3"', 'size="0.5 0.2 0.3"'))
    assert big.bodies[0].geoms[0].shape == Box((0.5, 0.2, 0.3)) and big.bodies[0].mass == float(mass)


def test_an_edited_contact_section_wins_with_a_warning():
    scene = Scene([Body("b", Sphere(1))], static=[Plane()], pairs=[Pair("b", "static:0", friction=0.25)])
    xml = to_mjcf(scene).replace('friction="0.25 0.25', 'friction="0.5 0.5')
    with pytest.warns(UserWarning, match="rbd_pairs.*ignored"):
        again = load_mjcf(xml)
    assert resolve(again).pair_friction()[0] == 0.5


# The exported file is a correct MuJoCo model


@pytest.mark.parametrize("seed", range(10))
def test_exported_model_has_our_numbers(seed):
    scene = random_scene(seed)
    r = resolve(scene)
    m, d = compile_mujoco(scene)
    mujoco.mj_subtreeVel(m, d)
    for i, name in enumerate(r.body_names):
        b = m.body(name).id
        turn = rotation(r.quat[i])
        assert m.body_mass[b] == pytest.approx(r.mass[i], rel=1e-14)
        q = rotation(m.body_iquat[b])
        scale = r.inertia[i].max()
        assert np.allclose(q @ np.diag(m.body_inertia[b]) @ q.T, r.inertia[i], rtol=0, atol=1e-12 * scale)
        assert np.allclose(d.xipos[b], r.pos[i] + turn @ r.com[i], rtol=1e-12)
        size = np.abs(r.vel[i]).max() + np.abs(r.omega[i]).max() * np.abs(r.com[i]).max() + 1e-12
        assert np.allclose(d.subtree_linvel[b], r.vel[i], rtol=0, atol=1e-12 * size)
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_BODY, b, velocity, 0)  # inertial frame's, world axes
        assert np.allclose(velocity[:3], r.omega[i], rtol=1e-12, atol=1e-12)
        assert np.allclose(velocity[3:], r.vel[i], rtol=0, atol=1e-12 * size)
    for g, name in enumerate(r.geom_names):
        k = m.geom(name).id
        three = (r.geom_friction[g], r.geom_torsional_friction[g], r.geom_rolling_friction[g])
        assert tuple(m.geom_friction[k]) == three and m.geom_condim[k] == r.geom_condim[g]
        assert m.geom_priority[k] == r.geom_priority[g]
        assert np.array_equal(m.geom_pos[k], r.geom_pos[g]) and np.array_equal(m.geom_quat[k], r.geom_quat[g])
    assert m.opt.timestep == scene.dt and m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC


@pytest.mark.parametrize("seed", range(30))
def test_pairs_and_their_numbers_are_those_of_mujocos_contacts(seed):
    """All geoms in one place: each pair that may touch does."""
    rng = np.random.default_rng(seed)
    scene = random_scene(seed)

    def put(g, shape=Sphere(1.0)):
        return dataclasses.replace(g, pos=tuple(rng.normal(size=3) * 1e-2), shape=shape, margin=0.01)

    def put_body(b):
        return dataclasses.replace(b, pos=(0, 0, 0), geoms=[put(g) for g in b.geoms], com=None)

    scene = dataclasses.replace(
        scene,
        bodies=[put_body(b) for b in scene.bodies],
        kinematic=[put_body(b) for b in scene.kinematic],
        static=[put(g, Plane() if g.shape == Plane() else Sphere(1.0)) for g in scene.static],
    )
    r = resolve(scene)
    m, d = compile_mujoco(scene)
    margin, solref, solimp = r.pair_softness()
    coefficients = [v for v, _ in (r.pair_friction(), r.pair_torsional_friction(), r.pair_rolling_friction())]
    condim = r.pair_condim()
    row = {frozenset(r.geom_names[g] for g in p): k for k, p in enumerate(r.pairs.tolist())}
    seen = set()
    for c in d.contact:
        names = frozenset(m.geom(int(g)).name for g in c.geom)
        k = row[names]
        seen.add(k)
        assert c.dim == condim[k]
        five = np.array([coefficients[i][k] for i in (0, 0, 1, 2, 2)])[: c.dim - 1]
        assert np.allclose(c.friction[: c.dim - 1], np.maximum(five, 1e-5), rtol=1e-15)  # MuJoCo's least friction
        assert c.includemargin == pytest.approx(margin[k], rel=1e-14)
        assert np.allclose(c.solref, solref[k], rtol=1e-14) and np.allclose(c.solimp, solimp[k], rtol=1e-14)
    assert seen == set(row.values())


def test_flat_bodies_compile():
    """On the bound of the triangle inequality, turned and heavy: rounding breaks it."""
    turn = rotation(np.array([1, 2, 3, 4]) / math.sqrt(30))
    bodies = [
        Body(f"b{k}", mass=1.0, inertia=turn @ np.diag([1, 2, 3]) @ turn.T * 10.0**k, pos=(k, 0, 0))
        for k in range(-3, 7)
    ]
    scene = Scene(bodies)
    compile_mujoco(scene)
    assert load_mjcf(to_mjcf(scene)) == scene


# Velocities and keyframes


def test_qvel_is_the_origins_velocity_and_the_body_frames_omega():
    world = (
        '<body name="b" pos="1 2 3" quat="0.5 0.1 -0.7 0.3"><freejoint/>'
        '<inertial pos="0.1 0.2 -0.3" mass="2" fullinertia="3 4 5 0.1 0.2 0.3"/><geom size="0.1"/></body>'
    )
    key = '<keyframe><key name="k" qpos="3 2 1 0.2 0.3 0.4 -0.5" qvel="1 2 3 4 5 6"/></keyframe>'
    scene = load_mjcf(mjcf(world, key))
    (b,) = scene.bodies
    m = mujoco.MjModel.from_xml_string(mjcf(world, key))
    d = mujoco.MjData(m)
    mujoco.mj_resetDataKeyframe(m, d, 0)
    mujoco.mj_forward(m, d)
    mujoco.mj_subtreeVel(m, d)
    assert b.pos == (3, 2, 1) and np.allclose(b.quat, d.qpos[3:7], rtol=0, atol=1e-15)
    assert np.allclose(b.vel, d.subtree_linvel[1], rtol=0, atol=1e-14)
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_BODY, 1, velocity, 0)
    assert np.allclose(b.omega, velocity[:3], rtol=0, atol=1e-14)
    # a finite difference, free of any convention
    before = d.xipos[1].copy()
    m.opt.timestep, m.opt.gravity[:] = 1e-7, 0
    mujoco.mj_step(m, d)
    mujoco.mj_forward(m, d)
    assert np.allclose((d.xipos[1] - before) / 1e-7, b.vel, atol=1e-5)


def test_keyframes():
    keys = (
        '<keyframe><key name="low" qpos="0 0 1 1 0 0 0"/><key name="high" qpos="0 0 9 1 0 0 0" qvel="0 0 5 0 0 0" '
        'mpos="7 0 0" mquat="0 1 0 0"/></keyframe>'
    )
    xml = mjcf(BALL + '<body name="m" mocap="true" pos="1 0 0"><geom size="1"/></body>', keys)

    def at(key):
        return load_mjcf(xml, keyframe=key)

    assert at(None).bodies[0].pos == (0, 0, 1) == at("low").bodies[0].pos == at(0).bodies[0].pos
    assert at("high").bodies[0].pos == (0, 0, 9) == at(1).bodies[0].pos and at(1).bodies[0].vel == (0, 0, 5)
    assert at(1).kinematic[0].pos == (7, 0, 0) and at(1).kinematic[0].quat == (0, 1, 0, 0)
    assert at(False).bodies[0].pos == (0, 0, 0) and at(False).kinematic[0].pos == (1, 0, 0)
    with pytest.raises(ValueError, match=r"keyframe = 'mid' must be one of \['low', 'high'\]"):
        at("mid")
    with pytest.raises(ValueError, match="keyframe = 2 must be below"):
        at(2)
    with pytest.raises(TypeError, match="keyframe = True"):
        at(True)


# The subset


def test_defaults_includes_replicate_frames(tmp_path):
    (tmp_path / "common.xml").write_text(
        '<mujoco><default><geom friction="0.7" solref="0.05 0.8" density="200"/>'
        '<default class="box"><geom type="box" size="0.1 0.2 0.3" margin="0.01"/></default></default></mujoco>'
    )
    (tmp_path / "ground.xml").write_text(f"<mujoco><worldbody>{FLOOR}</worldbody></mujoco>")
    main = tmp_path / "main.xml"
    main.write_text(
        '<mujoco model="m"><include file="common.xml"/><include file="ground.xml"/><option cone="elliptic"/><worldbody>'
        '<frame pos="0 0 1" euler="0 0 90"><replicate count="3" offset="1 0 0">'
        '<body name="b"><freejoint/><geom class="box" name="g"/></body></replicate></frame></worldbody></mujoco>'
    )
    for source in (main, str(main)):
        scene = load_mjcf(source)
        assert scene.name == "m"
        assert [b.name for b in scene.bodies] == ["b0", "b1", "b2"]
        assert np.allclose([b.pos for b in scene.bodies], [(0, 0, 1), (0, 1, 1), (0, 2, 1)], atol=1e-15)
        g = scene.bodies[0].geoms[0]
        assert (g.shape, g.friction, g.margin, g.solref) == (Box((0.1, 0.2, 0.3)), 0.7, 0.01, (0.05, 0.8))
        assert scene.bodies[0].mass == pytest.approx(200 * 0.048)
        assert scene.static[0].friction == 0.7 and scene.static[0].shape == Plane()


def test_inferred_inertia_is_ours():
    """MuJoCo's compiler and resolve agree on compound bodies."""
    world = (
        '<body name="b"><freejoint/><geom type="box" size=".1 .2 .3" pos="1 0 0" quat="1 2 3 4"/>'
        '<geom size=".3" pos="0 1 0"/></body><body name="one"><freejoint/><geom type="box" size=".3 .2 .1"/></body>'
    )
    for body in load_mjcf(mjcf(world)).bodies:
        mass, com, inertia = mass_properties(body)
        expect = mass_properties(Body("b", body.geoms, density=1000.0))
        assert mass == pytest.approx(expect[0], rel=1e-14)
        assert np.allclose(com, expect[1], rtol=1e-13, atol=1e-15)
        assert np.allclose(inertia, expect[2], rtol=0, atol=1e-12 * inertia.max())
    assert np.shape(body.inertia) == (3,)


def test_isotropic_stays_isotropic_and_diagonal_diagonal():
    world = (
        '<body><freejoint/><geom size="0.1" quat="1 2 3 4"/></body>'
        '<body><freejoint/><geom type="box" size=".1 .2 .3" quat="0 1 1 0"/></body>'
    )
    ball, box = load_mjcf(mjcf(world)).bodies
    assert len(set(ball.inertia)) == 1 and np.shape(box.inertia) == (3,)
    assert (ball.name, box.name) == ("body1", "body2")


def test_freejoint_align_moves_the_body_frame():
    body = '<body name="b"><freejoint align="{}"/><inertial pos="1 0 0" mass="1" fullinertia="2 2 3 0.5 0 0"/></body>'
    plain, aligned = (load_mjcf(mjcf(body.format(a))).bodies[0] for a in ("false", "true"))
    assert plain.com == (1, 0, 0) and aligned.com == (0, 0, 0) and aligned.pos == (1, 0, 0)
    assert np.shape(plain.inertia) == (3, 3) and np.shape(aligned.inertia) == (3,)


def test_jointless_bodies_become_static_geoms():
    xml = mjcf(
        BALL + '<body name="table" pos="1 0 0" quat="1 0 0 1"><geom name="top" type="box" size="1 1 1" pos="1 0 0"/>'
        '<body pos="0 0 5"><geom size="2"/></body></body>',
        '<contact><exclude body1="table" body2="ball"/></contact>',
    )
    scene = load_mjcf(xml)
    assert [g.name for g in scene.static] == ["top", None]
    assert np.allclose(scene.static[0].pos, (1, 1, 0), atol=1e-15)
    assert np.allclose(scene.static[1].pos, (1, 0, 5), atol=1e-15)
    assert resolve(scene).pairs.tolist() == [[0, 2]]


def test_options():
    option = (
        '<option timestep="0.01" gravity="1 2 3" integrator="RK4" cone="elliptic" impratio="10" solver="CG" '
        'iterations="7" tolerance="1e-5"><flag refsafe="disable"/></option>'
    )
    s = load_mjcf(mjcf(BALL, option=option))
    assert (s.dt, s.gravity, s.integrator, s.impratio) == (0.01, (1, 2, 3), "rk4", 10)
    assert (s.solver, s.iterations, s.tolerance, s.refsafe) == ("cg", 7, 1e-5, False)
    assert load_mjcf(mjcf(BALL, option='<option><flag gravity="disable"/></option>')).gravity is None


def test_visual_elements_are_ignored_and_visual_geoms_weigh():
    xml = mjcf(
        '<light/><camera/><site name="s"/><body name="b"><freejoint/><geom name="hit" size="0.1" mass="1"/><site/>'
        '<geom name="show" type="capsule" size="1 1" contype="0" conaffinity="0" mass="2"/>'
        '<geom name="ball" size="1" contype="0" conaffinity="0" mass="4" condim="6"/></body>',
        "<sensor><framepos objtype='site' objname='s'/></sensor><asset><material name='m'/></asset>",
    )
    scene = load_mjcf(xml)
    assert [g.name for g in scene.bodies[0].geoms] == ["hit", "ball"] and scene.bodies[0].mass == 7
    assert (scene.bodies[0].geoms[1].group, scene.bodies[0].geoms[1].mask) == (0, 0)


def test_pyramidal_cone_is_said_once_where_it_matters():
    with pytest.warns(UserWarning, match="pyramidal friction cone is treated as elliptic") as caught:
        load_mjcf(mjcf(BALL + FLOOR, option=""))
    assert len(caught) == 1 and caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_mjcf(mjcf(BALL, option=""))  # nothing to touch
        load_mjcf(mjcf(BALL + FLOOR))
        load_mjcf(mjcf((BALL + FLOOR).replace("size", 'condim="1" size'), option=""))


def friction_of(xml, **kwargs):
    r = resolve(load_mjcf(xml, **kwargs))
    mu, has = r.pair_friction()
    return [float(v) if h else None for v, h in zip(mu, has)]


@pytest.mark.parametrize("seed", range(20))
def test_any_condim_friction_and_priority_combine_as_in_mujoco(seed):
    rng = np.random.default_rng(seed)

    def attributes():
        friction = " ".join(str(rng.choice([0.0, 0.001, 0.02, 0.7])) for _ in range(3))
        return f'size="1" condim="{rng.choice([1, 3, 4, 6])}" friction="{friction}" priority="{rng.choice([0, 0, 1])}"'

    bodies = "".join(f"<body><freejoint/><geom {attributes()}/></body>" for _ in range(4))
    xml = mjcf(f"<geom {attributes()}/>{bodies}<geom {attributes()}/>")
    m = mujoco.MjModel.from_xml_string(xml)
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    scene = load_mjcf(xml)
    r = resolve(scene)
    ids = np.argsort(m.geom_bodyid == 0, kind="stable").tolist()  # ours come last where they are fixed
    row = {frozenset(ids[g] for g in p): k for k, p in enumerate(r.pairs.tolist())}
    assert len(row) == len(d.contact)
    for c in d.contact:
        k = row[frozenset(c.geom.tolist())]
        ours = (r.pair_friction()[0], r.pair_torsional_friction()[0], r.pair_rolling_friction()[0])
        for value, i, least in zip(ours, (0, 2, 3), (3, 4, 6)):
            theirs = c.friction[i] if c.dim >= least else 0.0
            assert value[k] == (theirs if theirs > 1e-5 else 0.0), (i, c.dim, c.friction)
    assert load_mjcf(to_mjcf(scene)) == scene


@pytest.mark.parametrize("kinds", [((1, 1), (3, 0.5)), ((1, 0.2), (3, 0.5)), ((1, 1), (1, 0.3)), ((3, 0), (3, 0)),
                                   ((1, 1), (3, 0)), ((3, 0), (3, 0.4)), ((1, 0), (3, 0))])  # fmt: skip
def test_condim_and_friction_combine_as_in_mujoco(kinds):
    (c1, f1), (c2, f2) = kinds
    xml = mjcf(
        f'<body name="a"><freejoint/><geom size="1" condim="{c1}" friction="{f1}"/></body>'
        f'<body name="b"><freejoint/><geom size="1" condim="{c1}" friction="{f1}"/></body>'
        f'<geom size="1" condim="{c2}" friction="{f2}"/>'
    )
    m = mujoco.MjModel.from_xml_string(xml)
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    theirs = {tuple(c.geom): (c.friction[0] if c.dim == 3 and c.friction[0] > 1e-5 else None) for c in d.contact}
    mine = friction_of(xml)
    assert mine == [theirs[1, 2], theirs[0, 1], theirs[0, 2]]  # a-b, a-fixed, b-fixed


def test_zeros_are_absent_unless_kept():
    xml = mjcf(
        '<body name="b"><freejoint/><geom size="1" friction="0"/></body><geom size="1" friction="0"/>',
        option='<option gravity="0 0 0" cone="elliptic"/>',
    )
    s = load_mjcf(xml)
    assert s.gravity is None and s.bodies[0].geoms[0].friction is None and s.static[0].friction is None
    assert s.bodies[0].omega is None and s.bodies[0].vel is None
    s = load_mjcf(xml, keep=("friction", "gravity", "omega", "vel"))
    assert s.gravity == (0, 0, 0) and s.bodies[0].geoms[0].friction == 0.0 and s.static[0].friction == 0.0
    assert s.bodies[0].omega == (0, 0, 0) == s.bodies[0].vel
    assert load_mjcf(xml, keep="omega").bodies[0].omega == (0, 0, 0)
    # friction may turn a body that starts without spin
    assert load_mjcf(mjcf(BALL + FLOOR)).bodies[0].omega == (0, 0, 0)
    with pytest.raises(ValueError, match="keep = 'mass' must be one of"):
        load_mjcf(xml, keep=("mass",))


def test_restitution():
    xml = mjcf(BALL + FLOOR, '<custom><numeric name="rbd_restitution:ball" data="0.4"/></custom>')

    def restitutions(s):
        return (s.bodies[0].geoms[0].restitution, s.static[0].restitution)

    assert restitutions(load_mjcf(xml)) == (0.4, None)
    assert restitutions(load_mjcf(xml, restitution=0.8)) == (0.8, 0.8)
    with pytest.raises(ValueError, match="restitution = 1.5 must be between 0 and 1"):
        load_mjcf(xml, restitution=1.5)


def test_contact_pairs_and_exclusions():
    xml = mjcf(
        BALL + FLOOR + '<body name="two"><freejoint/><geom name="two" size="1" contype="0" conaffinity="0"/></body>',
        '<contact><exclude body1="ball" body2="world"/>'
        '<pair geom1="two" geom2="floor" friction="0.3 0.3" margin="0.1"/>'
        '<pair geom1="two" geom2="ball" condim="1"/></contact>',
    )
    r = resolve(load_mjcf(xml))
    assert r.pairs.tolist() == [[0, 1], [1, 2]]
    assert friction_of(xml) == [None, 0.3] and r.pair_softness()[0].tolist() == [0.0, 0.1]
    six = xml.replace('friction="0.3 0.3"', 'friction="0.3 0.3 0.04 0.002 0.002" condim="6"')
    assert resolve(load_mjcf(six)).pair_rolling_friction()[0].tolist() == [0.0, 0.002]
    assert resolve(load_mjcf(six)).pair_torsional_friction()[0].tolist() == [0.0, 0.04]
    four = six.replace('condim="6"', 'condim="4"').replace("0.002 0.002", "0.002 0.1")
    assert not resolve(load_mjcf(four)).pair_rolling_friction()[1].any()
    with pytest.raises(ValueError, match="friction = 0.002 0.1 .anisotropic.; the last two must be equal"):
        load_mjcf(four.replace('condim="4"', 'condim="6"'))


def test_mocap_velocity_from_custom():
    xml = mjcf(
        BALL + '<body name="belt" mocap="true" pos="0 0 1"><geom type="box" size="1 1 1"/></body>',
        '<custom><numeric name="rbd_vel:belt" data="1 0 0"/><numeric name="rbd_omega:belt" data="0 0 2"/></custom>',
    )
    (belt,) = load_mjcf(xml).kinematic
    assert belt.vel == (1, 0, 0) and belt.omega == (0, 0, 2) and belt.pos == (0, 0, 1) and belt.mass is None


# Refusals


def test_all_refusals_at_once():
    xml = """
    <mujoco>
      <option integrator="implicit" density="1.2" viscosity="0.1" noslip_iterations="3">
        <flag override="enable" sleep="enable" contact="disable"/></option>
      <worldbody>
        <body name="arm"><joint name="elbow" type="hinge"/><geom name="bone" type="capsule" size="1 1"/>
          <body name="hand"><joint name="wrist" type="ball"/><joint name="rail" type="slide"/><geom size="1"/></body>
        </body>
        <body name="free"><joint name="loose" type="free" damping="1" armature="2" frictionloss="3" stiffness="4"/>
          <geom name="can" type="cylinder" size="1 1"/><geom name="egg" type="ellipsoid" size="1 1 1" condim="4"/>
          <body name="rider"><geom size="1"/></body></body>
        <body name="balloon" gravcomp="1"><freejoint/>
          <geom name="g6" size="1" condim="6" gap="0.1" adhesion="2" surfacevel="1 0 0 0 0 0" priority="2"/></body>
        <geom name="s" size="1" solmix="3" solref="0.1 1"/>
      </worldbody>
      <contact><pair name="p" geom1="g6" geom2="s" friction="0.3" solreffriction="0.1 1" gap="1"/>
        <pair name="p4" geom1="can" geom2="s" condim="6" friction="1 1 0.1 0.01 0.02"/></contact>
      <tendon><fixed name="cord"><joint joint="elbow" coef="1"/></fixed></tendon>
      <actuator><motor name="muscle" joint="elbow"/></actuator>
      <equality><weld name="glue" body1="free" body2="balloon"/></equality>
      <custom><numeric name="rbd_restitution:nobody" data="0.5"/><numeric name="rbd_speed" data="1"/>
        <numeric name="rbd_vel:free" data="1 2"/><text name="rbd_note" data="x"/></custom>
    </mujoco>"""
    with pytest.raises(ValueError) as error:
        load_mjcf(xml)
    text = str(error.value)
    for reason in [
        "option integrator = implicit; must be Euler, implicitfast, RK4",
        "option density = 1.2 (forces of a fluid)",
        "option viscosity = 0.1",
        "option noslip_iterations = 3",
        "flag override = enable",
        "flag sleep = enable",
        "flag contact = disable",
        "joint 'elbow' (body 'arm'): hinge joint; only free joints are simulated",
        "joint 'wrist' (body 'hand'): ball joint",
        "joint 'rail' (body 'hand'): slide joint",
        "joint 'loose' (body 'free'): stiffness = 4 on a free joint; must be 0",
        "joint 'loose' (body 'free'): damping = 1",
        "joint 'loose' (body 'free'): armature = 2",
        "joint 'loose' (body 'free'): frictionloss = 3",
        "body 'hand': nested in body 'arm'",
        "body 'rider': nested in body 'free'",
        "body 'balloon': gravcomp = 1",
        "geom 'bone' (body 'arm'): capsule geom; only sphere, box and plane are simulated",
        "geom 'can' (body 'free'): cylinder geom",
        "geom 'egg' (body 'free'): ellipsoid geom",
        "geom 'g6' (body 'balloon'): gap = 0.1",
        "geom 'g6' (body 'balloon'): adhesion = 2",
        "geom 'g6' (body 'balloon'): surfacevel = 1",
        "geom solmix",
        "tendon 'cord': not simulated",
        "actuator 'muscle': not simulated",
        "equality constraint 'glue': not simulated",
        "pair 'p': friction = 0.3 1 (anisotropic)",
        "pair 'p': solreffriction = 1",
        "pair 'p': gap = 1",
        "pair 'p4': friction = 0.01 0.02 (anisotropic); the last two must be equal",
        "custom numeric 'rbd_restitution:nobody': no geom named 'nobody'",
        "custom numeric 'rbd_speed': unknown name",
        "custom numeric 'rbd_vel:free': data = (1.0, 2.0) must have 3 entries",
        "custom text 'rbd_note': unknown name",
    ]:
        assert reason in text, reason
    assert text.count("\n  - ") == 36 - 1


@pytest.mark.parametrize(
    "world, reason",
    [
        ("", "no free body"),
        ('<body><joint/><geom size="1"/></body>', "joint 0 (body 'body1'): hinge joint"),
        (BALL + '<body mocap="true" name="m"><geom size="1"/><body name="n"/></body>', "body 'n': nested in body 'm'"),
        (BALL.replace("size", 'type="mesh" mesh="m" size'), "geom 'ball' (body 'ball'): mesh geom"),
    ],
)
def test_single_refusals(world, reason):
    rest = '<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>' if "mesh" in world else ""
    with pytest.raises(ValueError) as error:
        load_mjcf(mjcf(world, rest))
    assert reason in str(error.value)


def test_bad_sources(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing.xml: no such MJCF file"):
        load_mjcf("nothing.xml")
    with pytest.raises(IsADirectoryError):
        load_mjcf(tmp_path)
    with pytest.raises(ValueError, match="MJCF text: MuJoCo cannot compile it"):
        load_mjcf("<mujoco><")
    bad = tmp_path / "bad.xml"
    bad.write_text('<mujoco><worldbody><body name="b"><freejoint/></body></worldbody></mujoco>')
    with pytest.raises(ValueError, match=r"bad.xml: MuJoCo cannot compile it: .*\bmass"):
        load_mjcf(bad)
    with pytest.raises(ValueError, match="URDF is not supported"):
        load_mjcf('<robot name="r"><link name="l"/></robot>')


# Examples


def test_example_names_and_paths():
    assert examples.names() == (
        "ball_pile", "bouncing_balls", "box_stack", "clutter", "compound", "conveyor", "dominoes", "tumbling_box",
    )  # fmt: skip
    with pytest.raises(ValueError, match="example = 'pile' must be one of ball_pile"):
        examples.path("pile")


@pytest.mark.parametrize("name", examples.names())
def test_examples_load_without_warning_and_round_trip(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_mjcf(examples.path(name))
    assert scene.name == name
    assert load_mjcf(to_mjcf(scene)) == scene


def test_examples_hold_what_they_say():
    def load(name):
        return load_mjcf(examples.path(name))

    assert [b.geoms[0].restitution for b in load("bouncing_balls").bodies] == [0.4, 0.8, 0.95]
    stack = load("box_stack")
    assert len(stack.bodies) == 5 and stack.dt == 1 / 240 and stack.bodies[0].geoms[0].friction == 0.6
    assert len(load("ball_pile").bodies) == 16 and len(load("clutter").bodies) == 8
    assert load("conveyor").kinematic[0].vel == (0.5, 0, 0)
    assert load("tumbling_box").gravity is None and load("tumbling_box").bodies[0].omega == (0.05, 5, 0.05)
    assert load("dominoes").bodies[0].vel == (2, 0, 0)
    assert any(np.any(np.abs(mass_properties(b)[1]) > 0.01) for b in load("compound").bodies)
