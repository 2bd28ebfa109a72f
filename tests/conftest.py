"""Shared settings: every test runs on the CPU backend; compiled programs are shared per session."""

import json
import os

import pytest

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Compile time is the cost of this suite: LLVM at its lowest level halves it and changes rounding only.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"


@pytest.fixture
def contract(record_property):
    """Record a row of the gradient contract; ``--junitxml FILE`` has them."""
    return lambda section, **row: record_property(section, json.dumps(row))
