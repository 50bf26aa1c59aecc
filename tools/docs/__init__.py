"""Generators of the manual's tables, diagrams, schemas and figures (`make docs`)."""
