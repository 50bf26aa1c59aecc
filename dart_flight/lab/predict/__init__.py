"""Prediction of one collision or drop over time."""
