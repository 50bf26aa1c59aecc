"""Whole missions through real MAVSDK over UDP against the embedded autopilot.

The command line and the vehicle run in separate processes, as they do on the desk.
"""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dart_flight.base.records import (
    ActuatorSample,
    EscSample,
    ImuSample,
    MissionEnd,
    PhaseChange,
    TruthContact,
)
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.recording.reader import read_log
from tests.doubles.ports import free_udp_port
from tests.real_time import assert_above, assert_flown, end_within, run_within, wait_until
from tests.shared_flights import LiveFlights

ROOT = Path(__file__).parents[2]
SINGLE = "missions/paper_single_wall.yaml"
NEAR = str(ROOT / "tests" / "data" / "near_wall.yaml")
DUAL = "missions/paper_dual_collision.yaml"


@pytest.fixture(autouse=True)
def state_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Share one state folder, in which a program finds a `simulate` that is still starting."""
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))


def start_command(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "dart_flight", *arguments],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def read_until(process: subprocess.Popen[str], word: str) -> None:
    """Read the progress on standard error up to a line with `word`."""
    assert process.stderr is not None
    for line in process.stderr:
        if word in line:
            return
    pytest.fail(f"the command ended before {word!r}")


@contextmanager
def simulated_vehicle(mission: str) -> Iterator[str]:
    """Run `dart-flight simulate` in a process; yield the URL of its link."""
    port = free_udp_port()
    vehicle = start_command("simulate", mission, "--port", str(port))
    try:
        yield f"udpin://127.0.0.1:{port}"
    finally:
        vehicle.terminate()
        status = vehicle.wait(10)
    assert status == 0


@pytest.mark.mavlink
def test_a_dual_collision_completes_through_mavsdk(commanded: LiveFlights) -> None:
    verdict = RecordedFlight.read(commanded(f"dart-flight dry-run {DUAL} --speed max").log).verdict
    assert (verdict.outcome, verdict.reason) == ("completed", None)
    assert [(c.wall, c.mode) for c in verdict.collisions] == [("wood", "flexible"), ("acrylic", "rigid")]
    first = verdict.collisions[0]
    assert first.truth is not None
    assert first.truth.normal_m_s == pytest.approx(-0.6, abs=0.1)
    assert first.truth.tangential_m_s == pytest.approx(0.5, abs=0.1)
    for collision in verdict.collisions:
        assert collision.truth is not None
        assert collision.measured.peak_force_n == pytest.approx(collision.truth.peak_force_n, rel=0.15)
        assert collision.setpoint_latency_ms is not None
    assert verdict.final_error_m is not None
    assert verdict.final_error_m <= 0.2
    assert verdict.max_tilt_deg is not None
    assert verdict.max_tilt_deg < 45.0


@pytest.mark.rest
@pytest.mark.mavlink
def test_a_hexarotor_completes_a_collision_through_mavsdk(commanded: LiveFlights) -> None:
    """Six motors need one message for the commands and two for the measured speeds."""
    fly = f"dart-flight dry-run {NEAR} --speed max --config configs/hexarotor.yaml"
    done = commanded(
        f"{fly} --set estimation.thrust_source=esc --set estimation.esc_thrust_n_per_rpm2=1.1e-8"
    )
    flight = RecordedFlight.read(done.log)
    assert flight.verdict.outcome == "completed", flight.verdict.reason
    (hit,) = flight.verdict.collisions
    assert hit.truth is not None
    assert hit.measured.peak_force_n == pytest.approx(hit.truth.peak_force_n, rel=0.15)
    records = [entry.record for entry in read_log(done.log).entries]
    assert {len(r.motors) for r in records if isinstance(r, ActuatorSample)} == {6}
    assert {len(r.rpm) for r in records if isinstance(r, EscSample)} == {6}


@pytest.mark.realtime
@pytest.mark.mavlink
def test_fly_completes_on_a_vehicle_simulated_in_another_process(commanded: LiveFlights) -> None:
    # `simulate` without a mission gives this room.
    mission = "missions/dual_collision.yaml"
    fly = f"dart-flight fly {mission} --driver px4 --connection udpin://127.0.0.1:14540"
    done = commanded(fly, "dart-flight simulate")
    verdict = json.loads(done.output)  # one object on standard output and nothing else
    assert_flown(verdict["outcome"], verdict["reason"])
    assert (done.status, verdict["world"]) == (0, "drone")
    assert [(c["wall"], c["mode"]) for c in verdict["collisions"]] == [
        ("wood", "flexible"),
        ("acrylic", "rigid"),
    ]
    # The lock moved through PX4's output: the contact times show the real mode at each wall.
    assert verdict["collisions"][0]["contact_time_ms"] > 90
    assert verdict["collisions"][1]["contact_time_ms"] < 75


@pytest.mark.realtime
@pytest.mark.mavlink
def test_a_plain_mavsdk_script_flies_the_simulated_vehicle() -> None:
    with simulated_vehicle(SINGLE) as url:
        script = run_within(
            80.0, [sys.executable, str(Path(__file__).with_name("plain_mavsdk_script.py")), url]
        )
    assert script.returncode == 0, script.stderr
    assert "landed and disarmed" in script.stdout


@pytest.mark.realtime
@pytest.mark.mavlink
def test_sigkill_in_flight_leaves_a_landed_vehicle_and_a_log(tmp_path: Path) -> None:
    flight = start_command("dry-run", NEAR, "--log-dir", str(tmp_path / "flights"))
    read_until(flight, "APPROACH")
    time.sleep(0.5)
    flight.kill()
    flight.wait()
    folder = next((tmp_path / "flights").iterdir())
    read = (folder / "autopilot.log").read_text
    wait_until(lambda: "simulated vehicle stops" in read(), 30.0, "the landing of the vehicle")
    autopilot_log = read()
    events = [
        "app disconnected",
        "offboard lost, holding",
        "offboard lost, landing",
        "Landing detected",
        "Disarmed",
    ]
    places = [autopilot_log.index(word) for word in events]
    assert places == sorted(places)
    # The log ends at most 0.2 s before the kill. The autopilot's clock starts 7 s later.
    log = read_log(folder / "flight.mcap")
    assert not log.complete
    gone_s = float(autopilot_log[: places[0]].rsplit("\n", 1)[-1].split(" s ")[0])
    last_us = max(e.record.t_us for e in log.entries if isinstance(e.record, ImuSample))
    assert_above(gone_s - 0.25, last_us * 1e-6 - 7.0, "end of the log, s")
    assert [e.record.after for e in log.entries if isinstance(e.record, PhaseChange)][-1] == "approach"


@pytest.mark.rest
@pytest.mark.mavlink
def test_control_c_in_a_pause_aborts_without_a_contact(tmp_path: Path) -> None:
    """tests/core/test_core.py has the same request in an approach."""
    flights, mission = tmp_path / "flights", tmp_path / "mission.yaml"
    text = Path(NEAR).read_text(encoding="utf-8").replace("../../configs", str(ROOT / "configs"))
    mission.write_text(f"{text}waypoints: [{{pause: operator, timeout_s: 30.0}}]\n")
    flight = start_command("dry-run", str(mission), "--speed", "max", "--log-dir", str(flights), "--json")
    read_until(flight, "for the operator")
    flight.send_signal(signal.SIGINT)
    output, _ = end_within(60.0, flight)
    verdict = json.loads(output)
    assert flight.returncode == 1
    assert verdict["outcome"] == "aborted"
    assert verdict["reason"].startswith("operator")
    log = read_log(next(flights.glob("*/flight.mcap")))
    assert log.complete
    assert any(isinstance(e.record, MissionEnd) for e in log.entries)
    assert not any(isinstance(e.record, TruthContact) for e in log.entries)


@pytest.mark.mavlink
def test_a_silent_port_is_reported_without_a_traceback(tmp_path: Path) -> None:
    config = (ROOT / "configs/dart.yaml").read_text().replace("timeout_s: 30.0", "timeout_s: 1.0")
    path = tmp_path / "dart.yaml"
    path.write_text(config)
    flight = start_command(
        *("fly", SINGLE, "--yes", "--config", str(path), "--log-dir", str(tmp_path)),
        *("--connection", f"udpin://127.0.0.1:{free_udp_port()}"),
    )
    _, errors = end_within(30.0, flight)
    assert flight.returncode == 1
    assert "Traceback" not in errors
    assert "no autopilot" in errors or "cannot open" in errors


@pytest.mark.realtime
@pytest.mark.mavlink
def test_the_lock_command_moves_the_servo_on_px4s_output() -> None:
    with simulated_vehicle(SINGLE) as url:
        lock = ["lock", "rigid", "--driver", "px4", "--connection", url, "--json"]
        process = run_within(40.0, [sys.executable, "-m", "dart_flight", *lock], cwd=ROOT)
        assert process.returncode == 0, process.stderr
    state = json.loads(process.stdout)["state"]
    assert (state["phase"], state["mode"], state["feedback"]) == ("settled", "rigid", False)
