"""The application's side of the lockstep: a report whenever nothing is left to do, and never before."""

from __future__ import annotations

import msgspec
import pytest

from dart_flight.base.records import (
    CommandResult,
    ImuSample,
    LockPhase,
    LockState,
    OdometrySample,
    PlanAnswer,
    PlanRequest,
    Setpoint,
)
from dart_flight.core.pace import BATCH_S
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
    told.reporter.close([imu(4_000), OdometrySample(4_000, 1, ORIGIN, ORIGIN), imu(8_000), imu(6_000)], False)
    assert told.last.streams == {"imu": 8_000, "odometry": 4_000}


def test_nothing_is_reported_while_work_is_open() -> None:
    told = Reports()
    told.reporter.open()  # the lock's state is queued
    told.reporter.close([imu(4_000)], False)
    assert told.last.streams == {}
    told.reporter.close([LockState(4_000, LockPhase.SETTLED, None)])
    assert told.last.streams == {"imu": 4_000}


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
    told.reporter.open_plan(request(1, 100_000, 300_000), 60_000)
    told.reporter.open_plan(request(2, 100_000, 160_000), 60_000)
    told.reporter.close([imu(100_000)], False)
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


def test_a_batch_is_complete_with_its_last_imu_sample() -> None:
    told = Reports()
    assert told.reporter.completes_batch(imu(4_000))
    told.reporter.close([imu(4_000)], True)
    assert told.last.batch_us == BATCH_US
    assert not told.reporter.completes_batch(imu(BATCH_US))
    assert not told.reporter.completes_batch(OdometrySample(4_000 + BATCH_US, 1, ORIGIN, ORIGIN))
    assert told.reporter.completes_batch(imu(4_000 + BATCH_US))


def test_near_a_wall_and_while_the_planner_works_every_sample_counts() -> None:
    told = Reports()
    told.reporter.close([imu(4_000)], False)
    assert told.last.batch_us == 0
    told.reporter.open_plan(request(1, 4_000, 100_000), 60_000)
    told.reporter.close([imu(8_000)], True)
    assert told.last.batch_us == 0
    assert told.reporter.completes_batch(OdometrySample(9_000, 1, ORIGIN, ORIGIN))


def test_a_setpoint_is_reported_with_what_it_leaves_out() -> None:
    told = Reports()
    told.reporter.sent(Setpoint(1, 1, (1.0, 2.0, -1.0), 0.0, (0.1, 0.0, 0.0)))
    told.reporter.close([imu(4_000)], False)
    assert told.last.setpoint == (1.0, 2.0, -1.0, 0.1, 0.0, 0.0, None, None, None)


def test_the_end_is_reported_at_once() -> None:
    told = Reports()
    told.reporter.open()
    told.reporter.end()
    assert not told.last.flies
