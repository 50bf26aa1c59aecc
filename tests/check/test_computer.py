"""Checks of the computer's speed, temperature and power supply."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from dart_flight.base.records import ComputerSample, Input, Note, Output, Record, World
from dart_flight.check.computer_load import check_computer, check_core_speed, evaluate_core_speed
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.run.computer import ComputerWatch, read_computer
from dart_flight.run.flight_record import FlightRecord


def make_pi(root: Path, flags: int, millidegrees: int = 51_000) -> Path:
    """Create the files of a Raspberry Pi's kernel under `root`."""
    firmware = root / "sys/devices/platform/soc/soc:firmware"
    firmware.mkdir(parents=True)
    (firmware / "get_throttled").write_text(f"{flags:x}\n")
    for k, temperature in enumerate((20_000, millidegrees)):
        zone = root / f"sys/class/thermal/thermal_zone{k}"
        zone.mkdir(parents=True)
        (zone / "temp").write_text(f"{temperature}\n")
    return root


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (0x0, (False, False, False, False)),
        (0x50005, (True, True, True, True)),
        (0x50000, (False, False, True, True)),
        (0x8, (False, True, False, False)),
        (0x10001, (True, False, True, False)),
    ],
)
def test_the_flags_of_a_pi_are_read(tmp_path: Path, flags: int, says: tuple[bool, ...]) -> None:
    now = read_computer(make_pi(tmp_path, flags))
    assert (now.undervoltage, now.throttled, now.was_undervoltage, now.was_throttled) == says
    assert now.temperature_c == 51.0


def test_figures_that_the_kernel_does_not_provide_are_unknown(tmp_path: Path) -> None:
    now = read_computer(tmp_path)
    assert (now.temperature_c, now.undervoltage, now.throttled) == (None, None, None)
    assert check_computer(now) == []


@pytest.mark.parametrize(
    ("sample", "no_go", "remark"),
    [
        (ComputerSample(0, 51.0, False, False, False, False), set(), set()),
        (ComputerSample(0, 72.0, False, False, True, True), set(), {"temperature", "supply", "throttling"}),
        (ComputerSample(0, 84.0, True, True, True, True), {"temperature", "supply", "throttling"}, set()),
    ],
)
def test_heat_and_undervoltage_are_reported(
    sample: ComputerSample, no_go: set[str], remark: set[str]
) -> None:
    found = check_computer(sample)
    assert {f.item for f in found if not f.go} == no_go
    assert {f.item for f in found if f.go and f.remark} == remark


def test_the_core_speed_is_evaluated_by_its_margin() -> None:
    fast, slow, too_slow = (evaluate_core_speed(ms * 1e-3, 4e-3) for ms in (0.1, 0.5, 2.0))
    assert (fast.go, fast.remark) == (True, False)
    assert fast.figures["margin"] == pytest.approx(40.0)
    assert (slow.go, slow.remark) == (True, True)
    assert "6 ms after the sample with the peak" in slow.message
    assert (too_slow.go, "too slow" in too_slow.message) == (False, True)


def test_the_core_step_is_measured_on_this_computer() -> None:
    found = check_core_speed(load_mission(packaged("missions", "dual_collision.yaml")))
    assert 0.001 < found.figures["core_step_ms"] < 100.0  # every computer is within these limits


def test_the_watch_delivers_a_sample_at_once_and_ends() -> None:
    delivered: list[object] = []
    with ComputerWatch(delivered.append):
        while not delivered:
            pass
    assert isinstance(delivered[0], ComputerSample)


def test_every_kind_of_record_can_be_logged() -> None:
    """A kind that is in none of the unions would end the log of its flight."""

    def kinds(base: type[Record]) -> set[type[Record]]:
        return {base} | {kind for sub in base.__subclasses__() for kind in kinds(sub)}

    record_kinds = {kind for kind in kinds(Record) - {Record} if kind.__module__ == Record.__module__}
    assert record_kinds == {*get_args(Input), *get_args(Output), *get_args(Note)}


def test_a_computer_sample_is_logged(tmp_path: Path) -> None:
    mission = load_mission(packaged("missions", "single_wall.yaml"))
    record = FlightRecord(mission, World.DRONE, None, tmp_path)
    record.truth(ComputerSample(7, 51.0, True, False, True, False))
    record.close()
    assert record.build().log_failure is None
    (entry,) = record.log.entries
    assert entry.record == ComputerSample(7, 51.0, True, False, True, False)
