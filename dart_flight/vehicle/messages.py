"""The acceptance table: which MAVLink messages the program uses, and when it accepts a message.

The program uses a message only if the sender is the autopilot's component, the message's instance is accepted
and the values are usable. `VehicleSession` subscribes to the messages in this table, and docs/link.md shows
the table.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import msgspec

from dart_flight.base.records import (
    AttitudeSample,
    FlightMode,
    ImuSample,
    LandedState,
    OdometrySample,
    SystemStatus,
)
from dart_flight.base.streams import BY_MESSAGE, Stream

AUTOPILOT: Final = 1  # component id
_PX4: Final = 12  # MAV_AUTOPILOT
_OTHER_AUTOPILOTS: Final = {0: "a generic autopilot", 3: "ArduPilot", 8: "no autopilot"}
_MAX_SPECIFIC_FORCE_M_S2: Final = 600.0  # three axes at 32 g give 544 m/s2
_MAX_RATE_RAD_S: Final = 75.0  # a gyro range of 4000 deg/s is 70 rad/s
_UNIT_TOLERANCE: Final = 0.01
_MAX_POSITION_M: Final = 10_000.0
_MAX_SPEED_M_S: Final = 100.0
_MIN_BATTERY_V, _MAX_BATTERY_V = 3.0, 150.0  # a reading below one cell comes from a sensor without a battery
_MAX_RPM: Final = 200_000
_MAX_SD_M: Final = 10_000.0
_ESCS: Final = 4  # number of motors in one ESC_STATUS message
_CHUNK: Final = 50  # bytes of text in one STATUSTEXT
SEVERITIES: Final = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")


class Unusable(NamedTuple):
    """The reason why a message is not usable, as a clause such as "the velocity is NaN"."""

    reason: str


# Function that converts a message's stamp to the host time of receipt, both in microseconds. Call it only for
# a usable message.
Receive = Callable[[int], int]

# --- contents of messages that become parts of records ------------------------------------------------------


class Heartbeat(NamedTuple):
    """Mode and state of the autopilot; `hil` is set if the vehicle uses simulated sensors."""

    armed: bool
    hil: bool
    flight_mode: FlightMode
    system_status: SystemStatus


class BatteryReading(NamedTuple):
    """Reading of one battery; `flies` is False for a battery of avionics or payload."""

    id: int
    voltage_v: float | None
    remaining: float | None  # 0 to 1
    flies: bool


class TextChunk(NamedTuple):
    """A part of a text; if `id` is 0, the part is a complete text."""

    severity: str
    id: int
    chunk: int
    text: str
    is_last: bool


# --- messages, from JSON; NaN arrives as null --------------------------------------------------------------

_ACCELEROMETER_AND_GYRO: Final = 0x3F  # bits of fields_updated


class _HighresImuMessage(msgspec.Struct):
    time_usec: int
    xacc: float | None
    yacc: float | None
    zacc: float | None
    xgyro: float | None
    ygyro: float | None
    zgyro: float | None
    fields_updated: int
    id: int = 0

    def value(self, receive: Receive) -> ImuSample | Unusable:
        if self.fields_updated & _ACCELEROMETER_AND_GYRO != _ACCELEROMETER_AND_GYRO:
            return Unusable("fields_updated lacks accelerometer or gyro")
        ax, ay, az, wx, wy, wz = self.xacc, self.yacc, self.zacc, self.xgyro, self.ygyro, self.zgyro
        if ax is None or ay is None or az is None or wx is None or wy is None or wz is None:
            return Unusable("the specific force or the rate is NaN")
        if ax * ax + ay * ay + az * az > _MAX_SPECIFIC_FORCE_M_S2 * _MAX_SPECIFIC_FORCE_M_S2:
            return Unusable(f"a specific force is over {_MAX_SPECIFIC_FORCE_M_S2:g} m/s2: the unit is wrong")
        if max(wx, wy, wz, -wx, -wy, -wz) > _MAX_RATE_RAD_S:
            return Unusable(f"a rate is over {_MAX_RATE_RAD_S:g} rad/s: the unit is wrong")
        return ImuSample(self.time_usec, receive(self.time_usec), (ax, ay, az), (wx, wy, wz))


class _AttitudeQuaternionMessage(msgspec.Struct):
    time_boot_ms: int
    q1: float | None
    q2: float | None
    q3: float | None
    q4: float | None

    def value(self, receive: Receive) -> AttitudeSample | Unusable:
        w, x, y, z = self.q1, self.q2, self.q3, self.q4
        if w is None or x is None or y is None or z is None:
            return Unusable("the quaternion is NaN")
        if abs(w * w + x * x + y * y + z * z - 1.0) > 2.0 * _UNIT_TOLERANCE:
            return Unusable("the length of the quaternion is not 1")
        t_us = self.time_boot_ms * 1000
        return AttitudeSample(t_us, receive(t_us), (w, x, y, z))


_ESTIMATORS: Final = (
    "unknown",
    "naive",
    "vision",
    "visual-inertial",
    "GPS",
    "GPS and inertial",
    "motion capture",
    "lidar",
    "autopilot",
)
_OWN_ESTIMATOR, _LOCAL_NED, _BODY_FRD = 8, 1, 12  # MAV_ESTIMATOR_TYPE, MAV_FRAME


class _OdometryMessage(msgspec.Struct):
    time_usec: int
    frame_id: int
    child_frame_id: int
    x: float | None
    y: float | None
    z: float | None
    vx: float | None
    vy: float | None
    vz: float | None
    reset_counter: int = 0
    estimator_type: int = 0
    quality: int = 0

    def value(self, receive: Receive) -> tuple[OdometrySample, int] | Unusable:
        """Return the estimate of PX4's own estimator, and the number of its resets."""
        vx, vy, vz, x, y, z = self.vx, self.vy, self.vz, self.x, self.y, self.z
        if self.estimator_type != _OWN_ESTIMATOR:
            kind = self.estimator_type
            name = _ESTIMATORS[kind] if kind < len(_ESTIMATORS) else f"type {kind}"
            poses = " without a velocity" if vx is None else ""
            return Unusable(
                f"the messages carry external poses{poses} ({name}; see MAV_ODOM_LP), not PX4's own estimate"
            )
        frame, child = self.frame_id, self.child_frame_id
        if frame != _LOCAL_NED:
            return Unusable(f"the position is in frame {frame}, as in an external pose, instead of local NED")
        if child != _LOCAL_NED:
            old = ", as before PX4 1.14" if child == _BODY_FRD else ""
            return Unusable(f"the velocity is in frame {child}{old}, instead of local NED")
        if x is None or y is None or z is None:
            return Unusable("the position is NaN")
        if vx is None or vy is None or vz is None:
            return Unusable("the velocity is NaN")
        if self.quality < 0:
            return Unusable("the estimate is invalid (the quality is -1)")
        if max(abs(x), abs(y), abs(z)) > _MAX_POSITION_M or max(abs(vx), abs(vy), abs(vz)) > _MAX_SPEED_M_S:
            return Unusable(
                f"the position is over {_MAX_POSITION_M:g} m, or the velocity is over {_MAX_SPEED_M_S:g} m/s:"
                " the unit is wrong"
            )
        sample = OdometrySample(self.time_usec, receive(self.time_usec), (x, y, z), (vx, vy, vz))
        return sample, self.reset_counter


_CUSTOM_MODE, _ARMED, _HIL = 1, 128, 32  # bits of MAV_MODE_FLAG
_AUTO: Final = 4
_MAIN_MODES: Final = {
    1: FlightMode.MANUAL,
    2: FlightMode.MANUAL,  # altitude
    3: FlightMode.MANUAL,  # position
    5: FlightMode.MANUAL,  # acro
    6: FlightMode.OFFBOARD,
    7: FlightMode.MANUAL,  # stabilized
    8: FlightMode.MANUAL,  # rattitude
}
_AUTO_MODES: Final = {
    1: FlightMode.READY,
    2: FlightMode.TAKEOFF,
    3: FlightMode.HOLD,
    4: FlightMode.MISSION,
    5: FlightMode.RETURN,
    6: FlightMode.LAND,
    8: FlightMode.MISSION,  # follow a target
    9: FlightMode.LAND,  # precision landing
    10: FlightMode.TAKEOFF,
    **dict.fromkeys(range(11, 19), FlightMode.MISSION),  # modes that an external program registers with PX4
}
_STATES: Final = tuple(SystemStatus)[1:]  # MAV_STATE's order


class _HeartbeatMessage(msgspec.Struct):
    autopilot: int
    base_mode: int
    custom_mode: int
    system_status: int

    def value(self, _: Receive) -> Heartbeat | Unusable:
        if self.autopilot != _PX4:
            other = _OTHER_AUTOPILOTS.get(self.autopilot, f"autopilot {self.autopilot}")
            return Unusable(f"the sender is {other}, not PX4")
        if not self.base_mode & _CUSTOM_MODE:
            return Unusable("the message has no flight mode of PX4")
        state = self.system_status
        return Heartbeat(
            bool(self.base_mode & _ARMED),
            bool(self.base_mode & _HIL),
            _flight_mode(self.custom_mode),
            _STATES[state] if state < len(_STATES) else SystemStatus.UNKNOWN,
        )


def _flight_mode(custom_mode: int) -> FlightMode:
    main, sub = custom_mode >> 16 & 255, custom_mode >> 24 & 255
    modes, number = (_AUTO_MODES, sub) if main == _AUTO else (_MAIN_MODES, main)
    return modes.get(number, FlightMode.UNKNOWN)


class _CurrentModeMessage(msgspec.Struct):
    custom_mode: int

    def value(self, _: Receive) -> FlightMode | Unusable:
        return (
            _flight_mode(self.custom_mode) if self.custom_mode else Unusable("the mode is 0 (not supplied)")
        )


_LANDED: Final = {
    1: LandedState.ON_GROUND,
    2: LandedState.IN_AIR,
    3: LandedState.TAKING_OFF,
    4: LandedState.LANDING,
}


class _ExtendedSysStateMessage(msgspec.Struct):
    landed_state: int

    def value(self, _: Receive) -> LandedState | Unusable:
        return _LANDED.get(self.landed_state) or Unusable("the landed state is undefined")


class Outputs(msgspec.Struct, rename={"t_us": "time_usec"}):
    """Raw outputs of one bank, such as MAIN or AUX, which `MotorOutputDecoder` converts to throttles."""

    t_us: int
    active: int
    actuator: list[float | None]

    @property
    def values(self) -> list[float | None]:
        # PX4 sends the outputs of the first bank. If `active` is 0, PX4 has not set the field.
        return self.actuator[: self.active] if self.active else self.actuator

    def value(self, receive: Receive) -> Outputs:
        receive(self.t_us)
        return self


class EscGroup(msgspec.Struct, rename={"t_us": "time_usec", "first": "index"}):
    """Speeds of four motors, revolutions per minute; `first` is the number of the first motor, from 0.

    Several messages form one record, `EscSample`.
    """

    t_us: int
    first: int
    rpm: list[int]

    def value(self, receive: Receive) -> EscGroup | Unusable:
        if self.first % _ESCS or len(self.rpm) != _ESCS:
            return Unusable("the message is not a group of four motors")
        if max(abs(rpm) for rpm in self.rpm) > _MAX_RPM:
            return Unusable(f"a motor speed is over {_MAX_RPM} 1/min: the unit is wrong")
        receive(self.t_us)
        return self


_UNKNOWN_MV: Final = 65535
_FLIGHT_FUNCTIONS: Final = (0, 1, 2)  # MAV_BATTERY_FUNCTION: unknown, all, propulsion


class _BatteryStatusMessage(msgspec.Struct):
    id: int
    battery_function: int
    battery_remaining: int
    voltages: list[int]
    voltages_ext: list[int] = []

    def value(self, _: Receive) -> BatteryReading | Unusable:
        cells = [mv for mv in self.voltages if mv != _UNKNOWN_MV]
        cells += [mv for mv in self.voltages_ext if mv not in (0, _UNKNOWN_MV)]
        volts = sum(cells) * 1e-3 if cells else None
        remaining = self.battery_remaining / 100.0 if 0 <= self.battery_remaining <= 100 else None
        if volts is None and remaining is None:
            return Unusable("voltage and charge are missing")
        if volts is not None and not _MIN_BATTERY_V <= volts <= _MAX_BATTERY_V:
            return Unusable(f"the battery voltage of {volts:.2f} V is implausible")
        return BatteryReading(self.id, volts, remaining, self.battery_function in _FLIGHT_FUNCTIONS)


# ESTIMATOR_STATUS_FLAGS: attitude and horizontal velocity; horizontal position, relative or absolute.
_NEEDED, _PLACED = 1 | 2, 8 | 16


class EstimatorState(msgspec.Struct, rename={"position_sd_m": "pos_horiz_accuracy"}):
    """State of PX4's estimator; `position_sd_m` is the horizontal standard deviation."""

    flags: int
    position_sd_m: float | None

    @property
    def healthy(self) -> bool:
        """Whether attitude, horizontal velocity and horizontal position are valid."""
        return self.flags & _NEEDED == _NEEDED and bool(self.flags & _PLACED)

    def value(self, _: Receive) -> EstimatorState | Unusable:
        if self.position_sd_m is not None and not 0.0 <= self.position_sd_m <= _MAX_SD_M:
            return Unusable(f"the standard deviation is negative or over {_MAX_SD_M:g} m")
        return self


class Sensors(
    msgspec.Struct,
    rename={
        "enabled": "onboard_control_sensors_enabled",
        "healthy": "onboard_control_sensors_health",
        "present": "onboard_control_sensors_present",
    },
):
    """Enabled, healthy and present sensors (bits of MAV_SYS_STATUS_SENSOR) and communication errors.

    `drop_rate_comm` is the fraction of lost packets in units of 0.01 %.
    """

    enabled: int
    healthy: int
    present: int = 0
    drop_rate_comm: int = 0
    errors_comm: int = 0

    def value(self, _: Receive) -> Sensors | Unusable:
        return self if self.present else Unusable("no sensor is present")


class _StatusTextMessage(msgspec.Struct):
    severity: int
    text: str
    id: int = 0
    chunk_seq: int = 0

    def value(self, _: Receive) -> TextChunk | Unusable:
        if not 0 <= self.severity < len(SEVERITIES):
            return Unusable("the severity is unknown")
        is_last = self.id == 0 or len(self.text.encode()) < _CHUNK
        if not self.text and self.id == 0:
            return Unusable("the text is empty")
        return TextChunk(SEVERITIES[self.severity], self.id, self.chunk_seq, self.text, is_last)


class Timesync(msgspec.Struct):
    """Answer to a TIMESYNC request."""

    tc1: int
    ts1: int

    @property
    def sent_us(self) -> int:
        """Host time of the request."""
        return self.ts1 // 1000

    @property
    def autopilot_us(self) -> int:
        return self.tc1 // 1000

    def value(self, _: Receive) -> Timesync | Unusable:
        # PX4 also sends requests, whose `tc1` is 0.
        return self if self.tc1 > 0 else Unusable("the message is a request")


class ListedParameter(
    msgspec.Struct, rename={"name": "param_id", "place": "param_index", "entries": "param_count"}
):
    """Name of a parameter, its index in the list of parameters, and the length of the list.

    If the parameter is not in the list, `place >= entries`.
    """

    name: str
    place: int
    entries: int

    def value(self, _: Receive) -> ListedParameter | Unusable:
        return self if self.name else Unusable("the name is empty")


_FIXES: Final = ("no_gps", "no_fix", "fix_2d", "fix_3d", "fix_dgps", "rtk_float", "rtk_fixed")


class _GpsRawIntMessage(msgspec.Struct):
    fix_type: int

    def value(self, _: Receive) -> str | Unusable:
        known = self.fix_type < len(_FIXES)
        return _FIXES[self.fix_type] if known else Unusable("the GPS fix type is unknown")


_RC_CHANNELS: Final = 18  # channels in one message; 65535 marks a channel that the receiver lacks


def _pulses(m: Any, _: Receive) -> tuple[int, ...] | Unusable:
    if m.chancount <= 0 or m.rssi == 0:
        return Unusable("the receiver has no channels or no signal")
    return tuple(getattr(m, f"chan{n}_raw") for n in range(1, min(m.chancount, _RC_CHANNELS) + 1))


_RcChannelsMessage = msgspec.defstruct(
    "_RcChannelsMessage",
    [("chancount", int), ("rssi", int), *((f"chan{n}_raw", int, 65535) for n in range(1, _RC_CHANNELS + 1))],
    namespace={"value": _pulses},
)


# --- the table ---------------------------------------------------------------------------------------------


class MessageEntry(msgspec.Struct, frozen=True):
    """One row of the table.

    Attributes:
        fields: type that holds the message's fields; its method `value` returns a record or another value, or
            `Unusable`.
        invalid: text with the conditions under which a message has no usable values.
        instance: name of the field that distinguishes the instances in one component.
        instances: accepted values of that field, or None if all are accepted.
        which: description of the accepted instances for the manual's table.
    """

    message: str
    fields: type[msgspec.Struct]
    frame: str
    units: str
    invalid: str
    instance: str | None = None
    instances: tuple[int, ...] | None = None
    which: str = "-"

    @property
    def stream(self) -> Stream | None:
        """The row in `base/streams.py`, or None if the program does not request the message's rate."""
        return BY_MESSAGE.get(self.message)

    def reader(self) -> Callable[[str, Receive], tuple[int, Any]]:
        """Return a function that decodes a message's JSON to (instance, value); `value` may be `Unusable`."""
        read, instance, instances = msgspec.json.Decoder(self.fields).decode, self.instance, self.instances

        def decode(fields_json: str, receive: Receive) -> tuple[int, Any]:
            try:
                fields: Any = read(fields_json)
            except msgspec.MsgspecError:
                return 0, Unusable("a field is missing or has a wrong type")
            number = 0 if instance is None else getattr(fields, instance)
            if instances is not None and number not in instances:
                return number, Unusable(f"{instance} is {number}, not {instances[0]}")
            return number, fields.value(receive)

        return decode


HIGHRES_IMU = MessageEntry(
    "HIGHRES_IMU",
    _HighresImuMessage,
    "body FRD",
    "m/s², rad/s",
    "a value is NaN or over 600 m/s² or 75 rad/s, or fields_updated lacks accelerometer or gyro",
    "id",
    (0,),
    "id 0",
)
ATTITUDE_QUATERNION = MessageEntry(
    "ATTITUDE_QUATERNION",
    _AttitudeQuaternionMessage,
    "body FRD to NED",
    "unit quaternion, ms",
    "a value is NaN, or the length is not 1",
)
ODOMETRY = MessageEntry(
    "ODOMETRY",
    _OdometryMessage,
    "frame_id and child_frame_id LOCAL_NED, as PX4 sends from 1.14 on",
    "m, m/s",
    "a value is NaN, the position is over 10 km, the velocity is over 100 m/s, or the quality is -1",
    "estimator_type",
    None,
    "estimator_type 8 (autopilot)",
)
HEARTBEAT = MessageEntry(
    "HEARTBEAT",
    _HeartbeatMessage,
    "-",
    "PX4's main and sub mode, MAV_STATE",
    "the autopilot is not PX4, or there is no custom mode",
)
CURRENT_MODE = MessageEntry(
    "CURRENT_MODE",
    _CurrentModeMessage,
    "-",
    "PX4's main and sub mode",
    "the mode is 0 (not supplied)",
)
EXTENDED_SYS_STATE = MessageEntry(
    "EXTENDED_SYS_STATE",
    _ExtendedSysStateMessage,
    "-",
    "MAV_LANDED_STATE",
    "the state is 0 (undefined)",
)
ACTUATOR_OUTPUT_STATUS = MessageEntry(
    "ACTUATOR_OUTPUT_STATUS",
    Outputs,
    "-",
    "PWM 1000 to 2000 µs, DShot 0 to 1999 or UAVCAN 0 to 8191, recognised by the values",
    "there are fewer outputs than motors, a value is NaN or of unknown type, or all are idle in flight",
    None,
    None,
    "PX4 sends only the bank of outputs that it started first",
)
ESC_STATUS = MessageEntry(
    "ESC_STATUS",
    EscGroup,
    "-",
    "1/min",
    "a group of motors with the same time stamp is missing, or a speed is over 200 000 1/min",
    "first",
    None,
    "each message has a group of four motors; `index` is the number of the first motor, from 0",
)
BATTERY_STATUS = MessageEntry(
    "BATTERY_STATUS",
    _BatteryStatusMessage,
    "-",
    "voltage in mV (per cell or total), charge in %",
    "voltage and charge are missing, or the voltage is under 3 V or over 150 V",
    "id",
    None,
    "one reading per id; the guard checks the flight battery with the lowest voltage or charge",
)
ESTIMATOR_STATUS = MessageEntry(
    "ESTIMATOR_STATUS",
    EstimatorState,
    "-",
    "flags, m",
    "the standard deviation is negative or over 10 km; NaN means that PX4 reports none",
    None,
    None,
    "PX4 reports only its selected estimator; the message has no id",
)
SYS_STATUS = MessageEntry(
    "SYS_STATUS",
    Sensors,
    "-",
    "bits of MAV_SYS_STATUS_SENSOR",
    "no sensor is present",
)
STATUSTEXT = MessageEntry(
    "STATUSTEXT",
    _StatusTextMessage,
    "-",
    "MAV_SEVERITY; text in UTF-8, in parts of 50 bytes",
    "the severity is over 7, or the text is empty",
    which="parts with the same id are joined",
)
TIMESYNC = MessageEntry(
    "TIMESYNC",
    Timesync,
    "-",
    "ns",
    "the message is a request (tc1 is 0), or it answers another program's request",
)
PARAM_VALUE = MessageEntry(
    "PARAM_VALUE",
    ListedParameter,
    "-",
    "index in the list of parameters; MAVSDK decodes the value",
    "the name is empty",
)
GPS_RAW_INT = MessageEntry(
    "GPS_RAW_INT",
    _GpsRawIntMessage,
    "-",
    "GPS_FIX_TYPE",
    "the GPS fix type is unknown",
)
RC_CHANNELS = MessageEntry(
    "RC_CHANNELS",
    _RcChannelsMessage,
    "-",
    "pulses in µs",
    "there are no channels, or the signal is 0",
)

ENTRIES: Final = (
    HIGHRES_IMU,
    ATTITUDE_QUATERNION,
    ODOMETRY,
    HEARTBEAT,
    CURRENT_MODE,
    EXTENDED_SYS_STATE,
    ACTUATOR_OUTPUT_STATUS,
    ESC_STATUS,
    BATTERY_STATUS,
    ESTIMATOR_STATUS,
    SYS_STATUS,
    STATUSTEXT,
    TIMESYNC,
    PARAM_VALUE,
    GPS_RAW_INT,
    RC_CHANNELS,
)
