"""Redirection of MAVSDK's log to Python's logging.

MAVSDK must not write to standard output, which is reserved for `--json`. A repeated message is logged only
once; its number of repetitions is logged when the connection closes.
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
# MAVSDK 4.1 may close a UDP socket during a receive. The error is harmless only while a connection closes.
_SOCKET_CLOSED = "Bad file descriptor"

_logger = logging.getLogger("dart_flight.mavsdk")
_lock = threading.Lock()
_closing = 0  # connections that are being closed
_NUMBER = re.compile(r"\d+")
_MAX_KINDS = 1000  # maximum number of stored kinds; a damaged link may produce any number of kinds
# Map each text, with its numbers removed, to its level, its first full text and its number of repetitions.
_repeated: dict[str, tuple[int, str, int]] = {}


def redirect() -> None:
    """Send every subsequent message to the logger `dart_flight.mavsdk` only."""
    log_subscribe(log_message)


def log_message(level: Any, message: str, _file: str | None, _line: int) -> bool:
    """Log a message on one of MAVSDK's threads; return True, so that MAVSDK does not print it."""
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


def _log_repetitions() -> None:
    with _lock:
        found = [entry for entry in _repeated.values() if entry[2]]
        _repeated.clear()
    for number, message, again in found:
        _logger.log(number, "%s (%d times)", message, again + 1)


@contextmanager
def closing() -> Iterator[None]:
    """Suppress socket errors within the context, in which the caller must close the connection."""
    global _closing  # noqa: PLW0603  (MAVSDK has one log for the whole process)
    with _lock:
        _closing += 1
    try:
        yield
    finally:
        with _lock:
            _closing -= 1
        _log_repetitions()
