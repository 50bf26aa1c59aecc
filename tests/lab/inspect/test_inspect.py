"""`dart-flight inspect` on synthetic logs with known forces."""

from __future__ import annotations

import functools
import json
import math
import random
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from dart_flight.base.records import ForceEstimate, ImpactOnset, ImpactPeak
from dart_flight.cli import main
from dart_flight.lab.identify.trial_readers import read_trials
from dart_flight.lab.identify.trials import TrialReading
from dart_flight.lab.inspect.impacts import Estimated, ThresholdCrossing
from tests.doubles.ulog_file import Topics, write_ulog

pytest.importorskip("pyulog")

ROOT = Path(__file__).parents[3]
FULL_M_S2, FACTOR = 22.0, 0.3
END_S = 26.0
HIT_S, HIT_M_S2, HIT_DEG, LONG_S = 16.0, 14.0, 60.0, 0.15
VIBRATION_M_S2 = 2.5
Rows = list[tuple[float, list[float]]]


def with_force(estimated: Estimated, push: tuple[float, float]) -> Estimated:
    """Return the estimate with an added horizontal force, newton, mission frame."""
    x, y, z = estimated.force.force_mission
    force = msgspec.structs.replace(estimated.force, force_mission=(x + push[0], y + push[1], z))
    along = estimated.along_n + push[0] * estimated.up[0] + push[1] * estimated.up[1]
    return estimated._replace(force=force, along_n=along)


@functools.cache
def topics(motor_hz: float = 100.0, motors: bool = True, north_m_s: float = 0.0) -> Topics:
    """Return 21 s of level flight facing north, with slow climbs and descents, vibration and one impact.

    Tests share the result, so copy it before a change.
    """
    rng = random.Random(5)
    imu: Rows = []
    attitude: Rows = []
    position: Rows = []
    commands: Rows = []
    landed: Rows = []
    every = round(250.0 / motor_hz)
    for i in range(round(END_S / 0.004)):
        t, stamp = i * 0.004, 1e6 + 4000 * i
        u = 0.5 + 0.05 * math.sin(0.5 * t)
        thrust = FULL_M_S2 * (FACTOR * u * u + (1.0 - FACTOR) * u)
        push = HIT_M_S2 * math.sin(math.pi * (t - HIT_S) / LONG_S) if 0.0 <= t - HIT_S <= LONG_S else 0.0
        north, east = (push * f(math.radians(HIT_DEG)) for f in (math.cos, math.sin))
        shake = [rng.gauss(0.0, VIBRATION_M_S2) for _ in range(3)]
        imu.append((stamp, [0.0, 0.0, 0.0, north + shake[0], east + shake[1], shake[2] - thrust]))
        if i % 10 == 0:
            attitude.append((stamp, [1.0, 0.0, 0.0, 0.0]))
        if i % 25 == 0:
            position.append((stamp, [0.0, 0.0, -min(2.0, max(0.0, t - 2.0)), north_m_s, 0.0, 0.0]))
        if i % every == 0:
            commands.append((stamp, [u] * 4))
        if i % 250 == 0:
            landed.append((stamp, [t < 2.0 or t > END_S - 3.0]))
    out: dict[tuple[str, int], tuple[str, Rows]] = {
        ("sensor_combined", 0): ("float[3] gyro_rad;float[3] accelerometer_m_s2;", imu),
        ("vehicle_attitude", 0): ("float[4] q;", attitude),
        ("vehicle_local_position", 0): ("float x;float y;float z;float vx;float vy;float vz;", position),
        ("vehicle_land_detected", 0): ("bool landed;", landed),
    }
    if motors:
        out["actuator_motors", 0] = ("float[4] control;", commands)
    return out


def inspect_json(path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, Any]:
    assert main(["inspect", str(path), "--json", *options]) == 0
    flights: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    return flights[0]


def test_an_impact_is_found_with_its_size_direction_and_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = inspect_json(
        write_ulog(tmp_path / "a.ulg", topics(), release=0x010E00FF), capsys, "--mass", "2.0"
    )
    (impact,) = flight["impacts"]
    assert impact["t_s"] == pytest.approx(HIT_S, abs=0.05)
    assert impact["acceleration_m_s2"] == pytest.approx(HIT_M_S2, rel=0.2)
    assert impact["force_n"] == pytest.approx(2.0 * impact["acceleration_m_s2"])
    assert impact["direction_deg"] == pytest.approx(HIT_DEG, abs=8.0)
    assert impact["kind"] == "impact"
    assert not impact["clipped"]
    assert flight["noise_m_s2"] == pytest.approx(VIBRATION_M_S2, rel=0.15)
    assert flight["noise_n"] == pytest.approx(2.0 * flight["noise_m_s2"])
    assert flight["noise_short_m_s2"] == pytest.approx(VIBRATION_M_S2 / math.sqrt(8.0), rel=0.3)
    thrust = flight["thrust"]
    assert thrust["full_m_s2"] == pytest.approx(FULL_M_S2, rel=0.03)
    assert thrust["held_out_percent"] < 5.0
    assert flight["px4_version"] == "1.14.0"


def test_a_vehicle_without_a_lock_is_rigid(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, cage = write_ulog(tmp_path / "a.ulg", topics()), str(ROOT / "configs" / "rigid_cage.yaml")
    (impact,) = inspect_json(log, capsys, "--config", cage)["impacts"]
    assert impact["acceleration_m_s2"] == pytest.approx(HIT_M_S2, rel=0.2)


def test_forces_are_unknown_without_a_mass(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = inspect_json(write_ulog(tmp_path / "a.ulg", topics()), capsys)
    assert flight["noise_n"] is None
    assert flight["threshold_n"] is None
    assert [i["force_n"] for i in flight["impacts"]] == [None]
    assert any("mass" in what for what in flight["unknown"])


def test_slow_and_missing_topics_are_reported_with_a_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    slow = inspect_json(write_ulog(tmp_path / "slow.ulg", topics(motor_hz=10.0)), capsys)["unknown"]
    assert any("at 10 Hz" in what for what in slow)
    assert any("SDLOG_PROFILE" in what for what in slow)
    flight = inspect_json(write_ulog(tmp_path / "none.ulg", topics(motors=False)), capsys)
    assert flight["thrust"] is None
    assert any(what.startswith("thrust: the log has no actuator_motors") for what in flight["unknown"])


@pytest.mark.rest
def test_impacts_in_fast_flight_are_untold_without_motor_outputs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    slow = inspect_json(write_ulog(tmp_path / "slow.ulg", topics(motors=False)), capsys)
    assert (len(slow["impacts"]), slow["untold"]) == (1, 0)
    fast_log = write_ulog(tmp_path / "fast.ulg", topics(motors=False, north_m_s=6.0))
    fast = inspect_json(fast_log, capsys)
    assert ([i["kind"] for i in fast["impacts"]], fast["untold"]) == (["untold"], 1)
    assert main(["inspect", str(fast_log)]) == 0
    assert "contacts or manoeuvres" in " ".join(capsys.readouterr().out.split())
    known = inspect_json(write_ulog(tmp_path / "known.ulg", topics(north_m_s=6.0)), capsys)
    assert (len(known["impacts"]), known["untold"]) == (1, 0)


def test_a_log_without_attitude_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    some = {key: value for key, value in topics().items() if key[0] != "vehicle_attitude"}
    assert main(["inspect", str(write_ulog(tmp_path / "a.ulg", some))]) == 2
    assert "has no vehicle_attitude" in capsys.readouterr().err


def test_impact_trials_and_the_page_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    path, page = write_ulog(tmp_path / "a.ulg", topics()), tmp_path / "page.html"
    status = main(["inspect", str(path), "--mass", "1.3", "-o", str(tmp_path / "t"), "--report", str(page)])
    assert status == 0
    (trial,) = read_trials(tmp_path / "t" / "a_impact1.csv", TrialReading())
    force = trial.series["normal_force_n"]
    top = force.time_s[int(np.argmax(np.convolve(force.value, np.ones(9) / 9, mode="same")))]
    assert top == pytest.approx(LONG_S / 2.0, abs=0.05)
    assert "a.ulg" in page.read_text()


def test_a_thrust_fit_that_fails_on_held_out_data_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The motor commands are unrelated to the measured thrust.
    changed = dict(topics())
    fields, rows = changed["actuator_motors", 0]
    changed["actuator_motors", 0] = (
        fields,
        [(t, [0.5 + 0.25 * math.sin(0.17 * (t - 1e6) * 1e-6)] * 4) for t, _ in rows],
    )
    flight = inspect_json(write_ulog(tmp_path / "a.ulg", changed), capsys)
    assert flight["thrust"] is None
    (problem,) = (what for what in flight["unknown"] if what.startswith("thrust:"))
    assert "segments of 0.5 s" in problem
    assert "limit 10 %" in problem


@pytest.mark.parametrize(
    ("peak_n", "along_n", "is_impact"), [(0.3, 0.0, False), (0.3, 6.0, True), (4.0, 0.0, True)]
)
def test_a_threshold_crossing_without_a_matching_peak_is_not_an_impact(
    peak_n: float, along_n: float, is_impact: bool
) -> None:
    onset = ImpactOnset(1, 1, 1, (6.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert ThresholdCrossing(onset, 5.5).is_impact, "a crossing at the end of a log needs no peak"
    peak = ImpactPeak(1, 1, 1, (1.0, 0.0), peak_n, along_n, (0.0, 0.0, 0.0), False, fitted=True)
    assert ThresholdCrossing(onset, 5.5, peak).is_impact is is_impact


def tilted_estimate(tilt_deg: float, thrust_n: float, along_n: float) -> Estimated:
    """Return the estimate of a vehicle that leans north and whose thrust differs from its commands."""
    up = (math.sin(math.radians(tilt_deg)), 0.0, math.cos(math.radians(tilt_deg)))
    error = along_n - thrust_n
    force = ForceEstimate(1, (error * up[0], error * up[1], error * up[2]), False)
    return Estimated(force, True, up, thrust_n, along_n, full_n=26.0)


@pytest.mark.parametrize(
    ("tilt_deg", "along_n", "push_n", "is_impact"),
    [
        (50.0, 2.0, 0.0, False),  # the thrust is below the estimate
        (50.0, 24.0, 0.0, False),  # the thrust is above the estimate
        (0.0, 12.0, -10.0, True),
        (40.0, 12.0, -10.0, True),  # the vehicle leans into the wall
        (40.0, 12.0, 10.0, True),
        (40.0, 60.0, 0.0, True),  # exceeds the full thrust
        (40.0, -20.0, 0.0, True),
    ],
)
def test_a_force_that_a_thrust_error_explains_is_not_an_impact(
    tilt_deg: float, along_n: float, push_n: float, is_impact: bool
) -> None:
    estimated = with_force(tilted_estimate(tilt_deg, 12.0, along_n), (push_n, 0.0))
    x, y, z = estimated.force.force_mission
    onset = ImpactOnset(1, 1, 1, (x, y, z), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    crossing = ThresholdCrossing(onset, 5.5)
    peak = ImpactPeak(1, 1, 1, (math.copysign(1.0, x), 0.0), abs(x), 0.0, (0.0, 0.0, 0.0), False, fitted=True)
    crossing.record_peak(peak, [estimated], 8)
    assert crossing.is_impact is is_impact


def test_a_thrust_loss_of_a_tilted_vehicle_is_not_an_impact(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = dict(topics())
    begin, end = 1e6 + 20.0e6, 1e6 + 20.3e6
    fields, rows = changed["sensor_combined", 0]
    changed["sensor_combined", 0] = (
        fields,
        [(t, [*v[:5], 0.2 * v[5]] if begin <= t <= end else v) for t, v in rows],
    )
    half = math.radians(0.5 * 50.0)
    fields, rows = changed["vehicle_attitude", 0]
    changed["vehicle_attitude", 0] = (
        fields,
        [(t, [math.cos(half), 0.0, math.sin(half), 0.0] if begin <= t <= end else v) for t, v in rows],
    )
    flight = inspect_json(write_ulog(tmp_path / "a.ulg", changed), capsys)
    assert [round(i["t_s"]) for i in flight["impacts"]] == [round(HIT_S)]
    assert flight["weak"] >= 1
