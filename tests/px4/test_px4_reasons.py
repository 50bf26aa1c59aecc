"""PX4's own reasons, from a real PX4: wherever the program says that PX4 refuses, it says why."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dart_flight.config.parameters import PositionSource
from dart_flight.recording import read_log
from dart_flight.samples import GuardEvent, HealthReport, StatusText
from dart_flight.worlds.prepare import load_flyable
from tests.px4.test_px4_check import waiting_px4

pytestmark = pytest.mark.px4

MISSION = Path(__file__).parents[2] / "missions" / "single_wall.yaml"
# v1.14 and v1.15 in simulation do not serve the words of their events.
WITHOUT_WORDS = ("preflight checks failed", "gives no reason")


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"COM_ARM_ODID": 2}, "Open Drone ID"), ({"EKF2_EV_CTRL": 8, "EKF2_HGT_REF": 0}, "osition")],
    ids=["a preflight check", "no position"],
)
def test_a_refusal_says_why_in_terminal_log_and_verdict(
    changes: dict[str, int], words: str, px4_dir: Path, tmp_path: Path
) -> None:
    own = tmp_path / "own.params"
    own.write_text("# of this test\n" + "".join(f"1\t1\t{name}\t{v}\t6\n" for name, v in changes.items()))
    done = subprocess.run(
        [
            sys.executable, "-m", "dart_flight", "dry-run", str(MISSION), "--px4", str(px4_dir), "--json",
            "--params", str(own), "--speed", "2", "--log-dir", str(tmp_path / "flights"),
        ],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    if "has no parameter" in done.stderr:
        pytest.skip(done.stderr.splitlines()[-1])
    verdict = json.loads(done.stdout)
    reason = verdict["reason"]
    assert reason.startswith("arming_refused: PX4 refused to arm; PX4 "), reason
    assert any(word in reason for word in (words, *WITHOUT_WORDS)), reason
    said = " ".join(done.stderr.split())
    assert reason.partition(": ")[2] in said, done.stderr
    (log,) = (tmp_path / "flights").glob("*/flight.mcap")
    records = [entry.record for entry in read_log(log).entries]
    assert [r.detail for r in records if isinstance(r, GuardEvent)] == [reason.partition(": ")[2]]
    given = [r.text for r in records if isinstance(r, StatusText)]
    given += [word for r in records if isinstance(r, HealthReport) for word in (*r.blocking, *r.others)]
    quoted = re.split("PX4 says: |, but finds: ", reason)[-1].replace("; also ", ", ").split(", ")
    assert all(any(word in text for text in given) for word in quoted), (quoted, given)


def test_check_on_a_connection_says_why_px4_would_not_arm(px4_dir: Path, tmp_path: Path) -> None:
    mission = load_flyable(MISSION)
    changes: dict[str, int | float] = {"COM_ARM_ODID": 2}
    with waiting_px4(mission, px4_dir, tmp_path, PositionSource.MOCAP, changes) as url:
        done = subprocess.run(
            [sys.executable, "-m", "dart_flight", "check", str(MISSION), "--connection", url, "--json"],
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
    found = {f["item"]: f for f in json.loads(done.stdout)["findings"]}
    if "px4_checks" not in found:
        pytest.skip(f"{found['version']['says']} sends no report of its checks")
    says = found["px4_checks"]["says"]
    assert says.startswith("PX4 would not arm as it is: "), says
    assert any(word in says for word in ("Open Drone ID", *WITHOUT_WORDS)), says
