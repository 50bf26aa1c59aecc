"""Chosen cells of the fault matrix through real MAVSDK, in real time if the fault concerns timing."""

from collections.abc import Collection, Sequence
from pathlib import Path

import pytest

from dart_flight.base.records import GuardEvent, ImuSample, Setpoint, Silence, StatusSample, VehicleCommand
from dart_flight.recording.reader import read_log
from dart_flight.run.embedded import fly_embedded
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.faults.fault_table import Fault, parse_fault
from dart_flight.sim.pipe import FULL_SPEED
from tests.faults.expected import expected_outcomes
from tests.faults.fault_flights import ROWS
from tests.real_time import assert_below, rule_of
from tests.shared_flights import PATIENT

ROOT = Path(__file__).parents[2]
NEAR = ROOT / "tests/data/near_wall.yaml"


def fly_with_fault(text: str, folder: Path, settings: Sequence[str] = ()) -> tuple[str, list[object], Fault]:
    """Fly with a fault and return outcome, records and fault; in real time if the fault needs it."""
    fault = parse_fault(text)
    speed = 1.0 if fault.kind.needs_real_time else FULL_SPEED
    verdict = fly_embedded(load_flyable(NEAR, settings=settings), 1, folder, fault=fault, speed=speed)
    assert verdict.log is not None
    log = read_log(next(folder.glob("*/flight.mcap")))
    outcome = "completed" if verdict.outcome == "completed" else (verdict.reason or "").split(":")[0]
    return outcome, [e.record for e in log.entries], fault


def assert_outcome(outcome: str, allowed: Collection[str]) -> None:
    """Assert an outcome; a rule about lateness that is not expected counts as too slow."""
    assert outcome in allowed, rule_of(outcome)


@pytest.mark.mavlink
@pytest.mark.parametrize(
    "text",
    [
        pytest.param("servo-unplugged@approach", marks=pytest.mark.rest),
        *(
            pytest.param(text, marks=pytest.mark.realtime)
            for text in ("packet-loss=10@take-off", "link-loss@recovery", "delay=1000@approach")
        ),
    ],
)
def test_a_cell_flown_through_mavsdk_has_an_expected_outcome(text: str, tmp_path: Path) -> None:
    outcome, records, fault = fly_with_fault(
        text, tmp_path, PATIENT if parse_fault(text).kind.needs_real_time else ()
    )
    row = text.partition("@")[0]
    assert_outcome(outcome, expected_outcomes()[row if row in ROWS else fault.name, str(fault.phase)])
    if outcome != "completed":
        assert outcome in [r.rule for r in records if isinstance(r, GuardEvent)]


@pytest.mark.realtime
@pytest.mark.mavlink
def test_an_imu_dropout_leads_to_a_decision_within_100_ms(tmp_path: Path) -> None:
    outcome, records, _ = fly_with_fault("imu-dropout@approach", tmp_path)
    assert_outcome(outcome, ["imu_silent"])
    event = next(i for i, r in enumerate(records) if isinstance(r, GuardEvent))
    last = max(r.received_us for r in records[:event] if isinstance(r, ImuSample))
    newest = max(getattr(r, "received_us", 0) for r in records[: event + 1])
    assert_below(100.0, 1e-3 * (newest - last), "decision after the last IMU sample, ms")


@pytest.mark.rest
@pytest.mark.mavlink
def test_a_pilot_takeover_silences_the_app_within_100_ms(tmp_path: Path) -> None:
    outcome, records, _ = fly_with_fault("pilot@approach", tmp_path)
    assert outcome == "pilot"
    shown = next(r for r in records if isinstance(r, StatusSample) and r.flight_mode == "manual")
    silence = next(r for r in records if isinstance(r, Silence))
    assert silence.t_us - shown.t_us <= 100_000
    after = records[records.index(silence) :]
    assert not [r for r in after if isinstance(r, Setpoint | VehicleCommand)]
