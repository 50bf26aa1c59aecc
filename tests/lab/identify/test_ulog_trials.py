"""ULogs as trials: drops with and without positions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.records import Mode
from dart_flight.cli import main
from dart_flight.config.vehicle import packaged
from dart_flight.config.vehicle.airframe import Coefficients
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.contact.contact_map import drop
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.fit import identify
from dart_flight.lab.identify.fit_quality import assess_fit, expected_residuals
from dart_flight.lab.identify.measured_impacts import measure_impact
from dart_flight.lab.identify.problem import LawProblem
from dart_flight.lab.identify.trial_readers import read_trials
from dart_flight.lab.identify.trials import TrialReading
from dart_flight.lab.predict.path import ContactMotion
from tests.doubles.ulog_file import write_ulog

pytest.importorskip("pyulog")
pytest.importorskip("scipy")

VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))
MASS_KG = VEHICLE.airframe.mass_kg
GROUND = VEHICLE.materials["concrete"].coefficients(Mode.FLEXIBLE)
BEGIN_S = 2.0  # stamp of the first touch


def write_level_ulog(path: Path, time: Any, place: Any, specific: Any, positions: bool) -> Path:
    """Write the log of a level vehicle heading north, from NED positions and FRD forces (n, 3) every ms."""
    stamps = np.round((time + BEGIN_S) * 1e6)
    topics = {
        ("sensor_combined", 0): (
            "float[3] gyro_rad;float[3] accelerometer_m_s2;",
            [(t, [0.0, 0.0, 0.0, *f]) for t, f in zip(stamps[::4], specific[::4].tolist(), strict=True)],
        ),
        ("vehicle_attitude", 0): ("float[4] q;", [(t, [1.0, 0.0, 0.0, 0.0]) for t in stamps[::20]]),
    }
    if positions:
        topics["vehicle_local_position", 0] = (
            "float x;float y;float z;float vx;float vy;float vz;",
            [(t, [*p, 0.0, 0.0, 0.0]) for t, p in zip(stamps[::5], place[::5].tolist(), strict=True)],
        )
    return write_ulog(path, topics)


def write_drop(path: Path, height_m: float, seed: int, positions: bool) -> Path:
    """Write the log of a drop: hold, release, contact with the ground, rebound and second contact."""
    random = np.random.default_rng(seed)
    numbers = drop(GROUND, MASS_KG, height_m, Onset.LCP)
    contact = ContactMotion(
        GROUND, MASS_KG, -numbers.onset_speed_m_s, Onset.LCP, acceleration_m_s2=-GRAVITY_M_S2
    )
    flight = 2.0 * float(contact.normal(contact.end_s)[1]) / GRAVITY_M_S2
    time = np.arange(-numbers.onset_s - 0.5, contact.end_s + flight + 0.15, 1e-3)
    height, _, force = (np.asarray(v) for v in contact.normal(time)[:3])
    second_contact = np.asarray(contact.normal(time - contact.end_s - flight)[2])
    held = time < -numbers.onset_s
    up = np.where(held, GRAVITY_M_S2, (force + 0.5 * second_contact) / MASS_KG)
    place = np.stack([np.zeros_like(time), np.zeros_like(time), -np.where(held, height_m, height)], axis=1)
    specific = np.stack([np.zeros_like(time), np.zeros_like(time), -up], axis=1)
    return write_level_ulog(
        path,
        time,
        place + random.normal(0.0, 3e-4, place.shape),
        specific + random.normal(0.0, 0.2, specific.shape),
        positions,
    )


def run_identify(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert main(["identify", *words, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def assert_near(found: dict[str, Any], truth: Coefficients, rel: float) -> None:
    assert found["k"]["value"] == pytest.approx(truth.k, rel=rel)
    assert found["f"]["value"] == pytest.approx(truth.f, rel=2.0 * rel)


@pytest.mark.parametrize("positions", [True, False])
def test_drops_are_identified_with_and_without_recorded_positions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], positions: bool
) -> None:
    logs = [str(write_drop(tmp_path / f"{h}.ulg", h, 4, positions)) for h in (0.1, 0.3)]
    found = run_identify(capsys, *logs, "--drop", "--mode", "flexible")
    assert [t["used"] for t in found["trials"]] == ["samples" if positions else "whole"] * 2
    for trial, height in zip(found["trials"], (0.1, 0.3), strict=True):
        truth = drop(GROUND, MASS_KG, height, Onset.LCP)
        assert -trial["normal_m_s"] == pytest.approx(truth.onset_speed_m_s, rel=0.05 if positions else 0.08)
        assert trial["peak_force_n"] == pytest.approx(truth.peak_force_n, rel=0.1)
    assert_near(found["coefficients"]["flexible"], GROUND, 0.15)
    assert found["fit"]["good"] is True


def test_coefficients_that_do_not_reproduce_the_drops_are_a_poor_fit(tmp_path: Path) -> None:
    reading = TrialReading(mode="flexible", drop=True, mass_kg=MASS_KG)
    trials = [
        trial
        for height in (0.1, 0.2, 0.3)
        for trial in read_trials(write_drop(tmp_path / f"{height}.ulg", height, 6, positions=False), reading)
    ]
    found = identify(trials, MASS_KG, Onset.LCP)
    assert found.fit.good is True
    whole = LawProblem([measure_impact(trial, MASS_KG) for trial in trials], MASS_KG, Onset.LCP)
    expected = expected_residuals(trials, whole.hits)
    k = found.coefficients["flexible"]["k"]
    assert k is not None
    wrong = {"flexible": found.coefficients["flexible"] | {"k": k._replace(value=3.0 * k.value)}}
    assessed = assess_fit(wrong, whole, found.residuals, expected)
    assert assessed.good is False
    assert any("flexible peak" in line for line in assessed.messages)
    unknown = {"flexible": dict.fromkeys(found.coefficients["flexible"])}
    assert assess_fit(unknown, whole, found.residuals, expected).good is None
