"""A vehicle on the ground with logs on its card, which it sends by MAVLink's log protocol."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from dart_flight.config.mission import Mission
from dart_flight.sim.embedded_autopilot import TICK_S
from tests.doubles.ports import free_udp_port
from tests.doubles.vehicle_peer import VehiclePeer

_CHUNK = 90  # bytes of a LOG_DATA
_PER_TICK = 40  # messages


class LogVehicle(VehiclePeer):
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
        super().__init__(mission, (port,))
        self.url = f"udpin://127.0.0.1:{port}"
        self._logs, self._sends_bytes, self._queue = logs, sends_bytes, deque[Any]()
        self.answers["LOG_REQUEST_LIST"] = self._list
        self.answers["LOG_REQUEST_DATA"] = self._queue_data
        self.answers["LOG_REQUEST_END"] = self._stop_sending

    def _list(self, _: Any) -> Iterable[Any]:
        count = len(self._logs)
        if not count:
            return [mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0)]
        return [
            mavlink.MAVLink_log_entry_message(k, count, count - 1, time_utc, len(content))
            for k, (time_utc, content) in enumerate(self._logs)
        ]

    def _queue_data(self, request: Any) -> Iterable[Any]:
        content = self._logs[request.id][1]
        end = min(len(content), request.ofs + request.count)
        for at in range(request.ofs, end, _CHUNK):
            data = content[at : min(end, at + _CHUNK)]
            padded = list(data.ljust(_CHUNK, b"\0"))
            self._queue.append(mavlink.MAVLink_log_data_message(request.id, at, len(data), padded))
        return []

    def _stop_sending(self, _: Any) -> Iterable[Any]:
        self._queue.clear()
        return []

    def tick(self) -> None:
        self.autopilot.plant.time_s += TICK_S  # it stays on the ground, armed or not

    def exchange(self) -> None:
        super().exchange()
        for _ in range(min(_PER_TICK, len(self._queue))):
            message = self._queue.popleft()
            self._sends_bytes -= message.count
            if self._sends_bytes >= 0:
                self.endpoint.send(message)
