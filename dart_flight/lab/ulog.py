"""Reader of PX4's logs (ULog, PX4 1.9 and later): topics as arrays, decoded motor commands, battery voltage.

The content of `actuator_outputs` depends on PX4's version and on the output type. Parameters limit the pulse
widths: `PWM_MIN` and `PWM_MAX` until 1.11, `PWM_MAIN_MIN` and `PWM_MAIN_MAX` in 1.12, and parameters of each
pin since 1.13. DShot uses 0 to 1999, UAVCAN 0 to 8191 and the simulation 0 to 1. A log may have several
instances of `actuator_outputs`: one contains the motors, the others contain servos or nothing.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.motor_outputs import PWM, identify_scale
from dart_flight.config.document import InputError, open_file
from dart_flight.config.file_kinds import FileKind, refuse_other_kind
from dart_flight.config.packages import missing_package
from dart_flight.config.rotors import COUNT, MAV_TYPES

Array = NDArray[np.float64]

_MIN_CELL_V = 3.0  # a flight battery has at least one cell; an unconnected sensor reads 0.05 V
_LONGEST_COUNT = 8
_MOTORS_OF_TYPE = {kind: motors for motors, kind in MAV_TYPES.items()}
# Largest plausible magnitudes; a flipped bit exceeds them. No IMU measures 1000 m/s2 (100 g).
_PLAUSIBLE = {
    "sensor_combined": {"accelerometer_m_s2": 1000.0, "gyro_rad": 100.0},
    "vehicle_attitude": {"q": 1.01},
    "vehicle_local_position": {"x": 1e5, "y": 1e5, "z": 1e5, "vx": 1e3, "vy": 1e3, "vz": 1e3},
    "actuator_motors": {"control": 1.01},
    "battery_status": {"voltage_v": 1e3},
}
_MAX_OUT_OF_STEP_US = 100_000  # maximum difference of a valid stamp from its neighbours
_MAX_SPAN_US = 86_400e6  # maximum duration of a log: a day
ARMED = 2  # vehicle_status.arming_state
_OLDEST = (1, 9, 0)
_ROTARY_WING = 1  # vehicle_status.vehicle_type
_VEHICLE_TYPES = {2: "plane", 3: "rover", 4: "airship"}
# MAV_TYPE of multirotors, and of the other vehicles that PX4 supports.
_MULTIROTORS = (0, 2, 3, 13, 14, 15, 29, 35)
_MAV_TYPES = {
    **{1: "plane", 4: "helicopter", 7: "airship", 8: "balloon", 10: "rover", 11: "boat", 12: "submarine"},
    **dict.fromkeys(range(19, 26), "VTOL"),
}
_STILL = 1e-3  # minimum variation of a motor's output, as a fraction of the range


class ULogFile(msgspec.Struct):
    """A PX4 log.

    Attributes:
        source: name of the file, for messages.
        topics: name -> instance -> field -> array as PX4 wrote it. Topics without samples are absent.
        parameters: PX4's parameters at the start of the log.
        version: PX4's version, or None if it is not logged or PX4 was built between releases.
        gaps_s: total duration of the logger's gaps, s.
        damage: descriptions of damaged parts, which are skipped.
    """

    source: str
    topics: dict[str, dict[int, dict[str, Any]]]
    parameters: dict[str, float]
    version: tuple[int, int, int] | None
    gaps_s: float
    damage: tuple[str, ...] = ()

    def first(self, name: str) -> dict[str, Any] | None:
        """Return instance 0 of a topic, or None if the topic was not logged."""
        return self.topics.get(name, {}).get(0)

    def rate_hz(self, name: str) -> float | None:
        """Return the mean rate of a topic's first instance, or None if the topic was not logged."""
        data = self.first(name)
        if data is None or len(data["timestamp"]) < 2:
            return None
        t = seconds(data)
        return float((len(t) - 1) / max(t[-1] - t[0], 1e-6))


class MotorCommands(msgspec.Struct):
    """Commands to the motors, 0 to 1, (n, motors), at stamps in s, (n,).

    `description` names the topic and how its values were decoded.
    """

    time_s: Array
    values: Array
    description: str


class Battery(msgspec.Struct):
    """Battery voltage over time; if the voltage is left out, `problem` gives the reason."""

    time_s: Array
    volts: Array
    problem: str = ""


def open_ulog(path: str | Path, topics: Sequence[str]) -> ULogFile:
    source = str(path)
    try:
        from pyulog import ULog  # noqa: PLC0415  (an extra, slow to import)
    except ImportError:
        raise missing_package("needs pyulog", "identify", source=source) from None
    # pyulog prints its warnings to stdout, which may carry this program's JSON.
    with open_file(path) as file, contextlib.redirect_stdout(io.StringIO()) as printed:
        try:
            log = ULog(file, list(topics))
        except OSError as error:
            raise InputError(f"cannot read: {error.strerror or error}", source=source) from None
        except Exception:
            # pyulog raises arbitrary exceptions on damaged files.
            refuse_other_kind(path, FileKind.ULOG)
            raise InputError("not a readable ULog", source=source) from None
    found: dict[str, dict[int, dict[str, Any]]] = {}
    damage = ["parts of the file are damaged"] if log.file_corruption or printed.getvalue() else []
    for entry in log.data_list:
        good = _plausible(entry.name, entry.data)
        if not good.all():
            damage.append(f"{int((~good).sum())} damaged samples of {entry.name}")
        if good.any():
            found.setdefault(entry.name, {})[entry.multi_id] = {k: v[good] for k, v in entry.data.items()}
    release = int(log.msg_info_dict.get("ver_sw_release", 0))
    version = (release >> 24 & 255, release >> 16 & 255, release >> 8 & 255) if release else None
    return ULogFile(
        source=source,
        topics=found,
        parameters={name: float(value) for name, value in log.initial_parameters.items()},
        version=version,
        gaps_s=sum(d.duration for d in log.dropouts) * 1e-3,
        damage=tuple(damage),
    )


def _plausible(name: str, data: dict[str, Any]) -> NDArray[np.bool_]:
    """Return a mask of the samples whose stamps and values are plausible; NaN is a plausible value."""
    stamps = np.asarray(data["timestamp"]).astype(float)
    good = np.ones(len(stamps), dtype=bool)
    if len(stamps) > 4:
        around = np.lib.stride_tricks.sliding_window_view(stamps, 5)
        good[2:-2] = np.abs(stamps[2:-2] - np.median(around, axis=1)) <= _MAX_OUT_OF_STEP_US
        for ends in (slice(0, 2), slice(-2, None)):
            good[ends] = np.abs(stamps[ends] - np.median(stamps)) <= _MAX_SPAN_US
    for field, most in _PLAUSIBLE.get(name, {}).items():
        for column, values in data.items():
            if column.partition("[")[0] == field:
                good &= ~(np.abs(np.asarray(values, dtype=float)) > most)  # NaN is plausible
    return good


def refuse_other_vehicles(log: ULogFile) -> None:
    """Reject a log if PX4's version or the vehicle type is unsupported, or the vehicle was never armed.

    A log that lacks this information is accepted.
    """
    if log.version is not None and log.version < _OLDEST:
        raise InputError(
            f"log of PX4 {'.'.join(map(str, log.version))}: only {_OLDEST[0]}.{_OLDEST[1]} and later are "
            "supported",
            source=log.source,
        )
    other = _other_than_multicopter(log)
    if other is not None:
        raise InputError(f"the log is of a {other}: only multicopters are supported", source=log.source)
    status = log.first("vehicle_status")
    if status is not None and not (np.asarray(status["arming_state"]) == ARMED).any():
        raise InputError("the vehicle was never armed: the log contains no flight", source=log.source)


def _other_than_multicopter(log: ULogFile) -> str | None:
    status, kind = log.first("vehicle_status") or {}, log.parameters.get("MAV_TYPE", 0.0)
    if "system_type" in status:
        kind = float(status["system_type"][-1])
    if "is_vtol" in status and np.asarray(status["is_vtol"]).any():
        return "VTOL"
    if kind not in _MULTIROTORS:
        return _MAV_TYPES.get(int(kind), f"vehicle of MAV_TYPE {kind:.0f}")
    types = [int(t) for t in np.unique(status.get("vehicle_type", [])) if t not in (0, _ROTARY_WING)]
    return _VEHICLE_TYPES.get(types[0], f"vehicle of type {types[0]}") if types else None


def seconds(data: dict[str, Any]) -> Array:
    """Return the times at which a topic was measured (if unknown: logged), in s on the autopilot's clock."""
    name = (
        "timestamp_sample" if "timestamp_sample" in data and data["timestamp_sample"].any() else "timestamp"
    )
    return np.asarray(data[name], dtype=float) * 1e-6


def columns(data: dict[str, Any], name: str, count: int) -> Array:
    """Return a field with `count` elements as an array (samples, count)."""
    return np.stack([np.asarray(data[f"{name}[{i}]"], dtype=float) for i in range(count)], axis=1)


def motor_commands(log: ULogFile) -> MotorCommands:
    """Return PX4's commands to the motors, 0 to 1, decoded by version and output type."""
    motors = log.first("actuator_motors")
    if motors is not None:
        present = sum(1 for name in motors if name.startswith("control["))
        control = columns(motors, "control", present)
        used = np.isfinite(control).mean(axis=0) > 0.5
        used &= np.nan_to_num(np.nanmax(np.where(np.isfinite(control), control, 0.0), axis=0)) > 0.0
        if used.any():
            values = np.clip(np.nan_to_num(control[:, used]), 0.0, 1.0)
            return MotorCommands(seconds(motors), values, f"actuator_motors, {values.shape[1]} motors")
    outputs = log.topics.get("actuator_outputs", {})
    found = [d for i, data in sorted(outputs.items()) if (d := _decoded(log, i, data)) is not None]
    if not found:
        other = "no output in actuator_outputs varies" if outputs else "no actuator_outputs"
        raise InputError(f"the log has no actuator_motors, and {other}", source=log.source)
    # The instance that varies most has the motors; servos, or copies on another port, vary less.
    return max(found, key=lambda c: float(c.values.std(axis=0).mean()))


def _motor_count(log: ULogFile) -> int:
    """Return the number of motors according to the parameters, or four if they do not specify it."""
    count = log.parameters.get(COUNT, 0.0) or _MOTORS_OF_TYPE.get(int(log.parameters.get("MAV_TYPE", 0.0)), 4)
    return int(min(count, _LONGEST_COUNT))


def _decoded(log: ULogFile, instance: int, data: dict[str, Any]) -> MotorCommands | None:
    present = sum(1 for name in data if name.startswith("output["))
    raw = np.nan_to_num(columns(data, "output", min(_motor_count(log), present)))
    top = float(raw.max(initial=0.0))
    if top <= 0.0:
        return None
    scale = identify_scale(float(raw[raw > 0.0].min()), top)
    if scale is None:
        return None
    low, high = np.full(raw.shape[1], scale.stop), np.full(raw.shape[1], scale.full)
    kind = scale.describe()
    if scale is PWM:
        low, high = _pulse_range(log.parameters, instance, raw.shape[1])
        kind = f"PWM {low.min():.0f} to {high.max():.0f} us"
    values = np.clip((raw - low) / (high - low), 0.0, 1.0)
    if float(values.std(axis=0).mean()) < _STILL:
        return None
    source = f"actuator_outputs[{instance}], {kind}, {values.shape[1]} motors"
    return MotorCommands(seconds(data), values, source)


def _pulse_range(parameters: dict[str, float], instance: int, count: int) -> tuple[Array, Array]:
    """Return the shortest and longest pulse of each output.

    Up to three parameters can set each limit: for the pin, for the port, or for all ports. The first of these
    with a value determines the limit.
    """
    bank = "MAIN" if instance == 0 else "AUX"
    ends = []
    for end, default in (("MIN", PWM.stop), ("MAX", PWM.full)):
        names = [(f"PWM_{bank}_{end}{pin}", f"PWM_{bank}_{end}", f"PWM_{end}") for pin in range(1, count + 1)]
        # A value of -1 or 0 for a pin selects the port's value.
        ends.append(
            np.array(
                [next((v for n in pin if (v := parameters.get(n, -1.0)) > 0.0), default) for pin in names]
            )
        )
    low, high = ends
    return low, np.where(high > low, high, low + PWM.full - PWM.stop)


def battery(log: ULogFile) -> Battery:
    """Return the battery voltage if it is plausible, otherwise an empty series with the reason."""
    empty = np.empty(0)
    data = log.first("battery_status")
    if data is None:
        return Battery(empty, empty, "no battery_status")
    volts = np.asarray(data["voltage_v"], dtype=float)
    usual = float(np.median(volts[np.isfinite(volts)])) if np.isfinite(volts).any() else 0.0
    if usual < _MIN_CELL_V:
        return Battery(empty, empty, f"the battery voltage of {usual:.2f} V is implausible")
    good = np.isfinite(volts) & (volts >= _MIN_CELL_V)
    return Battery(seconds(data)[good], volts[good])
