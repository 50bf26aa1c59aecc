"""The application's side of the lockstep: a report whenever nothing is left to do, and never before."""

from __future__ import annotations

import msgspec
import pytest

from dart_flight.base.records import (
    CommandResult,
    ContactAnswer,
    ContactRequest,
    ImpactOnset,
    ImuSample,
    Input,
    LockPhase,
    LockState,
    OdometrySample,
    OperatorRequest,
    Output,
    PlanAnswer,
    PlanRequest,
    PoseSample,
    Request,
    Setpoint,
    StatusSample,
    StatusText,
    Tick,
)
from dart_flight.core.pace import BATCH_S, Pace
from dart_flight.run.core_thread import CoreThread
from dart_flight.run.runner import CoreRunner
from dart_flight.run.step_reporter import StepReporter
from dart_flight.sim.pipe import Stepped

ORIGIN = (0.0, 0.0, 0.0)
BATCH_US = round(1e6 * BATCH_S)


class Reports:
    """A reporter that has begun, and what it has reported."""

    def __init__(self) -> None:
        self.lines: list[bytes] = []
        self.reporter = StepReporter(self.lines.append)
        assert not self.lines, "the world does not wait before the streams are requested"
        self.reporter.begin()

    @property
    def last(self) -> Stepped:
        return msgspec.json.decode(self.lines[-1], type=Stepped)


def imu(t_us: int) -> ImuSample:
    return ImuSample(t_us, t_us, ORIGIN, ORIGIN)


def request(number: int, t_us: int, begin_us: int) -> PlanRequest:
    return PlanRequest(t_us, number, begin_us, None, ORIGIN, ORIGIN, ORIGIN, ORIGIN, None)


def test_stepped_samples_are_reported_by_the_newest_stamp_of_their_stream() -> None:
    told = Reports()
    told.reporter.close(
        [imu(4_000), OdometrySample(4_000, 1, ORIGIN, ORIGIN), imu(8_000), imu(6_000)], 0, False
    )
    assert told.last.streams == {"imu": 8_000, "odometry": 4_000}


def test_nothing_is_reported_while_work_is_open() -> None:
    told = Reports()
    told.reporter.open()  # the lock's state is queued
    told.reporter.close([imu(4_000)], 0, False)
    assert told.last.streams == {}
    told.reporter.close([LockState(4_000, LockPhase.SETTLED, None)])
    assert told.last.streams == {"imu": 4_000}


def test_samples_are_reported_while_a_command_is_open_whatever_else_is() -> None:
    """A lock order by PX4's output is open work that waits for a command, which needs time to advance."""
    told = Reports()
    told.reporter.open()
    with told.reporter.command():
        told.reporter.close([imu(4_000)], 0)
        assert (told.last.streams, told.last.commands) == ({"imu": 4_000}, 1)
    told.reporter.close([imu(8_000)], 0)
    assert told.last.streams == {"imu": 4_000}, "the order is still open"


def test_a_command_is_open_until_its_result_is_stepped() -> None:
    told = Reports()
    told.reporter.open_command()
    assert told.last.commands == 1
    told.reporter.open()
    told.reporter.close([CommandResult(0, "arm", True)])
    assert told.last.commands == 0


def test_a_request_that_fails_is_no_longer_open() -> None:
    told = Reports()

    def fail() -> None:
        with told.reporter.command():
            assert told.last.commands == 1
            raise OSError("gone")

    with pytest.raises(OSError, match="gone"):
        fail()
    assert told.last.commands == 0


def test_an_answer_of_the_planner_counts_from_its_latency_on_and_before_its_trajectory_begins() -> None:
    told = Reports()
    clock = told.reporter.clock
    told.reporter.open_request(request(1, 100_000, 300_000), 60_000)
    told.reporter.open_request(request(2, 100_000, 160_000), 60_000)
    told.reporter.close([imu(100_000)], 0, False)
    assert told.last.plan_due_us == 120_000
    for number in (1, 2):
        told.reporter.hold_answer(PlanAnswer(0, number, 0))
    clock.receive(119_999, 0)
    assert told.reporter.due_answers() == []
    clock.receive(120_000, 0)
    assert [answer.number for answer in told.reporter.due_answers()] == [2]
    clock.receive(160_000, 0)
    assert [answer.number for answer in told.reporter.due_answers()] == [1]
    assert told.reporter.due_answers() == []


def test_a_fit_is_waited_for_like_a_plan_of_the_same_number() -> None:
    told = Reports()
    clock = told.reporter.clock
    onset = ImpactOnset(90_000, 90_000, 0, ORIGIN, ORIGIN, ORIGIN)
    contact = ContactRequest(100_000, 1, onset, None, (1.0, 0.0), None, 0.0, (0.0, 0.0), 0.1, (0.1, 0.1, 0.1))
    told.reporter.open_request(contact, 50_000)
    told.reporter.open_request(request(1, 100_000, 300_000), 60_000)
    told.reporter.close([imu(100_000)], 0, False)
    assert told.last.plan_due_us == 150_000
    plan, fit = PlanAnswer(0, 1, 0), ContactAnswer(0, 1)
    told.reporter.hold_answer(plan)
    told.reporter.hold_answer(fit)
    clock.receive(150_000, 0)
    assert told.reporter.due_answers() == [fit]
    told.reporter.close([fit], 0)
    assert told.last.plan_due_us == 160_000
    clock.receive(160_000, 0)
    assert told.reporter.due_answers() == [plan]
    told.reporter.close([plan], 0)
    assert told.last.plan_due_us is None


def test_a_batch_is_complete_with_its_last_imu_sample() -> None:
    told = Reports()
    assert told.reporter.completes_batch(imu(4_000))
    told.reporter.close([imu(4_000)], 0, True)
    assert told.last.batch_us == BATCH_US
    assert not told.reporter.completes_batch(imu(BATCH_US))
    assert not told.reporter.completes_batch(OdometrySample(4_000 + BATCH_US, 1, ORIGIN, ORIGIN))
    assert told.reporter.completes_batch(imu(4_000 + BATCH_US))


def test_near_a_wall_and_while_the_planner_works_every_sample_counts() -> None:
    told = Reports()
    told.reporter.close([imu(4_000)], 0, False)
    assert told.last.batch_us == 0
    told.reporter.open_request(request(1, 4_000, 100_000), 60_000)
    told.reporter.close([imu(8_000)], 0, True)
    assert told.last.batch_us == 0
    assert told.reporter.completes_batch(OdometrySample(9_000, 1, ORIGIN, ORIGIN))


def test_a_setpoint_is_reported_with_what_it_leaves_out() -> None:
    told = Reports()
    told.reporter.sent(Setpoint(1, 1, (1.0, 2.0, -1.0), 0.0, (0.1, 0.0, 0.0)))
    told.reporter.close([imu(4_000)], 0, False)
    assert told.last.sent["setpoint"] == (1.0, 2.0, -1.0, 0.1, 0.0, 0.0, None, None, None)


def test_poses_are_reported_by_frame_and_by_what_was_forwarded_and_samples_not_in_batches() -> None:
    lines: list[bytes] = []
    reporter = StepReporter(lines.append, batches=False)
    reporter.begin()
    pose = PoseSample(8_000, 8_000, "dart", True, (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), frame_number=7)
    reporter.sent_pose((2.0, 1.0, -3.0))
    reporter.close([imu(8_000), pose], 0, True)
    last = msgspec.json.decode(lines[-1], type=Stepped)
    assert last.streams == {"imu": 8_000, "pose": 7}
    assert last.sent == {"pose": (2.0, 1.0, -3.0)}
    assert last.batch_us == 0
    assert reporter.completes_batch(OdometrySample(9_000, 1, ORIGIN, ORIGIN))


def test_the_end_is_reported_at_once() -> None:
    told = Reports()
    told.reporter.open()
    told.reporter.end()
    assert not told.last.flies


class CountingCore:
    """A core that keeps what it is given, and wants batches or not."""

    def __init__(self, pace: Pace) -> None:
        self.pace = pace
        self.taken: list[Input] = []

    def step(self, item: Input) -> list[Output]:
        if not isinstance(item, Tick):
            self.taken.append(item)
        return []


class Thread(Reports):
    """A core thread in lockstep, whose core does nothing."""

    def __init__(self, pace: Pace) -> None:
        super().__init__()
        self.core = CountingCore(pace)
        runner = CoreRunner(self.core, self, lambda record, number: None, self.reporter.clock.host_us)
        self.thread = CoreThread(runner, lockstep=self.reporter)

    def send(self, setpoint: Setpoint) -> None:
        """As `CommandSink`."""

    def execute(self, output: Output) -> None:
        """As `CommandSink`."""

    def arrive(self, item: ImuSample | OdometrySample) -> None:
        """As the session: the clock first."""
        self.reporter.clock.receive(item.t_us, item.received_us)
        self.thread.arrive(item)


@pytest.mark.parametrize(
    "item",
    [
        StatusText(0, 0, "critical", "setpoint not sent", found_here=True),
        OperatorRequest(0, Request.LAND),
        LockState(0, LockPhase.SETTLED, None),
        StatusSample(0, 0),
    ],
    ids=lambda item: type(item).__name__,
)
def test_whatever_is_put_is_stepped_at_once_and_no_open_work_stays(item: Input) -> None:
    told = Thread(Pace.BATCHED)
    told.arrive(imu(4_000))
    told.arrive(imu(8_000))
    assert told.core.taken == [imu(4_000)], "the rest of the batch is to come"
    told.thread.put(item)
    assert told.core.taken == [imu(4_000), imu(8_000), item]
    assert told.last.streams == {"imu": 8_000}


def test_a_batch_is_stepped_whole_when_its_last_imu_sample_comes() -> None:
    told = Thread(Pace.BATCHED)
    for t_us in range(4_000, 4_000 + BATCH_US, 4_000):
        told.arrive(imu(t_us))
    assert len(told.core.taken) == 1
    told.arrive(imu(4_000 + BATCH_US))
    assert len(told.core.taken) == 1 + BATCH_US // 4_000
    assert told.last.streams == {"imu": 4_000 + BATCH_US}


def test_near_a_wall_each_sample_is_stepped_as_it_comes() -> None:
    told = Thread(Pace.IMMEDIATE)
    for t_us in (4_000, 8_000, 12_000):
        told.arrive(imu(t_us))
        assert told.last.streams == {"imu": t_us}


def test_a_fault_of_the_core_is_never_reported_as_stepped() -> None:
    told = Thread(Pace.IMMEDIATE)

    def fail(item: Input) -> list[Output]:
        raise ZeroDivisionError

    told.core.step = fail  # type: ignore[method-assign]
    told.arrive(imu(4_000))
    assert told.last.streams == {}, "the world ends the flight after 10 s"
