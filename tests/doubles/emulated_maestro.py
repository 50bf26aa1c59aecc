"""A Pololu Maestro behind a real pseudo-terminal, which parses the driver's bytes and moves a modelled servo.

It follows the controller's guide, not the driver. Bytes of 128 and above start a command, and smaller bytes
are its data. Anything else is a protocol error, which the controller keeps until the driver reads it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType

from dart_flight.config.vehicle import Servo
from dart_flight.lock.servo import NO_FAULTS, ServoFaults, ServoModel
from tests.doubles.scripted_peer import PlainBytes, PtyLink, ScriptedPeer

_DATA_BYTES = {0x84: 3, 0x87: 3, 0x89: 3, 0x90: 1, 0x93: 0, 0xA1: 0, 0xA2: 0}
_PROTOCOL_ERROR = 1 << 4
_TICK_US = 10_000  # the controller moves a limited pulse every 10 ms


class EmulatedMaestro:
    """The controller with the modelled servo on one channel; the driver opens the path `link`.

    Attributes:
        received: every received byte.
        limits_us: range of the channel, to which targets are clamped.
    """

    def __init__(
        self, servo: Servo, link: Path, clock_us: Callable[[], int], *, channel: int = 0, horn_us: float
    ) -> None:
        self.link, self.channel = link, channel
        self.received = bytearray()
        self.limits_us = (500.0, 2500.0)
        self._servo, self._clock_us = ServoModel(servo, horn_us), clock_us
        self._lock = threading.Lock()
        self._command, self._noise = bytearray(), list[bytes]()
        self._errors, self._mute = 0, False
        self._target_us: float | None = None
        self._output_us: float | None = None
        self._speed_us_s = 0.0
        self._output_at_us = clock_us()
        self._reset_at_us: int | None = None
        self._port: ScriptedPeer | None = None

    def __enter__(self) -> EmulatedMaestro:
        self.plug()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.unplug()

    # -- actions of a test --

    def plug(self) -> None:
        """Plug the cable in, so that the port appears."""
        port = PtyLink()
        self._command.clear()
        self.link.symlink_to(port.device)
        self._port = ScriptedPeer(port, PlainBytes(), {None: self._answer_bytes})
        self._port.__enter__()

    def unplug(self, *, power_too: bool = False) -> None:
        """Pull the cable, so that the port vanishes; with `power_too` also stop the pulses."""
        if self._port is None:
            return
        self.link.unlink()
        self._port.__exit__(None, None, None)
        self._port = None
        if power_too:
            self.restart()

    def restart(self) -> None:
        """Restart the controller as after a brown-out: no pulses, no speed limit."""
        with self._lock:
            self._advance()
            self._restart(self._clock_us())

    def restart_at(self, t_us: int | None) -> None:
        """Schedule a restart at a future time; None cancels it."""
        with self._lock:
            self._reset_at_us = t_us

    def set_servo_faults(self, faults: ServoFaults = NO_FAULTS) -> None:
        """Give the servo these faults from now on."""
        with self._lock:
            self._advance()
            self._servo.set_faults(self._clock_us(), faults)

    def set_errors(self, bits: int) -> None:
        """Raise error bits."""
        with self._lock:
            self._errors |= bits

    def add_noise(self, *bursts: bytes) -> None:
        """Send one burst of noise before each of the next answers."""
        with self._lock:
            self._noise += bursts

    def say(self, noise: bytes) -> None:
        """Send noise now."""
        if self._port is not None:
            self._port.send(noise)

    def mute(self, mute: bool = True) -> None:
        """Stop answering, as a controller that hangs."""
        with self._lock:
            self._mute = mute

    def horn_us(self) -> float:
        """Return the present position of the modelled horn, as a pulse width."""
        with self._lock:
            self._advance()
            return self._servo.pulse_at(self._clock_us())

    def output_us(self) -> float | None:
        """Return the pulse width of the output, or None without pulses."""
        with self._lock:
            self._advance()
            return self._output_us

    # -- the controller --

    def _answer_bytes(self, data: bytes) -> Iterator[bytes]:
        return filter(None, map(self._handle_byte, data))

    def _handle_byte(self, byte: int) -> bytes:
        with self._lock:
            self.received.append(byte)
            if byte >= 0x80:
                if self._command:
                    self._errors |= _PROTOCOL_ERROR
                self._command[:] = bytes((byte,))
            elif self._command:
                self._command.append(byte)
            else:
                self._errors |= _PROTOCOL_ERROR
                return b""
            code = self._command[0]
            if code not in _DATA_BYTES:
                self._errors |= _PROTOCOL_ERROR
                self._command.clear()
                return b""
            if len(self._command) <= _DATA_BYTES[code]:
                return b""
            data = bytes(self._command[1:])
            self._command.clear()
            self._advance()
            return self._answer(code, data)

    def _answer(self, code: int, data: bytes) -> bytes:
        answer = b""
        if code == 0xA1:
            answer, self._errors = self._errors.to_bytes(2, "little"), 0
        elif code == 0x93:
            answer = bytes((int(self._output_us != self._target_us),))
        elif code == 0x90 and data[0] == self.channel:
            answer = round((self._output_us or 0.0) * 4.0).to_bytes(2, "little")
        elif code in (0x84, 0x87) and data[0] == self.channel:
            value = data[1] | data[2] << 7
            if code == 0x87:
                self._speed_us_s = value * 25.0
            else:
                self._set_target(value / 4.0)
        elif data and data[0] != self.channel:
            self._errors |= _PROTOCOL_ERROR
        if self._mute or not answer:
            return b""
        return (self._noise.pop(0) if self._noise else b"") + answer

    def _set_target(self, pulse_us: float) -> None:
        low, high = self.limits_us
        self._target_us = None if pulse_us == 0.0 else max(low, min(high, pulse_us))
        if self._target_us is None or self._output_us is None or self._speed_us_s == 0.0:
            self._put_out(self._clock_us(), self._target_us)

    def _restart(self, t_us: int) -> None:
        self._target_us = None
        self._speed_us_s = 0.0
        self._errors = 0
        self._put_out(t_us, None)

    def _put_out(self, t_us: int, pulse_us: float | None) -> None:
        self._output_us = pulse_us
        self._output_at_us = t_us
        self._servo.command(t_us, pulse_us)

    def _advance(self) -> None:
        """Advance the ramp of the pulse to the present time, in the controller's ticks."""
        now = self._clock_us()
        if self._reset_at_us is not None and now >= self._reset_at_us:
            at, self._reset_at_us = self._reset_at_us, None
            self._ramp(at)
            self._restart(at)
        self._ramp(now)

    def _ramp(self, until_us: int) -> None:
        step = self._speed_us_s * _TICK_US * 1e-6
        while self._output_us is not None and self._target_us is not None:
            remaining = self._target_us - self._output_us
            if remaining == 0.0 or self._output_at_us + _TICK_US > until_us:
                break
            self._put_out(self._output_at_us + _TICK_US, self._output_us + max(-step, min(step, remaining)))
        if self._output_us == self._target_us:
            self._output_at_us = until_us
