"""A late plant: it merges missed ticks into one message with their mean, and pauses after a stall."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.sim.pipe import HitlSpec, SimulatorSpec
from dart_flight.sim.px4 import hitl_simulator
from dart_flight.sim.px4.bridge import Controls, Px4Vehicle
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


def test_unreported_ticks_are_averaged_into_the_next_message(mission: Mission) -> None:
    every_tick, merged = RecordingLink(), RecordingLink()
    vehicle, late_vehicle = Px4Vehicle(mission, 1, every_tick), Px4Vehicle(mission, 1, merged)
    for tick in range(1, 4):
        vehicle.step()
        late_vehicle.step(report=tick == 3)
    (sent,) = merged.sensors
    means = [sum(axis) / 3.0 for axis in zip(*map(imu, every_tick.sensors), strict=True)]
    assert imu(sent) == pytest.approx(means, abs=1e-5)
    assert sent.time_usec == every_tick.sensors[-1].time_usec
    late_vehicle.step()
    assert len(merged.sensors) == 2  # the next message covers a single tick
    assert imu(merged.sensors[1]) != pytest.approx(means, abs=1e-5)


def test_no_pose_is_lost_in_unreported_ticks(mission: Mission) -> None:
    every_tick, merged = RecordingLink(), RecordingLink()
    vehicle, late_vehicle = Px4Vehicle(mission, 1, every_tick), Px4Vehicle(mission, 1, merged)
    for tick in range(1, 51):
        vehicle.step()
        late_vehicle.step(report=tick % 25 == 0)
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


class Host:
    """A HITL simulator whose clock is set by hand."""

    def __init__(self, mission: Mission, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr(
            hitl_simulator, "time", SimpleNamespace(monotonic=lambda: self.now_s, sleep=self.sleep)
        )
        hitl = HitlSpec("serial:///dev/none:921600")
        self.simulator = HitlSimulator(SimulatorSpec(mission, 1, [], None, hitl=hitl), hitl)
        self.link = RecordingLink()
        self.simulator._vehicle = Px4Vehicle(mission, 1, self.link)
        self.simulator._start_s = self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def run(self, after_s: float, ticks: int) -> list[int]:
        """Advance by `ticks`, `after_s` after the last call; return the sent timestamps in ticks."""
        self.link.sensors.clear()
        self.now_s += after_s
        for _ in range(ticks):
            self.simulator.advance()
        return [m.time_usec // 4000 for m in self.link.sensors]


def test_late_ticks_are_sent_as_one_message(mission: Mission, monkeypatch: pytest.MonkeyPatch) -> None:
    host = Host(mission, monkeypatch)
    assert host.run(0.0041, 1) == [1]
    assert host.run(0.004, 1) == [2]
    assert host.run(0.020, 5) == [7]  # five were due
    assert host.run(0.004, 1) == [8]
    assert host.simulator._merged == 4


def test_a_late_plant_catches_up_and_then_reports_every_tick(
    mission: Mission, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = Host(mission, monkeypatch)
    assert host.run(0.1, 100) == list(range(25, 101))
    assert host.now_s == pytest.approx(1000.4)
    assert host.simulator._merged == 24


def test_the_plant_pauses_after_a_stall(mission: Mission, monkeypatch: pytest.MonkeyPatch) -> None:
    host = Host(mission, monkeypatch)
    host.run(0.0041, 1)
    offset_us = host.simulator._vehicle.plant.time_offset_us
    assert host.run(1.0, 1) == [2]  # sent at once, none merged
    assert host.simulator._vehicle.plant.time_offset_us - offset_us == pytest.approx(1e6, abs=8000)
    assert host.run(0.004, 1) == [3]
    assert host.simulator._merged == 0


class SilentLink(RecordingLink):
    """A link whose flight controller has been silent for `silent_s`."""

    silent_s = 0.0


def test_the_plant_freezes_while_an_armed_flight_controller_is_silent(
    mission: Mission, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last outputs would make the plant tumble; samples and the truth's clock continue."""
    host, link = Host(mission, monkeypatch), SilentLink()
    host.link = link
    host.simulator._vehicle = Px4Vehicle(mission, 1, link)
    host.simulator._link = link  # type: ignore[assignment]
    plant = host.simulator._vehicle.plant
    plant.position, plant.rate = (0.0, 0.0, -1.0), (3.0, 2.0, 1.0)
    host.run(0.004, 10)
    before, at_us = plant.truth(), plant.truth().t_us
    link.silent_s = 0.2
    host.run(0.004, 100)
    frozen = plant.truth()
    assert frozen.q_frd_to_ned == before.q_frd_to_ned
    assert frozen.position_mission == before.position_mission
    assert frozen.t_us - at_us == 100 * 4000
    assert len(link.sensors) == 100
    assert len({tuple(imu(sensor)) for sensor in link.sensors}) == 1
    link.silent_s = 0.0
    host.run(0.004, 10)
    assert plant.truth().q_frd_to_ned != before.q_frd_to_ned


def test_the_plant_runs_while_a_disarmed_flight_controller_is_silent(
    mission: Mission, monkeypatch: pytest.MonkeyPatch
) -> None:
    host, link = Host(mission, monkeypatch), SilentLink()
    link.silent_s, link.controls = 0.2, Controls(0, False, (0.0,) * 16)
    host.link, host.simulator._vehicle = link, Px4Vehicle(mission, 1, link)
    host.simulator._link = link  # type: ignore[assignment]
    before = host.simulator._vehicle.plant.time_s
    host.run(0.004, 10)
    assert host.simulator._vehicle.plant.time_s > before
