"""Flight state of the core: the newest sample of every stream, in the mission frame."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Final

from dart_flight.base.geometry import MissionFrame, Vec3, add, scale, tilt_of, yaw_ned_of
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ClockOffset,
    CommandResult,
    EstimatorSample,
    FlightMode,
    HealthReport,
    ImuSample,
    LandedState,
    LockPhase,
    LockState,
    Mode,
    OdometrySample,
    PoseSample,
    StatusSample,
    StatusText,
    Tick,
)
from dart_flight.base.stamps import LEAP_US, LeapFilter

_SEVERE: Final = frozenset({"emergency", "alert", "critical", "error", "warning"})
_TEXT_AGE_US: Final = 15_000_000  # texts of PX4 are given as reasons for at most this time
_MAX_REASONS: Final = 6
_FURTHEST_M: Final = 1e5  # limit of a plausible position in PX4's local frame
_FASTEST_M_S: Final = 1e3
_LEAPS_ACCEPTED: Final = 25
_VELOCITIES_KEPT_US: Final = 1_000_000


class FlightState:
    """Newest samples and values derived from them.

    `now_us` is the estimate of the autopilot's time: the newest stamp, or the host's time plus the clock
    offset while the streams are silent. `host_us` is the host's time of the newest receipt or tick. Without a
    lock, `lock` is settled and rigid. An `update_` method returns False if it discards the sample: the stamp
    does not increase, or the sample is implausible.
    """

    def __init__(self, has_lock: bool = True) -> None:
        self.frame: MissionFrame | None = None
        self.now_us = 0
        self.host_us = 0
        self.clock_offset_us: int | None = None
        self.imu: ImuSample | None = None
        self.attitude: AttitudeSample | None = None
        self.odometry: OdometrySample | None = None
        self.actuator: ActuatorSample | None = None
        self.pose: PoseSample | None = None  # from motion capture, if this program forwards poses
        self.status = StatusSample(t_us=0, received_us=0)
        self.in_offboard = self.on_ground = False  # from PX4's mode and land detector
        self.position_sd_m: float | None = None  # horizontal standard deviation from PX4
        self.position_ahead_s: float | None = None  # lead over the IMU; negative if behind, None if not known
        self.lock = LockState(t_us=0, phase=LockPhase.UNKNOWN, mode=None)
        if not has_lock:
            self.lock = LockState(t_us=0, phase=LockPhase.SETTLED, mode=Mode.RIGID)
        self.position: Vec3 = (0.0, 0.0, 0.0)
        self.velocity: Vec3 = (0.0, 0.0, 0.0)
        self.acceleration: Vec3 = (0.0, 0.0, 0.0)  # low-pass-filtered derivative of the odometry's velocity
        self.yaw = 0.0
        self.tilt_rad = 0.0
        self._velocities: deque[tuple[int, Vec3]] = deque()
        self._stamp_us = self._stamped_us = 0  # stamp and receipt of the newest accepted sample
        self._leap_filters = {
            name: LeapFilter(_LEAPS_ACCEPTED) for name in ("imu", "attitude", "odometry", "actuator")
        }
        self.health: HealthReport | None = None
        self._px4_texts: dict[str, int] = {}  # PX4's last warnings or worse, oldest first, with their times
        self._found_on_link: dict[str, int] = {}  # this program's warnings about the link, with their times
        self._refused: dict[str, str] = {}  # PX4's refusal, by command

    def update_odometry(self, sample: OdometrySample) -> bool:
        if not self.is_plausible(sample):
            return False
        previous, t_us, received_us = self.odometry, sample.t_us, sample.received_us
        before_us = 0 if previous is None else previous.t_us
        if previous is not None and t_us <= before_us:
            return False
        if self._leaps("odometry", t_us, received_us, previous):
            return False
        self.odometry = sample
        self._advance_time(t_us, received_us)
        if self.frame is None:
            return True
        position = self.frame.point_from_ned(sample.position_ned)
        velocity = self.frame.vector_from_ned(sample.velocity_ned)
        if previous is not None:
            dt = (t_us - before_us) * 1e-6
            share = min(1.0, dt / 0.06)  # low-pass of 0.06 s, because the estimator's velocity is noisy
            a, v = self.acceleration, self.velocity
            self.acceleration = (
                a[0] + share * ((velocity[0] - v[0]) / dt - a[0]),
                a[1] + share * ((velocity[1] - v[1]) / dt - a[1]),
                a[2] + share * ((velocity[2] - v[2]) / dt - a[2]),
            )
        self.position, self.velocity = position, velocity
        self._velocities.append((t_us, velocity))
        while self._velocities[0][0] < t_us - _VELOCITIES_KEPT_US:
            self._velocities.popleft()
        return True

    @staticmethod
    def is_plausible(sample: OdometrySample) -> bool:
        """Return whether position and velocity are within physical limits."""
        (x, y, z), (u, v, w) = sample.position_ned, sample.velocity_ned
        return (
            abs(x) < _FURTHEST_M
            and abs(y) < _FURTHEST_M
            and abs(z) < _FURTHEST_M
            and abs(u) < _FASTEST_M_S
            and abs(v) < _FASTEST_M_S
            and abs(w) < _FASTEST_M_S
        )

    def update_attitude(self, sample: AttitudeSample) -> bool:
        previous, t_us, received_us = self.attitude, sample.t_us, sample.received_us
        if previous is not None and t_us <= previous.t_us:
            return False
        if self._leaps("attitude", t_us, received_us, previous):
            return False
        self.attitude = sample
        self._advance_time(t_us, received_us)
        q = sample.q_frd_to_ned
        self.tilt_rad = tilt_of(q)
        if self.frame is not None:
            self.yaw = self.frame.yaw_from_ned(yaw_ned_of(q))
        return True

    def update_imu(self, sample: ImuSample) -> bool:
        previous, t_us, received_us = self.imu, sample.t_us, sample.received_us
        if previous is not None and t_us <= previous.t_us:
            return False
        if self._leaps("imu", t_us, received_us, previous):
            return False
        self.imu = sample
        self._advance_time(t_us, received_us)
        return True

    def update_actuator(self, sample: ActuatorSample) -> None:
        received_us = sample.received_us
        if self._leaps("actuator", sample.t_us, received_us, self.actuator):
            return
        self.actuator = sample
        self.host_us = max(self.host_us, received_us)

    def update_status(self, sample: StatusSample) -> None:
        self.status = sample
        self.in_offboard = sample.flight_mode is FlightMode.OFFBOARD
        self.on_ground = sample.landed is LandedState.ON_GROUND
        self.host_us = max(self.host_us, sample.received_us)

    def update_estimator(self, sample: EstimatorSample) -> None:
        """Store the standard deviation of the position; the guard uses the rest of the sample."""
        if sample.position_sd_m is not None:
            self.position_sd_m = sample.position_sd_m
        self.host_us = max(self.host_us, sample.received_us)

    def update_pose(self, sample: PoseSample) -> None:
        self.pose = sample
        self.host_us = max(self.host_us, sample.received_us)

    def update_lock(self, sample: LockState) -> None:
        self.lock = sample

    def advance(self, tick: Tick) -> None:
        """Advance the host's time; the autopilot's time follows from the clock offset."""
        self.host_us = max(self.host_us, tick.host_us)
        if self.clock_offset_us is not None:
            now_us = self.host_us + self.clock_offset_us
            if self._stamp_us:  # the clock offset may be another vehicle's, so limit the advance
                now_us = min(now_us, self._stamp_us + self.host_us - self._stamped_us + LEAP_US)
            self.now_us = max(self.now_us, now_us)

    def update_clock(self, sample: ClockOffset) -> None:
        self.clock_offset_us = sample.offset_us

    def add_text(self, sample: StatusText) -> None:
        if sample.severity in _SEVERE:
            texts = self._found_on_link if sample.found_here else self._px4_texts
            texts.pop(sample.text, None)  # insert again, so that the newest is last
            texts[sample.text] = self.now_us
            if len(texts) > _MAX_REASONS:
                del texts[next(iter(texts))]

    def text_about(self, beginning: str) -> str:
        """Return "; " and the newest warning that starts with `beginning`, or an empty string."""
        texts = {**self._px4_texts, **self._found_on_link}
        found = [text for text in sorted(texts, key=lambda text: texts[text]) if text.startswith(beginning)]
        return f"; {found[-1]}" if found else ""

    def update_health(self, sample: HealthReport) -> None:
        self.health = sample

    def add_result(self, sample: CommandResult) -> None:
        """Store PX4's answer if it refuses a command; delete it once PX4 accepts the command."""
        if sample.ok:
            self._refused.pop(sample.command, None)
        else:
            self._refused[sample.command] = sample.detail

    def _leaps(
        self,
        stream: str,
        t_us: int,
        received_us: int,
        previous: ImuSample | AttitudeSample | OdometrySample | ActuatorSample | None,
    ) -> bool:
        """Return whether to discard a sample whose stamp leaps.

        The first sample of a stream is compared with the newest sample of the other streams.
        """
        if previous is not None:
            ahead_us, elapsed_us = t_us - previous.t_us, received_us - previous.received_us
        elif self._stamp_us:
            ahead_us, elapsed_us = t_us - self._stamp_us, received_us - self._stamped_us
        else:
            return False
        return self._leap_filters[stream].rejects(ahead_us, elapsed_us)

    def _advance_time(self, t_us: int, received_us: int) -> None:
        self._stamp_us, self._stamped_us = t_us, received_us
        # Comparisons are faster than `max`, and this runs for every sample.
        self.now_us = t_us if t_us > self.now_us else self.now_us
        self.host_us = received_us if received_us > self.host_us else self.host_us

    # -- derived --

    def anchor(self, frame: MissionFrame) -> None:
        """Set the mission frame, and convert the current positions, velocities and yaw."""
        self.frame = frame
        if self.odometry is not None:
            self.position = frame.point_from_ned(self.odometry.position_ned)
            self.velocity = frame.vector_from_ned(self.odometry.velocity_ned)
        if self.attitude is not None:
            self.yaw = frame.yaw_from_ned(yaw_ned_of(self.attitude.q_frd_to_ned))

    def position_at(self, t_us: int) -> Vec3:
        """Extrapolate the last odometry position (mission frame) to `t_us` at constant velocity."""
        if self.odometry is None:
            return self.position
        return add(self.position, scale(self.velocity, (t_us - self.odometry.t_us) * 1e-6))

    def velocity_before(self, t_us: int) -> Vec3:
        """Return the last velocity stamped before `t_us`, mission frame."""
        for stamp, velocity in reversed(self._velocities):
            if stamp < t_us:
                return velocity
        return self.velocity

    def mean_velocity(self, over_s: float) -> Vec3:
        """Return the mean odometry velocity (mission frame) over the last `over_s`, at most 1 s.

        PX4's velocity estimate follows accelerometer vibration. Use this mean to test whether the vehicle is
        slow.
        """
        if not self._velocities:
            return self.velocity
        first_us = self._velocities[-1][0] - over_s * 1e6
        x = y = z = 0.0
        n = 0
        for stamp, (vx, vy, vz) in reversed(self._velocities):
            if n and stamp <= first_us:
                break
            x, y, z, n = x + vx, y + vy, z + vz, n + 1
        return scale((x, y, z), 1.0 / n)

    def reasons(self, command: str | None = None) -> str:
        """Return the reasons why PX4 does not act, from faults found on the link and PX4's own texts.

        The result is empty, or text to append such as "; PX4 reports: No offboard signal". If there is no
        other reason, the result is PX4's answer to the refused `command`.
        """
        own = self._recent(self._found_on_link)
        here = "; " + ", ".join(own) if own else ""
        found = [] if self.health is None else list(self.health.blocking)
        found += self._recent(self._px4_texts)
        others = () if self.health is None else self.health.others
        found = list(dict.fromkeys(found))[:_MAX_REASONS]
        # A fault of another mode may be the cause: without a position, PX4 also lacks offboard signal.
        also = [word for word in others if word not in found][:_MAX_REASONS]
        if found:
            return f"{here}; PX4 reports: " + ", ".join(found) + ("; also " + ", ".join(also) if also else "")
        answer = self._refused.get(command or "")
        answered = f"{here}; PX4 answers: {answer}" if answer else here
        if also:  # possibly not the reason, but all that an older PX4 reports
            return f"{answered}; PX4 gives no reason, but reports: " + ", ".join(also)
        return answered

    def _recent(self, texts: Mapping[str, int]) -> list[str]:
        return [text for text, t_us in texts.items() if self.now_us - t_us < _TEXT_AGE_US]

    def lock_is_in(self, mode: Mode) -> bool:
        return self.lock.phase is LockPhase.SETTLED and self.lock.mode is mode
