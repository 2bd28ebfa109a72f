"""Shared settings: every test runs on the CPU backend; compiled programs are shared per session."""

import json
import os

import pytest

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Compile time is the cost of this suite: LLVM at its lowest level halves it and changes rounding only.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"

# Each compiled program takes memory maps, and Linux ends a process that asks for more of them than
# vm.max_map_count (65,530 unless set otherwise).  A worker of the whole suite comes that far.
MANY_MAPS = 20_000


def memory_maps():
    """How many memory maps the process has; 0 where the system does not tell."""
    try:
        with open("/proc/self/maps", "rb") as maps:
            return sum(1 for _ in maps)
    except OSError:
        return 0


@pytest.fixture(scope="module", autouse=True)
def few_compiled_programs():
    """Drop the compiled programs of earlier modules before they are too many for one process."""
    yield
    if memory_maps() > MANY_MAPS:
        import jax  # not above: it reads the settings above from the environment when imported

        jax.clear_caches()


@pytest.fixture
def contract(record_property):
    """Record a row of the gradient contract; ``--junitxml FILE`` has them."""
    return lambda section, **row: record_property(section, json.dumps(row))
