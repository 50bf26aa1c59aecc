"""A chosen part of the fault matrix through real MAVSDK; in real time where the fault is about time."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from dart_flight.base.records import GuardEvent, ImuSample, Setpoint, Silence, StatusSample, VehicleCommand
from dart_flight.lab.campaign.fault_flights import ROWS
from dart_flight.recording.reader import read_log
from dart_flight.run.embedded import fly_embedded
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.faults.fault_table import Fault, parse_fault
from dart_flight.sim.pipe import FULL_SPEED
from tests.faults.expected import expected
from tests.shared_flights import PATIENT

ROOT = Path(__file__).parents[2]
NEAR = ROOT / "tests/data/near_wall.yaml"


def flown(text: str, folder: Path, settings: Sequence[str] = ()) -> tuple[str, list[object], Fault]:
    """A flight with a fault, in real time where the fault is about time."""
    fault = parse_fault(text)
    speed = 1.0 if fault.kind.needs_real_time else FULL_SPEED
    verdict = fly_embedded(load_flyable(NEAR, settings=settings), 1, folder, fault=fault, speed=speed)
    assert verdict.log is not None
    log = read_log(next(folder.glob("*/flight.mcap")))
    came = "completed" if verdict.outcome == "completed" else (verdict.reason or "").split(":")[0]
    return came, [e.record for e in log.entries], fault


@pytest.mark.mavlink
@pytest.mark.parametrize(
    "text",
    [
        "wall-missing@approach",
        "servo-unplugged@approach",
        *(
            pytest.param(text, marks=pytest.mark.realtime)
            for text in ("packet-loss=10@take-off", "link-loss@recovery", "delay=1000@approach")
        ),
    ],
)
def test_a_cell_through_mavsdk(text: str, tmp_path: Path) -> None:
    came, records, fault = flown(text, tmp_path, PATIENT if parse_fault(text).kind.needs_real_time else ())
    row = text.partition("@")[0]
    assert came in expected()[row if row in ROWS else fault.name, str(fault.phase)]
    if came != "completed":
        assert came in [r.rule for r in records if isinstance(r, GuardEvent)]


@pytest.mark.realtime
@pytest.mark.mavlink
def test_imu_drop_out_to_decision_within_a_tenth_of_a_second(tmp_path: Path) -> None:
    came, records, _ = flown("imu-dropout@approach", tmp_path)
    assert came == "imu_silent"
    event = next(i for i, r in enumerate(records) if isinstance(r, GuardEvent))
    last = max(r.received_us for r in records[:event] if isinstance(r, ImuSample))
    newest = max(getattr(r, "received_us", 0) for r in records[: event + 1])
    print(f"decision {1e-3 * (newest - last):.1f} ms after the last IMU sample")
    assert newest - last <= 100_000


@pytest.mark.mavlink
def test_the_pilot_gets_silence_at_once(tmp_path: Path) -> None:
    came, records, _ = flown("pilot@approach", tmp_path)
    assert came == "pilot"
    shown = next(r for r in records if isinstance(r, StatusSample) and r.flight_mode == "manual")
    silence = next(r for r in records if isinstance(r, Silence))
    print(f"silence {1e-3 * (silence.t_us - shown.t_us):.1f} ms after telemetry showed the mode")
    assert silence.t_us - shown.t_us <= 100_000
    after = records[records.index(silence) :]
    assert not [r for r in after if isinstance(r, Setpoint | VehicleCommand)]
