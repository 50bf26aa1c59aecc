"""Another component of the vehicle's system, whose messages mavlink-router forwards on the link."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import common as mavlink

from tests.doubles.scripted_peer import Mavlink, ScriptedPeer, UdpLink

COMPONENT = 197  # visual-inertial odometry
_PERIOD_S = 0.02
_FAR_AHEAD_US = 10**12
_Q_TURNED = [math.cos(math.radians(30.0)), 0.0, 0.0, math.sin(math.radians(30.0))]


def foreign_sender(port: int) -> ScriptedPeer:
    """Return a peer that sends every message of `messages` to a UDP port, 50 times a second."""
    return ScriptedPeer(UdpLink(to=("127.0.0.1", port)), Mavlink(1, COMPONENT), every=[(_PERIOD_S, messages)])


def messages() -> list[mavlink.MAVLink_message]:
    """Return messages of every kind that the program must not accept from another component."""
    zeros, far_ms = [0.0] * 21, _FAR_AHEAD_US // 1000 % 2**32
    velocity_and_rate = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return [
        mavlink.MAVLink_odometry_message(
            _FAR_AHEAD_US, 1, 1, 77.0, 77.0, -77.0, _Q_TURNED, *velocity_and_rate, zeros, zeros, 99, 8
        ),
        mavlink.MAVLink_attitude_quaternion_message(far_ms, *_Q_TURNED, 0.0, 0.0, 0.0),
        mavlink.MAVLink_highres_imu_message(_FAR_AHEAD_US, 1.0, 2.0, -77.0, *zeros[:10], 63),
        mavlink.MAVLink_extended_sys_state_message(0, mavlink.MAV_LANDED_STATE_LANDING),
        mavlink.MAVLink_battery_status_message(0, 1, 1, 32767, [7700] + [65535] * 9, -1, -1, -1, 7),
        mavlink.MAVLink_statustext_message(2, b"failsafe"),
        mavlink.MAVLink_estimator_status_message(_FAR_AHEAD_US, 0, *[0.0] * 6, 77.0, 77.0),
        mavlink.MAVLink_actuator_output_status_message(_FAR_AHEAD_US, 4, [1770.0] * 4 + [0.0] * 28),
    ]
