"""A vehicle that is heavier or lighter than its configuration is stopped before the first wall."""

from __future__ import annotations

import msgspec
import pytest

from dart_flight.base.records import Outcome
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.recording.verdict import VerdictBuilder
from dart_flight.run.fast import FastFlight
from dart_flight.sim.draws import DrawnWorld


@pytest.mark.parametrize(
    ("configured_kg", "flown_kg", "stopped"),
    [
        (1.3, 1.85, True),
        (1.3, 0.8, True),
        *(pytest.param(*case, marks=pytest.mark.rest) for case in ((1.3, 1.45, False), (1.3, 1.2, False))),
    ],
)
def test_a_wrong_mass_aborts_the_flight_before_the_wall(
    configured_kg: float, flown_kg: float, stopped: bool
) -> None:
    mission = load_mission(packaged("missions", "single_wall.yaml")).replace(
        {"vehicle.airframe.mass_kg": configured_kg}
    )
    true = mission.replace({"vehicle.airframe.mass_kg": flown_kg})
    builder = VerdictBuilder(mission)
    FastFlight(
        mission, 1, observe=lambda record, _: builder.add(record), world=DrawnWorld(true, None, {})
    ).run()
    verdict = builder.build(None, None)
    assert [event.rule for event in verdict.guard] == ["hover_thrust"] * stopped
    assert (verdict.outcome is Outcome.COMPLETED) == (not stopped)
    if stopped:
        assert all(collision.truth is None for collision in verdict.collisions), "no wall was hit"
        estimated_kg = float(msgspec.to_builtins(verdict)["reason"].split(" kg")[0].split()[-1])
        assert estimated_kg == pytest.approx(flown_kg, rel=0.03)
