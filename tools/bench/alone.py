"""MAVSDK alone, for the benchmarks: the link at a flight's rates, with empty callbacks.

No app over MAVSDK can take less processor time than this program. `tools.bench.share` measures what
`dart_flight` adds.
"""

from __future__ import annotations

import asyncio
from typing import Any

from dart_flight.config.mission import Mission
from dart_flight.vehicle.messages import MessageEntry
from dart_flight.vehicle.vehicle_session import connect


async def keep_connected(mission: Mission, url: str, ended: asyncio.Event) -> None:
    """Connect and subscribe as a flight does, but with empty callbacks, until `ended` is set.

    Args:
        mission: mission with the vehicle.
        url: MAVSDK connection URL.
        ended: event that ends the connection.
    """
    async with connect(url, mission.vehicle.connection.timeout_s, _do_nothing) as session:

        def listen_idly(entry: MessageEntry, *_: object) -> None:
            session._direct.subscribe_message(entry.message, _do_nothing)

        session.listen = listen_idly  # type: ignore[method-assign, assignment]
        session._on_event = session._on_checks = _do_nothing  # type: ignore[method-assign]
        motors = len(mission.vehicle.airframe.motors)
        session.subscribe(mission.vehicle.estimation, motors)
        await session.set_rates()
        await ended.wait()


def _do_nothing(*_: Any, **__: Any) -> None:
    """Do nothing."""
