"""The application's side of the lockstep: it reports only when no work is left to do."""

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
from dart_flight.planning.contact_fit import FIT_US
from dart_flight.run.core_thread import CoreThread
from dart_flight.run.shell import Shell
from dart_flight.run.timing import InProcessTime, LockstepTime, RealTime
from dart_flight.sim.pipe import Stepped
from dart_flight.vehicle.clock import Clock, SimulatedTime
from tests.run.recorded_commands import RecordedCommands

ORIGIN = (0.0, 0.0, 0.0)
BATCH_US = round(1e6 * BATCH_S)


class Reports:
    """A started reporter and its reports."""

    def __init__(self) -> None:
        self.lines: list[bytes] = []
        self.reporter = LockstepTime(self.lines.append, 60_000)
        assert not self.lines, "the world does not wait before the streams are requested"
        self.reporter.begin()

    @property
    def clock(self) -> Clock:
        """The simulated time."""
        assert self.reporter.clock is not None
        return self.reporter.clock

    @property
    def last(self) -> Stepped:
        return msgspec.json.decode(self.lines[-1], type=Stepped)


def imu(t_us: int) -> ImuSample:
    return ImuSample(t_us, t_us, ORIGIN, ORIGIN)


def request(number: int, t_us: int, begin_us: int) -> PlanRequest:
    return PlanRequest(t_us, number, begin_us, None, ORIGIN, ORIGIN, ORIGIN, ORIGIN, None)


def contact_request(number: int) -> ContactRequest:
    onset = ImpactOnset(90_000, 90_000, 0, ORIGIN, ORIGIN, ORIGIN)
    placed = ((1.0, 0.0), None, 0.0, (0.0, 0.0), 0.1, (0.1, 0.1, 0.1))
    return ContactRequest(100_000, number, onset, None, *placed)


def test_stepped_samples_are_reported_by_the_newest_stamp_of_their_stream() -> None:
    reports = Reports()
    reports.reporter.close(
        [imu(4_000), OdometrySample(4_000, 1, ORIGIN, ORIGIN), imu(8_000), imu(6_000)], 0, False
    )
    assert reports.last.streams == {"imu": 8_000, "odometry": 4_000}


def test_no_samples_are_reported_while_work_is_open() -> None:
    reports = Reports()
    reports.reporter.open()  # the lock's state is queued
    reports.reporter.close([imu(4_000)], 0, False)
    assert reports.last.streams == {}
    reports.reporter.close([LockState(4_000, LockPhase.SETTLED, None)])
    assert reports.last.streams == {"imu": 4_000}


def test_samples_are_reported_while_a_command_is_open_despite_other_work() -> None:
    """A lock command by PX4's output is open work that ends only if time advances."""
    reports = Reports()
    reports.reporter.open()
    with reports.reporter.command():
        reports.reporter.close([imu(4_000)], 0)
        assert (reports.last.streams, reports.last.commands) == ({"imu": 4_000}, 1)
    reports.reporter.close([imu(8_000)], 0)
    assert reports.last.streams == {"imu": 4_000}, "the lock command is still open"


def test_a_command_is_open_until_its_result_is_stepped() -> None:
    reports = Reports()
    reports.reporter.open_command()
    assert reports.last.commands == 1
    reports.reporter.open()
    reports.reporter.close([CommandResult(0, "arm", True)])
    assert reports.last.commands == 0


def test_a_failed_command_is_no_longer_open() -> None:
    reports = Reports()

    def fail() -> None:
        with reports.reporter.command():
            assert reports.last.commands == 1
            raise OSError("gone")

    with pytest.raises(OSError, match="gone"):
        fail()
    assert reports.last.commands == 0


def test_a_plan_is_due_after_its_latency_or_just_before_its_trajectory_begins() -> None:
    reports = Reports()
    clock = reports.clock
    reports.reporter.open_request(request(1, 100_000, 300_000))
    reports.reporter.open_request(request(2, 100_000, 160_000))
    reports.reporter.close([imu(100_000)], 0, False)
    assert reports.last.plan_due_us == 120_000
    for number in (1, 2):
        reports.reporter.hold_answer(PlanAnswer(0, number, 0))
    clock.receive(119_999, 0)
    assert reports.reporter.due_answers() == []
    clock.receive(120_000, 0)
    assert [answer.number for answer in reports.reporter.due_answers()] == [2]
    clock.receive(160_000, 0)
    assert [answer.number for answer in reports.reporter.due_answers()] == [1]
    assert reports.reporter.due_answers() == []


def test_a_contact_fit_and_a_plan_of_the_same_number_are_awaited_separately() -> None:
    reports = Reports()
    clock = reports.clock
    reports.reporter.open_request(contact_request(1))
    reports.reporter.open_request(request(1, 100_000, 300_000))
    reports.reporter.close([imu(100_000)], 0, False)
    assert reports.last.plan_due_us == 100_000 + FIT_US
    plan, fit = PlanAnswer(0, 1, 0), ContactAnswer(0, 1)
    reports.reporter.hold_answer(plan)
    reports.reporter.hold_answer(fit)
    clock.receive(100_000 + FIT_US, 0)
    assert reports.reporter.due_answers() == [fit]
    reports.reporter.close([fit], 0)
    assert reports.last.plan_due_us == 160_000
    clock.receive(160_000, 0)
    assert reports.reporter.due_answers() == [plan]
    reports.reporter.close([plan], 0)
    assert reports.last.plan_due_us is None


def test_a_batch_is_complete_with_its_last_imu_sample() -> None:
    reports = Reports()
    assert reports.reporter.completes_batch(imu(4_000))
    reports.reporter.close([imu(4_000)], 0, True)
    assert reports.last.batch_us == BATCH_US
    assert not reports.reporter.completes_batch(imu(BATCH_US))
    assert not reports.reporter.completes_batch(OdometrySample(4_000 + BATCH_US, 1, ORIGIN, ORIGIN))
    assert reports.reporter.completes_batch(imu(4_000 + BATCH_US))


def test_samples_are_not_batched_near_a_wall_or_while_the_planner_works() -> None:
    reports = Reports()
    reports.reporter.close([imu(4_000)], 0, False)
    assert reports.last.batch_us == 0
    reports.reporter.open_request(request(1, 4_000, 100_000))
    reports.reporter.close([imu(8_000)], 0, True)
    assert reports.last.batch_us == 0
    assert reports.reporter.completes_batch(OdometrySample(9_000, 1, ORIGIN, ORIGIN))


def test_a_setpoint_is_reported_with_none_for_missing_components() -> None:
    reports = Reports()
    reports.reporter.sent(Setpoint(1, 1, (1.0, 2.0, -1.0), 0.0, (0.1, 0.0, 0.0)))
    reports.reporter.close([imu(4_000)], 0, False)
    assert reports.last.sent["setpoint"] == (1.0, 2.0, -1.0, 0.1, 0.0, 0.0, None, None, None)


def test_poses_are_reported_by_frame_number_and_as_forwarded() -> None:
    lines: list[bytes] = []
    reporter = LockstepTime(lines.append, 0, batches=False)
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
    reports = Reports()
    reports.reporter.open()
    reports.reporter.end()
    assert not reports.last.flies


class CountingCore:
    """A double of the core that records its inputs and has a fixed pace."""

    def __init__(self, pace: Pace) -> None:
        self.pace = pace
        self.stepped: list[Input] = []

    def step(self, item: Input) -> list[Output]:
        if not isinstance(item, Tick):
            self.stepped.append(item)
        return []


class Thread(Reports):
    """A core thread in lockstep, whose core returns no outputs."""

    def __init__(self, pace: Pace) -> None:
        super().__init__()
        self.core = CountingCore(pace)
        shell = Shell(self.core, RecordedCommands(), lambda record, number: None, self.reporter)
        self.thread = CoreThread(shell)

    def arrive(self, item: ImuSample | OdometrySample) -> None:
        """Deliver a sample like the session, which updates the clock first."""
        self.clock.receive(item.t_us, item.received_us)
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
def test_an_input_put_by_another_thread_is_stepped_at_once_with_its_backlog(item: Input) -> None:
    reports = Thread(Pace.BATCHED)
    reports.arrive(imu(4_000))
    reports.arrive(imu(8_000))
    assert reports.core.stepped == [imu(4_000)], "an incomplete batch must wait"
    reports.thread.put(item)
    assert reports.core.stepped == [imu(4_000), imu(8_000), item]
    assert reports.last.streams == {"imu": 8_000}


@pytest.mark.parametrize("deliver", ["arrive", "put"])
def test_no_input_stays_queued_because_the_core_thread_turns_its_rounds(deliver: str) -> None:
    """A world in lockstep sends nothing more until it has the answer: 10 s later the flight ended."""
    flight = Thread(Pace.IMMEDIATE)
    # The rounds follow each other without rests only if the thread wakes itself, which no caller can do.
    flight.thread._alive = flight.thread._called.set
    flight.thread.thread.start()
    try:
        for t_us in range(4_000, 4_000 * 3_000, 4_000):
            flight.clock.receive(t_us, t_us)
            getattr(flight.thread, deliver)(imu(t_us))
            assert flight.core.stepped[-1] == imu(t_us)
    finally:
        flight.thread.stop()


def test_a_batch_is_stepped_whole_when_its_last_imu_sample_arrives() -> None:
    reports = Thread(Pace.BATCHED)
    for t_us in range(4_000, 4_000 + BATCH_US, 4_000):
        reports.arrive(imu(t_us))
    assert len(reports.core.stepped) == 1
    reports.arrive(imu(4_000 + BATCH_US))
    assert len(reports.core.stepped) == 1 + BATCH_US // 4_000
    assert reports.last.streams == {"imu": 4_000 + BATCH_US}


def test_each_sample_is_stepped_on_arrival_near_a_wall() -> None:
    reports = Thread(Pace.IMMEDIATE)
    for t_us in (4_000, 8_000, 12_000):
        reports.arrive(imu(t_us))
        assert reports.last.streams == {"imu": t_us}


def test_an_input_that_raises_in_the_core_is_never_reported_as_stepped() -> None:
    """Without a report the world ends the flight after 10 s."""
    reports = Thread(Pace.IMMEDIATE)

    def fail(item: Input) -> list[Output]:
        raise ZeroDivisionError

    reports.core.step = fail  # type: ignore[method-assign]
    reports.arrive(imu(4_000))
    assert reports.last.streams == {}


def test_an_answer_is_due_at_once_in_real_time_and_after_its_latency_in_process() -> None:
    real, clock = RealTime(), SimulatedTime()
    in_process = InProcessTime(clock, plan_us=60_000)
    plan, fit = PlanAnswer(0, 1, 0), ContactAnswer(0, 1)
    clock.receive(100_000, 0)
    for time in (real, in_process):
        time.open_request(request(1, 100_000, 300_000))
        time.open_request(contact_request(1))
        time.hold_answer(plan)
        time.hold_answer(fit)
    assert real.due_answers() == [plan, fit]
    clock.receive(100_000 + FIT_US, 0)
    assert in_process.due_answers() == [fit]
    clock.receive(160_000, 0)
    assert in_process.due_answers() == [plan]
