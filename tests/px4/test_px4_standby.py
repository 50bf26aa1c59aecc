"""Standby on a real PX4, which forwards the commands of a ground station on another link."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dart_flight.config.vehicle import LockDriver
from dart_flight.run.operator_buttons import Button
from dart_flight.run.prepare import load_flyable, with_driver
from dart_flight.vehicle.command_server import Press, Result
from dart_flight.vehicle.ground_link import GroundLink
from tests.px4.real_px4 import station_of, waiting_px4
from tests.real_time import limited
from tests.run.test_standby_day import MISSION, ROOT
from tests.shared_flights import patient

pytestmark = [pytest.mark.px4, pytest.mark.realtime]

OK, NO = Result.ACCEPTED, Result.DENIED
PAUSE = MISSION.replace("waypoints: [", "waypoints: [{{pause: operator, timeout_s: 120.0}}, ")


@contextlib.contextmanager
def standing_by(folder: Path, url: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "dart_flight", "standby", *arguments, "--connection", url]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "DART_FLIGHT_STATE_DIR": str(folder / "state")}
    with open(folder / "standby.log", "a") as log:
        process = subprocess.Popen(command, cwd=folder, env=environment, stderr=log, stdout=log)
        try:
            yield process
        finally:
            process.terminate()
            with limited("the end of standby"):
                process.wait(90.0)


def test_every_button_is_answered_in_standby_and_in_flight(px4_dir: Path, tmp_path: Path) -> None:
    config = patient((ROOT / "configs" / "dart.yaml").read_text())
    (tmp_path / "dart.yaml").write_text(config)
    (tmp_path / "none.yaml").write_text(config.replace("driver: mock", "driver: none"))
    (tmp_path / "one.yaml").write_text(PAUSE.format(name="one", x=0.0))
    (tmp_path / "two.yaml").write_text(PAUSE.format(name="two", x=0.0).replace("dart.yaml", "none.yaml"))
    mission = with_driver(load_flyable(tmp_path / "one.yaml"), LockDriver.PX4)
    with (
        waiting_px4(px4_dir, tmp_path, {"COM_RC_IN_MODE": 1}, mission=mission) as url,
        station_of(url) as station,
    ):
        with standing_by(tmp_path, url, "one.yaml", "--driver", "px4"):
            station.wait_for_text("standby", timeout_s=120.0)
            station.wait_for_program()
            time.sleep(2.0)  # until standby has received PX4's heartbeat
            assert station.press(Button.FLY, 1) == NO
            station.wait_for_text("denied: PX4 receives no remote control")
            assert [station.press(b) for b in (Button.CONTINUE, Button.LAND)] == [NO, NO]
            assert station.press(Button.LOCK_RIGID) == OK
            station.wait_for_text("lock rigid: settled")
            assert station.press(Button.LOCK_FLEXIBLE) == OK
            station.wait_for_text("lock flexible: settled")
            assert station.press(Button.CHECK) == OK
            station.wait_for_text("one: no-go", timeout_s=120.0)
            station.wait_for_text("lock_driver: PWM_AUX_FUNC1 is not on this vehicle")  # SITL has no pins
        # A vehicle without a lock is go, and the sticks are present.
        with standing_by(tmp_path, url, "two.yaml") as process:
            station.wait_for_text("standby", 3, timeout_s=60.0)
            station.sticks = True
            station.wait_for_program()
            time.sleep(2.0)
            assert station.press(Button.LOCK_RIGID) == NO
            assert station.press(Button.CHECK) == OK
            station.wait_for_text("two: go", timeout_s=120.0)
            station.wait_for_text("standby", 4, timeout_s=60.0)
            time.sleep(2.0)
            assert [station.press(Button.FLY, 1) for _ in range(2)] == [OK, OK]
            station.wait_for_text("phase pause", timeout_s=180.0)
            in_flight = (Button.LOCK_RIGID, Button.LOCK_FLEXIBLE, Button.FLY, Button.CHECK, Button.CONTINUE)
            assert [station.press(b, 1) for b in in_flight] == [NO, NO, NO, OK, OK]
            station.wait_for_text("in flight: pause")
            station.wait_for_text("phase waypoint", timeout_s=60.0)
            assert station.press(Button.CONTINUE) == NO
            station.wait_for_text("two: completed", timeout_s=180.0)
            station.wait_for_text("standby", 5, timeout_s=60.0)
            assert process.poll() is None
            # The land button ends the next flight.
            time.sleep(2.0)
            assert [station.press(Button.FLY, 1) for _ in range(2)] == [OK, OK]
            station.wait_for_text("phase pause", 2, timeout_s=180.0)
            assert station.press(Button.LAND) == OK
            assert "landing requested" in station.wait_for_text("two: aborted", timeout_s=180.0)


@pytest.mark.parametrize("system", [2, 77])
def test_the_buttons_reach_a_program_on_a_vehicle_with_another_system_id(
    px4_dir: Path, tmp_path: Path, system: int
) -> None:
    presses: list[Press] = []

    def answer(press: Press) -> tuple[Result, str]:
        presses.append(press)
        return OK, "pressed"

    with (
        waiting_px4(px4_dir, tmp_path, {"MAV_SYS_ID": system}) as url,
        station_of(url) as station,
        GroundLink(url, 30.0) as link,
    ):
        assert link.system_id == system
        link.serve_operator(255, answer)
        station.wait_for_program()
        assert station.press(Button.CONTINUE, 4) == OK
    assert set(presses) == {Press(Button.CONTINUE, 4)}
