"""One module per command of the lab."""
