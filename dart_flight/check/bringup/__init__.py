"""Bring up a vehicle on the bench in steps, each measured and evaluated (docs/bringup.md)."""
