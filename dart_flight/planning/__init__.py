"""Choosing and flying collisions: approach references, the closed-loop flight model, enumeration."""
