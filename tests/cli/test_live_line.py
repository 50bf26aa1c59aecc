"""The live line at the bottom of the terminal, and the commands recommended after a flight."""

from __future__ import annotations

import io
import re
import shlex
from pathlib import Path

import pytest
from rich.console import Console

from dart_flight.base.records import OdometrySample
from dart_flight.cli import main
from dart_flight.cli.flight_output import FlightLines, live_line_for
from dart_flight.cli.live_line import LiveLine
from dart_flight.config.vehicle import packaged
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import Log, read_log
from tests.shared_flights import SharedFlights


@pytest.fixture(scope="module")
def log(flown: SharedFlights) -> Log:
    return read_log(flown("paper_single_wall", 1).log)


def test_the_live_line_shows_phase_position_speed_force_lock_and_battery(log: Log) -> None:
    terminal = io.StringIO()
    now_s = 0.0
    line = LiveLine(flown_mission(log.about, log.source), terminal, lambda: now_s)
    for entry in log.entries:
        if isinstance(entry.record, OdometrySample):
            now_s = entry.record.t_us * 1e-6
        line(entry.record)
    shown = terminal.getvalue().split("\r\x1b[K")[1:]
    pattern = r"\w+  \(-?[\d.]+, -?[\d.]+, -?[\d.]+\) m  [\d.]+ m/s  force [\d.]+ N  lock .*  [\d.]+ V"
    assert all(re.match(pattern, text) or len(text) == 79 for text in shown)
    assert 50 < len(shown) <= 5.0 * now_s
    assert {text.split()[0] for text in shown} >= {"climb", "approach", "goal", "landing"}
    # A contact of 0.1 s is shorter than a refresh; its peak must be shown all the same.
    assert max(float(re.findall(r"force ([\d.]+)", text)[0]) for text in shown) > 25.0


def test_the_live_line_is_cleared_before_other_lines_and_at_the_end(log: Log) -> None:
    terminal = io.StringIO()
    console = Console(file=terminal, force_terminal=True, width=100)
    mission = flown_mission(log.about, log.source)
    lines = FlightLines(console, live_line=live_line_for(mission, console))
    for entry in log.entries:
        lines(entry.record)
    lines.close()
    text = terminal.getvalue()
    assert text.endswith("\r\x1b[K") or text.endswith("\n")
    for printed in text.split("\n")[:-1]:
        assert " m/s  force" not in printed.split("\r\x1b[K")[-1]


def test_a_pipe_has_no_live_line(log: Log) -> None:
    console = Console(file=io.StringIO())
    assert live_line_for(flown_mission(log.about, log.source), console) is None


@pytest.mark.rest
def test_the_commands_recommended_after_a_flight_run(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mission = str(packaged("missions", "paper_single_wall.yaml"))
    main(["dry-run", mission, "--fast", "--log-dir", "my flights"])
    steps = re.findall(r"^  dart-flight (.*)$", capsys.readouterr().err, re.MULTILINE)
    assert [step.split()[0] for step in steps] == ["report", "export", "replay", "identify"]
    assert main(shlex.split(steps[1])) == 0
