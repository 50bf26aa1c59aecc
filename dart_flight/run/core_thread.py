"""The threads that step the core in flights over MAVSDK. They share one queue of inputs.

Only the thread that holds the mutex `_owner` steps the core. This thread also sends the setpoints, without
delay. In real time the core chooses the thread (`core.pace`). Near a wall MAVSDK's thread, on which samples
arrive, steps the core. No other thread has to wake up first (docs/latency.md). Away from walls the core's own
thread steps the core.

In lockstep, the simulated world waits until the core has processed the world's samples. The thread that
delivers a sample also steps the core. Near a wall it does so after each sample, and away from walls after
every 20 ms of simulated time.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Final

from dart_flight.base.records import ActuatorSample, AttitudeSample, Input, OdometrySample, Tick
from dart_flight.core.pace import BATCH_S, Pace
from dart_flight.run.shell import Shell
from dart_flight.vehicle.clock import host_us

_TICK_S: Final = 0.02
_STOP_S: Final = 2.0
_BACKLOG: Final = 64  # if more inputs are queued, older samples of the state streams are dropped
_STATE_STREAMS: Final = (AttitudeSample, OdometrySample, ActuatorSample)


class CoreThread:
    """Thread that steps the core with the inputs of one queue.

    Args:
        alive: feeds the deadman; called at least every 20 ms while no step hangs.
        after_step: callback after every step in lockstep, before the report to the world.
    """

    def __init__(
        self,
        shell: Shell,
        alive: Callable[[], None] = lambda: None,
        after_step: Callable[[], None] = lambda: None,
    ) -> None:
        self._shell, self._time, self._alive, self._after_step = shell, shell.time, alive, after_step
        self._queue: queue.SimpleQueue[Input] = queue.SimpleQueue()
        self._owner = threading.Lock()  # held by the thread that steps the core
        self._work: set[int] = set()  # ids of queued inputs; in lockstep the world waits for these inputs
        self._pace = Pace.BATCHED  # only the owner changes it
        self._called = threading.Event()  # wakes the core's own thread
        self._fault: BaseException | None = None
        self._stopping = False
        self._ticked_us = 0
        self._turned_us = host_us()
        self.thread = threading.Thread(target=self._run, name="core", daemon=True)

    def age_s(self) -> float:
        """Return the time since the thread last began a round of its loop."""
        return (host_us() - self._turned_us) * 1e-6

    def put(self, item: Input) -> None:
        """Queue an input, from any thread, without blocking."""
        self._time.open()
        if self._time.waits:
            self._work.add(id(item))
        self._queue.put(item)
        if self._time.waits:
            self._step_now()

    def arrive(self, item: Input) -> None:
        """Queue an input from a stream, from any thread.

        If a step is due immediately, the calling thread steps the core with the queued inputs.
        """
        # Queue the item first, so that the thread that processes the batch also steps this item.
        self._queue.put(item)
        if self._time.completes_batch(item):
            self._step_now()

    def _step_now(self) -> None:
        # An input may arrive while another thread steps, so that thread checks the queue again.
        while self._in_haste and not self._queue.empty() and self._owner.acquire(blocking=False):
            try:
                self._step_queued()
            except BaseException as fault:
                # MAVSDK would swallow the exception. The core's thread raises it again, and the deadman acts.
                self._fault, self._pace = fault, Pace.BATCHED
            finally:
                self._owner.release()
            if not self._in_haste:
                self._called.set()

    @property
    def _in_haste(self) -> bool:
        return self._fault is None if self._time.waits else self._pace is Pace.IMMEDIATE

    def stop(self) -> None:
        """End the thread. After this call no thread processes a queued input."""
        self._stopping = True
        self._called.set()
        self.thread.join(timeout=_STOP_S)
        self._owner.acquire(timeout=_STOP_S)  # never released, so that no thread steps again

    def _run(self) -> None:
        while not self._stopping:
            self._turned_us = host_us()
            self._alive()
            if self._called.wait(BATCH_S):
                self._called.clear()
            if self._fault is not None:
                raise self._fault
            # In lockstep this thread must not own the core: an input that another thread delivers then would
            # stay queued.
            if not self._time.waits:
                with self._owner:
                    self._step_queued()
                    self._tick()
                self._step_now()

    def _tick(self) -> None:
        now_us = self._time.host_us()
        if now_us - self._ticked_us >= _TICK_S * 1e6:
            self._ticked_us = now_us
            self._shell.step(Tick(now_us))

    def _step_queued(self) -> None:
        """Step the core with the queued inputs; the caller must hold `_owner`.

        If more than `_BACKLOG` inputs are queued, drop all samples of attitude, odometry and actuators except
        the newest of each kind.
        """
        items, queued = list[Input](), self._queue
        while not queued.empty():  # only the owner removes inputs
            items.append(queued.get_nowait())
        if len(items) > _BACKLOG and not self._time.waits:
            newest = {type(item): i for i, item in enumerate(items)}
            items = [
                item
                for i, item in enumerate(items)
                if not isinstance(item, _STATE_STREAMS) or newest[type(item)] == i
            ]
        left = len(items)
        for item in items:
            left -= 1
            self._shell.step(item, more=left > 0)
        self._pace = self._shell.core.pace
        if self._time.waits and items:
            self._tick()
            self._after_step()
            work = self._work.intersection(map(id, items))
            self._work -= work
            self._time.close(items, len(work), self._pace is Pace.BATCHED)
