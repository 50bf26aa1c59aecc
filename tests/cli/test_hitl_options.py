"""`dry-run --hitl`: contradictory options are refused in one line, and nothing flies unconfirmed."""

from __future__ import annotations

import os
import pty
from pathlib import Path

import pytest

from dart_flight.check.checks import FlightContext
from dart_flight.check.findings import CheckFinding
from dart_flight.check.vehicle_reading import VehicleReading
from dart_flight.cli import hitl_preflight, main
from tests.command_fixtures import Refuse, Type

MISSION = str(Path(__file__).parents[2] / "missions" / "single_wall.yaml")
HITL, LINK = "udpout://127.0.0.1:14570", "udpin://127.0.0.1:14999"
FLY = ["dry-run", MISSION, "--hitl", HITL, "--connection", LINK]


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--connection", LINK], "--connection needs --hitl"),
        (["--hitl", HITL, "--px4", "/nowhere"], "--px4 and --hitl exclude each other"),
        (["--hitl", HITL, "--fast"], "--fast and --hitl exclude each other"),
        (["--hitl", HITL, "--runs", "3"], "--runs and --hitl exclude each other"),
        (["--hitl", HITL, "--fault", "servo-slow"], "--fault and --hitl exclude each other"),
        (["--hitl", HITL, "--speed", "2"], "--speed and --hitl exclude each other"),
        (["--hitl", "rubbish", "--connection", LINK], "not a connection URL"),
        (["--hitl", "serial:///dev/no-such-port:921600", "--connection", LINK], "the serial port"),
        (["--hitl", LINK, "--connection", LINK], "also the link of the application"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_contradictory_options_are_refused_in_one_line(
    words: list[str], problem: str, refusal_of: Refuse
) -> None:
    assert problem in refusal_of("dry-run", MISSION, *words)


def test_two_names_of_one_serial_port_are_recognised(tmp_path: Path, refusal_of: Refuse) -> None:
    master, slave = pty.openpty()
    by_id = tmp_path / "by-id"
    by_id.symlink_to(os.ttyname(slave))
    first, second = f"serial://{os.ttyname(slave)}:921600", f"serial://{by_id}:921600"
    line = refusal_of("dry-run", MISSION, "--hitl", first, "--connection", second)
    assert "also the link of the application" in line
    os.close(slave)
    os.close(master)


@pytest.fixture
def ready(monkeypatch: pytest.MonkeyPatch) -> list[CheckFinding]:
    """Replace the preflight checks by these findings; a flight fails the test."""
    findings = [CheckFinding("disarmed", True, "disarmed")]

    def find(context: FlightContext, *_: object) -> list[CheckFinding]:
        context.reading = VehicleReading(None, {})
        context.found += findings
        return findings

    monkeypatch.setattr(hitl_preflight, "run_checks", find)

    def fly(**_: object) -> None:
        pytest.fail("flown")

    monkeypatch.setattr(hitl_preflight, "fly_hitl", fly)
    return findings


@pytest.mark.parametrize("typed", ["", "y\n", "propellers on\n"])
def test_an_unconfirmed_flight_does_not_start(
    typed: str, ready: list[CheckFinding], type_lines: Type, capsys: pytest.CaptureFixture[str]
) -> None:
    type_lines(typed)
    assert main(FLY) == 2
    err = capsys.readouterr().err
    assert "Take the propellers off" in err
    assert err.splitlines()[-1].endswith("'propellers off' was not typed; the mission was not flown")


def test_a_flight_controller_that_is_not_ready_does_not_fly(
    ready: list[CheckFinding], type_lines: Type, capsys: pytest.CaptureFixture[str]
) -> None:
    ready.append(CheckFinding("SYS_HITL", False, "SYS_HITL is 0, wanted 1"))
    type_lines("propellers off\n")
    assert main(FLY) != 0
    err = capsys.readouterr().err
    assert "SYS_HITL is 0, wanted 1" in err
    assert "not ready for hardware in the loop; the mission was not flown" in err
    assert "Take the propellers off" not in err
