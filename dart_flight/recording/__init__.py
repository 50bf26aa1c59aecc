"""The record of a flight: MCAP files, written during the flight; a cut-off file is readable up to the cut."""
