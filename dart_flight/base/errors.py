"""Errors that end a command with exit status 1: the input was right, the world did not play along."""


class FlightError(Exception):
    """The flight could not begin: no vehicle, no simulator. One line for the person at the terminal."""
