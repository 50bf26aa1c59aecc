"""The flight core: samples in, commands and decisions out. No I/O, no clock, no asyncio.

The way of one IMU sample: `core.step` -> `senses` (`state` -> `force_estimator` -> `detector`) -> `executive`
(which calls `recovery` at the peak) -> `guard` -> out.
"""
