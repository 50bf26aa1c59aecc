"""The core thread with inputs queued by hand: which inputs it steps, in which order, and which it skips."""

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
    VehicleAction,
    VehicleCommand,
)
from dart_flight.core.flight_core import FlightCore
from dart_flight.core.pace import Pace
from dart_flight.run import core_thread as module
from dart_flight.run.core_thread import CoreThread
from dart_flight.run.shell import Shell
from dart_flight.run.timing import LockstepTime, RealTime
from dart_flight.vehicle.clock import host_us
from tests.real_time import wait_until
from tests.run.recorded_commands import RecordedCommands

LEVEL = (1.0, 0.0, 0.0, 0.0)


class SteppedCore(FlightCore):
    """A double of the core that records its inputs and returns scripted outputs."""

    def __init__(self, answer: Callable[[Input], list[Output]] = lambda item: []) -> None:
        self.stepped: list[Input] = []
        self.current_pace = Pace.BATCHED
        self._answer = answer

    def step(self, item: Input) -> list[Output]:
        self.stepped.append(item)
        return [] if isinstance(item, Tick) else self._answer(item)

    @property
    def pace(self) -> Pace:
        return self.current_pace

    @property
    def samples(self) -> list[Input]:
        """Inputs without the ticks."""
        return [item for item in self.stepped if not isinstance(item, Tick)]


C = TypeVar("C", bound=SteppedCore)


class Harness(Generic[C]):
    """A core thread whose sent setpoints, executed outputs and observed records are kept in order."""

    def __init__(self, core: C, time: RealTime | None = None) -> None:
        self.core = core
        self.turns = 0
        self.observed: list[tuple[Record, int]] = []
        self.transport = RecordedCommands()
        self.shell = Shell(core, self.transport, self._observe, time or RealTime())
        self.thread = CoreThread(self.shell, self._alive)

    def _observe(self, record: Record, number: int) -> None:
        self.observed.append((record, number))

    def _alive(self) -> None:
        self.turns += 1

    def run(self, items: list[Input], seconds: float = 0.0) -> None:
        """Queue all items before the thread starts, as after a stall of the computer."""
        for item in items:
            self.thread.put(item)
        self.thread.thread.start()
        if items:
            wait_for(lambda: items[-1] in self.core.stepped)
        time.sleep(seconds)
        self.thread.stop()
        assert not self.thread.thread.is_alive()


def backlog(rounds: int) -> list[Input]:
    """Return `rounds` times attitude, odometry, motor commands and IMU, with one status in the middle."""
    items: list[Input] = []
    for t in range(4000, 4000 * (rounds + 1), 4000):
        items.append(AttitudeSample(t, t, LEVEL))
        items.append(OdometrySample(t, t, (0.0, 0.0, -1.0), (0.0, 0.0, 0.0)))
        if t == 4000 * (rounds // 2):
            items.append(StatusSample(t, t))
        items.append(ActuatorSample(t, t, (0.5,) * 4))
        items.append(ImuSample(t, t, (0.0, 0.0, -9.81), (0.0, 0.0, 0.0)))
    return items


def test_only_the_newest_sample_of_each_state_stream_in_a_backlog_is_stepped() -> None:
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
    # Every IMU sample and the status remain, in the order of arrival.
    assert harness.core.samples == kept
    assert len(kept) == 40 + 1 + 3


@pytest.mark.parametrize(("count", "in_full"), [(61, True), (64, True), (65, False)])
def test_a_queue_of_up_to_64_inputs_is_stepped_in_full(count: int, in_full: bool) -> None:
    harness = Harness(SteppedCore())
    items = backlog(20)[:count]
    harness.run(items)
    assert (harness.core.samples == items) is in_full


def test_inputs_are_numbered_in_order_and_outputs_carry_their_inputs_number() -> None:
    permission = LockPermission(5, True)
    harness = Harness(SteppedCore(lambda item: [permission] if isinstance(item, StatusSample) else []))
    harness.run(backlog(40))
    inputs = [(record, number) for record, number in harness.observed if record is not permission]
    assert [number for _, number in inputs] == list(range(len(inputs)))
    assert [record for record, _ in inputs] == harness.core.stepped
    status = next(number for record, number in inputs if isinstance(record, StatusSample))
    assert [number for record, number in harness.observed if record is permission] == [status]


def test_the_latency_of_a_recovery_setpoint_is_recorded() -> None:
    received_us = host_us()
    setpoint = Setpoint(4000, received_us, (0.0, 0.0, -1.0), 0.0, recovery=True)
    harness = Harness(SteppedCore(lambda item: [setpoint]))
    harness.run([AttitudeSample(4000, received_us, LEVEL)])
    (sent,) = [r for r, _ in harness.observed if isinstance(r, SetpointSent)]
    assert sent.latency_us == sent.sent_us - received_us
    assert 0 <= sent.latency_us < 5_000_000


def test_an_idle_core_thread_ticks_every_20_ms_and_reports_that_it_is_alive() -> None:
    harness = Harness(SteppedCore())
    assert harness.thread.age_s() < 1.0
    harness.run([], 0.5)
    ticks = [item.host_us for item in harness.core.stepped if isinstance(item, Tick)]
    gaps = sorted(b - a for a, b in itertools.pairwise(ticks))
    assert 5 <= len(ticks) <= 26  # a shared computer may delay ticks but never adds any
    assert gaps[0] >= 20_000
    assert gaps[len(gaps) // 2] < 60_000
    assert harness.turns >= len(ticks)
    assert harness.core.samples == []
    time.sleep(0.1)
    assert 0.1 <= harness.thread.age_s() < 10.0  # the thread has ended and no longer reports


# --- the core's pace: which thread steps, and when ---------------------------------------------------------


def attitude(t_us: int) -> AttitudeSample:
    return AttitudeSample(t_us, t_us, LEVEL)


class WatchedCore(SteppedCore):
    """Records which thread stepped it, and counts steps that overlap."""

    def __init__(self) -> None:
        super().__init__()
        self.threads: list[str] = []
        self.inside = self.overlaps = 0
        self.may_step = threading.Event()  # a step waits for it
        self.may_step.set()
        self.raises = False

    def step(self, item: Input) -> list[Output]:
        self.inside += 1
        self.overlaps += self.inside > 1
        if not isinstance(item, Tick):
            self.threads.append(threading.current_thread().name)
            assert self.may_step.wait(10.0)
            if self.raises:
                raise RuntimeError("the core must not raise")
        out = super().step(item)
        self.inside -= 1
        return out


def wait_for(condition: Callable[[], object]) -> None:
    wait_until(condition, 10.0, "the core thread")


@pytest.fixture
def watched() -> Iterator[Harness[WatchedCore]]:
    harness = Harness(WatchedCore())
    yield harness
    harness.core.may_step.set()
    harness.thread.stop()


@pytest.fixture
def end_turns(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Set a batch interval of 60 s, and wait until the current turn has ended."""

    def end() -> None:
        # The thread reads this constant in each turn, so a turn can be held back from now on.
        monkeypatch.setattr(module, "BATCH_S", 60.0)
        time.sleep(0.1)

    return end


def start(harness: Harness[WatchedCore], pace: Pace) -> None:
    """Start the thread and wait until it has read the core's pace."""
    harness.core.current_pace = pace
    harness.thread.thread.start()
    wait_for(lambda: bool(harness.core.stepped))


def test_immediate_pace_steps_an_input_on_the_delivering_thread(watched: Harness[WatchedCore]) -> None:
    start(watched, Pace.IMMEDIATE)
    watched.thread.arrive(attitude(4000))
    assert watched.core.samples == [attitude(4000)]  # already stepped when `arrive` returns
    assert watched.core.threads == [threading.current_thread().name]


def test_batched_pace_steps_inputs_on_the_core_thread(watched: Harness[WatchedCore]) -> None:
    start(watched, Pace.BATCHED)
    for t_us in range(4000, 24000, 4000):
        watched.thread.arrive(attitude(t_us))
    wait_for(lambda: len(watched.core.samples) == 5)
    assert watched.core.samples == [attitude(t_us) for t_us in range(4000, 24000, 4000)]
    assert set(watched.core.threads) == {"core"}


def test_batched_pace_does_not_wake_the_core_thread_for_every_input(watched: Harness[WatchedCore]) -> None:
    """Ten inputs arrive faster than turns are due, so several share a turn on any computer."""
    start(watched, Pace.BATCHED)
    turns = watched.turns
    began = time.monotonic()
    for i in range(1, 11):
        watched.thread.arrive(attitude(4000 * i))
        time.sleep(0.004)
    took_s = time.monotonic() - began
    assert watched.turns - turns <= took_s / 0.02 + 1


def test_an_input_put_by_another_thread_is_stepped_in_the_next_turn(watched: Harness[WatchedCore]) -> None:
    start(watched, Pace.IMMEDIATE)
    watched.thread.put(attitude(4000))
    wait_for(lambda: bool(watched.core.samples))
    assert watched.core.threads == ["core"]


def test_two_threads_never_step_at_once_and_leave_no_input_behind(watched: Harness[WatchedCore]) -> None:
    start(watched, Pace.IMMEDIATE)
    watched.core.may_step.clear()
    first = threading.Thread(target=watched.thread.arrive, args=(attitude(4000),), name="first")
    first.start()
    wait_for(lambda: watched.core.threads == ["first"])  # held inside the step
    watched.thread.arrive(attitude(8000))  # returns at once
    assert watched.core.samples == []
    watched.core.may_step.set()
    first.join(10.0)
    wait_for(lambda: len(watched.core.samples) == 2)
    assert watched.core.samples == [attitude(4000), attitude(8000)]
    assert watched.core.threads[0] == "first"  # the core's own thread may get the second
    assert not watched.core.overlaps


def test_the_core_thread_resumes_stepping_when_the_immediate_pace_ends(watched: Harness[WatchedCore]) -> None:
    start(watched, Pace.IMMEDIATE)
    watched.core.current_pace = Pace.BATCHED
    watched.thread.arrive(attitude(4000))
    watched.thread.arrive(attitude(8000))
    wait_for(lambda: len(watched.core.samples) == 2)
    assert watched.core.threads == [threading.current_thread().name, "core"]


def test_the_core_thread_is_woken_once_when_the_immediate_pace_ends(
    watched: Harness[WatchedCore], end_turns: Callable[[], None]
) -> None:
    """Without regular turns, only the wake-up can start one."""
    start(watched, Pace.IMMEDIATE)
    end_turns()
    turns = watched.turns
    time.sleep(0.1)
    assert watched.turns == turns
    watched.core.current_pace = Pace.BATCHED
    watched.thread.arrive(attitude(4000))
    wait_for(lambda: watched.turns > turns)
    time.sleep(0.1)
    turns = watched.turns
    time.sleep(0.1)
    assert watched.turns <= turns + 1  # the thread waits and does not spin


def test_in_lockstep_the_core_thread_only_reports_that_it_is_alive() -> None:
    """The thread that delivers the last sample of a batch steps the whole batch."""
    reporter = LockstepTime(lambda line: None, 0)
    reporter.begin()
    harness = Harness(WatchedCore(), reporter)
    harness.thread.thread.start()
    batch = [ImuSample(t_us, t_us, (0.0, 0.0, -9.81), (0.0, 0.0, 0.0)) for t_us in (4000, 8000, 24_000)]
    for item in batch[:2]:
        harness.thread.arrive(item)
    stepped, turns = list(harness.core.stepped), harness.turns
    assert harness.core.samples == batch[:1]
    wait_for(lambda: harness.turns > turns + 3)
    assert harness.core.stepped == stepped
    harness.thread.arrive(batch[2])
    assert harness.core.samples == batch
    harness.thread.stop()
    assert set(harness.core.threads) == {threading.current_thread().name}


def test_a_step_that_hangs_on_another_thread_starves_the_deadman(watched: Harness[WatchedCore]) -> None:
    start(watched, Pace.IMMEDIATE)
    watched.core.may_step.clear()
    hanging = threading.Thread(target=watched.thread.arrive, args=(attitude(4000),), name="hanging")
    hanging.start()
    wait_for(lambda: bool(watched.core.threads))
    time.sleep(0.1)  # until the current turn ends
    turns = watched.turns
    time.sleep(0.2)
    assert watched.turns == turns
    watched.core.may_step.set()
    hanging.join(10.0)
    wait_for(lambda: watched.turns > turns)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_exception_on_the_delivering_thread_ends_the_core_thread(watched: Harness[WatchedCore]) -> None:
    """MAVSDK's thread would swallow the exception, so the core thread must end for the deadman to react."""
    start(watched, Pace.IMMEDIATE)
    watched.core.raises = True
    watched.thread.arrive(attitude(4000))
    watched.thread.thread.join(10.0)
    assert not watched.thread.thread.is_alive()


def setpoint_at(t_us: int, recovery: bool = False) -> Setpoint:
    return Setpoint(t_us, t_us, (0.0, 0.0, -1e-6 * t_us), 0.0, recovery=recovery)


LAND, SILENCE = VehicleCommand(8, VehicleAction.LAND), Silence(8, "a pilot flies")


@pytest.mark.parametrize(
    ("outputs", "calls"),
    [
        # Only the newest setpoint of a turn is sent, before a later output is executed.
        ([[setpoint_at(4)], [setpoint_at(8)], [setpoint_at(12)]], [setpoint_at(12)]),
        ([[setpoint_at(4)], [LAND], []], [setpoint_at(4), VehicleAction.LAND]),
        ([[LAND, setpoint_at(4)]], [setpoint_at(4), VehicleAction.LAND]),
        # A recovery setpoint is sent at once and replaces a waiting one.
        ([[setpoint_at(4)], [setpoint_at(8, recovery=True)], []], [setpoint_at(8, recovery=True)]),
        # None is sent once silence is decided, whether or not more inputs follow.
        ([[setpoint_at(4)], [SILENCE]], ["silence"]),
        ([[setpoint_at(4)], [SILENCE], []], ["silence"]),
    ],
)
def test_the_outputs_of_a_turn_are_sent_and_executed_in_order_and_all_are_logged(
    outputs: list[list[Output]], calls: list[object]
) -> None:
    """The inputs are queued before the thread starts, so one turn steps them all."""
    items: list[Input] = [attitude(4 * (i + 1)) for i in range(len(outputs))]
    answers = dict(zip(items, outputs, strict=True))
    harness = Harness(SteppedCore(lambda item: answers.get(item, [])))
    harness.run(items)
    assert harness.transport.calls == calls
    logged = [
        record for record, _ in harness.observed if isinstance(record, Setpoint | VehicleCommand | Silence)
    ]
    assert sorted(map(str, logged)) == sorted(str(one) for step in outputs for one in step)


def test_a_stopped_core_thread_steps_no_inputs(watched: Harness[WatchedCore]) -> None:
    start(watched, Pace.IMMEDIATE)
    watched.thread.stop()
    watched.thread.arrive(attitude(4000))
    assert watched.core.samples == []


def test_a_stop_does_not_wait_for_the_next_turn(
    watched: Harness[WatchedCore], end_turns: Callable[[], None]
) -> None:
    start(watched, Pace.BATCHED)
    end_turns()
    watched.thread.stop()
    assert not watched.thread.thread.is_alive()
