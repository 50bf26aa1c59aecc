"""`dart-flight calibrate inertia` recovers a known inertia from simulated rotation."""

from __future__ import annotations

import copy
import functools
import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.lab.calibrate.inertia import calibrate_inertia
from dart_flight.lab.track import Track, read_calibration_series
from tests.doubles.ulog_file import write_ulog
from tests.shared_flights import SharedFlights

ROOT = Path(__file__).parents[3]
VEHICLE = load_vehicle(ROOT / "configs" / "dart.yaml")
INERTIA = (0.016, 0.011, 0.027)  # differs from the configured inertia
HOVER = VEHICLE.thrust.command_for(VEHICLE.airframe.mass_kg * 9.80665 / 4.0)


@functools.cache
def simulated_rotation(
    amplitudes: tuple[float, float, float],
    seconds: float = 20.0,
    lag_s: float = 0.025,
    wind_nm: float = 0.0,
    vehicle: VehicleConfig = VEHICLE,
) -> Track:
    """Simulate a vehicle of `INERTIA` whose motors excite its axes with the given command amplitudes.

    Tests share the result; `excited_track` returns a copy.
    """
    rng = np.random.default_rng(3)
    tick, fine = 0.004, 4
    motors = vehicle.airframe.motors
    mix = np.array([(-np.sign(m.y_m), np.sign(m.x_m), np.sign(m.yaw_torque_per_thrust_m)) for m in motors])
    arms = np.array([(-m.y_m, m.x_m, m.yaw_torque_per_thrust_m) for m in motors])
    j, w, u = np.array(INERTIA), np.zeros(3), np.full(4, HOVER)
    keep = math.exp(-tick / fine / lag_s)
    gyro, commands, stamps = [], [], []
    for i in range(round(seconds / tick)):
        t = i * tick
        # Two tones per axis make the vehicle rotate back and forth.
        wave = [math.sin(2 * math.pi * (1.1 + 0.7 * k) * t) + math.sin(19.0 * t + k) for k in range(3)]
        command = HOVER + mix @ (np.array(amplitudes) * wave) + 0.002 * rng.normal(size=4)
        if i % 2 == 0:
            stamps.append(t)
            commands.append(command)
        for _ in range(fine):
            u = command + (u - command) * keep
            torque = np.array([vehicle.thrust.force_n(x) for x in u]) @ arms + wind_nm * rng.normal(size=3)
            w = w + tick / fine * (torque - np.cross(w, j * w)) / j
        gyro.append(w + 0.01 * rng.normal(size=3))
    n = len(gyro)
    return Track(
        source="made",
        imu_s=tick * np.arange(1, n + 1, dtype=float),
        specific_force=np.tile((0.0, 0.0, -9.81), (n, 1)),
        rate=np.array(gyro),
        motor_s=np.array(stamps),
        motors=np.array(commands),
    )


def excited_track(
    amplitudes: tuple[float, float, float], seconds: float = 20.0, lag_s: float = 0.025
) -> Track:
    """Return a copy of a simulated rotation, which a test may change."""
    return copy.deepcopy(simulated_rotation(amplitudes, seconds, lag_s))


def test_excitation_of_all_axes_gives_all_three_inertias() -> None:
    result = calibrate_inertia([excited_track((0.02, 0.02, 0.05))], VEHICLE)
    for axis, true in zip(result.axes, INERTIA, strict=True):
        assert axis.value == pytest.approx(true, rel=0.04), axis
        assert axis.low is not None
        assert axis.high is not None
        assert axis.low < true < axis.high
        assert axis.high < 1.25 * axis.low
    assert result.motor_lag_s == pytest.approx(0.025, rel=0.25)


@pytest.mark.rest
def test_a_different_motor_lag_is_estimated() -> None:
    result = calibrate_inertia([excited_track((0.02, 0.02, 0.05), lag_s=0.05)], VEHICLE)
    assert result.motor_lag_s == pytest.approx(0.05, rel=0.25)
    assert result.axes[0].value == pytest.approx(INERTIA[0], rel=0.06)


@pytest.mark.rest
def test_yaw_inertia_scales_with_the_propeller_torque() -> None:
    """Only the ratio of inertia to propeller torque is observable: half the torque gives half the inertia."""
    track = excited_track((0.02, 0.02, 0.05))
    airframe = msgspec.structs.replace(VEHICLE.airframe, yaw_torque_per_thrust_m=0.008)
    half = calibrate_inertia([track], msgspec.structs.replace(VEHICLE, airframe=airframe))
    # The gyroscopic terms do not scale with the torque, hence the wide tolerance.
    assert half.axes[2].value == pytest.approx(0.5 * INERTIA[2], rel=0.15)
    assert half.axes[1].value == pytest.approx(INERTIA[1], rel=0.04)


def test_an_axis_without_excitation_is_refused() -> None:
    result = calibrate_inertia([excited_track((0.02, 0.0, 0.0))], VEHICLE)
    roll, _, yaw = result.axes
    assert roll.value == pytest.approx(INERTIA[0], rel=0.06)
    assert (yaw.axis, yaw.value) == ("yaw", None)
    assert "excitation" in yaw.refused
    assert result.inertia_kg_m2[2] is None


def test_a_track_without_any_excitation_is_refused() -> None:
    track = excited_track((0.0, 0.0, 0.0))
    track.motors[:] = HOVER
    with pytest.raises(InputError, match=r"no axis is excited: roll: .*pitch: .*yaw: "):
        calibrate_inertia([track], VEHICLE)


@pytest.mark.rest
def test_a_wrong_motor_order_is_detected() -> None:
    """With left and right exchanged, roll and yaw rates oppose the torques; pitch is unaffected."""
    track = excited_track((0.02, 0.02, 0.05))
    track.motors[:] = track.motors[:, (2, 3, 0, 1)]
    roll, pitch, yaw = calibrate_inertia([track], VEHICLE).axes
    assert (roll.value, yaw.value) == (None, None)
    assert "cause no rotation" in roll.refused
    assert pitch.value == pytest.approx(INERTIA[1], rel=0.1)


def test_slow_commands_other_airframes_and_short_tracks_are_refused() -> None:
    track = excited_track((0.02, 0.02, 0.05), seconds=6.0)
    slow = msgspec.structs.replace(track, motor_s=track.motor_s[::20], motors=track.motors[::20])
    with pytest.raises(InputError, match="motor commands at 6 Hz, at least 50"):
        calibrate_inertia([slow], VEHICLE)
    six = msgspec.structs.replace(track, motors=np.hstack([track.motors, track.motors[:, :2]]))
    with pytest.raises(InputError, match="6 motors, but the configured airframe has 4"):
        calibrate_inertia([six], VEHICLE)
    with pytest.raises(InputError, match=r"windows of 0\.1 s"):
        calibrate_inertia([excited_track((0.02, 0.02, 0.05), seconds=2.0)], VEHICLE)


@pytest.mark.rest
def test_contacts_and_ground_time_are_excluded() -> None:
    """External torques in a contact and on the ground do not affect the estimate."""
    track = excited_track((0.02, 0.02, 0.05))
    hit = (track.imu_s > 8.0) & (track.imu_s < 8.4)
    track.specific_force[hit] = (20.0, 0.0, -9.81)
    track.rate[hit] += 5.0 * np.sin(30.0 * track.imu_s[hit])[:, None]
    track.rate[track.imu_s < 3.0] = 0.0
    track.ground.append((0.0, 3.0))
    result = calibrate_inertia([track], VEHICLE)
    assert result.axes[0].value == pytest.approx(INERTIA[0], rel=0.05)


def test_the_command_writes_only_the_identified_axis_to_the_configuration(
    flown: SharedFlights, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An ordinary flight excites pitch, the axis of its approach; `--write` leaves the other axes."""
    config = tmp_path / "mine.yaml"
    text = (ROOT / "configs" / "dart.yaml").read_text()
    config.write_text(text.replace("[0.0125, 0.0125, 0.022]", "[0.02, 0.02, 0.03]"))
    log = str(flown("paper_single_wall", 1).log)
    assert main(["calibrate", "inertia", log, "--config", str(config), "--write", "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    pitch = output["axes"][1]
    assert pitch["low"] < 0.0125 < pitch["high"]
    found = load_vehicle(config).airframe.inertia_kg_m2
    kept = (0.02, 0.02, 0.03)
    for value, axis, old in zip(found, output["axes"], kept, strict=True):
        assert value == pytest.approx(axis["value"] or old, abs=1e-6)
    changed = [a for a, b in zip(text.splitlines(), config.read_text().splitlines(), strict=True) if a != b]
    assert len(changed) == 1
    assert main(["calibrate", "inertia", log, "--config", str(config)]) == 0
    assert "about" in capsys.readouterr().out


@pytest.mark.rest
def test_px4_logs_give_the_inertia(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    track = excited_track((0.02, 0.02, 0.05))
    imu = zip(track.imu_s, np.hstack([track.rate, track.specific_force]).tolist(), strict=True)
    commands = zip(track.motor_s, track.motors.tolist(), strict=True)
    topics = {
        (name, 0): (fields, [(10_000_000 + round(1e6 * float(t)), values) for t, values in rows])
        for name, fields, rows in (
            ("sensor_combined", "float[3] gyro_rad;float[3] accelerometer_m_s2;", imu),
            ("actuator_motors", "float[4] control;", commands),
        )
    }
    result = calibrate_inertia([read_calibration_series(write_ulog(tmp_path / "a.ulg", topics))], VEHICLE)
    for axis, true in zip(result.axes, INERTIA, strict=True):
        assert axis.value == pytest.approx(true, rel=0.04)
    assert any("actuator_motors" in note for note in result.notes)
