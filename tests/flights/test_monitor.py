"""`dart-flight monitor` against the embedded autopilot, and its screen."""

from __future__ import annotations

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
from dart_flight.run.fast import FastFlight
from dart_flight.run.monitor import TelemetryMonitor
from tests.core.conftest import HandFedCore
from tests.doubles.ports import free_udp_port

ROOT = Path(__file__).parents[2]


def test_monitor_shows_the_force_and_impacts_of_a_flight() -> None:
    mission = load_mission(
        ROOT / "missions" / "paper_single_wall.yaml", settings=["simulation.contact.body=point"]
    )
    telemetry_monitor = TelemetryMonitor(mission, frame_known=True)
    flight = FastFlight(mission, 1)
    step = flight.core.step

    def step_both(item: object) -> object:
        telemetry_monitor.put(item)  # type: ignore[arg-type]
        return step(item)  # type: ignore[arg-type]

    flight.core.step = step_both  # type: ignore[method-assign,assignment]
    flight.run()
    telemetry_monitor.put(StatusText(0, 0, "info", "lock settled rigid"))
    view = telemetry_monitor.view()
    assert len(view.peaks) == 1
    # The monitor uses the direction of the force as the normal; the core knows the wall and reports 34.5 N.
    assert view.peaks[0][1] == pytest.approx(34.5, rel=0.1)
    assert view.thrust_source == "actuator"
    assert view.thrust_scale == pytest.approx(1.0, abs=0.1)  # including the touchdown
    assert view.lock == "settled rigid"
    console = Console(record=True, width=100, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(screen(view))
    text = console.export_text()
    assert "impact" in text
    assert "thrust from actuator" in text


def test_monitor_reports_that_it_waits_for_telemetry(view_without_telemetry: str) -> None:
    assert "waiting for telemetry" in view_without_telemetry


@pytest.fixture
def view_without_telemetry() -> str:
    telemetry_monitor = TelemetryMonitor(HandFedCore().core.mission, frame_known=False)
    console = Console(record=True, width=100, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(screen(telemetry_monitor.view()))
    return console.export_text()


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
            done = subprocess.run(
                [sys.executable, "-m", "dart_flight", *command],
                cwd=ROOT, capture_output=True, text=True, timeout=60, check=True,
            )  # fmt: skip
        finally:
            vehicle.terminate()
    view = json.loads(done.stdout)
    rates = {s["name"]: s["rate_hz"] for s in view["streams"]}
    assert rates["imu"] > 150.0
    assert rates["attitude"] > 45.0
    assert view["landed"] == "on_ground"
    assert view["force_n"] is not None
    assert view["thrust_source"] == ("actuator" if source == "auto" else source)
    assert view["cpu_percent"] < 50.0
