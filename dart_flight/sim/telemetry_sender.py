"""Telemetry of a simulated vehicle as records, for worlds in the same process as the program."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    EstimatorSample,
    ImuSample,
    Input,
    OdometrySample,
    StatusSample,
)
from dart_flight.sim.simulated_vehicle import SimulatedVehicle

_HALF_RATE: Final = 2  # ticks: attitude, odometry, actuator outputs at 125 Hz
_STATUS_EVERY: Final = 50  # status at 5 Hz, and immediately after a change
# ticks between reports of the position's standard deviation, if the estimator reports it
_POSITION_SD_EVERY: Final = 250


class TelemetrySender:
    """Telemetry of one simulated vehicle, at the rates of the stream table.

    A vehicle sends its status immediately only if it has just been switched on (`begins`).
    """

    def __init__(self, vehicle: SimulatedVehicle, begins: bool = True) -> None:
        self._autopilot = a = vehicle.autopilot
        self._status: tuple[object, ...] = (
            () if begins else (a.armed, a.mode, a.landed, a.estimator.ok, a.system_status)
        )
        self._resets = -1

    def samples(self, ticks: int, received: int) -> Iterator[Input]:
        """Yield the samples that are due at a tick; `received` is the host time of receipt, microseconds."""
        a, t_us = self._autopilot, self._autopilot.time_us
        e = a.estimator
        if ticks % _HALF_RATE == 0:
            # The MAVLink message has a stamp in milliseconds.
            yield AttitudeSample(t_us // 1000 * 1000, received, e.q)
            if e.ok:
                yield OdometrySample(t_us, received, e.position, e.velocity)
            yield ActuatorSample(t_us, received, a.motors)
        yield ImuSample(a.imu.t_us, received, a.imu.specific_force_frd, a.imu.rate_frd)
        if e.resets != self._resets or (e.position_sd_m is not None and ticks % _POSITION_SD_EVERY == 0):
            self._resets = e.resets
            yield EstimatorSample(t_us, received, e.resets, position_sd_m=e.position_sd_m)
        status = (a.armed, a.mode, a.landed, e.ok, a.system_status)
        if status != self._status or ticks % _STATUS_EVERY == 0:
            self._status = status
            volts = a.vehicle.simulation.battery_v
            yield StatusSample(t_us, received, *status[:4], volts, a.battery_remaining, a.system_status)
