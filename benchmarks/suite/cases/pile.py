"""Many bodies: no truth but that rigid bodies do not overlap and none leaves; chaotic, so no limit is asked for."""

from __future__ import annotations

import numpy as np

from ..case import Case, box, sphere
from ..judge import overlap, random_quat
from .free import STEPS, G
from .impact import GROUND

MU = 0.5
FEATURES = frozenset({"contact", "friction", "attitude", "pairs"})
UNIT = "deepest overlap at the end, over the half-size"


def bin_of(width):
    """The ground and four walls ``width`` [m] apart."""
    h = width / 2
    return (*GROUND, ((-h, 0.0, 0.0), (1.0, 0.0, 0.0)), ((h, 0.0, 0.0), (-1.0, 0.0, 0.0)),
            ((0.0, -h, 0.0), (0.0, 1.0, 0.0)), ((0.0, h, 0.0), (0.0, -1.0, 0.0)))  # fmt: skip


def lattice(n, side, pitch, height, rise):
    """(n, 3) places of a square lattice, layer on layer."""
    k = np.arange(n)
    middle = (side - 1) / 2
    return np.stack([pitch * (k % side - middle), pitch * (k // side % side - middle), height + rise * (k // side**2)],
                    -1)  # fmt: skip


def dropped(places, noise=0.01, turned=False):
    n = len(places)

    def starts(worlds, rng):
        pos = places + rng.uniform(-noise, noise, (worlds, n, 3))
        quat = random_quat(rng, worlds, n) if turned else np.broadcast_to([1.0, 0, 0, 0], (worlds, n, 4))
        return pos, quat, 0.1 * rng.normal(size=(worlds, n, 3)), np.zeros((worlds, n, 3))

    return starts


def pile(name, title, parts, planes, starts, seconds=2.0, worlds=64):
    return Case(
        name=name, title=title, group="pile", parts=tuple(parts), planes=planes, friction=MU, restitution=None,
        gravity=G, starts=starts, seconds=seconds, samples=2, truth=None, reference="rigid bodies do not overlap",
        bound=0.0, error=overlap, unit=UNIT, distance=None, steps=STEPS, features=FEATURES, worlds=worlds,
    )  # fmt: skip


def balls(n, width, side):
    return [sphere(0.1)] * n, bin_of(width), dropped(lattice(n, side, (width - 0.24) / (side - 1), 0.15, 0.25))


MIXED = [sphere(0.1), box((0.12, 0.1, 0.1)), sphere(0.1), box((0.1, 0.1, 0.1))] * 2

CASES = (
    pile("pile16", "16 balls in a bin", *balls(16, 0.56, 2)),
    pile("pile64", "64 balls in a bin", *balls(64, 0.94, 4), worlds=32),
    pile("heap216", "216 spheres collapse (\"666\")", [sphere(0.1)] * 216, GROUND,
         dropped(lattice(216, 6, 0.21, 0.11, 0.21), 0.004), worlds=16),
    pile("clutter", "4 boxes and 4 balls in a bin", MIXED, bin_of(0.6), dropped(lattice(8, 2, 0.28, 0.16, 0.3))),
)  # fmt: skip
