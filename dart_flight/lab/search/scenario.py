"""The planner's input: YAML types of scenario files (version 1), and the checked `Scenario`.

A scenario shares start, goal, bounds, walls, limits and frame with a mission (`config.mission`), and defines
a search instead of collisions. `docs/missions.md` explains every key.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import Mode
from dart_flight.base.walls import Post, Wall
from dart_flight.config.document import Document, InputError, Key, unknown_name
from dart_flight.config.file_kinds import FileKind, load_document, refuse_other_keys
from dart_flight.config.flight_space import FlightSpace
from dart_flight.config.mission_file import (
    Alpha,
    BoundsSpec,
    Name,
    Point2,
    PostSpec,
    SpaceKeys,
    StartSpec,
    WallSpec,
)
from dart_flight.config.provenance import VehicleSource, find_vehicle
from dart_flight.config.section import Section, shared_keys
from dart_flight.config.vehicle import Px4Parameters, VehicleConfig

_MAX_STEPS = 2001
_MAX_CANDIDATES = 20_000_000
_MAX_COLLISIONS = 4  # longest sequence of a grid search; `_MAX_QUICKEST` applies to the objective quickest
_MAX_QUICKEST = 16


class Objective(StrEnum):
    """The criterion of the best plan."""

    NEAREST = "nearest"
    FASTEST = "fastest"
    GENTLEST = "gentlest"
    ROBUST = "robust"
    QUICKEST = "quickest"


class GridSpec(Section, frozen=True):
    """Evenly spaced velocities, both ends included.

    Attributes:
        min: lowest velocity, m/s.
        max: highest velocity, m/s.
        step: difference between neighbouring velocities, m/s; must divide the range.
    """

    min: Annotated[float, Meta(ge=-20.0, le=20.0)]
    max: Annotated[float, Meta(ge=-20.0, le=20.0)]
    step: Annotated[float, Meta(gt=0.0, le=40.0)]


class SearchSpec(Section, frozen=True):
    """The approach velocities of the first collision, in its collision frame, and the modes to try.

    Attributes:
        normal_m_s: grid along the wall's normal; negative is towards the wall.
        tangential_m_s: grid along the wall.
        modes: modes to try at every collision of the sequence; by default every mode of the vehicle.
    """

    normal_m_s: GridSpec
    tangential_m_s: GridSpec
    modes: tuple[Mode, ...] | None = None


class VisitSpec(Section, frozen=True):
    """A place that the vehicle passes in flight on its way to the goal.

    Attributes:
        position_m: place [x, y] for the vehicle's centre, mission frame.
        within_m: tolerance; the vehicle's centre passes the place at a distance of at most this value.
    """

    position_m: Point2
    within_m: Annotated[float, Meta(gt=0.0, le=10.0)]


class SightSpec(Section, frozen=True):
    """The vehicle detects the wall only when the wall is near, and cruises until it reacts to the detection.

    Attributes:
        distance_m: distance from the vehicle's centre to the wall's plane at which the wall is detected.
        reaction_s: time from the detection until the flight reacts.
    """

    distance_m: Annotated[float, Meta(gt=0.0, le=100.0)]
    reaction_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.15


class Uncertainty(Section, frozen=True):
    """Standard deviations for the objective `robust`.

    Attributes:
        samples: number of random sets of values (draws); every candidate is evaluated with the same sets.
        k, f, mu: relative standard deviation of the contact coefficient.
        approach_m_s: standard deviation of each component of the approach velocity.
        detection_delay_s: standard deviation of the time between force peak and setpoint.
    """

    samples: Annotated[int, Meta(ge=64, le=4096)] = 64
    k: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.15
    f: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.15
    mu: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.5
    approach_m_s: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.05
    detection_delay_s: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.004


class ScenarioFile(SpaceKeys, frozen=True, kw_only=True):
    """A scenario as written in YAML.

    Attributes:
        version: version of the file format.
        walls: the walls by name; walls outside the sequence are obstacles.
        posts: posts by name, as obstacles; only with the objective quickest.
        touch_m_s: speed of touches before the hits; only with the objective quickest. Before the hits, the
            vehicle flies from the start to each wall to be hit, touches the wall at this speed, and returns.
            The touches measure the walls' direction and vertical force. Without this key there are no
            touches.
        sequence: walls in the order of the hits: up to four, or up to 16 with the objective quickest. With
            `any` the planner chooses walls and order. With `any` and the objective quickest, a plan without a
            wall is possible, too.
        search: the approaches to try; the objective quickest does not use this key.
        name: name of the written mission; by default the name of this file.
        vehicle: vehicle configuration, relative to this file; by default the default configuration.
        alpha_m_per_n: wall -> recovery gains along the mission's x and y axes, as in a mission.
        alpha_wall_m_per_n: wall -> recovery gains [normal, tangential], as in a mission.
        objective: criterion of the best plan. nearest: smallest miss of the goal; fastest: shortest time to
            the goal; gentlest: smallest peak force; robust: smallest miss under the uncertainty; quickest:
            shortest time from rest at the start through the visits to rest at the goal. Plans with quickest
            contain only hits that save time or that `sequence` demands.
        visits: places to pass, in this order; only with the objective quickest.
        sight: late detection of the scenario's only wall, which must be in front of the start; only with the
            objective quickest.
        uncertainty: standard deviations for the objective robust.
    """

    version: Literal[1]
    start: StartSpec
    bounds_m: BoundsSpec
    walls: dict[str, WallSpec]
    sequence: list[str] | Literal["any"]
    search: SearchSpec | None = None
    visits: list[VisitSpec] = msgspec.field(default_factory=list)
    sight: SightSpec | None = None
    posts: dict[str, PostSpec] = msgspec.field(default_factory=dict)
    touch_m_s: Annotated[float, Meta(ge=0.3, le=1.0)] | None = None
    name: Name | None = None
    vehicle: str | None = None
    alpha_m_per_n: dict[str, tuple[Alpha, Alpha]] = msgspec.field(default_factory=dict)
    alpha_wall_m_per_n: dict[str, tuple[Alpha, Alpha]] = msgspec.field(default_factory=dict)
    objective: Objective = Objective.NEAREST
    uncertainty: Uncertainty = Uncertainty()


class Scenario(SpaceKeys, frozen=True, kw_only=True):
    """A checked scenario and its vehicle.

    Attributes:
        spec: the file's content; keys that a mission shares, such as walls, are copied into the mission file.
        vehicle_path: file of the configuration, or None for the default configuration.
        vehicle_source: source of the configuration; None if the caller passed the configuration as an object.
        walls: walls by name. The vehicle's centre is in the plane of a wall when the vehicle touches the
            wall.
        sequences: sequences to search, each with its walls in the order of the hits. There is one sequence,
            or several if the file contains `any`.
        chosen_by_planner: whether the planner chooses the sequence.
        normal_m_s, tangential_m_s: the grid of approach velocities, collision frame of the first wall.
        alphas: gains (A_n, A_t) of the recovery setpoint per wall, m/N.
    """

    name: str
    source: str
    spec: ScenarioFile
    vehicle: VehicleConfig
    vehicle_path: Path | None
    start: Vec2
    altitude_m: float
    bounds: BoundsSpec
    walls: dict[str, Wall]
    sequences: tuple[tuple[str, ...], ...]
    chosen_by_planner: bool
    normal_m_s: tuple[float, ...]
    tangential_m_s: tuple[float, ...]
    modes: tuple[Mode, ...]
    alphas: dict[str, tuple[float, float]]
    objective: Objective
    uncertainty: Uncertainty
    visits: tuple[VisitSpec, ...] = ()
    sight: SightSpec | None = None
    posts: tuple[Post, ...] = ()
    vehicle_source: VehicleSource | None = None

    @property
    def first_mode(self) -> Mode:
        """The mode to try first: the mode in which a hit loses the least velocity."""
        return Mode.FLEXIBLE if Mode.FLEXIBLE in self.modes else self.modes[0]


def load_scenario(
    path: str | Path | Mapping[str, Any],
    config: str | Path | None = None,
    vehicle: VehicleConfig | None = None,
    settings: Sequence[str] = (),
) -> Scenario:
    """Load, validate and resolve a scenario file.

    Args:
        path: the scenario, or a mapping with the content of a file.
        config: vehicle configuration to use instead of the scenario's configuration.
        vehicle: configuration already loaded, for example with parameters read from the vehicle.
        settings: `KEY=VALUE` settings that override the vehicle configuration.

    Raises:
        InputError: the scenario or the configuration is invalid.
    """
    return parse_scenario(load_document(path, FileKind.SCENARIO), config, vehicle, settings)


def parse_scenario(
    document: Document,
    config: str | Path | None = None,
    vehicle: VehicleConfig | None = None,
    settings: Sequence[str] = (),
) -> Scenario:
    """Resolve a parsed scenario as `load_scenario` does."""
    refuse_other_keys(document, FileKind.SCENARIO)
    spec = document.convert(ScenarioFile)
    if config is None and spec.vehicle is not None:
        config = Path(document.source).parent / spec.vehicle
    config_path = None if config is None else Path(config)
    if vehicle is not None:
        return resolve_scenario(spec, vehicle, config_path, document)
    found = find_vehicle(config, settings)
    scenario = resolve_scenario(spec, found.config, config_path, document)
    return msgspec.structs.replace(scenario, vehicle_source=found.source)


def with_vehicle_parameters(scenario: Scenario, url: str) -> Scenario:
    """Return the scenario with the PX4 parameters of the vehicle that is connected at `url`.

    `VehicleError` is raised if the vehicle does not answer or has none of the parameters.
    """
    from dart_flight.vehicle.ground_link import GroundLink  # noqa: PLC0415  (an extra, slow to import)
    from dart_flight.vehicle.vehicle_session import VehicleError  # noqa: PLC0415

    vehicle = scenario.vehicle
    own = msgspec.to_builtins(vehicle.px4)
    with GroundLink(url, vehicle.connection.timeout_s) as link:
        found = link.read_parameters(own)
    if not found:
        raise VehicleError(f"vehicle on {url} reports no parameters")
    try:
        px4 = msgspec.convert({**own, **found}, Px4Parameters)
    except msgspec.ValidationError as error:
        raise InputError(f"the vehicle's parameters: {error}", source=url) from None
    return msgspec.structs.replace(scenario, vehicle=msgspec.structs.replace(vehicle, px4=px4))


def resolve_scenario(
    spec: ScenarioFile, vehicle: VehicleConfig, vehicle_path: Path | None, document: Document
) -> Scenario:
    """Resolve a scenario for a vehicle; reject contradictions, and a search that is empty or too large."""
    space = FlightSpace(spec, vehicle, document)
    walls = space.walls
    sequences = _sequences(spec, list(walls), document)
    modes = space.vehicle.modes
    normal: tuple[float, ...] = ()
    tangential: tuple[float, ...] = ()
    if spec.search is not None:
        normal, tangential = _grids(spec.search, document)
        modes = modes if spec.search.modes is None else tuple(dict.fromkeys(spec.search.modes))
    elif spec.objective is not Objective.QUICKEST:
        problem = f"missing key `search`: the objective {spec.objective} needs a grid of approaches"
        raise document.error((), problem)
    if not modes:
        raise document.error(("search", "modes"), "no mode is listed: name at least one mode")
    for mode, key in [(spec.transit_mode, ("transit_mode",)), *((m, ("search", "modes")) for m in modes)]:
        space.check_mode(mode, key)
    count = sum(len(normal) * len(tangential) * len(modes) ** len(s) for s in sequences)
    if count > _MAX_CANDIDATES:
        raise document.error(("search",), f"{count} candidates, limit {_MAX_CANDIDATES}; increase the steps")
    for i, visit in enumerate(spec.visits):
        if spec.objective is not Objective.QUICKEST:
            raise document.error(("visits",), "visits are possible only with the objective quickest")
        space.check_bounds(visit.position_m, ("visits", i))
    for name in ("posts", "touch_m_s"):
        if getattr(spec, name) and spec.objective is not Objective.QUICKEST:
            raise document.error((name,), "this key is possible only with the objective quickest")
    if spec.sight is not None:
        _check_sight(spec, spec.sight, list(walls.values()), document)
    return Scenario(
        **shared_keys(spec, SpaceKeys),
        name=spec.name or _name_from(document.source),
        source=document.source,
        spec=spec,
        vehicle=space.vehicle,
        vehicle_path=vehicle_path,
        start=spec.start.position_m,
        altitude_m=spec.start.altitude_m,
        bounds=spec.bounds_m,
        walls=walls,
        sequences=sequences,
        chosen_by_planner=spec.sequence == "any",
        normal_m_s=normal,
        tangential_m_s=tangential,
        modes=modes,
        alphas={} if spec.search is None else _alphas(spec, space, sequences),
        objective=spec.objective,
        uncertainty=spec.uncertainty,
        visits=tuple(spec.visits),
        sight=spec.sight,
        posts=tuple(space.posts.values()),
    )


def _check_sight(spec: ScenarioFile, sight: SightSpec, walls: list[Wall], document: Document) -> None:
    start = spec.start.position_m
    for valid, problem in (
        (
            spec.objective is Objective.QUICKEST,
            "the key `sight` is possible only with the objective quickest",
        ),
        (
            len(walls) == 1 and not spec.visits,
            "the key `sight` needs exactly one wall and no visits",
        ),
        (walls[0].spans(start), "the vehicle sees only straight ahead: move start in front of the wall"),
        (
            walls[0].signed_distance(start) > sight.distance_m,
            "the wall must be out of sight at start: move start away from the wall",
        ),
    ):
        if not valid:
            raise document.error(("sight",), problem)


def _grids(spec: SearchSpec, document: Document) -> tuple[tuple[float, ...], tuple[float, ...]]:
    normal = _grid(spec.normal_m_s, ("search", "normal_m_s"), document)
    if not normal[-1] < 0.0:
        raise document.error(
            ("search", "normal_m_s", "max"), f"an approach needs a negative velocity, not {normal[-1]:g}"
        )
    return normal, _grid(spec.tangential_m_s, ("search", "tangential_m_s"), document)


def _name_from(source: str) -> str:
    name = re.sub(r"[^A-Za-z0-9 _.-]", "-", Path(source).stem)[:64]
    return name if name[:1].isascii() and name[:1].isalnum() else "plan"


def _sequences(spec: ScenarioFile, walls: list[str], document: Document) -> tuple[tuple[str, ...], ...]:
    key: Key = ("sequence",)
    if not walls:
        raise document.error(("walls",), "a plan needs at least one wall")
    if spec.sequence == "any":
        found: list[tuple[str, ...]] = [(name,) for name in walls]
        frontier = found
        # Use each wall at most once, because the recovery from a wall leads away from this wall.
        for _ in range(min(len(walls), _MAX_COLLISIONS) - 1):
            frontier = [(*s, name) for s in frontier for name in walls if name not in s]
            found = [*found, *frontier]
        return tuple(found)
    sequence = tuple(spec.sequence)
    most = _MAX_QUICKEST if spec.objective is Objective.QUICKEST else _MAX_COLLISIONS
    if not 1 <= len(sequence) <= most:
        raise document.error(
            key, f"expected a list of 1 to {most} walls or the word `any`, not {len(sequence)} walls"
        )
    for i, name in enumerate(sequence):
        if name not in walls:
            raise document.error((*key, i), unknown_name(name, walls))
        if i and name == sequence[i - 1]:
            raise document.error(
                (*key, i), "a wall cannot be hit twice in a row: the recovery leads away from the wall"
            )
    return (sequence,)


def _grid(spec: GridSpec, key: Key, document: Document) -> tuple[float, ...]:
    if spec.min > spec.max:
        raise document.error(key, f"the grid is empty: min {spec.min:g} is above max {spec.max:g}")
    steps = (spec.max - spec.min) / spec.step
    count = round(steps)
    if abs(steps - count) > 1e-6 * max(1.0, steps):
        below = spec.min + math.floor(steps) * spec.step
        raise document.error(
            (*key, "step"),
            f"{spec.step:g} does not divide the range {spec.min:g} to {spec.max:g}; "
            f"use max {below:.6g} or {below + spec.step:.6g}",
        )
    if count + 1 > _MAX_STEPS:
        raise document.error((*key, "step"), f"{count + 1} values, limit {_MAX_STEPS}; increase the step")
    return tuple(round(spec.min + i * spec.step, 12) for i in range(count + 1))


def _alphas(
    spec: ScenarioFile, space: FlightSpace, sequences: tuple[tuple[str, ...], ...]
) -> dict[str, tuple[float, float]]:
    for field in ("alpha_m_per_n", "alpha_wall_m_per_n"):
        for name in getattr(spec, field):
            if name not in space.walls:
                raise space.error((field, name), unknown_name(name, list(space.walls)))
    alphas = {}
    for name in sorted({name for sequence in sequences for name in sequence}):
        per_axis, per_wall = spec.alpha_m_per_n.get(name), spec.alpha_wall_m_per_n.get(name)
        if per_axis is None and per_wall is None:
            raise space.error(
                ("alpha_m_per_n",), f"wall {name} needs gains in alpha_m_per_n or alpha_wall_m_per_n"
            )
        key: Key = ("alpha_wall_m_per_n" if per_axis is None else "alpha_m_per_n", name)
        alphas[name] = space.alphas(per_axis, per_wall, space.walls[name], key)
    return alphas
