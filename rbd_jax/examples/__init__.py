"""Example scenes, as MJCF files."""

from __future__ import annotations

from importlib import resources


def names() -> tuple[str, ...]:
    """Return the names of the shipped scenes, sorted."""
    return tuple(sorted(f.name[: -len(".xml")] for f in resources.files(__name__).iterdir() if f.name.endswith(".xml")))


def path(name: str) -> str:
    """Return the path of a shipped scene's MJCF file.

    Raises:
      ValueError: no scene of that name.
    """
    if name not in names():
        raise ValueError(f"example = {name!r} must be one of {', '.join(names())}")
    return str(resources.files(__name__).joinpath(f"{name}.xml"))
