"""A vehicle on the bench behind a serial port, which a test tilts, pushes and carries as if by hand.

It speaks the embedded autopilot's MAVLink on a real pseudo-terminal. If the program sets another baud rate
than the flight controller's, the port carries noise. `wrong` names the vehicle's defects.
"""

from __future__ import annotations

import contextlib
import math
import os
import pty
import random
import socket
import termios
import time
import tty
from collections.abc import Callable, Collection

from pymavlink.dialects.v20 import common as mavlink

from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    Quaternion,
    Vec3,
    quaternion_conjugate,
    quaternion_from_euler,
    quaternion_multiply,
    rotate_back,
)
from dart_flight.base.records import FlightMode
from dart_flight.base.thread_context import ThreadContext
from dart_flight.config.mission import Mission
from dart_flight.sim.embedded_autopilot import TICK_S, ImuReading, make_autopilot
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint

BAUD = 921600
_NOISE_M_S2 = 0.05
_PUSH_M_S2, _PUSH_S = 6.0, 0.15
_CARRY_M, _CARRY_S = 0.6, 1.0
_BUFFER = 65536
_POSE_EVERY = 4  # ticks
YAW_RAD = math.radians(35.0)  # an arbitrary heading


Motion = Callable[[float], tuple[Vec3, Quaternion]]


def move_by_hand(motion: Motion, t: float) -> tuple[Vec3, Quaternion, Vec3, Vec3]:
    """Return position, attitude, specific force and rate (FRD), the last two by central differences."""
    h = 1e-3
    (p0, q0), (p1, q1), (p2, q2) = (motion(t + k * h) for k in (-1.0, 0.0, 1.0))
    ax, ay, az = ((a - 2.0 * b + c) / h**2 for a, b, c in zip(p0, p1, p2, strict=True))
    force = rotate_back(q1, (ax, ay, az - GRAVITY_M_S2))
    _, x, y, z = quaternion_multiply(quaternion_conjugate(q0), q2)
    return p1, q1, force, (x / h, y / h, z / h)


class BenchVehicle(ThreadContext):
    """`with BenchVehicle(mission) as vehicle: bringup --connection vehicle.url`.

    Args:
        mission: mission with the vehicle.
        wrong: defects: `axes` (IMU rotated by 90 degrees), `frame` (motion capture in east, north, up),
            `radio` (remote control off).
        motion: position (NED) and attitude as functions of the time since `move`, for a motion by hand.
        publish: receives time (microseconds), position and attitude at every fourth tick of a motion.
    """

    def __init__(
        self,
        mission: Mission,
        wrong: Collection[str] = (),
        motion: Motion | None = None,
        publish: Callable[[int, Vec3, Quaternion], None] = lambda t_us, position, q: None,
    ) -> None:
        self._wrong = set(wrong)
        self._motion, self._publish = motion, publish
        self._move_s: float | None = None
        self._autopilot = make_autopilot(mission, 1)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._endpoint = MavlinkEndpoint(self._autopilot, (self._socket.getsockname()[1],))
        if "radio" in self._wrong:
            self._endpoint.stopped.add(mavlink.MAVLINK_MSG_ID_RC_CHANNELS)
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self._device = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self._noise = random.Random(1)
        super().__init__()
        self._out = bytearray()
        self._roll = self._pitch = 0.0
        self._position = [0.0, 0.0]
        self._push_s: float | None = None
        self._carry: tuple[float, tuple[float, float], tuple[float, float]] | None = None

    @property
    def url(self) -> str:
        """The connection URL of the vehicle."""
        return f"serial://{self._device}:{BAUD}"

    def _close(self) -> None:
        self._endpoint.close()
        self._socket.close()
        os.close(self._master)

    # -- handling --

    def tilt(self, *, roll_deg: float = 0.0, pitch_deg: float = 0.0) -> None:
        """Hold the vehicle at this attitude from now on."""
        self._roll, self._pitch = math.radians(roll_deg), math.radians(pitch_deg)

    def push(self) -> None:
        """Push the vehicle forward, and catch it."""
        self._push_s = self._autopilot.now_s

    def carry(self, direction_deg: float) -> None:
        """Carry the vehicle in a direction, clockwise from its nose."""
        heading = YAW_RAD + math.radians(direction_deg)
        path = (_CARRY_M * math.cos(heading), _CARRY_M * math.sin(heading))
        self._carry = (self._autopilot.now_s, (self._position[0], self._position[1]), path)

    def move(self) -> None:
        """Start the motion by hand, which `motion` defines."""
        self._move_s = self._autopilot.now_s

    def flip_switch(self) -> None:
        """Toggle the mode switch of the remote control."""
        manual = self._autopilot.mode is FlightMode.MANUAL
        self._autopilot.mode = FlightMode.HOLD if manual else FlightMode.MANUAL

    # -- simulation --

    def _run(self) -> None:
        ticks, due_s = 0, time.monotonic()
        while not self._stop.is_set():
            ticks += 1
            due_s += TICK_S
            self._advance(ticks)
            self._endpoint.exchange()
            self._exchange_bytes()
            time.sleep(max(0.0, due_s - time.monotonic()))

    def _advance(self, ticks: int) -> None:
        a = self._autopilot
        a.plant.time_s = ticks * TICK_S
        q = quaternion_from_euler(self._roll, self._pitch, YAW_RAD)
        velocity = self._carry_on()
        up = rotate_back(q, (0.0, 0.0, -GRAVITY_M_S2))
        pushed = self._pushed_m_s2()
        force: Vec3 = (up[0] + pushed, up[1], up[2])
        if "axes" in self._wrong:
            force = (-force[1], force[0], force[2])
        x, y, z = (f + self._noise.gauss(0.0, _NOISE_M_S2) for f in force)
        a.imu = ImuReading(a.time_us, (x, y, z), (0.0, 0.0, 0.0))
        e = a.estimator
        if self._motion is not None:
            e.ok = True
            since_s = 0.0 if self._move_s is None else a.now_s - self._move_s
            e.position, e.q, force, rate = move_by_hand(self._motion, since_s)
            a.imu = ImuReading(a.time_us, force, rate)
            if ticks % _POSE_EVERY == 0:
                self._publish(a.time_us, e.position, e.q)
            return
        n, east = self._position
        vn, ve = velocity
        e.q, e.ok = q, True
        swapped = "frame" in self._wrong
        e.position = (east, n, 0.0) if swapped else (n, east, 0.0)
        e.velocity = (ve, vn, 0.0) if swapped else (vn, ve, 0.0)

    def _pushed_m_s2(self) -> float:
        if self._push_s is None:
            return 0.0
        since_s = self._autopilot.now_s - self._push_s
        if since_s > 2.0 * _PUSH_S:
            self._push_s = None
            return 0.0
        return _PUSH_M_S2 if since_s < _PUSH_S else -_PUSH_M_S2

    def _carry_on(self) -> tuple[float, float]:
        """Update the carried position and return its velocity."""
        if self._carry is None:
            return (0.0, 0.0)
        begun_s, start, path = self._carry
        share = min(1.0, (self._autopilot.now_s - begun_s) / _CARRY_S)
        self._position = [start[0] + share * path[0], start[1] + share * path[1]]
        if share >= 1.0:
            self._carry = None
            return (0.0, 0.0)
        return (path[0] / _CARRY_S, path[1] / _CARRY_S)

    def _exchange_bytes(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                self._write(self._socket.recv(65536))
        with contextlib.suppress(OSError):  # no data, or no program has the port open
            data = os.read(self._master, 65536)
            if self._rate_is_right():
                self._socket.sendto(data, self._endpoint.links[0].socket.getsockname())

    def _write(self, data: bytes) -> None:
        if not self._rate_is_right():
            data = self._noise.randbytes(max(1, len(data) // 3))
        self._out += data
        with contextlib.suppress(OSError):
            del self._out[: os.write(self._master, self._out)]
        if len(self._out) > _BUFFER:
            self._out.clear()  # no program reads

    def _rate_is_right(self) -> bool:
        return bool(termios.tcgetattr(self._master)[5] == termios.B921600)
