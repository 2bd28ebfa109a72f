"""Layer 9: pictures of a trajectory, without a GL driver (PNG) and without a network (HTML page)."""

from __future__ import annotations

import os

from .clip import Clip
from .html import write_html
from .png import encode_png, render, write_png

__all__ = ["Clip", "check_writable", "encode_png", "render", "write_html", "write_png"]


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
