"""Layer 0: frozen dataclasses that are JAX pytrees.

``@struct`` registers a frozen dataclass: array fields are leaves, fields made with
``static()`` are part of the tree structure (they select the program and must be hashable).
JAX also unflattens with placeholders, so that ``__post_init__`` must not look at leaves.
"""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import jax

T = TypeVar("T")


def static(**kwargs: Any) -> Any:
    """A dataclass field that is part of the tree structure: hashable, never traced."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


def struct(cls: type[T]) -> type[T]:
    """Make ``cls`` a frozen dataclass and register it as a pytree, with a ``_with`` method."""
    cls = dataclasses.dataclass(frozen=True, eq=False, repr=cls.__dict__.get("__repr__") is None)(cls)
    leaves = tuple(f.name for f in dataclasses.fields(cls) if not f.metadata.get("static"))
    fixed = tuple(f.name for f in dataclasses.fields(cls) if f.metadata.get("static"))
    jax.tree_util.register_dataclass(cls, leaves, fixed)

    def _with(self, **changes):
        """Return a copy with the named fields changed (no validation)."""
        return dataclasses.replace(self, **changes)

    cls._with = _with
    return cls
