"""What is known of the vehicle: newest telemetry, force estimate, impacts; for the core and for `monitor`."""

from __future__ import annotations

from dart_flight.config.mission import Mission
from dart_flight.core.sense.detector import ImpactDetector
from dart_flight.core.sense.force import ForceEstimator
from dart_flight.core.sense.state import FlightState
from dart_flight.samples import (
    ActuatorSample,
    AttitudeSample,
    AttitudeTargetSample,
    ClockOffset,
    ContactEnd,
    EscSample,
    EstimatorSample,
    ForceEstimate,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    Input,
    LockState,
    OdometrySample,
    StatusSample,
    Tick,
)

Event = ImpactOnset | ImpactPeak | ContactEnd


class Senses:
    """State, estimator and detector, fed together.

    Attributes:
        state: the newest of every stream.
        estimator: external force from every IMU sample.
        detector: impacts in it; it watches only while told to.
    """

    def __init__(self, mission: Mission) -> None:
        self.state = FlightState(mission)
        self.estimator = ForceEstimator(mission.vehicle)
        self.detector = ImpactDetector(mission.vehicle)

    def take(self, item: Input) -> tuple[ForceEstimate | None, list[Event]]:
        """Take one input; returns the force that it gives, and what the detector makes of that."""
        state, estimator = self.state, self.estimator
        if isinstance(item, ImuSample):
            if state.take_imu(item):
                return self._feel(item)
        elif isinstance(item, AttitudeSample):
            if state.take_attitude(item):
                estimator.take_attitude(item)
        elif isinstance(item, OdometrySample):
            state.take_odometry(item)
        elif isinstance(item, ActuatorSample):
            state.take_actuator(item)
            estimator.thrust.take_actuator(item)
        elif isinstance(item, AttitudeTargetSample):
            estimator.thrust.take_attitude_target(item)
        elif isinstance(item, EscSample):
            estimator.thrust.take_esc(item)
        elif isinstance(item, Tick):
            state.take_tick(item)
        elif isinstance(item, StatusSample):
            state.status = item
            estimator.thrust.take_voltage(item.battery_v)
            state.host_us = max(state.host_us, item.received_us)
        elif isinstance(item, LockState):
            state.lock = item
        elif isinstance(item, EstimatorSample):
            state.host_us = max(state.host_us, item.received_us)
        elif isinstance(item, ClockOffset):
            state.take_clock(item)
        return None, []

    def _feel(self, item: ImuSample) -> tuple[ForceEstimate | None, list[Event]]:
        estimate = self.estimator.estimate(item, self.state, self.detector.in_contact)
        if estimate is None:
            return None, []
        return estimate, self.detector.update(estimate, item.received_us, self.state)
