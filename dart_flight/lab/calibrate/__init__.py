"""Thrust curve, inertia and airframe from flights."""
