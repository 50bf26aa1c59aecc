"""The acceptance table: which MAVLink messages the program uses, and when it accepts a message.

The program uses a message only if the sender is the autopilot's component, the message's instance is accepted
and the values are usable. `VehicleSession` subscribes to the messages in this table, and docs/link.md shows
the table.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import msgspec

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.base.records import FlightMode, LandedState, SystemStatus

AUTOPILOT: Final = 1  # component id
_PX4: Final = 12  # MAV_AUTOPILOT
_OTHER_AUTOPILOTS: Final = {0: "a generic autopilot", 3: "ArduPilot", 8: "no autopilot"}
_MAX_SPECIFIC_FORCE_M_S2: Final = 600.0  # three axes at 32 g give 544
_MAX_RATE_RAD_S: Final = 75.0  # 4000 deg/s give 70
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


# --- decoded values ----------------------------------------------------------------------------------------


class InertialReading(NamedTuple):
    """Specific force (m/s2) and body rate (rad/s), FRD."""

    t_us: int
    specific_force_frd: Vec3
    rate_frd: Vec3


class Attitude(NamedTuple):
    """Attitude, body FRD to world NED."""

    t_us: int
    q_frd_to_ned: Quaternion


class Odometry(NamedTuple):
    """Position (m) and velocity (m/s) of PX4's own estimator, local NED."""

    t_us: int
    position_ned: Vec3
    velocity_ned: Vec3
    reset_counter: int


class Heartbeat(NamedTuple):
    """Mode and state of the autopilot; `hil` is set if the vehicle uses simulated sensors."""

    armed: bool
    hil: bool
    flight_mode: FlightMode
    system_status: SystemStatus


class Outputs(NamedTuple):
    """Raw values of the outputs of one bank, such as MAIN or AUX."""

    t_us: int
    values: list[float | None]


class EscGroup(NamedTuple):
    """Speeds of four motors, revolutions per minute; `first` is the number of the first motor, from 0."""

    t_us: int
    first: int
    rpm: tuple[float, ...]


class BatteryReading(NamedTuple):
    """Reading of one battery; `flies` is False for a battery of avionics or payload."""

    id: int
    voltage_v: float | None
    remaining: float | None  # 0 to 1
    flies: bool


class EstimatorState(NamedTuple):
    """State of PX4's estimator.

    `healthy` is set if attitude, horizontal velocity and horizontal position are valid. `position_sd_m` is
    the horizontal standard deviation.
    """

    healthy: bool
    position_sd_m: float | None


class Sensors(NamedTuple):
    """Enabled, healthy and present sensors (bits of MAV_SYS_STATUS_SENSOR) and errors of the links.

    `drop_rate_comm` is the share of lost packets in units of 0.01 %.
    """

    enabled: int
    healthy: int
    drop_rate_comm: int = 0
    errors_comm: int = 0
    present: int = 0


class TextChunk(NamedTuple):
    """A part of a text; if `id` is 0, the part is a complete text."""

    severity: str
    id: int
    chunk: int
    text: str
    is_last: bool


class Timesync(NamedTuple):
    """Answer to a TIMESYNC request: autopilot time, and host time of the request."""

    sent_us: int
    autopilot_us: int


class ListedParameter(NamedTuple):
    """Name of a parameter, its index in the list of parameters, and the number of entries in the list.

    `place` is at least `entries` for a parameter that is not in the list.
    """

    name: str
    place: int
    entries: int


# --- fields of the messages, as JSON; NaN arrives as null --------------------------------------------------


class _HighresImuFields(msgspec.Struct):
    time_usec: int
    xacc: float | None
    yacc: float | None
    zacc: float | None
    xgyro: float | None
    ygyro: float | None
    zgyro: float | None
    fields_updated: int
    id: int = 0


class _AttitudeQuaternionFields(msgspec.Struct):
    time_boot_ms: int
    q1: float | None
    q2: float | None
    q3: float | None
    q4: float | None


class _OdometryFields(msgspec.Struct):
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


class _HeartbeatFields(msgspec.Struct):
    autopilot: int
    base_mode: int
    custom_mode: int
    system_status: int


class _CurrentModeFields(msgspec.Struct):
    custom_mode: int


class _ExtendedSysStateFields(msgspec.Struct):
    landed_state: int


class _ActuatorOutputStatusFields(msgspec.Struct):
    time_usec: int
    active: int
    actuator: list[float | None]


class _EscStatusFields(msgspec.Struct):
    time_usec: int
    index: int
    rpm: list[int]


class _BatteryStatusFields(msgspec.Struct):
    id: int
    battery_function: int
    battery_remaining: int
    voltages: list[int]
    voltages_ext: list[int] = []


class _EstimatorStatusFields(msgspec.Struct):
    flags: int
    pos_horiz_accuracy: float | None


class _SysStatusFields(msgspec.Struct):
    onboard_control_sensors_present: int
    onboard_control_sensors_enabled: int
    onboard_control_sensors_health: int
    drop_rate_comm: int = 0
    errors_comm: int = 0


class _StatusTextFields(msgspec.Struct):
    severity: int
    text: str
    id: int = 0
    chunk_seq: int = 0


class _TimesyncFields(msgspec.Struct):
    tc1: int
    ts1: int


class _ParamValueFields(msgspec.Struct):
    param_id: str
    param_index: int
    param_count: int


class _GpsRawIntFields(msgspec.Struct):
    fix_type: int


_RC_CHANNELS: Final = 18  # number in a message; a channel that the receiver lacks has the value 65535
_RcChannelsFields = msgspec.defstruct(
    "_RcChannelsFields",
    [("chancount", int), ("rssi", int), *((f"chan{n}_raw", int, 65535) for n in range(1, _RC_CHANNELS + 1))],
)


# --- decoders ----------------------------------------------------------------------------------------------

_ACCELEROMETER_AND_GYRO: Final = 0x3F  # bits of fields_updated


def _imu(m: _HighresImuFields) -> InertialReading | Unusable:
    if m.fields_updated & _ACCELEROMETER_AND_GYRO != _ACCELEROMETER_AND_GYRO:
        return Unusable("fields_updated lacks accelerometer or gyro")
    ax, ay, az, wx, wy, wz = m.xacc, m.yacc, m.zacc, m.xgyro, m.ygyro, m.zgyro
    if ax is None or ay is None or az is None or wx is None or wy is None or wz is None:
        return Unusable("the specific force or the rate is NaN")
    if ax * ax + ay * ay + az * az > _MAX_SPECIFIC_FORCE_M_S2 * _MAX_SPECIFIC_FORCE_M_S2:
        return Unusable(f"a specific force is over {_MAX_SPECIFIC_FORCE_M_S2:g} m/s2: the unit is wrong")
    if max(wx, wy, wz, -wx, -wy, -wz) > _MAX_RATE_RAD_S:
        return Unusable(f"a rate is over {_MAX_RATE_RAD_S:g} rad/s: the unit is wrong")
    return InertialReading(m.time_usec, (ax, ay, az), (wx, wy, wz))


def _attitude(m: _AttitudeQuaternionFields) -> Attitude | Unusable:
    w, x, y, z = m.q1, m.q2, m.q3, m.q4
    if w is None or x is None or y is None or z is None:
        return Unusable("the quaternion is NaN")
    if abs(w * w + x * x + y * y + z * z - 1.0) > 2.0 * _UNIT_TOLERANCE:
        return Unusable("the length of the quaternion is not 1")
    return Attitude(m.time_boot_ms * 1000, (w, x, y, z))


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


def _odometry(m: _OdometryFields) -> Odometry | Unusable:
    vx, vy, vz, x, y, z = m.vx, m.vy, m.vz, m.x, m.y, m.z
    if m.estimator_type != _OWN_ESTIMATOR:
        kind = m.estimator_type
        name = _ESTIMATORS[kind] if kind < len(_ESTIMATORS) else f"type {kind}"
        poses = " without a velocity" if vx is None else ""
        return Unusable(
            f"the messages carry external poses{poses} ({name}; see MAV_ODOM_LP), not PX4's own estimate"
        )
    if m.frame_id != _LOCAL_NED:
        return Unusable(f"the position has frame {m.frame_id}, as in an external pose, instead of local NED")
    if m.child_frame_id != _LOCAL_NED:
        old = ", as before PX4 1.14" if m.child_frame_id == _BODY_FRD else ""
        return Unusable(f"the velocity has frame {m.child_frame_id}{old}, instead of local NED")
    if x is None or y is None or z is None:
        return Unusable("the position is NaN")
    if vx is None or vy is None or vz is None:
        return Unusable("the velocity is NaN")
    if m.quality < 0:
        return Unusable("the estimate is invalid (the quality is -1)")
    if max(abs(x), abs(y), abs(z)) > _MAX_POSITION_M or max(abs(vx), abs(vy), abs(vz)) > _MAX_SPEED_M_S:
        return Unusable(
            f"the position is over {_MAX_POSITION_M:g} m, or the velocity is over {_MAX_SPEED_M_S:g} m/s: "
            "the unit is wrong"
        )
    return Odometry(m.time_usec, (x, y, z), (vx, vy, vz), m.reset_counter)


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


def _heartbeat(m: _HeartbeatFields) -> Heartbeat | Unusable:
    if m.autopilot != _PX4:
        other = _OTHER_AUTOPILOTS.get(m.autopilot, f"autopilot {m.autopilot}")
        return Unusable(f"the sender is {other}, not PX4")
    if not m.base_mode & _CUSTOM_MODE:
        return Unusable("the message has no flight mode of PX4")
    state = m.system_status
    return Heartbeat(
        bool(m.base_mode & _ARMED),
        bool(m.base_mode & _HIL),
        _flight_mode(m.custom_mode),
        _STATES[state] if state < len(_STATES) else SystemStatus.UNKNOWN,
    )


def _flight_mode(custom_mode: int) -> FlightMode:
    main, sub = custom_mode >> 16 & 255, custom_mode >> 24 & 255
    modes, number = (_AUTO_MODES, sub) if main == _AUTO else (_MAIN_MODES, main)
    return modes.get(number, FlightMode.UNKNOWN)


def _current_mode(m: _CurrentModeFields) -> FlightMode | Unusable:
    return _flight_mode(m.custom_mode) if m.custom_mode else Unusable("the mode is 0 (not supplied)")


_LANDED: Final = {
    1: LandedState.ON_GROUND,
    2: LandedState.IN_AIR,
    3: LandedState.TAKING_OFF,
    4: LandedState.LANDING,
}


def _landed(m: _ExtendedSysStateFields) -> LandedState | Unusable:
    return _LANDED.get(m.landed_state) or Unusable("the landed state is undefined")


def _outputs(m: _ActuatorOutputStatusFields) -> Outputs | Unusable:
    # PX4 sends the outputs of the first bank; `active` 0 means that PX4 does not set the field.
    values = m.actuator[: m.active] if m.active else m.actuator
    return Outputs(m.time_usec, values)


def _esc(m: _EscStatusFields) -> EscGroup | Unusable:
    if m.index % _ESCS or len(m.rpm) != _ESCS:
        return Unusable("the message is not a group of four motors")
    if max(abs(rpm) for rpm in m.rpm) > _MAX_RPM:
        return Unusable(f"a motor speed is over {_MAX_RPM} 1/min: the unit is wrong")
    return EscGroup(m.time_usec, m.index, tuple([float(rpm) for rpm in m.rpm]))


_UNKNOWN_MV: Final = 65535
_FLIGHT_FUNCTIONS: Final = (0, 1, 2)  # MAV_BATTERY_FUNCTION: unknown, all, propulsion


def _battery(m: _BatteryStatusFields) -> BatteryReading | Unusable:
    cells = [mv for mv in m.voltages if mv != _UNKNOWN_MV]
    cells += [mv for mv in m.voltages_ext if mv not in (0, _UNKNOWN_MV)]
    volts = sum(cells) * 1e-3 if cells else None
    remaining = m.battery_remaining / 100.0 if 0 <= m.battery_remaining <= 100 else None
    if volts is None and remaining is None:
        return Unusable("voltage and charge are missing")
    if volts is not None and not _MIN_BATTERY_V <= volts <= _MAX_BATTERY_V:
        return Unusable(f"the battery voltage of {volts:.2f} V is implausible")
    return BatteryReading(m.id, volts, remaining, m.battery_function in _FLIGHT_FUNCTIONS)


# ESTIMATOR_STATUS_FLAGS: attitude and horizontal velocity; horizontal position, relative or absolute.
_NEEDED, _PLACED = 1 | 2, 8 | 16


def _estimator(m: _EstimatorStatusFields) -> EstimatorState | Unusable:
    sd = m.pos_horiz_accuracy
    if sd is not None and not 0.0 <= sd <= _MAX_SD_M:
        return Unusable(f"the standard deviation is negative or over {_MAX_SD_M:g} m")
    healthy = m.flags & _NEEDED == _NEEDED and bool(m.flags & _PLACED)
    return EstimatorState(healthy, sd)


def _sys_status(m: _SysStatusFields) -> Sensors | Unusable:
    if not m.onboard_control_sensors_present:
        return Unusable("no sensor is present")
    enabled, healthy = m.onboard_control_sensors_enabled, m.onboard_control_sensors_health
    present = m.onboard_control_sensors_present
    return Sensors(enabled, healthy, m.drop_rate_comm, m.errors_comm, present)


def _status_text(m: _StatusTextFields) -> TextChunk | Unusable:
    if not 0 <= m.severity < len(SEVERITIES):
        return Unusable("the severity is unknown")
    is_last = m.id == 0 or len(m.text.encode()) < _CHUNK
    if not m.text and m.id == 0:
        return Unusable("the text is empty")
    return TextChunk(SEVERITIES[m.severity], m.id, m.chunk_seq, m.text, is_last)


def _timesync(m: _TimesyncFields) -> Timesync | Unusable:
    if m.tc1 <= 0:
        return Unusable("the message is a request")  # PX4 sends requests too
    return Timesync(m.ts1 // 1000, m.tc1 // 1000)


def _listed(m: _ParamValueFields) -> ListedParameter | Unusable:
    if not m.param_id:
        return Unusable("the name is empty")
    return ListedParameter(m.param_id, m.param_index, m.param_count)


_FIXES: Final = ("no_gps", "no_fix", "fix_2d", "fix_3d", "fix_dgps", "rtk_float", "rtk_fixed")


def _gps(m: _GpsRawIntFields) -> str | Unusable:
    return _FIXES[m.fix_type] if m.fix_type < len(_FIXES) else Unusable("the type of fix is unknown")


def _radio(m: Any) -> tuple[int, ...] | Unusable:
    if m.chancount <= 0 or m.rssi == 0:
        return Unusable("the receiver has no channels or no signal")
    return tuple(getattr(m, f"chan{n}_raw") for n in range(1, min(m.chancount, _RC_CHANNELS) + 1))


# --- the table ---------------------------------------------------------------------------------------------


class MessageEntry(msgspec.Struct, frozen=True):
    """One row of the table.

    Attributes:
        stream: name in `base/streams.py`.
        fields: type of the fields that are read.
        convert: function that returns a value from the fields, or `Unusable`.
        invalid: text with the conditions under which a message has no usable values.
        instance: name of the field that distinguishes the instances in one component.
        instances: accepted values of that field, or None if all are accepted.
        which: description of the accepted instances for the manual's table.
    """

    message: str
    stream: str | None
    fields: type[msgspec.Struct]
    convert: Callable[[Any], Any]
    frame: str
    units: str
    invalid: str
    instance: str | None = None
    instances: tuple[int, ...] | None = None
    which: str = "-"

    def reader(self) -> Callable[[str], tuple[int, Any]]:
        """Return a function that decodes a message's JSON to (instance, value); `value` may be `Unusable`."""
        read, convert = msgspec.json.Decoder(self.fields).decode, self.convert
        instance, instances = self.instance, self.instances

        def decode(fields_json: str) -> tuple[int, Any]:
            try:
                fields = read(fields_json)
            except msgspec.MsgspecError:
                return 0, Unusable("a field is missing or has a wrong type")
            if instance is None:
                return 0, convert(fields)
            number = getattr(fields, instance)
            if instances is not None and number not in instances:
                return number, Unusable(f"{instance} is {number}, not {instances[0]}")
            return number, convert(fields)

        return decode

    def decode(self, fields_json: str) -> Any:
        """Return a message's value, or None if the message has no usable value."""
        value = self.reader()(fields_json)[1]
        return None if isinstance(value, Unusable) else value


HIGHRES_IMU = MessageEntry(
    "HIGHRES_IMU",
    "imu",
    _HighresImuFields,
    _imu,
    "body FRD",
    "m/s², rad/s",
    "a value is NaN or over 600 m/s² or 75 rad/s, or fields_updated lacks accelerometer or gyro",
    "id",
    (0,),
    "id 0",
)
ATTITUDE_QUATERNION = MessageEntry(
    "ATTITUDE_QUATERNION",
    "attitude",
    _AttitudeQuaternionFields,
    _attitude,
    "body FRD to NED",
    "unit quaternion, ms",
    "a value is NaN, or the length is not 1",
)
ODOMETRY = MessageEntry(
    "ODOMETRY",
    "odometry",
    _OdometryFields,
    _odometry,
    "frame_id and child_frame_id LOCAL_NED, as PX4 sends from 1.14 on",
    "m, m/s",
    "a value is NaN, the position is over 10 km, the velocity is over 100 m/s, or the quality is -1",
    "estimator_type",
    None,
    "estimator_type 8 (autopilot)",
)
HEARTBEAT = MessageEntry(
    "HEARTBEAT",
    None,
    _HeartbeatFields,
    _heartbeat,
    "-",
    "PX4's main and sub mode, MAV_STATE",
    "the autopilot is not PX4, or there is no custom mode",
)
CURRENT_MODE = MessageEntry(
    "CURRENT_MODE",
    None,
    _CurrentModeFields,
    _current_mode,
    "-",
    "PX4's main and sub mode",
    "the mode is 0 (not supplied)",
)
EXTENDED_SYS_STATE = MessageEntry(
    "EXTENDED_SYS_STATE",
    "landed",
    _ExtendedSysStateFields,
    _landed,
    "-",
    "MAV_LANDED_STATE",
    "the state is 0 (undefined)",
)
ACTUATOR_OUTPUT_STATUS = MessageEntry(
    "ACTUATOR_OUTPUT_STATUS",
    "actuator",
    _ActuatorOutputStatusFields,
    _outputs,
    "-",
    "PWM 1000 to 2000 µs, DShot 0 to 1999 or UAVCAN 0 to 8191, recognised by the values",
    "there are fewer outputs than motors, a value is NaN or of unknown type, or all are idle in flight",
    None,
    None,
    "PX4 sends only the bank of outputs that it started first",
)
ESC_STATUS = MessageEntry(
    "ESC_STATUS",
    "esc",
    _EscStatusFields,
    _esc,
    "-",
    "1/min",
    "a group of motors with the same time stamp is missing, or a speed is over 200 000 1/min",
    "index",
    None,
    "each message has a group of four motors; `index` is the number of the first motor, from 0",
)
BATTERY_STATUS = MessageEntry(
    "BATTERY_STATUS",
    None,
    _BatteryStatusFields,
    _battery,
    "-",
    "voltage in mV (per cell or total), charge in %",
    "voltage and charge are missing, or the voltage is under 3 V or over 150 V",
    "id",
    None,
    "one reading per id; the guard checks the flight battery with the lowest voltage or charge",
)
ESTIMATOR_STATUS = MessageEntry(
    "ESTIMATOR_STATUS",
    None,
    _EstimatorStatusFields,
    _estimator,
    "-",
    "flags, m",
    "the standard deviation is negative or over 10 km; NaN means that PX4 reports none",
    None,
    None,
    "PX4 reports only its selected estimator; the message has no id",
)
SYS_STATUS = MessageEntry(
    "SYS_STATUS",
    None,
    _SysStatusFields,
    _sys_status,
    "-",
    "bits of MAV_SYS_STATUS_SENSOR",
    "no sensor is present",
)
STATUSTEXT = MessageEntry(
    "STATUSTEXT",
    None,
    _StatusTextFields,
    _status_text,
    "-",
    "MAV_SEVERITY; text in UTF-8, in parts of 50 bytes",
    "the severity is over 7, or the text is empty",
    which="parts with the same id are joined",
)
TIMESYNC = MessageEntry(
    "TIMESYNC",
    None,
    _TimesyncFields,
    _timesync,
    "-",
    "ns",
    "the message is a request (tc1 is 0), or it answers another program's request",
)
PARAM_VALUE = MessageEntry(
    "PARAM_VALUE",
    None,
    _ParamValueFields,
    _listed,
    "-",
    "index in the list of parameters; MAVSDK decodes the value",
    "the name is empty",
)
GPS_RAW_INT = MessageEntry(
    "GPS_RAW_INT",
    None,
    _GpsRawIntFields,
    _gps,
    "-",
    "GPS_FIX_TYPE",
    "the type of fix is unknown",
)
RC_CHANNELS = MessageEntry(
    "RC_CHANNELS",
    None,
    _RcChannelsFields,
    _radio,
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
STREAM_OF: Final = {entry.message: entry.stream for entry in ENTRIES}
