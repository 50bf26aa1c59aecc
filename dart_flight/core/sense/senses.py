"""Senses of the core, of `monitor` and of `inspect`: state, force, torque and impacts from samples."""

from __future__ import annotations

from typing import Final, NamedTuple

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ClockOffset,
    CommandResult,
    ContactAnswer,
    EscSample,
    EstimatorSample,
    ForceEstimate,
    HealthReport,
    ImuSample,
    Input,
    LockState,
    OdometrySample,
    Output,
    PoseSample,
    StatusSample,
    StatusText,
    Tick,
    TorqueEstimate,
    WallEstimate,
)
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.contact_height import ContactHeight
from dart_flight.core.sense.contact_recorder import ContactRecorder
from dart_flight.core.sense.detector import Event, ExpectedContact, ImpactDetector
from dart_flight.core.sense.force import ForceEstimator
from dart_flight.core.sense.position_delay import PositionDelay
from dart_flight.core.sense.state import FlightState
from dart_flight.core.sense.torque import TorqueEstimator
from dart_flight.core.sense.vehicle_motion import VehicleMotion

# A contact may disturb PX4's estimate for this long; such a disturbance is not an estimator fault.
IMPACT_WINDOW_S: Final = 2.0


class Sensed(NamedTuple):
    """Results of the senses for one input.

    Attributes:
        estimate: external force, or None if the input yields none.
        impacts: events of the detector, usually none. At the beginning of an approach, they include the
            smallest detectable force (`DetectionFloor`).
        torque: external torque, or None if the input yields none.
        contact: records of a contact that has ended: the request for its fit, or the results of the fit.
        wall: estimate of a planned wall and of the mode of the arms, or None; it is also in `contact`.
        height_m: height above the centre of mass at which the walls' force acts, or None if not known.
        thrust_ratio: thrust from mass and accelerometer, divided by thrust from the curve, in the last
            seconds of free flight; None if not known.
    """

    estimate: ForceEstimate | None = None
    impacts: tuple[Event, ...] = ()
    in_contact: bool = False
    torque: TorqueEstimate | None = None
    contact: tuple[Output, ...] = ()
    wall: WallEstimate | None = None
    height_m: float | None = None
    thrust_ratio: float | None = None


_NOTHING: Final = Sensed()
_TOUCHING: Final = Sensed(in_contact=True)


class Senses:
    """State, estimators and impact detector, updated together.

    The detector is active only while `ExpectedContact.watching` is set. Every user of a force estimate gets
    the estimate from this class. Construct another estimator here (docs/extending.md).
    """

    def __init__(self, vehicle: VehicleConfig) -> None:
        self.state = FlightState(vehicle.has_lock)
        self.motion = VehicleMotion(vehicle)
        self.force = ForceEstimator(vehicle)
        self.torque = TorqueEstimator(vehicle)
        self.detector = ImpactDetector(vehicle)
        self.contacts = ContactRecorder(vehicle)
        self.height = ContactHeight(vehicle.airframe.contact_distance_m)
        self.delay = PositionDelay(vehicle.airframe.mass_kg, IMPACT_WINDOW_S)

    def update(self, item: Input, expected: ExpectedContact) -> Sensed:
        state, motion = self.state, self.motion
        if type(item) is ImuSample:
            if state.update_imu(item):
                return self._process_imu(item, expected)
        elif type(item) is AttitudeSample:
            if state.update_attitude(item):
                motion.add_attitude(item)
        elif type(item) is OdometrySample:
            if state.update_odometry(item) and item.t_us >= self.delay.due_us:
                self._compare_velocity(item.t_us)
        elif type(item) is ActuatorSample:
            state.update_actuator(item)
            motion.thrust.add_commands(item)
        elif type(item) is PoseSample:
            state.update_pose(item)
        elif type(item) is EscSample:
            motion.thrust.update_esc(item)
        elif type(item) is Tick:
            state.advance(item)
        elif type(item) is StatusSample:
            state.update_status(item)
            motion.thrust.update_voltage(item.battery_v)
        elif type(item) is LockState:
            state.update_lock(item)
        elif type(item) is EstimatorSample:
            state.update_estimator(item)
        elif type(item) is ClockOffset:
            state.update_clock(item)
        elif type(item) is StatusText:
            state.add_text(item)
        elif type(item) is HealthReport:
            state.update_health(item)
        elif type(item) is CommandResult:
            state.add_result(item)
        elif type(item) is ContactAnswer:
            body, wall = self.contacts.accept(item)
            records: list[Output] = [] if body is None else [body]
            if wall is not None:
                records.append(wall)
            return Sensed(in_contact=self.detector.in_contact, contact=tuple(records), wall=wall)
        return _TOUCHING if self.detector.in_contact else _NOTHING

    def _compare_velocity(self, t_us: int) -> None:
        state, delay = self.state, self.delay
        if self.detector.in_contact:
            delay.disturb(t_us)
        delay.compare_odometry(t_us, state.velocity, self.motion.momenta)
        state.position_ahead_s = delay.ahead_s

    def _process_imu(self, item: ImuSample, expected: ExpectedContact) -> Sensed:
        state, motion, detector = self.state, self.motion, self.detector
        touching = detector.in_contact
        complete = motion.update(item, state, touching)
        torque = self.torque.estimate(
            item.t_us,
            motion.turning,
            motion.thrust.each_n,
            motion.hover.scale,
            not touching and not state.on_ground,
        )
        if not complete:
            return Sensed(in_contact=touching)
        estimate = self.force.estimate(item, motion, state)
        slow = detector.slow_force.value
        impacts = detector.update(estimate, item.received_us, state, expected)
        contact: tuple[Output, ...] = ()
        wall = None
        if torque is not None and motion.attitude is not None:
            self.contacts.add(estimate, torque, motion.attitude, motion.turning.rate)
            if impacts:
                request = self.contacts.update(state, slow, impacts, expected)
                if request is not None:
                    contact = (request,)
                    self.height.add(request)
        if self.contacts.unanswered and not contact:
            wall = self.contacts.overdue(item.t_us)
            contact = () if wall is None else (wall,)
        found = tuple(impacts) if impacts else ()
        ratio = motion.hover.thrust_ratio
        return Sensed(
            estimate, found, detector.in_contact, torque, contact, wall, self.height.height_m, ratio
        )
