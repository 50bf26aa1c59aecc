"""A ground station behind the autopilot's forwarding: every button in every phase of a flight.

Simulated time stops while the operator presses, so that the test reaches each phase on any computer.
"""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

from dart_flight.base.records import (
    MissionEnd,
    OperatorRequest,
    Outcome,
    Phase,
    PhaseChange,
    Record,
    Request,
    StatusText,
)
from dart_flight.run.app import FlightApp, WorldLink
from dart_flight.run.operator_buttons import Button
from dart_flight.run.prepare import load_flyable
from dart_flight.run.simulator_process import SimulatorProcess
from dart_flight.sim.pipe import FULL_SPEED, SimulatorSpec
from dart_flight.vehicle.command_server import Result
from tests.doubles.operator_station import OperatorStation
from tests.doubles.ports import free_udp_port

pytestmark = pytest.mark.mavlink

MISSION = """
version: 1
name: pause and wall
start: {position_m: [0.0, 0.0], altitude_m: 1.0}
goal: {position_m: [0.0, -0.5], capture_radius_m: 0.15, hold_s: 0.5}
bounds_m: {x: [-2.0, 2.2], y: [-1.6, 2.0], z: [0.3, 2.0]}
walls:
  acrylic: {point_m: [1.0, 0.0], normal: [-1.0, 0.0], length_m: 3.0, material: acrylic}
transit_mode: flexible
waypoints:
  - {position_m: [-0.3, 0.0]}
  - {pause: operator, timeout_s: 60.0}
collisions:
  - wall: acrylic
    mode: rigid
    approach: {normal_m_s: -0.8, tangential_m_s: 0.0}
    alpha_m_per_n: [0.025, 0.025]
"""
R = TypeVar("R", bound=Record)
FLOWN = set(Phase) - {Phase.OVERRULED}


class HeldWorld:
    """A world in lockstep, whose time stands still while it is held because it gets no reports."""

    def __init__(self, world: SimulatorProcess) -> None:
        self._world, self._lock = world, threading.Lock()
        self._holds, self._reports = 0, list[bytes]()
        self.send_horn = world.send_horn

    @property
    def died(self) -> bool:
        return self._world.died

    @property
    def cause(self) -> str:
        return self._world.cause

    def send_line(self, line: bytes) -> None:
        with self._lock:
            self._reports.append(line)
            self._pass_on()

    def hold(self) -> None:
        """Stop time until `release` has been called as often as this."""
        with self._lock:
            self._holds += 1

    def release(self) -> None:
        """Let time go on."""
        with self._lock:
            self._holds -= 1
            self._pass_on()

    def _pass_on(self) -> None:
        while self._reports and not self._holds:
            self._world.send_line(self._reports.pop(0))


class PressedFlight:
    """A flight in lockstep that stops in every phase until the operator has pressed his buttons.

    Attributes:
        records: records of the flight.
        texts: texts that the ground station has received.
        end: end of the mission.
    """

    def __init__(self, folder: Path, press: Callable[[OperatorStation, Phase], None]) -> None:
        self.records: list[Record] = []
        self._press, self._errors = press, list[BaseException]()
        self._phases: queue.SimpleQueue[Phase | None] = queue.SimpleQueue()
        path = folder / "mission.yaml"
        path.write_text(MISSION)
        mission = load_flyable(path)
        port, ground = free_udp_port(), free_udp_port()
        spec = SimulatorSpec(mission, 1, [port, ground], speed=FULL_SPEED, lockstep=True)
        with OperatorStation(ground) as station:
            process = SimulatorProcess(spec, lambda record: None)
            try:
                process.wait_ready()
                self._world = HeldWorld(process)
                link = WorldLink(self._world, lockstep=True)
                self._app = FlightApp(mission, f"udpin://127.0.0.1:{port}", self._observe, world_link=link)
                operator = threading.Thread(target=self._operate, args=(station,), daemon=True)
                operator.start()
                asyncio.run(self._app.run())
                self._phases.put(None)
                operator.join(30.0)
            finally:
                process.close()
        if self._errors:
            raise self._errors[0]
        self.texts = station.texts
        (self.end,) = self.records_of(MissionEnd)

    def records_of(self, kind: type[R]) -> list[R]:
        return [record for record in self.records if isinstance(record, kind)]

    def _observe(self, record: Record, number: int) -> None:
        self.records.append(record)
        if isinstance(record, PhaseChange):
            self._world.hold()
            self._phases.put(record.after)

    def _operate(self, station: OperatorStation) -> None:
        connected = False
        while (phase := self._phases.get()) is not None:
            try:
                if not connected:
                    station.wait_for_program()
                    connected = True
                if phase is not Phase.DONE:  # the connection is closing
                    self._press(station, phase)
            except BaseException as error:
                self._errors.append(error)
                self._app.stop()
            finally:
                self._world.release()


def test_every_button_is_answered_in_every_phase_and_a_foreign_system_is_denied(tmp_path: Path) -> None:
    """The land button has a flight of its own."""
    answers: dict[tuple[Phase, Button], int | None] = {}
    foreign: list[int | None] = []

    def press(station: OperatorStation, phase: Phase) -> None:
        if phase in (Phase.CLIMB, Phase.TRANSIT):
            station.system = 42
            foreign.append(station.press(Button.LAND))
            station.system = 255
        for button in (Button.LOCK_RIGID, Button.LOCK_FLEXIBLE, Button.CHECK, Button.FLY, Button.CONTINUE):
            answers[phase, button] = station.press(button, 1)

    flight = PressedFlight(tmp_path, press)
    assert flight.end.outcome is Outcome.COMPLETED, flight.end
    phases = {phase for phase, _ in answers}
    assert phases >= FLOWN - {Phase.READYING, Phase.DONE}
    for (phase, button), answer in answers.items():
        rest = Phase.CONTACT is phase and button is not Button.FLY
        expected = Result.TEMPORARILY_REJECTED if rest else Result.DENIED
        if button is Button.CHECK or (button is Button.CONTINUE and phase is Phase.PAUSE):
            expected = Result.ACCEPTED
        assert answer == expected, (phase, button)
    assert [record.request for record in flight.records_of(OperatorRequest)] == [Request.CONTINUE]
    assert "denied: the mission moves the lock during the flight" in flight.texts
    assert any(text.startswith("in flight: approach; lock rigid") for text in flight.texts)
    noted = [record.text for record in flight.records_of(StatusText) if record.found_here]
    assert "ground station: denied: a mission is flying" in noted
    assert len(foreign) >= 2
    assert set(foreign) == {Result.DENIED}
    assert len([text for text in noted if "system 42" in text]) == 1, "the denial must be reported once"


@pytest.mark.parametrize(
    "land_in",
    [
        Phase.TRANSIT,
        *(pytest.param(phase, marks=pytest.mark.rest) for phase in (Phase.ARMING, Phase.CONTACT)),
    ],
)
def test_the_land_button_lands_and_does_not_release_the_vehicle(tmp_path: Path, land_in: Phase) -> None:
    answers: list[int | None] = []

    def press(station: OperatorStation, phase: Phase) -> None:
        if phase is Phase.PAUSE:
            station.press(Button.CONTINUE)
        if phase is land_in and not answers:
            answers.extend((station.press(Button.LAND), station.press(Button.LAND)))

    end = PressedFlight(tmp_path, press).end
    assert end.outcome is Outcome.ABORTED, "two presses of the land button released the vehicle"
    assert answers == [Result.ACCEPTED, Result.ACCEPTED]
    assert "landing requested" in str(end.reason) or land_in is Phase.ARMING
