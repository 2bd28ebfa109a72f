"""Layer 0: what a value must be, for functions that check what they are given."""

from __future__ import annotations

import numpy as np


def whole(value, least: int) -> bool:
    """Whether ``value`` is an integer, of Python or numpy but no bool, and at least ``least``."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= least
