"""A vehicle that answers no request: `fly` ends soon and reports the reason."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.doubles.ports import free_udp_port
from tests.real_time import run_within

ROOT = Path(__file__).parents[2]


@pytest.mark.realtime
@pytest.mark.mavlink
@pytest.mark.parametrize("silent_after_s", [4.0, 60.0])
def test_fly_reports_a_vehicle_that_answers_nothing_within_seconds(
    silent_after_s: float, tmp_path: Path
) -> None:
    port = free_udp_port()
    words = [sys.executable, "-m", "tests.doubles.mute_vehicle", str(port), str(silent_after_s)]
    fly = [sys.executable, "-m", "dart_flight", "fly", "missions/single_wall.yaml", "--yes"]
    fly += ["--driver", "px4", "--connection", f"udpin://127.0.0.1:{port}", "--log-dir", str(tmp_path)]
    with subprocess.Popen(words, cwd=ROOT) as vehicle:
        try:
            ended = run_within(20.0, fly, cwd=ROOT)
        finally:
            vehicle.kill()
    assert ended.returncode == 2
    last = ended.stderr.splitlines()[-1]
    assert last.startswith(f"udpin://127.0.0.1:{port}: the vehicle ")
    assert "rate of " in last
    assert ended.stderr.count("Retrying failed") <= 2
    assert not list(tmp_path.iterdir()), "nothing was flown"
