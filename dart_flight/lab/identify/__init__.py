"""Identification of contact coefficients from recorded data."""
