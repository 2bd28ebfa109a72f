"""Layer 8: a batch shared between processes, after ``jax.distributed.initialize``.

Worlds do not know of each other: every process rolls out its own, and nothing passes between them but what is gathered
in the end. With one process both functions do nothing.
"""

from __future__ import annotations

import jax
import numpy as np

from .checks import whole
from .tiles import LANES


def my_worlds(count: int) -> slice:
    """The worlds, of ``count``, that are this process's: equal shares in multiples of 32, the last one shorter.

    Multiples of 32, since a world then has the bits that it has in one batch with all others.

    Raises:
      ValueError: count is not an integer >= 1, or there are too few worlds for every process to have some.
    """
    if not whole(count, 1):
        raise ValueError(f"my_worlds: count = {count!r} must be an integer >= 1")
    parts, mine = jax.process_count(), jax.process_index()
    share = -(-count // parts)
    if parts > 1:
        share = -(-share // LANES) * LANES
    if (parts - 1) * share >= count:
        raise ValueError(f"my_worlds: {count} worlds cannot be shared by {parts} processes in parts of {share}")
    return slice(mine * share, min((mine + 1) * share, count))


def gathered(tree):
    """``tree``, whose leaves have the worlds of :func:`my_worlds` as first axis, of all processes in order, as numpy
    arrays in every process. Shares may differ in size."""
    if jax.process_count() == 1:
        return jax.tree.map(np.asarray, tree)
    from jax.experimental.multihost_utils import process_allgather

    sizes = np.ravel(process_allgather(np.asarray(jax.tree.leaves(tree)[0].shape[0])))
    most = int(sizes.max())

    def whole(leaf):
        leaf = np.asarray(leaf)
        filled = np.concatenate([leaf, np.zeros((most - len(leaf), *leaf.shape[1:]), leaf.dtype)])
        parts = np.asarray(process_allgather(filled))
        return np.concatenate([part[:size] for part, size in zip(parts, sizes)])

    return jax.tree.map(whole, tree)
