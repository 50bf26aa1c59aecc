"""Base of the doubles that run in a thread of their own while their context is open."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Self


class Threaded:
    """Context with a thread.

    A subclass loops in `_run` until `_stop` is set, and frees its resources in `_close`.
    """

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name=type(self).__name__)

    def _run(self) -> None:
        raise NotImplementedError

    def _close(self) -> None:
        """Free what the double has opened."""

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(1.0)
        self._close()
