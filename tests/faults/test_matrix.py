"""A sample of the fault matrix and of random faults, flown in the fast world without loss of control.

The campaign `faults` flies the whole matrix, and `faults_random` thousands of random faults
(`docs/results/fault_matrix.md`).
"""

import random
import re
from pathlib import Path

import pytest

from dart_flight.base.records import GuardEvent, Outcome, Override, Record, StatusSample
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.run.fast import FastFlight, fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.faults.fault_table import KINDS, Fault, FaultSite, parse_fault
from dart_flight.sim.faults.impairment import Impairment, LossyLink
from tests.faults.expected import expected_outcomes
from tests.faults.fault_flights import (
    CELLS,
    ON_GROUND,
    PHASES,
    ROWS,
    FaultFlight,
    cell_fault,
    fly_fault,
    random_fault,
)

ROOT = Path(__file__).parents[2]
SINGLE = ROOT / "missions/paper_single_wall.yaml"
CHANCE = random.Random(61)
# One cell of each site of a fault; `make test-rest` flies another sample, the campaign all cells.
BY_SITE = [
    CHANCE.choice([(name, phase) for name, phase in CELLS if cell_fault(name, phase).kind.site is site])
    for site in FaultSite
]
OTHERS = CHANCE.sample(sorted(set(CELLS) - set(BY_SITE)), 2)
LANDS_AT_A_WALL = ("delay=1000", "recovery")  # PX4's failsafe lands 20 cm in front of the second wall
DUAL = ROOT / "missions/paper_dual_collision.yaml"
IN_AIR = [phase for phase in PHASES if phase != ON_GROUND]


def fly_cell(fault: str, phase: str) -> FaultFlight:
    return fly_fault(load_flyable(DUAL), cell_fault(fault, phase), 1)


def test_the_table_of_expected_outcomes_has_every_cell() -> None:
    assert set(expected_outcomes()) == set(CELLS)
    assert {kind.name for kind in KINDS} <= set(ROWS)


@pytest.mark.parametrize(
    ("fault", "phase"),
    [*BY_SITE, LANDS_AT_A_WALL, *(pytest.param(*cell, marks=pytest.mark.rest) for cell in OTHERS)],
)
def test_a_cell_has_an_expected_outcome(fault: str, phase: str) -> None:
    flown = fly_cell(fault, phase)
    assert not flown.problems
    assert flown.came_of in expected_outcomes()[fault, phase]


@pytest.mark.parametrize("delay_ms", [100, 300, 1000, 2000])
def test_late_telemetry_prevents_arming(delay_ms: float) -> None:
    flight = FastFlight(load_flyable(SINGLE), 1, fault=Fault("delay", delay_ms))
    while flight.core.end is None:
        flight.tick()
        assert not flight.autopilot.armed
    reason = flight.core.end.reason or ""
    found = re.fullmatch(
        r"telemetry_late_ground: telemetry arrives "
        r"(\d+) ms after sampling, limit 75 ms, round trip (\d+) ms",
        reason,
    )
    assert found, reason
    assert int(found[1]) == pytest.approx(delay_ms, abs=5)
    assert int(found[2]) == pytest.approx(2 * delay_ms, abs=10)


@pytest.mark.rest
def test_a_flight_with_random_faults_stays_controlled() -> None:
    """tools/campaigns/faults_random.yaml flies thousands."""
    flown = fly_fault(*random_fault(7), 7)
    assert not flown.problems, flown


@pytest.mark.parametrize("phase", ["approach", pytest.param("recovery", marks=pytest.mark.rest)])
def test_an_imu_dropout_leads_to_a_decision_within_100_ms(phase: str) -> None:
    flown = fly_cell("imu-dropout", phase)
    assert flown.decision_ms is not None
    assert flown.decision_ms <= 100.0


# The clock of the second vehicle is ahead, behind and equal; the campaign flies it in every phase.
@pytest.mark.parametrize(
    ("phase", "ahead_s"),
    [
        *zip(IN_AIR[:3], (238.0, -238.0, 0.0), strict=True),
        pytest.param("landing", 238.0, marks=pytest.mark.rest),
    ],
)
def test_a_second_vehicle_on_the_link_is_reported_within_100_ms(phase: str, ahead_s: float) -> None:
    events: list[GuardEvent] = []

    def observe(record: Record, number: int) -> None:
        if isinstance(record, GuardEvent):
            events.append(record)

    flight = FastFlight(
        load_flyable(SINGLE), 1, observe=observe, fault=Fault("second-vehicle", ahead_s, phase)
    )
    assert flight.faulted is not None
    while flight.core.override is not Override.LAND:
        flight.tick()
        began_us = flight.faulted.began_us
        assert began_us is None or flight.host_us - began_us < 100_000
    assert events[-1].rule == "second_vehicle"
    assert re.match(
        "two clocks alternate, 238.0 s|two positions alternate in the odometry, [45]", events[-1].detail
    )


def test_a_flight_beside_a_second_vehicle_ends_only_after_its_own_landing() -> None:
    """The second vehicle is disarmed throughout and must not end the landing."""
    flight = FastFlight(load_flyable(SINGLE), 1, fault=Fault("second-vehicle", 0.0, "landing"))
    flight.run()
    assert not flight.autopilot.armed
    assert flight.core.end is not None
    assert flight.core.end.outcome is Outcome.ABORTED
    assert (flight.core.end.reason or "").startswith("second_vehicle: ")


@pytest.mark.parametrize("ahead_s", [238.0, -238.0, 3.0, 0.0])
def test_a_second_vehicle_on_the_link_prevents_takeoff(ahead_s: float) -> None:
    verdict = fly_fast(load_flyable(SINGLE), 1, None, fault=Fault("second-vehicle", ahead_s))
    assert (verdict.reason or "").startswith("second_vehicle_ground: ")


def test_a_pilot_takeover_silences_the_core_within_4_ms() -> None:
    """Silence follows in the same step as the sample that shows the mode change."""
    records: list[Record] = []
    fly_fast(load_flyable(SINGLE), 1, None, records.append, fault=Fault("pilot", 0.0, "approach"))
    shown_us = next(r.t_us for r in records if isinstance(r, StatusSample) and r.flight_mode == "manual")
    silenced_us = next(r.t_us for r in records if isinstance(r, GuardEvent))
    assert 0 <= silenced_us - shown_us <= 4000
    after = [r.topic for r in records if getattr(r, "t_us", 0) > silenced_us]
    assert not [topic for topic in after if topic in ("/out/setpoint", "/out/command", "/out/lock")]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("hangs", "unknown fault"),
        ("pilot@lunch", "unknown phase"),
        ("delay=soon", "not a number"),
        ("delay=1e9", "0 to 2000 ms"),
        ("pilot=3", "no value"),
    ],
)
def test_an_invalid_fault_is_rejected_with_its_cause(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_fault(text)
    assert main(["dry-run", str(SINGLE), "--fast", "--fault", text]) == 2


def test_a_fault_is_parsed_with_its_value_and_phase() -> None:
    assert parse_fault("packet-loss=5@contact") == Fault("packet-loss", 5.0, "contact")
    assert parse_fault("gust") == Fault("gust", 5.0, None)


def test_a_lossy_link_loses_delays_duplicates_and_reorders() -> None:
    def send_through(impairment: Impairment) -> tuple[list[int], list[int]]:
        link: LossyLink[int] = LossyLink(1)
        link.impairment = impairment
        arrived = []
        for i in range(2000):
            link.push(i * 0.004, i)
            arrived += link.pop(i * 0.004)
        return arrived, link.pop(1e9)

    assert send_through(Impairment()) == (list(range(2000)), [])
    lost, _ = send_through(Impairment(loss=0.1))
    assert 150 < 2000 - len(lost) < 250
    late, rest = send_through(Impairment(delay_s=0.1))
    assert late + rest == list(range(2000))
    assert len(rest) == 25
    twice, _ = send_through(Impairment(duplicate=0.5))
    assert 900 < len(twice) - 2000 < 1100
    mixed, rest = send_through(Impairment(reorder=0.1))
    assert sorted(mixed + rest) == list(range(2000))
    assert mixed != sorted(mixed)
    assert send_through(Impairment(down=True)) == ([], [])
