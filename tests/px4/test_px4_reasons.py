"""PX4's own reasons, from a real PX4: wherever the program says that PX4 refuses, it says why."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from dart_flight.base.records import GuardEvent, HealthReport, StatusText
from dart_flight.config.parameter_file import PositionSource
from dart_flight.recording.reader import read_log
from dart_flight.run.prepare import load_flyable
from tests.doubles.ground_station import arm
from tests.px4.test_px4_check import waiting_px4

pytestmark = pytest.mark.px4

MISSION = Path(__file__).parents[2] / "missions" / "paper_single_wall.yaml"
# v1.14 and v1.15 in simulation do not serve the words of their events.
WITHOUT_WORDS = ("preflight checks failed", "gives no reason")
# A distance sensor that is not there: a preflight check that every version has.
A_CHECK: dict[str, int | float] = {"SYS_HAS_NUM_DIST": 1}
NO_POSITION: dict[str, int | float] = {"EKF2_EV_CTRL": 8, "EKF2_HGT_REF": 0}  # yaw alone from motion capture


class Refused(NamedTuple):
    """A dry-run that PX4 refused: the verdict's reason, what stands in the terminal, and the log's words."""

    reason: str
    said: str
    guard: list[str]
    given: list[str]  # what PX4 itself has said


class DryRun:
    """A dry-run with a real PX4 in a process of its own, with some parameters changed."""

    def __init__(self, px4_dir: Path, folder: Path, changes: dict[str, int | float], *words: str) -> None:
        own = folder / "own.params"
        lines = [f"1\t1\t{name}\t{v}\t{6 if isinstance(v, int) else 9}\n" for name, v in changes.items()]
        own.write_text("# of this test\n" + "".join(lines))
        self._folder = folder / "flights"
        self._process = subprocess.Popen(
            [
                sys.executable, "-m", "dart_flight", "dry-run", str(MISSION), "--px4", str(px4_dir), "--json",
                "--params", str(own), "--log-dir", str(self._folder), *words,
            ],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def instance(self) -> int:
        """The number of its PX4, once it has one."""
        for _ in range(400):
            said = "".join(path.read_text() for path in self._folder.glob("*/autopilot.log"))
            found = re.search(r"PX4 instance (\d+)", said)
            if found:
                return int(found[1])
            time.sleep(0.05)
        raise AssertionError("no PX4 within 20 s")

    def refused(self) -> Refused:
        """How it ended."""
        out, error = self._process.communicate(timeout=150)
        assert self._process.returncode == 1, error
        (log,) = self._folder.glob("*/flight.mcap")
        records = [entry.record for entry in read_log(log).entries]
        given = [r.text for r in records if isinstance(r, StatusText)]
        given += [w for r in records if isinstance(r, HealthReport) for w in (*r.blocking, *r.others)]
        guard = [f"{r.rule}: {r.detail}" for r in records if isinstance(r, GuardEvent)]
        return Refused(json.loads(out)["reason"], " ".join(error.split()), guard, given)


def judge(refused: Refused, begins: str, words: str) -> None:
    """PX4's own words stand in verdict, terminal and log."""
    reason, text = refused.reason, refused.reason.partition(": ")[2]
    assert reason.startswith(begins), reason
    assert any(word in reason for word in (words, *WITHOUT_WORDS)), reason
    assert text in refused.said
    assert refused.guard == [reason]
    quoted = re.split("PX4 reports: |, but reports: ", text)[-1].replace("; also ", ", ").split(", ")
    assert all(any(word in given for given in refused.given) for word in quoted), refused


@pytest.mark.parametrize(
    ("changes", "begins", "words"),
    [
        (A_CHECK, "arming_refused: PX4 refused to arm; PX4 ", "istance"),
        (NO_POSITION, "not_ready: no local position; PX4 ", "No valid position estimate"),
    ],
    ids=["arming", "no local position"],
)
def test_a_refusal_says_why_in_terminal_log_and_verdict(
    changes: dict[str, int | float], begins: str, words: str, px4_dir: Path, tmp_path: Path
) -> None:
    judge(DryRun(px4_dir, tmp_path, changes, "--speed", "2").refused(), begins, words)


def test_refused_offboard_says_why_in_terminal_log_and_verdict(px4_dir: Path, tmp_path: Path) -> None:
    """Disarmed PX4 takes every mode: it refuses offboard when armed already, and no setpoint counts."""
    changes: dict[str, int | float] = {"COM_OF_LOSS_T": 0.0, "COM_DISARM_PRFLT": -1.0}
    flight = DryRun(px4_dir, tmp_path, changes, "--outdoor")
    assert arm(flight.instance())
    judge(flight.refused(), "offboard_refused: PX4 refused offboard mode; PX4 ", "No offboard signal")


def checked(px4_dir: Path, folder: Path, changes: dict[str, int | float]) -> dict[str, Any]:
    mission = load_flyable(MISSION)
    with waiting_px4(mission, px4_dir, folder, PositionSource.MOCAP, changes) as url:
        done = subprocess.run(
            [sys.executable, "-m", "dart_flight", "check", str(MISSION), "--connection", url, "--json"],
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
    return {f["item"]: f for f in json.loads(done.stdout)["findings"]}


def test_check_on_a_connection_says_why_px4_would_not_arm(px4_dir: Path, tmp_path: Path) -> None:
    says = checked(px4_dir, tmp_path, A_CHECK)["px4_checks"]["says"]
    assert says.startswith("PX4 would refuse to arm: "), says
    assert any(word in says for word in ("istance", *WITHOUT_WORDS)), says


def test_check_on_a_connection_says_that_there_is_no_local_position_and_why(
    px4_dir: Path, tmp_path: Path
) -> None:
    found = checked(px4_dir, tmp_path, NO_POSITION)
    assert not found["estimator"]["go"]
    assert re.match("no valid local position; PX4 reports: .*(osition|failed)", found["estimator"]["says"])
