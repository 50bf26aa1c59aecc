"""MAVSDK's callback thread, as the interpreter knows it.

Python was not the one to start that thread. So with every callback the interpreter makes a state for it, maps
memory for its stack, and unmaps both when the callback returns: a third of what an empty callback costs
(docs/latency.md).
"""

from __future__ import annotations

import ctypes
import threading

_own = threading.local()  # goes with the interpreter's state of a thread


def pin_thread_state() -> None:
    """Let the interpreter keep its state of the calling thread until the thread's end; cheap when it does."""
    if not hasattr(_own, "kept"):
        _own.kept = True
        # One more than is ever released; with the last of them the state would go. A state is small, and
        # there is one of these threads per connection.
        ctypes.pythonapi.PyGILState_Ensure()
