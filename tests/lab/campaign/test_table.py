"""The table of a campaign: incomplete rows, zeros after a power loss, and a second writer."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError
from dart_flight.lab.campaign.flight_job import line_of
from dart_flight.lab.campaign.table import Table, rows_in

COLUMNS = ("mission", "seed", "reason")


def row(seed: int, reason: str = "") -> bytes:
    return line_of(["m.yaml", seed, reason])


def write_rows(path: Path, count: int) -> bytes:
    with Table(path, COLUMNS) as table:
        for seed in range(count):
            table.append(row(seed))
    return path.read_bytes()


def test_rows_are_read_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "flights.csv"
    with Table(path, COLUMNS) as table:
        table.append(line_of(["a, b.yaml", 3, 'lost:  "it"\nwas']))
    assert list(rows_in(path)) == [{"mission": "a, b.yaml", "seed": "3", "reason": 'lost: "it" was'}]
    assert line_of([None, True, False, 0.1 + 0.2, 7]) == b",true,false,0.30000000000000004,7\n"


@pytest.mark.parametrize("incomplete", [b"m.yaml", b"m.yaml,3,", b"\0" * 40, b"m.ya\0\0\0\n\0\0"])
def test_an_incomplete_row_is_removed(tmp_path: Path, incomplete: bytes) -> None:
    path = tmp_path / "flights.csv"
    complete = write_rows(path, 3)
    path.write_bytes(complete + incomplete)
    with Table(path, COLUMNS) as table:
        assert path.read_bytes() == complete
        table.append(row(3))
    assert path.read_bytes() == complete + row(3)


def test_an_incomplete_header_is_rewritten(tmp_path: Path) -> None:
    path = tmp_path / "flights.csv"
    complete = write_rows(path, 0)
    path.write_bytes(complete[:7])
    assert write_rows(path, 1) == complete + row(0)


def test_a_table_with_other_columns_is_refused_and_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "flights.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="columns of this table differ"):
        Table(path, COLUMNS)
    assert path.read_text() == "a,b\n1,2\n"
    write_rows(tmp_path / "good.csv", 2)
    with open(tmp_path / "good.csv", "ab") as file:
        file.write(b"too,few\nm.yaml,5,\n")
    with pytest.raises(InputError, match=r"good.csv:4: this line has 2 cells, the header has 3"):
        list(rows_in(tmp_path / "good.csv"))


def test_a_second_writer_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "flights.csv"
    with Table(path, COLUMNS), pytest.raises(FlightError, match="being written by another campaign"):
        Table(path, COLUMNS)
    write_rows(path, 1)
