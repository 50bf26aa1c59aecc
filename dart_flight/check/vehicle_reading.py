"""The parameters and telemetry of a vehicle on the ground, read once for all checks of a stage."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import msgspec

from dart_flight.check.findings import CheckFinding, EndOfStageError
from dart_flight.check.hitl_check import BOARD, HITL, IO_OUTPUTS, ON_A_BOARD, WITH_IO, hitl_parameters
from dart_flight.check.px4_parameters import alternative_names, parameter_names, position_source
from dart_flight.check.telemetry_check import LOOPBACK, motor_output_names
from dart_flight.check.vehicle_check import evaluate_autopilot, evaluate_round_trip
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource, Version
from dart_flight.config.rotors import COUNT, motors_from_parameters, rotor_names
from dart_flight.config.vehicle import LockDriver, Motor
from dart_flight.lock.drivers.px4_output import required_parameters
from dart_flight.vehicle.command_server import Press, Result
from dart_flight.vehicle.ground_link import GroundLink, HeartbeatMode, Observation

_MEASURE_S = 3.0
_UNANSWERED = "no answer to repeated requests, so PX4's behaviour is unknown: try again, or improve the link"


class VehicleReading(msgspec.Struct, frozen=True):
    """The parameters and telemetry of a vehicle on the ground.

    Attributes:
        mode: mode in the heartbeat, or None without a heartbeat.
        values: PX4's parameters.
        observed: telemetry over a few seconds.
        round_trip_s: shortest round trip of a request, seconds, or None if no request was answered.
    """

    mode: HeartbeatMode | None
    values: Mapping[str, float]
    observed: Observation = msgspec.field(default_factory=Observation)
    round_trip_s: float | None = None

    @property
    def version(self) -> Version | None:
        """PX4's major and minor version, or None if not reported (0.0.0)."""
        return parse_release(self.observed.version)

    @property
    def position_from(self) -> PositionSource | None:
        return position_source(self.values, self.observed.gps_fix)

    @property
    def motors(self) -> tuple[Motor, ...] | None:
        """The motors in PX4's parameters, or None if the parameters describe no motors."""
        if not rotor_names(self.values.get(COUNT, 0.0)):
            return None
        return motors_from_parameters(self.values, "the flight controller")


def read_vehicle(
    mission: Mission, url: str, answer: Callable[[Press], tuple[Result, str]] | None = None
) -> VehicleReading:
    """Read the parameters and telemetry that the checks of a vehicle need.

    During the reading, `answer` responds to the ground station's buttons. If `answer` is None, the buttons
    get no response.

    Raises: EndOfStageError: the autopilot is not PX4, the link is too slow to read the parameters, or a
            parameter has no answer.
        VehicleError: no autopilot is found at the URL.
        NoAnswerError: the autopilot does not answer requests.
    """
    lock = mission.vehicle.lock
    with GroundLink(url, mission.vehicle.connection.timeout_s, mocap=mission.vehicle.mocap) as link:
        if answer is not None:
            link.serve_operator(mission.vehicle.ground_station.system_id, answer)
        mode = link.heartbeat_mode()
        other = evaluate_autopilot(mode)
        if other:
            raise EndOfStageError(other)  # an autopilot other than PX4 lacks PX4's parameters and modes
        round_trip_s = link.round_trip_s()
        late = evaluate_round_trip(mission, round_trip_s)
        if not late.go:
            raise EndOfStageError([late])  # over a link this slow, reading the parameters takes minutes
        observed = link.observe(mission.vehicle, _MEASURE_S)
        names = [*parameter_names(parse_release(observed.version)), COUNT]
        if lock is not None and lock.driver is LockDriver.PX4:
            names += [required.name for required in required_parameters(lock)]
        lost: set[str] = set()
        values = link.read_parameters(names, unanswered=lost)
        values |= link.read_parameters(dict.fromkeys(alternative_names(values)), unanswered=lost)
        values |= link.read_parameters(rotor_names(values.get(COUNT, 0.0)), unanswered=lost)
        values |= _read_outputs(link, len(mission.vehicle.airframe.motors), lost)
        if any(s.reason for s in observed.sources if s.is_vehicle and s.sender.message == "ODOMETRY"):
            values |= link.read_parameters([LOOPBACK], unanswered=lost)
    if lost:
        raise EndOfStageError([CheckFinding(name, False, _UNANSWERED) for name in sorted(lost)])
    return VehicleReading(mode, values, observed, round_trip_s)


def _read_outputs(link: GroundLink, motors: int, unanswered: set[str]) -> dict[str, float]:
    """Read the parameters of the motor outputs, and return those that exist on the vehicle.

    `unanswered` receives the names of the parameters without an answer.
    """
    values: dict[str, float] = {}
    while names := motor_output_names(values, motors):
        values |= dict.fromkeys(names, math.nan) | link.read_parameters(names, unanswered=unanswered)
    return {name: value for name, value in values.items() if math.isfinite(value)}


def read_for_hitl(mission: Mission, url: str) -> VehicleReading:
    """Read a flight controller before it gets simulated sensors; raise the same errors as `read_vehicle`.

    The URL belongs to the application's link, not to the link for simulated sensors.
    """
    with GroundLink(url, mission.vehicle.connection.timeout_s) as link:
        mode = link.heartbeat_mode()
        values = link.read_parameters([*hitl_parameters(), COUNT])
        values |= link.read_parameters([WITH_IO, *IO_OUTPUTS] if ON_A_BOARD in values else [BOARD])
        if round(values.get(HITL, 0)) == 1:
            # If HITL is off, skip these parameters: they take a minute, and a restart must follow anyway.
            values |= link.read_parameters([name for name in parameter_names() if name not in values])
            values |= link.read_parameters(rotor_names(values.get(COUNT, 0.0)))
    return VehicleReading(mode, values)


def parse_release(text: str) -> Version | None:
    """Return the major and minor number of a version text, or None if the text is empty or 0.0.0."""
    major, _, rest = text.partition(".")
    minor = rest.partition(".")[0]
    return (int(major), int(minor)) if major.isdigit() and minor.isdigit() and int(major) else None
