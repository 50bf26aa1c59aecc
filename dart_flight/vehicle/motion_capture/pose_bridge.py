"""The bridge from a pose source: every pose goes to the core, selected poses go to PX4 as ODOMETRY."""

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
from dart_flight.vehicle.motion_capture.pose_statistics import ShortestOffset
from dart_flight.vehicle.motion_capture.source import PoseSource, RawPose, checked_pose, open_source

_LOCAL_NED: Final = 1  # MAV_FRAME
_BODY_FRD: Final = 12  # MAV_FRAME of the velocities, which are not sent
_VISION: Final = 2  # MAV_ESTIMATOR_TYPE; PX4's EKF2 ignores the MOCAP type
_POSITION_SD_M: Final = 0.01  # PX4 uses EKF2_EVP_NOISE if that parameter is larger
_ANGLE_SD_RAD: Final = 0.01
_EARLY: Final = 0.125  # because of jitter, a frame may be early by this fraction of a period
_STALE_US: Final = 300_000  # minimum age of a stale frame; longer than any latency with which PX4 can fly
_JUMPED_US: Final = 1_000_000  # duration of stale frames that proves a clock jump; a delayed burst is shorter
_FINE_US: Final = 100_000  # maximum difference between successive stamps for the stamps to be usable
_DECIDE_US, _DECIDE_FRAMES, _DECIDE_NEW = 500_000, 10, 3  # minimum data before stamps are rejected
_SILENT_US, _MISSING_US = 1_000_000, 3_000_000  # time without a pose until `problem` and `missing` name it
_DIAGONAL: Final = (0, 6, 11, 15, 18, 20)  # indices in the upper triangle of a 6 x 6 matrix


def _covariance() -> list[float]:
    values = [0.0] * 21
    for place, index in enumerate(_DIAGONAL):
        values[index] = (_POSITION_SD_M if place < 3 else _ANGLE_SD_RAD) ** 2
    return values


_COVARIANCE: Final = _covariance()
_UNKNOWN: Final[Sequence[float | None]] = [None] * 21
_NO_ATTITUDE: Final[Sequence[float | None]] = [None] * 4


def odometry(t_us: int, position_ned: Vec3, q_frd_to_ned: Quaternion | None) -> MavlinkMessage:
    """Return the ODOMETRY message of a pose.

    Null fields arrive at PX4 as NaN, and PX4 does not fuse NaN. Without an attitude, PX4 still fuses the
    position, and PX4's heading follows from the gyro alone.

    The reset counter stays 0. If it changed, PX4's estimate would immediately follow a jump in the poses.
    """
    x, y, z = position_ned
    fields = {
        "time_usec": t_us,
        "frame_id": _LOCAL_NED,
        "child_frame_id": _BODY_FRD,
        "x": x,
        "y": y,
        "z": z,
        "q": q_frd_to_ned or _NO_ATTITUDE,
        **dict.fromkeys(("vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed")),
        "pose_covariance": _COVARIANCE,
        "velocity_covariance": _UNKNOWN,
        "reset_counter": 0,
        "estimator_type": _VISION,
        "quality": 100,
    }
    return MavlinkMessage("ODOMETRY", 0, 0, 0, 0, msgspec.json.encode(fields).decode())


class ForwardedPose(msgspec.Struct):
    """The pose in a message of `odometry`: position in local NED, metres, and attitude FRD to NED."""

    x: float
    y: float
    z: float
    q: tuple[float | None, float | None, float | None, float | None]

    @property
    def attitude(self) -> Quaternion | None:
        w, x, y, z = self.q
        return None if w is None or x is None or y is None or z is None else (w, x, y, z)


def forwarded_pose(message: Any) -> ForwardedPose:
    """Return the pose in a message of `odometry`; simulated worlds use this function."""
    fields: str = message.fields_json
    return msgspec.json.decode(fields, type=ForwardedPose)


class Decimation:
    """A selection of frames with a given mean rate, spaced as evenly as possible.

    All frames of a slower source are selected.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_us = round(1e6 / rate_hz)
        self._due_us: int | None = None

    def selects(self, t_us: int) -> bool:
        """Return whether to forward the frame with this stamp, on any clock."""
        period, due = self._period_us, self._due_us
        if due is not None and -2 * period < t_us - due < -_EARLY * period:
            return False
        # After a gap or a leap of the source's clock, restart the period at this frame.
        in_step = due is not None and abs(t_us - due) < period
        self._due_us = (due if due is not None and in_step else t_us) + period
        return True


class StaleFrames:
    """A filter of stale frames, which TCP delivers in one burst after an outage.

    PX4 stamps a pose by its arrival, so a stale pose would move PX4's estimate to a former position.
    """

    def __init__(self) -> None:
        self._shortest = ShortestOffset()
        self._since_us: int | None = None

    def contains(self, stamp_us: int, received_us: int) -> bool:
        """Return whether a frame arrives over 0.3 s older than the youngest frame so far.

        If all frames during one second are stale, the source's clock has jumped. The next frame then counts
        as fresh.
        """
        offset_us = received_us - stamp_us
        self._shortest.add(offset_us, received_us)
        if offset_us - self._shortest.least_us <= _STALE_US:
            self._since_us = None
            return False
        if self._since_us is None:
            self._since_us = received_us
        if received_us - self._since_us <= _JUMPED_US:
            return True
        self._shortest, self._since_us = ShortestOffset(), None
        return False


class Stamps:
    """The rule that decides whether a source's stamps are the times of its frames.

    The stamps are usable once two successive frames have stamps that differ by less than 0.1 s. The rule
    decides this before the vehicle takes off. If the stamps stop later, the poses count as lost.

    If the frames differ but no such pair arrives, the stamps are unusable: empty, whole seconds or frame
    numbers. The bridge then uses the time of arrival.

    Attributes:
        usable: whether the stamps are usable, or None if this is not decided yet.
        advanced_us: host time of receipt of the last frame with a new stamp or without a stamp.
    """

    def __init__(self) -> None:
        self.usable: bool | None = None
        self.advanced_us = 0
        self._last: RawPose | None = None
        self._first_us = 0
        self._frames = self._new = 0

    def filtered(self, pose: RawPose, received_us: int) -> RawPose:
        """Return a pose, without its stamp if the stamps are not usable."""
        before, self._last = self._last, pose
        if pose.source_us is None or self.usable is False:
            self.advanced_us = received_us
            return pose._replace(source_us=None)
        if before is None or before.source_us != pose.source_us:
            self.advanced_us = received_us
        if self.usable is None:
            self._decide(before, pose, received_us)
        return pose

    def _decide(self, before: RawPose | None, pose: RawPose, received_us: int) -> None:
        if before is None or before.source_us is None or pose.source_us is None:
            self._first_us = received_us
            return
        if 0 < pose.source_us - before.source_us < _FINE_US:
            self.usable = True
            return
        self._frames += 1
        self._new += before[1:4] != pose[1:4] or before.source_us != pose.source_us
        if received_us - self._first_us > _DECIDE_US and self._frames >= _DECIDE_FRAMES:
            self.usable = None if self._new < _DECIDE_NEW else False


class MotionCaptureBridge:
    """A forwarder of one source's poses to PX4, on the source's thread.

    Args:
        config: axes of the room and forwarding rate.
        source: source of the poses; `start` starts it.
        deliver: receives each pose, tracked or not, as an input of the core.

    Attributes:
        sent: number of forwarded poses.
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
        self._decimation, self._stale, self._stamps = Decimation(config.rate_hz), StaleFrames(), Stamps()
        self._lock = threading.Lock()
        self._stopped = self._withheld = self._attitude_withheld = False
        self._invalid: str | None = None  # reason why the newest frame contains no pose
        self._frame_us = self._good_us = 0  # host time of the newest frame, and of the newest usable pose
        self._newest: RawPose | None = None
        self.sent = 0

    @property
    def place(self) -> str:
        """The address on which the source listens, or the server that it reads."""
        return self._source.place

    @property
    def problem(self) -> str | None:
        """The reason why PX4 gets no poses, or None while PX4 gets poses."""
        now_us, newest = self._clock.host_us(), self._newest
        silent_us, poor_us = now_us - self._frame_us, now_us - self._good_us
        if self._source.problem is not None:
            return self._source.problem
        if silent_us > _SILENT_US:
            place, remedy = self._source.place, self._source.remedy
            return f"no frame for {1e-6 * silent_us:.0f} s ({place}): {remedy}"
        if self._invalid is not None or newest is None or poor_us <= _SILENT_US:
            return self._invalid
        if newest.tracked:
            return (
                f"the pose stamps have not changed for {1e-6 * poor_us:.0f} s: "
                "resume the recording, move the body, or send the poses without stamps"
            )
        return f'body "{newest.body}" not tracked for {1e-6 * poor_us:.0f} s: check markers and cameras'

    @property
    def missing(self) -> str | None:
        """The reason why no usable pose has arrived for 3 s, or None if a pose has arrived."""
        return self.problem if self._clock.host_us() - self._good_us > _MISSING_US else None

    def start(self) -> None:
        self._frame_us = self._good_us = self._clock.host_us()
        self._source.start(self.forward)

    def withhold(self, *, attitude_only: bool) -> None:
        """Stop sending poses (or only the attitudes) to PX4; the core still receives complete poses."""
        with self._lock:
            self._attitude_withheld = True
            self._withheld = self._withheld or not attitude_only

    def stop(self) -> None:
        """Stop forwarding and close the source."""
        with self._lock:  # send nothing more, because the caller closes the connection next
            self._stopped = True
        self._source.stop()

    def forward(self, raw: RawPose) -> None:
        """Deliver a pose; if its body is tracked and the pose is due and not stale, also send it to PX4."""
        received = self._clock.host_us()
        t_us = self._clock.to_autopilot(received)
        raw, self._invalid = checked_pose(raw)
        with self._lock:
            if self._stopped:
                return
            raw = self._stamps.filtered(raw, received)
            self._newest, self._frame_us = raw, received
            if raw.tracked and self._stamps.advanced_us == received:
                self._good_us = received
            stamp = raw.source_us if raw.source_us is not None else received
            stale = self._stale.contains(stamp, received)
            if raw.tracked and not (stale or self._withheld) and self._decimation.selects(stamp):
                position, attitude = self._room.pose_to_ned(raw.position_room, raw.q_body_to_room)
                self._send(odometry(t_us, position, None if self._attitude_withheld else attitude))
                self.sent += 1
        self._deliver(PoseSample(t_us, received, *raw))


@contextlib.contextmanager
def forwarding(
    config: MotionCapture,
    send: Callable[[MavlinkMessage], None],
    clock: Clock,
    deliver: Callable[[PoseSample], None],
    source: PoseSource | None = None,
) -> Iterator[MotionCaptureBridge | None]:
    """Forward the poses of `config.url` while the context is open; if the URL is None, yield None.

    `source` is the URL's source if the caller has already opened it. Raise InputError if the source cannot be
    opened.
    """
    if config.url is None:
        yield None
        return
    bridge = MotionCaptureBridge(config, source or open_source(config.url), send, clock, deliver)
    bridge.start()
    try:
        yield bridge
    finally:
        bridge.stop()
