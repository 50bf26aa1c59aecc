"""The planner's process: it answers as the planner does, and its death is an answer, too."""

import queue

import msgspec

from dart_flight.base.records import PlanAnswer, PlanRequest
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.planning.replanner import Replanner
from dart_flight.run.replanner_process import ReplannerProcess

MISSION = load_mission(packaged("missions", "dual_collision_replan.yaml"))
REQUEST = PlanRequest(
    0, 1, 100_000, 2, (1.0, -1.05, 1.0), (0.3, 0.45, 0.0), (0.0, 0.0, 0.0), (2.6, -0.75, 1.0), 450_000
)


def test_the_process_answers_as_the_planner_and_its_death_is_told() -> None:
    answers: queue.SimpleQueue[PlanAnswer] = queue.SimpleQueue()
    planner = ReplannerProcess(MISSION, answers.put)
    try:
        planner.send(REQUEST)
        answer = answers.get(timeout=60.0)
        there = answer.received_us
        assert answer == Replanner(MISSION).answer(REQUEST, there)
        assert there > 0
        planner.process.kill()
        planner.process.wait()
        planner.send(msgspec.structs.replace(REQUEST, number=2))
        dead = answers.get(timeout=60.0)
        assert (dead.number, dead.problem) == (2, "the planner has died")
    finally:
        planner.stop()
    assert planner.process.returncode is not None


def test_it_ends_with_its_flight() -> None:
    answers: queue.SimpleQueue[PlanAnswer] = queue.SimpleQueue()
    planner = ReplannerProcess(MISSION, answers.put)
    planner.send(REQUEST)
    answers.get(timeout=60.0)
    planner.stop()
    assert planner.process.returncode == 0
