"""What can go wrong in a simulated flight."""
