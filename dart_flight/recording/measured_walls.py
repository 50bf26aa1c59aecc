"""The walls of a flight as its contacts have measured them, for verdict, report and survey."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec

from dart_flight.base.geometry import Vec2, turn_between
from dart_flight.base.records import FrameAnchor, Record, TruthContact, WallEstimate
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls

_SAME_US = 60_000  # a contact and its truth lie this near in time


class MeasuredWall(msgspec.Struct):
    """A wall that was met at least once, as its last contact has it; mission frame.

    Attributes:
        name: as in the mission.
        point_m: [x, y] of its middle (`given_at: centre`); of one that was sought, where it was met.
        normal: [x, y], unit vector into free space.
        position_sd_m, yaw_sd_deg: of the plane at `point_m`, and of its direction; null: taken as known.
        touched_m: [x, y] of the vehicle's centre at the first touch of the last contact.
        material: of the table; null: of none that is known.
        coefficients: by mode, k, f, mu and nu as felt, each with its relative standard deviation.
        age_s: of the contact at the flight's end.
        truth_error_m: measured plane less the true one where it was met, along the normal; simulation only.
        truth_error_deg: likewise, direction.
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
    """Takes the records of one flight in order."""

    def __init__(self, mission: Mission) -> None:
        self._walls = {c.wall.name: c.wall for c in mission.collisions}
        self._standing = {wall.name: wall for wall in mission.standing_walls}
        self._found = EstimatedWalls()
        self._met: dict[str, WallEstimate] = {}
        self._coefficients: dict[str, dict[str, dict[str, tuple[float, float]]]] = {}
        self._truths: list[TruthContact] = []

    def take(self, record: Record) -> None:
        """The next record; most kinds do not matter here."""
        if isinstance(record, WallEstimate) and record.wall in self._walls:
            self._found.add_estimate(record, self._walls[record.wall])
            self._met[record.wall] = record
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
        """A wall as its last contact has it; None: it was not met."""
        return self._found.wall_now(self._walls[name]) if self._found.is_met(name) else None

    def build(self, end_us: int, drawn: Mapping[str, float | str]) -> list[MeasuredWall]:
        """The walls that were met, in the order of their first contact.

        Args:
            end_us: of the flight, autopilot time.
            drawn: of the simulated world: where walls really stand.
        """
        return [self._measured(name, end_us, drawn) for name in self._met]

    def _measured(self, name: str, end_us: int, drawn: Mapping[str, float | str]) -> MeasuredWall:
        wall, felt = self._found.wall_now(self._walls[name]), self._met[name]
        sure = wall.yaw_sd_rad
        found = MeasuredWall(
            name,
            wall.point,
            wall.normal,
            felt.plane_offset_sigma_m if wall.position_sd_m is None else wall.position_sd_m,
            None if sure is None else math.degrees(sure),
            wall.material if wall.material_known else None,
            felt.centre_mission,
            self._coefficients.get(name, {}),
            (end_us - felt.first_us) * 1e-6,
        )
        true = self._true_wall(name, felt, drawn)
        if true is not None:
            # Where it was met: elsewhere along it an error of the direction has its share.
            met = felt.plane_point_mission
            at = wall.foot(met) if met is not None else wall.point
            found.truth_error_m = true.signed_distance(at)
            found.truth_error_deg = math.degrees(turn_between(true.normal, wall.normal))
        return found

    def _true_wall(self, name: str, felt: WallEstimate, drawn: Mapping[str, float | str]) -> Wall | None:
        """The wall that was really met, by the simulation."""
        near = [t for t in self._truths if abs(t.t_us - felt.first_us) < _SAME_US]
        if not near or near[0].wall not in self._standing:
            return None
        wall = self._standing[near[0].wall]
        wall = wall.moved(float(drawn.get(f"wall_offset_m.{wall.name}", 0.0)))
        return wall.turned(math.radians(float(drawn.get(f"wall_yaw_deg.{wall.name}", 0.0))))
