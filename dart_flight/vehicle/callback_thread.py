"""Python's thread state for the thread on which MAVSDK runs callbacks.

MAVSDK, not Python, starts this thread. The interpreter therefore creates a thread state for every callback
and releases the thread state on return. The creation and release take a third of the time of an empty
callback (docs/latency.md).
"""

from __future__ import annotations

import ctypes
import threading

_own = threading.local()  # is released with the thread state


def pin_thread_state() -> None:
    """Keep Python's thread state for the calling thread until the thread ends; repeated calls are cheap."""
    if not hasattr(_own, "kept"):
        _own.kept = True
        # This reference is never released, so the state stays; there is one such thread per connection.
        ctypes.pythonapi.PyGILState_Ensure()
