"""Contact coefficients and thrust curve from recorded data."""
