"""Signals that end a program: Ctrl-C, SIGTERM, and SIGHUP when the terminal or the session closes."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable, Sequence
from types import FrameType, TracebackType
from typing import Any, Final, Self

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
REPEAT_S: Final = 0.3

_logger = logging.getLogger(__name__)


def log_repeat(number: signal.Signals) -> None:
    _logger.info("%s", describe_repeat(number))


def describe_repeat(number: signal.Signals) -> str:
    return f"{number.name} again within {REPEAT_S:g} s: counted once"


class StopSignals:
    """Context in which signals call a function instead of ending the program.

    A signal that arrives again within 0.3 s is a repeat and does not count: GNU timeout signals a program and
    then its group, and both the shell and the kernel report a closed terminal. A different signal counts
    immediately. A SIGHUP that is ignored (`nohup`, `trap '' HUP`) stays ignored.

    `handle` receives every signal that counts, between two steps of the program, and `repeated` receives the
    repeats. The context has an effect only in the main thread.
    """

    def __init__(
        self,
        handle: Callable[[signal.Signals], object],
        repeated: Callable[[signal.Signals], object] = log_repeat,
        numbers: Sequence[signal.Signals] = STOP_SIGNALS,
    ) -> None:
        self._handle, self._repeated, self._numbers = handle, repeated, numbers
        self._before: dict[int, Any] = {}
        self._counted_s: dict[int, float] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in self._numbers:
                if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()

    def _receive(self, number: int, _frame: FrameType | None) -> None:
        now_s = time.monotonic()
        if now_s - self._counted_s.get(number, -REPEAT_S) < REPEAT_S:
            self._repeated(signal.Signals(number))
            return
        self._counted_s[number] = now_s
        self._handle(signal.Signals(number))
