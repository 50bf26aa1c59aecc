"""The core thread with inputs queued by hand: what it steps, in which order, and what it may leave out."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import pytest

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ImuSample,
    Input,
    LockPermission,
    OdometrySample,
    Output,
    Record,
    Setpoint,
    SetpointSent,
    Silence,
    StatusSample,
    Tick,
)
from dart_flight.core.flight_core import FlightCore
from dart_flight.core.pace import Pace
from dart_flight.run import core_thread as module
from dart_flight.run.core_thread import CoreThread
from dart_flight.run.runner import CoreRunner
from dart_flight.vehicle.clock import host_us

LEVEL = (1.0, 0.0, 0.0, 0.0)


class SteppedCore(FlightCore):
    """In place of the core: notes what it is given and answers what the test wants."""

    def __init__(self, answer: Callable[[Input], list[Output]] = lambda item: []) -> None:
        self.taken: list[Input] = []
        self.wanted = Pace.BATCHED
        self._answer = answer

    def step(self, item: Input) -> list[Output]:
        self.taken.append(item)
        return [] if isinstance(item, Tick) else self._answer(item)

    @property
    def pace(self) -> Pace:
        return self.wanted

    @property
    def samples(self) -> list[Input]:
        """What it was given, without the ticks."""
        return [item for item in self.taken if not isinstance(item, Tick)]


C = TypeVar("C", bound=SteppedCore)


class Harness(Generic[C]):
    """A core thread with ears: what is sent, carried out and observed, in order."""

    def __init__(self, core: C) -> None:
        self.core = core
        self.turns = 0
        self.did: list[tuple[str, Record]] = []
        self.observed: list[tuple[Record, int]] = []
        self.thread = CoreThread(CoreRunner(core, self, self._observe, host_us), self._alive)

    def send(self, setpoint: Setpoint) -> None:
        self.did.append(("send", setpoint))

    def execute(self, output: Output) -> None:
        self.did.append(("carry out", output))

    def _observe(self, record: Record, number: int) -> None:
        self.observed.append((record, number))

    def _alive(self) -> None:
        self.turns += 1

    def run(self, items: list[Input], seconds: float = 0.0) -> None:
        """What was queued before the thread began is there at once, as after a stall of the machine."""
        for item in items:
            self.thread.put(item)
        self.thread.thread.start()
        deadline = time.monotonic() + 10.0
        last = items[-1] if items else None
        while last is not None and last not in self.core.taken and time.monotonic() < deadline:
            time.sleep(0.002)
        time.sleep(seconds)
        self.thread.stop()
        assert not self.thread.thread.is_alive()


def backlog(rounds: int) -> list[Input]:
    """`rounds` times attitude, odometry, motor commands, IMU; one status in between."""
    items: list[Input] = []
    for t in range(4000, 4000 * (rounds + 1), 4000):
        items.append(AttitudeSample(t, t, LEVEL))
        items.append(OdometrySample(t, t, (0.0, 0.0, -1.0), (0.0, 0.0, 0.0)))
        if t == 4000 * (rounds // 2):
            items.append(StatusSample(t, t))
        items.append(ActuatorSample(t, t, (0.5,) * 4))
        items.append(ImuSample(t, t, (0.0, 0.0, -9.81), (0.0, 0.0, 0.0)))
    return items


def test_of_a_backlog_only_the_newest_of_each_state_stream_is_stepped() -> None:
    harness = Harness(SteppedCore())
    items = backlog(40)
    harness.run(items)
    newest = {type(item): item for item in items}
    kept = [
        item
        for item in items
        if not isinstance(item, AttitudeSample | OdometrySample | ActuatorSample)
        or item is newest[type(item)]
    ]
    # Every IMU sample and the status are there, and the order is that of arrival.
    assert harness.core.samples == kept
    assert len(kept) == 40 + 1 + 3


def test_a_short_queue_is_stepped_as_it_came() -> None:
    harness = Harness(SteppedCore())
    items = backlog(15)
    assert len(items) == 61
    harness.run(items)
    assert harness.core.samples == items


def test_inputs_are_numbered_as_they_are_consumed_with_what_follows_from_them() -> None:
    permission = LockPermission(5, True)
    harness = Harness(SteppedCore(lambda item: [permission] if isinstance(item, StatusSample) else []))
    harness.run(backlog(40))
    inputs = [(record, number) for record, number in harness.observed if record is not permission]
    assert [number for _, number in inputs] == list(range(len(inputs)))
    assert [record for record, _ in inputs] == harness.core.taken
    status = next(number for record, number in inputs if isinstance(record, StatusSample))
    assert [number for record, number in harness.observed if record is permission] == [status]


def test_set_points_are_sent_before_anything_else_is_done() -> None:
    setpoint = Setpoint(4000, 4000, (0.0, 0.0, -1.0), 0.0)
    permission = LockPermission(4000, True)

    def answer(item: Input) -> list[Output]:
        return [permission, setpoint]

    harness = Harness(SteppedCore(answer))
    harness.run([AttitudeSample(4000, 4000, LEVEL)])
    assert harness.did == [("send", setpoint), ("carry out", permission)]
    assert not [r for r, _ in harness.observed if isinstance(r, SetpointSent)]


def test_the_latency_of_a_recovery_set_point_is_observed() -> None:
    received_us = host_us()
    setpoint = Setpoint(4000, received_us, (0.0, 0.0, -1.0), 0.0, recovery=True)
    harness = Harness(SteppedCore(lambda item: [setpoint]))
    harness.run([AttitudeSample(4000, received_us, LEVEL)])
    sent = next(r for r, _ in harness.observed if isinstance(r, SetpointSent))
    assert sent.latency_us == sent.sent_us - received_us
    assert 0 <= sent.latency_us < 5_000_000


def test_without_inputs_it_ticks_every_20_ms_and_says_that_it_lives() -> None:
    harness = Harness(SteppedCore())
    assert harness.thread.age_s() < 1.0
    harness.run([], 0.5)
    ticks = [item.host_us for item in harness.core.taken if isinstance(item, Tick)]
    gaps = sorted(b - a for a, b in itertools.pairwise(ticks))
    assert 5 <= len(ticks) <= 26  # a shared machine may hold it up; it never goes faster
    assert gaps[0] >= 20_000
    assert gaps[len(gaps) // 2] < 60_000
    assert harness.turns >= len(ticks)
    assert harness.core.samples == []
    time.sleep(0.1)
    assert 0.1 <= harness.thread.age_s() < 10.0  # it does not come round any more


# --- the core's pace: which thread steps, and when ---------------------------------------------------------


def attitude(t_us: int) -> AttitudeSample:
    return AttitudeSample(t_us, t_us, LEVEL)


class WatchedCore(SteppedCore):
    """Notes on which thread it was stepped, and that no two were in it at once."""

    def __init__(self) -> None:
        super().__init__()
        self.threads: list[str] = []
        self.inside = self.collided = 0
        self.held = threading.Event()  # a step waits for it
        self.held.set()
        self.broken = False

    def step(self, item: Input) -> list[Output]:
        self.inside += 1
        self.collided += self.inside > 1
        if not isinstance(item, Tick):
            self.threads.append(threading.current_thread().name)
            assert self.held.wait(10.0)
            if self.broken:
                raise RuntimeError("the core must not raise")
        out = super().step(item)
        self.inside -= 1
        return out


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


@pytest.fixture
def watched() -> Iterator[Harness[WatchedCore]]:
    harness = Harness(WatchedCore())
    yield harness
    harness.core.held.set()
    harness.thread.stop()


def begin(harness: Harness[WatchedCore], pace: Pace) -> None:
    """Start the thread and let the core have said how soon it wants its inputs."""
    harness.core.wanted = pace
    harness.thread.thread.start()
    wait_for(lambda: bool(harness.core.taken))


def test_in_haste_an_input_is_stepped_on_the_thread_that_brings_it(watched: Harness[WatchedCore]) -> None:
    begin(watched, Pace.IMMEDIATE)
    watched.thread.arrive(attitude(4000))
    assert watched.core.samples == [attitude(4000)]  # when `arrive` returns, not some time later
    assert watched.core.threads == [threading.current_thread().name]


def test_otherwise_the_cores_own_thread_steps(watched: Harness[WatchedCore]) -> None:
    begin(watched, Pace.BATCHED)
    for t_us in range(4000, 24000, 4000):
        watched.thread.arrive(attitude(t_us))
    wait_for(lambda: len(watched.core.samples) == 5)
    assert watched.core.samples == [attitude(t_us) for t_us in range(4000, 24000, 4000)]
    assert set(watched.core.threads) == {"core"}


def test_with_patience_inputs_do_not_wake_the_thread(watched: Harness[WatchedCore]) -> None:
    """Ten inputs, each before the next turn is due: several share a turn, however slow the machine."""
    begin(watched, Pace.BATCHED)
    turns = watched.turns
    began = time.monotonic()
    for i in range(1, 11):
        watched.thread.arrive(attitude(4000 * i))
        time.sleep(0.004)
    took_s = time.monotonic() - began
    assert watched.turns - turns <= took_s / 0.02 + 1


def test_what_other_threads_put_is_stepped_with_the_next_turn(watched: Harness[WatchedCore]) -> None:
    begin(watched, Pace.IMMEDIATE)
    watched.thread.put(attitude(4000))
    wait_for(lambda: bool(watched.core.samples))
    assert watched.core.threads == ["core"]


def test_two_threads_never_step_at_once_and_nothing_is_left_lying(watched: Harness[WatchedCore]) -> None:
    begin(watched, Pace.IMMEDIATE)
    watched.core.held.clear()
    first = threading.Thread(target=watched.thread.arrive, args=(attitude(4000),), name="first")
    first.start()
    wait_for(lambda: watched.core.threads == ["first"])  # in the step, and held there
    watched.thread.arrive(attitude(8000))  # returns at once
    assert watched.core.samples == []
    watched.core.held.set()
    first.join(10.0)
    assert watched.core.samples == [attitude(4000), attitude(8000)]
    assert watched.core.threads == ["first", "first"]
    assert not watched.core.collided


def test_at_the_end_of_haste_the_cores_own_thread_takes_over(watched: Harness[WatchedCore]) -> None:
    begin(watched, Pace.IMMEDIATE)
    watched.core.wanted = Pace.BATCHED
    watched.thread.arrive(attitude(4000))
    watched.thread.arrive(attitude(8000))
    wait_for(lambda: len(watched.core.samples) == 2)
    assert watched.core.threads == [threading.current_thread().name, "core"]


def test_at_the_end_of_haste_the_cores_own_thread_is_called_once_and_then_has_its_patience(
    watched: Harness[WatchedCore], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long a turn would be waited for."""
    begin(watched, Pace.IMMEDIATE)
    monkeypatch.setattr(module, "BATCH_S", 60.0)
    time.sleep(0.1)  # the turn under way ends
    turns = watched.turns
    time.sleep(0.1)
    assert watched.turns == turns
    watched.core.wanted = Pace.BATCHED
    watched.thread.arrive(attitude(4000))
    wait_for(lambda: watched.turns > turns)
    time.sleep(0.1)
    turns = watched.turns
    time.sleep(0.1)
    assert watched.turns <= turns + 1  # it waits, and does not go round and round


def test_a_step_that_hangs_on_another_thread_starves_the_deadman(watched: Harness[WatchedCore]) -> None:
    begin(watched, Pace.IMMEDIATE)
    watched.core.held.clear()
    hanging = threading.Thread(target=watched.thread.arrive, args=(attitude(4000),), name="hanging")
    hanging.start()
    wait_for(lambda: bool(watched.core.threads))
    time.sleep(0.1)  # the turn under way ends
    turns = watched.turns
    time.sleep(0.2)
    assert watched.turns == turns
    watched.core.held.set()
    hanging.join(10.0)
    wait_for(lambda: watched.turns > turns)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_fault_on_another_thread_ends_the_cores_own(watched: Harness[WatchedCore]) -> None:
    """MAVSDK's thread would swallow it and go on; so the deadman sees it as it sees any other."""
    begin(watched, Pace.IMMEDIATE)
    watched.core.broken = True
    watched.thread.arrive(attitude(4000))
    watched.thread.thread.join(10.0)
    assert not watched.thread.thread.is_alive()


def setpoint_at(t_us: int) -> Setpoint:
    return Setpoint(t_us, t_us, (0.0, 0.0, -1e-6 * t_us), 0.0)


def at_one_go(answer: Callable[[Input], list[Output]], times_us: list[int]) -> Harness[SteppedCore]:
    """Attitudes that are all there when the thread begins."""
    harness = Harness(SteppedCore(answer))
    harness.run([attitude(t_us) for t_us in times_us])
    return harness


def test_of_set_points_decided_at_one_go_the_newest_leaves_and_all_are_logged() -> None:
    harness = at_one_go(
        lambda item: [setpoint_at(item.t_us)] if isinstance(item, AttitudeSample) else [], [4, 8, 12]
    )
    assert harness.did == [("send", setpoint_at(12))]
    assert [r for r, _ in harness.observed if isinstance(r, Setpoint)] == [setpoint_at(t) for t in (4, 8, 12)]


def test_a_set_point_leaves_before_what_is_carried_out_after_it() -> None:
    permission = LockPermission(8, True)
    answers: dict[int, list[Output]] = {4: [setpoint_at(4)], 8: [permission], 12: []}
    harness = at_one_go(lambda item: answers.get(getattr(item, "t_us", 0), []), [4, 8, 12])
    assert harness.did == [("send", setpoint_at(4)), ("carry out", permission)]


@pytest.mark.parametrize("times_us", [[4, 8], [4, 8, 12]], ids=["last of its go", "more follows"])
def test_once_silence_is_decided_no_set_point_leaves(times_us: list[int]) -> None:
    silence = Silence(8, "a pilot flies")
    answers: dict[int, list[Output]] = {4: [setpoint_at(4)], 8: [silence], 12: []}
    harness = at_one_go(lambda item: answers.get(getattr(item, "t_us", 0), []), times_us)
    assert harness.did == [("carry out", silence)]


def test_a_set_point_of_the_recovery_never_waits_and_replaces_what_does() -> None:
    recovery = Setpoint(8, 8, (0.0, 0.0, -1.0), 0.0, recovery=True)
    answers: dict[int, list[Output]] = {4: [setpoint_at(4)], 8: [recovery], 12: []}
    harness = at_one_go(lambda item: answers.get(getattr(item, "t_us", 0), []), [4, 8, 12])
    assert harness.did == [("send", recovery)]


def test_after_the_stop_nothing_is_stepped(watched: Harness[WatchedCore]) -> None:
    begin(watched, Pace.IMMEDIATE)
    watched.thread.stop()
    watched.thread.arrive(attitude(4000))
    assert watched.core.samples == []


def test_a_stop_is_heard_however_long_the_next_turn_would_be_waited_for(
    watched: Harness[WatchedCore], monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(watched, Pace.BATCHED)
    monkeypatch.setattr(module, "BATCH_S", 60.0)
    time.sleep(0.1)  # the turn under way ends
    watched.thread.stop()
    assert not watched.thread.thread.is_alive()
