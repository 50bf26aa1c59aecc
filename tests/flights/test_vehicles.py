"""A vehicle without a lock through MAVSDK; a signal to the process ends its pause."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from dart_flight.base.records import LockCommand, LockState, OperatorRequest, PhaseChange, Request
from dart_flight.config.vehicle import packaged
from dart_flight.recording.reader import read_log
from dart_flight.run.replay import replay
from tests.real_time import end_within


@pytest.mark.rest
@pytest.mark.mavlink
def test_a_rigid_cage_resumes_from_a_pause_at_sigusr1_and_hits_a_wall(tmp_path: Path) -> None:
    config = tmp_path / "cage.yaml"
    config.write_text(packaged("configs", "rigid_cage.yaml").read_text("utf-8"))
    (tmp_path / "dart.yaml").write_text(packaged("configs", "dart.yaml").read_text("utf-8"))
    mission = tmp_path / "mission.yaml"
    text = packaged("missions", "rigid_cage", "single_wall.yaml").read_text("utf-8")
    mission.write_text(f"{text}waypoints: [{{pause: operator, timeout_s: 30.0}}]\n")
    command = ["dry-run", str(mission), "--config", str(config), "--log-dir", str(tmp_path), "--json"]
    command += ["--speed", "max"]
    with subprocess.Popen(
        [sys.executable, "-m", "dart_flight", *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as flight:
        assert flight.stderr is not None
        prompt = next((line for line in flight.stderr if "for the operator" in line), "")
        assert "Enter or SIGUSR1" in prompt
        flight.send_signal(signal.SIGUSR1)
        out, errors = end_within(90.0, flight)
    assert flight.returncode == 0, errors
    verdict = json.loads(out)
    assert verdict["outcome"] == "completed"
    (hit,) = verdict["collisions"]
    assert (hit["mode"], hit["lock"], hit["mode_felt"]) == ("rigid", None, None)
    assert hit["measured"]["peak_force_n"] == pytest.approx(hit["truth"]["peak_force_n"], rel=0.15)
    log = read_log(verdict["log"])
    records = [entry.record for entry in log.entries]
    assert not [r for r in records if isinstance(r, LockState | LockCommand)]
    assert [r.request for r in records if isinstance(r, OperatorRequest)] == [Request.CONTINUE]
    phases = [r.after.value for r in records if isinstance(r, PhaseChange)]
    assert phases[3:6] == ["pause", "transit", "approach"]
    again = replay(log)
    assert again.exact
    assert again.equal
