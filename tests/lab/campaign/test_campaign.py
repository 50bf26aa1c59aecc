"""`dart-flight campaign`: the table, resuming, kept logs, and the reproduction of failed flights."""

from __future__ import annotations

import csv
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest

from dart_flight.cli import main
from dart_flight.lab.campaign import campaign_folder as campaigns
from dart_flight.lab.campaign.campaign_spec import CampaignSpec, Item
from dart_flight.lab.campaign.flight_job import Flown, ItemFlyer
from dart_flight.lab.report import render as rendering
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.run.workers import Failure, FinishedItem, Interrupt
from dart_flight.sim.draws import parse_vary
from tests.shared_flights import SharedFlights

ROOT = Path(__file__).parents[3]
MISSION = str(ROOT / "tests" / "data" / "near_wall.yaml")
# In some of these worlds the wall is far from its place in the mission.
VARY = ["--vary", "wall_offset_m=0.4", "--vary", "mass"]


RUNS = 5  # one flight completes, so the table has both outcomes


def campaign_command(out: Path, runs: int, *options: str) -> list[str]:
    return ["campaign", MISSION, "--runs", str(runs), "--out", str(out), *VARY, *options]


def rows(out: Path) -> list[dict[str, str]]:
    with open(out / "flights.csv", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def flown(flown: SharedFlights) -> Path:
    """Return the folder of a campaign of `RUNS` flights without interruption."""

    def fly(folder: Path) -> None:
        assert main(campaign_command(folder / "whole", RUNS)) == 0

    return flown.once("campaign", fly) / "whole"


def test_a_row_holds_the_results_of_its_flight(flown: Path) -> None:
    mission = load_flyable(MISSION)
    spreads = parse_vary(VARY[1::2], mission.vehicle)
    found = {int(row["seed"]): row for row in rows(flown)}
    assert sorted(found) == list(range(1, RUNS + 1))
    assert {row["outcome"] for row in found.values()} == {"completed", "aborted"}
    for seed in (1, 2):  # seed 1 has no contact, seed 2 has one
        verdict = fly_fast(mission, seed, None, spreads=spreads)
        row = found[seed]
        assert row["mission"] == MISSION
        assert float(row["wall_offset_m.acrylic"]) == verdict.drawn["wall_offset_m.acrylic"]
        assert row["outcome"] == verdict.outcome.value
        assert row["reason"] == (verdict.reason or "")
        for name in ("goal_miss_m", "final_error_m", "max_tilt_deg", "flight_time_s"):
            assert row[name] == ("" if getattr(verdict, name) is None else repr(getattr(verdict, name)))
        if verdict.collisions:
            assert row["c1_normal_m_s"] == repr(verdict.collisions[0].measured.normal_m_s)
            assert row["c1_peak_force_n"] == repr(verdict.collisions[0].measured.peak_force_n)
        else:
            assert row["c1_normal_m_s"] == ""


def test_the_summary_counts_the_rows(flown: Path) -> None:
    summary = json.loads((flown / "summary.json").read_text())
    completed = sum(row["outcome"] == "completed" for row in rows(flown))
    assert summary["completed"]["count"] == completed
    assert (summary["flights"], summary["asked"], summary["errors"]) == (RUNS, RUNS, 0)
    assert sum(rule["flights"] for rule in summary["rules"]) == RUNS - completed == len(summary["failed"])
    (drawn,) = (d for d in summary["drawn"] if d["name"] == "wall_offset_m.acrylic")
    assert sum(one["completed"]["of"] for one in drawn["bins"]) == RUNS
    assert summary["vehicle"]["mass_kg"] == 1.3


def test_the_log_of_a_failed_flight_is_kept_and_can_be_replayed(
    flown: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = json.loads((flown / "summary.json").read_text())["failed"]
    logs = sorted(str(path.relative_to(flown)) for path in flown.glob("logs/*/flight.mcap"))
    assert logs == sorted(one["log"] for one in failed)
    command = shlex.split(failed[0]["command"])
    assert command[:2] == ["dart-flight", "replay"]
    assert main(command[1:]) == 0


def test_the_command_of_a_failed_flight_reproduces_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grid = ["--set", "airframe.mass_kg=1.25,1.35", "--keep", "none", "--jobs", "1"]
    assert main(campaign_command(tmp_path / "bare", 2, "--seed", "2", *grid)) == 0
    summary = json.loads((tmp_path / "bare" / "summary.json").read_text())
    assert not (tmp_path / "bare" / "logs").exists()
    assert [point["settings"] for point in summary["points"]] == [
        {"airframe.mass_kg": "1.25"},
        {"airframe.mass_kg": "1.35"},
    ]
    one = summary["failed"][0]
    capsys.readouterr()
    assert main([*shlex.split(one["command"])[1:], "--json", "--log-dir", str(tmp_path / "again")]) == 1
    verdict = json.loads(capsys.readouterr().out)
    assert (verdict["outcome"], verdict["reason"]) == (one["outcome"], one["reason"])
    assert verdict["drawn"]["wall_offset_m.acrylic"] == next(
        float(row["wall_offset_m.acrylic"])
        for row in rows(tmp_path / "bare")
        if row["seed"] == str(one["seed"]) and row["airframe.mass_kg"] == one["settings"]["airframe.mass_kg"]
    )


def test_the_campaign_page_is_a_single_file(flown: Path) -> None:
    page = (flown / "index.html").read_text()
    assert not re.search(r"<script|https?://(?!www\.w3\.org)|<link", page)
    assert "wall_not_met" in page or "wall_met_early" in page
    for link in re.findall(r'<a href="([^"]+)"', page):
        assert (flown / link).exists()
    assert page.count("data:image/svg+xml") == 2


def test_missing_jinja2_is_reported_and_the_table_is_still_written(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(flown, tmp_path / "out", ignore=shutil.ignore_patterns("index.html", "summary.json"))
    monkeypatch.setattr(rendering, "_environment", rendering._environment.__wrapped__)
    monkeypatch.setitem(sys.modules, "jinja2", None)
    assert main(["campaign", "--resume", "--out", str(tmp_path / "out")]) == 0
    assert "no page: a page needs jinja2" in capsys.readouterr().err
    assert not (tmp_path / "out" / "index.html").exists()
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["flights"] == RUNS


# --- resuming -------------------------------------------------------------------------------------------


def test_resuming_with_more_runs_appends_to_the_table(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "two"
    assert main(campaign_command(out, 2)) == 0
    assert main(campaign_command(out, 2)) == 2
    assert "a campaign exists here already; use --resume to continue it" in capsys.readouterr().err
    assert main([*campaign_command(out, RUNS), "--resume"]) == 0
    assert f"2 of {RUNS} flights are already in the table" in capsys.readouterr().err
    assert sorted((out / "flights.csv").read_bytes().splitlines()) == sorted(
        (flown / "flights.csv").read_bytes().splitlines()
    )
    before = (out / "flights.csv").read_bytes()
    assert main(["campaign", "--resume", "--out", str(out), "--json"]) == 0, "no flight remains"
    assert json.loads(capsys.readouterr().out)["flights"] == RUNS
    assert (out / "flights.csv").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seed", "2"], "cannot resume this campaign: --seed: 1 in the existing campaign, not 2"),
        (["--vary", "battery"], "cannot resume this campaign: --vary"),
        (["--set", "airframe.mass_kg=1.2"], "cannot resume this campaign: --set"),
        (["--keep", "all"], "cannot resume this campaign: --keep: failed in the existing campaign, not all"),
    ],
)
def test_resuming_a_different_campaign_is_refused_in_one_line(
    options: list[str], message: str, flown: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (flown / "flights.csv").read_bytes()
    assert main([*campaign_command(flown, RUNS), "--resume", *options]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert (flown / "flights.csv").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--runs", "3"], "MISSION: no mission given"),
        (["--resume"], "no campaign to resume here"),
        (["--resume", "--runs", "3"], "--runs needs the mission files"),
        ([MISSION], "--runs: missing --runs N"),
        (
            [MISSION, "--runs", "1", "--scheduler", "tcp://127.0.0.1:1", "--jobs", "2"],
            "--jobs applies to this computer",
        ),
    ],
)
def test_an_incomplete_command_is_refused(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["campaign", "--out", str(tmp_path / "none"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def start_campaign(out: Path, runs: int) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "dart_flight", *campaign_command(out, runs), "--resume"],
        env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )  # fmt: skip


def wait_for_rows(out: Path, count: int, process: subprocess.Popen[str]) -> None:
    until = time.monotonic() + 120.0
    table = out / "flights.csv"
    while time.monotonic() < until and process.poll() is None:
        if table.exists() and table.read_bytes().count(b"\n") > count:
            return
        time.sleep(0.02)


@pytest.mark.rest
def test_rows_are_neither_lost_nor_duplicated_by_repeated_kills(flown: Path, tmp_path: Path) -> None:
    out = tmp_path / "killed"
    for count in (1, 3):
        process = start_campaign(out, RUNS)
        wait_for_rows(out, count, process)
        process.kill()
        process.wait()
        with open(out / "flights.csv", "ab") as file:
            file.write(b"torn,by,the,last")  # an incomplete row, as after a crash
    process = start_campaign(out, RUNS)
    _, message = process.communicate(timeout=300.0)
    assert process.returncode == 0, message
    assert sorted((out / "flights.csv").read_bytes().splitlines()) == sorted(
        (flown / "flights.csv").read_bytes().splitlines()
    )
    assert {path.parent.name for path in out.glob("logs/*/flight.mcap")} == {
        path.parent.name for path in flown.glob("logs/*/flight.mcap")
    }


def test_ctrl_c_keeps_completed_rows(tmp_path: Path) -> None:
    out = tmp_path / "interrupted"
    process = start_campaign(out, 200)
    wait_for_rows(out, 1, process)
    os.killpg(process.pid, signal.SIGINT)
    _, message = process.communicate(timeout=120.0)
    assert process.returncode == 130, message
    written = len(rows(out))
    assert 1 <= written < 200
    assert f"{written} of 200 flights are in the table" in message
    assert json.loads((out / "summary.json").read_text())["flights"] == written
    assert "flights are not flown yet" in (out / "index.html").read_text()


# --- errors ---------------------------------------------------------------------------------------------


def open_folder(out: Path, runs: int = 6) -> campaigns.CampaignFolder:
    return campaigns.open_campaign(CampaignSpec((MISSION,), runs=runs), out, resume=True)


def engine_with(flights: Mapping[int, Flown | Failure]) -> campaigns.Engine:
    def engine(flyer: ItemFlyer, items: Iterable[Item], interrupt: Interrupt) -> campaigns.Landings:
        for item in items:
            line = flyer.failed(item, "stands in").line
            yield FinishedItem(item, flights.get(item.seed, Flown(line, completed=True, log=None)))

    return engine


def test_a_software_error_becomes_a_row_and_the_campaign_continues(tmp_path: Path) -> None:
    opened = open_folder(tmp_path / "faulty")
    faults = {3: Failure("ValueError: no (plant.py:7)"), 5: Failure("its process died 2 times (SIGKILL)")}
    assert campaigns.fly(opened, engine_with(faults), Interrupt()) == 6
    found = {row["seed"]: row for row in rows(opened.folder)}
    assert (found["3"]["outcome"], found["3"]["reason"]) == ("error", "ValueError: no (plant.py:7)")
    assert found["5"]["reason"] == "its process died 2 times (SIGKILL)"
    assert len(found) == 6


@pytest.mark.rest
def test_a_full_disk_ends_a_campaign_that_can_be_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The kernel's limit on file sizes simulates the full disk."""
    out = tmp_path / "full"
    limited = (
        "import resource, sys\n"
        "from dart_flight.cli import main\n"
        "from dart_flight.recording.about import software_version\n"
        "if __name__ == '__main__':\n"
        "    software_version()\n"  # call git before the limit: a truncated index leaves a lock file
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (800, 800))\n"
        "    sys.exit(main(sys.argv[1:]))\n"
    )
    script = tmp_path / "limited.py"
    script.write_text(limited)
    command = ["campaign", MISSION, "--runs", "6", "--out", str(out), "--keep", "none", "--jobs", "2"]
    done = subprocess.run(
        [sys.executable, "-B", str(script), *command],  # -B: no truncated bytecode
        env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert done.stderr.splitlines()[-1] == (
        f"cannot write {out}/flights.csv: File too large; completed rows are kept; continue with --resume"
    )
    written = len(rows(out))
    assert 1 <= written < 6
    assert main([*command, "--resume"]) == 0
    assert [int(row["seed"]) for row in sorted(rows(out), key=lambda row: int(row["seed"]))] == list(
        range(1, 7)
    )
