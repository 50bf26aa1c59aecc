"""Raw motion-capture poses in `identify` and in the report, around a contact that PX4's estimate smooths."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from dart_flight.base.records import ImpactOnset, PoseSample, TruthSample
from dart_flight.lab.flight_arrays import FlightArrays
from dart_flight.lab.identify.flight_trials import trials_of
from dart_flight.lab.report.page import flight_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import Log, LogEntry
from dart_flight.run.fast import fly_fast
from dart_flight.run.flight_record import FlightRecord
from dart_flight.run.prepare import load_flyable, with_simulated_mocap

SINGLE = Path(__file__).parents[3] / "missions/paper_single_wall.yaml"
AGE_S = 0.02


@pytest.fixture(scope="module")
def log() -> Log:
    kept: list[FlightRecord] = []
    settings = [f"simulation.pose_delay_s={AGE_S}", "mocap.delay_ms=20", "mocap.up=y"]
    mission = with_simulated_mocap(load_flyable(SINGLE, None, settings), "udp")
    fly_fast(mission, 1, None, keep_record=kept.append)
    return kept[0].log


def with_poses_changed(log: Log, change: Any) -> Log:
    """Return a copy of a log with changed poses; a change to None removes the pose."""
    entries = []
    for entry in log.entries:
        new = change(entry.record) if isinstance(entry.record, PoseSample) else entry.record
        if new is not None:
            entries.append(LogEntry(entry.number, new))
    return Log(log.source, log.about, {}, entries, complete=True)


def errors_m(log: Log) -> np.ndarray[Any, Any]:
    """Return the errors of the trial's normal position from -0.05 s to 0.3 s around the onset, metres."""
    ((trial,),) = trials_of(log).values()
    mission = flown_mission(log.about, log.source)
    course = FlightArrays(log, mission)
    truth = course.topic(TruthSample)
    wall = mission.collisions[0].wall
    true_m = (truth["position_mission"] - np.array([*wall.point, 0.0])) @ np.array([*wall.normal, 0.0])
    onset_s = course.time_of(course.all(ImpactOnset)[0].t_us)
    time, value = trial.series["normal_m"]
    near = (time > -0.05) & (time < 0.3)
    return np.asarray(value[near] - np.interp(time[near] + onset_s, truth.t_s, true_m))


def test_poses_resolve_a_contact_that_the_estimate_smooths(log: Log) -> None:
    raw = errors_m(log)
    smoothed = errors_m(with_poses_changed(log, lambda pose: None))
    rms_raw, rms_smoothed = (float(np.sqrt(np.mean(e**2))) for e in (raw, smoothed))
    assert rms_raw < 0.003  # the poses' own noise is 1 mm
    assert rms_smoothed > 2.0 * rms_raw


def test_sparse_poses_and_poses_of_unknown_age_are_not_used(log: Log) -> None:
    estimate = errors_m(with_poses_changed(log, lambda pose: None))
    few = errors_m(with_poses_changed(log, lambda pose: pose if (pose.frame_number or 0) % 3 == 0 else None))
    assert np.array_equal(few, estimate)
    mission = flown_mission(log.about, log.source)
    mocap = msgspec.structs.replace(mission.vehicle.mocap, delay_ms=None)
    vehicle = msgspec.structs.replace(mission.vehicle, mocap=mocap)
    about = log.about | {"world": "drone"}
    course = FlightArrays(
        Log(log.source, about, {}, log.entries, complete=True),
        msgspec.structs.replace(mission, vehicle=vehicle),
    )
    assert not course.posed.is_timed
    assert course.posed.time_s.size > 500


def test_source_timestamps_remove_the_jitter_of_reception(log: Log) -> None:
    def shake(pose: PoseSample) -> PoseSample:
        late_us = 1_000 * ((pose.frame_number or 0) * 7 % 9)
        return msgspec.structs.replace(pose, t_us=pose.t_us + late_us)

    mission = flown_mission(log.about, log.source)
    quiet, shaken = (FlightArrays(one, mission).posed for one in (log, with_poses_changed(log, shake)))
    assert shaken.time_s == pytest.approx(quiet.time_s, abs=1e-3)
    without = with_poses_changed(log, lambda pose: msgspec.structs.replace(shake(pose), source_us=None))
    assert np.abs(FlightArrays(without, mission).posed.time_s[:100] - quiet.time_s[:100]).max() > 5e-3


@pytest.mark.rest
def test_a_report_shows_poses_beside_the_estimate_if_the_log_has_poses(log: Log) -> None:
    """The page of a log without poses is tested with the other pages."""
    assert "Position from the motion capture" in flight_page(RecordedFlight(log))
