"""A MAVSDK script without code of this project: connect, check health, arm, take off, fly, land.

`test_embedded_flights.py` runs it against `dart-flight simulate`. Usage: plain_mavsdk_script.py URL
"""

import asyncio
import sys

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.offboard import PositionNedYaw
from mavsdk.plugins.telemetry import LandedState


async def main(url: str) -> None:
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    async with Mavsdk(configuration) as mavsdk:
        await mavsdk.add_any_connection(url)
        system = await mavsdk.first_autopilot(timeout_s=20)
        if system is None:
            sys.exit("no autopilot")
        action, offboard = ActionAsync(system), OffboardAsync(system)
        telemetry = TelemetryAsync(system)
        async for health in telemetry.subscribe_health():
            if health.is_local_position_ok and health.is_global_position_ok and health.is_armable:
                break
        await action.set_takeoff_altitude(1.2)
        await action.arm()
        await action.takeoff()
        async for position in telemetry.subscribe_position():
            if position.relative_altitude_m > 1.1:
                break
        await offboard.set_position_ned(PositionNedYaw(1.0, 0.5, -1.2, 90.0))
        await offboard.start()
        async for state in telemetry.subscribe_position_velocity_ned():
            p = state.position
            if abs(p.north_m - 1.0) < 0.15 and abs(p.east_m - 0.5) < 0.15:
                break
        await action.land()
        async for landed in telemetry.subscribe_landed_state():
            if landed == LandedState.ON_GROUND:
                break
        async for armed in telemetry.subscribe_armed():
            if not armed:
                break
    print("landed and disarmed")


asyncio.run(asyncio.wait_for(main(sys.argv[1]), 60.0))
