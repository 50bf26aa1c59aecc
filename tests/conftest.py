"""Shared test settings."""

import os

# Before NumPy is imported: threads of the linear algebra only wait for each other on matrices of this size,
# and on a busy machine they do so for long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from hypothesis import settings

# Deterministic examples: the same commit gives the same answer on every machine.
settings.register_profile("ci", derandomize=True, deadline=None, max_examples=100)
settings.load_profile("ci")
