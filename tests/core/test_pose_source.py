"""The guard's checks of motion-capture poses: faults that it names, and cases that it accepts."""

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import Quaternion, Vec3, add, quaternion_from_euler, quaternion_multiply
from dart_flight.base.records import (
    AttitudeSample,
    OdometrySample,
    Override,
    Phase,
    PoseSample,
    PosesWithheld,
    StatusSample,
)
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.core.guard.pose_watch import (
    _AGE_US,
    _APART_LATENCY_S,
    _APART_S,
    APART_M,
    LOST_APPROACH_S,
    LOST_LAND_S,
    LOST_S,
    PoseWatch,
)
from dart_flight.core.sense.state import FlightState
from tests.core.conftest import RULES_WITHOUT_JUMP, HandFedCore, known

MOCAP = MotionCapture(url="udp://127.0.0.1:9763/dart", up="y", heading_deg=30.0, body_yaw_deg=90.0)
WITH_MOCAP = {"vehicle.mocap": MOCAP}
ROOM = MOCAP.room_frame()
LEVEL = quaternion_from_euler(0.0, 0.0, 0.4)
STEP_US = 10_000


class Feed:
    """Poses at 100 Hz of a vehicle whose PX4 estimate is correct."""

    def __init__(self) -> None:
        self.watch, self.state = PoseWatch(MOCAP), FlightState()
        self.now_us = 0
        self.frame = 0
        self.state.update_status(StatusSample(0, 0, local_position_ok=True))

    def pose(
        self,
        position: Vec3 = (0.0, 0.0, -1.0),
        velocity: Vec3 = (0.0, 0.0, 0.0),
        q: Quaternion = LEVEL,
        away: Vec3 = (0.0, 0.0, 0.0),
        turn: float = 0.0,
        tracked: bool = True,
        later_us: int = 0,
        step_us: int = STEP_US,
        sender: str = "10.0.0.1:1511",
    ) -> None:
        """Advance by a step, then feed odometry, attitude and a pose that is `away` and turned."""
        self.now_us += step_us
        self.frame += 1
        self.tick()
        now = self.now_us
        self.state.update_attitude(AttitudeSample(now, now, q))
        self.state.update_odometry(OdometrySample(now, now, position, velocity))
        there = (position[0] + away[0], position[1] + away[1], position[2] + away[2])
        turned = quaternion_multiply(quaternion_from_euler(0.0, 0.0, turn), q)
        room = ROOM.pose_from_ned(there, turned)
        age_us = 3_000_000 + later_us  # another clock
        sample = PoseSample(now, now, "dart", tracked, *room, self.frame, now - age_us, sender)
        self.watch.add_pose(sample, self.state, Phase.TRANSIT)

    def tick(self) -> None:
        self.watch.tick(self.now_us)

    def silence(self, seconds: float) -> None:
        self.now_us += round(1e6 * seconds)
        self.tick()

    def hover(self, seconds: float, **changes: Any) -> str | None:
        """Feed poses for a while; return the first fault in transit."""
        end_us = self.now_us + 1e6 * seconds
        while self.now_us < end_us:
            self.pose(**changes)
            fault = self.watch.fault(Phase.TRANSIT)
            if fault is not None:
                return fault
        return None


@pytest.fixture
def feed() -> Feed:
    feed = Feed()
    assert feed.hover(2.0) is None
    return feed


@pytest.mark.parametrize(
    ("changes", "within_s", "message"),
    [
        (
            {"away": (0.5, 0.0, 0.0)},
            0.1,
            "body jumped by 0.50 m: it is another body, or the markers are swapped",
        ),
        ({"turn": math.radians(90.0)}, 0.15, "the pose is rotated by 90 deg from PX4's attitude"),
        ({"turn": math.pi}, 0.15, "the pose is rotated by 180 deg from PX4's attitude"),
        ({"later_us": 50_000}, 0.35, "the poses' delay grew by 50 ms since take-off"),
        ({"step_us": 100_000}, 0.7, "poses arrive at 10 Hz, minimum 25 Hz"),
        ({"tracked": False}, 0.6, "not tracking body dart for 0.5"),
    ],
)
def test_a_pose_fault_is_named_in_time(
    feed: Feed, changes: dict[str, Any], within_s: float, message: str
) -> None:
    fault = known(feed.hover(within_s, **changes))
    assert fault.startswith(message)


@pytest.mark.parametrize(
    ("speed_m_s", "away_m", "apart"),
    [
        (speed_m_s, APART_M + _APART_LATENCY_S * speed_m_s + more_m, more_m > 0.0)
        for speed_m_s in (0.0, 2.0)
        for more_m in (-0.02, 0.02)
    ],
)
def test_a_pose_that_drifts_away_is_named_after_a_while(
    feed: Feed, speed_m_s: float, away_m: float, apart: bool
) -> None:
    """It may be some way from PX4's position, and farther by the flight during the latency."""
    moving = (0.0, speed_m_s, 0.0)
    for step in range(50):
        feed.pose(velocity=moving, away=(0.02 * away_m * step, 0.0, 0.0))
    assert feed.hover(_APART_S - 0.04, velocity=moving, away=(away_m, 0.0, 0.0)) is None
    fault = feed.hover(0.05, velocity=moving, away=(away_m, 0.0, 0.0))
    assert fault == (f"the pose is {away_m:.2f} m from PX4's position" if apart else None)


@pytest.mark.parametrize(("more_us", "named"), [(0, False), (1, True)])
def test_a_pose_may_be_apart_from_px4s_position_for_a_time_to_the_microsecond(
    feed: Feed, more_us: int, named: bool
) -> None:
    away_m = 0.0
    while away_m <= APART_M:
        away_m += 0.0062
        feed.pose(away=(away_m, 0.0, 0.0))
    limit_us = feed.now_us + round(1e6 * _APART_S)
    while feed.now_us < limit_us - STEP_US:
        feed.pose(away=(away_m, 0.0, 0.0))
    feed.pose(away=(away_m, 0.0, 0.0), step_us=limit_us + more_us - feed.now_us)
    assert (feed.watch.fault(Phase.TRANSIT) is not None) is named


@pytest.mark.parametrize(
    ("changes", "seconds"),
    [({"away": (0.5, 0.0, 0.0)}, 0.03), ({"turn": math.radians(90.0)}, 0.08), ({"tracked": False}, 0.4)],
)
def test_a_short_glitch_of_the_poses_is_no_fault(feed: Feed, changes: dict[str, Any], seconds: float) -> None:
    for _ in range(3):
        assert feed.hover(seconds, **changes) is None
        assert feed.hover(0.2) is None


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("moved_m", "jumps"), [(0.27, False), (0.02, False), (-0.27, True)])
def test_a_pose_after_a_gap_is_compared_with_the_motion_since_the_previous_pose(
    feed: Feed, axis: int, moved_m: float, jumps: bool
) -> None:
    """The gap lasts 90 ms and the vehicle flies at 3 m/s; the tolerance is 0.15 m plus 2 m/s."""
    fast, there = [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]
    fast[axis] = 3.0
    for away_m, step_us in ((moved_m, 90_000), *((0.03, STEP_US),) * 7):
        there[axis] += away_m
        position, velocity = (there[0], there[1], there[2]), (fast[0], fast[1], fast[2])
        feed.pose(position=position, velocity=velocity, step_us=step_us)
    fault = feed.watch.fault(Phase.TRANSIT)
    assert (fault or "").startswith("body jumped by 0.54 m") is jumps
    assert (fault is not None) is jumps


def test_poses_are_late_once_the_last_timely_one_is_old(feed: Feed) -> None:
    feed.pose(later_us=50_000, step_us=_AGE_US)
    assert feed.watch.fault(Phase.TRANSIT) is None
    feed.pose(later_us=50_000, step_us=1)
    assert (feed.watch.fault(Phase.TRANSIT) or "").startswith("the poses' delay grew by 50 ms")


def test_the_timeout_of_the_pose_source_depends_on_the_phase(feed: Feed) -> None:
    def lost(silent_s: float, limit_s: float) -> str:
        return f"no pose of body dart for {silent_s:.2f} s, limit {limit_s:g} s"

    feed.silence(LOST_APPROACH_S + 0.05)
    assert feed.watch.fault(Phase.TRANSIT) is None
    assert feed.watch.fault(Phase.APPROACH) == lost(LOST_APPROACH_S + 0.05, LOST_APPROACH_S)
    feed.silence(LOST_S + 0.05 - LOST_APPROACH_S)
    assert feed.watch.fault(Phase.TRANSIT) == lost(LOST_S + 0.1, LOST_S)
    assert feed.watch.fault(Phase.READYING) is None
    assert feed.watch.blind(False, Phase.TRANSIT) is None
    feed.silence(LOST_LAND_S - LOST_S)
    assert feed.watch.blind(False, Phase.TRANSIT) == lost(LOST_LAND_S + 0.1, LOST_LAND_S)


def test_wrong_poses_are_withheld_once_and_in_the_air_only(feed: Feed) -> None:
    feed.hover(0.1, away=(1.0, 0.0, 0.0))
    assert feed.watch.withhold(Phase.ARMING, 7) is None
    reason = "body jumped by 1.00 m: it is another body, or the markers are swapped"
    assert feed.watch.withhold(Phase.CONTACT, 7) == PosesWithheld(7, reason)
    assert feed.watch.withhold(Phase.CONTACT, 8) is None
    assert feed.watch.blind(False, Phase.TRANSIT) is None
    feed.silence(1.6)
    assert feed.watch.fault(Phase.TRANSIT) == feed.watch.blind(False, Phase.TRANSIT) == reason


def test_only_the_attitudes_of_rotated_poses_are_withheld(feed: Feed) -> None:
    feed.hover(0.15, turn=math.pi)
    reason = "the pose is rotated by 180 deg from PX4's attitude: markers swapped?"
    assert feed.watch.withhold(Phase.CONTACT, 7) == PosesWithheld(7, reason, attitude_only=True)
    assert feed.watch.withhold(Phase.CONTACT, 8) is None
    for _ in range(200):
        feed.pose()
    assert feed.watch.fault(Phase.TRANSIT) == reason  # markers that were swapped once are not trusted again
    assert feed.watch.blind(False, Phase.TRANSIT) is None  # PX4 still receives the positions
    for _ in range(10):
        feed.pose(away=(1.0, 0.0, 0.0))
    later = known(feed.watch.withhold(Phase.TRANSIT, 9))
    assert not later.attitude_only


@pytest.mark.parametrize("wrong", [{"tracked": False}, {"later_us": 90_000}, {"step_us": 100_000}])
def test_late_slow_and_untracked_poses_are_not_withheld(feed: Feed, wrong: dict[str, Any]) -> None:
    feed.hover(1.2, **wrong)
    assert feed.watch.fault(Phase.TRANSIT) is not None
    assert feed.watch.withhold(Phase.TRANSIT, 7) is None


def test_an_estimate_that_jumps_with_the_poses_leaves_the_vehicle_blind(feed: Feed) -> None:
    assert feed.watch.blind(True, Phase.TRANSIT) is None
    feed.hover(0.1, away=(0.0, 1.0, 0.0))
    blind = known(feed.watch.blind(True, Phase.TRANSIT))
    assert blind.endswith("markers are swapped; then PX4's estimate stepped")


def test_two_simultaneous_senders_are_named_but_a_change_of_sender_is_not(feed: Feed) -> None:
    assert feed.hover(2.0, sender="10.0.0.2:1511") is None
    for sender in ("10.0.0.1:1511", "10.0.0.2:1511"):
        feed.pose(sender=sender)
    fault = feed.watch.fault(Phase.TRANSIT)
    assert fault == "two senders send poses: 10.0.0.1:1511 and 10.0.0.2:1511"
    assert feed.hover(1.5, sender="10.0.0.2:1511") == fault  # reported at once, and cleared after a second
    for _ in range(110):
        feed.pose(sender="10.0.0.2:1511")
    assert feed.watch.fault(Phase.TRANSIT) is None


def test_the_source_has_time_to_connect_before_its_first_pose() -> None:
    feed = Feed()
    feed.silence(0.1)
    feed.silence(4.0)
    assert feed.watch.fault(Phase.READYING) is None
    feed.silence(2.0)
    assert feed.watch.fault(Phase.READYING) == "no pose has arrived"
    feed.pose(tracked=False)
    assert feed.watch.fault(Phase.READYING) == "body dart has never been tracked"


@pytest.mark.parametrize("gap_s", [0.0, 0.12, 0.2])
def test_a_wrong_frame_after_a_gap_is_no_reference_for_the_next(gap_s: float) -> None:
    feed = Feed()
    if gap_s:
        feed.hover(0.3)
        feed.silence(gap_s)
    feed.pose(away=(0.8, 0.0, 0.0))
    assert feed.hover(0.5) is None


def test_a_pose_that_alternates_after_a_gap_is_a_jump() -> None:
    feed = Feed()
    feed.hover(0.3)
    feed.silence(0.15)
    for i in range(40):
        feed.pose(away=(0.8 if i // 8 % 2 else 0.0, 0.0, 0.0))
    assert (
        feed.watch.fault(Phase.TRANSIT)
        == "body jumped by 0.80 m: it is another body, or the markers are swapped"
    )


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_a_flight_with_latency_noise_and_occlusion_has_no_fault(data: st.DataObject) -> None:
    """Accelerations of a contact, poses up to 50 ms old, gaps below the limit, single wrong frames."""
    feed = Feed()
    feed.hover(0.3)
    age_s = data.draw(st.floats(0.0, 0.05))
    position, velocity, past = (0.0, 0.0, -1.0), (0.0, 0.0, 0.0), [(0.0, 0.0, -1.0)] * 6
    for _ in range(data.draw(st.integers(1, 6))):
        turn_to = data.draw(st.tuples(*(st.floats(-3.5, 3.5),) * 2))
        change = [(target - now) / 8 for target, now in zip(turn_to, velocity[:2], strict=True)]
        wrong = data.draw(st.integers(0, 60))
        gap = data.draw(st.integers(2, 8) | st.just(60))  # apart from the gap before
        for i in range(30):
            if i < 8:  # 80 ms: a contact
                velocity = (velocity[0] + change[0], velocity[1] + change[1], 0.0)
            position = (position[0] + 0.01 * velocity[0], position[1] + 0.01 * velocity[1], -1.0)
            past = [*past[1:], position]
            then = past[-1 - round(age_s / 0.01)]
            lag = tuple(a - b for a, b in zip(then, position, strict=True))
            away = (lag[0] + (0.8 if i == wrong else 0.0), lag[1], lag[2])
            feed.pose(position, velocity, away=away, tracked=not gap <= i < gap + 20)
            assert feed.watch.fault(Phase.APPROACH) is None


class PosedCore(HandFedCore):
    """A hand-fed core that also receives poses at 250 Hz after `begin`."""

    begun = lost = False
    away: Vec3 = (0.0, 0.0, 0.0)
    later_us = 0

    def begin(self) -> None:
        self.begun = True
        self.q = quaternion_from_euler(0.0, 0.0, 0.0)

    def run(self, seconds: float) -> list[Any]:
        out = []
        for _ in range(round(seconds / 0.004)):
            out += super().run(0.004)
            if self.begun:
                pose = ROOM.pose_from_ned(add(self.position_ned, self.away), self.q)
                stamp_us = self.t_us - 3_000_000 - self.later_us  # another clock
                sample = PoseSample(self.t_us, self.t_us, "dart", not self.lost, *pose, None, stamp_us)
                self.feed(sample)
        return out


def posed_core_in(phase: str) -> PosedCore:
    """Return a core with motion capture, in an approach or just after a contact."""
    c = PosedCore(rules=RULES_WITHOUT_JUMP, settings=WITH_MOCAP)
    c.fly_to_wood()
    c.begin()
    c.run(0.2)
    if phase == "contact":
        c.pulse((-10.0, -16.0))
        c.velocity_ned = (0.0, 0.0, 0.0)
        c.run(0.02)
        assert c.core.phase is Phase.RECOVERY
    return c


def events(c: HandFedCore) -> list[tuple[str, Override]]:
    return [(event.rule, event.action) for event in c.fired if event.action is not Override.NONE]


def test_a_body_lost_in_an_approach_causes_a_break_off_and_then_a_landing() -> None:
    c = posed_core_in("approach")
    c.lost = True
    c.run(LOST_APPROACH_S - 0.01)
    assert not events(c)
    c.run(0.04)
    assert events(c) == [("pose_source", Override.BREAK_OFF)]
    c.run(1.6)
    assert events(c)[1:] == [("pose_source_blind", Override.LAND)]


def test_a_body_lost_in_a_contact_does_not_disturb_the_recovery() -> None:
    c = posed_core_in("contact")
    c.lost = True
    c.run(0.7)
    assert c.core.phase is Phase.RECOVERY
    assert not events(c)


@pytest.mark.parametrize(
    ("away", "later_us", "afterwards"),
    [
        ((1.0, 0.0, 0.0), 0, [("pose_source_blind", Override.LAND)]),
        ((0.0, 0.0, 0.0), 150_000, []),
        ((0.0, 0.0, 0.0), 60_000, []),
    ],
)
def test_another_body_or_late_poses_in_a_contact_end_the_recovery_before_the_next_wall(
    away: Vec3, later_us: int, afterwards: list[tuple[str, Override]]
) -> None:
    c = posed_core_in("contact")
    c.away, c.later_us = away, later_us
    c.run(0.44)
    assert c.core.phase is Phase.RECOVERY
    assert not events(c)
    c.run(0.1)
    assert events(c) == [("pose_source", Override.BREAK_OFF)]
    c.run(1.1)
    assert events(c)[1:] == afterwards


def test_poses_without_a_configured_url_have_no_effect() -> None:
    bare, posed = HandFedCore(), HandFedCore()
    for c, with_poses in ((bare, False), (posed, True)):
        c.enter_approach()
        for _ in range(100):
            c.run(0.008)
            if with_poses:
                c.feed(PoseSample(c.t_us, c.t_us, "dart", False, (9.0, 9.0, 9.0), LEVEL))
    assert bare.outputs == posed.outputs
    assert posed.core.state.pose is not None
