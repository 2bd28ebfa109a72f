"""Layer 9: pictures, movies, scenes for other programs and pages of a trajectory; no GL driver, no network."""

from __future__ import annotations

import os

from .clip import Clip
from .gltf import write_glb
from .html import write_html
from .movie import pictures, write_gif, write_mp4
from .png import encode_png, render, write_png
from .replay import write_replay
from .usd import write_usda

__all__ = [
    "Clip",
    "check_writable",
    "encode_png",
    "pictures",
    "render",
    "write_gif",
    "write_glb",
    "write_html",
    "write_mp4",
    "write_png",
    "write_replay",
    "write_usda",
]


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise an OSError that says why unless a file can be written at ``path``. Creates nothing."""
    path = os.fspath(path)
    if not path:
        raise ValueError("output path is empty")
    folder = os.path.dirname(os.path.abspath(path))
    if os.path.isdir(path) or path.endswith(("/", os.sep)):
        raise IsADirectoryError(f"cannot write {path!r}: it is a folder, not a file")
    if not os.path.exists(folder):
        raise FileNotFoundError(f"cannot write {path!r}: folder {folder!r} does not exist")
    if not os.path.isdir(folder):
        raise NotADirectoryError(f"cannot write {path!r}: {folder!r} is not a folder")
    if not os.access(path if os.path.exists(path) else folder, os.W_OK):
        raise PermissionError(f"cannot write {path!r}: no permission")
