"""A follower reads a log during the flight, over all parts, without losing or repeating a record."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from dart_flight.base.records import StatusText, Tick
from dart_flight.config.document import InputError
from dart_flight.recording import reader
from dart_flight.recording.follow import LogFollower
from dart_flight.recording.reader import read_log
from dart_flight.recording.writer import FlightLog


def drain(follower: LogFollower, wanted: int, timeout_s: float = 10.0) -> list[int]:
    numbers: list[int] = []
    end = time.monotonic() + timeout_s
    while len(numbers) < wanted and time.monotonic() < end:
        numbers += [entry.number for entry in follower.read()]
        time.sleep(0.01)
    return numbers


@pytest.mark.parametrize("part_bytes", [1, 1 << 26])
def test_a_follower_returns_records_as_they_are_written(tmp_path: Path, part_bytes: int) -> None:
    log = FlightLog(tmp_path / "flight.mcap", {"mission": "m"}, part_bytes=part_bytes)
    follower = LogFollower(log.path)
    for begin in (0, 100, 200):
        for number in range(begin, begin + 100):
            log.put(Tick(number), number)
        assert drain(follower, 100) == list(range(begin, begin + 100))
        assert follower.about["mission"] == "m"
        assert not follower.ended
    log.put(StatusText(1, 2, "info", "the end"), 300)
    log.close()
    assert drain(follower, 1) == [300]
    follower.read()
    assert follower.ended
    assert follower.read() == []
    assert len(read_log(log.path).entries) == 301


def test_a_follower_waits_for_the_rest_of_a_half_written_record(tmp_path: Path) -> None:
    log = FlightLog(tmp_path / "whole.mcap", {})
    for number in range(1000):
        log.put(Tick(number), number)
    log.close()
    whole = log.path.read_bytes()
    growing = tmp_path / "growing.mcap"
    numbers: list[int] = []
    growing.write_bytes(whole[:20])
    follower = LogFollower(growing)
    for end in range(20, len(whole) + 97, 97):
        growing.write_bytes(whole[:end])
        numbers += [entry.number for entry in follower.read()]
    assert numbers == list(range(1000))
    assert follower.ended


def test_following_a_damaged_or_missing_log_raises_an_input_error(tmp_path: Path) -> None:
    """The logs have a damaged chunk, a length of gigabytes, or no file."""
    log = FlightLog(tmp_path / "whole.mcap", {})
    for number in range(1000):
        log.put(Tick(number), number)
    log.close()
    whole = log.path.read_bytes()
    chunk = whole.index(b"zstd")
    broken = {
        "content": whole[:chunk] + whole[chunk:].replace(whole[chunk + 40 : chunk + 60], bytes(20), 1),
        "length": whole[:9] + b"\xff" * 8 + whole[17:],
    }
    for name, data in broken.items():
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(data)
        with pytest.raises(InputError, match="cannot follow"):
            LogFollower(path).read()
    follower = LogFollower(tmp_path / "gone.mcap")
    with pytest.raises(InputError, match="cannot follow"):
        follower.read()


def test_a_program_error_is_not_reported_as_a_damaged_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = FlightLog(tmp_path / "whole.mcap", {})
    log.put(Tick(1), 1)
    log.close()
    monkeypatch.setattr(reader, "decode", lambda data, decoder: 1 / 0)
    for read in (lambda: read_log(log.path), LogFollower(log.path).read):
        with pytest.raises(ZeroDivisionError):
            read()
