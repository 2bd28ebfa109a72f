"""Layer 5: small matrices of pairs as one array each, and their turn from contact frames to world axes.

A vector is an array (P, m, B), a matrix (P, m columns, m rows, B); what comes from the contact frame is lists of
entries (P, B), in which None is a structural zero. Entry by entry, the turned matrices would take several times as many
operations, which is what a program takes its time to compile for.
"""

from __future__ import annotations

import jax.numpy as jnp

from ..spatial import Vec3, components
from ..xla import materialise


def vector(entries) -> jnp.ndarray:
    """An array (P, m, B) of entries (P, B)."""
    return jnp.concatenate([x.reshape(-1, 1, x.shape[-1]) for x in jnp.broadcast_arrays(*entries)], axis=1)


def frame(t1: Vec3 | None, t2: Vec3 | None, n: Vec3, one) -> list:
    """t1, t2 and n as vectors; None where there are no tangents."""
    return [None if v is None else materialise(vector(components(v)), one) for v in (t1, t2, n)]


def across(c):
    """A vector as a row: one entry for every column of a matrix, (P, m, 1, B)."""
    return c[:, :, None]


def transposed(m):
    return jnp.swapaxes(m, 1, 2)


def combined(q, factors):
    """sum of q_k f_k over the axes k that both have, (P, 3, B); f_k (P, B) or (P, 1, B). None: there is none."""
    flat = lambda f: f if f.ndim == 3 else f[:, None]
    scaled = [a * flat(f) for a, f in zip(q, factors) if a is not None and f is not None]
    return sum(scaled[1:], scaled[0]) if scaled else None


def rotated(q, m, one):
    """Q M Q', (P, 3, 3, B), from the entries of M in the contact frame ``q``; at least one is not zero."""
    total = None
    for j in range(3):
        half = None if q[j] is None else combined(q, [m[i][j] for i in range(3)])
        if half is None:
            continue
        part = materialise(half, one)[:, None] * across(q[j])
        total = part if total is None else total + part
    return materialise(total, one)
