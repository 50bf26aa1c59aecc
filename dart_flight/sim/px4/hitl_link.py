"""The plant's end of the link to a flight controller in hardware-in-the-loop mode: HIL over USB or UDP.

There is no lockstep. PX4 uses its own clock and stamps every HIL_SENSOR, ODOMETRY and HIL_GPS on arrival
(v1.14 to v1.18), because this link does not answer PX4's TIMESYNC. The time of sending therefore acts as the
stamp. The link and the world follow these rules:

- Missed ticks are not sent later in a burst, because PX4 would treat a burst as one sample of 20 ms and
  several samples of zero duration. All missed ticks together give one message with the mean of their samples
  (`Px4Vehicle.step`).
- A message that the port does not accept is dropped as a whole and counted.
- After a lost HIL_ACTUATOR_CONTROLS the motors keep their last values, as ESCs do after a lost frame.
- A gap of more than about 75 ms in HIL_SENSOR (measured on v1.18) shifts PX4's estimate of the vertical
  velocity by g times the duration of the gap, and the vehicle descends to the ground. In flight such a gap
  ends the simulation, and the gap is reported as the cause. The link detects a gap from its times of sending
  and from PX4's own stamps. A delay in the receipt of PX4's outputs is harmless.

Since v1.18, PX4 no longer disables the real outputs in this mode. To verify that the motors stay off, the
link queries PX4's outputs through PX4's shell: only the simulated outputs may change.
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

SILENCE_S = 1.0  # time without outputs (200 Hz) after which a flight controller counts as lost
GAP_S = 0.07  # limit of the gap between two samples in flight: PX4 tolerates 50 ms, but not 75 ms
_READ = 65536
# A companion computer's ids, because the loss of a ground station would trigger a failsafe.
_SYSTEM, _COMPONENT = 1, 191
_HEARTBEAT_S = 1.0  # period of heartbeats, which also make a board start MAVLink on its USB port
_CONTROLS_US = 4000  # interval of the outputs: one per HIL_SENSOR, instead of PX4's 200 Hz
_QUERY_OUTPUTS_S = 1.0
_FORCE = 21196.0  # magic value: disarm even in the air
_SHELL, _SHELL_FLAGS = 10, 2 | 4 | 16  # SERIAL_CONTROL: device, and respond, exclusive, multi
_QUERY_OUTPUTS = b"listener actuator_outputs -n 1\n"
_PROMPT = re.compile("pxh>|nsh>")
_OUTPUTS = re.compile(r"output: \[([^\]]*)\]")


class HitlPort(Protocol):
    """Byte stream to and from a flight controller; no call blocks."""

    def read(self) -> bytes:
        """Return the received data; raise OSError if the port is gone."""

    def write(self, data: bytes) -> int:
        """Return the number of accepted bytes; raise OSError if the port is gone."""

    def close(self) -> None:
        """Release the port."""


class SerialPort:
    """A serial device in raw mode; a USB port ignores the baud rate."""

    def __init__(self, device: str, baud: int) -> None:
        self._serial = serial.Serial(device, baud, timeout=0.0)
        self._fd = self._serial.fileno()
        os.set_blocking(self._fd, False)

    def read(self) -> bytes:
        try:
            return os.read(self._fd, _READ)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> int:
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        self._serial.close()


class UdpPort:
    """A UDP socket: `udpin` listens and answers the last sender, `udpout` sends first."""

    def __init__(self, address: LinkAddress) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._to: tuple[str, int] | None = None
        if address.kind == "udpout":
            self._to = (address.place, address.number)
        else:
            self._socket.bind((address.place, address.number))

    def read(self) -> bytes:
        data = b""
        with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
            while True:
                part, self._to = self._socket.recvfrom(_READ)
                data += part
        return data

    def write(self, data: bytes) -> int:
        """Send the datagram completely or not at all."""
        if self._to is None:
            return 0
        try:
            return self._socket.sendto(data, self._to)
        except (BlockingIOError, ConnectionRefusedError):
            return 0

    def close(self) -> None:
        self._socket.close()


def open_port(url: str) -> HitlPort:
    """Open a serial or UDP port; raise InputError if it cannot be opened or is of another kind."""
    address = parse_link(url)
    if address is None or address.kind not in ("serial", "udpin", "udpout"):
        raise InputError(
            f"{url!r}: allowed are serial:///dev/ttyACM0:921600, udpin://HOST:PORT, udpout://HOST:PORT",
            key=("--hitl",),
        )
    try:
        return SerialPort(address.place, address.number) if address.kind == "serial" else UdpPort(address)
    except (OSError, ValueError) as error:
        # pyserial wraps the system's message in its own; the last part is the reason.
        code = getattr(error, "errno", None)
        reason = os.strerror(code) if code else str(error)
        busy = " (is QGroundControl connected to this port?)" if code in (errno.EBUSY, errno.EAGAIN) else ""
        raise InputError(f"cannot open {url}: {reason}{busy}", key=("--hitl",)) from None


class HitlLink:
    """The link that sends the plant's measurements and stores the flight controller's outputs.

    Attributes:
        controls: last actuator outputs.
        answered: whether any actuator outputs have arrived.
        sent, dropped: number of accepted messages, and number of messages that the port did not accept.
        outputs_seen: number of output drivers that PX4 reports, including the simulated one; 0 before the
            first report.
        longest_gap_s: longest gap between two ticks that the port accepted, or between the stamps of two
            messages with actuator outputs. PX4 sends such messages at least every 50 ms.
    """

    def __init__(self, port: HitlPort) -> None:
        self._port = port
        self._pack = mavlink.MAVLink(None, srcSystem=_SYSTEM, srcComponent=_COMPONENT)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._rest = b""  # remainder of a partly accepted message
        self.controls = Controls(0, False, (0.0,) * 16)
        self.answered = False
        self.sent = self.dropped = 0
        self.outputs_seen = 0
        self.longest_gap_s = 0.0
        self._received_s = self._fed_s = time.monotonic()
        self._beat_s = self._queried_s = 0.0
        self._target = (1, 1)  # system and component of the flight controller
        self._shell = ""
        self._at_rest: list[str] = []  # outputs of each kind while disarmed, as text from PX4

    @property
    def silent_s(self) -> float:
        """Time without actuator outputs."""
        return time.monotonic() - self._received_s

    def exchange(self, sensor: Any, *others: Any) -> Controls:
        """Send one tick's messages, process the received data, and return the newest actuator outputs.

        Raises:
            Px4LostError: the port is gone, no actuator outputs have arrived for `SILENCE_S`, a gap in flight
                has exceeded `GAP_S`, or a real output changes. If a real output changes, this method also
                disarms the flight controller.
        """
        dropped = self.dropped
        self.send(*others, sensor)
        if self.dropped == dropped:
            now_s = time.monotonic()
            if self.answered:
                self._check_gap(now_s - self._fed_s, self.controls.armed)
            self._fed_s = now_s
        self._send_periodic()
        self.receive()
        if self.answered and self.silent_s > SILENCE_S:
            raise Px4LostError(f"the flight controller has sent no actuator outputs for {SILENCE_S:g} s")
        return self.controls

    def _send_periodic(self) -> None:
        """Send a heartbeat and queries of the outputs when they are due."""
        now_s = time.monotonic()
        if now_s - self._beat_s >= _HEARTBEAT_S:
            self._beat_s = now_s
            self.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4, 3))
        if self.answered and now_s - self._queried_s >= _QUERY_OUTPUTS_S:
            if not self._queried_s:
                wanted = (mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS, _CONTROLS_US)
                self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, *wanted)
            self._queried_s = now_s
            data = list(_QUERY_OUTPUTS.ljust(70, b"\0"))
            self.send(
                mavlink.MAVLink_serial_control_message(_SHELL, _SHELL_FLAGS, 0, 0, len(_QUERY_OUTPUTS), data)
            )

    def _command(self, number: int, *values: float) -> None:
        padded = [*values, *[0.0] * (7 - len(values))]
        self.send(mavlink.MAVLink_command_long_message(*self._target, number, 0, *padded))

    def _check_outputs(self) -> None:
        """Evaluate a complete answer of the shell: only the simulated outputs may change."""
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
                "the flight controller is driving real outputs and was commanded to disarm: "
                "set PWM_MAIN_FUNC1 to 8 and UAVCAN_ENABLE to 0 (docs/hitl.md)"
            )

    def _check_gap(self, gap_s: float, in_flight: bool) -> None:
        self.longest_gap_s = max(self.longest_gap_s, gap_s)
        if in_flight and gap_s > GAP_S:
            raise Px4LostError(
                f"the flight controller was without simulated sensors for {gap_s * 1e3:.0f} ms and "
                "has lost its estimate: check the port and the load of this computer"
            )

    def send(self, *messages: Any) -> None:
        """Send messages, each completely or not at all; raise Px4LostError if the port is gone."""
        try:
            for message in messages:
                if self._rest:
                    self._rest = self._rest[self._port.write(self._rest) :]
                data = b"" if self._rest else message.pack(self._pack)
                self._pack.seq = (self._pack.seq + 1) % 256
                accepted = self._port.write(data) if data else 0
                self._rest = data[accepted:] if accepted else self._rest
                self.sent += bool(accepted)
                self.dropped += not accepted
        except OSError as error:
            raise Px4LostError(f"lost the port to the flight controller ({error.strerror})") from None

    def receive(self) -> None:
        """Process the received data; raise Px4LostError as `exchange` does."""
        try:
            data = self._port.read()
        except OSError as error:
            raise Px4LostError(f"lost the port to the flight controller ({error.strerror})") from None
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
                        self._check_gap((message.time_usec - before.time_us) * 1e-6, armed and before.armed)
                    self._received_s, self.answered = time.monotonic(), True
        if "output:" in self._shell:
            self._check_outputs()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._port.close()
