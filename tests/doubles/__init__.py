"""Stand-ins for hardware and programs that are not there."""
