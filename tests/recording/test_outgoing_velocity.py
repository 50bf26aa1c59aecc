"""The exit velocity of a contact in the verdict: measured by odometry, and true in simulation."""

from __future__ import annotations

import pytest

from dart_flight.base.records import ContactEnd, OdometrySample
from dart_flight.config.mission import Mission
from dart_flight.recording.reader import Log
from dart_flight.recording.verdict import VerdictBuilder
from tests.shared_flights import SharedFlights

SD_M_S = 0.06  # the measurement includes 20 ms of acceleration by the recovery


@pytest.mark.parametrize("name", ["single_wall", "paper_dual_collision", "rigid_cage/single_wall"])
def test_measured_and_true_exit_velocities_agree(name: str, flown: SharedFlights) -> None:
    verdict = flown(name, 1).verdict
    assert verdict.collisions
    for hit in verdict.collisions:
        assert hit.truth is not None
        assert hit.truth.normal_out_m_s is not None
        assert hit.truth.tangential_out_m_s is not None
        assert hit.measured.normal_out_m_s == pytest.approx(hit.truth.normal_out_m_s, abs=SD_M_S)
        assert hit.measured.tangential_out_m_s == pytest.approx(hit.truth.tangential_out_m_s, abs=SD_M_S)
        assert 0.0 < hit.truth.normal_out_m_s < -(hit.measured.normal_m_s or 0.0), "a wall adds no energy"


def test_exit_velocity_is_unknown_without_the_end_of_the_contact(flight: Log, single_wall: Mission) -> None:
    """The log is cut during the contact, or its last odometry precedes the end of the contact."""
    builder, ended = VerdictBuilder(single_wall), None
    for entry in flight.entries:
        if ended is not None and isinstance(entry.record, OdometrySample) and entry.record.t_us >= ended:
            break
        builder.add(entry.record)
        if isinstance(entry.record, ContactEnd):
            ended = entry.record.t_us
    (hit,) = builder.build(None, None).collisions
    assert (hit.measured.normal_out_m_s, hit.measured.tangential_out_m_s) == (None, None)
    assert hit.contact_time_ms is not None
