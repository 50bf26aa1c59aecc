"""Walls measured with the vehicle held by hand: geometry, uncertainty, refusals, and the command."""

from __future__ import annotations

import contextlib
import io
import math
from pathlib import Path

import numpy as np
import pytest

from dart_flight.base.geometry import MissionFrame, Quaternion, Vec2, Vec3
from dart_flight.check.held_walls import HeldPose, Pose, difference_from, mean_pose, wall_keys
from dart_flight.cli import main, room_command
from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import load_vehicle

ROOT = Path(__file__).parents[2]
FRAME = MissionFrame(0.4, -0.2, 0.0, math.radians(30.0))
AIRFRAME = load_vehicle().airframe


def attitude(yaw: float, tilt: float = 0.0) -> Quaternion:
    """Return an attitude with a heading, clockwise from north, and a roll."""
    c, s = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    ct, st = math.cos(0.5 * tilt), math.sin(0.5 * tilt)
    return (c * ct, c * st, s * st, s * ct)


def held_at(at: Vec2, yaw_rad: float, noise_m: float = 0.001, tilt: float = 0.0) -> list[Pose | None]:
    """Return poses of a vehicle at a place of the mission frame."""
    rng = np.random.default_rng(1)
    x, y, z = FRAME.point_to_ned((*at, 0.5))
    q = attitude(FRAME.yaw_to_ned(yaw_rad), tilt)

    def near() -> Vec3:
        dx, dy = rng.normal(0.0, noise_m, 2).tolist()
        return (x + dx, y + dy, z)

    return [(near(), q) for _ in range(100)]


def test_a_wall_has_its_place_direction_length_and_uncertainty() -> None:
    """A wall at x = 1.65 that faces the start; who looks along x has y on the left."""
    left = mean_pose(held_at((1.65, 1.5), 0.0), FRAME)
    right = mean_pose(held_at((1.65, -0.5), math.radians(90.0)), FRAME)  # held with another side
    keys = wall_keys(left, right, AIRFRAME, (0.0, 0.0))
    assert keys["point_m"] == pytest.approx([1.65, 0.5], abs=1e-3)
    assert keys["normal"] == pytest.approx([-1.0, 0.0], abs=1e-3)
    assert keys["length_m"] == pytest.approx(2.0 + 2.0 * AIRFRAME.guard_along_m, abs=2e-3)
    assert 0.005 < keys["position_sd_m"] < 0.01
    assert 0.3 < keys["yaw_sd_deg"] < 0.6
    wall = load_mission(ROOT / "missions/single_wall.yaml").flat_walls[0]
    assert difference_from(wall, {**keys, "point_m": [1.681, 0.5], "normal": [-0.9998, 0.0209]}) == (
        "3.1 cm and 1.2° from the file"
    )


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ([None] * 60 + held_at((0.0, 0.0), 0.0)[:40], "only 40 of 100 poses show the vehicle"),
        (held_at((0.0, 0.0), 0.0)[:5], "only 5 of 5 poses"),
        (held_at((0.0, 0.0), 0.0, tilt=math.radians(12.0)), "tilted by 12°, limit 6°"),
        (held_at((0.0, 0.0), 0.0)[:50] + held_at((0.06, 0.0), 0.0)[:50], "has moved by 3."),
        (held_at((0.0, 0.0), 0.0)[:50] + held_at((0.0, 0.0), 0.2)[:50], "has moved by"),
    ],
)
def test_a_vehicle_that_is_lost_moves_or_tilts_is_refused(poses: list[Pose | None], message: str) -> None:
    with pytest.raises(InputError, match=message):
        mean_pose(poses, FRAME)


@pytest.mark.parametrize(
    ("left", "right", "yaw_deg", "message"),
    [
        ((1.65, -0.5), (1.65, 1.5), 0.0, "were left and right exchanged"),
        ((1.65, 0.5), (1.65, 0.4), 0.0, "0.10 m apart"),
        ((1.65, 1.5), (1.65, -0.5), 30.0, "at 30° to the wall"),
    ],
)
def test_impossible_ends_are_refused(left: Vec2, right: Vec2, yaw_deg: float, message: str) -> None:
    ends = [HeldPose(at, math.radians(yaw_deg), 0.001) for at in (left, right)]
    with pytest.raises(InputError, match=message):
        wall_keys(ends[0], ends[1], AIRFRAME, (0.0, 0.0))


def test_the_command_writes_the_wall_and_keeps_comments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first measurement at the left end is tilted, and is repeated."""
    path = tmp_path / "mission.yaml"
    text = (ROOT / "missions/single_wall.yaml").read_text("utf-8")
    path.write_text(text.replace("vehicle: ../configs/dart.yaml\n", ""), "utf-8")
    monkeypatch.setattr("tests.check.test_held_walls.FRAME", MissionFrame())
    given = iter(
        [
            held_at((1.68, 1.5), 0.0, tilt=0.3),
            held_at((1.68, 1.5), 0.0),
            held_at((1.68, -0.5), 0.0),
        ]
    )

    monkeypatch.setattr(room_command, "mean_pose", lambda poses, frame: mean_pose(next(given), frame))
    monkeypatch.setattr(room_command, "_camera_poses", lambda url, mocap: contextlib.nullcontext(list))
    monkeypatch.setattr("sys.stdin", io.StringIO("\n\n\n"))
    assert main(["room", str(path), "--mocap", "udp://127.0.0.1:9/body"]) == 0
    said = capsys.readouterr().err
    assert "hold it level" in said
    assert "acrylic: 3.0 cm and 0.0° from the file" in said
    written = path.read_text("utf-8")
    assert "# One hit on acrylic in flexible mode" in written
    wall = Document(written, "").tree["walls"]["acrylic"]
    assert (wall["material"], wall["given_at"]) == ("acrylic", "centre")
    assert load_mission(path).flat_walls[0].point == pytest.approx((1.68, 0.5), abs=1e-3)
