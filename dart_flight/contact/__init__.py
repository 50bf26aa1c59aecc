"""The contact model: the complementarity law, its solutions, and its coefficients from data."""
