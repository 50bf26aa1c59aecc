"""Tools for study on the ground. They import the part that flies, and the part that flies imports none of
them.
"""
