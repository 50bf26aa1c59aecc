"""Forwarding of a motion capture's poses to PX4 without a flight, for `dart-flight mocap`."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable

from dart_flight.config.mission import Mission
from dart_flight.vehicle.motion_capture.pose_bridge import MotionCaptureBridge, forwarding
from dart_flight.vehicle.motion_capture.pose_statistics import PoseFigures, PoseStatistics
from dart_flight.vehicle.motion_capture.source import PoseSource
from dart_flight.vehicle.vehicle_session import connect

_STREAMS = ("attitude", "odometry")  # PX4's own estimate, which is compared with the poses


async def forward_poses(
    mission: Mission,
    source: PoseSource,
    url: str,
    show: Callable[[PoseFigures, MotionCaptureBridge], None],
    period_s: float,
    seconds: float | None,
    opened: Callable[[], None] = lambda: None,
) -> None:
    """Forward the poses of `mocap.url` to PX4, and call `show` once per period.

    Args:
        source: the opened source of `mocap.url`; it is closed at the end.
        seconds: duration, or None to run until cancelled.

    Raises:
        VehicleError: there is no autopilot at the URL.
    """
    vehicle = mission.vehicle
    statistics = PoseStatistics(vehicle.mocap.room_frame(), vehicle.mocap.delay_ms)

    def report(bridge: MotionCaptureBridge) -> None:
        show(statistics.figures(session.clock.host_us()), bridge)

    async with connect(url, vehicle.connection.timeout_s, statistics.update, opened=opened) as session:
        session.subscribe(vehicle.estimation, len(vehicle.airframe.motors), guarded=False)
        poses = forwarding(vehicle.mocap, session.send_message, session.clock, statistics.update, source)
        with poses as bridge:
            assert bridge is not None, "the command must refuse a configuration without mocap.url"
            await session.set_rates(_STREAMS, watching=True)
            end_s = None if seconds is None else time.monotonic() + seconds
            try:
                while end_s is None or time.monotonic() < end_s:
                    left_s = period_s if end_s is None else min(period_s, end_s - time.monotonic())
                    await asyncio.sleep(max(0.0, left_s))
                    report(bridge)
            except asyncio.CancelledError:
                with contextlib.suppress(Exception):  # show the last figures if the link is open
                    report(bridge)
                raise
