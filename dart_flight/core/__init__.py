"""The flight core: inputs in, commands and decisions out; no I/O, no clock, no asyncio.

The path of one IMU sample: `flight_core` -> `sense` (`state` -> `vehicle_motion` -> `force` -> `detector`) ->
`mission.executive` (which calls `recovery` at the peak) -> `guard` -> out.
"""
