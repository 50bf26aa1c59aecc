"""What is known of the vehicle: newest telemetry, force estimate, impacts; for the core and for `monitor`."""

from __future__ import annotations

from typing import NamedTuple

from dart_flight.config.mission import Mission
from dart_flight.core.sense.detector import Expected, ImpactDetector
from dart_flight.core.sense.force import ForceEstimator
from dart_flight.core.sense.state import FlightState
from dart_flight.samples import (
    ActuatorSample,
    AttitudeSample,
    AttitudeTargetSample,
    ClockOffset,
    CommandResult,
    ContactEnd,
    DetectionFloor,
    EscSample,
    EstimatorSample,
    ForceEstimate,
    HealthReport,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    Input,
    LockState,
    OdometrySample,
    StatusSample,
    StatusText,
    Tick,
)


class Sensed(NamedTuple):
    """What one input has taught.

    Attributes:
        estimate: the external force, where the input gives one.
        impacts: what the detector makes of it, none at most times; what it can feel, as an approach begins.
        in_contact: between onset and end of a contact.
    """

    estimate: ForceEstimate | None = None
    impacts: tuple[ImpactOnset | ImpactPeak | ContactEnd | DetectionFloor, ...] = ()
    in_contact: bool = False


_NOTHING, _TOUCHING = Sensed(), Sensed(in_contact=True)


class Senses:
    """State, estimator and detector, fed together.

    Attributes:
        state: the newest of every stream.
        estimator: external force from every IMU sample.
        detector: impacts in it; it watches only while told to.
    """

    def __init__(self, mission: Mission) -> None:
        self.state = FlightState()
        self.estimator = ForceEstimator(mission.vehicle)
        self.detector = ImpactDetector(mission.vehicle)

    def take(self, item: Input, expected: Expected) -> Sensed:
        """Take one input, knowing what contact the mission expects; returns what that teaches."""
        state, estimator = self.state, self.estimator
        if isinstance(item, ImuSample):
            if state.take_imu(item):
                return self._feel(item, expected)
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
            state.take_status(item)
            estimator.thrust.take_voltage(item.battery_v)
        elif isinstance(item, LockState):
            state.take_lock(item)
        elif isinstance(item, EstimatorSample):
            state.take_estimator(item)
        elif isinstance(item, ClockOffset):
            state.take_clock(item)
        elif isinstance(item, StatusText):
            state.take_text(item)
        elif isinstance(item, HealthReport):
            state.take_health(item)
        elif isinstance(item, CommandResult):
            state.take_result(item)
        return _TOUCHING if self.detector.in_contact else _NOTHING

    def _feel(self, item: ImuSample, expected: Expected) -> Sensed:
        estimate = self.estimator.estimate(item, self.state, self.detector.in_contact)
        if estimate is None:
            return Sensed(in_contact=self.detector.in_contact)
        impacts = self.detector.update(estimate, item.received_us, self.state, expected)
        return Sensed(estimate, tuple(impacts), self.detector.in_contact)
