"""The embedded autopilot's MAVLink side: it sends and answers like PX4, over UDP.

Message rates are PX4's onboard defaults until a client requests others with SET_MESSAGE_INTERVAL. As in PX4,
periods are rounded to ticks of 4 ms. An endpoint has one or more links. Each link is a UDP socket that sends
to a fixed port: 14540 for a companion computer, 14550 for a ground station.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from dart_flight.base.geometry import distance2
from dart_flight.base.records import MOTOR_FULL_US, MOTOR_STOP_US, FlightMode, LandedState, SystemStatus
from dart_flight.base.streams import SAMPLED
from dart_flight.config.rotors import MAV_TYPES
from dart_flight.sim import unlisted_messages
from dart_flight.sim.cascade import TrajectorySetpoint
from dart_flight.sim.datagrams import receive_datagram, send_datagram
from dart_flight.sim.embedded_autopilot import TICK_US, Autopilot
from dart_flight.sim.faults.impairment import Impairment, LossyLink

_PX4 = 12  # MAV_AUTOPILOT_PX4
_AUTOPILOT = 1  # component id
_VERSION = (1 << 24) | (16 << 16) | (0 << 8) | 255  # v1.16.0, the version that this endpoint imitates
_HOME_LAT, _HOME_LON, _HOME_ALT = 33.4242, -111.9281, 360.0
_EARTH_M_PER_DEG = 111_320.0
# PX4 custom mode: main mode and, for the automatic modes, sub mode.
_MODES: dict[FlightMode, tuple[int, int]] = {
    FlightMode.MANUAL: (3, 0),  # position control, the mode that a pilot selects
    FlightMode.READY: (4, 1),
    FlightMode.TAKEOFF: (4, 2),
    FlightMode.HOLD: (4, 3),
    FlightMode.MISSION: (4, 4),
    FlightMode.RETURN: (4, 5),
    FlightMode.LAND: (4, 6),
    FlightMode.OFFBOARD: (6, 0),
}
_LANDED = {
    LandedState.ON_GROUND: mavlink.MAV_LANDED_STATE_ON_GROUND,
    LandedState.IN_AIR: mavlink.MAV_LANDED_STATE_IN_AIR,
    LandedState.TAKING_OFF: mavlink.MAV_LANDED_STATE_TAKEOFF,
    LandedState.LANDING: mavlink.MAV_LANDED_STATE_LANDING,
}
_STATES = {
    SystemStatus.STANDBY: mavlink.MAV_STATE_STANDBY,
    SystemStatus.ACTIVE: mavlink.MAV_STATE_ACTIVE,
    SystemStatus.CRITICAL: mavlink.MAV_STATE_CRITICAL,
    SystemStatus.FLIGHT_TERMINATION: mavlink.MAV_STATE_FLIGHT_TERMINATION,
}
_DISARMED_US = 900.0  # pulse of a motor output that is off
_SEVERITY = {"critical": 2, "error": 3, "warning": 4, "info": 6}

_HEARTBEAT_S = 1.0
_STREAM_NAMES = {stream.number: stream.name for stream in SAMPLED}

_ESC_THRUST_N_PER_RPM2 = 1.1e-8  # example value, used if the configuration has none


class Link:
    """A UDP socket, its peer, and the rates of the messages to the peer; `local_port` 0 selects any port."""

    def __init__(self, remote_port: int, host: str = "127.0.0.1", local_port: int = 0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((host, local_port))
        self.socket.setblocking(False)
        self.remote = (host, remote_port)
        self.period_ticks: dict[int, int] = {}
        for message, (rate, _) in MESSAGES.items():
            self.set_rate(message, rate)
        self.seen: set[tuple[int, int]] = set()  # systems and components that send on this link
        self.parser = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.parser.robust_parsing = True
        # All sent and received messages pass these queues, which apply the faults of the link.
        self.to_app: LossyLink[bytes] = LossyLink(remote_port)
        self.from_app: LossyLink[bytes] = LossyLink(remote_port + 1)

    def set_rate(self, message: int, rate_hz: float) -> None:
        """Set the rate of a message, rounded to whole ticks; 0 stops the message."""
        if rate_hz <= 0.0:
            self.period_ticks.pop(message, None)
        else:
            self.period_ticks[message] = max(1, math.ceil(1e6 / rate_hz / TICK_US - 1e-9))

    def close(self) -> None:
        self.socket.close()


class MavlinkEndpoint:
    """The MAVLink endpoint of one autopilot.

    Args:
        autopilot: the autopilot, which the caller advances by one tick before every `exchange`.
        ports: remote UDP ports on this host, one for each link.
        local_port: local port of the first link; 0 selects any port.
        system: MAVLink system id; messages to another system are ignored.
    """

    def __init__(
        self, autopilot: Autopilot, ports: tuple[int, ...], local_port: int = 0, system: int = 1
    ) -> None:
        self.autopilot, self._system = autopilot, system
        self.links = [Link(port, local_port=0 if i else local_port) for i, port in enumerate(ports)]
        self.stopped: set[int] = set()  # ids of the messages that a fault suppresses
        self._pack = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
        self._tick = 0
        self._texts: list[tuple[str, str]] = []
        self._heartbeat_s = -math.inf  # host time of the last heartbeat
        # State of the first link for lockstep (`sim.lockstep.LinkEnd`).
        self.sent_us: dict[str, int] = {}
        self.arrived: dict[str, tuple[float, ...]] = {}
        self._rc_us = [1500] * 8  # channels of the remote control, which a ground station may override
        self._type = MAV_TYPES.get(len(autopilot.motors), MAV_TYPES[4])
        self._builders: dict[int, Callable[[], Any]] = {
            message: getattr(self, build.__name__)  # allows a subclass to override a builder
            for message, (_, build) in MESSAGES.items()
        }
        self._commands: dict[int, Callable[[Any], int]] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._do_arm,
            mavlink.MAV_CMD_DO_SET_MODE: self._do_set_mode,
            mavlink.MAV_CMD_NAV_TAKEOFF: self._do_takeoff,
            mavlink.MAV_CMD_NAV_LAND: self._do_land,
            mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: self._do_return,
            mavlink.MAV_CMD_DO_SET_ACTUATOR: self._do_set_actuator,
        }
        autopilot.send_text = self.send_text

    def send_text(self, severity: str, text: str) -> None:
        """Send a STATUSTEXT on every link."""
        self._texts.append((severity, text))

    def impair(self, impairment: Impairment) -> None:
        for link in self.links:
            link.to_app.impairment = link.from_app.impairment = impairment

    def stop_imu(self) -> None:
        self.stopped.add(mavlink.MAVLINK_MSG_ID_HIGHRES_IMU)

    def close(self) -> None:
        for link in self.links:
            link.close()

    # -- once per tick --

    @property
    def sockets(self) -> list[int]:
        """Descriptors that become readable when data has arrived."""
        return [link.socket.fileno() for link in self.links]

    def answer_requests(self) -> None:
        """While simulated time stands still, answer the requests that have arrived.

        Also repeat the heartbeat: after 3 s of host time without it, MAVSDK reports a lost vehicle.
        """
        for link in self.links:
            self._receive(link)
        now_s = time.monotonic()
        if now_s - self._heartbeat_s >= _HEARTBEAT_S:
            self._heartbeat_s = now_s
            for link in self.links:
                self._send(link, self._heartbeat())
        self._flush()

    def exchange(self) -> None:
        """Process the received messages, then send the messages that are due at this tick."""
        for link in self.links:
            self._receive(link)
        self._tick += 1
        for severity, text in self._texts:
            message = mavlink.MAVLink_statustext_message(_SEVERITY.get(severity, 6), text.encode()[:50])
            for link in self.links:
                self._send(link, message)
        self._texts.clear()
        cache: dict[int, Any] = {}
        for link in self.links:
            for message_id, period in link.period_ticks.items():
                # Each message has its own phase, so that slow messages are not all due at the same tick.
                if (self._tick + message_id) % period or message_id in self.stopped:
                    continue
                if link is self.links[0] and message_id in _STREAM_NAMES:
                    # ATTITUDE_QUATERNION has stamps in milliseconds; a tick is a multiple of 1 ms.
                    self.sent_us[_STREAM_NAMES[message_id]] = self.autopilot.time_us
                if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
                    self._heartbeat_s = time.monotonic()
                if message_id not in cache:
                    cache[message_id] = self._builders[message_id]().pack(self._pack)
                    self._pack.seq = (self._pack.seq + 1) % 256
                self._send_bytes(link, cache[message_id])
        self._flush()

    def _flush(self) -> None:
        """Send the messages whose delay has passed."""
        now_s = self.autopilot.now_s
        for link in self.links:
            for packed in link.to_app.pop(now_s):
                send_datagram(link.socket, packed, link.remote)

    def _send(self, link: Link, message: Any) -> None:
        packed = message.pack(self._pack)
        self._pack.seq = (self._pack.seq + 1) % 256
        self._send_bytes(link, packed)

    def _send_bytes(self, link: Link, packed: bytes) -> None:
        link.to_app.push(self.autopilot.now_s, packed)

    def _receive(self, link: Link) -> None:
        for _ in range(100):  # limit the number, so that a flood of messages does not stop the flight
            arrived = receive_datagram(link.socket)
            if arrived is None:
                break
            link.from_app.push(self.autopilot.now_s, arrived[0])
        self._parse(link)

    def _parse(self, link: Link) -> None:
        for data in link.from_app.pop(self.autopilot.now_s):
            # The parser raises struct.error for noise that passes its checksum.
            with contextlib.suppress(mavlink.MAVError, struct.error):
                for message in link.parser.parse_buffer(data) or []:
                    self._handle_message(link, message)

    def _forward(self, link: Link, message: Any, system: int, component: int) -> None:
        """Forward a message to every other link on which its target has sent, like PX4's MAV_x_FORWARD."""
        link.seen.add((message.get_srcSystem(), message.get_srcComponent()))
        for other in self.links:
            known = any(system in (0, s) and component in (0, c) for s, c in other.seen)
            if other is not link and known:
                self._send_bytes(other, bytes(message.get_msgbuf()))

    def _handle_message(self, link: Link, message: Any) -> None:
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        kind = message.get_type()
        if kind != "BAD_DATA" and (system, component) != (self._system, _AUTOPILOT):
            self._forward(link, message, system, component)
        if system not in (0, self._system) or (kind == "COMMAND_LONG" and component not in (0, _AUTOPILOT)):
            return
        if kind == "COMMAND_LONG":
            self._command(link, message)
        elif kind == "SET_POSITION_TARGET_LOCAL_NED":
            self._position_target(message)
            if link is self.links[0]:
                m = message
                self.arrived["setpoint"] = (m.x, m.y, m.z, m.vx, m.vy, m.vz, m.afx, m.afy, m.afz)
        elif kind == "ODOMETRY":
            self._external_pose(message)
            if link is self.links[0]:
                self.arrived["pose"] = (message.x, message.y, message.z)
        elif kind == "PARAM_REQUEST_READ":
            self._param_read(link, message)
        elif kind == "PARAM_REQUEST_LIST":
            for index, name in enumerate(self.autopilot.parameters):
                self._send(link, self._param_value(name, index))
        elif kind == "PARAM_SET":
            self._param_set(link, message)
        elif kind == "TIMESYNC" and message.tc1 == 0:
            self._send(
                link, mavlink.MAVLink_timesync_message(self.autopilot.time_us * 1000 or 1, message.ts1)
            )
        elif kind == "RC_CHANNELS_OVERRIDE":
            self._rc_us = [getattr(message, f"chan{n}_raw") for n in range(1, 9)]
        elif kind == "MISSION_REQUEST_LIST":
            reply = mavlink.MAVLink_mission_count_message(
                message.get_srcSystem(), message.get_srcComponent(), 0, message.mission_type
            )
            self._send(link, reply)

    # -- commands --

    def _command(self, link: Link, message: Any) -> None:
        if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._set_interval(link, _whole(message.param1), message.param2)
        elif message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            result = self._request_message(link, _whole(message.param1))
        elif message.command == mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
            result = self._request_message(link, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        elif message.command in self._commands:
            result = self._commands[message.command](message)
        else:
            result = mavlink.MAV_RESULT_UNSUPPORTED
        ack = mavlink.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )
        self._send(link, ack)

    def _set_interval(self, link: Link, message_id: int, interval_us: float) -> int:
        if message_id not in self._builders or not math.isfinite(interval_us):
            return int(mavlink.MAV_RESULT_DENIED)
        if interval_us < 0:
            link.set_rate(message_id, 0.0)
        elif interval_us == 0:
            link.set_rate(message_id, MESSAGES[message_id][0])
        else:
            link.set_rate(message_id, 1e6 / interval_us)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _request_message(self, link: Link, message_id: int) -> int:
        if message_id not in self._builders:
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        self._send(link, self._builders[message_id]())
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _do_arm(self, message: Any) -> int:
        force = _whole(message.param2) == 21196
        ok = self.autopilot.arm(force) if message.param1 > 0.5 else self.autopilot.disarm(force)
        return _result(ok)

    def _do_set_mode(self, message: Any) -> int:
        wanted = (_whole(message.param2), _whole(message.param3))
        for mode, numbers in _MODES.items():
            if numbers == wanted or (wanted[0] != 4 and numbers[0] == wanted[0]):
                return _result(self.autopilot.set_mode(mode))
        if wanted[0] in (1, 2, 5, 7, 8):  # the other modes in which a pilot steers
            self.autopilot.set_mode(FlightMode.MANUAL)
            return int(mavlink.MAV_RESULT_ACCEPTED)
        return int(mavlink.MAV_RESULT_DENIED)

    def _do_takeoff(self, message: Any) -> int:
        altitude = None if math.isnan(message.param7) else message.param7 - _HOME_ALT
        return _result(self.autopilot.take_off(altitude if altitude and altitude > 0.0 else None))

    def _do_land(self, _message: Any) -> int:
        self.autopilot.set_mode(FlightMode.LAND)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _do_return(self, _message: Any) -> int:
        # Indoors there is no home position, so PX4 lands instead.
        self.autopilot.set_mode(FlightMode.LAND)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _do_set_actuator(self, message: Any) -> int:
        for index in range(1, 7):
            value = getattr(message, f"param{index}")
            if not math.isnan(value):
                self.autopilot.set_actuator(index, value)
        return int(mavlink.MAV_RESULT_ACCEPTED)  # PX4 accepts even an actuator without an output

    def _position_target(self, message: Any) -> None:
        if message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
            return
        mask = message.type_mask

        def part(values: tuple[float, float, float], bits: int) -> tuple[float, float, float]:
            return (
                math.nan if mask & bits else values[0],
                math.nan if mask & (bits << 1) else values[1],
                math.nan if mask & (bits << 2) else values[2],
            )

        self.autopilot.set_trajectory(
            TrajectorySetpoint(
                part((message.x, message.y, message.z), 1),
                part((message.vx, message.vy, message.vz), 8),
                part((message.afx, message.afy, message.afz), 64),
                math.nan if mask & 1024 else message.yaw,
            )
        )

    def _external_pose(self, message: Any) -> None:
        """Fuse the pose of an ODOMETRY message if it is local and of type VISION, as PX4 does."""
        local = message.frame_id in (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_FRD)
        if local and message.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_VISION:
            w, x, y, z = message.q
            attitude = None if math.isnan(w) else (w, x, y, z)
            self.autopilot.fuse_external_pose((message.x, message.y, message.z), attitude)

    # -- parameters --

    def _param_value(self, name: str, index: int) -> Any:
        value = self.autopilot.parameters[name]
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        if isinstance(value, int):
            # PX4 sends integers bytewise in the float field.
            value = struct.unpack("<f", struct.pack("<i", value))[0]
            kind = mavlink.MAV_PARAM_TYPE_INT32
        count = len(self.autopilot.parameters)
        return mavlink.MAVLink_param_value_message(name.encode(), value, kind, count, index)

    def _param_read(self, link: Link, message: Any) -> None:
        names = list(self.autopilot.parameters)
        if 0 <= message.param_index < len(names):
            name = names[message.param_index]
        else:
            name = _param_name(message.param_id)
        if name in self.autopilot.parameters:
            self._send(link, self._param_value(name, names.index(name)))

    def _param_set(self, link: Link, message: Any) -> None:
        name = _param_name(message.param_id)
        if name not in self.autopilot.parameters:
            return
        value = message.param_value
        whole = message.param_type == mavlink.MAV_PARAM_TYPE_INT32
        # A value of the wrong type is ignored, and the answer contains the current value.
        if isinstance(self.autopilot.parameters[name], int) is whole and (whole or math.isfinite(value)):
            self.autopilot.parameters[name] = (
                struct.unpack("<i", struct.pack("<f", value))[0] if whole else value
            )
        self._send(link, self._param_value(name, list(self.autopilot.parameters).index(name)))

    # -- telemetry --

    @property
    def _boot_ms(self) -> int:
        return (self.autopilot.time_us // 1000) & 0xFFFFFFFF

    def _heartbeat(self) -> Any:
        a = self.autopilot
        base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        if a.armed:
            base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        if a.mode is not FlightMode.MANUAL:
            base |= mavlink.MAV_MODE_FLAG_AUTO_ENABLED
        status = _STATES[a.system_status]
        return mavlink.MAVLink_heartbeat_message(self._type, _PX4, base, self._custom_mode(), status, 3)

    def _custom_mode(self) -> int:
        main, sub = _MODES[self.autopilot.mode]
        return main << 16 | sub << 24

    def _current_mode(self) -> Any:
        return unlisted_messages.current_mode(self._custom_mode())

    def _sys_status(self) -> Any:
        a = self.autopilot
        present = (
            mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
            | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
            | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
            | mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION
            | mavlink.MAV_SYS_STATUS_SENSOR_GPS
            | mavlink.MAV_SYS_STATUS_PREARM_CHECK
            | mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
        )
        ok = present
        if not a.estimator.ok:
            ok &= ~(
                mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION
                | mavlink.MAV_SYS_STATUS_SENSOR_GPS
                | mavlink.MAV_SYS_STATUS_PREARM_CHECK
            )
        volts = round(a.vehicle.simulation.battery_v * 1000)
        remaining = round(a.battery_remaining * 100)
        return mavlink.MAVLink_sys_status_message(
            present, present, ok, 300, volts, -1, remaining, 0, 0, 0, 0, 0, 0
        )

    def _extended_sys_state(self) -> Any:
        return mavlink.MAVLink_extended_sys_state_message(
            0, _LANDED.get(self.autopilot.landed, mavlink.MAV_LANDED_STATE_UNDEFINED)
        )

    def _battery_status(self) -> Any:
        a = self.autopilot
        # Without cell voltages, the first value is the total voltage, the second value its excess over 65534.
        volts = round(a.vehicle.simulation.battery_v * 1000)
        cells = [min(volts, 65534), volts - 65534 if volts > 65534 else 65535] + [65535] * 8
        return mavlink.MAVLink_battery_status_message(
            0, 0, 0, 32767, cells, -1, -1, -1, round(a.battery_remaining * 100)
        )

    def _highres_imu(self) -> Any:
        imu = self.autopilot.imu
        return mavlink.MAVLink_highres_imu_message(
            imu.t_us, *imu.specific_force_frd, *imu.rate_frd, 0.2, 0.0, 0.45, 1013.25, 0.0, 0.0, 25.0, 0x1FFF
        )

    def _attitude_quaternion(self) -> Any:
        e = self.autopilot.estimator
        return mavlink.MAVLink_attitude_quaternion_message(self._boot_ms, *e.q, *e.rate)

    def _local_position(self) -> Any:
        e = self.autopilot.estimator
        return mavlink.MAVLink_local_position_ned_message(self._boot_ms, *e.position, *e.velocity)

    def _odometry(self) -> Any:
        e = self.autopilot.estimator
        unknown = [math.nan] + [0.0] * 20
        return mavlink.MAVLink_odometry_message(
            self.autopilot.time_us,
            mavlink.MAV_FRAME_LOCAL_NED,
            mavlink.MAV_FRAME_LOCAL_NED,
            *e.position,
            e.q,
            *e.velocity,
            *e.rate,
            unknown,
            unknown,
            e.resets % 256,
            mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        )

    def _estimator_status(self) -> Any:
        good = (
            mavlink.ESTIMATOR_ATTITUDE
            | mavlink.ESTIMATOR_VELOCITY_HORIZ
            | mavlink.ESTIMATOR_VELOCITY_VERT
            | mavlink.ESTIMATOR_POS_HORIZ_REL
            | mavlink.ESTIMATOR_POS_VERT_ABS
        )
        flags = good if self.autopilot.estimator.ok else 0
        return mavlink.MAVLink_estimator_status_message(
            self.autopilot.time_us, flags, *([0.0] * 6), 0.05, 0.05
        )

    def _geodetic(self) -> tuple[int, int, float]:
        n, e, d = self.autopilot.estimator.position
        lat = _HOME_LAT + n / _EARTH_M_PER_DEG
        lon = _HOME_LON + e / (_EARTH_M_PER_DEG * math.cos(math.radians(_HOME_LAT)))
        return round(lat * 1e7), round(lon * 1e7), _HOME_ALT - d

    def _global_position(self) -> Any:
        lat, lon, alt = self._geodetic()
        v = self.autopilot.estimator.velocity
        return mavlink.MAVLink_global_position_int_message(
            self._boot_ms,
            lat,
            lon,
            round(alt * 1000),
            round((alt - _HOME_ALT) * 1000),
            *(max(-32768, min(32767, round(c * 100))) for c in v),
            65535,
        )

    def _gps_raw(self) -> Any:
        lat, lon, alt = self._geodetic()
        speed = round(distance2(self.autopilot.estimator.velocity, (0.0, 0.0)) * 100)
        return mavlink.MAVLink_gps_raw_int_message(
            self.autopilot.time_us, 6, lat, lon, round(alt * 1000), 60, 80, min(speed, 65534), 65535, 14
        )

    def _rc_channels(self) -> Any:
        unused = [65535] * (18 - len(self._rc_us))
        return mavlink.MAVLink_rc_channels_message(
            self._boot_ms, len(self._rc_us), *self._rc_us, *unused, 254
        )

    def _home_position(self) -> Any:
        return mavlink.MAVLink_home_position_message(
            round(_HOME_LAT * 1e7),
            round(_HOME_LON * 1e7),
            round(_HOME_ALT * 1000),
            *(0.0, 0.0, 0.0),
            [1.0, 0.0, 0.0, 0.0],
            *(0.0, 0.0, 0.0),
        )

    def _actuator_output_status(self) -> Any:
        """Motor and servo outputs as PWM, microseconds."""
        a = self.autopilot
        span = MOTOR_FULL_US - MOTOR_STOP_US
        outputs = [MOTOR_STOP_US + span * u for u in a.motors] if a.armed else [_DISARMED_US] * len(a.motors)
        outputs.append(a.lock_pulse_us() or 0.0)
        return mavlink.MAVLink_actuator_output_status_message(
            a.time_us, len(outputs), outputs + [0.0] * (32 - len(outputs))
        )

    def _esc_status(self) -> Any:
        a = self.autopilot
        per_rpm2 = a.vehicle.estimation.esc_thrust_n_per_rpm2 or _ESC_THRUST_N_PER_RPM2
        rpm = [round(math.sqrt(a.vehicle.thrust.force_n(u) / per_rpm2)) for u in a.plant.motor]
        return unlisted_messages.EscStatusMessages(a.time_us, rpm)

    def _autopilot_version(self) -> Any:
        capabilities = (
            mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
            | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
            | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        )
        custom = [0] * 8
        return mavlink.MAVLink_autopilot_version_message(
            capabilities, _VERSION, 0, 0, 0, custom, custom, custom, 0, 0, 0xDA27
        )


# message -> default rate on PX4's onboard link (Hz, 0 for a message on request only) and builder
MESSAGES: dict[int, tuple[float, Callable[[MavlinkEndpoint], Any]]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: (1.0, MavlinkEndpoint._heartbeat),
    unlisted_messages.CURRENT_MODE_ID: (0.5, MavlinkEndpoint._current_mode),
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: (5.0, MavlinkEndpoint._sys_status),
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: (5.0, MavlinkEndpoint._extended_sys_state),
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: (0.5, MavlinkEndpoint._battery_status),
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: (50.0, MavlinkEndpoint._highres_imu),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: (50.0, MavlinkEndpoint._attitude_quaternion),
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: (30.0, MavlinkEndpoint._local_position),
    mavlink.MAVLINK_MSG_ID_ODOMETRY: (30.0, MavlinkEndpoint._odometry),
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: (10.0, MavlinkEndpoint._global_position),
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: (5.0, MavlinkEndpoint._gps_raw),
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: (5.0, MavlinkEndpoint._rc_channels),
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: (0.5, MavlinkEndpoint._home_position),
    mavlink.MAVLINK_MSG_ID_ACTUATOR_OUTPUT_STATUS: (0.0, MavlinkEndpoint._actuator_output_status),
    unlisted_messages.ESC_STATUS_ID: (0.0, MavlinkEndpoint._esc_status),
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: (1.0, MavlinkEndpoint._estimator_status),
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: (0.0, MavlinkEndpoint._autopilot_version),
}


def _result(accepted: bool) -> int:
    return int(mavlink.MAV_RESULT_ACCEPTED if accepted else mavlink.MAV_RESULT_DENIED)


def _whole(value: float) -> int:
    """Return a command's parameter as an integer; unused parameters are NaN."""
    return int(value) if math.isfinite(value) else 0


def _param_name(raw: str | bytes) -> str:
    text = raw.decode("ascii", "replace") if isinstance(raw, bytes) else raw
    return text.rstrip("\x00")
