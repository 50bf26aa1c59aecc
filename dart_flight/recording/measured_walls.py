"""The walls of a flight as measured by its contacts, for verdict, report and survey."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec

from dart_flight.base.geometry import Vec2, angle_between
from dart_flight.base.records import FrameAnchor, Record, TruthContact, WallEstimate
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls

_SAME_US = 60_000  # maximum time between a measured contact and its true contact


class MeasuredWall(msgspec.Struct):
    """A wall that was touched at least once, as estimated at its last contact; mission frame.

    Attributes:
        name: name in the mission.
        point_m: [x, y] of the wall's middle (`given_at: centre`), or of the contact if a probe found the
            wall.
        normal: [x, y], unit vector from the wall into free space.
        position_sd_m: standard deviation of the plane's position at `point_m`; null if assumed exact.
        yaw_sd_deg: standard deviation of the plane's direction; null if the direction is assumed exact.
        touched_m: [x, y] of the vehicle's centre at the first touch of the last contact.
        material: name in the table of materials; null if unknown.
        coefficients: estimates of k, f, mu and nu by mode, each with its relative standard deviation.
        age_s: time from the last contact to the flight's end.
        truth_error_m: error of the plane's measured position at the contact. The error is positive if the
            measured plane is on the free side of the true plane. Simulation only.
        truth_error_deg: error of the plane's measured direction (measured minus true). Simulation only.
    """

    name: str
    point_m: Vec2
    normal: Vec2
    position_sd_m: float | None
    yaw_sd_deg: float | None
    material: str | None
    touched_m: Vec2 | None = None
    coefficients: dict[str, dict[str, tuple[float, float]]] = msgspec.field(default_factory=dict)
    age_s: float = 0.0
    truth_error_m: float | None = None
    truth_error_deg: float | None = None


class WallMeasurements:
    """A collector of one flight's measured walls, from the flight's records in order."""

    def __init__(self, mission: Mission) -> None:
        self._walls = {c.wall.name: c.wall for c in mission.collisions}
        self._standing = {wall.name: wall for wall in mission.standing_walls}
        self._found = EstimatedWalls()
        self._estimates: dict[str, WallEstimate] = {}
        self._coefficients: dict[str, dict[str, dict[str, tuple[float, float]]]] = {}
        self._truths: list[TruthContact] = []

    def add(self, record: Record) -> None:
        if isinstance(record, WallEstimate) and record.wall in self._walls:
            self._found.add_estimate(record, self._walls[record.wall])
            self._estimates[record.wall] = record
            mode = record.mode_felt or record.mode_reported
            if mode is not None:
                self._coefficients.setdefault(record.wall, {})[mode.value] = {
                    "k": (record.k_n_per_m, record.k_sd),
                    "f": (record.f_ns_per_m, record.f_sd),
                    "mu": (record.mu_s_per_m, record.mu_sd),
                    "nu": (record.nu_n, record.nu_sd),
                }
        elif isinstance(record, FrameAnchor):
            self._found.move_frame(record.moved_mission)
        elif isinstance(record, TruthContact):
            self._truths.append(record)

    def wall(self, name: str) -> Wall | None:
        """Return a wall as estimated at its last contact, or None if the wall was not touched."""
        return self._found.known_wall(self._walls[name]) if self._found.is_measured(name) else None

    def build(self, end_us: int, drawn: Mapping[str, float | str]) -> list[MeasuredWall]:
        """Return the touched walls, in the order of their first contact.

        `drawn` contains random values of the simulated world, including the true wall offsets.
        """
        return [self._measured(name, end_us, drawn) for name in self._estimates]

    def _measured(self, name: str, end_us: int, drawn: Mapping[str, float | str]) -> MeasuredWall:
        wall, estimate = self._found.known_wall(self._walls[name]), self._estimates[name]
        yaw_sd_rad = wall.yaw_sd_rad
        found = MeasuredWall(
            name,
            wall.point,
            wall.normal,
            estimate.plane_offset_sigma_m if wall.position_sd_m is None else wall.position_sd_m,
            None if yaw_sd_rad is None else math.degrees(yaw_sd_rad),
            wall.material if wall.material_known else None,
            estimate.centre_mission,
            self._coefficients.get(name, {}),
            (end_us - estimate.first_us) * 1e-6,
        )
        true = self._true_wall(name, estimate, drawn)
        if true is not None:
            # Compare at the contact, because elsewhere the error of the direction adds to the result.
            point = estimate.plane_point_mission
            at = wall.foot(point) if point is not None else wall.point
            found.truth_error_m = true.signed_distance(at)
            found.truth_error_deg = math.degrees(angle_between(true.normal, wall.normal))
        return found

    def _true_wall(self, name: str, estimate: WallEstimate, drawn: Mapping[str, float | str]) -> Wall | None:
        near = [t for t in self._truths if abs(t.t_us - estimate.first_us) < _SAME_US]
        if not near or near[0].wall not in self._standing:
            return None
        wall = self._standing[near[0].wall]
        wall = wall.displaced(float(drawn.get(f"wall_offset_m.{wall.name}", 0.0)))
        return wall.rotated(math.radians(float(drawn.get(f"wall_yaw_deg.{wall.name}", 0.0))))
