"""Checks of the motion-capture poses that this program forwards to PX4, and the guard's rules about them.

Without poses PX4 uses only its IMU. A bias of 0.05 m/s2 and a tilt error of half a degree then move the
estimate by 0.02 m in 0.5 s. Every phase tolerates this error. A contact adds a velocity error of up to 1 m/s.
Without poses the vehicle must therefore not hit a wall, so an approach tolerates a shorter loss of poses. If
the poses fail in a contact or recovery, the guard acts after this phase, because the recovery needs only the
IMU.

Poses that jump belong to another body and are withheld from PX4 immediately. PX4 would reject such poses for
a second and then reset its position to them. Without poses, PX4 dead-reckons long enough to land. If only the
attitudes are wrong, for example because markers were swapped, only the attitudes are withheld. PX4 would
otherwise reset its heading to the wrong attitudes, and the vehicle would tumble. The positions are still
correct, and PX4 keeps its heading by the gyro.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Final

from dart_flight.base.geometry import Quaternion, Vec3, rotation_angle
from dart_flight.base.records import OdometrySample, Override, Phase, PoseSample, PosesWithheld
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.core.guard.rule import Rule, RuleCondition, Scope
from dart_flight.core.mission.phases import ON_GROUND
from dart_flight.core.sense.state import FlightState

LOST_S: Final = 0.5
LOST_APPROACH_S: Final = 0.25
LOST_LAND_S: Final = 1.5  # after this loss the vehicle lands, because dead reckoning has erred by 0.2 m
_GROUND_LOST_S: Final = 2.0  # longest loss of poses on the ground, where a loss is no hazard
_FIRST_S: Final = 5.0  # longest time from the core's first input to the first pose
# Limit of a pose's distance from its prediction by PX4's velocity, which errs by up to 2 m/s in a contact.
JUMP_M: Final = 0.15
_JUMP_M_S: Final = 2.0
_JUMP_S: Final = 0.05  # a shorter jump is tolerated, because PX4's innovation gate rejects it
_JUMP_GAP_S: Final = 0.1  # after a longer gap, a pose is compared only with PX4's estimate
# Limits of the difference between a pose and PX4's estimate, and how long a pose may exceed them. In a fast
# rotation, latency causes a larger difference, but for a shorter time.
TURNED_DEG: Final = 30.0
_TURNED_S: Final = 0.1
APART_M: Final = 0.3
_APART_S: Final = 0.5
_APART_LATENCY_S: Final = 0.1
_GROUND_APART_S: Final = 3.0  # value for `_APART_S` on the ground, where PX4 first aligns its estimate
RATE_SHARE: Final = 0.5  # poses are too slow below this fraction of the configured rate
_INTERVALS: Final = 9  # the rate is the median over this number of intervals, so a single gap has no effect
LATER_S: Final = 0.04  # limit of a delay's growth since take-off; PX4's estimate oscillates beyond it
_AGE_US: Final = 250_000
_SENDERS_US: Final = 1_000_000
_RECENT_US: Final = 5_000_000  # wrong poses may affect PX4's estimate for this time
_FINISHED_FIRST: Final = frozenset((Phase.CONTACT, Phase.RECOVERY))
_RECOVERED_S: Final = 0.5  # first part of a recovery; after it the vehicle flies to the next wall or the goal


class PoseWatch:
    """Monitor of the poses in one flight."""

    def __init__(self, mocap: MotionCapture) -> None:
        self._room, self._rate_hz = mocap.room_frame(), mocap.rate_hz
        self._begun_us = 0  # host time of the first input
        self._now_us = 0  # host time
        self._newest: PoseSample | None = None
        self._tracked_us = 0  # host time of the newest tracked pose, or 0 if there is none
        # Receipt and position (NED) of the newest plausible pose.
        self._plausible: tuple[int, Vec3] | None = None
        self._settling_us: int | None = None  # newest start or end of a gap in the poses, or None
        self._jumped_us: int | None = None  # host time at which poses first were far from `_plausible`
        self._jump = ""
        self._wrong = self._turned_wrong = ""  # why poses, or only their attitudes, are withheld
        self._withheld_us = 0
        self._not_recovering_us = 0  # host time of the newest pose outside of a recovery
        self._recent, self._recent_us = "", -_RECENT_US  # newest fault and its time
        self._apart_us: int | None = None
        self._turned_us: int | None = None
        self._apart_m = self._turned_deg = 0.0
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)  # times between tracked poses, us
        self._ages: deque[tuple[int, int]] = deque()  # time of receipt; receipt minus the source's stamp
        self._least_age_us: int | None = None
        self._other: PoseSample | None = None  # newest pose of the previous sender
        self._alternates_us: int | None = None  # host time at which two senders last alternated

    def tick(self, host_us: int) -> None:
        self._begun_us = self._begun_us or host_us
        self._now_us = host_us

    def add_pose(self, item: PoseSample, state: FlightState, phase: Phase) -> None:
        """Compare a pose with the previous one and with PX4's estimate in `state`."""
        now_us, before = item.received_us, self._newest
        self._newest = item
        if phase is not Phase.RECOVERY:
            self._not_recovering_us = now_us
        if before is not None and before.sender != item.sender:
            other = self._other
            if other is not None and other.sender == item.sender and now_us - other.received_us < _SENDERS_US:
                self._alternates_us = now_us
            self._other = before
        if not item.tracked:
            return
        if self._tracked_us:
            self._intervals.append(now_us - self._tracked_us)
        self._tracked_us = now_us
        self._record_age(item, phase in ON_GROUND)
        position, attitude = self._room.pose_to_ned(item.position_room, item.q_body_to_room)
        self._compare_poses(now_us, position, state)
        self._compare_estimate(now_us, position, attitude, state)

    def fault(self, phase: Phase) -> str | None:
        ground = phase in ON_GROUND
        lost_s = LOST_APPROACH_S if phase is Phase.APPROACH else LOST_S
        text = (
            self._wrong
            or self._turned_wrong
            or self._lost(_GROUND_LOST_S if ground else lost_s)
            or self._jump
            or self._two_senders()
            or self._turned(_GROUND_APART_S if ground else _TURNED_S)
            or self._apart(_GROUND_APART_S if ground else _APART_S)
            or self._late()
            or self._slow()
        )
        if text is not None:
            self._recent, self._recent_us = text, self._now_us
        return text

    def blind(self, estimate_steps: bool, phase: Phase) -> str | None:
        """Return the reason why PX4's position cannot be used, or None if it can.

        `estimate_steps` means that PX4's estimate has just jumped.
        """
        if estimate_steps and (self.fault(phase) or self._now_us - self._recent_us < _RECENT_US):
            return f"{self._recent}; then PX4's estimate stepped"
        if self._wrong and (self._now_us - self._withheld_us) * 1e-6 > LOST_LAND_S:
            return self._wrong
        return self._lost(LOST_LAND_S)

    def waits(self, phase: Phase) -> bool:
        """Return whether to finish the current contact or recovery before responding to a fault of the poses.

        If poses are withheld or have become late, the guard's response waits only for the first part of a
        recovery. Withheld poses do not return, and late poses move PX4's estimate. In both cases the vehicle
        must not continue to another wall.
        """
        if phase is Phase.RECOVERY and (self._wrong or self._late() is not None):
            return (self._now_us - self._not_recovering_us) * 1e-6 < _RECOVERED_S
        return phase in _FINISHED_FIRST

    def withhold(self, phase: Phase, t_us: int) -> PosesWithheld | None:
        """Return a record when this program begins to withhold poses or their attitudes; otherwise None."""
        if self._wrong or phase in ON_GROUND:
            return None
        if self._jump:
            self._wrong, self._withheld_us = self._jump, self._now_us
            return PosesWithheld(t_us, self._wrong)
        if not self._turned_wrong and (turned := self._turned(_TURNED_S)) is not None:
            self._turned_wrong = turned
            return PosesWithheld(t_us, turned, attitude_only=True)
        return None

    # -- causes --

    def _lost(self, limit_s: float) -> str | None:
        newest = self._newest
        if not self._tracked_us:
            if (self._now_us - self._begun_us) * 1e-6 <= _FIRST_S:
                return None
            return "no pose has arrived" if newest is None else f"body {newest.body} has never been tracked"
        lasting_s = (self._now_us - self._tracked_us) * 1e-6
        if lasting_s <= limit_s or newest is None:
            return None
        what = "no pose of body" if newest.received_us == self._tracked_us else "not tracking body"
        return f"{what} {newest.body} for {lasting_s:.2f} s, limit {limit_s:g} s"

    def _two_senders(self) -> str | None:
        if self._alternates_us is None or self._now_us - self._alternates_us > _SENDERS_US:
            return None
        assert self._newest is not None
        assert self._other is not None
        return f"two senders send poses: {' and '.join(sorted((self._newest.sender, self._other.sender)))}"

    def _turned(self, limit_s: float) -> str | None:
        if self._turned_us is None or (self._tracked_us - self._turned_us) * 1e-6 <= limit_s:
            return None
        return f"the pose is rotated by {self._turned_deg:.0f} deg from PX4's attitude: markers swapped?"

    def _apart(self, limit_s: float) -> str | None:
        if self._apart_us is None or (self._tracked_us - self._apart_us) * 1e-6 <= limit_s:
            return None
        return f"the pose is {self._apart_m:.2f} m from PX4's position"

    def _late(self) -> str | None:
        if self._least_age_us is None or not self._ages:
            return None
        later_s = 1e-6 * (min(age_us for _, age_us in self._ages) - self._least_age_us)
        if later_s <= LATER_S:
            return None
        return f"the poses' delay grew by {1e3 * later_s:.0f} ms since take-off, limit {1e3 * LATER_S:g} ms"

    def _slow(self) -> str | None:
        if len(self._intervals) < _INTERVALS:
            return None
        rate_hz = 1e6 / max(1, sorted(self._intervals)[_INTERVALS // 2])
        least_hz = RATE_SHARE * self._rate_hz
        return f"poses arrive at {rate_hz:.0f} Hz, minimum {least_hz:.0f} Hz" if rate_hz < least_hz else None

    # -- comparisons --

    def _record_age(self, item: PoseSample, on_ground: bool) -> None:
        if item.source_us is None:
            return
        self._ages.append((item.received_us, item.t_us - item.source_us))
        while self._ages[0][0] < item.received_us - _AGE_US:
            self._ages.popleft()
        if on_ground:  # the offset of the autopilot's clock is not yet known precisely
            return
        least_us = (
            min(age_us for _, age_us in self._ages) if self._least_age_us is None else self._least_age_us
        )
        self._least_age_us = min(least_us, self._ages[-1][1])

    def _compare_poses(self, now_us: int, position: Vec3, state: FlightState) -> None:
        if self._plausible is None or state.odometry is None:
            self._plausible, self._settling_us = (now_us, position), now_us
            return
        then_us, then = self._plausible
        dt = (now_us - then_us) * 1e-6
        vx, vy, vz = state.odometry.velocity_ned
        away_m = math.dist(position, (then[0] + dt * vx, then[1] + dt * vy, then[2] + dt * vz))
        if away_m <= JUMP_M + dt * _JUMP_M_S:
            self._plausible, self._jumped_us, self._settling_us = (now_us, position), None, None
            return
        if dt > _JUMP_GAP_S and self._jumped_us is None:
            self._settling_us = now_us
        if self._settling_us is not None and (now_us - self._settling_us) * 1e-6 < _JUMP_S:
            self._plausible = (now_us, position)
            return
        if self._jumped_us is None:
            self._jumped_us = now_us
        if (now_us - self._jumped_us) * 1e-6 >= _JUMP_S:
            self._plausible, self._jumped_us = (now_us, position), None
            self._jump = f"body jumped by {away_m:.2f} m: it is another body, or the markers are swapped"

    def _compare_estimate(
        self, now_us: int, position: Vec3, attitude: Quaternion, state: FlightState
    ) -> None:
        odometry, q_px4 = state.odometry, state.attitude
        if odometry is None or q_px4 is None or not state.status.local_position_ok:
            self._apart_us = self._turned_us = None
            return
        self._turned_deg = math.degrees(rotation_angle(q_px4.q_frd_to_ned, attitude))
        self._turned_us = (self._turned_us or now_us) if self._turned_deg > TURNED_DEG else None
        self._apart_m = math.dist(position, odometry.position_ned)
        allowed_m = APART_M + _APART_LATENCY_S * math.hypot(*odometry.velocity_ned)
        self._apart_us = (self._apart_us or now_us) if self._apart_m > allowed_m else None


def _present(flight: Any) -> str | None:
    watch: PoseWatch | None = flight.poses
    return None if watch is None or watch.waits(flight.phase) else watch.fault(flight.phase)


def _blind(flight: Any) -> str | None:
    watch: PoseWatch | None = flight.poses
    if watch is None or watch.waits(flight.phase) or flight.phase is Phase.LANDING:
        return None
    return watch.blind(bool(flight.estimator.jump or flight.estimator.reset_step()), flight.phase)


# Faults in PX4's estimate that follow from missing poses.
_DEAD_RECKONING: Final = frozenset({"position_uncertain", "estimator_flags", "odometry_silent"})

# fmt: off
POSE_RULES: tuple[Rule, ...] = (
    Rule("pose_source_ground", Override.GIVE_UP, Scope.GROUND, RuleCondition(
        "the forwarded poses are wrong: the body was lost or jumped, two senders send poses, or the poses "
        "are too slow, too late or far from PX4's estimate",
        f"{_GROUND_LOST_S:g} s, mocap.rate_hz", _present)),
    Rule("pose_source_blind", Override.LAND, Scope.AIR, RuleCondition(
        "PX4's estimate jumped during or shortly after wrong poses (see `pose_source_ground`), or poses "
        "were missing or withheld for longer than the limit",
        f"{LOST_LAND_S:g} s", _blind), (OdometrySample,), explains=_DEAD_RECKONING),
    Rule("pose_source", Override.BREAK_OFF, Scope.FLYING, RuleCondition(
        "the poses are wrong (see `pose_source_ground`); in an approach, the rule acts at once; in a contact "
        f"or recovery, it waits for the end of the recovery, but for at most {_RECOVERED_S:g} s of the "
        "recovery if the poses jumped or became late",
        f"{LOST_APPROACH_S:g} s, {LOST_S:g} s, mocap.rate_hz", _present)),
)
# fmt: on
