"""Reports of logs with holes, truncated logs and logs without a flight."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.records import ImuSample
from dart_flight.cli import main
from dart_flight.config.vehicle import load_vehicle
from dart_flight.lab.holes import describe_holes, describe_missing_parts
from dart_flight.lab.identify.trial_readers import read_trials
from dart_flight.lab.identify.trials import TrialReading
from dart_flight.lab.inspect.inspection import inspect_file
from dart_flight.lab.report.inspection_page import inspection_page
from dart_flight.lab.report.page import comparison_page, flight_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.recording.reader import Log, read_log
from tests.doubles.ulog_file import write_ulog
from tests.lab.inspect.test_inspect import inspect_json, topics
from tests.shared_flights import SharedFlights

pytest.importorskip("pyulog")


@given(
    st.floats(0.002, 0.05),
    st.integers(20, 300),
    st.integers(1, 18),
    st.floats(0.6, 30.0),
    st.floats(0.0, 1e4),
)
def test_a_hole_is_reported_with_its_time_and_duration(
    interval_s: float, count: int, place: int, hole_s: float, begin_s: float
) -> None:
    time_s = np.asarray(begin_s + interval_s * np.arange(count), dtype=np.float64)
    assert describe_holes(time_s, "normal_m") == []
    time_s[place + 1 :] += hole_s
    (line,) = describe_holes(time_s, "normal_m")
    at_s, long_s = time_s[place] - time_s[0], time_s[place + 1] - time_s[place]
    assert line == f"hole of {long_s:.2f} s in normal_m, at {at_s:.2f} s"


def test_additional_holes_are_counted() -> None:
    time_s = np.concatenate([np.arange(0.0, 1.0, 0.01) + 2.0 * k for k in range(6)])
    lines = describe_holes(time_s, "imu")
    assert len(lines) == 4
    assert lines[-1].startswith("2 more holes in imu, 2.0")
    assert describe_holes(np.array([0.0, 5.0]), "imu") == []


def _without(part: Any, begin_s: float, end_s: float) -> Any:
    """Return the topics without the rows between two times, in seconds after the log's beginning."""
    return {
        key: (fields, [row for row in rows if not begin_s <= row[0] * 1e-6 - 1.0 < end_s])
        for key, (fields, rows) in part.items()
    }


def test_inspect_reports_holes_and_truncation_of_a_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def unknown(name: str, content: Any) -> list[str]:
        lines: list[str] = inspect_json(write_ulog(tmp_path / f"{name}.ulg", content), capsys)["unknown"]
        return lines

    whole = unknown("whole", topics())
    assert not [what for what in whole if "hole" in what or "cut" in what]
    holed = unknown("hole", _without(topics(), 12.0, 13.5))
    assert "hole of 1.50 s in sensor_combined, at 12.00 s" in holed
    short = unknown("short", _without(topics(), 20.0, 99.0))
    assert "cut: the log ends in the air, at 20.00 s" in short
    late = unknown("late", _without(topics(), 0.0, 8.0))
    assert "cut: the log begins in the air" in late


def test_a_log_without_a_flight_reports_that_no_impact_can_be_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grounded = dict(topics())
    fields, rows = grounded["vehicle_land_detected", 0]
    grounded["vehicle_land_detected", 0] = (fields, [(stamp, [True]) for stamp, _ in rows])
    assert main(["inspect", str(write_ulog(tmp_path / "ground.ulg", grounded))]) == 0
    output = capsys.readouterr().out
    assert "0 s in the air: no impact can be found" in output
    assert "\nno impact" not in output
    flight = inspect_file(tmp_path / "ground.ulg", load_vehicle())
    assert "<p>0 s in the air: no impact can be found.</p>" in inspection_page([flight])


def test_a_trial_notes_its_hole(tmp_path: Path) -> None:
    time_s = np.arange(0.0, 2.0, 0.004)
    normal_m = np.abs(time_s - 1.0) * 0.8 - 0.05 * np.exp(-(((time_s - 1.0) / 0.05) ** 2))
    keep = ~((time_s > 0.3) & (time_s < 0.65))
    rows = "".join(f"{t:.3f},{x:.5f}\n" for t, x in zip(time_s[keep], normal_m[keep], strict=True))
    (tmp_path / "trial.csv").write_text(f"time_s,normal_m\n{rows}")
    (trial,) = read_trials(tmp_path / "trial.csv", TrialReading())
    assert trial.notes == (f"{tmp_path}/trial.csv: hole of 0.35 s in normal_m, at 0.30 s",)


def test_a_trial_of_a_truncated_flight_log_notes_it(flown: SharedFlights, tmp_path: Path) -> None:
    data = flown("paper_single_wall", 1).log.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: round(0.8 * len(data))])
    (trial,) = read_trials(cut, TrialReading())
    assert any(f"{cut}: cut: the log ends at " in note for note in trial.notes)


def _damaged(log: Log, *, cut_s: float | None = None, hole_s: tuple[float, float] | None = None) -> Log:
    """Return a log truncated at a time, or without the IMU samples between two times."""
    begin_us = next(e.record.t_us for e in log.entries if isinstance(e.record, ImuSample))
    kept, now_s = [], 0.0
    for entry in log.entries:
        if isinstance(entry.record, ImuSample):
            now_s = (entry.record.t_us - begin_us) * 1e-6
            if hole_s is not None and hole_s[0] < now_s < hole_s[1]:
                continue
        if cut_s is not None and now_s > cut_s:
            break
        kept.append(entry)
    return Log(log.source, log.about, {} if cut_s is not None else log.end, kept, complete=cut_s is None)


def test_holes_and_truncation_of_a_flight_log_are_described(flown: SharedFlights) -> None:
    whole = flown("paper_single_wall", 1).log
    log = read_log(whole)
    assert describe_missing_parts(log) == []
    cut = _damaged(log, cut_s=3.0)
    (line,) = describe_missing_parts(cut)
    assert line == "cut: the log ends at 3.00 s"
    holed = _damaged(log, hole_s=(2.0, 3.5))
    assert describe_missing_parts(holed) == ["hole of 1.50 s in the IMU samples, at 2.00 s"]


@pytest.mark.rest
def test_a_comparison_begins_with_the_holes_of_a_log(flown: SharedFlights) -> None:
    log = read_log(flown("paper_single_wall", 1).log)
    holed = _damaged(log, hole_s=(2.0, 3.5))
    both = comparison_page([RecordedFlight(holed), RecordedFlight(log)])
    assert both.count("does not contain the whole flight: hole of 1.50 s in the IMU samples") == 1


@pytest.mark.rest
def test_a_page_begins_with_the_truncation_of_the_log(flown: SharedFlights) -> None:
    cut = _damaged(read_log(flown("paper_single_wall", 1).log), cut_s=3.0)
    (line,) = describe_missing_parts(cut)
    page = flight_page(RecordedFlight(cut))
    assert f"The log does not contain the whole flight: {line}." in page
    assert page.index(line) < page.index("class=sentence")


@pytest.mark.rest
def test_a_log_cut_before_its_first_imu_sample_is_reported(flown: SharedFlights) -> None:
    log = _damaged(read_log(flown("paper_single_wall", 1).log), cut_s=-1.0)
    log.entries = [e for e in log.entries if not isinstance(e.record, ImuSample)]
    assert describe_missing_parts(log) == ["cut: the log ends before its first IMU sample"]
    log.entries.clear()
    assert "cut: the log ends before its first IMU sample" in flight_page(RecordedFlight(log))


@pytest.mark.parametrize("samples", [0, 1, 2, 3])
def test_a_px4_log_with_too_few_imu_samples_has_no_impact(
    samples: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = dict(topics())
    for key in (("sensor_combined", 0), ("vehicle_attitude", 0)):
        fields, rows = short[key]
        short[key] = (fields, rows[:samples])
    assert main(["inspect", str(write_ulog(tmp_path / "short.ulg", short))]) == (2 if samples < 2 else 0)
    output = capsys.readouterr()
    if samples < 2:  # too few for a sample rate
        assert len(output.err.strip().splitlines()) == 1
    else:
        assert "0 s in the air: no impact can be found" in output.out
