"""A ground station on PX4's ground-station link, which arms the simulated vehicle and then ends.

python -m tests.doubles.ground_station INSTANCE
"""

from __future__ import annotations

import contextlib
import sys
import time
from threading import Event

from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

PORT = 18570  # of instance 0: PX4's link for a ground station
_WAIT_S = 30.0


def arm(instance: int) -> bool:
    """Request arming in the present mode until PX4 accepts; return False after half a minute."""
    link = mavutil.mavlink_connection(
        f"udpout:127.0.0.1:{PORT + instance}", source_system=255, dialect="common"
    )
    end = time.monotonic() + _WAIT_S
    while time.monotonic() < end:
        try:
            link.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
            system = instance + 1  # as PX4 SITL numbers them
            order = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
            link.mav.command_long_send(system, 1, order, 0, 1.0, *([0.0] * 6))
            answer = link.recv_match(type="COMMAND_ACK", blocking=True, timeout=0.2)
        except ConnectionError:  # PX4 does not listen yet
            answer = None
        # PX4 forwards its answers to the application's commands to this link as well.
        if answer is not None and (answer.command, answer.result) == (order, mavlink.MAV_RESULT_ACCEPTED):
            return True
        time.sleep(0.05)
    return False


def switch_to_position(instance: int, begin: Event, sticks: bool) -> int | None:
    """Request position mode once `begin` is set, and return PX4's answer, or None without one.

    Args:
        instance: number of the PX4 instance.
        begin: event that starts the request; sticks are sent from the beginning.
        sticks: whether to send centred sticks, without which PX4 has no pilot to hand over to.
    """
    link = mavutil.mavlink_connection(
        f"udpout:127.0.0.1:{PORT + instance}", source_system=255, dialect="common"
    )
    system, end = instance + 1, time.monotonic() + 3.0 * _WAIT_S
    while time.monotonic() < end:
        with contextlib.suppress(ConnectionError):
            link.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
            if sticks:
                link.mav.manual_control_send(system, 0, 0, 500, 0, 0)
            if begin.is_set():
                mode = (1.0, 3.0, *([0.0] * 5))  # PX4's own: position
                link.mav.command_long_send(system, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, *mode)
            answer = link.recv_match(type="COMMAND_ACK", blocking=True, timeout=0.05)
            if answer is not None and answer.command == mavlink.MAV_CMD_DO_SET_MODE:
                return int(answer.result)
    return None


if __name__ == "__main__":
    sys.exit(0 if arm(int(sys.argv[1])) else 1)
