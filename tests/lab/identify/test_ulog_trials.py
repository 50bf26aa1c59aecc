"""ULogs as trials: a bump in flight, and drops with and without positions."""

from __future__ import annotations

import json
import math
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
from dart_flight.lab.identify.judgement import judge_fit
from dart_flight.lab.identify.trials import TrialReading, read_trials
from dart_flight.lab.predict.path import Contact, trajectory
from tests.doubles.ulog_file import write_ulog

pytest.importorskip("pyulog")
pytest.importorskip("scipy")

VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))
MASS_KG = VEHICLE.airframe.mass_kg
WALL = VEHICLE.materials["acrylic"].rigid
GROUND = VEHICLE.materials["concrete"].of(Mode.FLEXIBLE)
BEGIN_S = 2.0  # stamp of the first touch


def ulog(path: Path, time: Any, place: Any, specific: Any, yaw: float = 0.0, positions: bool = True) -> Path:
    """A level vehicle's log: place in NED (n, 3), specific force in FRD (n, 3), every millisecond given."""
    stamps = np.round((time + BEGIN_S) * 1e6)
    turn = [math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)]
    topics = {
        ("sensor_combined", 0): (
            "float[3] gyro_rad;float[3] accelerometer_m_s2;",
            [(t, [0.0, 0.0, 0.0, *f]) for t, f in zip(stamps[::4], specific[::4].tolist(), strict=True)],
        ),
        ("vehicle_attitude", 0): ("float[4] q;", [(t, turn) for t in stamps[::20]]),
    }
    if positions:
        topics["vehicle_local_position", 0] = (
            "float x;float y;float z;float vx;float vy;float vz;",
            [(t, [*p, 0.0, 0.0, 0.0]) for t, p in zip(stamps[::5], place[::5].tolist(), strict=True)],
        )
    return write_ulog(path, topics)


def bump(path: Path, speed_m_s: float, heading_deg: float, yaw: float, seed: int) -> Path:
    """A hit of a wall whose outward normal has that heading, somewhere out in the field."""
    random = np.random.default_rng(seed)
    contact = Contact(WALL, MASS_KG, -speed_m_s, Onset.LCP)
    time = np.arange(-0.6, 0.35, 1e-3)
    way = trajectory(contact, time, 0.4)
    heading = math.radians(heading_deg)
    normal = np.array([math.cos(heading), math.sin(heading), 0.0])
    tangent = np.array([-normal[1], normal[0], 0.0])
    place = np.array([7.0, -3.0, -1.5]) + np.outer(way.normal_m, normal) + np.outer(way.tangential_m, tangent)
    push = np.outer(way.normal_force_n / MASS_KG, normal)
    c, s = math.cos(yaw), math.sin(yaw)
    body = push @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    body[:, 2] -= GRAVITY_M_S2
    place = place + random.normal(0.0, 5e-4, place.shape)
    return ulog(path, time, place, body + random.normal(0.0, 0.5, body.shape), yaw)


def dropped(path: Path, height_m: float, seed: int, positions: bool) -> Path:
    """Held, released, one contact with the ground, thrown back up to its apex and down again."""
    random = np.random.default_rng(seed)
    numbers = drop(GROUND, MASS_KG, height_m, Onset.LCP)
    contact = Contact(GROUND, MASS_KG, -numbers.onset_speed_m_s, Onset.LCP, acceleration_m_s2=-GRAVITY_M_S2)
    flight = 2.0 * float(contact.normal(contact.end_s)[1]) / GRAVITY_M_S2
    time = np.arange(-numbers.onset_s - 0.5, contact.end_s + flight + 0.15, 1e-3)
    height, _, force = (np.asarray(v) for v in contact.normal(time)[:3])
    again = np.asarray(contact.normal(time - contact.end_s - flight)[2])
    held = time < -numbers.onset_s
    up = np.where(held, GRAVITY_M_S2, (force + 0.5 * again) / MASS_KG)
    place = np.stack([np.zeros_like(time), np.zeros_like(time), -np.where(held, height_m, height)], axis=1)
    specific = np.stack([np.zeros_like(time), np.zeros_like(time), -up], axis=1)
    return ulog(
        path,
        time,
        place + random.normal(0.0, 3e-4, place.shape),
        specific + random.normal(0.0, 0.2, specific.shape),
        positions=positions,
    )


def identified(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert main(["identify", *words, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def about(found: dict[str, Any], truth: Coefficients, rel: float) -> None:
    assert found["k"]["value"] == pytest.approx(truth.k, rel=rel)
    assert found["f"]["value"] == pytest.approx(truth.f, rel=2.0 * rel)


@pytest.mark.parametrize(("heading_deg", "yaw"), [(0.0, 0.0), (135.0, 0.6), (-60.0, -2.0)])
def test_a_bump_in_a_log_is_a_trial_wherever_the_wall_was(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], heading_deg: float, yaw: float
) -> None:
    logs = [str(bump(tmp_path / f"{v}.ulg", v, heading_deg, yaw, 3)) for v in (0.7, 1.2)]
    for log, speed in zip(logs, (0.7, 1.2), strict=True):
        found = identified(capsys, log, "--bump", "--mode", "rigid")
        assert found["trials"][0]["normal_m_s"] == pytest.approx(-speed, rel=0.05)
        assert abs(found["trials"][0]["tangential_m_s"]) == pytest.approx(0.4, abs=0.05)
        about(found["coefficients"]["rigid"], WALL, 0.15)


def test_a_bump_needs_the_accelerometer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    time = np.arange(-0.5, 0.5, 1e-3)
    rows = [(round((t + BEGIN_S) * 1e6), [t, 0.0, 0.0, 0.0, 0.0, 0.0]) for t in time.tolist()]
    topics = {("vehicle_local_position", 0): ("float x;float y;float z;float vx;float vy;float vz;", rows)}
    assert main(["identify", str(write_ulog(tmp_path / "a.ulg", topics)), "--bump"]) == 2
    assert "sensor_combined" in capsys.readouterr().err


@pytest.mark.parametrize("positions", [True, False])
def test_drops_recorded_by_the_vehicle_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], positions: bool
) -> None:
    logs = [str(dropped(tmp_path / f"{h}.ulg", h, 4, positions)) for h in (0.1, 0.3)]
    found = identified(capsys, *logs, "--drop", "--mode", "flexible")
    assert [t["used"] for t in found["trials"]] == ["samples" if positions else "whole"] * 2
    for trial, height in zip(found["trials"], (0.1, 0.3), strict=True):
        truth = drop(GROUND, MASS_KG, height, Onset.LCP)
        assert -trial["normal_m_s"] == pytest.approx(truth.onset_speed_m_s, rel=0.05 if positions else 0.08)
        assert trial["peak_force_n"] == pytest.approx(truth.peak_force_n, rel=0.1)
    about(found["coefficients"]["flexible"], GROUND, 0.15)
    assert found["fit"]["good"] is True


def test_coefficients_that_do_not_give_back_the_drops_are_a_poor_fit(tmp_path: Path) -> None:
    how = TrialReading(mode="flexible", drop=True, mass_kg=MASS_KG)
    trials = [
        trial
        for height in (0.1, 0.2, 0.3)
        for trial in read_trials(dropped(tmp_path / f"{height}.ulg", height, 6, positions=False), how)
    ]
    found = identify(trials, MASS_KG, Onset.LCP)
    assert judge_fit(found, trials, MASS_KG, Onset.LCP).good is True
    k = found.coefficients["flexible"]["k"]
    assert k is not None
    wrong = {"flexible": found.coefficients["flexible"] | {"k": k._replace(value=3.0 * k.value)}}
    judged = judge_fit(found._replace(coefficients=wrong), trials, MASS_KG, Onset.LCP)
    assert judged.good is False
    assert any("flexible peak" in line for line in judged.says)
    unknown = {"flexible": dict.fromkeys(found.coefficients["flexible"])}
    assert judge_fit(found._replace(coefficients=unknown), trials, MASS_KG, Onset.LCP).good is None
