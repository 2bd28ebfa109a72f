"""rbd_jax: batched, differentiable rigid-body dynamics in JAX.

>>> import rbd_jax as rbd
>>> scene = rbd.Scene(bodies=[rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 1))], static=[rbd.Plane()])
>>> model, state = rbd.build(scene, method="fast")
>>> final, traj = rbd.rollout(model, rbd.batch(state, 1024), steps=1000, every=10)
"""

from .audit import Audit, audit
from .build import build
from .contact.sdf import sdf
from .convert import from_mujoco, to_mujoco
from .diagnostics import Contacts, SimulationError, check, contacts, energy, inertia_world, momentum, wrench_at
from .estimate import memory_estimate
from .farm import farm
from .horizon import GradientNorms, gradient_norms
from .longrun import long_rollout
from .memory import MemoryEstimate
from .method import PRESETS, Method
from .mjcf import load_mjcf, to_mjcf
from .model import Model
from .processes import gathered, my_worlds
from .rollout import rollout, step
from .scene import Body, Geom, Pair, Scene
from .shapes import Box, Plane, Sphere
from .solvers import CONTACT_MODELS, SOLVERS
from .spread import use_cores
from .state import State, Wrench, batch
from .status import Status

__version__ = "0.1.0"

__all__ = [
    "Audit",
    "Body",
    "CONTACT_MODELS",
    "Box",
    "Contacts",
    "Geom",
    "GradientNorms",
    "MemoryEstimate",
    "Method",
    "Model",
    "PRESETS",
    "Pair",
    "Plane",
    "SOLVERS",
    "Scene",
    "SimulationError",
    "Sphere",
    "State",
    "Status",
    "Wrench",
    "audit",
    "batch",
    "build",
    "check",
    "contacts",
    "energy",
    "farm",
    "from_mujoco",
    "gathered",
    "gradient_norms",
    "inertia_world",
    "load_mjcf",
    "long_rollout",
    "memory_estimate",
    "momentum",
    "my_worlds",
    "rollout",
    "sdf",
    "step",
    "to_mjcf",
    "to_mujoco",
    "use_cores",
    "wrench_at",
]
