"""The record of a flight: MCAP files, written as it goes, readable up to where they were cut."""
