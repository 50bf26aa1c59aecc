"""Tools for study on the ground.

The tools import modules of the part that flies. The part that flies does not import the tools.
"""
