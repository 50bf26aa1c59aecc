"""Descriptions of the log's fields are derived from their names."""

import pytest

from dart_flight.recording.schema import describe


@pytest.mark.parametrize(
    ("name", "description"),
    [
        ("normal", "unit vector, mission frame"),
        ("normal_force_n", "N"),
        ("normal_in_m_s", "m/s"),
        ("torque_sigma_nm", "N m"),
        ("force_mission", "N; mission frame"),
    ],
)
def test_a_unit_suffix_takes_precedence_over_the_quantity(name: str, description: str) -> None:
    assert describe(name).startswith(description)
