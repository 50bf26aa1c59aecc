"""Checks of a connected vehicle's telemetry: rates, senders, batteries, motor outputs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.motor_outputs import DSHOT, PWM, UAVCAN, OutputScale
from dart_flight.base.streams import BY_NAME
from dart_flight.base.text import battery_figures
from dart_flight.check.findings import CheckFinding
from dart_flight.config.mission import Mission
from dart_flight.vehicle.batteries import describe_reading
from dart_flight.vehicle.ground_link import Observation, Source, unusable_streams

LOOPBACK = "MAV_ODOM_LP"  # only PX4 versions before 1.14 have this parameter
_REST_TOLERANCE = 0.3  # tolerance, as a fraction of g; a wrong unit changes the value at least tenfold
_ARRIVES_HZ = 0.2  # minimum rate of a stream


class StreamRate(NamedTuple):
    """The rate of usable samples of a stream.

    Attributes:
        name: name in the stream table.
        enough: whether the rate is sufficient for a mission.
        unusable: the reason why messages are unusable; None if all are usable or the rate is sufficient.
    """

    name: str
    rate_hz: float
    enough: bool
    unusable: str | None

    @property
    def describe(self) -> str:
        """Return the rate and the required rate, or the reason why messages are unusable."""
        return self.unusable or f"{self.rate_hz:.0f} Hz, minimum {BY_NAME[self.name].expected_hz:g} Hz"


def stream_rates(rates_hz: Mapping[str, float], unusable: Mapping[str, str]) -> list[StreamRate]:
    """Check the rates of usable samples against the rates that a mission needs.

    Args:
        rates_hz: rate of each stream by its name in the stream table.
        unusable: the reason why a stream's messages are unusable, by the stream's name.
    """
    slow = {name: rate < BY_NAME[name].expected_hz for name, rate in rates_hz.items()}
    return [
        StreamRate(name, rate, not slow[name], unusable.get(name) if slow[name] else None)
        for name, rate in rates_hz.items()
    ]


def evaluate_rates(observed: Observation, values: Mapping[str, float]) -> list[CheckFinding]:
    """Check the rate of each stream; of the vehicle's parameters, only MAV_ODOM_LP (`LOOPBACK`) is used."""
    findings = []
    for stream in stream_rates(observed.rates_hz, unusable_streams(observed.sources)):
        go, message = stream.enough, stream.describe
        if stream.name == "odometry" and values.get(LOOPBACK):
            go, message = False, f"{message}; {LOOPBACK} is {values[LOOPBACK]:g}, set it to 0"
        findings.append(CheckFinding(f"rate_{stream.name}", go, message))
    return findings


def evaluate_sources(observed: Observation) -> list[CheckFinding]:
    """List the messages in use with their senders, and the senders that are ignored."""
    taken = [s for s in observed.sources if s.is_vehicle and s.usable_hz > 0.0]
    if not taken:
        return []
    systems = sorted({s.sender.system for s in taken})
    names = ", ".join(dict.fromkeys(s.sender.message for s in taken))
    message = f"system {', '.join(map(str, systems))} component 1: {names}"
    others = [_describe(s) for s in observed.sources if _is_other(s)]
    if others:
        message += "; not used: " + "; ".join(others)
    return [CheckFinding("sources", True, message, remark=bool(others))]


def evaluate_systems(mission: Mission, observed: Observation) -> list[CheckFinding]:
    """Compare the MAVLink system ids of vehicle, program and ground station; return the problems."""
    if observed.systems is None:
        return []
    vehicle, own = observed.systems
    station = mission.vehicle.ground_station.system_id
    if station == vehicle:
        message = (
            f"vehicle and ground station (ground_station.system_id) are both system {vehicle}: change one"
        )
        return [CheckFinding("system_id", False, message)]
    if own != vehicle:
        message = (
            f"this program sends as system {own}, the vehicle is system {vehicle}: PX4 does not forward the "
            f"ground station's buttons; set MAV_SYS_ID to {own}"
        )
        return [CheckFinding("system_id", False, message)]
    return []


def _is_other(source: Source) -> bool:
    if source.is_vehicle:
        return (
            bool(source.reason) and source.arriving_hz >= _ARRIVES_HZ and source.sender.message != "TIMESYNC"
        )
    return source.sender.message not in ("HEARTBEAT", "TIMESYNC")


def _describe(source: Source) -> str:
    sender = source.sender
    instance = f", instance {sender.instance}" if sender.instance else ""
    return (
        f"{sender.message} of system {sender.system} component {sender.component}{instance}, "
        f"{source.arriving_hz:.0f} Hz"
    )


def evaluate_battery(mission: Mission, observed: Observation) -> CheckFinding:
    """Check the charge of the flight battery with the worst reading."""
    guard, left, volts = mission.vehicle.guard, observed.battery_remaining, observed.battery_v
    low = (left is not None and left < 2.0 * guard.battery_remaining) or (
        volts is not None and volts < guard.battery_v
    )
    message = ", ".join(battery_figures(left, volts)) or "not reported"
    if observed.battery_id is not None:
        message = f"id {observed.battery_id}: {message}"
    also = [r for r in observed.batteries if r.id != observed.battery_id]
    if also:
        message += "; better: " + ", ".join(describe_reading(r) for r in also)
    if observed.other_batteries:
        message += "; not a flight battery: " + ", ".join(
            describe_reading(r) for r in observed.other_batteries
        )
    return CheckFinding("battery", not low, message)


def evaluate_resting_force(observed: Observation) -> list[CheckFinding]:
    """Return a no-go if the accelerometer does not measure gravity while the vehicle is at rest."""
    force = observed.specific_force_m_s2
    if force is None or abs(force - GRAVITY_M_S2) <= _REST_TOLERANCE * GRAVITY_M_S2:
        return []
    message = f"HIGHRES_IMU reports {force:.2f} m/s2 on the ground, not 9.81: wrong unit or not calibrated"
    return [CheckFinding("imu_scale", False, message)]


# --- motor outputs -----------------------------------------------------------------------------------------

_BANKS = ("PWM_MAIN", "PWM_AUX", "UAVCAN_EC")  # banks of outputs, in the order in which PX4 starts them
_MOTOR_1 = 101  # output function
_SLOWEST_DSHOT = -2  # PWM_<bank>_TIM<n>: a value of -2 or less selects DShot, and -1 selects OneShot


def motor_output_names(values: Mapping[str, float], motors: int) -> list[str]:
    """Return the next parameters to read in the search for the motors' outputs; empty if all have been read.

    A bank is a group of outputs, such as PWM_MAIN. Reading an absent parameter takes seconds, so the first
    output of a bank decides whether the bank exists.
    """
    for bank in _BANKS:
        pins = [f"{bank}_FUNC{k}" for k in range(1, motors + 1)]
        if pins[0] not in values:
            return [pins[0]]
        if pins[0] in values and math.isfinite(values[pins[0]]) and pins[1] not in values:
            return pins[1:]
        if _has_motors(bank, values, motors):
            break
    else:
        return []
    if bank.startswith("PWM") and f"{bank}_TIM0" not in values:
        return [f"{bank}_TIM0", *(f"{bank}_{end}{k}" for k in range(1, motors + 1) for end in ("MIN", "MAX"))]
    return []


def _has_motors(bank: str, values: Mapping[str, float], motors: int) -> bool:
    functions = [values.get(f"{bank}_FUNC{k}", 0.0) for k in range(1, motors + 1)]
    return any(_MOTOR_1 <= function < _MOTOR_1 + motors for function in functions)


def evaluate_motor_outputs(
    mission: Mission, observed: Observation, values: Mapping[str, float]
) -> list[CheckFinding]:
    """Return the motors' output type and scale, or the reason why the outputs cannot be decoded.

    Args:
        observed: telemetry, with the output scale that its values imply.
        values: parameters requested by `motor_output_names`.
    """
    item, motors = "motor_outputs", len(mission.vehicle.airframe.motors)
    observed_scale = observed.motor_scale
    bank = next((bank for bank in _BANKS if _has_motors(bank, values, motors)), None)
    if bank is None:
        if f"{_BANKS[0]}_FUNC1" in values:
            message = (
                f"none of the outputs 1 to {motors} of {', '.join(_BANKS)} drives a motor: thrust is unknown"
            )
            return [CheckFinding(item, False, message)]
        by_values = (
            f"{observed_scale.describe()}, inferred from the values"
            if observed_scale
            else "the vehicle is disarmed and all outputs are 0, so the output type is not known yet"
        )
        return [CheckFinding(item, True, by_values)]
    wrong = _problem_of(bank, values, motors)
    if wrong:
        return [CheckFinding(item, False, wrong)]
    scale = _configured_scale(bank, values)
    if observed_scale is not None and observed_scale != scale:
        message = f"the parameters of {bank} select {scale.describe()}, but the vehicle sends "
        message += observed_scale.describe()
        return [CheckFinding(item, False, message)]
    return [CheckFinding(item, True, f"{scale.describe()}, on {bank}")]


def _configured_scale(bank: str, values: Mapping[str, float]) -> OutputScale:
    if bank == "UAVCAN_EC":
        return UAVCAN
    return DSHOT if values.get(f"{bank}_TIM0", 0.0) <= _SLOWEST_DSHOT else PWM


def _problem_of(bank: str, values: Mapping[str, float], motors: int) -> str:
    for k in range(1, motors + 1):
        function = round(values.get(f"{bank}_FUNC{k}", 0))
        if function != _MOTOR_1 + k - 1:
            return (
                f"output {k} of {bank} has function {function}, not {_MOTOR_1 + k - 1} (motor {k}): assign "
                f"the motors to outputs 1 to {motors}"
            )
    earlier = [
        b for b in _BANKS[: _BANKS.index(bank)] if any(values.get(f"{b}_FUNC{k}") for k in range(1, 17))
    ]
    if earlier:
        return (
            f"thrust is unknown: the motors are on {bank}, but PX4 reports only {earlier[0]}, the bank that "
            f"it starts first; free all outputs of {earlier[0]}, or move the motors to {earlier[0]}"
        )
    if _configured_scale(bank, values) is PWM:
        for k in range(1, motors + 1):
            low, high = values.get(f"{bank}_MIN{k}", PWM.stop), values.get(f"{bank}_MAX{k}", PWM.full)
            if (low, high) != (PWM.stop, PWM.full):
                return (
                    f"{bank}_MIN{k} and MAX{k} are {low:g} and {high:g}: set {PWM.stop:g} and {PWM.full:g}, "
                    "the thrust model's range"
                )
    return ""
