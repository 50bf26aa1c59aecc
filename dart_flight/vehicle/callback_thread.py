"""Python's thread state for the thread on which MAVSDK runs callbacks.

MAVSDK starts this thread, not Python. The interpreter therefore creates and releases a thread state for
every callback, which takes a third of the time of an empty callback (docs/latency.md).
"""

from __future__ import annotations

import ctypes
import threading

_own = threading.local()  # the interpreter releases this with the thread state


def pin_thread_state() -> None:
    """Keep the calling thread's state until the thread ends; repeated calls are cheap."""
    if not hasattr(_own, "kept"):
        _own.kept = True
        # This reference is never released, so the state stays; there is one such thread per connection.
        ctypes.pythonapi.PyGILState_Ensure()
