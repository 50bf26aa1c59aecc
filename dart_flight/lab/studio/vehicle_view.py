"""The flying vehicle in the room: pose, state of the arms, force, setpoint and path."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import Mode
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.studio.canvas import GREEN, RED, Canvas, Node, Palette, frame, polyline
from dart_flight.lab.studio.room_view import M_PER_N, cross, vehicle_nodes
from dart_flight.lab.studio.scene_model import Scene

_LEAST_N = 2.0  # smaller forces are noise
_ARMS: dict[str, Mode | None] = {"rigid": Mode.RIGID, "flexible": Mode.FLEXIBLE, "travelling": None}
_GROUP, _BODY, _FORCE, _SETPOINT = "player", "/player/vehicle", "/player/force", "/player/setpoint"


class VehicleView:
    """The vehicle of one flight."""

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas

    def draw(self, scene: Scene, palette: Palette, path: Array | None = None) -> None:
        """Draw the vehicle in each state of its arms, and its path (n, 3)."""
        unit_m = 0.012 * scene.size_m
        nodes = [] if path is None else [polyline("/player/path", path, palette.ink, 1.5)]
        force = {
            "points": np.zeros((1, 2, 3), dtype=np.float32),
            "colors": RED,
            "shaft_radius": 0.25 * unit_m,
            "head_radius": 0.8 * unit_m,
            "head_length": 2.0 * unit_m,
            "visible": False,
        }
        nodes += [
            frame(_BODY),
            frame(_SETPOINT, visible=False),
            cross(f"{_SETPOINT}/cross", (0.0, 0.0, 0.0), unit_m, GREEN),
            Node("arrows", _FORCE, force),
        ]
        for name, mode in _ARMS.items():
            nodes.append(frame(f"{_BODY}/{name}"))
            nodes += vehicle_nodes(f"{_BODY}/{name}", scene.airframe, mode, palette.ink, palette.grey)
        self._canvas.draw(_GROUP, nodes)

    def remove(self) -> None:
        self._canvas.draw(_GROUP, [])

    def place(
        self,
        position: Array,
        quaternion: Sequence[float] | Array,
        arms: str,
        force: Vec2,
        setpoint: Vec3 | None = None,
    ) -> None:
        """Show the vehicle at a pose, its arms in a state of the lock, the force on it, and its setpoint."""
        body = self._canvas.handle(_GROUP, _BODY)
        body.position, body.wxyz = tuple(position), tuple(quaternion)
        shown = arms if arms in _ARMS else "travelling"
        for name in _ARMS:
            self._canvas.handle(_GROUP, f"{_BODY}/{name}").visible = name == shown
        arrow = self._canvas.handle(_GROUP, _FORCE)
        arrow.visible = math.hypot(*force) > _LEAST_N
        if arrow.visible:
            tip = position + M_PER_N * np.array([*force, 0.0])
            arrow.points = np.array([[position, tip]], dtype=np.float32)
        target = self._canvas.handle(_GROUP, _SETPOINT)
        target.visible = setpoint is not None
        if setpoint is not None:
            target.position = setpoint
