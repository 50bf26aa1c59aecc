"""The plant's end of a flight controller in hardware-in-the-loop mode: HIL messages over its USB port or UDP.

There is no lockstep: PX4 runs on its own clock and stamps every HIL_SENSOR, ODOMETRY and HIL_GPS when it
arrives (v1.14 to v1.18), as nothing here answers its TIMESYNC. So the moment of sending is the time stamp:

- a late message is not made up for by a burst, whose samples PX4 would take for one of some 20 ms and several
  of none: the ticks that were missed are reported as one message with their mean (`Px4Vehicle.step`);
- a message that the port does not take is dropped whole, never in part, and counted;
- a lost HIL_ACTUATOR_CONTROLS leaves the motors at what the last one said, as a lost frame to an ESC does;
- a gap of more than some 75 ms in HIL_SENSOR spoils PX4's vertical estimate (measured on v1.18) by g times
  its length, and the vehicle sinks to the ground: in flight it is the end, with that as its cause. What was
  sent and PX4's own stamps tell it; outputs that only arrive late do no such harm.

Beside the simulation the link asks PX4, through its shell, what its outputs are: simulated ones may move, no
other may. That is the measurement that the motors stay off; v1.18 no longer locks them in this mode.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
import struct
import time
from typing import Any, Protocol

import serial
from pymavlink.dialects.v20 import common as mavlink

from dart_flight.config.document import InputError
from dart_flight.config.link_url import LinkAddress, parse_link
from dart_flight.sim.px4.bridge import ARMED, Controls, Px4LostError

SILENCE_S = 1.0  # without actuator outputs, which come at 200 Hz: then the flight controller is gone
GAP_S = 0.07  # between two samples of PX4 in flight: 50 ms are survived, 75 ms are not
_READ = 65536
_SYSTEM, _COMPONENT = 1, 191  # of a companion computer: no ground station, whose loss it would hide
_HEARTBEAT_S = 1.0  # it also makes a board start MAVLink on its USB port
_CONTROLS_US = 4000  # an answer to every HIL_SENSOR; PX4 itself asks for 200 Hz
_ASK_OUTPUTS_S = 1.0
_FORCE = 21196.0  # disarm in the air, too
_SHELL, _SHELL_FLAGS = 10, 2 | 4 | 16  # SERIAL_CONTROL: device, and respond, exclusive, multi
_ASK_OUTPUTS = b"listener actuator_outputs -n 1\n"
_PROMPT = re.compile("pxh>|nsh>")
_OUTPUTS = re.compile(r"output: \[([^\]]*)\]")


class HitlPort(Protocol):
    """Bytes to and from a flight controller; nothing blocks."""

    def read(self) -> bytes:
        """What has arrived; raises OSError where the port is gone."""

    def write(self, data: bytes) -> int:
        """How many bytes the port took; raises OSError where it is gone."""

    def close(self) -> None:
        """Let go of the port."""


class SerialPort:
    """A serial device, raw, at a baud rate; USB ports ignore the rate."""

    def __init__(self, device: str, baud: int) -> None:
        self._serial = serial.Serial(device, baud, timeout=0.0)
        self._fd = self._serial.fileno()
        os.set_blocking(self._fd, False)

    def read(self) -> bytes:
        """As `HitlPort`."""
        try:
            return os.read(self._fd, _READ)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> int:
        """As `HitlPort`."""
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """As `HitlPort`."""
        self._serial.close()


class UdpPort:
    """A UDP socket: `udpin` listens and answers whoever sent last, `udpout` sends first."""

    def __init__(self, address: LinkAddress) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._to: tuple[str, int] | None = None
        if address.kind == "udpout":
            self._to = (address.place, address.number)
        else:
            self._socket.bind((address.place, address.number))

    def read(self) -> bytes:
        """As `HitlPort`."""
        data = b""
        with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
            while True:
                part, self._to = self._socket.recvfrom(_READ)
                data += part
        return data

    def write(self, data: bytes) -> int:
        """As `HitlPort`; a datagram goes whole or not at all."""
        if self._to is None:
            return 0
        try:
            return self._socket.sendto(data, self._to)
        except (BlockingIOError, ConnectionRefusedError):
            return 0

    def close(self) -> None:
        """As `HitlPort`."""
        self._socket.close()


def open_port(url: str) -> HitlPort:
    """The port of a URL as `--hitl` takes it.

    Raises:
        InputError: it cannot be opened, or is neither serial nor UDP.
    """
    address = parse_link(url)
    if address is None or address.kind not in ("serial", "udpin", "udpout"):
        raise InputError(
            f"{url!r}: allowed are serial:///dev/ttyACM0:921600, udpin://HOST:PORT, udpout://HOST:PORT",
            key=("--hitl",),
        )
    try:
        return SerialPort(address.place, address.number) if address.kind == "serial" else UdpPort(address)
    except (OSError, ValueError) as error:
        # pyserial wraps the system's own word into its own; the last part is the reason.
        code = getattr(error, "errno", None)
        reason = os.strerror(code) if code else str(error)
        busy = " (is QGroundControl connected to it?)" if code in (errno.EBUSY, errno.EAGAIN) else ""
        raise InputError(f"cannot open {url}: {reason}{busy}", key=("--hitl",)) from None


class HitlLink:
    """Sends what the plant measures and keeps what the flight controller puts out.

    Args:
        port: to the flight controller.

    Attributes:
        controls: the last actuator outputs.
        answered: whether any have come.
        sent, dropped: messages that the port took, and did not.
        outputs_seen: kinds of outputs that PX4 has, the simulated ones among them; 0: not asked yet.
        longest_gap_s: between two ticks that the port took, and between two messages with actuator outputs
            by PX4's clock, which come every 50 ms without any.
    """

    def __init__(self, port: HitlPort) -> None:
        self._port = port
        self._pack = mavlink.MAVLink(None, srcSystem=_SYSTEM, srcComponent=_COMPONENT)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._rest = b""  # of a message that the port took in part
        self.controls = Controls(0, False, (0.0,) * 16)
        self.answered = False
        self.sent = self.dropped = 0
        self.outputs_seen = 0
        self.longest_gap_s = 0.0
        self._heard_s = self._fed_s = time.monotonic()
        self._beat_s = self._asked_s = 0.0
        self._target = (1, 1)  # system and component of the flight controller
        self._shell = ""
        self._at_rest: list[str] = []  # outputs of each kind while disarmed, as PX4 writes them

    @property
    def silent_s(self) -> float:
        """How long no actuator outputs have come."""
        return time.monotonic() - self._heard_s

    def exchange(self, sensor: Any, *others: Any) -> Controls:
        """Send one tick's messages, take what has arrived, return the newest actuator outputs.

        Raises:
            Px4LostError: the port is gone, no actuator outputs for `SILENCE_S` after the first, a gap in
                flight of more than `GAP_S`, or other outputs than the simulated ones move; then it is
                told to disarm, too.
        """
        dropped = self.dropped
        self.send(*others, sensor)
        if self.dropped == dropped:
            now_s = time.monotonic()
            if self.answered:
                self._judge_gap(now_s - self._fed_s, self.controls.armed)
            self._fed_s = now_s
        self._keep_up()
        self.receive()
        if self.answered and self.silent_s > SILENCE_S:
            raise Px4LostError(f"flight controller sent no actuator outputs for {SILENCE_S:g} s")
        return self.controls

    def _keep_up(self) -> None:
        """What is sent now and then: a heartbeat, and questions about the outputs."""
        now_s = time.monotonic()
        if now_s - self._beat_s >= _HEARTBEAT_S:
            self._beat_s = now_s
            self.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4, 3))
        if self.answered and now_s - self._asked_s >= _ASK_OUTPUTS_S:
            if not self._asked_s:
                wanted = (mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS, _CONTROLS_US)
                self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, *wanted)
            self._asked_s = now_s
            data = list(_ASK_OUTPUTS.ljust(70, b"\0"))
            self.send(
                mavlink.MAVLink_serial_control_message(_SHELL, _SHELL_FLAGS, 0, 0, len(_ASK_OUTPUTS), data)
            )

    def _command(self, number: int, *values: float) -> None:
        padded = [*values, *[0.0] * (7 - len(values))]
        self.send(mavlink.MAVLink_command_long_message(*self._target, number, 0, *padded))

    def _judge_outputs(self) -> None:
        """Look at one whole answer of the shell: outputs that move beside the simulated ones."""
        *answers, rest = _PROMPT.split(self._shell)
        self._shell = rest[-_READ:]
        found = _OUTPUTS.findall(answers[-1]) if answers else []
        if not found:
            return
        if not self.controls.armed:
            self._at_rest = found
            self.outputs_seen = len(found)
            return
        still = self._at_rest
        if sum(k >= len(still) or values != still[k] for k, values in enumerate(found)) > 1:
            self._command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, _FORCE)
            raise Px4LostError(
                "outputs of the flight controller beside the simulated ones move: told it to disarm; set "
                "PWM_MAIN_FUNC1 to 8 and UAVCAN_ENABLE to 0 (docs/hitl.md)"
            )

    def _judge_gap(self, gap_s: float, in_flight: bool) -> None:
        self.longest_gap_s = max(self.longest_gap_s, gap_s)
        if in_flight and gap_s > GAP_S:
            raise Px4LostError(
                f"flight controller without simulated sensors for {gap_s * 1e3:.0f} ms: its estimate does "
                "not survive that (its port, or a computer that is too busy)"
            )

    def send(self, *messages: Any) -> None:
        """Send messages, each whole or not at all.

        Raises:
            Px4LostError: the port is gone.
        """
        try:
            for message in messages:
                if self._rest:
                    self._rest = self._rest[self._port.write(self._rest) :]
                data = b"" if self._rest else message.pack(self._pack)
                self._pack.seq = (self._pack.seq + 1) % 256
                taken = self._port.write(data) if data else 0
                self._rest = data[taken:] if taken else self._rest
                self.sent += bool(taken)
                self.dropped += not taken
        except OSError as error:
            raise Px4LostError(f"port to the flight controller is gone ({error.strerror})") from None

    def receive(self) -> None:
        """Take what has arrived.

        Raises:
            Px4LostError: as `exchange`.
        """
        try:
            data = self._port.read()
        except OSError as error:
            raise Px4LostError(f"port to the flight controller is gone ({error.strerror})") from None
        with contextlib.suppress(mavlink.MAVError, struct.error):
            for message in (self._parser.parse_buffer(data) or []) if data else []:
                kind = message.get_type()
                if kind == "SERIAL_CONTROL":
                    self._shell += bytes(message.data[: message.count]).decode("ascii", "replace")
                elif kind == "HIL_ACTUATOR_CONTROLS":
                    self._target = (message.get_srcSystem(), message.get_srcComponent())
                    before, armed = self.controls, bool(message.mode & ARMED)
                    self.controls = Controls(message.time_usec, armed, tuple(message.controls))
                    if self.answered:
                        self._judge_gap((message.time_usec - before.time_us) * 1e-6, armed and before.armed)
                    self._heard_s, self.answered = time.monotonic(), True
        if "output:" in self._shell:
            self._judge_outputs()

    def close(self) -> None:
        """Let go of the port."""
        with contextlib.suppress(OSError):
            self._port.close()
