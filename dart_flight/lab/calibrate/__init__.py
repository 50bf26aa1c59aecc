"""Calibration of the thrust curve, the inertia and the airframe from flights."""
