"""`dart-flight monitor` against the embedded autopilot, and its screen."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from dart_flight.base.records import StatusText
from dart_flight.cli.monitor_command import screen
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.recording.reader import read_log
from dart_flight.recording.schema import INPUTS
from dart_flight.run.monitor import MonitorView, TelemetryMonitor
from tests.core.conftest import HandFedCore
from tests.doubles.ports import free_udp_port
from tests.real_time import assert_above, assert_below, run_within
from tests.shared_flights import SharedFlights

ROOT = Path(__file__).parents[2]


def shown(view: MonitorView) -> str:
    """Return the text of the monitor's screen."""
    printed = io.StringIO()
    Console(width=100, file=printed).print(screen(view))
    return printed.getvalue()


def test_monitor_shows_the_force_and_impacts_of_a_flight(flown: SharedFlights) -> None:
    flight = flown("paper_single_wall", 1)
    monitor = TelemetryMonitor(load_mission(packaged("missions", "paper_single_wall.yaml")), frame_known=True)
    for entry in read_log(flight.log).entries:
        if isinstance(entry.record, INPUTS):
            monitor.put(entry.record)  # type: ignore[arg-type]
    monitor.put(StatusText(0, 0, "info", "lock settled rigid"))
    view = monitor.view()
    (hit,), ((_, peak_n, _),) = flight.verdict.collisions, view.peaks
    # The monitor uses the direction of the force as the normal; the core knows the wall.
    assert peak_n == pytest.approx(hit.measured.peak_force_n, rel=0.2)
    assert view.thrust_source == "actuator"
    assert view.thrust_scale == pytest.approx(1.0, abs=0.1)  # including the touchdown
    assert view.lock == "settled rigid"
    assert "impact" in shown(view)
    assert "thrust from actuator" in shown(view)


def test_monitor_reports_that_it_waits_for_telemetry() -> None:
    monitor = TelemetryMonitor(HandFedCore().core.mission, frame_known=False)
    assert "waiting for telemetry" in shown(monitor.view())


@pytest.mark.realtime
@pytest.mark.mavlink
@pytest.mark.parametrize("source", ["auto", "esc"])
def test_monitor_reads_telemetry_through_mavlink(source: str, tmp_path: Path) -> None:
    text = (ROOT / "configs" / "dart.yaml").read_text()
    text = re.sub("thrust_source: auto", f"thrust_source: {source}", text)
    if source == "esc":
        text = re.sub("esc_thrust_n_per_rpm2: null", "esc_thrust_n_per_rpm2: 1.1e-8", text)
    config = tmp_path / "vehicle.yaml"
    config.write_text(text)
    port = free_udp_port()
    simulate = [sys.executable, "-m", "dart_flight", "simulate", "--port", str(port)]
    with subprocess.Popen(
        simulate, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as vehicle:
        try:
            url = f"udpin://127.0.0.1:{port}"
            command = ["monitor", "--connection", url, "--seconds", "6", "--json", "--config", str(config)]
            done = run_within(60.0, [sys.executable, "-m", "dart_flight", *command], cwd=ROOT)
        finally:
            vehicle.terminate()
    assert done.returncode == 0, done.stderr
    view = json.loads(done.stdout)
    rates = {s["name"]: s["rate_hz"] for s in view["streams"]}
    assert_above(150.0, rates["imu"], "rate of the IMU, Hz")
    assert_above(45.0, rates["attitude"], "rate of the attitude, Hz")
    assert view["landed"] == "on_ground"
    assert view["force_n"] is not None
    assert view["thrust_source"] == ("actuator" if source == "auto" else source)
    assert_below(50.0, view["cpu_percent"], "processor load, %")
