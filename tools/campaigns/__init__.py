"""What `make campaign` runs in bulk, with a report each."""
