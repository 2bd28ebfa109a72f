"""Scenes that several test files share; equal scenes share compiled programs."""

import rbd_jax as rbd

MU = 0.5


def ground(**kwargs):
    return rbd.Geom(rbd.Plane(), **kwargs)


def ball(z=1.1, restitution=None, vel=None, friction=1.0):
    return rbd.Scene(
        bodies=[rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, z), vel=vel, restitution=restitution, friction=friction)],
        static=[ground(friction=friction)],
        dt=1 / 240,
    )


def box(z=0.5, vel=None, omega=(1.0, 2.0, 3.0), half=(0.1, 0.15, 0.2), friction=MU):
    return rbd.Scene(
        bodies=[rbd.Body("box", rbd.Box(half), pos=(0, 0, z), vel=vel, omega=omega, friction=friction)],
        static=[ground(friction=friction)],
        dt=1 / 240,
    )


def cube_sliding():
    return box(0.1, vel=(3.0, 0, 0), omega=(0.0, 0, 0), half=(0.1, 0.1, 0.1))


def stack(n=5, half=0.1, friction=0.6, dt=1 / 240):
    return rbd.Scene(
        bodies=[
            rbd.Body(f"box{i}", rbd.Box((half, half, half)), pos=(0, 0, half * (2 * i + 1)), friction=friction)
            for i in range(n)
        ],
        static=[ground(friction=friction)],
        dt=dt,
    )


def two_spheres(restitution=0.5):
    return rbd.Scene(
        bodies=[
            rbd.Body("a", rbd.Sphere(0.1), pos=(0, 0, 0), vel=(1, 0, 0), mass=1.0, restitution=restitution),
            rbd.Body("b", rbd.Sphere(0.2), pos=(0.5, 0.1, 0), mass=3.0, restitution=restitution),
        ],
        gravity=None,
        dt=1 / 240,
    )
