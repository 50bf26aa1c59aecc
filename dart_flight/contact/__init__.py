"""The contact model: the complementarity law, its closed-form solutions, and sets of coefficients."""
