"""Foundations used by every other room: rotations, frames, records, streams and errors."""
