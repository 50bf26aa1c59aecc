"""Faults of a simulated flight: the table of all faults, lossy links and a second vehicle."""
