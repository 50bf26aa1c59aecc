"""`room` with a real PX4, whose vehicle is carried by hand from one end of a wall to the other."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.cli import main
from dart_flight.config.mission import load_mission
from dart_flight.run.prepare import with_simulated_mocap
from tests.check.test_held_walls import attitude
from tests.px4.carried_vehicle import carried, eased

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.px4, pytest.mark.realtime]
_CARRY_S = 4.0  # for the way from one place to the next
_SETTLE_S = 2.0


class CarriedAround:
    """A motion with a rest at each place, and a smooth way to the next; a place is (north, east, yaw)."""

    def __init__(self) -> None:
        self._from = self._to = (0.0, 0.0, 0.0)
        self._begun_s = float("inf")
        self.swings_m = 0.0

    def go(self, place: tuple[float, float, float], now_s: float) -> None:
        self._from, self._to, self._begun_s = self._to, place, now_s

    def __call__(self, time_s: float) -> tuple[Vec3, Quaternion]:
        t = max(0.0, time_s - self._begun_s)
        share = eased(t / _CARRY_S)
        north, east, yaw = (a + share * (b - a) for a, b in zip(self._from, self._to, strict=True))
        swing = self.swings_m * share * math.sin(6.0 * t)
        return (north, east + swing, 0.0), attitude(yaw)


class Operator:
    """Standard input: before each Enter, the operator carries the vehicle to the next place."""

    def __init__(self, places: list[tuple[tuple[float, float, float], float]]) -> None:
        self.motion = CarriedAround()
        self._places = iter(places)
        self.now_s: Callable[[], float] = lambda: 0.0

    def readline(self) -> str:
        place, self.motion.swings_m = next(self._places)
        self.motion.go(place, self.now_s())
        until_s = self.now_s() + _CARRY_S + _SETTLE_S
        while self.now_s() < until_s:
            time.sleep(0.05)
        return "\n"


def test_a_wall_is_measured_by_the_estimate_of_px4(
    px4_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The wall is 3 cm farther than in the file; at the left end, the vehicle swings at first."""
    source = ROOT / "missions/single_wall.yaml"
    path, config = tmp_path / "mission.yaml", tmp_path / "vehicle.yaml"
    path.write_text(source.read_text("utf-8"), "utf-8")
    mission = with_simulated_mocap(load_mission(source), "optitrack")
    assert mission.start[:2] == (0.0, 0.0)
    places = [
        ((1.68, -1.5, 0.0), 0.06),
        ((1.68, -1.5, 0.0), 0.0),
        ((1.68, 0.5, math.radians(90.0)), 0.0),  # held with another side
    ]
    operator = Operator(places)
    with carried(mission, px4_dir, tmp_path / "px4", operator.motion) as (vehicle, url):
        operator.now_s = lambda: vehicle.time_s
        room = msgspec.structs.replace(mission.vehicle.mocap, url=vehicle.mocap_url)
        vehicle_file = msgspec.structs.replace(mission.vehicle, mocap=room)
        config.write_bytes(msgspec.yaml.encode(vehicle_file.to_dict()))
        monkeypatch.setattr("sys.stdin", operator)
        assert main(["room", str(path), "--config", str(config), "--connection", url]) == 0
    assert "hold it still; measure again" in capsys.readouterr().err
    wall = load_mission(path, str(config)).flat_walls[0]
    assert wall.point == pytest.approx((1.68, 0.5), abs=0.02)
    assert wall.normal == pytest.approx((-1.0, 0.0), abs=0.02)
