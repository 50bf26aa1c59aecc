"""The table survives: torn rows, zeros after a power loss, a full disk, a second writer."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError
from dart_flight.lab.campaign.flight_job import line_of
from dart_flight.lab.campaign.table import Table, rows_in

COLUMNS = ("mission", "seed", "reason")


def row(seed: int, reason: str = "") -> bytes:
    return line_of(["m.yaml", seed, reason])


def filled(path: Path, count: int) -> bytes:
    with Table(path, COLUMNS) as table:
        for seed in range(count):
            table.append(row(seed))
    return path.read_bytes()


def test_rows_come_back(tmp_path: Path) -> None:
    path = tmp_path / "flights.csv"
    with Table(path, COLUMNS) as table:
        table.append(line_of(["a, b.yaml", 3, 'lost:  "it"\nwas']))
    assert list(rows_in(path)) == [{"mission": "a, b.yaml", "seed": "3", "reason": 'lost: "it" was'}]
    assert line_of([None, True, False, 0.1 + 0.2, 7]) == b",true,false,0.30000000000000004,7\n"


@pytest.mark.parametrize("torn", [b"m.yaml", b"m.yaml,3,", b"\0" * 40, b"m.ya\0\0\0\n\0\0"])
def test_a_torn_row_is_cut_off(tmp_path: Path, torn: bytes) -> None:
    path = tmp_path / "flights.csv"
    whole = filled(path, 3)
    path.write_bytes(whole + torn)
    with Table(path, COLUMNS) as table:
        assert path.read_bytes() == whole
        table.append(row(3))
    assert path.read_bytes() == whole + row(3)


def test_a_torn_header_is_written_again(tmp_path: Path) -> None:
    path = tmp_path / "flights.csv"
    whole = filled(path, 0)
    path.write_bytes(whole[:7])
    assert filled(path, 1) == whole + row(0)


def test_what_is_no_table_of_ours_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "flights.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="other columns"):
        Table(path, COLUMNS)
    assert path.read_text() == "a,b\n1,2\n"
    filled(tmp_path / "good.csv", 2)
    with open(tmp_path / "good.csv", "ab") as file:
        file.write(b"too,few\nm.yaml,5,\n")
    with pytest.raises(InputError, match=r"good.csv:4: 2 cells, a row has 3"):
        list(rows_in(tmp_path / "good.csv"))


def test_a_second_writer_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "flights.csv"
    with Table(path, COLUMNS), pytest.raises(FlightError, match="being written by another campaign"):
        Table(path, COLUMNS)
    filled(path, 1)


FULL = """
import sys
from pathlib import Path
from dart_flight.lab.campaign.table import Table
from dart_flight.base.errors import FlightError
from tests.lab.campaign.test_table import COLUMNS, row
table, seed = Table(Path(sys.argv[1]), COLUMNS), 0
try:
    while True:
        table.append(row(seed, "x" * 50))
        seed += 1
except FlightError as error:
    print(seed, error)
"""


def test_a_full_disk_leaves_whole_rows(tmp_path: Path) -> None:
    """The kernel's limit of a file's size stands in for the disk: a write is cut short, the next refused."""
    path = tmp_path / "flights.csv"

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))

    done = subprocess.run(
        [sys.executable, "-B", "-c", FULL, str(path)],  # -B: bytecode would be cut, too, and stay
        cwd=Path(__file__).parents[3], preexec_fn=limit, capture_output=True, text=True, check=True,
    )  # fmt: skip
    seeds, _, said = done.stdout.strip().partition(" ")
    assert said == f"cannot write {path}: File too large; completed rows are kept; continue with --resume"
    assert path.read_bytes().endswith(row(int(seeds) - 1, "x" * 50))
    assert len(list(rows_in(path))) == int(seeds) > 10
    with Table(path, COLUMNS) as table:
        table.append(row(int(seeds)))
    assert [int(r["seed"]) for r in rows_in(path)] == list(range(int(seeds) + 1))
