"""A vehicle on the ground with logs on its card: the embedded autopilot plus MAVLink's log protocol."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from dart_flight.base.thread_context import ThreadContext
from dart_flight.config.mission import Mission
from dart_flight.sim.embedded_autopilot import TICK_S, make_autopilot
from dart_flight.sim.mavlink_endpoint import Link, MavlinkEndpoint
from tests.doubles.ports import free_udp_port

_CHUNK = 90  # bytes of a LOG_DATA
_PER_TICK = 40  # messages


class _LogEndpoint(MavlinkEndpoint):
    """An endpoint that answers LOG_REQUEST_LIST and LOG_REQUEST_DATA, and stops after `sends_bytes`."""

    logs: list[tuple[int, bytes]]
    sends_bytes: float
    _queue: deque[Any]

    def _handle_message(self, link: Link, message: Any) -> None:
        kind = message.get_type()
        if kind == "LOG_REQUEST_LIST":
            for k, (time_utc, content) in enumerate(self.logs):
                entry = mavlink.MAVLink_log_entry_message(
                    k, len(self.logs), len(self.logs) - 1, time_utc, len(content)
                )
                self._send(link, entry)
            if not self.logs:
                self._send(link, mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0))
        elif kind == "LOG_REQUEST_DATA":
            content = self.logs[message.id][1]
            end = min(len(content), message.ofs + message.count)
            for at in range(message.ofs, end, _CHUNK):
                data = content[at : min(end, at + _CHUNK)]
                padded = list(data.ljust(_CHUNK, b"\0"))
                self._queue.append(mavlink.MAVLink_log_data_message(message.id, at, len(data), padded))
        elif kind == "LOG_REQUEST_END":
            self._queue.clear()
        else:
            super()._handle_message(link, message)

    def send_logs(self) -> None:
        """Send the messages of a log that are due."""
        for _ in range(min(_PER_TICK, len(self._queue))):
            message = self._queue.popleft()
            self.sends_bytes -= message.count
            if self.sends_bytes >= 0:
                self._send(self.links[0], message)


class LogVehicle(ThreadContext):
    """`with LogVehicle(mission, logs) as vehicle: ...vehicle.url...`.

    Args:
        mission: mission with the vehicle.
        logs: time of the last change (seconds UTC) and content, in the order of the card's folder.
        sends_bytes: number of bytes after which it stops sending logs.
    """

    def __init__(
        self, mission: Mission, logs: list[tuple[int, bytes]], sends_bytes: float = float("inf")
    ) -> None:
        port = free_udp_port()
        self.url = f"udpin://127.0.0.1:{port}"
        self.autopilot = make_autopilot(mission, 1)
        self._endpoint = _LogEndpoint(self.autopilot, (port,))
        self._endpoint.logs, self._endpoint.sends_bytes, self._endpoint._queue = logs, sends_bytes, deque()
        super().__init__()

    def _run(self) -> None:
        while not self._stop.is_set():
            self.autopilot.plant.time_s += TICK_S
            self._endpoint.exchange()
            self._endpoint.send_logs()
            time.sleep(TICK_S)

    def _close(self) -> None:
        self._endpoint.close()
