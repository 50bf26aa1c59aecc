"""The shells around the core, one per world, and what runs many flights."""
