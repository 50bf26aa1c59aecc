"""Shared test settings."""

from hypothesis import settings

# Deterministic examples: the same commit gives the same answer on every machine.
settings.register_profile("ci", derandomize=True, deadline=None, max_examples=100)
settings.load_profile("ci")
