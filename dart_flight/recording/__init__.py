"""The record of a flight as MCAP files; a file that was cut off is readable up to the cut."""
