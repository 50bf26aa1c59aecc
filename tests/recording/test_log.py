"""The flight log: records survive writing and reading, also from cut or damaged files."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import signal
import subprocess
import sys
import textwrap
import threading
import time
import tracemalloc
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from dart_flight.base.records import (
    GuardEvent,
    HealthReport,
    ImuSample,
    LockPhase,
    LockState,
    MissionEnd,
    Mode,
    Outcome,
    Override,
    Record,
    Setpoint,
    Tick,
)
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.lab.scene.csv_export import export_csv
from dart_flight.recording.about import flown_mission, parse_written, written_mission
from dart_flight.recording.encoding import decode, encode
from dart_flight.recording.reader import MAX_BYTES, Log, LogEntry, read_log
from dart_flight.recording.schema import CLOCKS, RECORD_TYPES, schema
from dart_flight.recording.writer import ABOUT, FORMAT_VERSION, FlightLog, LogPart, part_path
from tests.real_time import wait_until

IMU = ImuSample(t_us=1, received_us=2, specific_force_frd=(0.1, -0.0, -9.81), rate_frd=(0.0, 0.0, 0.0))


def imu(i: int) -> ImuSample:
    return msgspec.structs.replace(IMU, t_us=1000 * i + 1)


# --- encoding ------------------------------------------------------------------------------------------


@given(st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 3))
def test_every_float_survives_encoding_and_decoding(v: tuple[float, float, float]) -> None:
    record = msgspec.structs.replace(IMU, specific_force_frd=v)
    back = decode(encode(record), msgspec.json.Decoder(ImuSample))
    assert encode(back) == encode(record)
    for a, b in zip(v, back.specific_force_frd, strict=True):
        assert (math.isnan(a) and math.isnan(b)) or (a == b and math.copysign(1, a) == math.copysign(1, b))


def test_missing_and_non_finite_values_survive_encoding() -> None:
    for record in (
        Setpoint(t_us=1, trigger_received_us=1, position_ned=(1.0, math.inf, math.nan), yaw_ned_rad=0.0),
        LockState(t_us=1, phase=LockPhase.SETTLED, mode=None),
        MissionEnd(t_us=1, outcome=Outcome.ABORTED, reason="nan", final_error_m=None),
    ):
        back = decode(encode(record), msgspec.json.Decoder(type(record)))
        assert encode(back) == encode(record)
    assert isinstance(back, MissionEnd)
    assert back.reason == "nan"


# --- content -------------------------------------------------------------------------------------


def test_the_log_describes_itself(flight: Log, single_wall: Mission) -> None:
    about = flight.about
    assert flight.complete
    assert flight.end["lost"] == "0"
    assert about["mission_text"] == Path(single_wall.source).read_text()
    assert flown_mission(about, "log") == single_wall
    as_written = parse_written(*written_mission(about, "log"))
    here = {"source": single_wall.source, "vehicle_source": single_wall.vehicle_source}
    assert msgspec.structs.replace(as_written, **here) == single_wall
    assert (flight.world, flight.seed) == ("fast", 1)
    for key in ("software", "host", "machine", "started_utc", "started_monotonic_us"):
        assert about[key], key


def test_a_log_of_another_version_is_rejected_with_the_missing_key(flight: Log) -> None:
    about = dict(flight.about)
    for name in ("flown", "vehicle"):
        other = msgspec.json.decode(about[name])
        del (other["vehicle"] if name == "flown" else other)["guard"]["retreat_m"]
        about[name] = msgspec.json.encode(other).decode()
    with pytest.raises(
        InputError, match=r"this version cannot read the mission in the log: .*`retreat_m`.*guard"
    ):
        flown_mission(about, "log")
    with pytest.raises(InputError, match="retreat_m"):
        parse_written(*written_mission(about, "log"))
    with pytest.raises(InputError, match="this version cannot read"):
        flown_mission({**about, "flown": "[]"}, "log")


def test_a_log_can_be_read_without_mission_and_configuration_files(flight_path: Path, tmp_path: Path) -> None:
    log = read_log(flight_path)
    log.about["mission_source"] = str(tmp_path / "gone.yaml")
    text = log.about["flown"].replace(str(Path("missions/paper_single_wall.yaml").resolve()), "/gone.yaml")
    log.about["flown"] = text
    assert flown_mission(log.about, "log").walls
    assert parse_written(*written_mission(log.about, "log")).walls


@pytest.mark.parametrize("kind", RECORD_TYPES)
def test_every_number_has_a_unit_and_every_vector_a_frame(kind: type[Record]) -> None:
    without_unit = {"severity", "collision", "reset_counter", "frame_number"}
    for name, value in schema(kind)["properties"].items():
        numeric = value["type"] in ("number", "integer") or value.get("items", {}).get("type") == "number"
        if not numeric or name in without_unit:
            continue
        text = value.get("description", "")
        assert text, f"{kind.__name__}.{name} has neither unit nor frame"
        if name.endswith("_us"):
            assert "clock" in text or name in CLOCKS
        if value["type"] == "array" and name not in ("motors", "rpm", "pieces_s"):
            assert any(word in text for word in ("NED", "FRD", "mission frame", "room")), (
                f"{kind.__name__}.{name}"
            )


def test_the_mcap_library_reads_the_log_without_this_package(flight_path: Path) -> None:
    """Foxglove reads summary, schemas and messages in time order with this indexed reader."""
    with open(flight_path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        topics = {channel.topic for channel in summary.channels.values()}
        assert {kind.topic for kind in RECORD_TYPES} <= topics
        schemas = [json.loads(s.data) for s in summary.schemas.values()]
        assert all("$ref" not in json.dumps(s) and s["type"] == "object" for s in schemas)
        times = [m.log_time for _, channel, m in reader.iter_messages(topics=["/in/imu"])]
        assert len(times) > 1000
        assert times == sorted(times)


# --- cut, damaged, foreign, newer ------------------------------------------------------------------------


def largest_chunk(whole: bytes) -> float:
    """Return the largest chunk with its index, as a share of the file."""
    summary = make_reader(io.BytesIO(whole)).get_summary()
    assert summary is not None
    ends = sorted(
        chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length
        for chunk in summary.chunk_indexes
    )
    return max(after - before for before, after in itertools.pairwise([0, *ends])) / len(whole)


@settings(max_examples=15)
@given(data=st.data())
def test_a_log_cut_at_any_byte_opens_up_to_the_cut(
    data: st.DataObject, flight: Log, flight_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    whole = flight_path.read_bytes()
    near_end = st.integers(len(whole) - 5000, len(whole) - 1)
    cut = data.draw(st.one_of(st.integers(0, len(whole) - 1), st.integers(0, 20_000), near_end))
    path = tmp_path_factory.mktemp("cut") / "flight.mcap"
    path.write_bytes(whole[:cut])
    log = read_log(path)
    assert log.entries == flight.entries[: len(log.entries)]
    # The cut loses at most one chunk of records.
    share = len(log.entries) / len(flight.entries)
    assert share >= cut / len(whole) - largest_chunk(whole) - 0.02 or cut > len(whole) - 20_000
    path.unlink()


def is_longer(path: Path, than_bytes: int) -> bool:
    return path.stat().st_size > than_bytes


def small_log(path: Path) -> bytes:
    """Write a finished log of a few records in several chunks; schemas make up most of it."""
    log = FlightLog(path, {"mission": "small"})
    for i in range(6):
        before = path.stat().st_size
        log.put(imu(i), i)
        log.put(Tick(i), i)
        wait_until(partial(is_longer, path, before), 5.0, "the writer")
    log.close()
    return path.read_bytes()


def places_to_cut(whole: bytes) -> list[int]:
    """Return places at which to cut: all bytes near the ends of a record, and every sixteenth inside.

    In a row of records of one kind, only the first two and the last are cut so densely. The others, such as
    the forty schemas of the summary, are cut at their edges and in the middle.
    """
    magic, head, near = 8, 9, 24  # bytes; a record has its kind, its length in eight bytes, and its content
    records, begin = list[tuple[int, int, int]](), magic
    while begin < len(whole) - magic:
        end = begin + head + int.from_bytes(whole[begin + 1 : begin + head], "little")
        records.append((whole[begin], begin, end))
        begin = end
    assert begin == len(whole) - magic
    places = list(range(magic))
    for _, alike in itertools.groupby(records, key=lambda record: record[0]):
        row = list(alike)
        for i, (_, first, end) in enumerate(row):
            if i < 2 or i == len(row) - 1:
                places += [
                    at
                    for at in range(first, end)
                    if at < first + head + near or at >= end - near or at % 16 == 0
                ]
            else:
                places += [first, first + 1, first + head, (first + end) // 2, end - 1]
    return [*places, *range(begin, len(whole))]


def test_a_log_cut_at_every_kind_of_record_opens_up_to_the_cut(tmp_path: Path) -> None:
    whole = small_log(tmp_path / "whole.mcap")
    entries = read_log(tmp_path / "whole.mcap").entries
    assert len(entries) == 12
    path, known = tmp_path / "flight.mcap", 0
    for cut in places_to_cut(whole):
        path.write_bytes(whole[:cut])
        log = read_log(path)
        assert log.entries == entries[: len(log.entries)]
        assert len(log.entries) >= known  # a longer file never yields fewer records
        known = len(log.entries)
        assert log.about.get("mission") in (None, "small")
        # A complete log may lack at most the magic number at its end.
        assert not log.complete or (len(log.entries) == 12 and log.end)


@settings(max_examples=20)
@given(data=st.data())
def test_a_damaged_byte_never_gives_wrong_records(
    data: st.DataObject, flight: Log, flight_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    whole = bytearray(flight_path.read_bytes())
    place = data.draw(st.integers(9, len(whole) - 1))
    whole[place] ^= data.draw(st.integers(1, 255))
    path = tmp_path_factory.mktemp("damaged") / "flight.mcap"
    path.write_bytes(whole)
    try:
        log = read_log(path)
    except InputError:
        return  # the damage is in the description, and is reported
    finally:
        path.unlink()
    assert log.entries == flight.entries[: len(log.entries)]


def claim_content(whole: bytearray, claimed: int) -> None:
    """Write a header of Zstandard's frame that names another size of the content."""
    frame = whole.index(b"\x28\xb5\x2f\xfd")
    whole[frame + 4 : frame + 13] = b"\xe0" + claimed.to_bytes(8, "little")


def claim_chunk(whole: bytearray, claimed: int) -> None:
    """Write another length of the compressed data into the first chunk."""
    name = whole.index(b"zstd")
    whole[name + 4 : name + 12] = claimed.to_bytes(8, "little")


@pytest.mark.parametrize("claim", [claim_content, claim_chunk])
@pytest.mark.parametrize("claimed", [1 << 62, 1 << 45, 1 << 33])
def test_a_chunk_that_claims_gigabytes_is_damage_and_is_not_allocated(
    claim: Callable[[bytearray, int], None], claimed: int, flight_path: Path, tmp_path: Path
) -> None:
    whole = bytearray(flight_path.read_bytes())
    claim(whole, claimed)
    path = tmp_path / "flight.mcap"
    path.write_bytes(whole)
    tracemalloc.start()
    log = read_log(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert not log.complete
    assert not log.entries
    assert peak < MAX_BYTES


def write_mcap(path: Path, metadata: dict[str, str] | None) -> Path:
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start()
        if metadata is not None:
            writer.add_metadata(ABOUT, metadata)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


@pytest.mark.parametrize("command", [["replay"], ["report", "-o", "x.html"], ["export", "-o", "x"]])
def test_a_newer_log_is_rejected_with_its_version(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    about = {"format_version": str(FORMAT_VERSION + 1), "software": "9.9"}
    path = write_mcap(tmp_path / "new.mcap", about)
    assert main([command[0], str(path), *command[1:]]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "newer" in error
    assert "dart-flight 9.9" in error


@pytest.mark.parametrize(
    ("content", "word"),
    [(b"not a log at all", "no MCAP"), (b"", None), (b"\x89MCAP", None)],
)
def test_a_foreign_file_is_rejected_but_a_log_cut_at_its_start_is_not(
    content: bytes, word: str | None, tmp_path: Path
) -> None:
    path = tmp_path / "flight.mcap"
    path.write_bytes(content)
    if word is None:  # the beginning of a log, cut before its description
        assert read_log(path).entries == []
        assert not read_log(path).complete
    else:
        with pytest.raises(InputError, match=word):
            read_log(path)


def test_an_mcap_file_of_another_program_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a flight log of dart-flight"):
        read_log(write_mcap(tmp_path / "other.mcap", None))


# --- rotation, full disk, killed process ---------------------------------------------------------------


def test_a_rotated_log_is_read_back_from_its_parts(tmp_path: Path) -> None:
    log = FlightLog(tmp_path / "flight.mcap", {"mission": "m"}, part_bytes=1)
    for i in range(3):
        log.put(imu(i), i)
        wait_until(part_path(log.path, i + 2).exists, 5.0, "the writer")
    log.close()
    back = read_log(log.path)
    assert back.complete
    assert [e.number for e in back.entries] == [0, 1, 2]
    part_path(log.path, 3).unlink()
    assert not read_log(log.path).complete
    assert [e.number for e in read_log(log.path).entries] == [0, 1]


def test_a_log_at_its_size_limit_still_records_decisions(tmp_path: Path) -> None:
    log = FlightLog(tmp_path / "flight.mcap", {}, part_bytes=1, most_parts=1)
    log.put(imu(0), 0)
    wait_until(lambda: part_path(log.path, 2).exists(), 5.0, "the writer")
    log.put(imu(1), 1)
    log.put(Tick(5), 2)
    log.put(GuardEvent(t_us=9, rule="speed", action=Override.HOLD, detail=""), 3)
    log.close()
    assert [e.number for e in read_log(log.path).entries] == [0, 3]
    assert read_log(log.path).end["lost"] == "2"
    assert log.lost == 2


def test_an_unresponsive_disk_leaves_a_readable_incomplete_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = FlightLog(tmp_path / "flight.mcap", {"mission": "m"})
    log.put(imu(0), 0)
    wait_until(lambda: len(read_log(log.path).entries) == 1, 5.0, "the writer")
    write, answers, asked = LogPart.write, threading.Event(), threading.Event()

    def slow(part: LogPart, record: Record, time_us: int, number: int) -> None:
        asked.set()
        answers.wait(10.0)
        write(part, record, time_us, number)

    monkeypatch.setattr(LogPart, "write", slow)
    log.put(imu(1), 1)
    assert asked.wait(10.0)
    log.patience_s = 0.01
    log.close()
    assert log.failure == "the disk does not respond"
    back = read_log(log.path)
    assert not back.complete
    assert [e.number for e in back.entries] == [0]
    answers.set()
    wait_until(lambda: len(read_log(log.path).entries) == 2, 10.0, "the writer")
    assert [e.number for e in read_log(log.path).entries] == [0, 1], "no index in the middle of the log"


def test_a_killed_process_loses_at_most_200_ms(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    script = textwrap.dedent(
        f"""
        import time
        from pathlib import Path
        from dart_flight.recording.writer import FlightLog
        from dart_flight.base.records import Tick
        log = FlightLog(Path({str(path)!r}), {{}})
        i = 0
        while True:
            log.put(Tick(time.monotonic_ns() // 1000), i)
            i += 1
            time.sleep(0.002)
        """
    )
    process = subprocess.Popen([sys.executable, "-c", script])
    while not (path.exists() and path.stat().st_size > 20_000):
        time.sleep(0.05)
        assert process.poll() is None
    killed_us = time.monotonic_ns() // 1000
    process.send_signal(signal.SIGKILL)
    process.wait()
    log = read_log(path)
    assert not log.complete
    last = log.entries[-1].record
    assert isinstance(last, Tick)
    assert killed_us - last.host_us < 200_000


# --- export ---------------------------------------------------------------------------------------------


def test_export_preserves_every_number(flight: Log, flight_path: Path, tmp_path: Path) -> None:
    assert main(["export", str(flight_path), "-o", str(tmp_path / "csv")]) == 0
    with open(tmp_path / "csv" / "in_imu.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    samples = [e for e in flight.entries if isinstance(e.record, ImuSample)]
    assert len(rows) == len(samples)
    for row, entry in zip(rows, samples, strict=True):
        assert isinstance(entry.record, ImuSample)
        assert int(row["number"]) == entry.number
        axes = [float(row[f"specific_force_frd_{axis}"]) for axis in "xyz"]
        assert tuple(axes) == entry.record.specific_force_frd
    times = [float(row["time_s"]) for row in rows]
    assert times == sorted(times)
    with open(tmp_path / "csv" / "columns.csv", newline="") as file:
        meaning = {(r["file"], r["column"]): r["meaning"] for r in csv.DictReader(file)}
    assert meaning["in_imu.csv", "specific_force_frd"].startswith("m/s2; body FRD")
    with open(tmp_path / "csv" / "truth_state.csv", newline="") as file:
        assert {row["mode"] for row in csv.DictReader(file)} == {Mode.RIGID.value, Mode.FLEXIBLE.value}
    assert json.loads((tmp_path / "csv" / "about.json").read_text())["world"] == "fast"


def test_lists_of_any_length_are_exported(tmp_path: Path) -> None:
    reports = [
        HealthReport(4000 * i, 4000 * i, not i, ("no position", "no battery")[:i], ()) for i in range(3)
    ]
    log = Log("", {}, {}, [LogEntry(i, report) for i, report in enumerate(reports)], complete=True)
    export_csv(log, tmp_path)
    with open(tmp_path / "in_health.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["blocking_1"] for row in rows] == ["", "no position", "no position"]
    assert [row["blocking_2"] for row in rows] == ["", "", "no battery"]
