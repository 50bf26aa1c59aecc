"""What the software writes of its own documentation (`make docs`)."""
