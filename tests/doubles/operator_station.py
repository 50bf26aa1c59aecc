"""A ground station (system 255, component 190), whose operator presses buttons, moves sticks and commands."""

from __future__ import annotations

from pymavlink.dialects.v20 import common as mavlink

from tests.doubles.scripted_peer import Mavlink, ScriptedPeer, UdpLink
from tests.real_time import TooSlow, wait_until

PROGRAM = 195  # component
_BUTTONS = mavlink.MAV_CMD_USER_1
_PX4_PORT = 18570  # of instance 0: PX4's link for a ground station
_WAIT_S, _TRY_S = 30.0, 3.0


class OperatorStation(ScriptedPeer):
    """`with OperatorStation(port) as station: station.press(5)`.

    Args:
        port: UDP port to which the vehicle's link sends; the station answers the latest sender.
        vehicle_port: UDP port of a vehicle that waits for the first message.
        vehicle_system: MAVLink system id of the vehicle, until its first heartbeat.

    Attributes:
        texts: STATUSTEXTs of the program, joined from their parts.
        beats: number of the program's heartbeats.
        poses: number of poses that the program has sent to the vehicle.
        armed: whether the vehicle is armed.
        was_armed: whether the vehicle has been armed.
        sticks: whether it sends centred joystick sticks, which PX4 treats as a remote control.
    """

    RECORDED = frozenset({"COMMAND_ACK"})

    def __init__(self, port: int = 0, vehicle_port: int | None = None, vehicle_system: int = 1) -> None:
        self._vehicle = UdpLink(port, None if vehicle_port is None else ("127.0.0.1", vehicle_port))
        self._mavlink = Mavlink(255, 190)
        super().__init__(self._vehicle, self._mavlink, every=[(0.1, self._beat)])
        self._parts: dict[int, str] = {}
        self.texts: list[str] = []
        self.beats = self.poses = 0
        self.vehicle_system, self.armed, self.was_armed, self.sticks = vehicle_system, False, False, False

    @classmethod
    def of_px4(cls, instance: int) -> OperatorStation:
        """Return a station on the link of one of the computer's simulated PX4s."""
        return cls(vehicle_port=_PX4_PORT + instance, vehicle_system=instance + 1)

    @property
    def system(self) -> int:
        """MAVLink system id of the station."""
        return int(self._mavlink.sender.srcSystem)

    @system.setter
    def system(self, system: int) -> None:
        self._mavlink.sender.srcSystem = system

    # -- the operator's actions --

    def command(
        self, order: int, *parameters: float, component: int = 1, wait_s: float = _TRY_S
    ) -> int | None:
        """Send a command and return its MAV_RESULT, or None without an answer."""
        parameters += (0.0,) * (7 - len(parameters))
        before = len(self._results(order))
        self.send(mavlink.MAVLink_command_long_message(self.vehicle_system, component, order, 0, *parameters))
        with self.news:
            self.news.wait_for(lambda: len(self._results(order)) > before, wait_s)
        return next(iter(self._results(order)[before:]), None)

    def press(self, button: int, value: int = 0) -> int | None:
        """Press a button of the program and return the MAV_RESULT, or None without an answer within 3 s."""
        return self.command(_BUTTONS, button, value, component=PROGRAM)

    def arm(self) -> int:
        """Command arming until the vehicle accepts, and return the answer."""
        order, accepted = mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_RESULT_ACCEPTED
        wait_until(lambda: self.command(order, 1.0, wait_s=0.25) == accepted, _WAIT_S, "PX4 accepts arming")
        return int(accepted)

    def set_mode(self, main: int, sub: int = 0, wait_s: float = _TRY_S) -> int | None:
        """Command one of PX4's own modes and return the answer."""
        return self.command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, main, sub, wait_s=wait_s)

    def move_switch(self, channel: int, pulse_us: int) -> None:
        """Send the transmitter's channels once, with all but one at their centre."""
        pulses = [1500] * 8
        pulses[channel - 1] = pulse_us
        self.send(mavlink.MAVLink_rc_channels_override_message(self.vehicle_system, 1, *pulses))

    # -- what the operator waits for --

    def wait_for_text(self, text: str, count: int = 1, timeout_s: float = _WAIT_S) -> str:
        """Wait until `count` received texts contain a text, and return the last of them."""

        def found() -> list[str]:
            return [received for received in self.texts if text in received]

        try:
            self.wait_for(lambda: len(found()) >= count, timeout_s, f"{text!r} for the {count}. time")
        except TooSlow as error:
            raise TooSlow(f"{error}: {self.texts[-20:]}") from None
        return found()[count - 1]

    def wait_for_program(self, more: int = 1) -> None:
        """Wait for heartbeats of the program, because the vehicle forwards to it only after them."""
        wanted = self.beats + more
        self.wait_for(lambda: self.beats >= wanted, _WAIT_S, "a heartbeat of the program")

    def wait_disarmed(self) -> None:
        """Wait until the vehicle has landed and disarmed."""
        self.wait_for(lambda: not self.armed, 2.0 * _WAIT_S, "the vehicle is disarmed")

    def _beat(self) -> list[mavlink.MAVLink_message]:
        gcs, none = mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID
        beat = [mavlink.MAVLink_heartbeat_message(gcs, none, 0, 0, 0, 3)]
        centred = mavlink.MAVLink_manual_control_message(self.vehicle_system, 0, 0, 500, 0, 0)
        return [centred] * self.sticks + beat

    def _results(self, order: int) -> list[int]:
        """Return the answers to a command; PX4 also forwards its answers to the application's commands."""
        return [
            int(ack.result)
            for ack in self.received_of("COMMAND_ACK")
            if ack.command == order and ack.target_system in (0, self.system)
        ]

    def update(self, message: mavlink.MAVLink_message) -> None:
        kind, component = message.get_type(), message.get_srcComponent()
        if kind == "HEARTBEAT" and component == 1:
            self.vehicle_system = message.get_srcSystem()
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self.was_armed |= self.armed
        self.beats += kind == "HEARTBEAT" and component == PROGRAM
        self.poses += kind == "ODOMETRY" and component == PROGRAM
        if kind == "STATUSTEXT" and component == PROGRAM:
            text = self._parts.pop(message.id, "") + message.text
            if message.id and len(message.text) == 50:
                self._parts[message.id] = text
            else:
                self.texts.append(text)
