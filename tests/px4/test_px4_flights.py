"""Flights with a real PX4, in lockstep: they complete; whatever dies in flight, nothing is left behind."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest
from pymavlink.dialects.v20.common import MAV_RESULT_ACCEPTED, MAV_RESULT_TEMPORARILY_REJECTED

from dart_flight.base.records import (
    ForceEstimate,
    GuardEvent,
    ImpactPeak,
    MissionEnd,
    Phase,
    PhaseChange,
    PlanTaken,
    Record,
)
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.rotors import rotor_differences
from dart_flight.config.vehicle import packaged
from dart_flight.lab.calibrate.airframe_reader import read_airframe
from dart_flight.recording.reader import read_log
from dart_flight.recording.verdict import Verdict
from dart_flight.run.prepare import load_flyable
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.pipe import FULL_SPEED
from tests.doubles.ground_station import switch_to_position

pytestmark = pytest.mark.px4

MISSIONS = Path(__file__).parents[2] / "missions"
SWEEP = Path(__file__).with_name("sweep_mission.yaml")
# Times real time: what lockstep sustains on two idle cores with room to spare; a busy machine wants 1.


def accept(verdict: Verdict) -> None:
    """What issue and docs ask of a flight with mocap or RTK."""
    assert verdict.outcome == "completed", verdict.reason
    assert verdict.px4 is not None
    assert verdict.px4.failsafe is False
    assert verdict.max_tilt_deg is not None
    assert verdict.max_tilt_deg < 45.0
    assert verdict.final_error_m is not None
    assert verdict.final_error_m <= 0.25
    assert verdict.ekf_error_m is not None
    assert verdict.ekf_error_m < 0.2


def test_dual_collision_indoors_in_real_time(px4_dir: Path, tmp_path: Path) -> None:
    verdict = fly_px4(load_flyable(MISSIONS / "paper_dual_collision.yaml"), px4_dir, 1, tmp_path)
    accept(verdict)
    assert [c.wall for c in verdict.collisions] == ["wood", "acrylic"]
    for collision in verdict.collisions:
        assert collision.truth is not None
        assert collision.truth.peak_force_n is not None
        assert collision.measured.peak_force_n == pytest.approx(collision.truth.peak_force_n, rel=0.1)
    assert verdict.px4 is not None
    assert verdict.px4.ekf_resets == 0
    assert verdict.px4_log is not None
    assert Path(verdict.px4_log).stat().st_size > 100_000


def test_a_flight_planned_again_after_every_hit(px4_dir: Path, tmp_path: Path) -> None:
    # In real time: the planner has 0.1 s of PX4's time to answer.
    verdict = fly_px4(load_flyable(MISSIONS / "dual_collision_replan.yaml"), px4_dir, 1, tmp_path)
    accept(verdict)
    assert verdict.log is not None
    taken = [e.record for e in read_log(verdict.log).entries if isinstance(e.record, PlanTaken)]
    assert [(one.taken, one.reason) for one in taken] == [(True, ""), (True, "")]
    assert verdict.goal_miss_m is not None
    assert verdict.goal_miss_m < 0.1
    assert verdict.collisions[1].measured.normal_m_s == pytest.approx(
        verdict.collisions[1].planned.normal_m_s, abs=0.15
    )


def test_the_paper_s_second_impact_with_stiffer_gains(px4_dir: Path, tmp_path: Path) -> None:
    verdict = fly_px4(
        load_flyable(MISSIONS / "dual_collision_stiff.yaml"), px4_dir, 1, tmp_path, speed=FULL_SPEED
    )
    accept(verdict)
    assert verdict.collisions[1].measured.normal_m_s is not None
    assert verdict.collisions[1].measured.normal_m_s < -1.3


def test_single_wall_outdoors_with_rtk(px4_dir: Path, tmp_path: Path) -> None:
    mission = load_flyable(MISSIONS / "paper_single_wall.yaml")
    accept(fly_px4(mission, px4_dir, 1, tmp_path, position_from=PositionSource.RTK, speed=FULL_SPEED))


def test_plain_gps_does_not_fly_at_a_wall(px4_dir: Path, tmp_path: Path) -> None:
    mission = load_flyable(MISSIONS / "paper_single_wall.yaml")
    verdict = fly_px4(mission, px4_dir, 1, tmp_path, position_from=PositionSource.PLAIN, speed=FULL_SPEED)
    assert verdict.reason is not None
    assert verdict.reason.startswith("not_ready: standard deviation of the position")
    assert verdict.flight_time_s is None


def test_lock_servo_on_px4s_own_output(px4_dir: Path, tmp_path: Path) -> None:
    from dart_flight.config.vehicle import LockDriver
    from dart_flight.run.prepare import with_driver

    mission = with_driver(load_flyable(MISSIONS / "paper_dual_collision.yaml"), LockDriver.PX4)
    accept(fly_px4(mission, px4_dir, 1, tmp_path, speed=FULL_SPEED))


def test_a_hexarotor_with_the_lock_s_servo_after_its_motors(px4_dir: Path, tmp_path: Path) -> None:
    from dart_flight.config.vehicle import LockDriver
    from dart_flight.run.prepare import with_driver

    mission = load_flyable(MISSIONS / "paper_single_wall.yaml", packaged("configs", "hexarotor.yaml"))
    verdict = fly_px4(with_driver(mission, LockDriver.PX4), px4_dir, 1, tmp_path, speed=FULL_SPEED)
    accept(verdict)
    (hit,) = verdict.collisions
    assert hit.truth is not None
    assert hit.truth.normal_m_s == pytest.approx(-1.0, abs=0.1)
    assert hit.measured.peak_force_n == pytest.approx(hit.truth.peak_force_n, rel=0.1)
    assert verdict.px4_log is not None
    motors = read_airframe(Path(verdict.px4_log))
    assert rotor_differences(mission.vehicle.airframe.motors, motors) == ([], [])


def test_a_hit_beyond_full_scale_is_marked_as_clipped(px4_dir: Path, tmp_path: Path) -> None:
    text = SWEEP.read_text().replace("MODE", "rigid").replace("MATERIAL", "acrylic").replace("SPEED", "4.0")
    mission = tmp_path / "sweep.yaml"
    mission.write_text(text)
    # Met by one guard first it would turn over 60 degrees: here the sensor is the matter, not the body.
    loaded = load_flyable(mission, settings=["simulation.contact.body=point"])
    verdict = fly_px4(loaded, px4_dir, 1, tmp_path, speed=FULL_SPEED)
    assert verdict.outcome == "completed", verdict.reason
    (hit,) = verdict.collisions
    assert hit.clipped
    assert hit.truth is not None
    assert hit.truth.peak_force_n is not None
    assert hit.measured.peak_force_n is not None
    assert hit.truth.peak_force_n > 240.0
    assert hit.measured.peak_force_n < hit.truth.peak_force_n  # a lower bound
    assert verdict.px4 is not None
    assert (verdict.px4.clipped_samples or 0) >= 3  # PX4's own count
    assert verdict.log is not None
    records = [entry.record for entry in read_log(verdict.log).entries]
    assert any(isinstance(r, ForceEstimate) and r.clipped for r in records)
    assert [r.clipped for r in records if isinstance(r, ImpactPeak)] == [True]


@pytest.mark.parametrize("sticks", [True, False])
def test_a_switch_to_position_mode_in_the_approach(px4_dir: Path, tmp_path: Path, sticks: bool) -> None:
    """With sticks the pilot has it; without PX4 refuses, stays in offboard, and the flight goes on."""
    taken = tmp_path / "sticks.params"
    taken.write_text("# sticks over MAVLink\n1\t1\tCOM_RC_IN_MODE\t1\t6\n")
    begin, answers = Event(), list[int | None]()

    def ask(record: Record) -> None:
        if isinstance(record, PhaseChange) and record.after is Phase.OFFBOARD:
            found = re.search(r"PX4 instance (\d+)", next(tmp_path.glob("*/autopilot.log")).read_text())
            assert found is not None
            instance = int(found[1])
            station.append(Thread(target=lambda: answers.append(switch_to_position(instance, begin, sticks))))
            station[0].start()
        elif isinstance(record, PhaseChange) and record.after is Phase.APPROACH:
            begin.set()

    station: list[Thread] = []
    mission, files = load_flyable(MISSIONS / "single_wall.yaml"), (taken,) if sticks else ()
    verdict = fly_px4(mission, px4_dir, 1, tmp_path, ask, parameter_files=files)
    station[0].join()
    if sticks:
        assert answers == [MAV_RESULT_ACCEPTED]
        assert (verdict.outcome, verdict.reason) == ("released", "pilot: PX4 is in manual")
    else:
        assert answers == [MAV_RESULT_TEMPORARILY_REJECTED]
        accept(verdict)


# --- what dies -----------------------------------------------------------------------------------


class Flight:
    """A dry-run in a process of its own, and the pids that belong to it."""

    def __init__(self, px4_dir: Path, folder: Path) -> None:
        self.folder = folder
        self.killed_at: float | None = None
        mission = str(MISSIONS / "paper_dual_collision.yaml")
        command = [sys.executable, "-m", "dart_flight", "dry-run", mission, "--json"]
        command += ["--px4", str(px4_dir), "--speed", "2", "--log-dir", str(folder)]
        self.app = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.px4 = int(self.wait_for(r"PX4 instance \d+, process (\d+)"))
        self.world = _parent_of(self.px4)

    def text(self) -> str:
        """The world's log so far."""
        return "".join(path.read_text() for path in self.folder.glob("*/autopilot.log"))

    def wait_for(self, pattern: str, timeout_s: float = 40.0) -> str:
        """Wait for a line of the world's log; returns its first group."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            found = re.search(pattern, self.text())
            if found:
                return found[1] if found.groups() else found[0]
            time.sleep(0.05)
        raise AssertionError(f"no {pattern!r} within {timeout_s:g} s in: {self.text()}")

    def into_the_air(self) -> None:
        """Wait until it flies."""
        self.wait_for("PX4 armed")
        time.sleep(2.5)  # at twice real time: in the climb or beyond

    def verdict(self) -> dict[str, Any]:
        """The verdict that the app prints."""
        out, _ = self.app.communicate(timeout=40.0)
        result: dict[str, Any] = json.loads(out)
        return result

    def kill(self, pid: int) -> None:
        """SIGKILL to one of the three."""
        self.killed_at = time.monotonic()
        os.kill(pid, signal.SIGKILL)

    def wait_all_gone(self, timeout_s: float = 30.0) -> float:
        """Wait until none of the processes lives; returns seconds since the kill."""
        begun = self.killed_at or time.monotonic()
        while time.monotonic() - begun < timeout_s:
            self.app.poll()
            left = [pid for pid in (self.app.pid, self.world, self.px4) if _lives(pid)]
            if not left and not _session_members(self.px4):
                print(f"nothing left after {time.monotonic() - begun:.1f} s")  # `pytest -rP` shows it
                return time.monotonic() - begun
            time.sleep(0.05)
        raise AssertionError(f"still there after {timeout_s:g} s: {left} {_session_members(self.px4)}")


@pytest.fixture
def flight(px4_dir: Path, tmp_path: Path) -> Iterator[Flight]:
    one = Flight(px4_dir, tmp_path)
    yield one
    for pid in (one.app.pid, one.world, one.px4):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    one.app.communicate()


def _stat(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def _parent_of(pid: int) -> int:
    return int(_stat(pid)[1])


def _lives(pid: int) -> bool:
    try:
        return _stat(pid)[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def _session_members(session: int) -> list[int]:
    members = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError, IndexError):
                if int(_stat(int(entry.name))[3]) == session and _lives(int(entry.name)):
                    members.append(int(entry.name))
    return members


def _events(folder: Path) -> list[Any]:
    (log,) = folder.glob("*/flight.mcap")
    return [entry.record for entry in read_log(log).entries]


def test_killing_px4_in_flight_says_so(flight: Flight) -> None:
    flight.into_the_air()
    flight.kill(flight.px4)
    verdict = flight.verdict()
    assert verdict["outcome"] == "aborted"
    assert "PX4 was killed by SIGKILL" in verdict["reason"]
    assert flight.wait_all_gone() < 30.0
    ends = [r for r in _events(flight.folder) if isinstance(r, MissionEnd)]
    assert "PX4 was killed" in (ends[-1].reason or "")
    assert "Fatal" not in flight.text(), "the plant's process ends in good order, too"


def test_killing_the_plant_in_flight_says_so_and_takes_px4_along(flight: Flight) -> None:
    flight.into_the_air()
    flight.kill(flight.world)
    verdict = flight.verdict()
    assert verdict["outcome"] == "aborted"
    assert "the plant under PX4 was killed by SIGKILL" in verdict["reason"]
    assert flight.wait_all_gone() < 30.0
    assert any(isinstance(r, GuardEvent) for r in _events(flight.folder))


def test_killing_the_app_in_flight_px4_lands_by_its_failsafe(flight: Flight) -> None:
    flight.into_the_air()
    flight.kill(flight.app.pid)
    assert flight.wait_all_gone() < 30.0
    said = flight.text()
    assert "app disconnected; PX4 continues until its failsafe acts" in said
    height = re.search(r"PX4 disarmed at \(.*, .*, (.*)\)", said)
    assert height, said
    assert abs(float(height[1])) < 0.1
    console = "".join(path.read_text(errors="replace") for path in flight.folder.glob("*/px4.log"))
    assert "Failsafe" in console
    assert list(flight.folder.glob("*/px4.ulg"))


def test_killing_the_app_while_px4_boots_leaves_nothing(px4_dir: Path, tmp_path: Path) -> None:
    flight = Flight(px4_dir, tmp_path)
    flight.kill(flight.app.pid)
    assert flight.wait_all_gone() < 30.0
    flight.app.communicate()


def test_ctrl_c_leaves_the_air_and_lands(flight: Flight) -> None:
    flight.into_the_air()
    flight.app.send_signal(signal.SIGINT)
    verdict = flight.verdict()
    assert verdict["outcome"] == "aborted"
    assert "operator" in verdict["reason"]
    assert flight.app.returncode == 1
    assert "PX4 disarmed" in flight.text()
    assert flight.wait_all_gone() < 30.0
