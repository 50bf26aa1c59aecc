"""Errors that end a command with exit status 1: the input was valid, but the flight was not possible."""


class FlightError(Exception):
    """The flight could not begin, for example because no vehicle answered; the message is one line."""
