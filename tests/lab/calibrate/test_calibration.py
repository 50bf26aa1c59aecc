"""`dart-flight calibrate thrust` recovers the known thrust curves of simulated flights and synthetic logs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.lab.calibrate.thrust_curve import calibrate_thrust, quiet_points
from dart_flight.lab.inspect.content import TOPICS
from dart_flight.lab.inspect.inspection import inspect_log
from dart_flight.lab.inspect.specific_thrust import fit_specific_thrust
from dart_flight.lab.track import read_calibration_series
from dart_flight.lab.ulog import open_ulog
from tests.doubles.ulog_file import write_ulog
from tests.shared_flights import SharedFlights

ROOT = Path(__file__).parents[3]
VEHICLE = load_vehicle(ROOT / "configs" / "dart.yaml")


@pytest.fixture(scope="module")
def flight(flown: SharedFlights) -> Path:
    return flown("paper_single_wall", 2).log


def test_a_flight_log_gives_the_plants_thrust_curve(flight: Path) -> None:
    result = calibrate_thrust([read_calibration_series(flight)], VEHICLE)
    assert result.segments >= 10
    assert result.hover_command == pytest.approx(0.5547, rel=0.01)
    assert result.residual_percent < 1.5
    assert result.full_n == pytest.approx(7.0, rel=0.04)
    assert result.reference_v == pytest.approx(15.6)
    assert result.battery_exponent_error is None


def test_contacts_and_ground_time_are_excluded(flight: Path) -> None:
    track = read_calibration_series(flight)
    points = quiet_points(track, VEHICLE.airframe.mass_kg, VEHICLE.thrust.motor_lag_s)
    assert len(points.force) < (track.imu_s[-1] - track.imu_s[0]) / 0.5
    assert (np.abs(points.force - 12.75) < 1.5).all()


def test_the_command_writes_the_thrust_curve_to_the_configuration(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "mine.yaml"
    text = (ROOT / "configs" / "dart.yaml").read_text()
    config.write_text(text.replace("full_n: 7.0", "full_n: 6.0"))
    assert main(["calibrate", "thrust", str(flight), "--config", str(config), "--write", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert load_vehicle(config).thrust.full_n == pytest.approx(result["full_n"], abs=1e-3)
    assert result["full_n"] == pytest.approx(7.0, rel=0.04)
    assert "# thrust at full command and at the battery voltage\n" in config.read_text()


def write_climbing_ulog(
    path: Path, volts: float, factor: float, full_n: float, noise: float = 0.0, release: int = 0
) -> None:
    """Write a PX4 log of slow climbs and descents; the thrust curve is for 16 V, with exponent 1."""
    rng = np.random.default_rng(4)
    imu, commands = [], []
    for i in range(5000):
        stamp, u = 10_000_000 + 4000 * i, 0.55 + 0.1 * np.sin(0.3 * i * 0.004)
        force = 4.0 * full_n * (factor * u * u + (1.0 - factor) * u) * volts / 16.0
        imu.append((stamp, [0.0, 0.0, 0.0, *rng.normal((0.0, 0.0, -force / 1.3), 0.2)]))
        commands.append((stamp, [u * (1.0 + noise * np.sin(0.7 * (i // 250)))] * 4))
    topics = {
        ("sensor_combined", 0): ("float[3] gyro_rad;float[3] accelerometer_m_s2;", imu),
        ("actuator_motors", 0): ("float[4] control;", commands),
        ("battery_status", 0): ("float voltage_v;", [(stamp, [volts]) for stamp, _ in commands[::50]]),
    }
    write_ulog(path, topics, release=release)


def test_px4_logs_give_the_thrust_curve_and_the_battery_exponent(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    paths = [tmp_path / "full.ulg", tmp_path / "low.ulg"]
    write_climbing_ulog(paths[0], 16.6, 0.4, 8.0)
    write_climbing_ulog(paths[1], 14.6, 0.4, 8.0)
    result = calibrate_thrust([read_calibration_series(p) for p in paths], VEHICLE)
    assert result.battery_exponent_error is not None
    assert result.battery_exponent == pytest.approx(1.0, abs=0.05)
    assert result.reference_v == pytest.approx(15.6, abs=0.05)
    assert result.full_n == pytest.approx(8.0 * 15.6 / 16.0, rel=0.02)
    assert result.model_factor_error is not None
    assert result.model_factor == pytest.approx(0.4, abs=0.06)


def test_unreadable_logs_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.ulg"
    bad.write_bytes(b"no log")
    with pytest.raises(InputError, match="not a readable ULog"):
        read_calibration_series(bad)
    assert main(["calibrate", "thrust", str(tmp_path / "none.mcap")]) == 2
    assert "cannot read" in capsys.readouterr().err


def test_calibrate_and_inspect_refuse_a_poor_thrust_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both assess the fit with the same function; the commands do not explain the thrust."""
    path, config = tmp_path / "a.ulg", tmp_path / "mine.yaml"
    write_climbing_ulog(path, 16.0, 0.7, 7.0, noise=0.35)
    config.write_text((ROOT / "configs" / "dart.yaml").read_text())
    track = read_calibration_series(path)
    refused = fit_specific_thrust(track, VEHICLE)
    assert isinstance(refused, str)
    assert "limit 10 %" in refused
    assert main(["calibrate", "thrust", str(path), "--config", str(config), "--write"]) == 2
    assert "limit 10 %" in capsys.readouterr().err
    assert load_vehicle(config).thrust.full_n == 7.0
    write_climbing_ulog(path, 16.0, 0.7, 7.0)
    track = read_calibration_series(path)
    assert not isinstance(fit_specific_thrust(track, VEHICLE), str)
    assert calibrate_thrust([track], VEHICLE).full_n == pytest.approx(7.0, rel=0.02)


def test_calibrate_and_inspect_refuse_logs_of_old_px4_versions(tmp_path: Path) -> None:
    path = tmp_path / "old.ulg"
    write_climbing_ulog(path, 16.0, 0.7, 7.0, release=0x010703FF)
    for read in (read_calibration_series, lambda log: inspect_log(open_ulog(log, TOPICS), VEHICLE)):
        with pytest.raises(InputError, match=r"of PX4 1\.7\.3: only 1\.9 and later are supported"):
            read(path)
