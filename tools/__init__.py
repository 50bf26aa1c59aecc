"""Benchmarks, campaigns and generators; run as `python -m tools.NAME`."""
