"""Mission files (version 1) as written in YAML; the types define the keys. `docs/missions.md` explains them.

A key is one field of one class. The field has type, bounds and default. `Attributes:` has the meaning, and
the unit if the name has none. Keys that the flight uses as written are in `MissionKeys`,
`CollisionKeys` or `WaypointKeys`, which the file and the resolved mission share. Keys that must be resolved
are only in the file's class, such as `CollisionSpec`; `config.mission` resolves them (docs/extending.md).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import AfterImpact, Mode, ModeMismatch, Outcome
from dart_flight.config.section import Section

Coordinate = Annotated[float, Meta(ge=-10_000.0, le=10_000.0)]
Velocity = Annotated[float, Meta(ge=-20.0, le=20.0)]
Acceleration = Annotated[float, Meta(ge=-50.0, le=50.0)]
Jerk = Annotated[float, Meta(ge=-1000.0, le=1000.0)]
PieceSeconds = Annotated[float, Meta(gt=0.0, le=60.0)]
Direction = Annotated[float, Meta(ge=-1e6, le=1e6)]
# Metres of setpoint per newton. The paper's largest gain is 0.12; 1 sends the vehicle across a room.
Alpha = Annotated[float, Meta(ge=0.0, le=1.0)]
Point2 = tuple[Coordinate, Coordinate]
Range = tuple[Coordinate, Coordinate]
_MOST_BROKEN_OFF = 0.1  # in an acceptable plan, at most this fraction of the drawn flights fails
# In 20 drawn flights of a mission, the tilt reached 74 degrees; in the next 20, one vehicle tumbled.
_MOST_TILT_DEG = 60.0
Standoff = Annotated[float, Meta(ge=0.1, le=2.0)]
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]{0,63}$")]


class FrameSpec(Section, frozen=True):
    """Mission frame (x along the heading, y left, z up) relative to PX4's local NED.

    Attributes:
        origin: local: PX4's local origin, displaced by north_m and east_m (motion capture, surveyed room);
            takeoff: the origin that places the mission's start directly above the take-off point, displaced
            by north_m and east_m.
        anchored_by: none: PX4's position is used without correction; touch: the position drifts, and every
            contact with a wall of the mission corrects the frame along the wall's normal.
        north_m, east_m: displacement of the frame's origin, m.
        heading_deg: direction of the mission's x axis, clockwise from north.
    """

    origin: Literal["local", "takeoff"] = "local"
    anchored_by: Literal["none", "touch"] = "none"
    north_m: Coordinate = 0.0
    east_m: Coordinate = 0.0
    heading_deg: Annotated[float, Meta(ge=-360.0, le=360.0)] = 0.0


class StartSpec(Section, frozen=True):
    """Start of the mission, in the air.

    Attributes:
        position_m: [x, y], mission frame; in simulation the vehicle takes off below this position.
        altitude_m: altitude above the take-off point; kept until a waypoint changes it.
    """

    position_m: Point2
    altitude_m: Annotated[float, Meta(gt=0.0, le=100.0)]


class GoalSpec(Section, frozen=True):
    """End of the mission.

    Attributes:
        position_m: [x, y], mission frame.
        capture_radius_m: maximum distance at which the goal counts as reached.
        hold_s: time at the goal before the landing.
    """

    position_m: Point2
    capture_radius_m: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.15
    hold_s: Annotated[float, Meta(ge=0.0, le=600.0)] = 2.0


class BoundsSpec(Section, frozen=True):
    """The flight space, mission frame: [low, high] per axis.

    Attributes:
        x, y: limits of the vehicle's position, and of the point at which it would stop if it braked now, m.
        z: limits of the height above the take-off point, m; they do not apply to take-off and landing.
    """

    x: Range
    y: Range
    z: Range

    def excess2(self, p: Vec2 | Vec3) -> float:
        """Return the horizontal distance of a point from the bounds, metres; 0 inside."""
        (x_min, x_max), (y_min, y_max), x, y = self.x, self.y, p[0], p[1]
        if x_min <= x <= x_max and y_min <= y <= y_max:  # return early in the usual case, inside the bounds
            return 0.0
        return max(x_min - x, x - x_max, y_min - y, y - y_max, 0.0)


class WallSpec(Section, frozen=True):
    """A finite, upright wall.

    Attributes:
        point_m: [x, y] of the wall's middle, mission frame; given_at defines whether this point is on the
            wall itself. For a partition, the point belongs to the front.
        normal: [x, y], points into free space; any length. For a partition, it points out of the front.
        length_m: length along the wall, half of it to each side of the middle.
        material: a key of materials in the vehicle configuration.
        given_at: centre: point_m is the position of the vehicle's centre at first touch, as in the paper;
            surface: point_m is on the wall itself, and airframe.contact_distance_m is added; null: centre,
            but a partition must give this key.
        position_sd_m: standard deviation of the position along the normal; null: the position is known to a
            few centimetres, and the guard thresholds of the vehicle configuration cover this error.
        yaw_sd_deg: standard deviation of the wall's direction, as a rotation about the wall's middle; null:
            the guard thresholds of the vehicle configuration cover the error.
        thickness_m: thickness of a partition: the entry NAME then gives two walls, NAME.front and NAME.back,
            and the vehicle may hit both; null: a wall with one face.
    """

    point_m: Point2
    normal: tuple[Direction, Direction]
    length_m: Annotated[float, Meta(gt=0.0, le=1000.0)]
    material: str
    given_at: Literal["centre", "surface"] | None = None
    position_sd_m: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    yaw_sd_deg: Annotated[float, Meta(ge=0.0, le=30.0)] | None = None
    thickness_m: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None


class PostSpec(Section, frozen=True):
    """A free-standing upright cylinder: an obstacle, or a surface that the vehicle hits.

    Attributes:
        centre_m: [x, y] of the axis, mission frame.
        radius_m: radius of the surface.
        material: a key of materials in the vehicle configuration.
    """

    centre_m: Point2
    radius_m: Annotated[float, Meta(gt=0.0, le=10.0)]
    material: str


# Acceleration (m/s2) and jerk (m/s3) of each preset: PX4's default MPC_ACC_HOR and MPC_JERK_AUTO, its default
# MPC_ACC_HOR_MAX and MPC_JERK_MAX, and the limits used in replanning.
MOTIONS = {"automatic": (3.0, 4.0), "position": (5.0, 8.0), "replanning": (5.9, 25.0)}


class Limits(Section, frozen=True):
    """Limits of the mission, checked before and during the flight.

    The default of peak_force_n keeps the accelerometer below its full scale (204 N) on every surface that was
    hit in flights with a real PX4 (docs/px4.md). At the default speed limit, 3 m/s, a rigid impact on acrylic
    has a peak force of 191 N.

    Attributes:
        speed_m_s: maximum speed of an approach and of the flight.
        motion: preset of acceleration and jerk. automatic: 3 m/s2 and 4 m/s3, as in PX4's automatic modes;
            position: 5 and 8, as in PX4's position mode; replanning: 5.9 and 25, as in replanning after an
            impact. acceleration_m_s2 and jerk_m_s3 override the preset.
        acceleration_m_s2: largest acceleration of transits and run-ups. If this key is given, the speed of
            transits and run-ups may reach speed_m_s; otherwise flying.acceleration_m_s2 and
            flying.transit_speed_m_s apply.
        jerk_m_s3: largest jerk; if not given, flying.jerk_m_s3 applies.
        closing_m_s: largest velocity along a wall's normal at an impact.
        sliding_m_s: largest velocity along a wall at an impact.
        friction_ratio: largest ratio of friction to normal force at an impact. Above a ratio of about 0.5, a
            friction coefficient measured at low sliding speed is not valid.
        peak_force_n: largest contact force, normal and friction together.
        collision_timeout_s: timeout of a recovery. After the timeout the vehicle flies to the goal, or breaks
            off if the recovery leads to another wall.
    """

    speed_m_s: Annotated[float, Meta(gt=0.0, le=20.0)] = 3.0
    motion: Literal["automatic", "position", "replanning"] | None = None
    acceleration_m_s2: Annotated[float, Meta(gt=0.0, le=50.0)] | None = None
    jerk_m_s3: Annotated[float, Meta(gt=0.0, le=1000.0)] | None = None
    closing_m_s: Annotated[float, Meta(gt=0.0, le=20.0)] | None = None
    sliding_m_s: Annotated[float, Meta(gt=0.0, le=20.0)] | None = None
    friction_ratio: Annotated[float, Meta(gt=0.0, le=20.0)] | None = None
    peak_force_n: Annotated[float, Meta(gt=0.0, le=2000.0)] = 150.0
    collision_timeout_s: Annotated[float, Meta(gt=0.0, le=120.0)] = 8.0

    def __post_init__(self) -> None:
        if self.motion is None:
            return
        for key, value in zip(("acceleration_m_s2", "jerk_m_s3"), MOTIONS[self.motion], strict=True):
            if getattr(self, key) is None:
                msgspec.structs.force_setattr(self, key, value)


class SpaceKeys(Section, frozen=True, kw_only=True):
    """Keys that missions and scenarios share and that need no conversion.

    Attributes:
        transit_mode: state of the arms in take-off, transit and landing.
    """

    goal: GoalSpec
    frame: FrameSpec = FrameSpec()
    transit_mode: Mode = Mode.RIGID
    limits: Limits = Limits()


class ApproachSpec(Section, frozen=True):
    """Velocity at the impact in the wall's collision frame.

    Attributes:
        normal_m_s: velocity along the wall's normal; negative because it points towards the wall.
        tangential_m_s: velocity along the wall, positive to the right when looking along the normal.
    """

    normal_m_s: Annotated[float, Meta(lt=0.0, ge=-20.0, extra={"note": "; negative is towards the wall"})]
    tangential_m_s: Velocity = 0.0


class ProbeSpec(Section, frozen=True):
    """A straight leg from rest to rest that searches for a wall; a contact ends the leg, but is not required.

    Attributes:
        from_m: [x, y] of the leg's start, mission frame.
        from_here: true: the leg starts at the vehicle's resting position, which is assumed to be near from_m;
            false: the leg starts at from_m. Direction and length are the same in both cases. With true, the
            vehicle omits the transit to from_m, during which a drifting frame drifts farther.
        direction: [x, y], any length; may be omitted for a wall of the mission, which is then approached
            along its normal.
        length_m: length of the leg, for the vehicle's centre.
        speed_m_s: speed of the leg. The vehicle need not be able to stop before a wall, but an impact at this
            speed must stay within the limits.
        back_m: distance from the point of contact at which the vehicle waits afterwards.
        material: material of a wall that is not in walls; default: the contact identifies the material.
    """

    from_m: Point2
    length_m: Annotated[float, Meta(gt=0.0, le=1000.0)]
    from_here: bool = False
    direction: tuple[Direction, Direction] | None = None
    speed_m_s: Annotated[float, Meta(ge=0.1, le=5.0)] = 0.5
    back_m: Annotated[float, Meta(ge=0.1, le=5.0)] = 0.4
    material: str | None = None


class PlaceAtWall(Section, frozen=True):
    """A position relative to a wall, known once the vehicle has touched the wall.

    Attributes:
        wall: name of the wall; an earlier probe may search for this wall.
        away_m: distance of the vehicle's centre from the plane on which the centre lies at first touch.
        along_m: distance from the wall's middle, or from the point of contact if a probe has found the wall;
            positive to the right when looking along the normal.
    """

    wall: str
    away_m: Annotated[float, Meta(ge=0.1, le=1000.0)]
    along_m: Coordinate = 0.0


class CollisionPrediction(Section, frozen=True):
    """The planner's prediction for a collision; flight and report compare it with the measured impact.

    Attributes:
        t_s: time from the start of the run-up to the onset of the contact.
        position_m: [x, y] of the impact, mission frame.
        normal_m_s, tangential_m_s: velocity at the impact, collision frame.
        peak_force_n: largest normal force.
        contact_time_s: duration of the contact.
    """

    t_s: Annotated[float, Meta(ge=0.0, le=3600.0)]
    position_m: Point2
    normal_m_s: Velocity
    tangential_m_s: Velocity
    peak_force_n: Annotated[float, Meta(ge=0.0, le=10_000.0)]
    contact_time_s: Annotated[float, Meta(ge=0.0, le=10.0)]


class MissPrediction(Section, frozen=True):
    """The planner's prediction for the whole mission.

    Attributes:
        goal_miss_m: smallest distance to the goal after the last contact.
    """

    goal_miss_m: Annotated[float, Meta(ge=0.0, le=10_000.0)]


class MotionState(NamedTuple):
    """Position, velocity and acceleration on a trajectory at one time, mission frame: m, m/s, m/s2."""

    t_s: float
    position: Vec2
    velocity: Vec2
    acceleration: Vec2


class TrajectoryPieces(Section, frozen=True):
    """A trajectory at constant altitude, mission frame; written by `plan`.

    Attributes:
        position_m, velocity_m_s, acceleration_m_s2: [x, y] at the beginning.
        pieces: consecutive pieces, [duration in s, jerk in x, jerk in y in m/s3].
    """

    position_m: Point2
    pieces: Annotated[list[tuple[PieceSeconds, Jerk, Jerk]], Meta(min_length=1, max_length=400)]
    velocity_m_s: tuple[Velocity, Velocity] = (0.0, 0.0)
    acceleration_m_s2: tuple[Acceleration, Acceleration] = (0.0, 0.0)

    @property
    def duration_s(self) -> float:
        return sum(piece[0] for piece in self.pieces)

    def states(self) -> list[MotionState]:
        """Return the motion at the beginning of each piece and at the end."""
        found = [MotionState(0.0, self.position_m, self.velocity_m_s, self.acceleration_m_s2)]
        for t, jx, jy in self.pieces:
            begin, (x, y), (vx, vy), (ax, ay) = found[-1]
            found.append(
                MotionState(
                    begin + t,
                    (_advance_position(x, vx, ax, jx, t), _advance_position(y, vy, ay, jy, t)),
                    (vx + t * (ax + 0.5 * t * jx), vy + t * (ay + 0.5 * t * jy)),
                    (ax + t * jx, ay + t * jy),
                )
            )
        return found


def _advance_position(p: float, v: float, a: float, j: float, t: float) -> float:
    """Return the position after a time at constant jerk."""
    return p + t * (v + t * (a / 2.0 + t * j / 6.0))


class CollisionKeys(Section, frozen=True, kw_only=True):
    """Keys of a collision that the flight uses as written.

    Attributes:
        mode: state of the arms at the impact. If the vehicle has no lock, its arms are rigid and the key is
            optional.
        predicted: the planner's prediction; `plan` writes this key.
        trajectory: trajectory to this wall. If the collision has an approach, the trajectory starts at rest.
            Without an approach, the trajectory starts at the predicted end of the previous collision. If
            after_impact is replan, a trajectory from the previous collision's actual end replaces this
            trajectory in flight. Without a trajectory the approach is straight, with a run-up.
        if_met: a wall that an earlier probe searches for; the collision is flown only if that wall was
            touched.
        if_not_met: a wall that an earlier probe searches for; the collision is flown only if that wall was
            not touched.
        peak_limit_n: limit of this impact's measured peak force, normal and friction together. A larger peak
            breaks the mission off. null: only limits.peak_force_n applies.
    """

    mode: Mode | None = None
    if_met: str | None = None
    if_not_met: str | None = None
    trajectory: TrajectoryPieces | None = None
    predicted: CollisionPrediction | None = None
    peak_limit_n: Annotated[float, Meta(gt=0.0, le=2000.0)] | None = None


class CollisionSpec(CollisionKeys, frozen=True, kw_only=True):
    """One planned collision.

    Attributes:
        wall: a key of walls or posts, or a face of a partition, such as board.front. With a probe, the name
            of an unknown wall is also allowed.
        approach: velocity at the impact; required for the first collision. Without an approach, the recovery
            of the previous collision leads to this wall.
        probe: search for the wall; a collision with a probe has neither an approach nor gains.
        impact_point_m: [x, y] on the wall's plane; default: the point at which a straight line from start
            along the approach meets the plane. For a post, the key is required: it is the position of
            the vehicle's centre at first touch.
        impact_along_m: the impact point as a distance along the wall from its middle, positive to the right
            when looking along the normal; give at most one of impact_point_m and impact_along_m. At a wall
            that a probe has found, 0 is the point of contact.
        alpha_m_per_n: recovery gains along the mission's x and y axes (the paper's form), m of setpoint per N
            of peak force. The wall must be parallel to an axis, or the two gains must be equal.
        alpha_wall_m_per_n: recovery gains [normal, tangential] of the wall, in the same unit, for any wall;
            give exactly one of alpha_m_per_n and alpha_wall_m_per_n.
    """

    wall: str
    approach: ApproachSpec | None = None
    probe: ProbeSpec | None = None
    impact_point_m: Point2 | None = None
    impact_along_m: Coordinate | None = None
    alpha_m_per_n: tuple[Alpha, Alpha] | None = None
    alpha_wall_m_per_n: tuple[Alpha, Alpha] | None = None


class WaypointKeys(Section, frozen=True, kw_only=True):
    """Keys of a waypoint or a pause that the flight uses as written.

    Attributes:
        after: number of collisions flown before the waypoint; it never decreases along the list.
        at_wall: a position relative to a wall, instead of position_m. The waypoint is skipped if the wall
            was not touched.
        if_met: a wall that an earlier probe searches for; the waypoint or pause is flown only if that wall
            was touched.
        if_not_met: a wall that an earlier probe searches for; the waypoint or pause is flown only if that
            wall was not touched.
    """

    after: Annotated[int, Meta(ge=0, le=1000)] = 0
    at_wall: PlaceAtWall | None = None
    if_met: str | None = None
    if_not_met: str | None = None


class WaypointSpec(WaypointKeys, frozen=True, kw_only=True):
    """A waypoint, at which the vehicle stops, or a pause in place; give exactly one of the two.

    Attributes:
        position_m: [x, y] of a waypoint, mission frame.
        altitude_m: altitude above the take-off point, at this waypoint and after it; if not given, the
            altitude does not change.
        speed_m_s: largest speed of the leg to the waypoint; default: flying.transit_speed_m_s. The vertical
            speed is limited by flying.climb_speed_m_s.
        hold_s: hold time at a waypoint.
        pause: operator: hold until the operator continues (Enter, or SIGUSR1).
        timeout_s: timeout of a pause; if the operator has not responded, the vehicle lands.
    """

    position_m: Point2 | None = None
    altitude_m: Annotated[float, Meta(gt=0.0, le=100.0)] | None = None
    speed_m_s: Annotated[float, Meta(ge=0.05, le=20.0)] | None = None
    hold_s: Annotated[float, Meta(ge=0.0, le=600.0)] | None = None
    pause: Literal["operator"] | None = None
    timeout_s: Annotated[float, Meta(ge=1.0, le=600.0)] | None = None


class Tolerance(Section, frozen=True):
    """Allowed differences between plan and flight; within them, the verdict reports `plan_followed`.

    Attributes:
        impact_m_s: allowed difference of each component of the impact velocity.
        peak_force_share: allowed difference of the peak force, relative to the planned peak force.
        place_m: allowed distance of the impact from the planned impact point.
    """

    impact_m_s: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.15
    peak_force_share: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.25
    place_m: Annotated[float, Meta(gt=0.0, le=100.0)] = 0.25


FlightSeconds = Annotated[float, Meta(ge=0.0, le=3600.0)]
Count = Annotated[int, Meta(ge=0, le=1_000_000)]


class NominalFlight(Section, frozen=True):
    """The simulated flight in the nominal world, without random differences.

    Attributes:
        outcome: completed, aborted or released.
        uncontrolled: whether the vehicle tumbled, crashed or left the bounds (docs/interfaces.md).
        time_s: duration from take-off to landing, including probes; null if the vehicle did not land.
        max_tilt_deg: largest tilt.
        reason: why the flight did not complete.
    """

    outcome: Outcome
    uncontrolled: bool
    time_s: FlightSeconds | None = None
    max_tilt_deg: Annotated[float, Meta(ge=0.0, le=180.0)] | None = None
    reason: str | None = None


class DrawnFlights(Section, frozen=True):
    """Simulated flights in random worlds, in which every quantity is drawn at random (`--vary all`).

    Attributes:
        flights: number of flights.
        first_seed: first of the consecutive seeds.
        completed: number of completed flights.
        uncontrolled: number of flights that the verdict calls uncontrolled (docs/interfaces.md); a completed
            flight may be uncontrolled, too.
        ended_by: number of incomplete flights for each cause; a cause is a guard rule or another reason.
        median_time_s: median duration of completed flights from take-off to landing, including probes.
        max_tilt_deg: largest tilt in any flight.
    """

    flights: Count
    first_seed: Count
    completed: Count
    uncontrolled: Count
    ended_by: dict[str, Count] = msgspec.field(default_factory=dict)
    median_time_s: FlightSeconds | None = None
    max_tilt_deg: Annotated[float, Meta(ge=0.0, le=180.0)] | None = None


class FlownRecord(Section, frozen=True):
    """Simulated flights of the mission; written by `plan`, shown by `check`, ignored in flight.

    Attributes:
        software: version of the software that flew the mission.
        digest: fingerprint of mission and vehicle at that time; `check` compares the current fingerprint with
            this value.
        nominal, drawn: the flight in the nominal world, and the flights with random differences; drawn is
            null if the nominal flight failed.
        free_time_s: median duration of flights without collisions, simulated in the same random worlds; null
            if not flown.
        saving_s: median time that this mission saves, compared with the flights without collisions; negative
            if the mission is slower.
    """

    software: str
    digest: str
    nominal: NominalFlight
    drawn: DrawnFlights | None = None
    free_time_s: FlightSeconds | None = None
    saving_s: Annotated[float, Meta(ge=-3600.0, le=3600.0)] | None = None

    @property
    def danger(self) -> str | None:
        """Reason not to fly the mission, or None.

        The reason is that the nominal flight is uncontrolled or does not complete, or that a drawn flight is
        uncontrolled.
        """
        nominal = self.nominal
        if nominal.uncontrolled:
            return f"the nominal flight is uncontrolled ({nominal.reason or nominal.outcome.value})"
        if nominal.outcome is not Outcome.COMPLETED:
            return f"the nominal flight does not complete ({nominal.reason or nominal.outcome.value})"
        if self.drawn is not None and self.drawn.uncontrolled:
            of = f"of the {self.drawn.flights} flights flown in random worlds"
            one = self.drawn.uncontrolled == 1
            return f"1 {of} is uncontrolled" if one else f"{self.drawn.uncontrolled} {of} are uncontrolled"
        return None

    @property
    def failure(self) -> str | None:
        """Reason not to offer the plan, or None.

        The reason is `danger`, or that a drawn flight tilts too far, or that too few drawn flights
        complete.
        """
        if self.danger is not None or self.drawn is None:
            return self.danger
        if (self.drawn.max_tilt_deg or 0.0) > _MOST_TILT_DEG:
            return (
                f"in a random world, the vehicle tilts by {self.drawn.max_tilt_deg:.0f} degrees, "
                f"limit {_MOST_TILT_DEG:g}"
            )
        if self.drawn.flights - self.drawn.completed > _MOST_BROKEN_OFF * self.drawn.flights:
            causes = ", ".join(f"{rule} {count}" for rule, count in self.drawn.ended_by.items())
            flown = f"{self.drawn.completed} of {self.drawn.flights} flights"
            return f"only {flown} in random worlds were completed ({causes})"
        return None

    @property
    def summary(self) -> str:
        """Results of the flights and the saved time in one line, for `plan`, `check` and the picture."""
        drawn = self.drawn
        if drawn is None:
            return self.danger or "the nominal flight completes; no flights in random worlds were simulated"
        text = (
            f"{drawn.completed} of {drawn.flights} flights in random worlds complete, "
            f"{drawn.uncontrolled} uncontrolled"
        )
        if drawn.median_time_s is not None:
            text += f", {drawn.median_time_s:.1f} s from take-off to landing"
        if self.saving_s is not None and self.free_time_s is not None:
            verb = "saves" if self.saving_s > 0.0 else "loses"
            text += f" against {self.free_time_s:.1f} s without collisions: {verb} {abs(self.saving_s):.2f} s"
        return text


class MissionKeys(SpaceKeys, frozen=True, kw_only=True):
    """Keys of a mission that the flight uses as written.

    Attributes:
        name: letters, digits and ' _.-', at most 64; names the flight's folder.
        predicted: the planner's prediction; `plan` writes this key.
        flown: results of the mission's simulated flights; `plan` writes this key.
        goal_trajectory: trajectory to the goal, from the predicted end of the last collision, or from rest at
            start.
        after_impact: setpoint: fly the paper's recovery setpoint; replan: also plan a trajectory from the
            measured impact, and fly the trajectory once it is ready.
        tolerance: allowed differences between flight and plan; for the goal, goal.capture_radius_m applies.
        mode_mismatch: response to a contact that indicates a different mode from the one that the lock
            reports; go_on: record it in log and verdict; land: the guard lands the vehicle.
        standoff_m: rehearsal: the vehicle stops this far short of each wall instead of touching it, as with
            --standoff; null: contacts are flown.
    """

    name: Name
    predicted: MissPrediction | None = None
    flown: FlownRecord | None = None
    goal_trajectory: TrajectoryPieces | None = None
    after_impact: AfterImpact = AfterImpact.SETPOINT
    tolerance: Tolerance = Tolerance()
    mode_mismatch: ModeMismatch = ModeMismatch.NOTE_ONLY
    standoff_m: Standoff | None = None


class MissionFile(MissionKeys, frozen=True, kw_only=True):
    """A mission as written in YAML.

    Attributes:
        version: version of the file format.
        walls: walls by name.
        simulated_walls: additional walls by name, which exist only in simulation; the vehicle finds them with
            probes.
        posts: posts by name; a post and a wall cannot have the same name.
        collisions: collisions in the order of flight; may be empty.
        waypoints: waypoints and pauses before, between and after the collisions, in the order of flight.
        vehicle: vehicle configuration: a path relative to the mission file, or keys and values; default: the
            default configuration.
    """

    version: Literal[1]
    start: StartSpec
    bounds_m: BoundsSpec
    walls: dict[str, WallSpec] = msgspec.field(default_factory=dict)
    simulated_walls: dict[str, WallSpec] = msgspec.field(default_factory=dict)
    posts: dict[str, PostSpec] = msgspec.field(default_factory=dict)
    collisions: list[CollisionSpec] = msgspec.field(default_factory=list)
    waypoints: list[WaypointSpec] = msgspec.field(default_factory=list)
    vehicle: str | dict[str, Any] | None = None
