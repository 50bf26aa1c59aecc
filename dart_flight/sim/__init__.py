"""Simulated worlds: one plant, an embedded autopilot on it, and the ways to fly them."""
