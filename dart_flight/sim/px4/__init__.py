"""A real PX4 SITL on our plant."""
