"""What the core knows of the vehicle: the newest of every stream, in the mission frame."""

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

_SEVERE: Final = frozenset({"emergency", "alert", "critical", "error", "warning"})
_SAID_US: Final = 15_000_000  # PX4's words older than this explain nothing any more
_MAX_REASONS: Final = 6
_LEAP_US: Final = 1_000_000
_FURTHEST_M: Final = 1e5  # any position in PX4's local frame is nearer to its origin
_FASTEST_M_S: Final = 1e3
_FASTEST: Final = 20  # simulated seconds per second
_LEAPS_BELIEVED: Final = 25
_VELOCITIES_KEPT_US: Final = 1_000_000


class FlightState:
    """Newest samples and what follows from them.

    `now_us` is the autopilot's time as far as it is known: the newest stamp, carried on by host ticks through
    the clock offset while the streams are silent. `host_us` is the host's time of the newest receipt or tick.

    Args:
        has_lock: whether the vehicle can change its stiffness; without a lock `lock` says settled and rigid.
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
        self.pose: PoseSample | None = None  # of the motion capture, where this program forwards it
        self.status = StatusSample(t_us=0, received_us=0)
        self.in_offboard = self.on_ground = False  # as PX4 says
        self.position_sd_m: float | None = None  # of the horizontal position, by PX4 itself
        self.position_ahead_s: float | None = None  # lead over the IMU; negative if behind, None if not known
        self.lock = LockState(t_us=0, phase=LockPhase.UNKNOWN, mode=None)
        if not has_lock:  # what cannot move is where it is, from the start and for ever
            self.lock = LockState(t_us=0, phase=LockPhase.SETTLED, mode=Mode.RIGID)
        self.position: Vec3 = (0.0, 0.0, 0.0)
        self.velocity: Vec3 = (0.0, 0.0, 0.0)
        self.acceleration: Vec3 = (0.0, 0.0, 0.0)  # of the odometry's velocity, lightly filtered
        self.yaw = 0.0
        self.tilt_rad = 0.0
        self._velocities: deque[tuple[int, Vec3]] = deque()
        self._stamp_us = self._stamped_us = 0  # of the newest sample taken, and its receipt
        self._leapt: dict[str, int] = {}  # samples in a row that are too far ahead
        self.health: HealthReport | None = None
        self._said: dict[str, int] = {}  # PX4's last warnings and worse, oldest first; when
        self._found_on_link: dict[str, int] = {}  # likewise, what this program finds on the link
        self._refused: dict[str, str] = {}  # command -> PX4's answer, while it is a refusal

    def take_odometry(self, sample: OdometrySample) -> bool:
        """A position and velocity; False where its stamp does not advance, or neither can be."""
        if not self.is_plausible(sample):
            return False
        previous, t_us, received_us = self.odometry, sample.t_us, sample.received_us
        before_us = 0 if previous is None else previous.t_us
        if previous is not None and t_us <= before_us:
            return False
        if self._leaps("odometry", t_us, received_us, previous):
            return False
        self.odometry = sample
        self._saw(t_us, received_us)
        if self.frame is None:
            return True
        position = self.frame.point_from_ned(sample.position_ned)
        velocity = self.frame.vector_from_ned(sample.velocity_ned)
        if previous is not None:
            dt = (t_us - before_us) * 1e-6
            share = min(1.0, dt / 0.06)  # first order, 0.06 s: the estimator's velocity is noisy
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
        """Whether any vehicle can be there and as fast; what cannot be is compared with nothing."""
        (x, y, z), (u, v, w) = sample.position_ned, sample.velocity_ned
        return (
            abs(x) < _FURTHEST_M
            and abs(y) < _FURTHEST_M
            and abs(z) < _FURTHEST_M
            and abs(u) < _FASTEST_M_S
            and abs(v) < _FASTEST_M_S
            and abs(w) < _FASTEST_M_S
        )

    def take_attitude(self, sample: AttitudeSample) -> bool:
        """An attitude; False where its stamp does not advance."""
        previous, t_us, received_us = self.attitude, sample.t_us, sample.received_us
        if previous is not None and t_us <= previous.t_us:
            return False
        if self._leaps("attitude", t_us, received_us, previous):
            return False
        self.attitude = sample
        self._saw(t_us, received_us)
        q = sample.q_frd_to_ned
        self.tilt_rad = tilt_of(q)
        if self.frame is not None:
            self.yaw = self.frame.yaw_from_ned(yaw_ned_of(q))
        return True

    def take_imu(self, sample: ImuSample) -> bool:
        """An IMU sample; False where its stamp does not advance."""
        previous, t_us, received_us = self.imu, sample.t_us, sample.received_us
        if previous is not None and t_us <= previous.t_us:
            return False
        if self._leaps("imu", t_us, received_us, previous):
            return False
        self.imu = sample
        self._saw(t_us, received_us)
        return True

    def take_actuator(self, sample: ActuatorSample) -> None:
        """Motor commands."""
        received_us = sample.received_us
        if self._leaps("actuator", sample.t_us, received_us, self.actuator):
            return
        self.actuator = sample
        self.host_us = max(self.host_us, received_us)

    def take_status(self, sample: StatusSample) -> None:
        """The autopilot's slow state."""
        self.status = sample
        self.in_offboard = sample.flight_mode is FlightMode.OFFBOARD
        self.on_ground = sample.landed is LandedState.ON_GROUND
        self.host_us = max(self.host_us, sample.received_us)

    def take_estimator(self, sample: EstimatorSample) -> None:
        """What PX4 says of its estimator: how sure it is of its position; the guard judges the rest."""
        if sample.position_sd_m is not None:
            self.position_sd_m = sample.position_sd_m
        self.host_us = max(self.host_us, sample.received_us)

    def take_pose(self, sample: PoseSample) -> None:
        """Keep a pose of the motion capture."""
        self.pose = sample
        self.host_us = max(self.host_us, sample.received_us)

    def take_lock(self, sample: LockState) -> None:
        """State of the lock."""
        self.lock = sample

    def take_tick(self, tick: Tick) -> None:
        """The host's clock goes by."""
        self.host_us = max(self.host_us, tick.host_us)
        if self.clock_offset_us is not None:
            now_us = self.host_us + self.clock_offset_us
            if self._stamp_us:  # a clock estimate may be that of another vehicle
                now_us = min(now_us, self._stamp_us + self.host_us - self._stamped_us + _LEAP_US)
            self.now_us = max(self.now_us, now_us)

    def take_clock(self, sample: ClockOffset) -> None:
        """Autopilot time minus host time."""
        self.clock_offset_us = sample.offset_us

    def take_text(self, sample: StatusText) -> None:
        """Remember warnings and worse, of PX4 or of this program."""
        if sample.severity in _SEVERE:
            texts = self._found_on_link if sample.found_here else self._said
            texts.pop(sample.text, None)  # the newest last
            texts[sample.text] = self.now_us
            if len(texts) > _MAX_REASONS:
                del texts[next(iter(texts))]

    def text_about(self, beginning: str) -> str:
        """Return the newest warning that begins so, to be appended after "; "; empty if there is none."""
        texts = {**self._said, **self._found_on_link}
        found = [text for text in sorted(texts, key=lambda text: texts[text]) if text.startswith(beginning)]
        return f"; {found[-1]}" if found else ""

    def take_health(self, sample: HealthReport) -> None:
        """PX4's health and arming checks."""
        self.health = sample

    def take_result(self, sample: CommandResult) -> None:
        """How PX4 answered a command."""
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
        """Whether a stamp lies further ahead than time can have gone by: another vehicle's, on the same link.

        A clock that has really jumped is believed after a few samples in a row. The first sample of a stream
        is compared with the newest of the others.
        """
        if previous is not None:
            ahead_us, elapsed_us = t_us - previous.t_us, received_us - previous.received_us
        elif self._stamp_us:
            ahead_us, elapsed_us = t_us - self._stamp_us, received_us - self._stamped_us
        else:
            return False
        if ahead_us <= _LEAP_US or ahead_us <= _LEAP_US + _FASTEST * elapsed_us:
            if self._leapt:
                self._leapt.pop(stream, None)
            return False
        self._leapt[stream] = self._leapt.get(stream, 0) + 1
        if self._leapt[stream] < _LEAPS_BELIEVED:
            return True
        del self._leapt[stream]
        return False

    def _saw(self, t_us: int, received_us: int) -> None:
        self._stamp_us, self._stamped_us = t_us, received_us
        # Comparisons, where `max` would do: a call for every sample costs more.
        self.now_us = t_us if t_us > self.now_us else self.now_us
        self.host_us = received_us if received_us > self.host_us else self.host_us

    # -- derived --

    def anchor(self, frame: MissionFrame) -> None:
        """From now on positions, velocities and yaw are in this mission frame."""
        self.frame = frame
        if self.odometry is not None:
            self.position = frame.point_from_ned(self.odometry.position_ned)
            self.velocity = frame.vector_from_ned(self.odometry.velocity_ned)
        if self.attitude is not None:
            self.yaw = frame.yaw_from_ned(yaw_ned_of(self.attitude.q_frd_to_ned))

    def position_at(self, t_us: int) -> Vec3:
        """Position in the mission frame at a moment near the newest odometry, by constant velocity."""
        if self.odometry is None:
            return self.position
        return add(self.position, scale(self.velocity, (t_us - self.odometry.t_us) * 1e-6))

    def velocity_before(self, t_us: int) -> Vec3:
        """The last velocity in the mission frame stamped before a moment."""
        for stamp, velocity in reversed(self._velocities):
            if stamp < t_us:
                return velocity
        return self.velocity

    def mean_velocity(self, over_s: float) -> Vec3:
        """Mean of the odometry's velocities of the last seconds, mission frame, m/s.

        PX4's estimate of the velocity shakes with the accelerometer; what is to be "slow" is asked of this.

        Args:
            over_s: up to 1 s.
        """
        if not self._velocities:
            return self.velocity
        first_us = self._velocities[-1][0] - over_s * 1e6
        total, n = (0.0, 0.0, 0.0), 0
        for stamp, velocity in reversed(self._velocities):
            if n and stamp <= first_us:
                break
            total, n = add(total, velocity), n + 1
        return scale(total, 1.0 / n)

    def reasons(self, command: str | None = None) -> str:
        """Return why PX4 does not do something: what this program finds on the link, and PX4's own words.

        Args:
            command: that it refuses; its answer is told where it gives no other reason.

        Returns:
            Words such as "; PX4 says: No offboard signal", to be appended; empty where there are none.
        """
        seen = self._recent(self._found_on_link)
        here = "; " + ", ".join(seen) if seen else ""
        found = [] if self.health is None else list(self.health.blocking)
        found += self._recent(self._said)
        others = () if self.health is None else self.health.others
        found = list(dict.fromkeys(found))[:_MAX_REASONS]
        # What PX4 holds against other modes may be behind it: without a position there is no offboard signal.
        also = [word for word in others if word not in found][:_MAX_REASONS]
        if found:
            return f"{here}; PX4 says: " + ", ".join(found) + ("; also " + ", ".join(also) if also else "")
        answer = self._refused.get(command or "")
        answered = f"{here}; PX4 answers: {answer}" if answer else here
        if also:  # all that a PX4 without reports tells; it need not be the reason
            return f"{answered}; PX4 gives no reason, but finds: " + ", ".join(also)
        return answered

    def _recent(self, texts: Mapping[str, int]) -> list[str]:
        return [text for text, t_us in texts.items() if self.now_us - t_us < _SAID_US]

    def lock_is_in(self, mode: Mode) -> bool:
        """Whether the lock is settled in a mode, as far as it can know."""
        return self.lock.phase is LockPhase.SETTLED and self.lock.mode is mode
