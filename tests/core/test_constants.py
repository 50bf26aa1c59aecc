"""Tuned limits stay in the range in which a flight works; the tests of each limit read its value."""

from types import ModuleType

import pytest

from dart_flight.core.guard import (
    estimator_watch,
    heading_step,
    pose_watch,
    rules,
    second_vehicle,
    stream_watch,
)
from dart_flight.core.mission import (
    anchors,
    commitment,
    contact_feedforward,
    course,
    executive,
    mission_state,
    position_loop,
    replan_requests,
    wall_uncertainty,
)
from dart_flight.core.sense import senses, torque


@pytest.mark.parametrize(
    ("module", "name", "above", "below"),
    [
        # Positions and walls.
        (anchors, "START_SD_M", 0.1, 1.0),
        (anchors, "WALL_SD_M", 0.005, 0.1),
        (wall_uncertainty, "SURE_SD", 2.0, 4.0),
        (wall_uncertainty, "_MIN_CLOSING_M_S", 0.02, 0.5),
        (position_loop, "STOP_TIME_S", 0.2, 1.0),
        # Commitments, arrivals and phases.
        (commitment, "SETTLED_BEFORE_S", 0.0, 0.2),
        (commitment, "STOP_MARGIN_M", 0.0, 0.1),
        (course, "ARRIVED_M", 0.05, 0.3),
        (course, "ARRIVED_M_S", 0.05, 0.3),
        (course, "ARRIVED_S", 0.1, 1.0),
        (course, "_ARRIVED_YAW_RAD", 0.02, 0.2),
        (course, "_DRIFTING_NEAR", 1.5, 3.5),
        (course, "_DRIFTING_SLOW", 3.0, 5.0),
        (course, "_DRIFTING_TURNED", 1.0, 3.0),
        (executive, "_LEFT_SHARE", 0.2, 0.8),
        (executive, "_NOTHING_MET_S", 0.1, 1.0),
        (mission_state, "_SLOWEST", 2.0, 4.0),
        (contact_feedforward, "LONGEST_S", 0.1, 0.5),
        (replan_requests, "_LATER_S", 0.05, 0.5),
        (replan_requests, "_HELD_TO_M", 0.1, 0.5),
        (replan_requests, "_TRIES", 5, 7),
        # The guard.
        (estimator_watch, "ESTIMATOR_BAD_S", 0.1, 1.0),
        (estimator_watch, "RESET_POSITION_M", 0.02, 0.2),
        (estimator_watch, "RESET_VELOCITY_M_S", 0.1, 0.5),
        (estimator_watch, "VELOCITY_JUMP_M_S", 0.5, 2.5),
        (heading_step, "HEADING_STEP_DEG", 4.0, 6.0),
        (pose_watch, "APART_M", 0.1, 1.0),
        (pose_watch, "_APART_S", 0.2, 1.0),
        (pose_watch, "_APART_LATENCY_S", 0.05, 0.3),
        (pose_watch, "LATER_S", 0.02, 0.1),
        (pose_watch, "LOST_S", 0.2, 1.0),
        (pose_watch, "LOST_APPROACH_S", 0.1, 0.5),
        (pose_watch, "LOST_LAND_S", 0.5, 2.5),
        (pose_watch, "_GROUND_LOST_S", 1.0, 3.0),
        (rules, "ALTITUDE_TOLERANCE_M", 0.15, 0.5),
        (rules, "BATTERY_LOW_S", 0.0, 2.0),
        (rules, "IMU_CLIPPED_S", 0.2, 0.5),
        (rules, "IMU_STUCK_S", 0.05, 0.2),
        (rules, "LYING_S", 0.2, 1.0),
        (rules, "_ALTITUDE_SLACK_M", 0.0, 0.2),
        (rules, "_FALL_S", 0.05, 0.3),
        (rules, "_GUARD_STRAYS_M", 0.1, 0.5),
        (rules, "_SPEED_TOLERANCE", 1.0, 1.3),
        (rules, "_STALE_SAMPLES", 4, 6),
        (second_vehicle, "POSITION_JUMP_M", 0.2, 1.0),
        (second_vehicle, "_TURNS", 2, 4),
        (stream_watch, "ACTUATOR_TIMEOUT_S", 0.2, 1.0),
        (stream_watch, "LINK_LOST_S", 4.0, 6.0),
        (stream_watch, "STAMP_TOLERANCE_S", 0.2, 1.0),
        (stream_watch, "STATUS_TIMEOUT_S", 2.0, 4.0),
        # The senses.
        (senses, "IMPACT_WINDOW_S", 1.0, 3.0),
        (torque, "_MAX_SLOW_NM", 0.1, 1.0),
        (torque, "_NOISE_TIME_S", 0.2, 1.0),
        (torque, "_SLOW_S", 0.5, 2.0),
    ],
)
def test_a_limit_is_in_its_useful_range(module: ModuleType, name: str, above: float, below: float) -> None:
    assert above < getattr(module, name) < below
