"""The count per item: the emulator's count is read like a clock (tools/bench/instructions.py)."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dart_flight.recording.reader import read_log
from tools.bench.instructions import FLIGHT, HANDED_OVER, costs, counter, measure, receiving


def test_reads_what_the_plugin_writes(tmp_path: Path) -> None:
    path = tmp_path / "count"
    path.write_bytes(bytes(8))
    read = counter(path)
    assert read() == 0
    with path.open("r+b") as file:
        file.write((123_456_789_012).to_bytes(8, "little"))
    assert read() == 123_456_789_012


def test_what_reading_takes_and_the_first_pass_are_left_out() -> None:
    now, passes = 0, 0

    def read() -> int:
        nonlocal now
        now += 7
        return now

    def begin() -> Callable[[int], None]:
        nonlocal passes
        passes += 1
        slower = {1: -3, 2: 100, 3: 0}[passes]  # the first is the cheapest and does not count

        def take(item: int) -> None:
            nonlocal now
            now += item + slower

        return take

    assert costs(read, 2, begin, [10, 20, 30]) == [10, 20, 30]


def test_messages_are_as_mavsdk_hands_them_over() -> None:
    """What the flight recorded comes out of the session again."""
    records = [entry.record for entry in read_log(FLIGHT).entries]
    for kind, handed_over in HANDED_OVER.items():
        recorded = [record for record in records if isinstance(record, kind)][100:200]
        delivered: list[Any] = []
        take = receiving(kind, 4, delivered.append)
        for record in recorded:
            take(handed_over(record))
        delivered = [record for record in delivered if isinstance(record, kind)]
        assert list(map(_without_times, delivered)) == list(map(_without_times, recorded))


def _without_times(record: Any) -> list[Any]:
    return [getattr(record, field) for field in record.__struct_fields__ if not field.endswith("_us")]


def test_every_row_of_a_recorded_flight() -> None:
    log = read_log(FLIGHT)
    del log.entries[600:]
    ticks = itertools.count()
    rows = {row.name: row for row in measure(lambda: next(ticks), log, 1)}
    kinds = [row for name, row in rows.items() if name[:4] == "core" and name[-6:] == "Sample"]
    assert len(kinds) >= 4
    assert rows["core, one input"].number > sum(row.number for row in kinds) > 100
    for kind in ("ImuSample", "AttitudeSample", "OdometrySample", "ActuatorSample"):
        assert rows[f"receive, {kind}"].number == rows[f"core, {kind}"].number
    assert rows["log, a record into the file"].number > rows["core, one input"].number  # outputs, too
