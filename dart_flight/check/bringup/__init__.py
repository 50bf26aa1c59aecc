"""Bringing a vehicle up on the bench, step by step, each measured and judged (docs/field.md)."""
