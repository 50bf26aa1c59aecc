"""Many logs in folders, some of them incomplete; all outputs share one time origin."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dart_flight.base.records import TruthContact, TruthSample, World
from dart_flight.cli import main
from dart_flight.config.mission import load_mission
from dart_flight.config.packages import install_command
from dart_flight.config.vehicle import packaged
from dart_flight.recording.about import describe_flight
from dart_flight.recording.reader import read_log
from dart_flight.recording.verdict import verdict_of
from dart_flight.recording.writer import FlightLog
from tests.command_fixtures import Refuse, RunJson
from tests.shared_flights import SharedFlights

ROOT = Path(__file__).parents[2]
MISSION = str(packaged("missions", "paper_single_wall.yaml"))


@pytest.fixture
def two_flights(flown: SharedFlights, folder: Path) -> Path:
    """A working folder with two flights in its folder `flights`."""
    for seed in (1, 2):
        log = flown("paper_single_wall", seed).log
        shutil.copytree(log.parent, folder / "flights" / f"{log.parent.name}-seed{seed}")
    return folder


def write_incomplete_log(folder: Path) -> Path:
    path = folder / "flights" / "20200101T000000-stub" / "flight.mcap"
    path.parent.mkdir()
    FlightLog(path, describe_flight(load_mission(MISSION), World.EMBEDDED, 1)).close()
    return path


def log_paths(folder: Path) -> list[str]:
    return [str(path) for path in sorted((folder / "flights").glob("*/flight.mcap"))]


def test_replay_accepts_a_folder(flown: SharedFlights, tmp_path: Path, run_json: RunJson) -> None:
    """The logs end in the climb; `test_incomplete_logs_are_skipped` replays a whole log."""
    whole = read_log(flown("paper_single_wall", 1).log)
    end = whole.entries[4000].number
    for name in ("one", "two"):
        (tmp_path / "flights" / name).mkdir(parents=True)
        log = FlightLog(tmp_path / "flights" / name / "flight.mcap", whole.about)
        for entry in (e for e in whole.entries[:4000] if e.number < end):
            log.put(entry.record, entry.number)
        log.close()
    printed, _ = run_json("replay", tmp_path / "flights")
    assert printed["equal"] is True
    assert [len(printed["replays"]), len({r["log"] for r in printed["replays"]})] == [2, 2]


def test_export_writes_tables_beside_each_log(two_flights: Path, run_json: RunJson) -> None:
    assert len(run_json("export", "flights")[0]["exports"]) == 2
    for log in log_paths(two_flights):
        assert (Path(log).parent / "csv" / "columns.csv").exists()
    assert main(["export", *log_paths(two_flights), "-o", "all"]) == 0
    assert len(list(Path("all").glob("*/columns.csv"))) == 2


@pytest.mark.rest
def test_a_report_of_several_logs_is_written_into_their_folder(two_flights: Path) -> None:
    """A report of one log: `test_all_outputs_share_one_time_origin`."""
    pytest.importorskip("matplotlib")
    assert main(["report", "flights"]) == 0
    assert (two_flights / "flights" / "report.html").exists()


@pytest.mark.parametrize("command", ["replay", "export", "report", "identify"])
def test_a_folder_without_flights_is_refused(command: str, tmp_path: Path, refusal_of: Refuse) -> None:
    assert "no flight log (flight.mcap) below this folder" in refusal_of(command, tmp_path)


@pytest.mark.parametrize(
    ("words", "count"),
    [
        (["replay"], lambda out: len(out["replays"])),
        pytest.param(
            ["identify", "--surface", "acrylic"], lambda out: len(out["trials"]), marks=pytest.mark.rest
        ),
        pytest.param(["calibrate", "thrust"], lambda out: 1, marks=pytest.mark.rest),
    ],
    ids=["replay", "identify", "calibrate"],
)
def test_incomplete_logs_are_skipped(
    words: list[str], count: Callable[[Any], int], two_flights: Path, run_json: RunJson
) -> None:
    pytest.importorskip("scipy")
    empty, whole = two_flights / "empty.mcap", log_paths(two_flights)[-1]
    empty.touch()
    incomplete = [empty]
    if words != ["replay"]:  # nothing to decide is replayed as equal
        incomplete.append(write_incomplete_log(two_flights))
    printed, errors = run_json(*words, *incomplete, whole)
    assert count(printed) == 1
    for path in incomplete:
        assert any(str(path) in line and "skipped" in line for line in errors.splitlines())


def test_an_incomplete_log_alone_is_refused(two_flights: Path) -> None:
    assert main(["identify", "--surface", "acrylic", str(write_incomplete_log(two_flights))]) == 2


@pytest.mark.rest
def test_all_outputs_of_an_oddly_named_log_share_one_time_origin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A phase change has the same time in the terminal, the CSV file, the replay and the report."""
    pytest.importorskip("matplotlib")
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/logs [/y]\xff"))
    assert main(["dry-run", MISSION, "--fast", "--log-dir", str(folder)]) == 0
    shown = re.search(r"([\d.]+) s +→ CONTACT 1", capsys.readouterr().err)
    assert shown is not None
    terminal_s = float(shown[1])
    (log,) = folder.glob("*/flight.mcap")
    assert main(["export", str(log)]) == 0
    (changed,) = (p for p in (log.parent / "csv").glob("*.csv") if "before,after" in p.read_text())
    with open(changed, newline="") as file:
        changes = list(csv.DictReader(file))
    table_s = next(float(row["time_s"]) for row in changes if row["after"] == "contact")
    assert abs(table_s - terminal_s) <= 0.005 + 1e-9
    capsys.readouterr()
    assert main(["replay", str(log), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    replayed_s = next(row[0] for row in rows if "after contact" in row[2])
    assert replayed_s == pytest.approx(table_s, abs=1e-6)
    assert main(["report", str(log)]) == 0
    assert "logs [/y]\\xff" in capsys.readouterr().err
    page = (log.parent / "report.html").read_text()
    cell = re.search(r"<td[^>]*>([\d.]+)</td>\s*<td[^>]*>approach</td>\s*<td[^>]*>contact</td>", page)
    assert cell is not None
    assert float(cell[1]) == pytest.approx(table_s, abs=0.051)


def test_replay_shows_only_changed_decisions(two_flights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = log_paths(two_flights)[0]
    assert main(["replay", log, "--set", "detection.force_threshold_n=20"]) == 1
    out = capsys.readouterr().out
    assert "ContactEnd" in out
    assert "arming" not in out, "unchanged decisions are not listed"
    assert "decisions are as recorded" in out


def test_an_abort_shows_its_reason(two_flights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dry-run", MISSION, "--fast", "--fault", "ekf-jump@transit"]) == 1
    out = capsys.readouterr().out
    assert "reason: " in out
    assert "peak" not in out, "no empty columns"
    reason = verdict_of(read_log(log_paths(two_flights)[-1])).reason
    assert reason is not None
    assert reason in out.replace("\n", " ") or reason[:30] in out


def test_truth_is_null_if_the_log_has_none(two_flights: Path) -> None:
    log = read_log(log_paths(two_flights)[0])
    log.entries = [e for e in log.entries if not isinstance(e.record, TruthSample | TruthContact)]
    verdict = verdict_of(log)
    assert [c.truth for c in verdict.collisions] == [None]
    assert verdict.ekf_error_m is None


@pytest.mark.rest
def test_tables_fit_eighty_columns(
    two_flights: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    scenarios = packaged("missions", "scenarios")
    for words, status in (
        (["plan", str(scenarios / "dual_collision.yaml"), "--top", "3"], 0),
        (["plan", str(scenarios / "one_wall.yaml"), "--objective", "robust", "--top", "2"], 0),
        (["dry-run", MISSION, "--fast", "--runs", "1"], 0),
        (["predict", "--surface", "acrylic", "--mode", "rigid", "--drop", "0.2"], 0),
        (["calibrate", "thrust", "flights"], 0),
    ):
        assert main(words) == status
        out = capsys.readouterr().out
        assert "…" not in out, f"{words}: cut\n{out}"
        assert max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.rest)],
    ids=lambda number: number.name,
)
def test_an_interrupted_series_reports_the_flights_that_were_flown(
    number: signal.Signals, tmp_path: Path
) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-m", "dart_flight", "dry-run", MISSION, "--fast", "--runs", "200", "--json"],
        cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
        # The test runner may ignore Ctrl-C, and its children would inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )  # fmt: skip
    deadline_s = time.monotonic() + 120.0
    while len(list(tmp_path.glob("flights/*/flight.mcap"))) < 4 and time.monotonic() < deadline_s:
        time.sleep(0.1)  # some flights are complete: every process has begun its second flight
    if number is signal.SIGINT:
        os.killpg(process.pid, number)  # as a terminal does
    else:
        process.send_signal(number)
    out, err = process.communicate(timeout=120.0)
    assert process.returncode == 130, err
    printed = json.loads(out)
    flown = len(printed["runs"])
    assert printed["interrupted"] is True
    assert 1 <= flown < 200
    assert printed["summary"]["completed"] == flown
    assert all((tmp_path / run["log"]).exists() for run in printed["runs"])
    assert f"{flown} of 200 flights were flown" in err
    assert f"logs: {flown} flights in flights" in err


@pytest.mark.parametrize("words", [["dry-run", MISSION], ["dry-run", MISSION, "--runs", "2"], ["simulate"]])
def test_nothing_starts_without_the_simulation_package(
    words: list[str], folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [n for n in sys.modules if n.split(".")[0] == "pymavlink"] + [
        "dart_flight.sim.standalone", "dart_flight.sim.mavlink_endpoint",
    ]:  # fmt: skip
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "pymavlink", None)
    assert main(words) == 2
    errors = capsys.readouterr().err.splitlines()
    assert errors[-1] == f"simulation needs pymavlink: {install_command('sim')}"
    assert list(folder.iterdir()) == [], "no log folder is left behind"


def test_a_bare_dry_run_flies_without_the_simulation_package(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pymavlink", None)
    assert main(["dry-run"]) == 0
    errors = " ".join(capsys.readouterr().err.split())
    assert "flying the packaged dual collision" in errors
    assert "flying with --fast, because pymavlink is not installed" in errors
    assert main(["dry-run", "--speed", "2"]) == 2
