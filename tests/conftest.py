"""Shared settings: every test runs on the CPU backend; compiled programs are shared per session."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Compile time is the cost of this suite: LLVM at its lowest level halves it and changes rounding only.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"
