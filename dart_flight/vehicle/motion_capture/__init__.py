"""Motion capture: pose sources of the vendors' systems, and the bridge that forwards their poses to PX4."""
