"""Simulated worlds: the plant, the embedded autopilot, and their processes."""
