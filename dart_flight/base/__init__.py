"""Foundations used by every other package: rotations, frames, records, streams and errors."""
