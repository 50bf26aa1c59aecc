"""A computer that is too busy for a real-time flight is reported before and after the flight."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from dart_flight.base.processes import measure_lateness_s
from dart_flight.base.records import GuardEvent, MissionEnd, Outcome, Override, Tick, World
from dart_flight.check import computer_load as lateness
from dart_flight.cli import dry_run_command, main
from dart_flight.cli.flight_output import TOO_BUSY
from dart_flight.config.vehicle import packaged
from dart_flight.recording.verdict import Verdict, VerdictBuilder
from dart_flight.run.prepare import load_flyable

ROOT = Path(__file__).parents[1]
SINGLE = ROOT / "missions/single_wall.yaml"
MISSION = load_flyable(packaged("missions", "single_wall.yaml"))


def test_the_lateness_of_the_program_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    real, naps = time.sleep, iter([0.12])
    monkeypatch.setattr(time, "sleep", lambda s: real(s + next(naps, 0.0)))
    assert 0.12 <= measure_lateness_s() < 5.0


@pytest.mark.parametrize(
    ("late_s", "go", "remark"), [(0.003, True, False), (0.1, True, True), (0.3, False, False)]
)
def test_check_reports_the_lateness(
    late_s: float, go: bool, remark: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lateness, "measure_lateness_s", lambda: late_s)
    found = lateness.check_lateness(MISSION)
    assert (found.item, found.go, found.remark) == ("lateness", go, remark)
    assert f"{1e3 * late_s:.0f} ms" in found.message
    assert main(["check", str(SINGLE)]) == (0 if go else 1)


def late_flight(late_us: int, world: World) -> Verdict:
    builder = VerdictBuilder(MISSION)
    for host_us in (0, 20_000, 40_000 + late_us, 60_000 + late_us):
        builder.add(Tick(host_us))
    builder.add(GuardEvent(1, "imu_silent", Override.LAND, "for 412 ms"))
    builder.add(MissionEnd(1, Outcome.ABORTED, "imu_silent: for 412 ms", None))
    return builder.build(world, 1)


def test_the_verdict_reports_the_lateness_of_the_program() -> None:
    assert late_flight(412_000, World.EMBEDDED).own_lateness_ms == 412.0
    assert late_flight(0, World.FAST).own_lateness_ms == 0.0


def test_a_real_time_dry_run_reports_lateness_before_and_after_the_flight(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(dry_run_command, "measure_lateness_s", lambda: 0.1)
    monkeypatch.setattr(
        dry_run_command, "fly_embedded", lambda *_, **__: late_flight(412_000, World.EMBEDDED)
    )
    assert main(["dry-run", str(SINGLE), "--realtime"]) == 1
    printed = capsys.readouterr().err
    advice = "the computer is too slow for real time; omit --realtime or use --fast"
    assert advice == TOO_BUSY
    assert f"this program lags by up to 100 ms: {advice}" in printed
    assert f"this program lagged by up to 412 ms: {advice}" in printed


def test_a_dry_run_in_simulated_time_does_not_report_lateness(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(dry_run_command, "measure_lateness_s", lambda: 0.1)
    assert main(["dry-run", str(SINGLE), "--fast", "--log-dir", str(tmp_path)]) == 0
    assert TOO_BUSY not in capsys.readouterr().err
