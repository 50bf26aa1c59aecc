"""Refusals of a real PX4: the program always reports PX4's own reason."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from dart_flight.base.records import GuardEvent, HealthReport, StatusText
from dart_flight.config.parameter_file import format_parameters
from dart_flight.recording.reader import read_log
from tests.doubles.operator_station import OperatorStation
from tests.px4.real_px4 import MISSIONS, DryRun, waiting_px4

pytestmark = pytest.mark.px4

MISSION = MISSIONS / "paper_single_wall.yaml"
# PX4 v1.14 and v1.15 in simulation do not provide the texts of their events.
WITHOUT_TEXTS = ("preflight checks failed", "gives no reason")
# A missing distance sensor fails a preflight check in every version.
FAILED_CHECK: dict[str, int | float] = {"SYS_HAS_NUM_DIST": 1}
NO_POSITION: dict[str, int | float] = {"EKF2_EV_CTRL": 8, "EKF2_HGT_REF": 0}  # yaw alone from motion capture


class Refusal(NamedTuple):
    """A dry-run that PX4 refused: the verdict's reason, the terminal's text, and texts of the log."""

    reason: str
    terminal: str
    guard: list[str]
    px4_texts: list[str]  # PX4's own texts


def dry_run(px4_dir: Path, folder: Path, changes: dict[str, int | float], *options: str) -> DryRun:
    """Start a dry-run with changed parameters."""
    own = folder / "own.params"
    own.write_text(format_parameters(changes, []))
    return DryRun(px4_dir, folder / "flights", MISSION, "--params", str(own), *options)


def refusal_of(flight: DryRun) -> Refusal:
    """Wait for the end of a dry-run and return its refusal."""
    verdict, error = flight.verdict(150.0)
    assert flight.process.returncode == 1, error
    (log,) = flight.folder.glob("*/flight.mcap")
    records = [entry.record for entry in read_log(log).entries]
    px4_texts = [r.text for r in records if isinstance(r, StatusText)]
    px4_texts += [w for r in records if isinstance(r, HealthReport) for w in (*r.blocking, *r.others)]
    guard = [f"{r.rule}: {r.detail}" for r in records if isinstance(r, GuardEvent)]
    return Refusal(verdict["reason"], " ".join(error.split()), guard, px4_texts)


def assert_reason_is_quoted(refusal: Refusal, start: str, expected: str) -> None:
    """Assert that verdict, terminal and log quote PX4's own reason."""
    reason, text = refusal.reason, refusal.reason.partition(": ")[2]
    assert reason.startswith(start), reason
    assert any(word in reason for word in (expected, *WITHOUT_TEXTS)), reason
    assert text in refusal.terminal
    assert refusal.guard == [reason]
    quoted = re.split("PX4 reports: |, but reports: ", text)[-1].replace("; also ", ", ").split(", ")
    assert all(any(word in px4_text for px4_text in refusal.px4_texts) for word in quoted), refusal


@pytest.mark.parametrize(
    ("changes", "start", "expected"),
    [
        (FAILED_CHECK, "arming_refused: PX4 refused to arm; PX4 ", "istance"),
        (NO_POSITION, "not_ready: no local position; PX4 ", "No valid position estimate"),
    ],
    ids=["arming", "no local position"],
)
def test_a_refusal_is_explained_in_terminal_log_and_verdict(
    changes: dict[str, int | float], start: str, expected: str, px4_dir: Path, tmp_path: Path
) -> None:
    flight = dry_run(px4_dir, tmp_path, changes, "--speed", "2")
    assert_reason_is_quoted(refusal_of(flight), start, expected)


def test_an_offboard_refusal_is_explained_in_terminal_log_and_verdict(px4_dir: Path, tmp_path: Path) -> None:
    """A disarmed PX4 accepts every mode, so the test arms it first and lets every setpoint time out.

    PX4 permits arming shortly before the mission begins; at a low speed this leaves time on a busy computer.
    """
    changes: dict[str, int | float] = {"COM_OF_LOSS_T": 0.0, "COM_DISARM_PRFLT": -1.0}
    flight = dry_run(px4_dir, tmp_path, changes, "--outdoor", "--speed", "0.4")
    number = int(flight.wait_for(r"PX4 instance (\d+)", 20.0))
    with OperatorStation.of_px4(number) as station:
        station.arm()
    assert_reason_is_quoted(
        refusal_of(flight), "offboard_refused: PX4 refused offboard mode; PX4 ", "No offboard signal"
    )


def check_findings(px4_dir: Path, folder: Path, changes: dict[str, int | float]) -> dict[str, Any]:
    with waiting_px4(px4_dir, folder, changes) as url:
        result = subprocess.run(
            [sys.executable, "-m", "dart_flight", "check", str(MISSION), "--connection", url, "--json"],
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
    return {f["item"]: f for f in json.loads(result.stdout)["findings"]}


def test_check_reports_why_px4_would_refuse_to_arm(px4_dir: Path, tmp_path: Path) -> None:
    says = check_findings(px4_dir, tmp_path, FAILED_CHECK)["px4_checks"]["message"]
    assert says.startswith("PX4 would refuse to arm: "), says
    assert any(word in says for word in ("istance", *WITHOUT_TEXTS)), says


def test_check_reports_a_missing_local_position_with_its_reason(px4_dir: Path, tmp_path: Path) -> None:
    found = check_findings(px4_dir, tmp_path, NO_POSITION)
    assert not found["estimator"]["go"]
    assert re.match("no valid local position; PX4 reports: .*(osition|failed)", found["estimator"]["message"])
