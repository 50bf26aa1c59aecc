"""Statistics of a stream of poses: rate, gaps, age, and the deviation of PX4's estimate from the poses."""

from __future__ import annotations

import math
import statistics
import threading
from collections import deque
from typing import Final

import msgspec

from dart_flight.base.geometry import (
    Quaternion,
    RoomFrame,
    Vec3,
    norm,
    rotation_angle,
    subtract,
)
from dart_flight.base.records import AttitudeSample, Input, OdometrySample, PoseSample

GAP_US: Final = 100_000  # minimum duration of a gap; at 50 Hz, PX4 misses five poses in this time
_RATE_US: Final = 2_000_000  # time window for the rate and the senders
_BEST_S: Final = 60  # window for the shortest age; the clocks drift apart by only a few ms in it
_AGE_POSES: Final = 25  # the age is the median over this many poses
_FRESH_US: Final = 500_000  # maximum age of PX4's estimate for a comparison with the poses


class PoseFigures(msgspec.Struct, frozen=True):
    """The statistics of a stream of poses.

    A value is None if it is not known yet, or if the source does not allow its measurement.

    Attributes:
        rate_hz: tracked poses per second over the last 2 s.
        gaps: number of gaps of more than 0.1 s between tracked poses.
        longest_gap_s: longest time between two tracked poses, including a gap that has not ended.
        lost: fraction of frames in which the body is not tracked.
        age_ms: age of the newest poses: the measured shortest age (`mocap.delay_ms`) plus the additional
            delay that their stamps show.
        age_growth_ms: growth of the age since the first poses.
        distance_to_px4_m: distance of PX4's position from the newest pose.
        angle_to_px4_deg: angle between PX4's attitude and the attitude of the newest pose.
        senders: addresses that have sent poses in the last 2 s.
    """

    rate_hz: float = 0.0
    gaps: int = 0
    longest_gap_s: float = 0.0
    lost: float = 0.0
    age_ms: float | None = None
    age_growth_ms: float | None = None
    distance_to_px4_m: float | None = None
    angle_to_px4_deg: float | None = None
    senders: tuple[str, ...] = ()


class ShortestOffset:
    """The smallest offset (time of receipt minus stamp) of a source's frames.

    A larger offset means an older frame. The clocks of source and host drift apart, so only the last
    `_BEST_S` seconds with frames count.
    """

    def __init__(self) -> None:
        self._best_us: deque[int] = deque(maxlen=_BEST_S)  # smallest offset in each second of receipt
        self._second: int | None = None

    def add(self, offset_us: int, received_us: int) -> None:
        second = received_us // 1_000_000
        if second != self._second:
            self._second = second
            self._best_us.append(offset_us)
        elif offset_us < self._best_us[-1]:
            self._best_us[-1] = offset_us

    @property
    def least_us(self) -> int:
        """The smallest offset; at least one frame must have been added."""
        return min(self._best_us)


class PoseStatistics:
    """The statistics of one source's poses.

    Call `update` for every input in the order of receipt; any thread may call it.

    Args:
        delay_ms: measured shortest age of a pose (`mocap.delay_ms`).
    """

    def __init__(self, room: RoomFrame, delay_ms: float | None = None) -> None:
        self._room, self._delay_ms = room, delay_ms or 0.0
        self._lock = threading.Lock()  # poses and PX4's messages arrive on different threads
        self._poses = self._lost = self._gaps = 0
        self._tracked_us: deque[int] = deque()  # times of receipt within the window
        self._first_us: int | None = None
        self._longest_us = 0
        self._shortest = ShortestOffset()
        self._late_us: deque[int] = deque(maxlen=_AGE_POSES)
        self._first_late_ms: float | None = None
        self._senders: dict[str, int] = {}  # time of the newest receipt by sender
        self._pose: tuple[Vec3, Quaternion] | None = None
        self._odometry: OdometrySample | None = None
        self._attitude: AttitudeSample | None = None

    def update(self, record: Input) -> None:
        """Process a pose, or PX4's position or attitude; ignore other inputs."""
        if isinstance(record, PoseSample):
            with self._lock:
                self._add(record)
        elif isinstance(record, OdometrySample):
            self._odometry = record
        elif isinstance(record, AttitudeSample):
            self._attitude = record

    def _add(self, pose: PoseSample) -> None:
        now = pose.received_us
        self._poses += 1
        self._senders[pose.sender] = now
        if not pose.tracked:
            self._lost += 1
            return
        times = self._tracked_us
        if times:
            interval = now - times[-1]
            self._gaps += interval > GAP_US
            self._longest_us = max(self._longest_us, interval)
        if self._first_us is None:
            self._first_us = now
        times.append(now)
        while times[0] < now - _RATE_US:
            times.popleft()
        self._pose = self._room.pose_to_ned(pose.position_room, pose.q_body_to_room)
        if pose.source_us is not None:
            self._add_age(now - pose.source_us, now)
        elif self._late_us:  # the bridge has found the stamps unusable
            self._late_us.clear()
            self._first_late_ms = None

    def _add_age(self, offset_us: int, received_us: int) -> None:
        self._shortest.add(offset_us, received_us)
        self._late_us.append(offset_us)
        if self._first_late_ms is None and len(self._late_us) == _AGE_POSES:
            self._first_late_ms = self._late_ms()

    def _late_ms(self) -> float:
        return 1e-3 * (statistics.median(self._late_us) - self._shortest.least_us)

    def figures(self, now_us: int) -> PoseFigures:
        """Return the statistics at a host time."""
        with self._lock:
            return self._figures(now_us)

    def _figures(self, now_us: int) -> PoseFigures:
        times, silent_us = self._tracked_us, 0
        rate_hz = 0.0
        if times and self._first_us is not None:
            silent_us = max(0, now_us - times[-1])
            span_us = min(_RATE_US, max(now_us - self._first_us, 1))
            recent = sum(t > now_us - _RATE_US for t in times)
            # The first pose begins the first period, so do not count it.
            rate_hz = 1e6 * max(0, recent - (self._first_us > now_us - _RATE_US)) / span_us
        late_ms = self._late_ms() if self._late_us else None
        growth_ms = None
        if late_ms is not None and self._first_late_ms is not None:
            growth_ms = late_ms - self._first_late_ms
        return PoseFigures(
            rate_hz=rate_hz,
            gaps=self._gaps + (silent_us > GAP_US),
            longest_gap_s=1e-6 * max(self._longest_us, silent_us),
            lost=self._lost / self._poses if self._poses else 0.0,
            age_ms=None if late_ms is None else self._delay_ms + late_ms,
            age_growth_ms=growth_ms,
            distance_to_px4_m=self._distance_m(now_us),
            angle_to_px4_deg=self._angle_deg(now_us),
            senders=tuple(s for s, t in sorted(self._senders.items()) if t > now_us - _RATE_US),
        )

    def _distance_m(self, now_us: int) -> float | None:
        if self._pose is None or self._odometry is None or self._is_old(self._odometry, now_us):
            return None
        return norm(subtract(self._pose[0], self._odometry.position_ned))

    def _angle_deg(self, now_us: int) -> float | None:
        if self._pose is None or self._attitude is None or self._is_old(self._attitude, now_us):
            return None
        return math.degrees(rotation_angle(self._pose[1], self._attitude.q_frd_to_ned))

    def _is_old(self, record: OdometrySample | AttitudeSample, now_us: int) -> bool:
        silent = not self._tracked_us or now_us - self._tracked_us[-1] > _FRESH_US
        return silent or now_us - record.received_us > _FRESH_US
