"""MAVSDK alone, for the benchmarks: the link at a flight's rates, with callbacks that do nothing.

What it costs of a core is the least that an app over MAVSDK can do; `tools.bench.share` measures what
`dart_flight` adds.
"""

from __future__ import annotations

import asyncio
from typing import Any

from dart_flight.config.mission import Mission
from dart_flight.vehicle.messages import MessageEntry
from dart_flight.vehicle.vehicle_session import connect


async def stay(mission: Mission, url: str, ended: asyncio.Event) -> None:
    """Connect, subscribe as a flight does, but to callbacks that do nothing; stay until it has ended.

    Args:
        mission: whose vehicle it is.
        url: MAVSDK connection URL.
        ended: when to leave.
    """
    async with connect(url, mission.vehicle.connection.timeout_s, _nothing) as session:

        def listen_idly(entry: MessageEntry, *_: object) -> None:
            session._direct.subscribe_message(entry.message, _nothing)

        session.listen = listen_idly  # type: ignore[method-assign, assignment]
        session._on_event = session._on_checks = _nothing  # type: ignore[method-assign]
        motors = len(mission.vehicle.airframe.motors)
        session.subscribe(mission.vehicle.estimation, motors)
        await session.set_rates()
        await ended.wait()


def _nothing(*_: Any, **__: Any) -> None:
    """An empty callback."""
