"""Flights with a real PX4 in lockstep: completed missions, and the cleanup after a process dies."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
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
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.rotors import rotor_differences
from dart_flight.config.vehicle import LockDriver, packaged
from dart_flight.lab.calibrate.airframe_reader import read_airframe
from dart_flight.recording.reader import read_log
from dart_flight.recording.verdict import Verdict
from dart_flight.run.prepare import load_flyable, with_driver
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.pipe import FULL_SPEED
from tests.doubles.operator_station import OperatorStation
from tests.doubles.other_process import is_alive, stat_of
from tests.px4.real_px4 import MISSIONS, DryRun
from tests.real_time import assert_flown, wait_until

pytestmark = pytest.mark.px4

SWEEP = Path(__file__).with_name("sweep_mission.yaml")
_POSITION_MODE = (3,)  # PX4's own number


Fly = Callable[..., Verdict]


@pytest.fixture
def fly(px4_dir: Path, tmp_path: Path) -> Fly:
    """Fly a mission, by default at full speed: `fly("single_wall", speed=1.0)`."""

    def fly(mission: str | Mission, speed: float = FULL_SPEED, **options: Any) -> Verdict:
        if isinstance(mission, str):
            mission = load_flyable(MISSIONS / f"{mission}.yaml")
        return fly_px4(mission, px4_dir, 1, tmp_path, speed=speed, **options)

    return fly


def assert_requirements(verdict: Verdict) -> None:
    """Assert the requirements on a flight with motion capture or RTK."""
    assert verdict.outcome == "completed", verdict.reason
    assert verdict.px4 is not None
    assert verdict.px4.failsafe is False
    assert verdict.max_tilt_deg is not None
    assert verdict.max_tilt_deg < 45.0
    assert verdict.final_error_m is not None
    assert verdict.final_error_m <= 0.25
    assert verdict.ekf_error_m is not None
    assert verdict.ekf_error_m < 0.2


def test_the_dual_collision_completes_indoors_in_real_time(fly: Fly) -> None:
    verdict = fly("paper_dual_collision", speed=1.0)
    assert_requirements(verdict)
    assert [c.wall for c in verdict.collisions] == ["wood", "acrylic"]
    for collision in verdict.collisions:
        assert collision.truth is not None
        assert collision.truth.peak_force_n is not None
        assert collision.measured.peak_force_n == pytest.approx(collision.truth.peak_force_n, rel=0.1)
    assert verdict.px4 is not None
    assert verdict.px4.ekf_resets == 0
    assert verdict.px4_log is not None
    assert Path(verdict.px4_log).stat().st_size > 100_000


def test_a_flight_replanned_after_every_collision_reaches_its_goal(fly: Fly) -> None:
    verdict = fly("dual_collision_replan", speed=1.0)
    assert_requirements(verdict)
    assert verdict.log is not None
    taken = [e.record for e in read_log(verdict.log).entries if isinstance(e.record, PlanTaken)]
    assert [(one.taken, one.reason) for one in taken] == [(True, ""), (True, "")]
    assert verdict.goal_miss_m is not None
    assert verdict.goal_miss_m < 0.1
    # In 23 flights the second impact was 0.05 to 0.16 m/s slower than planned.
    assert verdict.collisions[1].measured.normal_m_s == pytest.approx(
        verdict.collisions[1].planned.normal_m_s, abs=0.2
    )


def test_stiffer_gains_reach_the_papers_second_impact_speed(fly: Fly) -> None:
    verdict = fly("dual_collision_stiff")
    assert_requirements(verdict)
    assert verdict.collisions[1].measured.normal_m_s is not None
    assert verdict.collisions[1].measured.normal_m_s < -1.3


def test_the_single_wall_completes_outdoors_with_rtk(fly: Fly) -> None:
    assert_requirements(fly("paper_single_wall", position_from=PositionSource.RTK))


def test_a_flight_with_plain_gps_does_not_take_off(fly: Fly) -> None:
    verdict = fly("paper_single_wall", position_from=PositionSource.PLAIN)
    assert verdict.reason is not None
    assert verdict.reason.startswith("not_ready: standard deviation of the position")
    assert verdict.flight_time_s is None


def test_the_lock_servo_works_on_px4s_own_output(fly: Fly) -> None:
    mission = with_driver(load_flyable(MISSIONS / "paper_dual_collision.yaml"), LockDriver.PX4)
    assert_requirements(fly(mission))


def test_a_hexarotor_completes_with_the_lock_servo_after_its_motors(fly: Fly) -> None:
    mission = load_flyable(MISSIONS / "paper_single_wall.yaml", packaged("configs", "hexarotor.yaml"))
    verdict = fly(with_driver(mission, LockDriver.PX4))
    assert_requirements(verdict)
    (hit,) = verdict.collisions
    assert hit.truth is not None
    assert hit.truth.normal_m_s == pytest.approx(-1.0, abs=0.1)
    assert hit.measured.peak_force_n == pytest.approx(hit.truth.peak_force_n, rel=0.1)
    assert verdict.px4_log is not None
    motors = read_airframe(Path(verdict.px4_log))
    assert rotor_differences(mission.vehicle.airframe.motors, motors) == ([], [])


def test_an_impact_beyond_full_scale_is_marked_as_clipped(fly: Fly, tmp_path: Path) -> None:
    text = SWEEP.read_text().replace("MODE", "rigid").replace("MATERIAL", "acrylic").replace("SPEED", "4.0")
    mission = tmp_path / "sweep.yaml"
    mission.write_text(text)
    # Contacts of the guards would tilt the body over 60 degrees; a point body isolates the saturation.
    verdict = fly(load_flyable(mission, settings=["simulation.contact.body=point"]))
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


@pytest.mark.realtime  # the pilot moves the sticks in the computer's time
@pytest.mark.parametrize("sticks", [True, False])
def test_a_switch_to_position_mode_releases_the_flight_only_with_sticks(
    fly: Fly, tmp_path: Path, sticks: bool
) -> None:
    """Without sticks PX4 refuses the mode and stays in offboard, and the flight continues."""
    stick_parameters = tmp_path / "sticks.params"
    stick_parameters.write_text("# sticks over MAVLink\n1\t1\tCOM_RC_IN_MODE\t1\t6\n")
    stations, answers = list[OperatorStation](), list[Future[int | None]]()

    def observe(record: Record) -> None:
        if isinstance(record, PhaseChange) and record.after is Phase.OFFBOARD:
            found = re.search(r"PX4 instance (\d+)", next(tmp_path.glob("*/autopilot.log")).read_text())
            assert found is not None
            number = int(found[1])
            station = OperatorStation.of_px4(number)
            station.sticks = sticks
            stations.append(held.enter_context(station))
        elif isinstance(record, PhaseChange) and record.after is Phase.APPROACH:
            answers.append(pool.submit(stations[0].set_mode, *_POSITION_MODE, wait_s=30.0))

    files = (stick_parameters,) if sticks else ()
    with ExitStack() as held, ThreadPoolExecutor(1) as pool:
        verdict = fly("single_wall", speed=1.0, progress=observe, parameter_files=files)
        assert_flown(verdict.outcome, verdict.reason, "released" if sticks else "completed")
        (answer,) = (found.result() for found in answers)
    assert answer == (MAV_RESULT_ACCEPTED if sticks else MAV_RESULT_TEMPORARILY_REJECTED)
    if sticks:
        assert verdict.reason == "pilot: PX4 is in manual"
    else:
        assert_requirements(verdict)


# --- process deaths ------------------------------------------------------------------------------


class Flight(DryRun):
    """A dry-run at twice real time, with the pids of app, plant and PX4."""

    def __init__(self, px4_dir: Path, folder: Path) -> None:
        super().__init__(px4_dir, folder, MISSIONS / "paper_dual_collision.yaml", "--speed", "2")
        self.killed_at: float | None = None
        self.px4 = int(self.wait_for(r"PX4 instance \d+, process (\d+)"))
        self.world = int(stat_of(self.px4)[1])

    def wait_until_airborne(self) -> None:
        """Wait until the vehicle flies."""
        self.wait_for("PX4 armed")
        time.sleep(2.5)  # at twice real time: in the climb or beyond

    def kill(self, pid: int) -> None:
        """Send SIGKILL to one of the three processes."""
        self.killed_at = time.monotonic()
        os.kill(pid, signal.SIGKILL)

    def wait_all_gone(self, timeout_s: float = 30.0) -> float:
        """Wait until none of the processes lives; return the seconds since the kill."""
        started_s = self.killed_at or time.monotonic()

        def are_gone() -> bool:
            self.process.poll()
            own = (self.process.pid, self.world, self.px4)
            return not any(map(is_alive, own)) and not _session_members(self.px4)

        wait_until(are_gone, timeout_s, "no process of the flight is left")
        print(f"nothing left after {time.monotonic() - started_s:.1f} s")  # `pytest -rP` shows it
        return time.monotonic() - started_s


@pytest.fixture
def flight(px4_dir: Path, tmp_path: Path) -> Iterator[Flight]:
    started = Flight(px4_dir, tmp_path)
    yield started
    for pid in (started.process.pid, started.world, started.px4):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    started.process.communicate()


def _session_members(session: int) -> list[int]:
    members = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError, IndexError):
                if int(stat_of(int(entry.name))[3]) == session and is_alive(int(entry.name)):
                    members.append(int(entry.name))
    return members


def _log_records(folder: Path) -> list[Any]:
    (log,) = folder.glob("*/flight.mcap")
    return [entry.record for entry in read_log(log).entries]


def test_killing_px4_in_flight_aborts_with_its_cause(flight: Flight) -> None:
    flight.wait_until_airborne()
    flight.kill(flight.px4)
    verdict, _ = flight.verdict()
    assert verdict["outcome"] == "aborted"
    assert "PX4 was killed by SIGKILL" in verdict["reason"]
    assert flight.wait_all_gone() < 30.0
    ends = [r for r in _log_records(flight.folder) if isinstance(r, MissionEnd)]
    assert "PX4 was killed" in (ends[-1].reason or "")
    assert "Fatal" not in flight.text(), "the plant's process must end cleanly"


def test_killing_the_plant_in_flight_aborts_and_ends_px4(flight: Flight) -> None:
    flight.wait_until_airborne()
    flight.kill(flight.world)
    verdict, _ = flight.verdict()
    assert verdict["outcome"] == "aborted"
    assert "the plant under PX4 was killed by SIGKILL" in verdict["reason"]
    assert flight.wait_all_gone() < 30.0
    assert any(isinstance(r, GuardEvent) for r in _log_records(flight.folder))


def test_px4_lands_by_its_failsafe_after_the_app_is_killed(flight: Flight) -> None:
    flight.wait_until_airborne()
    flight.kill(flight.process.pid)
    assert flight.wait_all_gone() < 30.0
    log_text = flight.text()
    assert "app disconnected; PX4 continues until its failsafe acts" in log_text
    height = re.search(r"PX4 disarmed at \(.*, .*, (.*)\)", log_text)
    assert height, log_text
    assert abs(float(height[1])) < 0.1
    console = "".join(path.read_text(errors="replace") for path in flight.folder.glob("*/px4.log"))
    assert "Failsafe" in console
    assert list(flight.folder.glob("*/px4.ulg"))


def test_killing_the_app_while_px4_boots_leaves_no_process(px4_dir: Path, tmp_path: Path) -> None:
    flight = Flight(px4_dir, tmp_path)
    flight.kill(flight.process.pid)
    assert flight.wait_all_gone() < 30.0
    flight.process.communicate()


def test_ctrl_c_lands_the_vehicle_and_ends_every_process(flight: Flight) -> None:
    flight.wait_until_airborne()
    flight.process.send_signal(signal.SIGINT)
    verdict, _ = flight.verdict()
    assert verdict["outcome"] == "aborted"
    assert "operator" in verdict["reason"]
    assert flight.process.returncode == 1
    assert "PX4 disarmed" in flight.text()
    assert flight.wait_all_gone() < 30.0
