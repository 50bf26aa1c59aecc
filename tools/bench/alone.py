"""MAVSDK alone, for the benchmarks: the link at a flight's rates, with callbacks that do nothing.

What it costs of a core, and from an IMU sample on the wire to a setpoint on the wire, is the least that an
app over MAVSDK can do; what `dart_flight` adds is measured against it (`tools.bench.share`, `.latency`).
"""

from __future__ import annotations

import asyncio
from typing import Any

from mavsdk.plugins.offboard import PositionNedYaw

from dart_flight.config.mission import Mission
from dart_flight.vehicle import messages
from dart_flight.vehicle.messages import MessageEntry
from dart_flight.vehicle.vehicle_session import VehicleSession, connect

_ECHO_EVERY = 75  # IMU samples: 0.3 s
_STEP_M = 0.01  # between one echo and the next: told apart on the wire


async def stay(
    mission: Mission, url: str, ended: asyncio.Event, echo: Echo | None = None, *, watching: bool = False
) -> None:
    """Connect, subscribe as a flight does, but to callbacks that do nothing; stay until it has ended.

    Args:
        mission: whose vehicle it is.
        url: MAVSDK connection URL.
        ended: when to leave.
        echo: answers IMU samples.
        watching: with the streams and rates of `monitor` instead.
    """
    async with connect(url, mission.vehicle.connection.timeout_s, _nothing, ground=watching) as session:
        listen = session.listen

        def listen_idly(entry: MessageEntry, *_: object) -> None:
            if echo is not None and entry is messages.HIGHRES_IMU:
                echo.attach(session)
                listen(entry, echo.take)
            else:
                session._direct.subscribe_message(entry.message, _nothing)

        session.listen = listen_idly  # type: ignore[method-assign, assignment]
        session._on_event = session._on_checks = _nothing  # type: ignore[method-assign]
        motors = len(mission.vehicle.airframe.motors)
        session.subscribe(mission.vehicle.estimation, motors, guarded=not watching)
        await session.set_rates(watching=watching)
        await ended.wait()


def _nothing(*_: Any, **__: Any) -> None:
    """An empty callback."""


class Echo:
    """Answers an IMU sample now and then with a setpoint of its own, at once, from MAVSDK's callback.

    Attributes:
        asked: (the sample's stamp in microseconds, north of the setpoint in metres).
    """

    def __init__(self) -> None:
        self.asked: list[tuple[int, float]] = []
        self._count = 0
        self._offboard: Any = None

    def attach(self, session: VehicleSession) -> None:
        """Send by this session."""
        self._offboard = session._offboard

    def take(self, imu: messages.InertialReading, _: int) -> None:
        """Take an IMU sample."""
        self._count += 1
        if self._count % _ECHO_EVERY == 0:
            north = _STEP_M * (len(self.asked) + 1)
            self._offboard.set_position_ned(PositionNedYaw(north, 0.0, -1.0, 0.0))
            self.asked.append((imu.t_us, north))
