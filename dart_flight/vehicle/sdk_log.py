"""MAVSDK's own messages: to Python's logging, and not to standard output, which belongs to `--json`."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mavsdk.logging import log_subscribe

_LEVELS = {0: logging.DEBUG, 1: logging.INFO, 2: logging.WARNING, 3: logging.ERROR}
# When a UDP connection is closed, MAVSDK 4.1 takes its socket away from under a receive that its other thread
# is just about to repeat, seen once in 145 closings. Nothing is lost: there is no listener any more. The
# same words while a connection is in use would be an error.
_SOCKET_CLOSED = "Bad file descriptor"

_logger = logging.getLogger("dart_flight.mavsdk")
_lock = threading.Lock()
_closing = 0  # connections that are being closed


def redirect() -> None:
    """Have every message from now on go to the logger `dart_flight.mavsdk` alone."""
    log_subscribe(take)


def take(level: Any, message: str, _file: str | None, _line: int) -> bool:
    """MAVSDK's callback, on its threads; True: do not print it."""
    number = _LEVELS.get(int(level), logging.INFO)
    if _closing and _SOCKET_CLOSED in message:
        number = logging.DEBUG
    _logger.log(number, message)
    return True


@contextmanager
def closing() -> Iterator[None]:
    """While a connection is closed: what its socket says of that is no error."""
    global _closing  # noqa: PLW0603  (MAVSDK has one log for the whole process)
    with _lock:
        _closing += 1
    try:
        yield
    finally:
        with _lock:
            _closing -= 1
