"""Missions without a collision, waypoints before, between and after collisions, and pauses."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.records import (
    ImpactPeak,
    Input,
    OdometrySample,
    OperatorRequest,
    Outcome,
    PhaseChange,
    PlanRequest,
    Record,
    Request,
    Setpoint,
)
from dart_flight.check.findings import CheckFinding
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.flight_core import FlightCore
from dart_flight.core.mission.approach import NoApproachError, plan_transit, transit_segments
from dart_flight.lab.report.page import flight_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.verdict import VerdictBuilder, verdict_of
from dart_flight.run.fast import FastFlight, fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.run.replay import replay
from dart_flight.sim.faults.fault_table import parse_fault
from tests.mission_findings import check_mission

DART = packaged("configs", "dart.yaml")
BARE = f"""\
version: 1
name: bare
vehicle: {DART}
start: {{position_m: [0.0, 0.0], altitude_m: 1.0}}
goal: {{position_m: [0.5, 0.0], hold_s: 0.5}}
bounds_m: {{x: [-2.0, 2.2], y: [-1.6, 2.5], z: [0.3, 2.0]}}
"""
WALL = "walls:\n  acrylic: {point_m: [1.65, 0.5], normal: [-1.0, 0.0], length_m: 3.0, material: acrylic}\n"
HIT = "{wall: acrylic, mode: rigid, approach: {normal_m_s: -0.8, tangential_m_s: 0.3}, \
impact_point_m: [1.65, 0.5], alpha_m_per_n: [0.02, 0.02]}"


def mission(*lines: str) -> Mission:
    Path("mission.yaml").write_text(BARE + "\n".join(lines) + "\n")
    return load_flyable("mission.yaml")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def fly_mission(loaded: Mission) -> Log:
    """Fly a mission and return the log."""
    return read_log(str(fly_fast(loaded, 1, Path("flights")).log))


def all_of(log: Log, kind: type[Record]) -> list[Record]:
    return [entry.record for entry in log.entries if isinstance(entry.record, kind)]


def phases(log: Log) -> list[str]:
    return [c.after.value for c in all_of(log, PhaseChange) if isinstance(c, PhaseChange)]


AIR = ["offboard", "arming", "climb"]
DOWN = ["goal", "landing", "done"]


def test_a_mission_without_a_collision_completes_at_the_goal() -> None:
    loaded = mission()
    assert mission("collisions: []", "walls: {}", "waypoints: []") == loaded
    verdict = fly_fast(loaded, 1, None)
    assert verdict.outcome is Outcome.COMPLETED
    assert (verdict.collisions, verdict.guard, verdict.deviations) == ([], [], [])
    assert (verdict.goal_miss_m, verdict.plan_followed) == (None, None)
    assert verdict.final_error_m is not None
    assert verdict.final_error_m < 0.1


WAYPOINTS = (
    "waypoints:",
    "  - {position_m: [0.6, -0.6], altitude_m: 1.5, hold_s: 1.0}",
    "  - {pause: operator}",
    "  - {position_m: [-0.6, -0.6], speed_m_s: 1.0}",
)


def test_waypoints_are_flown_in_order_with_hold_times_and_altitudes() -> None:
    loaded = mission(*WAYPOINTS)
    assert [loaded.altitude_at(0), loaded.place_before(0)] == [1.5, (-0.6, -0.6)]
    log = fly_mission(loaded)
    assert phases(log) == [*AIR, "waypoint", "pause", "waypoint", *DOWN]
    # The simulated operator ends the pause with a recorded input.
    (operator_request,) = all_of(log, OperatorRequest)
    assert isinstance(operator_request, OperatorRequest)
    assert operator_request.request is Request.CONTINUE
    changes = [c.t_us for c in all_of(log, PhaseChange) if isinstance(c, PhaseChange)]
    first, second, third = changes[3:6]
    places = [s for s in all_of(log, OdometrySample) if isinstance(s, OdometrySample)]

    def at(t_us: int) -> tuple[float, float, float]:
        north, east, down = min(places, key=lambda s: abs(s.t_us - t_us)).position_ned
        return north, -east, -down

    for end_us in (second, third):
        assert at(end_us) == pytest.approx((0.6, -0.6, 1.5), abs=0.12)
    assert third - second == pytest.approx(2e6, abs=0.1e6)  # simulation.operator_s
    transit = plan_transit(loaded, transit_segments(loaded)[0], (0.0, 0.0, 1.0))
    assert second - first >= (transit.duration_s + 1.0) * 1e6  # transit and hold time
    # The last requested altitude holds until the landing.
    setpoints = [s for s in all_of(log, Setpoint) if isinstance(s, Setpoint) and s.t_us > third]
    assert [-s.position_ned[2] for s in setpoints] == pytest.approx([1.5] * len(setpoints), abs=0.01)


@pytest.mark.rest
def test_a_flight_along_waypoints_replays_and_has_a_page() -> None:
    log = fly_mission(mission(*WAYPOINTS))
    assert replay(log).equal
    page = flight_page(RecordedFlight.read(log.source))
    assert "waypoint" in page
    assert "The flight was completed; no collision was planned." in page
    assert "planned wall" not in page


@pytest.fixture
def between_collisions(folder: Path) -> Mission:
    return mission(
        WALL + "collisions:", f"  - {HIT}", f"  - {HIT}", "after_impact: replan", "waypoints:",
        "  - {position_m: [0.2, 0.5], altitude_m: 1.3, after: 1}",
        "  - {position_m: [0.0, -0.5], altitude_m: 0.8, after: 2}",
    )  # fmt: skip


def test_a_waypoint_sets_the_altitude_and_the_begin_of_later_legs(between_collisions: Mission) -> None:
    loaded = between_collisions
    assert [loaded.altitude_at(n) for n in (0, 1, 2)] == [1.0, 1.3, 0.8]
    assert [loaded.place_before(n) for n in (0, 1, 2)] == [(0.0, 0.0), (0.2, 0.5), (0.0, -0.5)]


@pytest.mark.rest
def test_collisions_after_a_waypoint_are_flown_at_its_altitude(between_collisions: Mission) -> None:
    log = fly_mission(between_collisions)
    hit = ["transit", "prepare", "approach", "contact", "recovery", "waypoint"]
    assert phases(log) == [*AIR, *hit, *hit, *DOWN]
    heights = [p.position_mission[2] for p in all_of(log, ImpactPeak) if isinstance(p, ImpactPeak)]
    assert heights == pytest.approx([1.0, 1.3], abs=0.08)
    assert not all_of(log, PlanRequest)  # no plan leads to a waypoint
    # Both recoveries use the paper's setpoints at the altitude of their collision.
    recoveries = [s for s in all_of(log, Setpoint) if isinstance(s, Setpoint) and s.recovery]
    assert [-s.position_ned[2] for s in recoveries] == pytest.approx([1.0, 1.3], abs=0.01)
    verdict = verdict_of(log)
    assert verdict.outcome is Outcome.COMPLETED
    assert (verdict.goal_miss_m, verdict.plan_followed) == (None, True)
    assert "goal miss, m" not in [d.what for d in verdict.deviations]


@pytest.mark.rest
def test_a_rehearsal_includes_the_waypoints() -> None:
    loaded = mission(
        WALL + "collisions:", f"  - {HIT}", "waypoints:", "  - {position_m: [0.3, 0.3]}",
        "  - {position_m: [0.2, 0.5], after: 1}",
    )  # fmt: skip
    log = fly_mission(msgspec.structs.replace(loaded, standoff_m=0.5))
    hit = ["transit", "prepare", "approach", "recovery", "waypoint"]
    assert phases(log) == [*AIR, "waypoint", *hit, *DOWN]


class OperatedFlight:
    """A flight whose operator sends one request in a phase."""

    def __init__(self, loaded: Mission, phase: str, request: Request) -> None:
        self.builder, self._phase, self._request = VerdictBuilder(loaded), phase, request
        self.changes: list[PhaseChange] = []
        self.flight = FastFlight(loaded, 1, observe=self._observe)

    def _observe(self, record: Record, _: int) -> None:
        self.builder.add(record)
        if isinstance(record, PhaseChange):
            self.changes.append(record)

    def fly(self) -> None:
        assert self.flight.lock is not None
        self.flight.lock.start()
        sent = False
        while self.flight.core.end is None and self.flight.autopilot.now_s < 60.0:
            self.flight.tick()
            if not sent and self.flight.core.phase == self._phase:
                sent = True
                request: Input = OperatorRequest(self.flight.host_us, self._request)
                self.flight.step(request)


def with_silent_operator(loaded: Mission) -> Mission:
    simulation = msgspec.structs.replace(loaded.vehicle.simulation, operator_s=None)
    return msgspec.structs.replace(
        loaded, vehicle=msgspec.structs.replace(loaded.vehicle, simulation=simulation)
    )


PAUSE = "waypoints: [{pause: operator, timeout_s: 3.0}]"


def test_a_pause_without_a_request_ends_with_a_landing() -> None:
    """A request to continue before the pause has no effect."""
    too_soon = OperatedFlight(with_silent_operator(mission(PAUSE)), "climb", Request.CONTINUE)
    too_soon.fly()
    assert "pause" in [c.after.value for c in too_soon.changes]
    verdict = too_soon.builder.build(None, None)
    assert verdict.outcome is Outcome.ABORTED
    assert verdict.reason == "pause_timeout: the operator did not resume within 3 s"
    assert [(g.rule, g.action) for g in verdict.guard] == [("pause_timeout", "land")]
    assert verdict.flight_time_s is not None


def test_a_land_request_ends_a_pause() -> None:
    stopped = OperatedFlight(with_silent_operator(mission(PAUSE)), "pause", Request.LAND)
    stopped.fly()
    verdict = stopped.builder.build(None, None)
    assert (verdict.reason or "").startswith("operator:")


@pytest.mark.parametrize(
    ("fault", "rule"), [("low-battery@pause", "battery"), ("imu-dropout@waypoint", "imu_silent")]
)
def test_the_guard_monitors_waypoints_and_pauses(fault: str, rule: str) -> None:
    loaded = mission("waypoints:", "  - {position_m: [1.0, 0.0]}", "  - {pause: operator}")
    verdict = fly_fast(loaded, 1, None, fault=parse_fault(fault))
    assert verdict.guard[0].rule == rule


WRONG = [
    ("waypoints: [{position_m: [9, 0]}]", "waypoints[0].position_m: (9, 0) is outside bounds_m"),
    (
        "waypoints: [{position_m: [0, 0], altitude_m: 5}]",
        "waypoints[0].altitude_m: must be within bounds_m z",
    ),
    ("waypoints: [{position_m: [0, 0], speed_m_s: 3.5}]", "waypoints[0].speed_m_s: 3.5 m/s exceeds limits"),
    (
        "waypoints: [{hold_s: 1}]",
        "waypoints[0]: give exactly one key: position_m or at_wall for a waypoint, or pause",
    ),
    ("waypoints: [{position_m: [0, 0], pause: operator}]", "waypoints[0]: give exactly one key"),
    ("waypoints: [{pause: operator, hold_s: 1}]", "waypoints[0].hold_s: a pause cannot have this key"),
    (
        "waypoints: [{position_m: [0, 0], timeout_s: 9}]",
        "waypoints[0].timeout_s: a waypoint cannot have this key",
    ),
    ("waypoints: [{pause: pilot}]", "waypoints[0].pause: 'pilot' is not allowed, only: operator"),
    ("waypoints: [{pause: operator, after: 1}]", "waypoints[0].after: 1, expected 0 to 0"),
    ("waypoints: [{pause: operator, timeout_s: 0}]", "waypoints[0].timeout_s: "),
    (WALL + "waypoints: [{position_m: [1.8, 0]}]", "waypoints[0].position_m: is in or behind wall acrylic"),
    (
        f"{WALL}collisions: [{HIT}]\nwaypoints: [{{pause: operator, after: 1}}, {{pause: operator}}]",
        "waypoints[1].after: 0, expected 1 to 1",
    ),
    (
        f"{WALL}collisions: [{HIT}, {{wall: acrylic, mode: rigid, alpha_m_per_n: [0.02, 0.02]}}]\n"
        "waypoints: [{position_m: [0, 0], after: 1}]",
        "collisions[1]: needs an approach: the recovery from the previous collision leads to waypoints[0]",
    ),
]


@pytest.mark.parametrize(("lines", "problem"), WRONG, ids=[problem for _, problem in WRONG])
def test_wrong_waypoints_are_refused_with_their_line(lines: str, problem: str) -> None:
    with pytest.raises(InputError) as error:
        mission(lines)
    assert re.match(r"mission\.yaml:\d+: ", str(error.value))
    assert problem in str(error.value)


BOARD = "  board: {{point_m: {}, normal: [0.0, -1.0], length_m: {}, material: wood}}\n"


def findings(loaded: Mission) -> dict[str, CheckFinding]:
    return {finding.item: finding for finding in check_mission(loaded)}


def test_a_wall_between_waypoints_is_reported_before_the_flight() -> None:
    walls = WALL + BOARD.format([1.0, 0.6], 0.8)
    with pytest.raises(InputError, match="wall board blocks the path to waypoint 2"):
        mission(f"{walls}waypoints: [{{position_m: [1.0, 0.0]}}, {{position_m: [1.0, 1.2]}}]")
    loaded = load_mission("mission.yaml")
    with pytest.raises(NoApproachError):
        FlightCore(loaded)
    found = findings(loaded)["waypoints"]
    assert (found.go, found.message) == (False, "wall board blocks the path to waypoint 2")
    # A detour around the wall, and back the same way.
    left = "{position_m: [0.0, 1.2]}"
    around = mission(f"{walls}waypoints: [{left}, {{position_m: [1.0, 1.2]}}, {left}]")
    assert findings(around)["waypoints"].go


def test_check_reports_blocked_legs_after_a_recovery_and_unreachable_speeds() -> None:
    loaded = mission(
        f"{WALL}{BOARD.format([1.2, 1.6], 1.0)}collisions: [{HIT}]",
        "waypoints:",
        "  - {position_m: [1.2, 2.2], after: 1}",
        "  - {position_m: [0.0, 2.2], speed_m_s: 2.5, after: 1}",
    )
    found = findings(loaded)
    assert not found["recovery_1"].go
    assert "wall board blocks the path to waypoint 1" in found["recovery_1"].message
    assert found["waypoint_speed"].remark


def test_check_and_guard_agree_on_a_fast_leg_near_the_bounds() -> None:
    """Both compare the bounds with the point at which the vehicle could stop."""
    loaded = mission(
        "waypoints:",
        "  - {position_m: [-2.0, 0.0], speed_m_s: 2.0}",
        "  - {position_m: [2.2, 0.0], speed_m_s: 2.5}",
    )
    verdict = fly_fast(loaded, 1, None)
    assert findings(loaded)["path"].go == (verdict.outcome is Outcome.COMPLETED)


@pytest.mark.parametrize("name", ["hover", "square", "transit"])
def test_the_packaged_missions_pass_check(name: str) -> None:
    loaded = load_flyable(packaged("missions", f"{name}.yaml"), DART)
    assert all(finding.go for finding in check_mission(loaded))


def test_the_transit_mission_completes_at_its_speed() -> None:
    loaded = load_flyable(packaged("missions", "transit.yaml"), DART)
    records: list[Record] = []
    verdict = fly_fast(loaded, 1, None, records.append)
    assert (verdict.outcome, verdict.guard) == (Outcome.COMPLETED, [])
    speeds = [abs(r.velocity_ned[0]) for r in records if isinstance(r, Setpoint) and r.velocity_ned]
    assert max(speeds) == pytest.approx(1.5, rel=0.02)
