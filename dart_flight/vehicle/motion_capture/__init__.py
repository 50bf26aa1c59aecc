"""Motion capture: pose sources for the vendors' systems, and the bridge that forwards poses to PX4."""
