"""Tasks, one file each; a file with a ``TASK`` is found by its name."""

from __future__ import annotations

import importlib
import pkgutil

from ..environment import Environment

#: Name -> class.
TASKS: dict[str, type[Environment]] = {}
for _, _name, _ in pkgutil.iter_modules(__path__):
    _task = importlib.import_module(f"{__name__}.{_name}").TASK
    TASKS[_task.name] = _task


def make(name: str, **options) -> Environment:
    """The task of that name; options as :class:`rbd_jax.learn.Environment` takes them.

    Raises:
      ValueError: an unknown name.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task '{name}'; tasks: {', '.join(TASKS)}")
    return TASKS[name](**options)
