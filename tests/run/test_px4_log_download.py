"""Download of PX4's log into the flight's folder: choice of the log, remaining time, failures."""

from __future__ import annotations

import json
import random
import shutil
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsdk.plugins.log_files import Entry

from dart_flight.base.errors import FlightError
from dart_flight.cli import fly_command, main
from dart_flight.config.document import InputError
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.recording.about import armed_span
from dart_flight.recording.found import px4_logs_in
from dart_flight.recording.reader import read_log
from dart_flight.run.px4_log_download import fetch_px4_log, list_px4_logs
from dart_flight.vehicle import downloads
from dart_flight.vehicle.downloads import (
    DownloadError,
    DownloadTime,
    Px4LogEntry,
    Px4Logs,
    logs_of_flight,
    parse_entry,
)
from tests.doubles.log_vehicle import LogVehicle

FLIGHT = Path(__file__).parents[1] / "data" / "flights" / "px4.mcap"
BEGAN = datetime(2026, 11, 26, 5, 0, tzinfo=UTC)
ARMED = (BEGAN, BEGAN + timedelta(seconds=40))


def log(k: int, after_s: float | None, size: int = 1000) -> Px4LogEntry:
    return Px4LogEntry(k, None if after_s is None else BEGAN + timedelta(seconds=after_s), size)


def ulog(size: int, seed: int) -> bytes:
    return b"ULog\x01\x12\x35" + random.Random(seed).randbytes(size - 7)


# --- which log ------------------------------------------------------------------------------------------


def test_the_flights_log_is_the_one_that_was_not_listed_before() -> None:
    old, new = [log(0, None, 10), log(1, None, 20)], log(1, None, 30)
    moved = log(2, None, 20)  # numbers change with the list
    assert logs_of_flight([old[0], new, moved], None, old) == [new]
    assert logs_of_flight(old, ARMED, old) == []
    assert logs_of_flight([log(0, None, 0), new], None, None) == [new]  # an empty log is skipped


def test_the_flights_log_is_selected_by_the_armed_time() -> None:
    before, own, later = log(0, -300.0), log(1, 42.0), log(2, 400.0)
    assert logs_of_flight([later, own, before], ARMED, None) == [own]
    # Without a clock on the flight controller every log remains a candidate.
    undated = [log(0, None, 1), log(1, None, 2)]
    assert logs_of_flight(undated, ARMED, None) == undated
    assert logs_of_flight(undated[:1], ARMED, None) == undated[:1]


@given(st.lists(st.tuples(st.one_of(st.none(), st.floats(-1e6, 1e6)), st.integers(0, 10**7))), st.data())
def test_a_log_listed_before_the_flight_is_never_selected(
    logs: list[tuple[float | None, int]], data: st.DataObject
) -> None:
    entries = [log(k, ended_s, size) for k, (ended_s, size) in enumerate(logs)]
    before = data.draw(st.lists(st.sampled_from(entries))) if entries else []
    found = logs_of_flight(entries, ARMED, before)
    assert not {(e.ended, e.size_bytes) for e in found} & {(e.ended, e.size_bytes) for e in before}
    assert set(found) <= set(entries)


def test_a_log_date_from_an_unset_clock_is_none() -> None:
    assert parse_entry(Entry(3, "1970-01-01T00:12:00Z", 5)) == Px4LogEntry(3, None, 5)
    assert parse_entry(Entry(3, "nonsense", 5)).ended is None
    assert parse_entry(Entry(3, "2026-11-26T05:00:00Z", 5)).ended == BEGAN
    assert parse_entry(Entry(3, "2026-11-26T05:00:00Z", 5_000_000)).line() == (
        "3: ended 2026-11-26 05:00:00 UTC, 5.0 MB"
    )


def test_the_remaining_time_is_reported_once_from_the_measured_rate() -> None:
    expected = DownloadTime(12_000_000, 100.0)
    assert expected.line(0.01, 101.0) is None
    assert expected.line(0.0, 103.0) is None  # no data received yet
    assert expected.line(0.01, 104.0) == "6.6 min left at 30 kB/s"
    assert expected.line(0.02, 105.0) is None


def test_the_armed_span_is_read_from_a_recorded_flight() -> None:
    span = armed_span(read_log(FLIGHT))
    assert span is not None
    assert timedelta(seconds=3) < span[1] - span[0] < timedelta(minutes=3)


# --- over the real protocol -----------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def short_timeouts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))
    # No setting shortens this time, and the test would wait for it.
    monkeypatch.setattr("dart_flight.run.px4_log_download._WRITTEN_S", 0.0)
    monkeypatch.setattr(downloads, "_LOG_SILENT_S", 1.0)


def vehicle(logs: list[tuple[int, bytes]], sends_bytes: float = float("inf")) -> LogVehicle:
    return LogVehicle(load_mission(packaged("missions", "paper_single_wall.yaml")), logs, sends_bytes)


def no_choice(found: list[Px4LogEntry]) -> Px4LogEntry:
    raise AssertionError(found)


@pytest.mark.mavlink
def test_a_log_is_downloaded_byte_for_byte(tmp_path: Path) -> None:
    end_s = int(ARMED[1].timestamp())
    logs = [(end_s - 900, ulog(40_000, 1)), (end_s + 2, ulog(123_457, 2))]
    lines: list[str] = []
    with vehicle(logs) as v:
        path = fetch_px4_log(v.url, 10.0, tmp_path, ARMED, choose=no_choice, print_line=lines.append)
        assert path.read_bytes() == logs[1][1]
        assert sorted(p.name for p in tmp_path.iterdir()) == ["px4.ulg"]
        assert "0.1 MB" in lines[0]
        before = list_px4_logs(v.url, 10.0)
        assert [entry.size_bytes for entry in before] == [40_000, 123_457]
        logs.insert(0, (0, ulog(5_000, 3)))  # the flight controller has lost its clock
        path = fetch_px4_log(
            v.url, 10.0, tmp_path, None, before=before, choose=no_choice, print_line=lines.append
        )
        assert path.read_bytes() == logs[0][1]


@pytest.mark.mavlink
def test_a_failed_or_interrupted_download_leaves_no_file(tmp_path: Path) -> None:
    (tmp_path / "flight.mcap").write_bytes(b"the flight")

    def interrupt(share: float) -> None:
        raise KeyboardInterrupt

    end_s = int(ARMED[1].timestamp())
    with (
        vehicle([(end_s, ulog(200_000, 1))], 100_000) as v,
        pytest.raises(DownloadError, match="no data for"),
    ):
        fetch_px4_log(v.url, 10.0, tmp_path, ARMED, choose=no_choice, print_line=lambda line: None)
    with vehicle([(end_s, ulog(2_000_000, 1))]) as v, pytest.raises(KeyboardInterrupt):
        fetch_px4_log(
            v.url, 10.0, tmp_path, ARMED, choose=no_choice, print_line=lambda line: None, progress=interrupt
        )
    with vehicle([(end_s, b"not a ULog at all")]) as v, pytest.raises(DownloadError, match="not a ULog"):
        fetch_px4_log(v.url, 10.0, tmp_path, ARMED, choose=no_choice, print_line=lambda line: None)
    with vehicle([]) as v, pytest.raises(DownloadError, match="no log of this flight"):
        fetch_px4_log(v.url, 10.0, tmp_path, ARMED, choose=no_choice, print_line=lambda line: None)
    assert [p.name for p in tmp_path.iterdir()] == ["flight.mcap"]


class SlowToCancel:
    """A plugin that calls back a moment after its download is cancelled, as MAVSDK does on its own thread."""

    def __init__(self) -> None:
        self.called_back = False

    def download_log_file_async(self, entry: Entry, path: str, callback: Callable[..., None]) -> None:
        self._callback = callback
        callback(SimpleNamespace(name="NEXT"), SimpleNamespace(progress=0.5), None)

    def cancel_download_log_file(self) -> None:
        threading.Timer(0.2, self._end).start()

    def _end(self) -> None:
        self.called_back = True
        self._callback(SimpleNamespace(name="CANCELLED"), SimpleNamespace(progress=0.5), None)


def test_a_cancelled_download_has_called_back_before_its_plugin_can_be_destroyed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(share: float) -> None:
        raise KeyboardInterrupt

    plugin = SlowToCancel()
    monkeypatch.setattr(downloads, "LogFiles", lambda system: plugin)
    with pytest.raises(KeyboardInterrupt):
        Px4Logs(None).download(log(0, None), tmp_path / "px4.ulg", interrupt)
    assert plugin.called_back


@pytest.mark.mavlink
def test_a_download_is_refused_while_the_vehicle_is_armed(tmp_path: Path) -> None:
    with vehicle([(0, ulog(1000, 1))]) as v:
        v.autopilot.armed = True
        with pytest.raises(FlightError, match="armed"):
            fetch_px4_log(v.url, 10.0, tmp_path, None, choose=no_choice, print_line=lambda line: None)


@pytest.mark.mavlink
def test_the_command_lists_the_logs_if_it_cannot_choose_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = tmp_path / "one"
    flight.mkdir()
    shutil.copy(FLIGHT, flight / "flight.mcap")
    logs = [(0, ulog(1_000, 1)), (0, ulog(2_000, 2))]  # no clock, as indoors
    with vehicle(logs) as v:
        command = ["px4-log", str(flight), "--connection", v.url]
        assert main(command) == 2
        output = capsys.readouterr().err
        assert "--log-id" in output
        assert "  1: no date, 0.0 MB" in output
        assert main([*command, "--log-id", "7"]) == 2
        assert main([*command, "--log-id", "1", "--json"]) == 0
        assert Path(json.loads(capsys.readouterr().out)["px4_log"]).name == "px4.ulg"
        assert (flight / "px4.ulg").read_bytes() == logs[1][1]
        assert main(command) == 0  # already there
        assert "--again" in capsys.readouterr().err
    assert px4_logs_in([tmp_path]) == px4_logs_in([flight / "flight.mcap"]) == [flight / "px4.ulg"]


def test_a_log_file_is_found_by_its_path_and_a_folder_without_logs_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "log_3.ulg"
    assert px4_logs_in([other]) == [other]
    with pytest.raises(InputError, match="px4-log"):
        px4_logs_in([tmp_path])


# --- after a flight -------------------------------------------------------------------------------------


class Downloads:
    """A double of the download after a flight: an error, or the path of the log."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        self.error: BaseException | None = None
        self.arguments: list[object] = []
        monkeypatch.setattr(fly_command, "download_px4_log", self._download)
        monkeypatch.chdir(folder)
        (folder / "one").mkdir()
        shutil.copy(FLIGHT, folder / "one" / "flight.mcap")

    def _download(self, url: str, timeout_s: float, folder: Path, armed: object, *, before: object) -> Path:
        self.arguments += [folder, armed, before]
        if self.error is not None:
            raise self.error
        return folder / "px4.ulg"

    def after_flight(self, before: list[Px4LogEntry] | None = None) -> str | None:
        mission = load_mission(packaged("missions", "paper_single_wall.yaml"))
        # The command around it flies with a vehicle before it downloads.
        return fly_command._downloaded(mission, "udpin://x", Path("one/flight.mcap"), before)


@pytest.fixture
def after_a_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Downloads:
    return Downloads(monkeypatch, tmp_path)


@pytest.mark.parametrize(
    "error",
    [KeyboardInterrupt(), DownloadError("no data for 15 s"), InputError("in use", source="udpin://x")],
)
def test_a_failed_download_prints_two_lines_and_keeps_the_flight(
    error: BaseException, after_a_flight: Downloads, capsys: pytest.CaptureFixture[str]
) -> None:
    after_a_flight.error = error
    assert after_a_flight.after_flight() is None
    _, later = capsys.readouterr().err.splitlines()
    assert later == "to download it later: dart-flight px4-log one"


def test_the_downloaded_path_is_returned_as_the_verdict_stores_it(after_a_flight: Downloads) -> None:
    before = [log(0, None)]
    assert after_a_flight.after_flight(before) == "one/px4.ulg"
    assert after_a_flight.arguments == [Path("one"), armed_span(read_log(FLIGHT)), before]
