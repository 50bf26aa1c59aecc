"""Thread that runs a lock's state machine, for programs over MAVSDK; the driver may block the thread."""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Callable
from typing import Final

from dart_flight.base.records import LockCommand, LockPermission, LockPhase, LockState
from dart_flight.lock.lock_session import LockSession
from dart_flight.run.timing import RealTime

_TRAVELLING_S, _RESTING_S = 0.01, 0.1  # polling periods while the lock travels and while it rests
_REAL_TIME: Final = RealTime()


class LockThread:
    """Thread that runs the lock's state machine on the core's time base.

    In lockstep the thread polls the driver in simulated time, whenever `poll_if_due` finds a poll due.

    Args:
        make_session: makes the session; its argument is a callback for each state. The thread waits until the
            autopilot's time is known, because the lock's stamps could otherwise be later than that time.
    """

    def __init__(
        self,
        make_session: Callable[[Callable[[LockState], None]], LockSession],
        clock_known: Callable[[], bool],
        deliver: Callable[[LockState], None],
        after_poll: Callable[[], None] = lambda: None,
        time: RealTime = _REAL_TIME,
    ) -> None:
        self._make_session, self._deliver = make_session, deliver
        self._clock_known, self._after_poll = clock_known, after_poll
        self._states: queue.SimpleQueue[LockState] = queue.SimpleQueue()
        self._time, self._due_us = time, 0.0
        self._orders: queue.SimpleQueue[LockCommand | LockPermission | None] = queue.SimpleQueue()
        self._stop = threading.Event()
        self.thread = threading.Thread(target=self._run, name="lock", daemon=True)

    def obey(self, order: LockCommand | LockPermission | None) -> None:
        """Queue an order, or None for a poll, from any thread, without blocking."""
        self._time.open()
        self._orders.put(order)

    def poll_if_due(self) -> None:
        """Poll the driver if a poll is due in simulated time."""
        if self._time.host_us() >= self._due_us:
            self._due_us = math.inf  # no poll is due until the thread has polled
            self.obey(None)

    def stop(self) -> None:
        self._stop.set()
        self._orders.put(None)
        self.thread.join(timeout=2.0)

    def _run(self) -> None:
        # The lock's stamps are autopilot time, so wait until the autopilot's clock is known.
        while not self._clock_known():
            if self._stop.wait(_TRAVELLING_S):
                return
        session = self._make_session(self._states.put)
        session.start()
        period_s = _TRAVELLING_S
        while not self._stop.is_set():
            order, ordered = None, True
            try:
                order = self._orders.get(timeout=None if self._time.waits else period_s)
            except queue.Empty:
                ordered = False
            if order is not None:
                session.obey(order)
            session.poll()
            self._after_poll()
            while not self._states.empty():  # only this thread removes states
                self._deliver(self._states.get_nowait())
            period_s = _TRAVELLING_S if session.state.phase is LockPhase.TRAVELLING else _RESTING_S
            self._due_us = self._time.host_us() + 1e6 * period_s
            if ordered:
                self._time.close()
