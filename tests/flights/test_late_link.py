"""A link with the same constant delay in both directions, between real processes."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.doubles.ports import free_udp_port
from tests.real_time import assert_below, run_within

ROOT = Path(__file__).parents[2]
MISSION = "missions/single_wall.yaml"
DELAY_MS = 100


@pytest.mark.realtime
@pytest.mark.mavlink
@pytest.mark.parametrize(
    ("options", "problem", "least_ms"),
    [
        ([], r"NO-GO +round_trip: (\d+) ms between vehicle and program", 2 * DELAY_MS),
        (
            ["--overrule", "round_trip"],
            r"telemetry_late_ground: telemetry arrives (\d+) ms after sampling, limit 75 ms",
            DELAY_MS,
        ),
    ],
)
def test_fly_stays_on_the_ground_and_reports_the_delay_of_the_link(
    options: list[str], problem: str, least_ms: int, tmp_path: Path
) -> None:
    vehicle_port, program_port = free_udp_port(), free_udp_port()
    run = [sys.executable, "-m"]
    simulate = [*run, "dart_flight", "simulate", MISSION, "--port", str(vehicle_port)]
    proxy = [*run, "tools.lossy_proxy", "--listen", str(vehicle_port), "--to", str(program_port)]
    proxy += ["--delay-ms", str(DELAY_MS)]
    fly = [*run, "dart_flight", "fly", MISSION, "--yes", "--driver", "px4", "--log-dir", str(tmp_path)]
    fly += ["--connection", f"udpin://127.0.0.1:{program_port}", *options]
    with (
        subprocess.Popen(simulate, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as vehicle,
        subprocess.Popen(proxy, cwd=ROOT, stdout=subprocess.DEVNULL) as link,
    ):
        try:
            time.sleep(2.0)
            ended = run_within(90.0, fly, cwd=ROOT)
        finally:
            vehicle.terminate()
            link.terminate()
    assert ended.returncode == 1
    found = re.search(problem, " ".join((ended.stdout + ended.stderr).split()))
    assert found, ended.stderr
    assert int(found[1]) >= least_ms
    assert_below(least_ms + 100, int(found[1]), "delay, ms")
