"""Shells around the core, one per world, and the runners of many flights."""
