"""Modules of a folder that define a name: how a file becomes a case or an engine."""

from __future__ import annotations

import importlib
import importlib.util
import pathlib
import sys


def found(path, package: str, name: str, folders=()) -> list:
    """``name`` of each module in ``path`` (of ``package``) and in the ``folders`` beside it, in order of file names.

    Raises:
      ValueError: a folder that is not there, a file of such a folder without ``name``.
    """
    modules = []
    for folder in [*path, *map(str, folders)]:
        if not pathlib.Path(folder).is_dir():
            raise ValueError(f"no such folder: '{folder}'")
        for file in sorted(pathlib.Path(folder).glob("*.py")):
            if file.stem.startswith("_"):
                continue
            full = f"{package}.{file.stem}"
            module = sys.modules.get(full)
            if module is None or pathlib.Path(module.__file__) != file:
                spec = importlib.util.spec_from_file_location(full, file)
                module = importlib.util.module_from_spec(spec)
                sys.modules[full] = module
                spec.loader.exec_module(module)
            if not hasattr(module, name):
                if folder in path:
                    continue  # what the engines share
                raise ValueError(f"{file}: defines no {name}")
            modules.append(getattr(module, name))
    return modules
