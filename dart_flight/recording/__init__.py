"""The record of a flight: MCAP files, written during the flight and readable up to a cut-off end."""
