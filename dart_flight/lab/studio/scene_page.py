"""A mission's room, or the playback of a flight, as one page that needs neither a server nor a network."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dart_flight.config.document import InputError, report_write_errors
from dart_flight.config.mission import Mission
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.lab.studio.canvas import LIGHT, Canvas, label
from dart_flight.lab.studio.page_server import LOCAL, open_server, stop_server
from dart_flight.lab.studio.playback import playback_of, value_at
from dart_flight.lab.studio.room_view import RoomView, VehicleView
from dart_flight.lab.studio.scene_model import Scene, scene_of_mission
from dart_flight.planning.predicted_flight import predict_mission
from dart_flight.recording.reader import Log

_CAPTION_S = 0.1  # interval between two captions


@contextlib.contextmanager
def mission_scene(mission: Mission) -> Iterator[Any]:
    """Yield viser's serializer of a mission's room with its predicted path."""
    try:
        planned = predict_mission(mission)
    except InputError:
        planned = None  # an approach that cannot be flown
    with _stage(scene_of_mission(mission, planned)) as (server, _):
        yield server.get_scene_serializer()


@contextlib.contextmanager
def flight_scene(log: Log) -> Iterator[Any]:
    """Yield the viser serializer that contains the playback of a flight at its real speed.

    Raises:
        InputError: the log contains no mission or no motion in the air.
    """
    flight = RecordedFlight(log)
    playback = playback_of(flight)
    if playback is None:
        raise InputError("the log contains no motion in the air", source=log.source)
    scene = scene_of_mission(flight.mission, flight.planned)
    with _stage(scene) as (server, canvas):
        vehicle = VehicleView(canvas)
        vehicle.draw(scene, LIGHT, playback.position)
        above = scene.bounds.y[1] + 0.05 * scene.size_m
        canvas.draw("caption", [label("/caption", "", (scene.bounds.x[0], above, 0.0))])
        caption, captioned_s = canvas.handle("caption", "/caption"), -1.0
        serializer, before_s = server.get_scene_serializer(), float(playback.time_s[0])
        for at in playback.time_s:
            at_s = float(at)
            serializer.insert_sleep(at_s - before_s)
            before_s, arms = at_s, value_at(playback.lock, at_s, "")
            position, quaternion = playback.frame(at_s)
            force, setpoint = playback.force_at(at_s), value_at(playback.setpoints, at_s, None)
            vehicle.place(position, quaternion, arms, force, setpoint)
            if at_s - captioned_s > _CAPTION_S:
                captioned_s = at_s
                caption.text = f"{at_s:.1f} s  {value_at(playback.phases, at_s, '')}  {arms}"
        yield serializer


@contextlib.contextmanager
def _stage(scene: Scene) -> Iterator[tuple[Any, Canvas]]:
    server = open_server(LOCAL, 0, "")
    try:
        canvas = Canvas(server)
        RoomView(server, canvas).show(scene, LIGHT, {})
        yield server, canvas
    finally:
        stop_server(server)


def write_scene(log: Log, path: Path) -> None:
    """Write the playback of a flight as an HTML page."""
    with flight_scene(log) as serializer, report_write_errors(path):
        path.write_text(serializer.as_html(), encoding="utf-8")


def show_flight(log: Log, height: int) -> None:
    """Show the playback of a flight in a notebook or the browser; `height` is in pixels."""
    with flight_scene(log) as serializer:
        serializer.show(height=height)


def show_mission(mission: Mission, height: int) -> None:
    """Show a mission's room in a notebook or the browser; `height` is in pixels."""
    with mission_scene(mission) as serializer:
        serializer.show(height=height)
