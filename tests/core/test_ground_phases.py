"""The commands of the phases on the ground depend on how long a phase has lasted, to the microsecond."""

from __future__ import annotations

import pytest

from dart_flight.base.records import LandedState, MissionEnd, StatusSample, VehicleAction
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.ground_phases import _DISARM_AFTER_US, _STREAMING_US, GroundPhases
from dart_flight.core.mission.mission_progress import MissionProgress
from dart_flight.core.mission.phases import DOWN_US
from dart_flight.core.sense.state import FlightState

MISSION = load_mission(packaged("missions", "paper_single_wall.yaml"))
BEGAN_US = 20_000_000


def after(elapsed_us: int, armed: bool = False) -> tuple[MissionProgress, FlightState]:
    """Return the states `elapsed_us` after the beginning of a phase, on the ground."""
    progress, state = MissionProgress(MISSION, {}), FlightState()
    progress.entered_us, progress.entered_host_us = BEGAN_US, BEGAN_US
    t_us = BEGAN_US + elapsed_us
    state.now_us = state.host_us = t_us
    state.update_status(StatusSample(t_us, t_us, armed=armed, landed=LandedState.ON_GROUND))
    return progress, state


@pytest.mark.parametrize(
    ("elapsed_us", "action"), [(0, None), (_STREAMING_US, None), (_STREAMING_US + 1, VehicleAction.OFFBOARD)]
)
def test_offboard_is_requested_once_setpoints_have_streamed_for_a_while(
    elapsed_us: int, action: VehicleAction | None
) -> None:
    assert GroundPhases(MISSION).enter_offboard(*after(elapsed_us)).action is action


@pytest.mark.parametrize(
    ("elapsed_us", "action"),
    [
        (0, VehicleAction.LAND),
        (_DISARM_AFTER_US, VehicleAction.LAND),
        (_DISARM_AFTER_US + 1, VehicleAction.DISARM),
    ],
)
def test_a_vehicle_that_px4_does_not_disarm_is_disarmed_after_a_while(
    elapsed_us: int, action: VehicleAction
) -> None:
    assert GroundPhases(MISSION).land(*after(elapsed_us, armed=True)).action is action


@pytest.mark.parametrize(("down_us", "ends"), [(DOWN_US - 1, False), (DOWN_US, True)])
def test_the_mission_ends_when_the_vehicle_has_been_down_for_a_while(down_us: int, ends: bool) -> None:
    progress, state = after(1_000_000)
    progress.down_us = state.now_us - down_us
    assert isinstance(GroundPhases(MISSION).land(progress, state).end, MissionEnd) is ends
