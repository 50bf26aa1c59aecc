"""MAVSDK's own messages: to Python's logging, and not to standard output, which belongs to `--json`.

What it says again and again is said once, and how often it came when the connection is closed.
"""

from __future__ import annotations

import logging
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mavsdk.logging import log_subscribe

_LEVELS = {0: logging.DEBUG, 1: logging.INFO, 2: logging.WARNING, 3: logging.ERROR}
# When a UDP connection is closed, MAVSDK 4.1 may take its socket away from under a receive. Nothing is lost:
# there is no listener any more. The same words while a connection is in use would be an error.
_SOCKET_CLOSED = "Bad file descriptor"

_logger = logging.getLogger("dart_flight.mavsdk")
_lock = threading.Lock()
_closing = 0  # connections that are being closed
_NUMBER = re.compile(r"\d+")
_MAX_KINDS = 1000  # of messages remembered; what a damaged link brings about need not end
_repeated: dict[
    str, tuple[int, str, int]
] = {}  # less its numbers -> level, first words, how often it came again


def redirect() -> None:
    """Have every message from now on go to the logger `dart_flight.mavsdk` alone."""
    log_subscribe(take)


def take(level: Any, message: str, _file: str | None, _line: int) -> bool:
    """MAVSDK's callback, on its threads; True: do not print it."""
    number = _LEVELS.get(int(level), logging.INFO)
    if _closing and _SOCKET_CLOSED in message:
        number = logging.DEBUG
    kind = f"{number} {_NUMBER.sub('#', message)}"
    with _lock:
        known = _repeated.get(kind)
        if known is not None:
            _repeated[kind] = (number, known[1], known[2] + 1)
            return True
        if len(_repeated) < _MAX_KINDS:
            _repeated[kind] = (number, message, 0)
    _logger.log(number, message)
    return True


def _tell_repeated() -> None:
    with _lock:
        found = [told for told in _repeated.values() if told[2]]
        _repeated.clear()
    for number, message, again in found:
        _logger.log(number, "%s (%d times)", message, again + 1)


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
        _tell_repeated()
