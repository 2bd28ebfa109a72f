"""Cases by name: every module of this folder (and of folders given) that has ``CASES``."""

from __future__ import annotations

from ..found import found

#: In the order in which they are measured and shown.
GROUPS = ("free", "impact", "friction", "rest", "pile")


def load(*folders) -> dict:
    cases = [c for group in found(__path__, __name__, "CASES", folders) for c in group]
    rank = {g: k for k, g in enumerate(GROUPS)}
    return {c.name: c for c in sorted(cases, key=lambda c: rank.get(c.group, len(rank)))}
