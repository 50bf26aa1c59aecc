"""A ground station (system 255, component 190) whose operator presses the program's buttons."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from types import TracebackType

from pymavlink.dialects.v20 import common as mavlink

PROGRAM = 195  # component
_BUTTONS = mavlink.MAV_CMD_USER_1
_WAIT_S, _TRY_S = 30.0, 3.0


class OperatorStation:
    """`with OperatorStation(port) as station: station.press(5)`.

    Args:
        port: UDP port to which the vehicle's link sends; the station answers the latest sender.
        system: MAVLink system id of the station.
        vehicle_port: UDP port of a vehicle that waits for the first message.

    Attributes:
        texts: STATUSTEXTs of the program, joined from their parts.
        beats: number of the program's heartbeats.
        poses: number of poses that the program has sent to the vehicle.
        armed: whether the vehicle is armed.
        was_armed: whether the vehicle has been armed.
    """

    def __init__(self, port: int, system: int = 255, vehicle_port: int | None = None) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.settimeout(0.2)
        self._vehicle = None if vehicle_port is None else ("127.0.0.1", vehicle_port)
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=190)
        self._mav.robust_parsing = True
        self._lock, self._news = threading.Lock(), threading.Condition()
        self._answers: list[int] = []
        self._parts: dict[int, str] = {}
        self.texts: list[str] = []
        self.beats = self.poses = 0
        self._vehicle_system, self.armed, self.was_armed = 1, False, False
        self._transmits = False
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=run, daemon=True, name="operator station")
            for run in (self._receive, self._beat)
        ]

    def __enter__(self) -> OperatorStation:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(2.0)
        self._socket.close()

    def press(self, button: int, value: int = 0, component: int = PROGRAM) -> int | None:
        """Press a button and return the MAV_RESULT, or None without an answer within 3 s."""
        before = len(self._answers)
        self.send(
            mavlink.MAVLink_command_long_message(
                self._vehicle_system, component, _BUTTONS, 0, button, value, 0, 0, 0, 0, 0
            )
        )
        with self._news:
            self._news.wait_for(lambda: len(self._answers) > before, _TRY_S)
        return self._answers[before] if len(self._answers) > before else None

    def move_switch(self, channel: int, pulse_us: int) -> None:
        """Send the transmitter's channels once, with all but one at their centre."""
        pulses = [1500] * 8
        pulses[channel - 1] = pulse_us
        self.send(mavlink.MAVLink_rc_channels_override_message(self._vehicle_system, 1, *pulses))

    def hold_sticks(self) -> None:
        """Send centred joystick sticks from now on, which PX4 treats as a remote control."""
        self._transmits = True

    def wait_for(self, text: str, count: int = 1, timeout_s: float = _WAIT_S) -> str:
        """Wait until `count` received texts contain a text, and return the last of them."""

        def found() -> list[str]:
            return [received for received in self.texts if text in received]

        with self._news:
            assert self._news.wait_for(lambda: len(found()) >= count, timeout_s), (text, self.texts[-20:])
            return found()[count - 1]

    def wait_for_program(self, more: int = 1) -> None:
        """Wait for heartbeats of the program, because the vehicle forwards to it only after them."""
        wanted = self.beats + more
        with self._news:
            assert self._news.wait_for(lambda: self.beats >= wanted, _WAIT_S), "no heartbeat of the program"

    def wait_disarmed(self) -> None:
        """Wait until the vehicle has landed and disarmed."""
        with self._news:
            assert self._news.wait_for(lambda: not self.armed, 2.0 * _WAIT_S), "still armed"

    def send(self, message: mavlink.MAVLink_message) -> None:
        """Send a message to the vehicle once its address is known."""
        if self._vehicle is not None:
            with self._lock, contextlib.suppress(OSError):
                self._socket.sendto(message.pack(self._mav), self._vehicle)

    def _beat(self) -> None:
        while not self._stop.wait(0.1):
            if self._transmits:
                self.send(mavlink.MAVLink_manual_control_message(self._vehicle_system, 0, 0, 500, 0, 0))
            self.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3
                )
            )

    def _receive(self) -> None:
        parser = mavlink.MAVLink(None)
        parser.robust_parsing = True
        while not self._stop.is_set():
            try:
                data, self._vehicle = self._socket.recvfrom(4096)
            except OSError:  # timeout, or the vehicle has ended
                time.sleep(0.01)
                continue
            for message in parser.parse_buffer(data) or []:
                with self._news:
                    self._handle_message(message)
                    self._news.notify_all()

    def _handle_message(self, message: mavlink.MAVLink_message) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT" and message.get_srcComponent() == 1:
            self._vehicle_system = message.get_srcSystem()
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self.was_armed |= self.armed
        if message.get_srcComponent() != PROGRAM:
            return
        if kind == "HEARTBEAT":
            self.beats += 1
        elif kind == "ODOMETRY":
            self.poses += 1
        elif kind == "COMMAND_ACK" and message.command == _BUTTONS:
            if message.target_system == self._mav.srcSystem:
                self._answers.append(message.result)
        elif kind == "STATUSTEXT":
            text = self._parts.pop(message.id, "") + message.text
            if message.id and len(message.text) == 50:
                self._parts[message.id] = text
            else:
                self.texts.append(text)
