"""Engines by name: every module of this folder (and of folders given) that has an ``ENGINE``."""

from __future__ import annotations

from ..found import found


def load(*folders) -> dict:
    return {e.name: e for e in found(__path__, __name__, "ENGINE", folders)}
