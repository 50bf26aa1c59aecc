"""The planner processes answer like planner and fitter, and report their own death."""

import queue
from collections.abc import Callable, Iterator

import msgspec
import pytest

from dart_flight.base.records import ContactAnswer, ContactRequest, PlanAnswer, PlanRequest
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.planning.contact_fit import ContactFitter
from dart_flight.planning.replanner import Replanner
from dart_flight.run.planner_process import PlannerProcess
from tests.planning.test_contact_fit import AT_WALL, contact_request

MISSION = load_mission(packaged("missions", "dual_collision_replan.yaml"))
REQUEST = PlanRequest(
    0, 1, 100_000, 2, (1.0, -1.05, 1.0), (0.3, 0.45, 0.0), (0.0, 0.0, 0.0), (2.6, -0.75, 1.0), 450_000
)
CONTACT = contact_request([0.0] * 3 + [4.0, 12.0, 18.0, 21.0, 21.0, 18.0, 12.0, 4.0, 0.0])


ANSWER_S = 60.0
Answers = queue.SimpleQueue[PlanAnswer | ContactAnswer]


@pytest.fixture
def start() -> Iterator[Callable[[type], tuple[PlannerProcess, Answers]]]:
    """Start the process for a kind of request."""
    started: list[PlannerProcess] = []

    def start(kind: type) -> tuple[PlannerProcess, Answers]:
        answers: Answers = queue.SimpleQueue()
        started.append(PlannerProcess(MISSION, kind, answers.put))
        return started[-1], answers

    yield start
    for process in started:
        process.stop()
        assert process.process.returncode is not None


Start = Callable[[type], tuple[PlannerProcess, Answers]]


def test_the_planner_process_answers_like_the_planner_and_ends_with_its_flight(start: Start) -> None:
    planner, answers = start(PlanRequest)
    planner.send(REQUEST)
    answer = answers.get(timeout=ANSWER_S)
    assert answer.received_us > 0
    assert msgspec.structs.replace(answer, received_us=0) == Replanner(MISSION).answer(REQUEST)
    planner.process.end(patience_s=ANSWER_S)  # `stop` kills it sooner on a busy computer
    assert planner.process.returncode == 0


def test_the_contact_process_answers_like_the_fitter_and_reports_its_death(start: Start) -> None:
    """The second fit of a wall starts from the result of the first one."""
    fits, answers = start(ContactRequest)
    fitter = ContactFitter(MISSION.vehicle)
    for number in (1, 2):
        request = msgspec.structs.replace(CONTACT, number=number)
        fits.send(request)
        answer = answers.get(timeout=ANSWER_S)
        assert msgspec.structs.replace(answer, received_us=0) == fitter.answer(request)
        assert isinstance(answer, ContactAnswer)
        assert answer.wall is not None
        assert (answer.wall.wall, answer.received_us > 0) == (AT_WALL.name, True)
    fits.process.kill()
    fits.process.wait()
    fits.send(msgspec.structs.replace(CONTACT, number=3))
    dead = answers.get(timeout=ANSWER_S)
    assert msgspec.structs.replace(dead, received_us=0) == ContactAnswer(
        0, 3, problem="the planner process ended"
    )


def test_a_dead_planner_is_reported_in_answer_to_a_plan(start: Start) -> None:
    planner, answers = start(PlanRequest)
    planner.process.kill()
    planner.process.wait()
    planner.send(msgspec.structs.replace(REQUEST, number=2))
    dead = answers.get(timeout=ANSWER_S)
    assert isinstance(dead, PlanAnswer)
    assert (dead.number, dead.problem) == (2, "the planner process ended")


def test_two_contacts_of_maximum_length_fit_into_the_pipe(start: Start) -> None:
    """A write that would block is reported as a planner that does not answer."""
    fits, answers = start(ContactRequest)
    long = contact_request([0.0] * 4 + [10.0 + 1.0 / (3.0 + i) for i in range(160)])
    for number in (1, 2):
        fits.send(msgspec.structs.replace(long, number=number))
    for number in (1, 2):
        answer = answers.get(timeout=ANSWER_S)
        assert (answer.number, "ended" in answer.problem) == (number, False)
