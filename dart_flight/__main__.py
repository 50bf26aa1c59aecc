"""`python -m dart_flight`."""

from dart_flight.cli import run

run()
