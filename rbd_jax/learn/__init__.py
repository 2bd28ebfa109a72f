"""Learning on the engine: tasks as pure functions, adapters to other libraries, and two learners.

>>> import jax
>>> from rbd_jax.learn import make
>>> task = make("push")
>>> states, obs = jax.vmap(task.reset)(jax.random.split(jax.random.key(0), 64))
>>> states, out = jax.vmap(task.step)(states, jax.numpy.zeros((64, task.action_size)))
"""

from .environment import AutoReset, Environment, EnvState, Step, unroll
from .tasks import TASKS, make
from .watch import watch

__all__ = ["AutoReset", "EnvState", "Environment", "Step", "TASKS", "make", "unroll", "watch"]
