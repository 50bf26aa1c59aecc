"""Thousands of flights: what was asked, a row per flight in a table on disk, what they amount to."""
