"""The world's side of the lockstep: simulated time waits for the application's answers."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.sim import lockstep as module
from dart_flight.sim.embedded_autopilot import TICK_US
from dart_flight.sim.lockstep import Lockstep, SilentParticipantError
from dart_flight.sim.pipe import FULL_SPEED, Stepped
from dart_flight.sim.served_world import speed_limit

STREAMS = ("imu", "attitude", "odometry", "actuator")
SETPOINT = (1.0, 2.0, -1.0, 0.5, None, None, None, None, None)


class Sender:
    """A double of the autopilot, whose sent and received messages the test sets."""

    def __init__(self) -> None:
        self.sent_us: dict[str, int] = {}
        self.arrived: dict[str, tuple[float, ...]] = {}
        self.rests = 0

    def answer_requests(self) -> None:
        self.rests += 1


class Host:
    """The host's time, which passes only while the world waits."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, wake: int) -> None:
        self.now_s, self._wake = 100.0, wake
        self.after: Callable[[], None] = lambda: None
        monkeypatch.setattr(f"{module.__name__}.time.monotonic", lambda: self.now_s)
        monkeypatch.setattr(f"{module.__name__}.select.select", self._select)

    def wait(self, world: Lockstep, next_us: int) -> float:
        """Let the world wait until it may advance; return the seconds that pass."""
        began_s = self.now_s
        world.wait(next_us, [self._wake], lambda: True)
        return self.now_s - began_s

    def _select(self, *_: Any) -> tuple[list[int], list[int], list[int]]:
        self.now_s += 0.05
        self.after()
        return [], [], []


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> Iterator[Host]:
    descriptor = os.eventfd(0)
    with closing(os.fdopen(descriptor)):
        yield Host(monkeypatch, descriptor)


def make_lockstep(sender: Sender, **more: Any) -> Lockstep:
    return Lockstep(sender, **{"answers_at_rest": True, "waits_at_first": True, **more})


@given(
    sent=st.dictionaries(st.sampled_from(STREAMS), st.integers(1, 100)),
    stepped=st.dictionaries(st.sampled_from(STREAMS), st.integers(1, 100)),
)
def test_time_stops_until_every_stream_is_processed(sent: dict[str, int], stepped: dict[str, int]) -> None:
    sender = Sender()
    world = make_lockstep(sender)
    world.update(Stepped({}))
    sender.sent_us = {name: tick * TICK_US for name, tick in sent.items()}
    world.update(Stepped({name: tick * TICK_US for name, tick in stepped.items()}))
    behind = [name for name, tick in sent.items() if tick > stepped.get(name, 0)]
    assert (world.outstanding(101 * TICK_US) is not None) == bool(behind)


def test_time_does_not_wait_for_messages_from_before_the_connection() -> None:
    sender = Sender()
    sender.sent_us = {"imu": 40_000}
    world = make_lockstep(sender)
    assert world.outstanding(44_000) == "the application to connect"
    world.update(Stepped({}))
    assert world.outstanding(44_000) is None


def test_time_waits_until_a_setpoint_has_arrived_in_single_precision() -> None:
    sender = Sender()
    world = make_lockstep(sender)
    world.update(Stepped({}, {"setpoint": SETPOINT}))
    assert world.outstanding(4_000) == "a setpoint of the application"
    sender.arrived["setpoint"] = (1.0000001, 2.0, -1.0, 0.5, *(math.nan,) * 5)
    assert world.outstanding(4_000) is None


def test_time_waits_until_a_published_pose_is_processed_and_returned() -> None:
    sender = Sender()
    world = make_lockstep(sender)
    world.update(Stepped({}))
    world.publish("pose", 7)
    assert world.outstanding(4_000) == "the application to process its telemetry"
    pose = (1.0, 2.0, -3.0)
    world.update(Stepped({"pose": 7}, {"pose": pose}))
    assert world.outstanding(4_000) == "a pose of the application"
    sender.arrived["pose"] = pose
    assert world.outstanding(4_000) is None


def test_time_does_not_wait_for_a_batch_before_its_end() -> None:
    sender = Sender()
    world = make_lockstep(sender)
    world.update(Stepped({"imu": 100_000}, batch_us=20_000))
    sender.sent_us = {"imu": 116_000}
    assert world.outstanding(120_000) is None
    assert world.outstanding(124_000) is not None


def test_time_waits_for_the_planner_when_its_answer_is_due() -> None:
    world = make_lockstep(Sender())
    world.update(Stepped({}, plan_due_us=50_000))
    assert world.outstanding(54_000) is None, "the next stamp is later than the due time"
    assert world.outstanding(55_000) == "the planner"


@pytest.mark.parametrize("answers_at_rest", [True, False], ids=["embedded", "PX4"])
def test_time_continues_for_an_autopilot_that_needs_it_to_answer_commands(answers_at_rest: bool) -> None:
    sender = Sender()
    world = make_lockstep(sender, answers_at_rest=answers_at_rest)
    world.update(Stepped({"imu": 4_000}, {"setpoint": SETPOINT}, commands=1))
    sender.sent_us = {"imu": 4_000}
    assert (world.outstanding(8_000) is None) != answers_at_rest, "a setpoint waits for the result"
    assert world.limits_pace is answers_at_rest, "otherwise a world at full speed would run ahead"
    sender.sent_us = {"imu": 8_000}
    assert world.outstanding(12_000) is not None, "the world always waits for telemetry"


@pytest.mark.parametrize("speed", [0.3, 1.0, 10.0, FULL_SPEED])
def test_a_world_in_lockstep_is_faster_than_real_time_only_while_the_application_holds_it_back(
    speed: float,
) -> None:
    """Beside other work, the telemetry of a faster world would run ahead of the application."""
    world = make_lockstep(Sender(), answers_at_rest=False, waits_at_first=False)
    at_most = min(speed, 1.0)
    assert speed_limit(speed, world, connected=True) == at_most, "before the first report"
    world.update(Stepped({}))
    assert speed_limit(speed, world, connected=True) == speed
    world.update(Stepped({}, commands=1))
    assert speed_limit(speed, world, connected=True) == at_most, "PX4 needs time to answer"
    assert speed_limit(speed, world, connected=False) == at_most
    assert speed_limit(speed, None, connected=True) == speed, "the user wants no lockstep"


def test_time_does_not_wait_for_a_silenced_application() -> None:
    sender = Sender()
    world = make_lockstep(sender)
    world.update(Stepped({}, {"setpoint": SETPOINT}, commands=1, flies=False))
    sender.sent_us = {"imu": 4_000}
    assert world.outstanding(8_000) is None
    assert not world.engaged


def test_a_setpoint_that_arrives_between_two_checks_ends_the_wait_at_once(host: Host) -> None:
    class Arriving(Sender):
        def answer_requests(self) -> None:
            self.arrived["setpoint"] = tuple(math.nan if value is None else value for value in SETPOINT)

    world = make_lockstep(Arriving())
    world.update(Stepped({}, {"setpoint": SETPOINT}))
    assert host.wait(world, 4_000) == 0.0


@pytest.mark.parametrize(
    ("report", "named"),
    [
        (Stepped({"imu": 4_000}), "process its telemetry, imu 4000 of 8000"),
        (
            Stepped({"imu": 8_000}, {"setpoint": SETPOINT}),
            "a setpoint of the application: sent 1.000 2.000 -1.000 0.500 - - - - -, arrived nothing",
        ),
        (
            Stepped({"imu": 8_000}, {"pose": (1.0, 2.0, 3.0)}),
            "a pose of the application: sent 1.000 2.000 3.000, arrived nothing",
        ),
    ],
)
def test_a_message_that_is_lost_on_either_way_is_named_after_a_second_and_time_goes_on(
    host: Host, report: Stepped, named: str
) -> None:
    sender, log = Sender(), list[str]()
    world = make_lockstep(sender, log=log.append)
    world.update(report)
    sender.sent_us = {"imu": 8_000}
    assert host.wait(world, 12_000) == pytest.approx(1.0, abs=0.2)
    assert sender.rests > 10
    assert len(log) == 1
    assert log[0].startswith("the simulation has waited 1.")
    assert log[0].endswith(named)
    world.update(Stepped({"imu": 8_000}))
    host.wait(world, 12_000)
    assert log[1:] == ["the simulation continues"]


def test_a_lost_setpoint_delays_the_world_only_once(host: Host) -> None:
    """The application sends an unchanged setpoint again only after 0.1 s of simulated time."""
    world, waited_s = make_lockstep(Sender()), 0.0
    for tick in range(25):
        world.update(Stepped({}, {"setpoint": SETPOINT}))
        waited_s += host.wait(world, 4_000 * tick)
    assert waited_s == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("keeps_reporting", [False, True])
@pytest.mark.parametrize(
    ("report", "missing"),
    [
        (Stepped({"imu": 4_000}, plan_due_us=3_000), "the planner"),
        (Stepped({"imu": 4_000}, commands=1), "the result of a command"),
    ],
)
def test_a_participant_that_is_silent_for_ten_seconds_is_named_and_ends_the_flight(
    host: Host, report: Stepped, missing: str, keeps_reporting: bool
) -> None:
    """The application may keep reporting meanwhile."""
    world = make_lockstep(Sender())
    world.update(report)
    if keeps_reporting:
        host.after = lambda: world.update(report)
    began_s = host.now_s
    with pytest.raises(SilentParticipantError, match=f"waited 10 s for {missing}"):
        host.wait(world, 8_000)
    assert host.now_s - began_s == pytest.approx(10.0, abs=0.2)


def test_a_stopped_application_ends_the_flight_despite_the_tolerance_of_losses(host: Host) -> None:
    sender, ticks = Sender(), list[int]()
    world = make_lockstep(sender)
    world.update(Stepped({"imu": 4_000}))
    began_s = host.now_s

    def fly_on() -> None:
        for tick in range(1000):
            sender.sent_us = {"imu": 8_000 + tick * TICK_US}
            host.wait(world, 12_000 + tick * TICK_US)
            ticks.append(tick)

    with pytest.raises(SilentParticipantError, match="process its telemetry"):
        fly_on()
    assert host.now_s - began_s == pytest.approx(10.0, abs=0.5)
    assert len(ticks) <= 10


def test_a_suspension_of_the_host_does_not_count_as_silence(host: Host) -> None:
    world = make_lockstep(Sender())
    world.update(Stepped({}, plan_due_us=0))

    def sleep() -> None:
        host.now_s += 3600.0  # the computer was suspended
        host.after = lambda: world.update(Stepped({}))

    host.after = sleep
    assert host.wait(world, 8_000) > 3600.0


def test_the_world_continues_without_its_application() -> None:
    make_lockstep(Sender()).wait(4_000, [], lambda: False)


def test_px4_gets_time_to_send_telemetry_that_is_due(host: Host) -> None:
    sender = Sender()
    world = make_lockstep(sender, answers_at_rest=False, sender_lag_us=16_000)
    world.update(Stepped({"imu": 100_000}))
    sender.sent_us = {"imu": 100_000}
    assert world.outstanding(116_000) is None
    assert world.outstanding(120_000) == "the autopilot to send its telemetry"
    assert host.wait(world, 120_000) == pytest.approx(0.2, abs=0.1)
