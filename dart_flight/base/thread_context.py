"""Base of the context managers that run a thread while the context is open."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Final, Self

_JOIN_S: Final = 1.0


class ThreadContext:
    """Context with a thread: a subclass loops in `_run` until `_stop` is set, and cleans up in `_close`."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name=type(self).__name__)

    def _run(self) -> None:
        raise NotImplementedError

    def _close(self) -> None:
        """Release the subclass's resources; called once the thread has ended."""

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(_JOIN_S)
        self._close()
