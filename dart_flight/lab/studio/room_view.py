"""The view of the room: draws a `Scene`, and reports what the mouse selects, moves and turns."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import viser

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import Mode
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import circle
from dart_flight.lab.studio.canvas import (
    BLUE,
    DARK,
    DARK_RED,
    GREEN,
    LIGHT,
    PALE,
    RED,
    Canvas,
    Node,
    Palette,
    Rgb,
    arrow,
    at_height,
    label,
    node_name,
    path_style,
    polyline,
    prism,
    segments,
    surface,
    turn_z,
)
from dart_flight.lab.studio.scene_model import Handle, HitShape, PlaceShape, Scene, VehicleShape, WallShape

_FOV_RAD = math.radians(1.0)  # viser has no parallel projection
_UPRIGHT, _FREE_SHARE = 0.65, 0.4  # aspect of a view whose lower part is covered; share that is free
_MARGIN = 1.3  # size of the view over that of the room
_MOST_LINES = 14  # of the grid along one axis
_KNOB_M = 0.3  # distance of the knob that turns a wall from its surface
_CHARACTER, _LINE = 0.0095, 0.025  # size of a label's letters as fractions of the room's size
_MOST_SHIFTS = 24
_LABEL_CHARACTERS, _LABEL_LINES = 40, 3  # of a finding beside its object
_SLOP_M, _SLOP_RAD = 5e-4, 1e-3  # smaller drags change nothing
_STEPS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


class _Drag(NamedTuple):
    """A drag in progress: the handle, whether it is turned, and the place where the mouse began."""

    handle: Handle
    turns: bool
    begin: Array


class RoomView:
    """The room in the page.

    Args:
        on_drag: called with the handle's id, the new position, and the new direction if it was turned.
        on_select: called with the id of the clicked object.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        canvas: Canvas,
        on_drag: Callable[[str, Vec2, float | None], None] | None,
        on_select: Callable[[str], None],
    ) -> None:
        self._server, self._canvas = server, canvas
        self._on_drag, self._on_select = on_drag, on_select
        self._handles: dict[str, Handle] = {}
        self._grips: dict[str, str] = {}  # name of a node -> its object
        self._drag: _Drag | None = None
        self._scene: Scene | None = None
        self.palette = LIGHT
        server.on_client_connect(self._aim)

    @property
    def is_dragging(self) -> bool:
        return self._drag is not None

    def use_dark(self, dark: bool) -> None:
        """Choose the colours of the next drawing."""
        self.palette = DARK if dark else LIGHT

    def show(
        self, scene: Scene, problems: Mapping[str, str], selected: str | None, *, editable: bool = True
    ) -> None:
        """Draw the scene.

        Args:
            problems: one line by the id of the object that it concerns.
            selected: id of the selected object.
            editable: whether handles are shown.
        """
        first, self._scene = self._scene is None, scene
        self._handles = {handle.id: handle for handle in scene.handles}
        painter = _Painter(scene, self.palette, problems, selected)
        editable = editable and self._on_drag is not None
        nodes = painter.nodes(corners=editable)
        self._grips = painter.grips
        if editable:
            nodes = [*map(self._interactive, nodes), *self._knobs(painter)]
        self._canvas.draw("room", nodes)
        if first:
            self.look_from_above()

    # --- camera ---------------------------------------------------------------------------------------------

    def look_from_above(self) -> None:
        """Aim every camera at the whole room from above, with the mission frame's x to the right."""
        if self._scene is None:
            return
        camera, (x, y, far) = self._server.initial_camera, self._aim_point(1.2)
        camera.fov, camera.near, camera.far = _FOV_RAD, 0.02 * far, 4.0 * far
        camera.position, camera.look_at = (x, y - 1e-4 * far, far), (x, y, 0.0)
        for client in self._server.get_clients().values():
            self._aim(client)

    def _aim(self, client: viser.ClientHandle) -> None:
        if self._scene is None:
            return
        camera = client.camera
        x, y, far = self._aim_point(camera.image_width / max(1, camera.image_height))
        with client.atomic():
            camera.fov, camera.near, camera.far = _FOV_RAD, 0.02 * far, 4.0 * far
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.position = (x, y - 1e-4 * far, far)
            camera.look_at = (x, y, 0.0)

    def _aim_point(self, aspect: float) -> Vec3:
        """Return the point to look at, and the height from which the room fills the view.

        On a phone (upright), the panel covers the lower part of the view.
        """
        assert self._scene is not None
        (x0, y0, _), (x1, y1, _) = self._scene.bounds
        share = _FREE_SHARE if aspect < _UPRIGHT else 1.0
        tall = _MARGIN * max((y1 - y0) / share, 0.95 * (x1 - x0) / max(aspect, 0.2))
        lowered = 0.5 * (1.0 - share) * tall
        return 0.5 * (x0 + x1), 0.5 * (y0 + y1) - lowered, 0.5 * tall / math.tan(0.5 * _FOV_RAD)

    # --- mouse ----------------------------------------------------------------------------------------------

    def _interactive(self, node: Node) -> Node:
        """Let a solid or a marker select its object, and drag it if it has a handle."""
        object_id = self._grips.get(node.name)
        if object_id is None:
            return node
        return node._replace(attach=lambda made: self._listen(made, object_id, turns=False))

    def _knobs(self, painter: _Painter) -> list[Node]:
        """Return the knobs that turn walls."""
        found: list[Node] = []
        for handle in self._handles.values():
            if handle.yaw_rad is None:
                continue
            x, y, _ = handle.position
            reach = max(_KNOB_M, 4.0 * painter.unit_m)
            place = (x - reach * math.cos(handle.yaw_rad), y - reach * math.sin(handle.yaw_rad), painter.top)
            root = node_name("room/object", handle.id)
            found.append(segments(f"{root}/stem", np.array([[(x, y, painter.top), place]]), BLUE, 1.5))
            found.append(
                Node(
                    "cylinder",
                    f"{root}/knob",
                    {
                        "radius": painter.unit_m,
                        "height": 0.02,
                        "color": BLUE,
                        "position": place,
                        "cast_shadow": False,
                    },
                    lambda made, name=handle.id: self._listen(made, name, turns=True),  # type: ignore[misc]
                )
            )
        return found

    def _listen(self, made: Any, object_id: str, *, turns: bool) -> None:
        @made.on_click  # type: ignore[untyped-decorator]
        def _(event: Any) -> None:
            self._on_select(object_id)

        # viser keeps the order of a drag's events only for coroutines.
        @made.on_drag("left")  # type: ignore[untyped-decorator]
        async def _(event: Any) -> None:
            self._follow(event, object_id, turns)

    def _follow(self, event: Any, object_id: str, turns: bool) -> None:
        eye = np.asarray(event.client.camera.position)
        if event.phase == "start":
            handle = self._handles.get(object_id)
            if handle is not None:
                self._drag = _Drag(handle, turns, np.asarray(event.start_position))
            return
        drag = self._drag
        if drag is None or drag.handle.id != object_id:
            return
        # The mouse moves in the horizontal plane of the place where it began.
        ray = np.asarray(event.end_position) - eye
        if abs(ray[2]) < 1e-6:
            return
        place = eye + ray * (drag.begin[2] - eye[2]) / ray[2]
        x, y, _ = drag.handle.position
        yaw: float | None = None
        if drag.turns:
            yaw = math.atan2(y - float(place[1]), x - float(place[0]))
        else:
            x, y = x + float(place[0] - drag.begin[0]), y + float(place[1] - drag.begin[1])
        self._pose(drag.handle, (x, y), yaw)
        if event.phase == "end":
            self._drag = None
            if self._on_drag is not None and _moved(drag.handle, (x, y), yaw):
                self._on_drag(object_id, (x, y), yaw)

    def _pose(self, handle: Handle, at: Vec2, yaw: float | None) -> None:
        """Move the drawn object to where the mouse has it."""
        frame = self._canvas.handle("room", node_name("room/object", handle.id))
        if frame is None:
            return
        (x, y, _), turned = handle.position, 0.0 if yaw is None else yaw - (handle.yaw_rad or 0.0)
        c, s = math.cos(turned), math.sin(turned)
        with self._server.atomic():
            frame.wxyz = turn_z(turned)
            frame.position = (at[0] - c * x + s * y, at[1] - s * x - c * y, 0.0)


def _moved(handle: Handle, at: Vec2, yaw: float | None) -> bool:
    turned = 0.0 if yaw is None else abs(math.remainder(yaw - (handle.yaw_rad or 0.0), 2.0 * math.pi))
    return math.dist(handle.position[:2], at) > _SLOP_M or turned > _SLOP_RAD


class _Painter:
    """The nodes of one drawing."""

    def __init__(
        self, scene: Scene, palette: Palette, problems: Mapping[str, str], selected: str | None
    ) -> None:
        self.scene, self.palette, self.selected = scene, palette, selected
        self.problems = {name: _wrapped(message) for name, message in problems.items()}
        (x0, y0, _), (x1, y1, z1) = scene.bounds
        self.size_m = max(x1 - x0, y1 - y0)
        self.unit_m = 0.012 * self.size_m  # radius of a handle
        self.top = max(
            [wall.height_m for wall in scene.walls] + [post.height_m for post in scene.posts] + [z1]
        )
        self.top += 0.02  # above everything that could hide a handle
        self.grips: dict[str, str] = {}  # name of a node -> the object that it selects
        self._labels: list[tuple[float, float, float, float]] = []  # low and high x, low and high y

    def nodes(self, *, corners: bool) -> list[Node]:
        """Return everything except the knobs; `corners` are shown to be dragged only."""
        shown, scene = [*self._ground()], self.scene
        ids = {wall.id for wall in scene.walls} | {post.id for post in scene.posts}
        ids |= {place.id for place in scene.places} | {handle.id for handle in scene.handles}
        roots = [node_name("room/object", object_id) for object_id in ids]
        shown += [Node("frame", root, {"show_axes": False}) for root in sorted(roots)]
        for i, wall in enumerate(scene.walls):
            shown += self._wall(wall, i)
        for post in scene.posts:
            root, outline = node_name("room/object", post.id), circle(post.centre, post.radius_m)[:-1]
            solid = prism(f"{root}/grip", outline, 0.0, post.height_m, self._solid(post.id))
            shown.append(self._grip(post.id, solid))
            shown += self._name(post.id, f"{_named(post.name, post.material)}", (*post.centre, self.top))
        for place in scene.places:
            shown += self._place(place)
        for handle in scene.handles:
            if handle.kind == "corner" and corners:
                box = {
                    "dimensions": (1.6 * self.unit_m,) * 2 + (0.02,),
                    "color": BLUE if handle.id == self.selected else self.palette.grey,
                    "position": (*handle.position[:2], 0.01),
                    "cast_shadow": False,
                }
                root = node_name("room/object", handle.id)
                shown.append(self._grip(handle.id, Node("box", f"{root}/grip", box)))
        for i, path in enumerate(scene.paths):
            if len(path.points) > 1:
                shown.append(polyline(f"/room/path/{i}", path.points, *path_style(path.kind, self.palette)))
        for hit in scene.hits:
            shown += self._hit(hit)
        return shown

    def _grip(self, object_id: str, node: Node) -> Node:
        self.grips[node.name] = object_id
        return node

    def _ground(self) -> list[Node]:
        (x0, y0, _), (x1, y1, _) = self.scene.bounds
        grey, grid = self.palette.grey, self.palette.grid
        step = next((s for s in _STEPS if self.size_m / s <= _MOST_LINES), _STEPS[-1])
        ticks = [
            np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1) * step
            for low, high in ((x0, x1), (y0, y1))
        ]
        lines = [[(x, y0, 0.0), (x, y1, 0.0)] for x in ticks[0]]
        lines += [[(x0, y, 0.0), (x1, y, 0.0)] for y in ticks[1]]
        frame = np.array([(x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0)])
        away, ends = 1.2 * self.unit_m, [f"{ticks[0][-1]:g}", f"{ticks[1][-1]:g}"]
        found = [
            segments("/room/grid", np.array(lines), grid, 1.0),
            polyline("/room/bounds", frame, grey, 1.5, closed=True),
        ]
        for axis, values in enumerate(ticks):
            for i, value in enumerate(values):
                text = f"{value:g}"
                if text == ends[axis]:
                    text += f" m {'xy'[axis]}"
                at = (float(value), y0 - away, 0.0) if axis == 0 else (x0 - away, float(value), 0.0)
                anchor = "top-center" if axis == 0 else "center-right"
                found.append(label(f"/room/tick/{axis}/{i}", text, at, 0.7, anchor))
        north = (math.cos(self.scene.north_rad), math.sin(self.scene.north_rad))
        x, y, reach = x1 - 5.0 * self.unit_m, y1 + 4.0 * self.unit_m, 3.0 * self.unit_m
        begin, end = ((x + k * reach * north[0], y + k * reach * north[1], 0.0) for k in (-1.0, 1.0))
        found.append(arrow("/room/north", begin, end, self.palette.ink, 2.0 * self.unit_m))
        beyond = (x + 1.6 * reach * north[0], y + 1.6 * reach * north[1], 0.0)
        found.append(label("/room/north_name", "N", beyond, 0.8, "center-center"))
        return found

    def _solid(self, object_id: str) -> Rgb:
        if object_id in self.problems:
            return (235, 130, 120) if self.palette is LIGHT else (170, 60, 55)
        if object_id == self.selected:
            return (150, 185, 235) if self.palette is LIGHT else (60, 100, 160)
        return self.palette.solid

    def _wall(self, wall: WallShape, i: int) -> list[Node]:
        root = node_name("room/object", wall.id)
        front = np.array(wall.surface)
        ink = self.palette.grey if wall.simulated else self.palette.ink
        solid = prism(
            f"{root}/grip{i}",
            wall.outline,
            0.0,
            wall.height_m,
            self._solid(wall.id),
            0.4 if wall.simulated else None,
        )
        found = [
            self._grip(wall.id, solid),
            polyline(f"{root}/front{i}", at_height(front, wall.height_m + 0.01), ink, 2.5),
            polyline(f"{root}/plane{i}", at_height(wall.plane, 0.01), self.palette.grey, 1.0),
        ]
        if wall.band is not None and len(wall.band) > 2:
            found.append(surface(f"{root}/band{i}", wall.band, self.top - 0.01, PALE, 0.35))
        c, s = math.cos(wall.yaw_rad), math.sin(wall.yaw_rad)
        behind = 0.12 + 2.0 * self.unit_m
        at = (wall.centre[0] - behind * c, wall.centre[1] - behind * s)
        # Beside the knob, along the wall.
        aside = 0.2 * math.dist(*wall.surface)
        at = (at[0] - aside * s, at[1] + aside * c)
        return found + self._name(wall.id, _named(wall.name, wall.material), (*at, self.top), str(i))

    def _name(self, object_id: str, text: str, at: Vec3, number: str = "") -> list[Node]:
        root, problem = node_name("room/object", object_id), self.problems.get(object_id)
        found = [label(f"{root}/name{number}", text if problem is None else f"✗ {text}", at)]
        if problem is not None and number in ("", "0"):
            lower = (at[0], at[1] - 2.5 * self.unit_m, at[2])
            found.append(label(f"{root}/problem{number}", problem, lower, 0.75, "top-center"))
        return found

    def _place(self, place: PlaceShape) -> list[Node]:
        root, (x, y, z) = node_name("room/object", place.id), place.at
        colours = {"start": self.palette.grey, "goal": GREEN, "visit": PALE}
        colour = colours.get(place.kind, self.palette.ink)
        if place.id in self.problems:
            colour = DARK_RED
        elif place.id == self.selected:
            colour = BLUE
        disc = {
            "radius": 1.1 * self.unit_m,
            "height": 0.02,
            "color": colour,
            "position": (x, y, z),
            "cast_shadow": False,
            "radial_segments": 4 if place.kind == "waypoint" else 32,
        }
        found = [
            self._grip(place.id, Node("cylinder", f"{root}/grip", disc)),
            segments(f"{root}/stem", np.array([[(x, y, 0.0), (x, y, z)]]), self.palette.grey, 1.0),
        ]
        if place.radius_m > 0.0:
            ring = circle(place.at, place.radius_m)
            found.append(polyline(f"{root}/radius", ring, colour, 1.5))
        problem = self.problems.get(place.id)
        text = place.label if problem is None else f"✗ {place.label}: {problem}"
        at = (x + 1.3 * self.unit_m, y + 1.3 * self.unit_m, z)
        return [*found, label(f"{root}/name", text, self._free(text, at), anchor="bottom-left")]

    def _hit(self, hit: HitShape) -> list[Node]:
        root, (x, y, z) = f"/room/hit/{hit.number}", hit.at
        colour = DARK_RED if hit.id in self.problems else self.palette.ink
        found = vehicle_nodes(root, self.scene.vehicle, hit.mode, colour, self.palette.grey)
        found.insert(
            0,
            Node(
                "frame",
                root,
                {"show_axes": False, "position": hit.at, "wxyz": turn_z(hit.vehicle_yaw_rad)},
            ),
        )
        dot = {"radius": 0.6 * self.unit_m, "color": RED, "position": hit.at, "cast_shadow": False}
        found.append(self._grip(hit.id, Node("icosphere", f"{root}_dot", dot)))
        if hit.arrow is not None:
            found.append(arrow(f"{root}_speed", *hit.arrow, self.palette.ink, 2.2 * self.unit_m))
        if hit.force is not None:
            found.append(arrow(f"{root}_force", *hit.force, RED, 2.2 * self.unit_m))
        if hit.setpoint is not None:
            found.append(polyline(f"{root}_recovery", np.array([hit.at, hit.setpoint]), GREEN, 1.5))
            found.append(cross(f"{root}_setpoint", hit.setpoint, self.unit_m, GREEN))
        text = hit.label if hit.id not in self.problems else f"{hit.label}\n✗ {self.problems[hit.id]}"
        at = self._free(text, (x + 0.5 * self.unit_m, y + 1.5 * self.unit_m, z))
        return [*found, label(f"{root}_label", text, at, 0.75, "bottom-left")]

    def _free(self, text: str, at: Vec3) -> Vec3:
        """Return the place nearest to `at`, above or below, where a label covers no other label."""
        lines = text.split("\n")
        wide = max(map(len, lines)) * _CHARACTER * self.size_m
        high = len(lines) * _LINE * self.size_m
        (x, y, z), step = at, 0.5 * _LINE * self.size_m
        for i in range(_MOST_SHIFTS):
            low = y + (1 if i % 2 else -1) * ((i + 1) // 2) * step
            covers = any(
                x < x1 and x + wide > x0 and low < y1 and low + high > y0 for x0, x1, y0, y1 in self._labels
            )
            if not covers:
                break
        self._labels.append((x, x + wide, low, low + high))
        return x, low, z


def _wrapped(message: str) -> str:
    """Return a finding as a short label; the panel has all of it."""
    lines = textwrap.wrap(message, _LABEL_CHARACTERS)
    return "\n".join(lines[:_LABEL_LINES]) + (" …" if len(lines) > _LABEL_LINES else "")


def _named(name: str, material: str) -> str:
    return name if name == material else f"{name} ({material})"


def cross(name: str, at: Vec3, size_m: float, colour: Rgb) -> Node:
    x, y, z = at
    pairs = [[(x - size_m, y + k * size_m, z), (x + size_m, y - k * size_m, z)] for k in (-1.0, 1.0)]
    return segments(name, np.array(pairs), colour, 2.0)


def vehicle_nodes(root: str, vehicle: VehicleShape, mode: Mode | None, ink: Rgb, grey: Rgb) -> list[Node]:
    """Return the vehicle in its own axes: guards, and arms that are thick if rigid and thin if flexible."""
    guards = [at_height(guard, 0.0) for guard in vehicle.guards]
    outline = np.vstack(
        [np.stack([guard[:-1], guard[1:]], axis=1) for guard in guards] or [np.empty((0, 2, 3))]
    )
    arms = np.array([at_height(arm, 0.0) for arm in vehicle.arms]).reshape(-1, 2, 3)
    tip, back, wide = 0.95 * vehicle.reach_m, 0.75 * vehicle.reach_m, 0.12 * vehicle.reach_m
    nose = at_height([(back, wide), (tip, 0.0), (back, -wide)], 0.0)
    colour = grey if mode is None else ink
    return [
        segments(f"{root}/guards", outline, ink, 1.5),
        segments(f"{root}/arms", arms, colour, 4.0 if mode is Mode.RIGID else 1.2),
        polyline(f"{root}/nose", nose, RED, 2.0),
    ]
