"""The exit velocity of a contact in the verdict: measured by odometry, and true in simulation."""

from __future__ import annotations

import pytest

import dart_flight
from dart_flight.base.records import ContactEnd, OdometrySample
from dart_flight.config.mission import load_mission
from dart_flight.recording.verdict import VerdictBuilder

SD_M_S = 0.06  # the measurement includes 20 ms of acceleration by the recovery


@pytest.mark.parametrize(
    "name", [("single_wall.yaml",), ("dual_collision.yaml",), ("rigid_cage", "single_wall.yaml")]
)
def test_measured_and_true_exit_velocities_agree(name: tuple[str, ...]) -> None:
    flight = dart_flight.simulate(dart_flight.packaged("missions", *name), seed=2)
    assert flight.verdict.collisions
    for hit in flight.verdict.collisions:
        assert hit.truth is not None
        assert hit.truth.normal_out_m_s is not None
        assert hit.truth.tangential_out_m_s is not None
        assert hit.measured.normal_out_m_s == pytest.approx(hit.truth.normal_out_m_s, abs=SD_M_S)
        assert hit.measured.tangential_out_m_s == pytest.approx(hit.truth.tangential_out_m_s, abs=SD_M_S)
        assert 0.0 < hit.truth.normal_out_m_s < -(hit.measured.normal_m_s or 0.0), "a wall adds no energy"


def test_exit_velocity_is_unknown_without_the_end_of_the_contact() -> None:
    """The log is cut during the contact, or its last odometry precedes the end of the contact."""
    mission = dart_flight.packaged("missions", "single_wall.yaml")
    log = dart_flight.simulate(mission, seed=2).log
    builder, ended = VerdictBuilder(load_mission(mission)), None
    for entry in log.entries:
        if ended is not None and isinstance(entry.record, OdometrySample) and entry.record.t_us >= ended:
            break
        builder.add(entry.record)
        if isinstance(entry.record, ContactEnd):
            ended = entry.record.t_us
    (hit,) = builder.build(None, None).collisions
    assert (hit.measured.normal_out_m_s, hit.measured.tangential_out_m_s) == (None, None)
    assert hit.contact_time_ms is not None
