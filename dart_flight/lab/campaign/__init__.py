"""Campaigns of many flights: the specification, a table with one row per flight, and its summary."""
