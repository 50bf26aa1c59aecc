"""Tuned limits stay in the range in which a flight works; the tests of each limit read its value."""

import pytest

from dart_flight.core.mission import anchors, commitment, course, executive, mission_state, wall_uncertainty


@pytest.mark.parametrize(
    ("module", "name", "above", "below"),
    [
        (anchors, "START_SD_M", 0.1, 1.0),
        (anchors, "WALL_SD_M", 0.005, 0.1),
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
        (wall_uncertainty, "SURE_SD", 2.0, 4.0),
        (wall_uncertainty, "_MIN_CLOSING_M_S", 0.02, 0.5),
    ],
)
def test_a_limit_is_in_its_useful_range(module: object, name: str, above: float, below: float) -> None:
    assert above < getattr(module, name) < below
