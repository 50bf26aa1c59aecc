"""Tools for work on the ground.

The tools import modules that run in flight. The modules that run in flight do not import the tools.
"""
