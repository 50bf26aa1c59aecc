"""Slow, independent computations that tests and benchmarks compare with."""
