"""Pololu Maestro serial servo controller, compact protocol (Maestro User's Guide, section 5.e).

    Set Target   0x84 channel low7 high7     quarter-microseconds; 0 stops the pulses
    Set Speed    0x87 channel low7 high7     0.25 us per 10 ms, that is 25 us/s; 0: no limit
    Get Position 0x90 channel                -> two bytes, little-endian, quarter-microseconds; 0: no pulses
    Get Errors   0xA1                        -> two bytes, little-endian; reading clears them

The protocol without checksum has no protection against noise. Every query is therefore sent twice. The driver
accepts an answer only if the two answers match and no more bytes arrive. A command counts as executed if
the controller reports no serial error after the command. This is the only file that imports pyserial.
"""

from __future__ import annotations

import os
import termios

import serial

from dart_flight.config.link_url import device_key
from dart_flight.config.vehicle import LockConfig
from dart_flight.lock.drivers import DriverError
from dart_flight.lock.persistence import ServoDevice
from dart_flight.lock.state_machine import DriverReading

SET_TARGET, SET_SPEED, GET_POSITION, GET_ERRORS = 0x84, 0x87, 0x90, 0xA1
QUARTERS_PER_US = 4
SPEED_UNIT_US_S = 25.0

ERRORS = (
    "serial signal error",
    "serial overrun error",
    "serial buffer full",
    "serial CRC error",
    "serial protocol error",
    "serial time-out",
    "script stack error",
    "script call stack error",
    "script program counter error",
)
SERIAL_ERRORS = 0b0011_1111  # serial errors that may have lost a command

_ATTEMPTS = 3
_MAX_POSITION = 4095 * QUARTERS_PER_US  # longest servo pulse
_MAX_RAMP_BETWEEN = 16 * QUARTERS_PER_US  # a moving position changes by at most this much between two queries


def error_names(bits: int) -> tuple[str, ...]:
    return tuple(name for i, name in enumerate(ERRORS) if bits & (1 << i))


class MaestroDriver:
    """One channel of a Maestro. After a failure the port is closed; the next call opens it again."""

    def __init__(self, config: LockConfig) -> None:
        self._config = config.maestro
        self._port: serial.Serial | None = None

    def device(self) -> ServoDevice:
        """Return the serial port, which only one process can open, even if the channels differ."""
        return ServoDevice(device_key(self._config.port), self._config.port)

    def open(self) -> None:
        """Open the port and set the channel's speed limit.

        Raises:
            DriverError: no Maestro answers, or the port cannot be opened. If the port cannot be opened, the
                error's `key` is the configuration key of the port.
        """
        if self._port is not None:
            return
        name = self._config.port
        key = ("maestro", "port")
        if not os.path.exists(name):
            raise DriverError(f"{name} does not exist; plug the servo controller in", key)
        if not os.access(name, os.R_OK | os.W_OK):
            raise DriverError(f"{name} is not writable; add the user to the dialout group", key)
        try:
            self._port = serial.Serial(
                name,
                self._config.baud,
                timeout=self._config.reply_timeout_s,
                write_timeout=self._config.reply_timeout_s,
                exclusive=True,
            )
        except (OSError, ValueError, termios.error) as error:
            # pyserial's SerialException is an OSError; its message already names the port.
            raise DriverError(f"cannot open {name}: {_short_message(error)}", key) from None
        self._query_errors()  # this query clears old errors and shows that a Maestro answers
        speed = round(self._config.speed_limit_us_s / SPEED_UNIT_US_S)
        self._command(SET_SPEED, speed)

    def set_pulse(self, pulse_us: float) -> None:
        """Output this pulse width in us; if a speed limit is set, the controller ramps to this width."""
        self._command(SET_TARGET, round(pulse_us * QUARTERS_PER_US))

    def release(self) -> None:
        self._command(SET_TARGET, 0)

    def read(self) -> DriverReading:
        self.open()
        position = self._query_position()
        bits = self._query_errors()
        return DriverReading(
            pulse_us=None if position == 0 else position / QUARTERS_PER_US, errors=error_names(bits)
        )

    def close(self) -> None:
        """Close the port; the controller keeps its pulses."""
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except OSError:
                # pyserial raises if the device is gone; the port counts as closed anyway.
                return

    # -- the line --

    def _command(self, code: int, value: int) -> None:
        """Send a command, up to `_ATTEMPTS` times, until the controller reports no serial error."""
        self.open()
        message = bytes((code, self._config.channel, value & 0x7F, (value >> 7) & 0x7F))
        problem = "the port accepts no bytes"
        for _ in range(_ATTEMPTS):
            if self._write(message) is None:
                continue
            bits = self._query_errors()
            if not bits & SERIAL_ERRORS:
                return
            problem = f"the controller reports {', '.join(error_names(bits))}"
        raise self._connection_error(problem)

    def _query_position(self) -> int:
        query = bytes((GET_POSITION, self._config.channel))
        for _ in range(_ATTEMPTS):
            answer = self._query(query * 2, 4)
            if answer is None:
                continue
            first, second = (int.from_bytes(answer[i : i + 2], "little") for i in (0, 2))
            plausible = max(first, second) <= _MAX_POSITION and (first == 0) == (second == 0)
            if plausible and abs(first - second) <= _MAX_RAMP_BETWEEN:
                return second
        raise self._connection_error("the controller gave no valid answer to the position query")

    def _query_errors(self) -> int:
        """Query the error bits twice and return the first answer, because answering clears the bits.

        The second answer must not contain bits that the first answer lacks.
        """
        for _ in range(_ATTEMPTS):
            answer = self._query(bytes((GET_ERRORS,)) * 2, 4)
            if answer is None:
                continue
            first, second = (int.from_bytes(answer[i : i + 2], "little") for i in (0, 2))
            if max(first, second) < 1 << len(ERRORS) and second & ~first == 0:
                return first
        raise self._connection_error("the controller gave no valid answer to the error query")

    def _query(self, query: bytes, size: int) -> bytes | None:
        """Return the answer to a query, or None if the answer is too short or more bytes follow."""
        port = self._write(query, clear=True)
        if port is None:
            return None
        try:
            answer = bytes(port.read(size))
            left_over = port.in_waiting
        except (OSError, termios.error, TypeError) as error:
            # pyserial raises TypeError after the descriptor is gone.
            raise self._connection_error(_short_message(error)) from None
        return answer if len(answer) == size and not left_over else None

    def _write(self, message: bytes, *, clear: bool = False) -> serial.Serial | None:
        """Write a message and return the port, or None if it is unknown whether the message was written.

        pyserial reports a timeout also if a busy computer has suspended this thread after the write.
        """
        port = self._port
        if port is None:
            raise self._connection_error("not connected")
        try:
            if clear:
                port.reset_input_buffer()
            port.write(message)
        except serial.SerialTimeoutException:
            return None
        except (OSError, termios.error, TypeError) as error:
            raise self._connection_error(_short_message(error)) from None
        return port

    def _connection_error(self, why: str) -> DriverError:
        self.close()
        return DriverError(f"servo controller at {self._config.port}: {why}")


def _short_message(error: Exception) -> str:
    number = getattr(error, "errno", None)
    if isinstance(error, termios.error):
        number = error.args[0]
    return os.strerror(number) if isinstance(number, int) else str(error)
