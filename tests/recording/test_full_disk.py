"""A full disk does not end the flight, and the incomplete log is reported."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from dart_flight.base.records import LogFailure, Record, Tick, World
from dart_flight.check.log_space import check_log_space, longest_flight_s
from dart_flight.cli import main
from dart_flight.config.vehicle import packaged
from dart_flight.recording.events import EventFormatter
from dart_flight.recording.verdict import Verdict
from dart_flight.recording.writer import LogPart
from dart_flight.run.flight_record import FlightRecord
from dart_flight.run.prepare import load_flyable
from dart_flight.run.program_fault import fill_disk_of

ROOT = Path(__file__).parents[2]
SINGLE = ROOT / "missions/single_wall.yaml"
MISSION = load_flyable(packaged("missions", "single_wall.yaml"))


def test_a_full_disk_is_reported_once_in_flight_and_in_the_verdict(tmp_path: Path) -> None:
    record = FlightRecord(MISSION, World.EMBEDDED, 1, tmp_path)
    notices: list[Record] = []
    record.notice = notices.append
    record(Tick(1), 0)
    fill_disk_of(record.path)
    record(Tick(2), 1)
    record.close()  # writes the queued records to the full disk
    for number in range(2, 10):
        record(Tick(number), number)
    assert [type(one) for one in notices] == [LogFailure]
    event = EventFormatter().format_event(notices[0])
    assert event is not None
    assert event.head == "flight log incomplete: No space left on device"
    assert (record.build().log_failure or "").startswith("No space left on device, ")


def test_a_flight_with_an_incomplete_log_reports_it_and_exits_with_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(part: LogPart) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    words = ["dry-run", str(SINGLE), "--fast", "--log-dir", str(tmp_path)]
    assert main([*words, "--runs", "1"]) == 0
    monkeypatch.setattr(LogPart, "flush", full)
    monkeypatch.setattr(LogPart, "sync", full)
    capsys.readouterr()
    assert main(words) == 1
    printed = capsys.readouterr()
    last = printed.err.strip().splitlines()[-1]
    assert last.startswith("log: ")
    assert "is incomplete: No space left on device, " in last
    assert "dart-flight report" not in printed.err, "no command is suggested that needs the log"
    assert main([*words, "--json"]) == 1
    verdict = msgspec.json.decode(capsys.readouterr().out, type=Verdict)
    assert verdict.outcome == "completed"
    assert (verdict.log_failure or "").startswith("No space left on device")


def test_check_compares_the_free_space_with_the_longest_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check_log_space(MISSION, tmp_path / "not" / "there").go
    assert 120.0 < longest_flight_s(MISSION) < 600.0
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1_000_000))
    found = check_log_space(MISSION, tmp_path)
    assert not found.go
    assert "1.0 MB free for the log" in found.message
    assert main(["check", str(SINGLE), "--log-dir", str(tmp_path)]) == 1
    assert "NO-GO     log_space: 1.0 MB free" in capsys.readouterr().err


def test_a_failed_write_is_reported_with_its_exception_type(tmp_path: Path) -> None:
    record = FlightRecord(MISSION, World.EMBEDDED, 1, tmp_path)
    record(object(), 0)  # type: ignore[arg-type]
    record.close()
    text = "a record cannot be written: KeyError: <class 'object'>, 1 records lost"
    assert record.build().log_failure == text
