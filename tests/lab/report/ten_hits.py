"""A mission with many collisions in a small room, for the readability of pages and maps."""

from __future__ import annotations

from dart_flight.config.document import Document
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.config.vehicle import load_vehicle, packaged

_WALLS = {
    "north": ((0.0, 1.7), (0.0, -1.0), "acrylic"),
    "east": ((1.7, 0.0), (-1.0, 0.0), "wood"),
    "south": ((0.0, -1.7), (0.0, 1.0), "acrylic"),
    "west": ((-1.7, 0.0), (1.0, 0.0), "wood"),
}
_ALONG_M = (-0.9, 0.8, 0.2)


def many_hits(count: int) -> Mission:
    """Return a mission around a room of four walls, with rigid and flexible collisions."""
    walls = "\n".join(
        f"  {name}: {{point_m: {list(point)}, normal: {list(normal)}, length_m: 3.4, material: {material}}}"
        for name, (point, normal, material) in _WALLS.items()
    )
    hits = []
    for i in range(count):
        name = list(_WALLS)[i % 4]
        (px, py), (nx, ny), _ = _WALLS[name]
        along = _ALONG_M[i // 4 % 3]
        mode, normal = ("flexible", -0.9) if i % 3 else ("rigid", -0.7)
        hits.append(
            f"  - {{wall: {name}, mode: {mode}, "
            f"approach: {{normal_m_s: {normal}, tangential_m_s: {0.3 * (-1) ** i:.1f}}}, "
            f"impact_point_m: [{px + along * ny:.2f}, {py - along * nx:.2f}], alpha_m_per_n: [0.02, 0.02]}}"
        )
    text = f"""version: 1
name: {count} hits
start: {{position_m: [0.0, 0.0], altitude_m: 1.0}}
goal: {{position_m: [0.4, -0.3], hold_s: 0.5}}
bounds_m: {{x: [-1.9, 1.9], y: [-1.9, 1.9], z: [0.3, 2.0]}}
walls:
{walls}
collisions:
{chr(10).join(hits)}
"""
    return parse_mission(Document(text, "ten_hits.yaml"), load_vehicle(packaged("configs", "dart.yaml")))
