"""The export of a flight to Foxglove's schemas, decoded as an independent viewer decodes it."""

from __future__ import annotations

import json
import math
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove.messages import SceneEntity, SceneUpdate
from mcap.reader import make_reader

from dart_flight.base.geometry import Quaternion, Vec3, rotate
from dart_flight.base.records import ForceEstimate, ImpactPeak, LockPhase, LockState, Record
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.flight_arrays import FlightArrays
from dart_flight.lab.map_model import room_map
from dart_flight.lab.scene import drawing
from dart_flight.lab.scene.downsampling import SCALARS_US, SCENE_US, Downsampler
from dart_flight.lab.scene.drawing import FORCE_SCALE_M_PER_N
from dart_flight.lab.scene.foxglove_export import export_foxglove
from dart_flight.planning.predicted_flight import predict_mission
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import Log, read_log
from tests.doubles.viewer import Decoder
from tests.shared_flights import SharedFlights

Messages = dict[str, list[tuple[int, dict[str, Any]]]]


@pytest.fixture(scope="module")
def log(flown: SharedFlights) -> Log:
    return read_log(flown("paper_dual_collision", 1).log)


@pytest.fixture(scope="module")
def exported(log: Log, tmp_path_factory: pytest.TempPathFactory) -> Messages:
    path = tmp_path_factory.mktemp("scene") / "flight.mcap"
    assert export_foxglove(log, path) > 1000
    return read_messages(path)


def read_messages(path: Path) -> Messages:
    """Return the messages of each topic, with their log times in microseconds."""
    messages: Messages = {}
    decoders: dict[int, Decoder] = {}
    with open(path, "rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.id not in decoders:
                decoders[channel.id] = Decoder(channel.message_encoding, schema.name, schema.data)
            values = decoders[channel.id](message.data)
            messages.setdefault(channel.topic, []).append((message.log_time // 1000, values))
    return messages


def vector(value: dict[str, float]) -> Vec3:
    return (value["x"], value["y"], value["z"])


def rotation(value: dict[str, float]) -> Quaternion:
    return (value["w"], value["x"], value["y"], value["z"])


def entities(messages: Messages, topic: str) -> list[dict[str, Any]]:
    return [entity for _, update in messages[topic] for entity in update["entities"]]


def test_the_published_motion_matches_the_log(log: Log, exported: Messages) -> None:
    arrays = FlightArrays(log, flown_mission(log.about, log.source))
    moves = exported["/tf"]
    assert len(moves) > 100
    for t_us, message in moves[::10]:
        [one] = message["transforms"]
        assert (one["parent_frame_id"], one["child_frame_id"]) == ("mission", "vehicle")
        at_s = arrays.time_of(t_us)
        motion = arrays.estimated
        expected = [float(np.interp(at_s, motion.time_s, motion.position[:, i])) for i in range(3)]
        if one["translation"]["z"] > 0.3:  # the frame is anchored by then
            assert vector(one["translation"]) == pytest.approx(expected, abs=1e-6)
    start = flown_mission(log.about, log.source).start
    assert vector(moves[0][1]["transforms"][0]["translation"]) == (*start, 0.0)  # before the first estimate
    ground, air = moves[1][1]["transforms"][0], max(m["transforms"][0]["translation"]["z"] for _, m in moves)
    assert abs(ground["translation"]["z"]) < 0.05
    assert air == pytest.approx(1.0, abs=0.2)


def test_the_published_attitude_is_upright_and_matches_the_tilt(log: Log, exported: Messages) -> None:
    for _, message in exported["/tf"]:
        up = rotate(rotation(message["transforms"][0]["rotation"]), (0.0, 0.0, 1.0))
        assert up[2] > 0.5
    states = exported["/flight/state"]
    leaning = [
        (rotate(rotation(m["transforms"][0]["rotation"]), (0.0, 0.0, 1.0)), s["tilt_deg"])
        for (_, m), (_, s) in zip(exported["/tf"][1:], states, strict=True)  # the first message is the start
    ]
    assert max(tilt for _, tilt in leaning) > 10.0
    for up, tilt in leaning:
        assert math.degrees(math.acos(min(1.0, up[2]))) == pytest.approx(tilt, abs=1e-3)


def test_the_message_rates_are_bounded(exported: Messages) -> None:
    for topic, period in (("/tf", SCENE_US), ("/flight/state", SCENE_US), ("/flight/force", SCALARS_US)):
        times = [t for t, _ in exported[topic]]
        assert 0.8 * (times[-1] - times[0]) / period < len(times) < (times[-1] - times[0]) / period + 2


def test_walls_are_drawn_at_their_surface(log: Log, exported: Messages) -> None:
    mission = flown_mission(log.about, log.source)
    reach = mission.vehicle.airframe.contact_distance_m
    room = {entity["id"]: entity for entity in entities(exported, "/scene/room")}
    for wall in mission.walls:
        [cube] = room[f"wall {wall.name}"]["cubes"]
        axis = rotate(rotation(cube["pose"]["orientation"]), (1.0, 0.0, 0.0))
        assert axis == pytest.approx((*wall.normal, 0.0), abs=1e-9)
        middle = vector(cube["pose"]["position"])
        face = wall.signed_distance(middle) + 0.5 * cube["size"]["x"]
        assert face == pytest.approx(-reach)
        assert cube["size"]["y"] == wall.length_m
        [label] = room[f"wall {wall.name}"]["texts"]
        assert wall.material in label["text"]
    [capture] = room["start and goal"]["cylinders"]
    assert capture["size"]["x"] == 2.0 * mission.goal.capture_radius_m


def decode_entity(entity: SceneEntity) -> dict[str, Any]:
    """Return an entity as a viewer receives it."""
    schema = SceneUpdate.get_schema()
    [one] = Decoder("protobuf", schema.name, schema.data)(SceneUpdate(entities=[entity]).encode())["entities"]
    found: dict[str, Any] = one
    return found


def test_the_plan_and_the_goal_have_the_altitude_of_the_waypoints() -> None:
    dual = load_mission(packaged("missions", "paper_dual_collision.yaml"))
    higher = dual.replace({"waypoints": [{"position_m": [0.0, 0.0], "altitude_m": 1.5}]})
    for mission, z in ((dual, 1.0), (higher, 1.5)):
        flight = predict_mission(mission)
        path = decode_entity(drawing.planned(flight, mission, 0))
        hits = path["spheres"][: len(flight.hits)]
        assert [ball["pose"]["position"]["z"] for ball in hits] == [z] * 2
        assert {line["points"][-1]["z"] for line in path["lines"]} == {z}
        marks = decode_entity(drawing.room(room_map(mission), 0)[-1])
        heights = {one["text"]: one["pose"]["position"]["z"] for one in marks["texts"]}
        assert heights["goal"] - heights["start"] == pytest.approx(z - 1.0)


def test_the_arms_are_coloured_by_the_state_of_the_lock(log: Log, exported: Messages) -> None:
    states = [e.record for e in log.entries if isinstance(e.record, LockState)]
    known = ["unknown"] + [
        s.mode.value if s.phase is LockPhase.SETTLED and s.mode else s.phase.value for s in states
    ]
    changes = [b for a, b in pairwise(["", *known]) if a != b]
    drawn = entities(exported, "/scene/vehicle")
    assert len(drawn) == len(changes)
    colours = {name: set() for name in changes}  # type: dict[str, set[tuple[float, ...]]]
    for name, entity in zip(changes, drawn, strict=True):
        arms = entity["cylinders"][4:]
        assert len(arms) == 4
        colours[name] |= {tuple(arm["color"].values()) for arm in arms}
    assert {"rigid", "flexible", "travelling"} <= colours.keys()
    assert all(len(colour) == 1 for colour in colours.values())
    assert len(set.union(*colours.values())) == len(colours)


def test_propellers_are_drawn_at_the_motors_of_the_airframe(log: Log, exported: Messages) -> None:
    airframe = flown_mission(log.about, log.source).vehicle.airframe
    body = entities(exported, "/scene/vehicle")[-1]
    assert body["frame_id"] == "vehicle"
    propellers = [vector(one["pose"]["position"])[:2] for one in body["cylinders"][:4]]
    assert propellers == [(m.x_m, -m.y_m) for m in airframe.motors]  # y points left in the viewer


def test_the_strongest_force_is_exported_with_its_direction_and_length(log: Log, exported: Messages) -> None:
    strongest = max(
        (e.record for e in log.entries if isinstance(e.record, ForceEstimate)),
        key=lambda f: sum(x * x for x in f.force_mission),
    )
    force = np.array(strongest.force_mission)
    drawn = max(state["force_n"] for _, state in exported["/flight/force"])
    assert drawn == pytest.approx(float(np.linalg.norm(force)))
    arrows = [a for e in entities(exported, "/scene/forces") for a in e["arrows"]]
    longest = max(arrows, key=lambda a: a["shaft_length"] if a["color"]["r"] > 0.8 else 0.0)
    length = longest["shaft_length"] + longest["head_length"]
    assert length == pytest.approx(FORCE_SCALE_M_PER_N * float(np.linalg.norm(force)))
    axis = rotate(rotation(longest["pose"]["orientation"]), (1.0, 0.0, 0.0))
    assert axis == pytest.approx(tuple(force / np.linalg.norm(force)), abs=1e-6)
    # The arrow is removed when the force ends.
    assert any(not e["arrows"] for e in entities(exported, "/scene/forces"))


def test_impacts_and_events_are_exported(log: Log, exported: Messages) -> None:
    peaks = [e.record for e in log.entries if isinstance(e.record, ImpactPeak)]
    marks = entities(exported, "/scene/hits")[-1]
    assert [t["text"] for t in marks["texts"]] == [
        f"{i}: {peak.normal_force_n:.0f} N" for i, peak in enumerate(peaks, 1)
    ]
    lines = [message for _, message in exported["/log"]]
    assert any(line["message"].startswith("→ APPROACH 1") for line in lines)
    assert {line["level"] for line in lines} <= {"DEBUG", "INFO", "WARNING", "ERROR"}
    assert lines[-1]["message"].startswith("completed") or "done" in lines[-1]["message"]


def test_a_guards_action_is_logged_as_an_error(flown: SharedFlights, tmp_path: Path) -> None:
    path = tmp_path / "fault.mcap"
    export_foxglove(read_log(flown("paper_single_wall", 1, "imu-dropout@approach").log), path)
    errors = [m["message"] for _, m in read_messages(path)["/log"] if m["level"] in ("ERROR", "FATAL")]
    assert any(line.startswith("guard: ") for line in errors)


def test_the_newest_message_of_every_scene_is_complete(exported: Messages) -> None:
    """A viewer that seeks or joins later receives only the newest message of each topic."""
    for topic, names in (
        ("/scene/room", {"bounds", "start and goal", "wall wood", "wall acrylic"}),
        ("/scene/vehicle", {"vehicle"}),
        ("/scene/path", {"flown"}),
    ):
        assert {entity["id"] for entity in exported[topic][-1][1]["entities"]} == names
    path = exported["/scene/path"][-1][1]["entities"][0]["lines"][0]["points"]
    assert len(path) > 50


def test_point_clouds_are_exported_for_viewers_without_scenes(exported: Messages) -> None:
    [room] = [m for _, m in exported["/points/room"]]
    assert room["frame_id"] == "mission"
    assert room["point_stride"] == 16
    assert {m["frame_id"] for _, m in exported["/points/vehicle"]} == {"vehicle"}


def test_a_peak_of_one_sample_survives_downsampling() -> None:
    downsampler = Downsampler()
    kept: list[Record] = []
    for i in range(200):
        force = 50.0 if i == 77 else 0.1
        kept += downsampler.select(ForceEstimate(4000 * i, (force, 0.0, 0.0), False))
    assert 38 <= len(kept) <= 40
    assert max(r.force_mission[0] for r in kept if isinstance(r, ForceEstimate)) == 50.0


def test_the_export_is_written_beside_the_log_or_to_the_given_folder(
    flown: SharedFlights, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = flown("paper_single_wall", 1).log
    copied = tmp_path / "one" / "flight.mcap"
    copied.parent.mkdir()
    copied.write_bytes(source.read_bytes())
    assert main(["export", str(copied), "--foxglove", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["files"] == [str(copied.with_name("foxglove.mcap"))]
    assert sum(map(len, read_messages(copied.with_name("foxglove.mcap")).values())) == summary["messages"]
    assert main(["export", str(copied), str(source), "--foxglove", "-o", str(tmp_path / "both")]) == 0
    assert len(list((tmp_path / "both").glob("*.mcap"))) == 2
    assert main(["export", str(copied.with_name("foxglove.mcap")), "--foxglove"]) == 2
    assert "not a flight log" in capsys.readouterr().err


def test_missing_foxglove_is_reported_with_the_command_to_install(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(InputError, match=r"make install"):
        export_foxglove(log, Path("never.mcap"))
