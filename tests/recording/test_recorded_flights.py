"""The core still makes the decisions of kept flights from every world (tests/data/README.md)."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.base.records import ImpactOnset, ImpactPeak, LockCommand, Setpoint
from dart_flight.lab.report.page import flight_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.recording.reader import read_log
from dart_flight.run.replay import Difference, Replay, replay
from tests.recording.keep_flight import LEFT_OUT, keep
from tests.shared_campaigns import campaign_rows
from tests.shared_flights import LiveFlights

FLIGHTS = sorted((Path(__file__).parents[1] / "data" / "flights").glob("*.mcap"))


def differences(result: Replay) -> list[Difference]:
    """Return the differences, without the records that a kept flight omits."""
    return [d for d in result.differences if d.recorded is not None or not isinstance(d.replayed, LEFT_OUT)]


def test_kept_flights_cover_every_world_without_px4() -> None:
    assert {path.stem for path in FLIGHTS} >= {"fast", "embedded"}
    assert sum(path.stat().st_size for path in FLIGHTS) < 2_600_000


@pytest.mark.parametrize("path", FLIGHTS, ids=lambda p: p.stem)
def test_a_replayed_flight_makes_the_recorded_decisions(path: Path) -> None:
    log = read_log(path)
    assert log.complete
    assert log.world == path.stem
    result = replay(log)
    assert not differences(result), differences(result)[0].text()
    assert result.missing == 0
    kinds = {type(r) for r in result.replayed}
    assert {ImpactOnset, ImpactPeak, Setpoint, LockCommand} <= kinds
    assert result.recorded
    if result.exact:
        assert result.recorded == result.replayed


# `make test` looks at the flight of the fast world, `make test-rest` at the others too.
EACH = [pytest.param(p, id=p.stem, marks=() if p.stem == "fast" else pytest.mark.rest) for p in FLIGHTS]


@pytest.mark.parametrize("path", EACH)
def test_replaying_a_kept_flight_detects_a_changed_threshold(path: Path) -> None:
    """The omitted records must not hide a changed decision."""
    result = replay(read_log(path), ["detection.force_threshold_n=15"])
    assert any(isinstance(d.recorded, ImpactOnset) for d in result.differences)


@pytest.mark.parametrize("path", EACH)
def test_a_kept_flight_has_a_report_page(path: Path) -> None:
    assert "Predicted against measured" in flight_page(RecordedFlight.read(path))


def test_a_kept_flight_lacks_only_force_and_torque_estimates(flight_path: Path, tmp_path: Path) -> None:
    keep(flight_path, tmp_path / "small.mcap")
    small = read_log(tmp_path / "small.mcap")
    assert not any(isinstance(e.record, LEFT_OUT) for e in small.entries)
    result = replay(small)
    assert not differences(result)
    assert len(result.differences) > 1000


@pytest.mark.rest
def test_a_sample_of_the_replay_campaign_has_no_differences(tmp_path: Path) -> None:
    options = ["--only", "world=fast", "--runs", "1", "--seed", "11"]
    rows = campaign_rows(tmp_path / "out", "replay", *options)
    assert len(rows) == 2
    for row in rows:
        assert (row["outcome"], row["differences"], row["missing"]) == ("completed", 0, 0)
        assert row["decisions"] > 20


@pytest.mark.mavlink
def test_a_flight_through_mavsdk_replays_bit_for_bit(commanded: LiveFlights) -> None:
    """The replay must agree whether or not a busy machine spoils the flight."""
    log = read_log(commanded("dart-flight dry-run missions/paper_dual_collision.yaml --speed max").log)
    result = replay(log)
    assert (result.exact, result.differences, result.missing) == (True, [], 0)
    assert result.inputs > 5000
