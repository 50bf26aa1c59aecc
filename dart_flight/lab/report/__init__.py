"""A flight as a page: verdict, map, forces, velocities, lock, latencies, and what the model should learn."""
