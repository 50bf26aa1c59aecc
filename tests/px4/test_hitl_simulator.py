"""A late plant: it merges missed ticks into one message with their mean, and pauses after a stall."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.sim.pipe import HitlSpec, SimulatorSpec
from dart_flight.sim.px4 import hitl_simulator
from dart_flight.sim.px4.bridge import Controls, Px4LostError, Px4Vehicle
from dart_flight.sim.px4.hitl_simulator import HitlSimulator

AXES = ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro")


class RecordingLink:
    """A link that records sent messages; uneven motor outputs make every tick different."""

    def __init__(self) -> None:
        self.controls = Controls(0, True, (0.6, 0.5, 0.55, 0.5, *[0.0] * 12))
        self.sensors: list[Any] = []
        self.others: list[Any] = []

    def exchange(self, sensor: Any, *others: Any) -> Controls:
        self.sensors.append(sensor)
        self.others += others
        return self.controls


@pytest.fixture
def mission() -> Mission:
    return load_mission(packaged("missions", "single_wall.yaml"))


def imu(sensor: Any) -> list[float]:
    return [getattr(sensor, axis) for axis in AXES]


def step_both(mission: Mission, ticks: int, reported: set[int]) -> tuple[RecordingLink, RecordingLink]:
    """Step one vehicle that reports every tick and one that reports some; return their links."""
    links = RecordingLink(), RecordingLink()
    vehicle, late_vehicle = (Px4Vehicle(mission, 1, link) for link in links)
    for tick in range(1, ticks + 1):
        vehicle.step()
        late_vehicle.step(report=tick in reported)
    return links


def test_unreported_ticks_are_averaged_into_the_next_message(mission: Mission) -> None:
    every_tick, merged = step_both(mission, 4, {3, 4})
    sent, single = merged.sensors
    means = [sum(axis) / 3.0 for axis in zip(*map(imu, every_tick.sensors[:3]), strict=True)]
    assert imu(sent) == pytest.approx(means, abs=1e-5)
    assert sent.time_usec == every_tick.sensors[2].time_usec
    assert imu(single) != pytest.approx(means, abs=1e-5)  # the next message covers a single tick


def test_no_pose_is_lost_in_unreported_ticks(mission: Mission) -> None:
    every_tick, merged = step_both(mission, 50, {25, 50})
    assert len(merged.sensors) == 2
    assert len(every_tick.others) > 10
    assert [m.time_usec for m in merged.others] == [m.time_usec for m in every_tick.others]


def test_the_barometer_is_not_lost_in_unreported_ticks(mission: Mission) -> None:
    """PX4 does not arm without the barometer, whose ticks a busy host may never report."""
    kept = RecordingLink()
    vehicle = Px4Vehicle(mission, 1, kept)
    for tick in range(100):
        vehicle.step(report=tick % 5 == 2)
    assert sum(bool(m.fields_updated & 0x1A00) for m in kept.sensors) >= 19


class Host(RecordingLink):
    """A run of the simulator on a clock set by hand, until its link fails after a number of reports.

    Args:
        delays_s: time that passes besides, after a report, by the report's number.
        reports: number of reports after which the run ends.
        before: what happens before the link answers a report.

    Attributes:
        now_s: the host's clock.
        summary: the last line of the simulator's log.
        vehicle: the simulated vehicle.
    """

    answered, sent, dropped, longest_gap_s, outputs_seen = False, 0, 0, 0.0, 0

    def __init__(
        self,
        mission: Mission,
        monkeypatch: pytest.MonkeyPatch,
        folder: Path,
        delays_s: Mapping[int, float],
        reports: int,
        before: Callable[[Host, int], object] = lambda host, number: None,
        armed: bool = True,
    ) -> None:
        super().__init__()
        self.now_s, self.silent_s = 1000.0, 0.0
        self._delays_s, self._reports, self._before = delays_s, reports, before
        if not armed:
            self.controls = Controls(0, False, (0.0,) * 16)
        clock = SimpleNamespace(monotonic=lambda: self.now_s, sleep=self._sleep)
        for name, double in (("time", clock), ("open_port", str), ("HitlLink", lambda port: self)):
            monkeypatch.setattr(hitl_simulator, name, double)
        monkeypatch.setattr(hitl_simulator, "Px4Vehicle", self._make_vehicle)
        hitl = HitlSpec("serial:///dev/none:921600")
        log = folder / "autopilot.log"
        simulator = HitlSimulator(SimulatorSpec(mission, 1, [], str(log), hitl=hitl), hitl)
        with open(os.devnull, "rb") as commands, open(os.devnull, "wb") as truth:
            simulator.run(commands, truth)
        self.summary = log.read_text().splitlines()[-1]

    def _make_vehicle(self, *arguments: Any) -> Px4Vehicle:
        self.vehicle = Px4Vehicle(*arguments)
        return self.vehicle

    def _sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def exchange(self, sensor: Any, *others: Any) -> Controls:
        number = len(self.sensors) + 1
        if number > self._reports:
            raise Px4LostError("the end of the test")
        self._before(self, number)
        self.now_s += self._delays_s.get(number, 0.0)
        return super().exchange(sensor, *others)

    @property
    def reported(self) -> list[int]:
        """Numbers of the reported ticks."""
        return [sensor.time_usec // 4000 for sensor in self.sensors]

    def close(self) -> None:
        """Do nothing."""


@pytest.fixture
def run_host(mission: Mission, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Host]:
    """Run the simulator on a host: `run_host(delays_s, reports, ...)`."""
    return partial(Host, mission, monkeypatch, tmp_path)


def test_late_ticks_are_sent_as_one_message(run_host: Callable[..., Host]) -> None:
    host = run_host({2: 0.0201}, 5)  # five ticks are due then
    assert host.reported == [1, 2, 7, 8, 9]
    assert "4 of 10 ticks reported late" in host.summary


def test_a_late_plant_catches_up_and_then_reports_every_tick(run_host: Callable[..., Host]) -> None:
    host = run_host({1: 0.1}, 76)
    assert host.reported == [1, *range(26, 101)]
    assert host.now_s == pytest.approx(1000.4, abs=0.005)
    assert "24 of 101 ticks reported late" in host.summary


def test_the_plant_pauses_after_a_stall(run_host: Callable[..., Host]) -> None:
    offsets_us: list[int] = []
    host = run_host({1: 1.0}, 3, lambda host, tick: offsets_us.append(host.vehicle.plant.time_offset_us))
    assert host.reported == [1, 2, 3]  # the second at once, none merged
    assert offsets_us[1] - offsets_us[0] == pytest.approx(1e6, abs=8000)
    assert "0 of 4 ticks reported late" in host.summary


@pytest.mark.parametrize("armed", [True, False])
def test_the_plant_freezes_while_an_armed_flight_controller_is_silent(
    run_host: Callable[..., Host], armed: bool
) -> None:
    """The last outputs would make the plant tumble; samples and the truth's clock continue."""
    truths: dict[int, Any] = {}

    def note(host: Host, number: int) -> None:
        plant = host.vehicle.plant
        truths[number] = plant.truth()
        if number == 1:
            plant.position, plant.rate = (0.0, 0.0, -1.0), (3.0, 2.0, 1.0)
        host.silent_s = 0.2 if 10 <= number < 110 else 0.0

    host = run_host({}, 120, note, armed)
    assert len(host.sensors) == 120
    frozen, before, after = truths[110], truths[11], truths[120]
    assert (frozen.q_frd_to_ned == before.q_frd_to_ned) is armed
    assert (frozen.position_mission == before.position_mission) is armed
    assert after.q_frd_to_ned != frozen.q_frd_to_ned
    assert frozen.t_us - before.t_us == 99 * 4000
    assert (len({tuple(imu(sensor)) for sensor in host.sensors[10:109]}) == 1) is armed
    assert f"plant paused for {400 * armed} ms" in host.summary
