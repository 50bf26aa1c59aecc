"""The list of all checks for `check`, `fly`, `survey` and hardware in the loop; each check has a stage.

A command creates a `FlightContext`, runs the checks of its stages (`run_checks`) and shows the findings. To
add a check, add one line to `CHECKS`. The steps on the bench have their own list, `bringup.steps.STEPS`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

from dart_flight.check.computer_load import check_computer, check_core_speed, check_lateness
from dart_flight.check.findings import CheckFinding, EndOfStageError
from dart_flight.check.hitl_check import (
    evaluate_hitl_lock,
    evaluate_hitl_mode,
    evaluate_hitl_outputs,
    evaluate_hitl_parameters,
    evaluate_own_parameters,
)
from dart_flight.check.inherited_check import check_inherited
from dart_flight.check.log_space import check_log_space
from dart_flight.check.mission_check import (
    check_collisions,
    check_flown,
    check_goal,
    check_materials,
    check_path,
    check_places,
    check_waypoints,
    predict_flight_path,
)
from dart_flight.check.place_check import check_heading, evaluate_place
from dart_flight.check.pose_check import evaluate_poses
from dart_flight.check.probe_check import check_anchors
from dart_flight.check.px4_parameters import evaluate_claim, evaluate_parameters, evaluate_position
from dart_flight.check.telemetry_check import (
    evaluate_battery,
    evaluate_motor_outputs,
    evaluate_rates,
    evaluate_resting_force,
    evaluate_sources,
    evaluate_systems,
)
from dart_flight.check.vehicle_check import (
    evaluate_airframe,
    evaluate_lock,
    evaluate_mode,
    evaluate_observation,
    evaluate_round_trip,
)
from dart_flight.check.vehicle_reading import VehicleReading, read_for_hitl, read_vehicle
from dart_flight.check.wall_check import check_walls
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.planning.predicted_flight import PredictedFlight
from dart_flight.vehicle.command_server import Press, Result


class Stage(StrEnum):
    """The stage of a check; all checks of a stage need the same inputs, such as a connected vehicle."""

    FILE = "file"  # checks of the mission file, which need no vehicle
    COMPUTER = "computer"  # the onboard computer
    DESK = "desk"  # checks of inherited values and of the position source that the operator claims
    VEHICLE = "vehicle"
    HITL = "hardware in the loop"


@dataclass
class FlightContext:
    """The inputs of the checks before a flight.

    Attributes:
        mission: the mission to be flown.
        log_dir: the folder of the flight log.
        url: MAVSDK connection URL of the vehicle, or None without a vehicle.
        position_from: the position source that the operator claims; if None, the vehicle's parameters select
            it.
        answer: responds to the ground station's buttons while the vehicle is read, or None.
        reading: the vehicle's parameters and telemetry; None until the first check with a vehicle.
        found: the findings of the earlier checks.
    """

    mission: Mission
    log_dir: Path = Path("flights")
    url: str | None = None
    position_from: PositionSource | None = None
    answer: Callable[[Press], tuple[Result, str]] | None = None
    reading: VehicleReading | None = None
    found: list[CheckFinding] = field(default_factory=list)

    @functools.cached_property
    def planned(self) -> PredictedFlight | None:
        """The flight that the planner's model predicts, or None if the model cannot predict a flight."""
        return predict_flight_path(self.mission)

    @property
    def vehicle(self) -> VehicleReading:
        assert self.reading is not None, "the first check of a stage must read the vehicle"
        return self.reading

    def read(self, reader: Callable[[Mission, str], VehicleReading]) -> list[CheckFinding]:
        """Read parameters and telemetry once for all checks of a stage; return no finding."""
        if self.reading is None and self.url is not None:
            self.reading = reader(self.mission, self.url)
        return []

    # -- checks that need more than one line --

    def check_claim(self) -> list[CheckFinding]:
        """Check the position source that the operator claims, if no vehicle is connected."""
        if self.url is not None or self.position_from is None:
            return []
        return evaluate_claim(self.mission, self.position_from)

    def check_parameters(self) -> list[CheckFinding]:
        v = self.vehicle
        return evaluate_parameters(self.mission, v.values, self.position_from or v.position_from, v.version)

    def check_own_parameters(self) -> list[CheckFinding]:
        """If all earlier checks have passed, check the parameters that are not in `hitl.params`."""
        if not all(finding.go for finding in self.found):
            return []
        return evaluate_own_parameters(self.mission, self.vehicle.values, self.position_from)


class Check(NamedTuple):
    """A check; its name is unique within the stage."""

    name: str
    stage: Stage
    run: Callable[[FlightContext], Iterable[CheckFinding]]


_FILE, _COMPUTER, _DESK, _VEHICLE, _HITL = Stage.FILE, Stage.COMPUTER, Stage.DESK, Stage.VEHICLE, Stage.HITL

CHECKS: tuple[Check, ...] = (
    Check("places", _FILE, lambda c: check_places(c.mission)),
    Check("heading", _FILE, lambda c: check_heading(c.mission)),
    Check("waypoints", _FILE, lambda c: check_waypoints(c.mission, c.planned)),
    Check("collisions", _FILE, lambda c: check_collisions(c.mission, c.planned)),
    Check("path", _FILE, lambda c: check_path(c.mission, c.planned)),
    Check("goal", _FILE, lambda c: check_goal(c.mission, c.planned)),
    Check("walls", _FILE, lambda c: check_walls(c.mission, c.planned)),
    Check("anchors", _FILE, lambda c: check_anchors(c.mission)),
    Check("materials", _FILE, lambda c: check_materials(c.mission, c.log_dir)),
    Check("flown", _FILE, lambda c: [check_flown(c.mission)]),
    Check("log_space", _COMPUTER, lambda c: [check_log_space(c.mission, c.log_dir)]),
    Check("lateness", _COMPUTER, lambda c: [check_lateness(c.mission)]),
    Check("core_speed", _COMPUTER, lambda c: [check_core_speed(c.mission, c.found)]),
    Check("health", _COMPUTER, lambda c: check_computer()),
    Check("inherited", _DESK, lambda c: check_inherited(c.mission)),
    Check("claim", _DESK, FlightContext.check_claim),
    Check("link", _VEHICLE, lambda c: c.read(functools.partial(read_vehicle, answer=c.answer))),
    Check(
        "position",
        _VEHICLE,
        lambda c: evaluate_position(
            c.mission, c.vehicle.position_from, c.vehicle.observed.gps_fix, c.position_from
        ),
    ),
    Check("parameters", _VEHICLE, FlightContext.check_parameters),
    Check("mode", _VEHICLE, lambda c: evaluate_mode(c.vehicle.mode)),
    Check("airframe", _VEHICLE, lambda c: evaluate_airframe(c.mission, c.vehicle.values)),
    Check("round_trip", _VEHICLE, lambda c: [evaluate_round_trip(c.mission, c.vehicle.round_trip_s)]),
    Check("estimator", _VEHICLE, lambda c: evaluate_observation(c.vehicle.observed)),
    Check("system_id", _VEHICLE, lambda c: evaluate_systems(c.mission, c.vehicle.observed)),
    Check("rates", _VEHICLE, lambda c: evaluate_rates(c.vehicle.observed, c.vehicle.values)),
    Check("sources", _VEHICLE, lambda c: evaluate_sources(c.vehicle.observed)),
    Check("pose_source", _VEHICLE, lambda c: evaluate_poses(c.mission.vehicle.mocap, c.vehicle.observed)),
    Check("battery", _VEHICLE, lambda c: [evaluate_battery(c.mission, c.vehicle.observed)]),
    Check("imu_scale", _VEHICLE, lambda c: evaluate_resting_force(c.vehicle.observed)),
    Check(
        "motor_outputs",
        _VEHICLE,
        lambda c: evaluate_motor_outputs(c.mission, c.vehicle.observed, c.vehicle.values),
    ),
    Check(
        "place",
        _VEHICLE,
        lambda c: evaluate_place(c.mission, c.vehicle.observed.position_ned, c.vehicle.observed.q_frd_to_ned),
    ),
    Check("lock", _VEHICLE, lambda c: evaluate_lock(c.mission, c.vehicle.values)),
    Check("link", _HITL, lambda c: c.read(read_for_hitl)),
    Check("lock", _HITL, lambda c: [evaluate_hitl_lock(c.mission)]),
    Check("mode", _HITL, lambda c: evaluate_hitl_mode(c.vehicle.values, c.vehicle.mode)),
    Check("hitl_parameters", _HITL, lambda c: evaluate_hitl_parameters(c.vehicle.values)),
    Check("outputs", _HITL, lambda c: evaluate_hitl_outputs(c.vehicle.values)),
    Check("parameters", _HITL, FlightContext.check_own_parameters),
)


def run_checks(context: FlightContext, *stages: Stage) -> list[CheckFinding]:
    """Run the checks of the given stages, in the order of `CHECKS`, and return their findings.

    After `EndOfStageError`, skip the remaining checks of that stage.
    """
    first, ended = len(context.found), set[Stage]()
    for check in CHECKS:
        if check.stage not in stages or check.stage in ended:
            continue
        try:
            context.found += check.run(context)
        except EndOfStageError as end:
            context.found += end.findings
            ended.add(check.stage)
    return context.found[first:]
