"""`room` with an emulated motion capture, whose body is carried by hand from one wall end to the other."""

from __future__ import annotations

import math
import time
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.base.thread_context import ThreadContext
from dart_flight.cli import main
from dart_flight.config.mission import Mission, load_mission
from dart_flight.sim.motion_capture import BODY, make_server
from dart_flight.sim.pose_feed import PoseFeed
from tests.check.test_held_walls import attitude

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.rest, pytest.mark.realtime]
_FRAME_S = 0.01


class CarriedBody(ThreadContext):
    """An emulated motion capture that shows a body at `position` (NED) and `q`, or swinging beside it."""

    def __init__(self, kind: str, mission: Mission) -> None:
        self._server = make_server(kind, BODY)
        self._feed = PoseFeed(mission.vehicle.mocap, self._server.publish, (0.0, 0.0, 0.0))
        self.url = self._server.url
        self.position: Vec3 = (0.0, 0.0, -0.5)
        self.q: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self.swings_m = 0.0
        super().__init__()

    def _run(self) -> None:
        began_s = time.monotonic()
        while not self._stop.wait(_FRAME_S):
            now_s = time.monotonic() - began_s
            x, y, z = self.position
            moved = (x, y + self.swings_m * math.sin(6.0 * now_s), z)
            self._feed.tick(now_s, (now_s, moved, self.q))

    def _close(self) -> None:
        self._server.close()


class Operator:
    """Standard input: before each Enter, the operator carries the vehicle to the next place."""

    def __init__(self, body: CarriedBody, places: list[tuple[Vec3, float, float]]) -> None:
        self._body, self._places = body, iter(places)

    def readline(self) -> str:
        self._body.position, yaw, self._body.swings_m = next(self._places)
        self._body.q = attitude(yaw)
        time.sleep(0.5)
        return "\n"


@pytest.mark.parametrize("kind", ["optitrack", "udp"])
def test_a_wall_is_measured_with_the_cameras(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The wall is 3 cm farther than in the file; at the left end, the vehicle moves at first.

    North is the mission's x axis, west its y axis.
    """
    mission = load_mission(
        ROOT / "missions/single_wall.yaml",
        settings=["mocap.up=y", "mocap.heading_deg=40", "mocap.body_yaw_deg=15"],
    )
    config, path = tmp_path / "vehicle.yaml", tmp_path / "mission.yaml"
    config.write_bytes(msgspec.yaml.encode(mission.vehicle.to_dict()))
    path.write_text((ROOT / "missions/single_wall.yaml").read_text("utf-8"), "utf-8")
    places = [
        ((1.68, -1.5, -0.5), 0.0, 0.05),
        ((1.68, -1.5, -0.5), 0.0, 0.0),
        ((1.68, 0.5, -0.5), math.radians(90.0), 0.0),  # held with another side
    ]
    with CarriedBody(kind, mission) as body:
        monkeypatch.setattr("sys.stdin", Operator(body, places))
        assert main(["room", str(path), "--config", str(config), "--mocap", body.url]) == 0
    said = capsys.readouterr().err
    assert "hold it still; measure again" in said
    assert "acrylic: 3.0 cm and 0.0° from the file" in said
    wall = load_mission(path, str(config)).flat_walls[0]
    assert wall.point == pytest.approx((1.68, 0.5), abs=2e-3)
    assert wall.normal == pytest.approx((-1.0, 0.0), abs=2e-3)
