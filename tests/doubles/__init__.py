"""Stand-ins for hardware and programs that the tests do not have."""
