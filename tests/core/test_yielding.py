"""Yielding to a contact: the setpoints during it, and the compensation of PX4's D term."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import patch

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import MissionFrame, Vec3, norm, tilt_of
from dart_flight.base.records import (
    AttitudeSample,
    ForceEstimate,
    ImpactOnset,
    ImpactPeak,
    OdometrySample,
    Phase,
    PhaseChange,
    Record,
    Setpoint,
)
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import load_vehicle
from dart_flight.core.mission import executive
from dart_flight.core.mission.contact_feedforward import (
    _FADED_M_S2,
    _LARGEST_M_S2,
    LONGEST_S,
    ContactFeedforward,
)
from dart_flight.core.mission.heading import Heading
from dart_flight.core.mission.mission_progress import MissionProgress
from dart_flight.core.mission.setpoint_selection import SetpointSelection
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState
from dart_flight.run.fast import FastFlight
from tests.core.conftest import HandFedCore, known, of_kind

ROOT = Path(__file__).parents[2]
VEHICLE = load_vehicle(ROOT / "configs" / "dart.yaml")
TICK_US = 4000
CUTOFF_HZ = 5.0


def sensed(n: int, force: tuple[float, float], in_contact: bool) -> Sensed:
    return Sensed(ForceEstimate(n * TICK_US, (force[0], force[1], 0.0), False), (), in_contact)


@given(st.floats(5.0, 80.0), st.floats(-math.pi, math.pi), st.integers(4, 40))
def test_the_feedforward_cancels_the_response_of_the_d_term_to_a_half_sine(
    peak_n: float, direction: float, samples: int
) -> None:
    """PX4's filtered derivative of the velocity in the contact, times the D gain, is fed forward."""
    feedforward, derivative = ContactFeedforward(VEHICLE), 0.0
    gain, mass = VEHICLE.px4.mpc_xy_vel_d_acc, VEHICLE.airframe.mass_kg
    share = 1.0 - math.exp(-2.0 * math.pi * CUTOFF_HZ * TICK_US * 1e-6)
    feedforward.update(sensed(0, (0.0, 0.0), False))
    for n in range(1, samples + 60):
        in_contact = n <= samples
        force = peak_n * math.sin(math.pi * n / (samples + 1)) if in_contact else 0.0
        feedforward.update(sensed(n, (force * math.cos(direction), force * math.sin(direction)), in_contact))
        derivative += share * (force / mass - derivative)
        fed = feedforward.feed_forward or (0.0, 0.0, 0.0)
        expected = min(_LARGEST_M_S2, gain * derivative)
        assert norm(fed) == pytest.approx(expected, abs=0.01)
        if norm(fed) > 0.1:
            assert math.atan2(fed[1], fed[0]) == pytest.approx(direction, abs=1e-6)
    assert norm(feedforward.feed_forward or (0.0, 0.0, 0.0)) < 0.1 * max(expected, 1.0)
    for n in range(samples + 60, samples + 160):
        feedforward.update(sensed(n, (0.0, 0.0), False))
    assert feedforward.feed_forward is None


def test_nothing_is_fed_forward_without_a_contact() -> None:
    feedforward = ContactFeedforward(VEHICLE)
    for n in range(50):
        feedforward.update(sensed(n, (30.0, 0.0), False))
    assert feedforward.feed_forward is None


def test_the_feedforward_stays_bounded_over_a_gap_in_the_samples() -> None:
    feedforward = ContactFeedforward(VEHICLE)
    feedforward.update(sensed(0, (0.0, 0.0), True))
    feedforward.update(sensed(10_000, (4000.0, 0.0), True))
    assert norm(feedforward.feed_forward or (0.0, 0.0, 0.0)) == pytest.approx(_LARGEST_M_S2)


def test_the_feedforward_ends_once_little_of_the_contact_is_left() -> None:
    """The acceleration decays from 1 m/s2 with the time constant of PX4's filter."""
    feedforward, mass = ContactFeedforward(VEHICLE), VEHICLE.airframe.mass_kg
    for n in range(500):
        feedforward.update(sensed(n, (mass, 0.0), True))
    fades = math.ceil(math.log(1.0 / _FADED_M_S2) / (2.0 * math.pi * CUTOFF_HZ * TICK_US * 1e-6))
    for n in range(500, 499 + fades):
        feedforward.update(sensed(n, (0.0, 0.0), False))
    assert feedforward.feed_forward is not None
    feedforward.update(sensed(499 + fades, (0.0, 0.0), False))
    assert feedforward.feed_forward is None


def test_the_vehicles_motion_is_commanded_for_a_limited_time_of_a_contact() -> None:
    """PX4 keeps the last setpoint, so the motion is not commanded for longer than a contact lasts."""
    c = HandFedCore(rules=())
    c.fly_to_wood()
    c.hide_peaks()
    c.force_ned = (-10.0, -16.0, 0.0)
    c.run(0.02)
    began_us = next(o.t_us for o in c.outputs if isinstance(o, PhaseChange) and o.after is Phase.CONTACT)
    out = c.run(LONGEST_S + 0.1)
    commanded = [o.t_us for o in out if isinstance(o, Setpoint) and o.velocity_ned is not None]
    assert c.core.phase is Phase.CONTACT
    assert max(commanded) - began_us == pytest.approx(1e6 * LONGEST_S, abs=8_000)


class _NoFeedforward(ContactFeedforward):
    """A feedforward that is always empty."""

    def update(self, sensed: Sensed) -> None:
        pass


class _SilentInContact(SetpointSelection):
    """A selection that sends no setpoint in a contact until the peak."""

    def setpoint(
        self,
        sample: OdometrySample,
        progress: MissionProgress,
        state: FlightState,
        frame: MissionFrame,
        added: Vec3 | None,
    ) -> tuple[Setpoint | None, Heading]:
        if progress.phase is Phase.CONTACT:
            return None, progress.heading
        return super().setpoint(sample, progress, state, frame, added)


def flight_records(mission: Mission, yields: bool) -> list[Record]:
    records: list[Record] = []
    with ExitStack() as patched:
        if not yields:
            patched.enter_context(patch.object(executive, "ContactFeedforward", _NoFeedforward))
            patched.enter_context(patch.object(executive, "SetpointSelection", _SilentInContact))
        FastFlight(mission, 3, observe=lambda r, n: records.append(r)).run()
    return records


@pytest.fixture(scope="module")
def flights() -> dict[bool, list[Record]]:
    mission = load_mission(ROOT / "missions" / "paper_single_wall.yaml")
    return {yields: flight_records(mission, yields) for yields in (True, False)}


def in_contact(records: list[Record]) -> list[Record]:
    phase, kept = Phase.READYING, []
    for record in records:
        if isinstance(record, PhaseChange):
            phase = record.after
        elif phase is Phase.CONTACT:
            kept.append(record)
    return kept


def test_the_vehicles_own_motion_is_commanded_in_a_contact(flights: dict[bool, list[Record]]) -> None:
    assert not [r for r in in_contact(flights[False]) if isinstance(r, Setpoint) and not r.recovery]
    commanded = [r for r in in_contact(flights[True]) if isinstance(r, Setpoint) and not r.recovery]
    assert commanded
    for setpoint in commanded:
        assert known(setpoint.velocity_ned)[2] == pytest.approx(0.0)


def test_the_recovery_setpoint_is_the_same_with_and_without_yielding(
    flights: dict[bool, list[Record]],
) -> None:
    """Both flights are the same up to the onset; the peaks differ by the push of the loop after it."""
    first = [
        next(r for r in flights[yields] if isinstance(r, Setpoint) and r.recovery) for yields in (True, False)
    ]
    peaks = [of_kind(ImpactPeak, flights[yields])[0] for yields in (True, False)]
    for a, b in zip(first[0].position_ned, first[1].position_ned, strict=True):
        assert a == pytest.approx(b, abs=0.05)
    assert peaks[0].normal_force_n == pytest.approx(peaks[1].normal_force_n, rel=0.05)
    assert first[0].acceleration_ned is not None
    assert first[1].acceleration_ned is None


def test_yielding_reduces_the_tilt_after_the_hit(flights: dict[bool, list[Record]]) -> None:
    def tilt_after(records: list[Record]) -> float:
        onset = next(r.t_us for r in records if isinstance(r, ImpactOnset))
        return max(
            tilt_of(r.q_frd_to_ned)
            for r in records
            if isinstance(r, AttitudeSample) and onset < r.t_us < onset + 300_000
        )

    assert tilt_after(flights[True]) < 0.75 * tilt_after(flights[False])
