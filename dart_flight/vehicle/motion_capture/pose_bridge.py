"""The bridge from a pose source to PX4: every pose is recorded, some are forwarded as ODOMETRY."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import msgspec
from mavsdk.plugins.mavlink_direct import MavlinkMessage

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.base.records import PoseSample
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.vehicle.clock import Clock
from dart_flight.vehicle.motion_capture.source import PoseSource, RawPose, open_source

_LOCAL_NED: Final = 1  # MAV_FRAME
_BODY_FRD: Final = 12  # of the velocities, which are not sent
_VISION: Final = 2  # MAV_ESTIMATOR_TYPE; PX4's EKF2 does not read what comes as MOCAP
_POSITION_SD_M: Final = 0.01  # PX4 uses EKF2_EVP_NOISE if that is larger
_ANGLE_SD_RAD: Final = 0.01
_EARLY: Final = 0.125  # of a period: a frame that jitter brought forward is still sent
_DIAGONAL: Final = (0, 6, 11, 15, 18, 20)  # of the upper triangle of a 6 x 6 matrix, by rows


def _covariance() -> list[float]:
    values = [0.0] * 21
    for place, index in enumerate(_DIAGONAL):
        values[index] = (_POSITION_SD_M if place < 3 else _ANGLE_SD_RAD) ** 2
    return values


_COVARIANCE: Final = _covariance()
_UNKNOWN: Final[Sequence[float | None]] = [None] * 21


def odometry(t_us: int, position_ned: Vec3, q_frd_to_ned: Quaternion) -> MavlinkMessage:
    """Return the ODOMETRY message of a pose; null velocities arrive as NaN, which PX4 does not fuse.

    The reset counter stays 0: with another one PX4's estimate would follow a jump of the poses at once.
    """
    x, y, z = position_ned
    fields = {
        "time_usec": t_us,
        "frame_id": _LOCAL_NED,
        "child_frame_id": _BODY_FRD,
        "x": x,
        "y": y,
        "z": z,
        "q": q_frd_to_ned,
        **dict.fromkeys(("vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed")),
        "pose_covariance": _COVARIANCE,
        "velocity_covariance": _UNKNOWN,
        "reset_counter": 0,
        "estimator_type": _VISION,
        "quality": 100,
    }
    return MavlinkMessage("ODOMETRY", 0, 0, 0, 0, msgspec.json.encode(fields).decode())


class ForwardedPose(msgspec.Struct):
    """The pose in a message of `odometry`: position in local NED, attitude FRD to NED."""

    x: float
    y: float
    z: float
    q: Quaternion


def forwarded_pose(message: Any) -> ForwardedPose:
    """Return the pose in a message of `odometry`, for a simulated world."""
    fields: str = message.fields_json
    return msgspec.json.decode(fields, type=ForwardedPose)


class Decimation:
    """Selection of frames at a mean rate, as even as the frames allow.

    Args:
        rate_hz: mean rate of the selected frames; slower sources pass whole.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_us = round(1e6 / rate_hz)
        self._due_us: int | None = None

    def selects(self, t_us: int) -> bool:
        """Return whether to forward the frame with this stamp, microseconds on any one clock."""
        period, due = self._period_us, self._due_us
        if due is not None and -2 * period < t_us - due < -_EARLY * period:
            return False
        # After a gap or a leap of the source's clock, count from this frame.
        in_step = due is not None and abs(t_us - due) < period
        self._due_us = (due if due is not None and in_step else t_us) + period
        return True


class MotionCaptureBridge:
    """Forwarder of one source's poses to PX4; its methods run on the source's thread.

    Args:
        config: axes of the room and the rate of forwarding.
        source: where the poses come from; `start` starts it.
        send: takes each message to PX4.
        clock: relates the host's time to PX4's.
        deliver: takes each pose, tracked or not, as an input of the core.

    Attributes:
        sent: number of poses forwarded.
    """

    def __init__(
        self,
        config: MotionCapture,
        source: PoseSource,
        send: Callable[[MavlinkMessage], None],
        clock: Clock,
        deliver: Callable[[PoseSample], None],
    ) -> None:
        self._source, self._send, self._clock, self._deliver = source, send, clock, deliver
        self._room = config.room_frame()
        self._decimation = Decimation(config.rate_hz)
        self._lock = threading.Lock()
        self._stopped = self._withheld = False
        self.sent = 0

    @property
    def problem(self) -> str | None:
        """Why no poses arrive; None while they do."""
        return self._source.problem

    def start(self) -> None:
        """Start the source, and forward its poses from now on."""
        self._source.start(self.forward)

    def withhold(self) -> None:
        """Send no pose to PX4 from now on; they are still delivered."""
        with self._lock:
            self._withheld = True

    def stop(self) -> None:
        """Stop forwarding and close the source."""
        with self._lock:  # nothing is sent over a connection that the caller closes next
            self._stopped = True
        self._source.stop()

    def forward(self, raw: RawPose) -> None:
        """Deliver a pose, and send it to PX4 if it is tracked and due."""
        received = self._clock.host_us()
        t_us = self._clock.to_autopilot(received)
        stamp = raw.source_us if raw.source_us is not None else received
        with self._lock:
            if self._stopped:
                return
            if raw.tracked and not self._withheld and self._decimation.selects(stamp):
                position, attitude = self._room.pose_to_ned(raw.position_room, raw.q_body_to_room)
                self._send(odometry(t_us, position, attitude))
                self.sent += 1
        self._deliver(PoseSample(t_us, received, *raw))


@contextlib.contextmanager
def forwarding(
    config: MotionCapture,
    send: Callable[[MavlinkMessage], None],
    clock: Clock,
    deliver: Callable[[PoseSample], None],
) -> Iterator[MotionCaptureBridge | None]:
    """Forward the poses of `config.url` while the context is open; yields None without a URL.

    Raises:
        InputError: on entering, if the source cannot be opened.
    """
    if config.url is None:
        yield None
        return
    bridge = MotionCaptureBridge(config, open_source(config.url), send, clock, deliver)
    bridge.start()
    try:
        yield bridge
    finally:
        bridge.stop()
