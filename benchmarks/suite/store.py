"""Rows: JSON lines that are only ever added to."""

from __future__ import annotations

import json
import os
import pathlib

import common

KEY = ("run", "case", "engine", "variant", "dtype", "dt")


def append(path: pathlib.Path, row: dict) -> None:
    """One whole line, on the disk when this returns; a line that was cut short before it is ended first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as file:
        if file.tell():
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")
        file.write((json.dumps(common.plain(row)) + "\n").encode())
        file.flush()
        os.fsync(file.fileno())


def read(path: pathlib.Path) -> tuple[list[dict], list[str]]:
    """(rows, what could not be read: line number and reason)."""
    rows, corrupt = [], []
    if not path.exists():
        return rows, corrupt
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        try:
            row = json.loads(line)
            if not isinstance(row, dict) or "kind" not in row:
                raise ValueError("no row of the suite")
            if row["kind"] == "point" and not all(k in row for k in (*KEY, "status")):
                raise ValueError(f"a point without {next(k for k in (*KEY, 'status') if k not in row)!r}")
        except ValueError as error:
            corrupt.append(f"{path.name}, line {number}: {str(error)[:100]}")
            continue
        rows.append(row)
    return rows, corrupt


def key(row: dict) -> tuple:
    return tuple(row[k] for k in KEY)
