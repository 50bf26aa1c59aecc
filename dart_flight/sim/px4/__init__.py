"""A real PX4 (SITL or hardware in the loop) on the simulated plant."""
