"""A ground station behind the autopilot's forwarding: every button in every phase of a flight.

Simulated time stops while the operator presses, so that the test reaches each phase on any computer.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

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
from dart_flight.config.mission import Mission
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
FLOWN = set(Phase) - {Phase.OVERRULED}


class PressedFlight:
    """A flight in lockstep that stops in every phase until the operator has pressed his buttons.

    Args:
        folder: for the mission file.
        press: the operator's presses in a phase.
    """

    def __init__(self, folder: Path, press: Callable[[OperatorStation, Phase], None]) -> None:
        self.records: list[Record] = []
        self._press = press
        self._phases: queue.SimpleQueue[Phase | None] = queue.SimpleQueue()
        path = folder / "mission.yaml"
        path.write_text(MISSION)
        self._mission: Mission = load_flyable(path)
        self.errors: list[BaseException] = []

    def fly(self) -> None:
        port, ground = free_udp_port(), free_udp_port()
        spec = SimulatorSpec(self._mission, 1, [port, ground], speed=FULL_SPEED, lockstep=True)
        with OperatorStation(ground) as station:
            world = SimulatorProcess(spec, lambda record: None)
            try:
                world.wait_ready()
                url = f"udpin://127.0.0.1:{port}"
                world_link = WorldLink(world, lockstep=True)
                self._app = FlightApp(self._mission, url, self._observe, world_link=world_link)
                operator = threading.Thread(target=self._operate, args=(station,), daemon=True)
                operator.start()
                asyncio.run(self._app.run())
                self._phases.put(None)
                operator.join(30.0)
            finally:
                world.close()
        self.texts = station.texts
        if self.errors:
            raise self.errors[0]

    def records_of(self, kind: type[Record]) -> list[Record]:
        return [record for record in self.records if isinstance(record, kind)]

    def _observe(self, record: Record, number: int) -> None:
        self.records.append(record)
        if isinstance(record, PhaseChange):
            assert self._app._lockstep is not None
            self._app._lockstep.open()  # time stops until the operator is done
            self._phases.put(record.after)

    def _operate(self, station: OperatorStation) -> None:
        connected = False
        while (phase := self._phases.get()) is not None:
            with self._resumed():
                try:
                    if not connected:
                        station.wait_for_program()
                        connected = True
                    if phase is not Phase.DONE:  # the connection is closing
                        self._press(station, phase)
                except BaseException as error:
                    self.errors.append(error)
                    self._app.stop()

    @contextlib.contextmanager
    def _resumed(self) -> Iterator[None]:
        try:
            yield
        finally:
            assert self._app._lockstep is not None
            self._app._lockstep.close()


def test_every_button_except_land_is_answered_in_every_phase(tmp_path: Path) -> None:
    answers: dict[tuple[Phase, Button], int | None] = {}

    def press(station: OperatorStation, phase: Phase) -> None:
        for button in (Button.LOCK_RIGID, Button.LOCK_FLEXIBLE, Button.CHECK, Button.FLY, Button.CONTINUE):
            answers[phase, button] = station.press(button, 1)

    flight = PressedFlight(tmp_path, press)
    flight.fly()
    (end,) = flight.records_of(MissionEnd)
    assert isinstance(end, MissionEnd)
    assert end.outcome is Outcome.COMPLETED, end
    phases = {phase for phase, _ in answers}
    assert phases >= FLOWN - {Phase.READYING, Phase.DONE}
    for (phase, button), answer in answers.items():
        rest = Phase.CONTACT is phase and button is not Button.FLY
        expected = Result.TEMPORARILY_REJECTED if rest else Result.DENIED
        if button is Button.CHECK or (button is Button.CONTINUE and phase is Phase.PAUSE):
            expected = Result.ACCEPTED
        assert answer == expected, (phase, button)
    requests = [
        record.request for record in flight.records_of(OperatorRequest) if isinstance(record, OperatorRequest)
    ]
    assert requests == [Request.CONTINUE]
    assert "denied: the mission moves the lock during the flight" in flight.texts
    assert any(text.startswith("in flight: approach; lock rigid") for text in flight.texts)
    noted = [r.text for r in flight.records_of(StatusText) if isinstance(r, StatusText) and r.found_here]
    assert "ground station: denied: a mission is flying" in noted


@pytest.mark.parametrize("land_in", [Phase.ARMING, Phase.TRANSIT, Phase.CONTACT, Phase.PAUSE])
def test_the_land_button_lands_and_does_not_release_the_vehicle(tmp_path: Path, land_in: Phase) -> None:
    answers: list[int | None] = []

    def press(station: OperatorStation, phase: Phase) -> None:
        if phase is Phase.PAUSE and land_in is not Phase.PAUSE:
            station.press(Button.CONTINUE)
        if phase is land_in and not answers:
            answers.extend((station.press(Button.LAND), station.press(Button.LAND)))

    flight = PressedFlight(tmp_path, press)
    flight.fly()
    (end,) = flight.records_of(MissionEnd)
    assert isinstance(end, MissionEnd)
    assert end.outcome is Outcome.ABORTED, "two presses of the land button released the vehicle"
    assert answers == [Result.ACCEPTED, Result.ACCEPTED]
    assert "landing requested" in str(end.reason) or land_in is Phase.ARMING


def test_commands_from_another_system_are_denied_and_have_no_effect(tmp_path: Path) -> None:
    answers: list[int | None] = []

    def press(station: OperatorStation, phase: Phase) -> None:
        station._mav.srcSystem = 42
        if phase in (Phase.CLIMB, Phase.TRANSIT):
            answers.append(station.press(Button.LAND))
        if phase is Phase.PAUSE:
            station._mav.srcSystem = 255
            station.press(Button.CONTINUE)

    flight = PressedFlight(tmp_path, press)
    flight.fly()
    (end,) = flight.records_of(MissionEnd)
    assert isinstance(end, MissionEnd)
    assert end.outcome is Outcome.COMPLETED
    assert set(answers) == {Result.DENIED}
    noted = [
        r.text for r in flight.records_of(StatusText) if isinstance(r, StatusText) and "system 42" in r.text
    ]
    assert len(noted) == 1, "the denial is not reported exactly once"
