"""Detection of MAVLink and its baud rate on a serial port, used if no autopilot answers on the port.

At a wrong rate, bytes arrive but contain no frames. A frame begins with 0xFD and contains its own length, so
the beginning of the next frame is known. The probability that noise looks like three consecutive frames is 1
in 10^7.
"""

from __future__ import annotations

import os
import termios
import time

import msgspec

USUAL_BAUDS = (57600, 115200, 230400, 460800, 500000, 921600, 1000000, 1500000, 2000000)
_START, _HEADER, _CHECKSUM, _SIGNATURE = 0xFD, 10, 2, 13
_IN_A_ROW = 3
_LISTEN_S = 0.6
_SPEED = 4, 5  # indices of input and output speed in the termios list


_CONSOLE_BAUDS = (115200, 57600)  # usual rates of login consoles and of PX4's shell


class PortFinding(msgspec.Struct, frozen=True):
    """The data received on a serial port.

    Attributes:
        received: number of bytes received at the requested rate.
        baud: rate at which MAVLink arrives, or None if it arrives at none of the usual rates.
        console: a console's answer to an empty line, such as `login:`.
    """

    received: int
    baud: int | None
    console: str = ""


def listen_for_mavlink(device: str, baud: int) -> PortFinding:
    """Listen for MAVLink at `baud`, then at the other usual rates, 0.6 s each.

    If there is no MAVLink, check whether a console answers. Raise OSError if the port cannot be opened.
    """
    port = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        heard = _listen(port, baud)
        if has_frames(heard):
            return PortFinding(len(heard), baud)
        if heard:
            for other in USUAL_BAUDS:
                if other != baud and has_frames(_listen(port, other)):
                    return PortFinding(len(heard), other)
        for rate in dict.fromkeys((baud, *_CONSOLE_BAUDS)):
            console = console_line(_listen(port, rate, b"\r"))
            if console:
                return PortFinding(len(heard), None, console)
        return PortFinding(len(heard), None)
    finally:
        os.close(port)


def console_line(data: bytes) -> str:
    """Return the last line of a console's answer, or an empty string for noise or no answer."""
    text = data.decode("ascii", "replace").replace("\x1b[K", "")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if not lines or sum(c.isprintable() and c.isascii() for c in lines[-1]) < len(lines[-1]):
        return ""
    return lines[-1][:40]


def has_frames(data: bytes) -> bool:
    """Return whether the data contains three consecutive MAVLink 2 frames."""
    for first in range(len(data)):
        at, count = first, 0
        while at + 2 < len(data) and data[at] == _START:
            at += _HEADER + data[at + 1] + _CHECKSUM + (_SIGNATURE if data[at + 2] & 1 else 0)
            count += at <= len(data)
            if count == _IN_A_ROW:
                return True
    return False


def _listen(port: int, baud: int, sent: bytes = b"") -> bytes:
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        return b""
    settings = termios.tcgetattr(port)
    settings[0] = settings[1] = settings[3] = 0  # raw mode: the port neither translates nor echoes bytes
    settings[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
    for k in _SPEED:
        settings[k] = speed
    termios.tcsetattr(port, termios.TCSANOW, settings)
    termios.tcflush(port, termios.TCIFLUSH)
    if sent:
        os.write(port, sent)
    data, end_s = b"", time.monotonic() + _LISTEN_S
    while time.monotonic() < end_s:
        try:
            data += os.read(port, 4096)
        except BlockingIOError:
            time.sleep(0.01)
    return data
