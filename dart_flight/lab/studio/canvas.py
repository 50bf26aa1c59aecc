"""Drawing for the view of the studio: named nodes of a viser scene, colours for light and dark, shapes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
import viser

from dart_flight.base.geometry import Vec3
from dart_flight.lab.figure_style import ESTIMATED, FORCE, GUARD, PREDICTED, REPLANNED, SET_POINT
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import MapKind, at_altitude

Rgb = tuple[int, int, int]


class Palette(NamedTuple):
    """The colours that differ between light and dark; the others are those of the report's figures."""

    ink: Rgb
    grey: Rgb
    grid: Rgb
    solid: Rgb


LIGHT = Palette((0, 0, 0), (102, 102, 102), (228, 228, 228), (205, 205, 205))
DARK = Palette((240, 240, 240), (150, 150, 150), (72, 72, 72), (110, 110, 110))


def rgb(colour: str) -> Rgb:
    """Convert #rrggbb."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


BLUE, ORANGE, PURPLE = rgb(ESTIMATED["color"]), rgb(PREDICTED["color"]), rgb(REPLANNED["color"])  # type: ignore[arg-type]
RED, GREEN, DARK_RED, PALE = rgb(FORCE), rgb(SET_POINT), rgb(GUARD), rgb("#8db4e2")


def path_style(kind: MapKind, palette: Palette) -> tuple[Rgb, float]:
    """Return colour and thickness in pixels of a path."""
    styles: dict[MapKind, tuple[Rgb, float]] = {
        MapKind.PREDICTED: (ORANGE, 3.0),
        MapKind.REPLANNED: (PURPLE, 2.5),
        MapKind.PROBE: (RED, 2.0),
        MapKind.RECOVERY: (GREEN, 1.5),
        MapKind.CAPTURE: (palette.ink, 1.0),
    }
    return styles.get(kind, (palette.grey, 1.2))


class Node(NamedTuple):
    """A node of the scene: `kind` is the name of viser's method without `add_`.

    Attributes:
        attach: called with viser's handle after the node has been made.
    """

    kind: str
    name: str
    props: dict[str, Any]
    attach: Callable[[Any], None] | None = None


class Canvas:
    """Groups of nodes, of which only the changed ones are sent to the pages."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._groups: dict[str, dict[str, tuple[Any, Any]]] = {}

    def draw(self, group: str, nodes: Sequence[Node]) -> None:
        """Make the nodes of a group exactly these; kept frames return to their place."""
        before, after = self._groups.get(group, {}), dict[str, tuple[Any, Any]]()
        with self._server.atomic():
            gone = before.keys() - {node.name for node in nodes}
            for name in sorted(gone, key=len, reverse=True):  # a parent would remove its children
                before[name][1].remove()
            for node in nodes:
                key = (node.kind, _key(node.props))
                known = before.get(node.name)
                if known is not None and known[0] == key:
                    after[node.name] = known
                    if node.kind == "frame":
                        known[1].position = node.props.get("position", (0.0, 0.0, 0.0))
                        known[1].wxyz = node.props.get("wxyz", (1.0, 0.0, 0.0, 0.0))
                    continue
                handle = getattr(self._server.scene, f"add_{node.kind}")(node.name, **node.props)
                if node.attach is not None:
                    node.attach(handle)
                after[node.name] = (key, handle)
        self._groups[group] = after

    def handle(self, group: str, name: str) -> Any:
        """Return viser's handle of a node, or None."""
        found = self._groups.get(group, {}).get(name)
        return None if found is None else found[1]


def _key(value: Any) -> Any:
    """Return something to compare the properties of nodes by."""
    if isinstance(value, dict):
        return tuple((name, _key(one)) for name, one in value.items())
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    return value


def node_name(root: str, *parts: str) -> str:
    """Return the name of a node; parts may contain any character."""
    return "/".join(("", root, *(quote(part, safe="") for part in parts)))


# --- shapes ------------------------------------------------------------------------------------------------


def polyline(name: str, points: Array, colour: Rgb, thickness: float, *, closed: bool = False) -> Node:
    """Return a line through points (n, 3), its thickness in pixels."""
    line = np.vstack([points, points[:1]]) if closed else points
    return segments(name, np.stack([line[:-1], line[1:]], axis=1), colour, thickness)


def segments(name: str, pairs: Array, colour: Rgb, thickness: float) -> Node:
    """Return lines between pairs of points (n, 2, 3)."""
    width = {"thickness": thickness, "thickness_units": "screen"}
    points = np.asarray(pairs, dtype=np.float32)
    return Node("line_segments", name, {"points": points, "colors": colour, **width})


def arrow(name: str, begin: Vec3, end: Vec3, colour: Rgb, size_m: float) -> Node:
    """Return an arrow; `size_m` is the length of its head."""
    head = min(size_m, 0.5 * max(math.dist(begin, end), 1e-3))
    props = {
        "points": np.array([[begin, end]], dtype=np.float32),
        "colors": colour,
        "shaft_radius": 0.12 * head,
        "head_radius": 0.35 * head,
        "head_length": head,
    }
    return Node("arrows", name, props)


def label(name: str, text: str, at: Vec3, scale: float = 0.85, anchor: str = "bottom-center") -> Node:
    return Node("label", name, {"text": text, "position": at, "font_screen_scale": scale, "anchor": anchor})


def disc(name: str, at: Vec3, radius_m: float, colour: Rgb, sides: int = 32) -> Node:
    """Return a flat marker."""
    size = {"radius": radius_m, "height": 0.02, "radial_segments": sides}
    return Node("cylinder", name, size | {"color": colour, "position": at, "cast_shadow": False})


def frame(name: str, **pose: Any) -> Node:
    """Return an invisible node that moves those below it."""
    return Node("frame", name, {"show_axes": False, **pose})


def surface(name: str, outline: Array, z: float, colour: Rgb, opacity: float | None = None) -> Node:
    """Return a flat convex area with corners (n, 2) at an altitude."""
    faces = [[0, i, i + 1] for i in range(1, len(outline) - 1)]
    return _mesh(name, at_altitude(outline, z), faces, colour, opacity)


def prism(name: str, outline: Array, height_m: float, colour: Rgb, opacity: float | None = None) -> Node:
    """Return a solid on the ground with a convex base of corners (n, 2)."""
    n = len(outline)
    vertices = np.vstack([at_altitude(outline, z) for z in (0.0, height_m)])
    faces = [[base, base + i, base + i + 1] for base in (0, n) for i in range(1, n - 1)]
    faces += [[i, (i + 1) % n, n + i] for i in range(n)]
    faces += [[(i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    return _mesh(name, vertices, faces, colour, opacity)


def _mesh(name: str, vertices: Array, faces: list[list[int]], colour: Rgb, opacity: float | None) -> Node:
    props = {
        "vertices": np.asarray(vertices, dtype=np.float32),
        "faces": np.array(faces, dtype=np.uint32),
        "color": colour,
        "opacity": opacity,
        "flat_shading": True,
        "side": "double",
        "cast_shadow": False,
        "receive_shadow": False,
    }
    return Node("mesh_simple", name, props)


def turn_z(yaw_rad: float) -> tuple[float, float, float, float]:
    """Return the quaternion of a turn about z."""
    return math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad)
