"""Pace of the core: inputs are stepped at once if a contact is possible, and in batches otherwise."""

from __future__ import annotations

from collections import Counter
from typing import cast

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from dart_flight.base.records import ContactEnd, ImpactOnset, ImpactPeak, Input, OdometrySample, Phase
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.flight_core import FlightCore
from dart_flight.core.pace import _LEAD_S, BATCH_S, Pace, pace_near_walls
from dart_flight.core.sense.state import FlightState
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import read_log
from dart_flight.recording.schema import INPUTS
from dart_flight.run.core_thread import _TICK_S
from dart_flight.run.prepare import load_flyable
from tests.shared_flights import SharedFlights

SINGLE_WALL = load_flyable(packaged("missions", "paper_single_wall.yaml"), packaged("configs", "dart.yaml"))
DUAL_COLLISION = load_flyable(
    packaged("missions", "paper_dual_collision.yaml"), packaged("configs", "dart.yaml")
)
WHILE_FLYING = [
    Phase.CLIMB,
    Phase.WAYPOINT,
    Phase.TRANSIT,
    Phase.PREPARE,
    Phase.APPROACH,
    Phase.RECOVERY,
    Phase.OVERRULED,
]


def state_at(mission: Mission, place: tuple[float, float], velocity: tuple[float, float]) -> FlightState:
    state = FlightState()
    state.anchor(mission.frame_at((0.0, 0.0, 0.0)))
    ned = mission.frame_at((0.0, 0.0, 0.0))
    state.update_odometry(
        OdometrySample(8000, 8000, ned.point_to_ned((*place, 1.0)), ned.vector_to_ned((*velocity, 0.0)))
    )
    return state


@given(
    wall=st.sampled_from(DUAL_COLLISION.walls),
    distance_m=st.floats(-0.5, 1.5),
    along_m=st.floats(-2.0, 2.0),
    velocity=st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0)),
    phase=st.sampled_from(WHILE_FLYING),
)
def test_inputs_are_stepped_at_once_if_a_contact_is_possible_soon(
    wall: Wall, distance_m: float, along_m: float, velocity: tuple[float, float], phase: Phase
) -> None:
    """A contact is possible from `wall_early_m` before a wall to `wall_overrun_m` behind it."""
    (nx, ny), (tx, ty) = wall.normal, wall.tangent
    place = (wall.point[0] + distance_m * nx + along_m * tx, wall.point[1] + distance_m * ny + along_m * ty)
    guard, possible = DUAL_COLLISION.vehicle.guard, False
    for one in DUAL_COLLISION.walls:
        closing_m_s = max(0.0, -(velocity[0] * one.normal[0] + velocity[1] * one.normal[1]))
        away_m = one.signed_distance(place)
        assume(abs(away_m - guard.wall_early_m - _LEAD_S * closing_m_s) > 1e-9)
        assume(abs(away_m + guard.wall_overrun_m) > 1e-9)
        possible |= -guard.wall_overrun_m < away_m < guard.wall_early_m + _LEAD_S * closing_m_s
    pace = pace_near_walls(DUAL_COLLISION, state_at(DUAL_COLLISION, place, velocity), phase)
    assert pace is (Pace.IMMEDIATE if possible else Pace.BATCHED)
    assert pace_near_walls(DUAL_COLLISION, FlightState(), Phase.CONTACT) is Pace.IMMEDIATE


@pytest.mark.parametrize(
    "mission", ["paper_single_wall", pytest.param("paper_dual_collision", marks=pytest.mark.rest)]
)
def test_no_contact_of_a_flight_is_stepped_in_a_batch(flown: SharedFlights, mission: str) -> None:
    log = read_log(flown(mission, 3).log)
    core = FlightCore(flown_mission(log.about, "a flight"))
    paces: Counter[Pace] = Counter()
    contacts = 0
    for entry in log.entries:
        if not isinstance(entry.record, INPUTS):
            continue
        pace = core.pace
        paces[pace] += 1
        for output in core.step(cast(Input, entry.record)):
            if isinstance(output, ImpactOnset | ImpactPeak | ContactEnd):
                contacts += 1
                assert pace is Pace.IMMEDIATE  # the reply is sent on the thread that receives the sample
    assert contacts
    # During most of a flight, no contact is possible.
    assert paces[Pace.BATCHED] > 0.6 * paces.total()


def test_a_batch_lasts_one_tick_and_a_quarter_of_the_imu_timeout() -> None:
    assert BATCH_S == _TICK_S
    assert SINGLE_WALL.vehicle.guard.imu_timeout_s == pytest.approx(4.0 * BATCH_S)


def test_inputs_are_batched_on_the_ground() -> None:
    assert FlightCore(SINGLE_WALL).pace is Pace.BATCHED


@pytest.mark.parametrize("phase", list(Phase))
def test_inputs_far_from_every_wall_are_stepped_at_once_only_in_a_contact(phase: Phase) -> None:
    """In a contact the estimated position does not matter."""
    state = state_at(SINGLE_WALL, SINGLE_WALL.start, (0.0, 0.0))
    immediate = pace_near_walls(SINGLE_WALL, state, phase) is Pace.IMMEDIATE
    assert immediate is (phase is Phase.CONTACT)
