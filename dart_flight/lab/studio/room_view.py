"""The view of the room: draws a `Scene` and a flight, and reports what the mouse selects, moves and turns."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import viser

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import Mode
from dart_flight.config.vehicle import Airframe
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import arms_m, at_altitude, circle, named_material
from dart_flight.lab.mission_map import PlannedHit
from dart_flight.lab.studio.canvas import (
    BLUE,
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
    disc,
    frame,
    label,
    node_name,
    path_style,
    polyline,
    prism,
    segments,
    surface,
    turn_z,
)
from dart_flight.lab.studio.scene_model import Handle, PlaceShape, Scene, WallShape

M_PER_N = 0.003  # length of a force's arrow
_M_PER_M_S = 0.3  # length of a velocity's arrow
_FOV_RAD = math.radians(1.0)  # viser has no parallel projection
_UPRIGHT, _FREE_SHARE = 0.65, 0.4  # aspect of a view whose lower part is covered; share that is free
_BESIDE = 0.1  # width beside the room that labels may use, over the size of the room
_MARGIN = 1.3  # size of the view over that of the room
_MOST_LINES = 14  # of the grid along one axis
_KNOB_M = 0.3  # distance of the knob that turns a wall from its surface
_CHARACTER_PX, _LINE_PX = 5.8, 15.5  # size of a label's letters
_VIEW_PX = 1000  # height of the view that the labels of a page without a camera are placed for
_MOST_SHIFTS = 30
_LABEL_CHARACTERS, _LABEL_LINES = 40, 3  # of a finding beside its object
_RESIZED, _UNMOVED = 0.02, 1e-3  # relative changes of a view's aspect ratio, and of a camera's position
_SLOP_M, _SLOP_RAD = 5e-4, 1e-3  # smaller drags change nothing
_LEAST_N = 2.0  # smaller forces are noise
_ARMS: dict[str, Mode | None] = {"rigid": Mode.RIGID, "flexible": Mode.FLEXIBLE, "travelling": None}
_GROUP, _BODY, _FORCE, _SETPOINT = "player", "/player/vehicle", "/player/force", "/player/setpoint"
_STEPS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


class _Drag(NamedTuple):
    """A drag in progress: the handle, whether it is turned, and the place where the mouse began."""

    handle: Handle
    turns: bool
    begin: Array


class RoomView:
    """The room in the page.

    Args:
        on_drag: called with the handle's id, the new position, and the new direction if it was turned; None:
            nothing can be dragged.
        on_select: called with the id of the clicked object.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        canvas: Canvas,
        on_drag: Callable[[str, Vec2, float | None], None] | None = None,
        on_select: Callable[[str], None] = lambda object_id: None,
    ) -> None:
        self._server, self._canvas = server, canvas
        self._on_drag, self._on_select = on_drag, on_select
        self._handles: dict[str, Handle] = {}
        self._drag: _Drag | None = None
        self._scene: Scene | None = None
        self._aims: dict[int, tuple[float, Array]] = {}  # of each client: aspect and position of the camera
        server.scene.configure_default_lights(True, cast_shadow=False)
        server.on_client_connect(self._follow_size)

    @property
    def is_dragging(self) -> bool:
        return self._drag is not None

    def show(self, scene: Scene, palette: Palette, problems: Mapping[str, str], selected: str = "") -> None:
        """Draw the scene; `problems` has one line by the id of the object that it concerns."""
        first, self._scene = self._scene is None, scene
        self._handles = {handle.id: handle for handle in scene.handles} if self._on_drag else {}
        painter = _Painter(scene, palette, problems, selected, self._m_per_px(scene))
        nodes = painter.paint(corners=bool(self._handles))
        if self._on_drag is not None:
            nodes = [self._interactive(node, painter.grips.get(node.name)) for node in nodes]
            nodes += self._knobs(painter)
        self._canvas.draw("room", nodes)
        if first:
            self.look_from_above()

    # --- camera ---------------------------------------------------------------------------------------------

    def look_from_above(self) -> None:
        """Aim every camera at the whole room from above, with the mission frame's x to the right."""
        self._aim(self._server.initial_camera, 1.2)
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.up_direction = (0.0, 0.0, 1.0)
                self._aim_client(client)

    def _follow_size(self, client: viser.ClientHandle) -> None:
        """Show the whole room in a new page, whatever its size, until the user moves the camera."""
        self._aim_client(client)

        # The panel takes its part of the window after the camera's first message.
        def fit(camera: viser.CameraHandle) -> None:
            aspect, position = self._aims[client.client_id]
            moved_m = float(np.linalg.norm(np.asarray(camera.position) - position))
            resized = abs(_aspect(client) / aspect - 1.0) > _RESIZED
            if resized and moved_m < _UNMOVED * float(position[2]):
                self._aim_client(client)

        client.camera.on_update(fit)

    def _aim_client(self, client: viser.ClientHandle) -> None:
        aspect = _aspect(client)
        self._aim(client.camera, aspect)
        self._aims[client.client_id] = aspect, np.asarray(client.camera.position)

    def _aim(self, camera: Any, aspect: float) -> None:
        if self._scene is None:
            return
        tall, share = _height_of_view(self._scene, aspect)
        (x0, y0), (x1, y1) = self._scene.extent()
        x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1) - 0.5 * (1.0 - share) * tall
        far = 0.5 * tall / math.tan(0.5 * _FOV_RAD)
        camera.fov, camera.near, camera.far = _FOV_RAD, 0.02 * far, 4.0 * far
        camera.position, camera.look_at = (x, y - 1e-4 * far, far), (x, y, 0.0)

    def _m_per_px(self, scene: Scene) -> float:
        """Return the metres of a pixel, in the page where the room is smallest."""
        views = [(1.2, _VIEW_PX)]
        for client in self._server.get_clients().values():
            views.append((_aspect(client), max(1, client.camera.image_height)))
        return max(_height_of_view(scene, aspect)[0] / height for aspect, height in views)

    # --- mouse ----------------------------------------------------------------------------------------------

    def _interactive(self, node: Node, object_id: str | None) -> Node:
        """Let a solid or a marker select its object, and drag it if it has a handle."""
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
            knob = disc(f"{root}/knob", place, painter.unit_m, BLUE)
            found += [
                segments(f"{root}/stem", np.array([[(x, y, painter.top), place]]), BLUE, 1.5),
                knob._replace(attach=lambda made, name=handle.id: self._listen(made, name, turns=True)),  # type: ignore[misc]
            ]
        return found

    def _listen(self, made: Any, object_id: str, *, turns: bool) -> None:
        made.on_click(lambda event: self._on_select(object_id))

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
        root = self._canvas.handle("room", node_name("room/object", handle.id))
        if root is None:
            return
        (x, y, _), turned = handle.position, 0.0 if yaw is None else yaw - (handle.yaw_rad or 0.0)
        c, s = math.cos(turned), math.sin(turned)
        with self._server.atomic():
            root.wxyz = turn_z(turned)
            root.position = (at[0] - c * x + s * y, at[1] - s * x - c * y, 0.0)


def _aspect(client: viser.ClientHandle) -> float:
    return float(client.camera.image_width / max(1, client.camera.image_height))


def _height_of_view(scene: Scene, aspect: float) -> tuple[float, float]:
    """Return the height of the view that shows the whole room, m, and the share of it that is free.

    If the screen is upright, as on a phone, the panel covers the lower part of the view.
    """
    (x0, y0), (x1, y1) = scene.extent()
    share = _FREE_SHARE if aspect < _UPRIGHT else 1.0
    return _MARGIN * max((y1 - y0) / share, 0.95 * (x1 - x0) / max(aspect, 0.2)), share


def _moved(handle: Handle, at: Vec2, yaw: float | None) -> bool:
    turned = 0.0 if yaw is None else abs(math.remainder(yaw - (handle.yaw_rad or 0.0), 2.0 * math.pi))
    return math.dist(handle.position[:2], at) > _SLOP_M or turned > _SLOP_RAD


class _Painter:
    """One drawing.

    Attributes:
        unit_m: radius of a handle.
        top: altitude above everything that could hide a handle.
        grips: the object that a node selects, by the name of the node.
    """

    def __init__(
        self, scene: Scene, palette: Palette, problems: Mapping[str, str], selected: str, m_per_px: float
    ) -> None:
        self._scene, self._palette, self._selected = scene, palette, selected
        self._problems, self._m_per_px = problems, m_per_px
        self._height_m, self._right = scene.bounds.z[1], scene.extent()[1][0]
        self.unit_m, self.top = 0.012 * scene.size_m, self._height_m + 0.02
        self.grips: dict[str, str] = {}
        self._nodes: list[Node] = []
        self._labels: list[tuple[float, float, float, float]] = []  # low and high x, low and high y

    def paint(self, *, corners: bool) -> list[Node]:
        """Return all nodes except the knobs; `corners` are shown to be dragged only."""
        scene, add = self._scene, self._nodes.append
        self._ground()
        ids = {f"post/{post.name}" for post in scene.posts} | {wall.id for wall in scene.walls}
        ids |= {place.id for place in scene.places} | {handle.id for handle in scene.handles}
        self._nodes += [frame(node_name("room/object", object_id)) for object_id in sorted(ids)]
        for i, wall in enumerate(scene.walls):
            self._wall(wall, i)
        for post in scene.posts:
            name, outline = f"post/{post.name}", circle(post.centre, post.radius_m)[:-1]
            root = node_name("room/object", name)
            self._grip(name, prism(f"{root}/grip", outline, self._height_m, self._solid(name)))
            self._text(f"{root}/name", name, named_material(post), (*post.centre, self.top))
        for place in scene.places:
            self._place(place)
        for handle in scene.handles:
            if handle.id.startswith("corner") and corners:
                colour = BLUE if handle.id == self._selected else self._palette.grey
                at, root = (*handle.position[:2], 0.01), node_name("room/object", handle.id)
                self._grip(handle.id, disc(f"{root}/grip", at, 1.1 * self.unit_m, colour, 4))
        for i, path in enumerate(scene.paths):
            if len(path.points) > 1:
                add(polyline(f"/room/path/{i}", path.points, *path_style(path.kind, self._palette)))
        for hit in scene.hits:
            self._hit(hit)
        return self._nodes

    def _grip(self, object_id: str, node: Node) -> None:
        self.grips[node.name] = object_id
        self._nodes.append(node)

    def _ground(self) -> None:
        (x0, x1), (y0, y1) = self._scene.bounds.x, self._scene.bounds.y
        step = next((s for s in _STEPS if self._scene.size_m / s <= _MOST_LINES), _STEPS[-1])
        ticks = [
            np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1) * step
            for low, high in ((x0, x1), (y0, y1))
        ]
        lines = [[(x, y0, 0.0), (x, y1, 0.0)] for x in ticks[0]] + [
            [(x0, y, 0.0), (x1, y, 0.0)] for y in ticks[1]
        ]
        bounds = np.array([(x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0)])
        self._nodes += [
            segments("/room/grid", np.array(lines), self._palette.grid, 1.0),
            polyline("/room/bounds", bounds, self._palette.grey, 1.5, closed=True),
        ]
        away = 1.2 * self.unit_m
        for axis, values in enumerate(ticks):
            for i, value in enumerate(values):
                text = f"{value:g}" + (f" m {'xy'[axis]}" if i == len(values) - 1 else "")
                at = (float(value), y0 - away, 0.0) if axis == 0 else (x0 - away, float(value), 0.0)
                anchor = "top-center" if axis == 0 else "center-right"
                self._nodes.append(label(f"/room/tick/{axis}/{i}", text, at, 0.7, anchor))
        north, reach = (
            np.array([math.cos(self._scene.north_rad), math.sin(self._scene.north_rad)]),
            3.0 * self.unit_m,
        )
        middle = np.array([x1 - 5.0 * self.unit_m, y1 + 4.0 * self.unit_m])
        begin, end, beyond = ((*(middle + k * reach * north), 0.0) for k in (-1.0, 1.0, 1.6))
        self._nodes += [
            arrow("/room/north", begin, end, self._palette.ink, 2.0 * self.unit_m),
            label("/room/north_name", "N", beyond, 0.8, "center-center"),
        ]

    def _solid(self, object_id: str) -> Rgb:
        light = self._palette is LIGHT
        if object_id in self._problems:
            return (235, 130, 120) if light else (170, 60, 55)
        if object_id == self._selected:
            return (150, 185, 235) if light else (60, 100, 160)
        return self._palette.solid

    def _wall(self, wall: WallShape, i: int) -> None:
        root, drawn, palette = node_name("room/object", wall.id), wall.drawn, self._palette
        opacity, ink = (0.4, palette.grey) if wall.simulated else (None, palette.ink)
        solid = prism(f"{root}/grip{i}", drawn.outline, self._height_m, self._solid(wall.id), opacity)
        self._grip(wall.id, solid)
        front, plane = (
            at_altitude(drawn.surface.ends, self._height_m + 0.01),
            at_altitude(drawn.plane.ends, 0.01),
        )
        self._nodes += [
            polyline(f"{root}/front{i}", front, ink, 2.5),
            polyline(f"{root}/plane{i}", plane, palette.grey, 1.0),
        ]
        band = wall.band()
        if band is not None:
            self._nodes.append(surface(f"{root}/band{i}", band, self.top - 0.01, PALE, 0.35))
        # Behind the wall, beside the knob.
        point = drawn.surface.displaced(-0.12 - 2.0 * self.unit_m).point
        aside, tangent = -0.2 * drawn.plane.length_m, drawn.surface.tangent
        at = (point[0] + aside * tangent[0], point[1] + aside * tangent[1], self.top)
        self._text(f"{root}/name{i}", wall.id, drawn.name, at, 0.5 + 0.5 * drawn.plane.normal[0])

    def _place(self, place: PlaceShape) -> None:
        root, (x, y, _) = node_name("room/object", place.id), place.at
        kind = place.id.partition("/")[0]
        colours = {"start": self._palette.grey, "goal": GREEN, "visit": PALE}
        colour = BLUE if place.id == self._selected else colours.get(kind, self._palette.ink)
        colour = DARK_RED if place.id in self._problems else colour
        marker = disc(f"{root}/grip", place.at, 1.1 * self.unit_m, colour, 4 if kind == "waypoint" else 32)
        self._grip(place.id, marker)
        stem = np.array([[(x, y, 0.0), place.at]])
        self._nodes.append(segments(f"{root}/stem", stem, self._palette.grey, 1.0))
        if place.radius_m > 0.0:
            ring = circle(place.at, place.radius_m)
            self._nodes.append(polyline(f"{root}/radius", ring, colour, 1.5))
        self._text(f"{root}/name", place.id, place.label, self._beside(place.at))

    def _hit(self, hit: PlannedHit) -> None:
        object_id, root, at = f"hit/{hit.number - 1}", f"/room/hit/{hit.number}", hit.at
        ink = DARK_RED if object_id in self._problems else self._palette.ink
        self._nodes.append(frame(root, position=at, wxyz=turn_z(hit.yaw_rad)))
        self._nodes += vehicle_nodes(root, self._scene.airframe, hit.mode, ink, self._palette.grey)
        dot = {"radius": 0.6 * self.unit_m, "color": RED, "position": at, "cast_shadow": False}
        self._grip(object_id, Node("icosphere", f"{root}_dot", dot))
        head = 2.2 * self.unit_m
        if hit.velocity is not None:
            begin = _offset(at, hit.velocity, -_M_PER_M_S)
            self._nodes.append(arrow(f"{root}_speed", begin, at, self._palette.ink, head))
        if hit.force is not None:
            self._nodes.append(arrow(f"{root}_force", at, _offset(at, hit.force, M_PER_N), RED, head))
        if hit.setpoint is not None:
            setpoint = (*hit.setpoint, at[2])
            self._nodes += [
                polyline(f"{root}_recovery", np.array([at, setpoint]), GREEN, 1.5),
                cross(f"{root}_setpoint", setpoint, self.unit_m, GREEN),
            ]
        text = hit.text or f"{hit.number} {hit.mode.value}"
        if object_id != self._selected:
            text = re.sub(r" \(.*\)", "", text)  # the parts of the force
        self._text(f"{root}_label", object_id, text, self._beside(at))

    def _beside(self, at: Vec3) -> Vec3:
        return at[0] + 1.3 * self.unit_m, at[1] + 1.3 * self.unit_m, at[2]

    def _text(self, name: str, object_id: str, text: str, at: Vec3, left: float = 0.0) -> None:
        """Add a label with the problem of its object, where it covers no other label.

        Args:
            left: share of the label that is to the left of `at`.
        """
        problem = self._problems.get(object_id)
        if problem is not None:
            shown = textwrap.wrap(problem, _LABEL_CHARACTERS)
            rest = " …" if len(shown) > _LABEL_LINES else ""
            text = f"✗ {text}\n" + "\n".join(shown[:_LABEL_LINES]) + rest
        lines, (x, y, z) = text.split("\n"), at
        wide = max(map(len, lines)) * _CHARACTER_PX * self._m_per_px
        high = len(lines) * _LINE_PX * self._m_per_px
        x -= left * wide
        beyond = x + wide - self._right - _BESIDE * self._scene.size_m
        if beyond > 0.0:  # the name of a wall moves inside, other labels to the left of their object
            x -= beyond if object_id.startswith(("wall/", "simulated/")) else wide + 2.6 * self.unit_m
        step = 0.25 * _LINE_PX * self._m_per_px
        for i in range(_MOST_SHIFTS):
            low = y + (1 if i % 2 else -1) * ((i + 1) // 2) * step
            if not any(
                x < x1 and x + wide > x0 and low < y1 and low + high > y0 for x0, x1, y0, y1 in self._labels
            ):
                break
        self._labels.append((x, x + wide, low, low + high))
        self._nodes.append(label(name, text, (x, low, z), 0.8, "bottom-left"))


def _offset(at: Vec3, vector: Vec2, scale: float) -> Vec3:
    return (at[0] + scale * vector[0], at[1] + scale * vector[1], at[2])


def cross(name: str, at: Vec3, size_m: float, colour: Rgb) -> Node:
    x, y, z = at
    pairs = [[(x - size_m, y + k * size_m, z), (x + size_m, y - k * size_m, z)] for k in (-1.0, 1.0)]
    return segments(name, np.array(pairs), colour, 2.0)


def vehicle_nodes(root: str, airframe: Airframe, mode: Mode | None, ink: Rgb, grey: Rgb) -> list[Node]:
    """Return the vehicle in its own axes: guards, and arms that are thick if rigid and thin if flexible."""
    guards = [at_altitude([*guard, guard[0]], 0.0) for guard in airframe.guards_m]
    outline = [np.stack([guard[:-1], guard[1:]], axis=1) for guard in guards]
    arms = np.array([at_altitude(arm, 0.0) for arm in arms_m(airframe)]).reshape(-1, 2, 3)
    reach = airframe.contact_distance_m
    tip, side = (0.95 * reach, 0.0), 0.12 * reach
    nose = at_altitude([(0.75 * reach, side), tip, (0.75 * reach, -side)], 0.0)
    return [
        segments(f"{root}/guards", np.vstack(outline or [np.empty((0, 2, 3))]), ink, 1.5),
        segments(f"{root}/arms", arms, grey if mode is None else ink, 4.0 if mode is Mode.RIGID else 1.2),
        polyline(f"{root}/nose", nose, RED, 2.0),
    ]


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
