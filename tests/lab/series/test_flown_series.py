"""A series in the fast world, from `new` to `apply`; and a hit that is harder than predicted."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dart_flight.base.records import GuardEvent, Override
from dart_flight.cli import main
from dart_flight.config.vehicle import load_vehicle
from dart_flight.contact.coefficients import CoefficientArrays
from dart_flight.contact.contact_map import contact_map
from dart_flight.contact.law import Onset
from dart_flight.lab.series.evidence import read_evidence
from dart_flight.lab.series.series_file import SeriesFolder
from dart_flight.lab.series.status import predict_hit
from dart_flight.recording.found import LOG_NAME
from dart_flight.recording.reader import read_log
from dart_flight.run.replay import replay
from tests.command_fixtures import folder  # noqa: F401

ROOT = Path(__file__).parents[3]
MISSION = str(ROOT / "missions/single_wall.yaml")
pytestmark = [pytest.mark.rest, pytest.mark.usefixtures("folder")]


def new_series(*options: str) -> SeriesFolder:
    config = Path("mine.yaml")
    config.write_text((ROOT / "configs/dart.yaml").read_text("utf-8"), "utf-8")
    given = ("--mission", MISSION, "--wall", "acrylic", "--config", str(config), "--modes", "flexible")
    assert main(["series", "new", "afternoon", *given, *options]) == 0
    return SeriesFolder(Path("afternoon"))


def check_the_fastest_hit_is_predicted_with_its_thrust(series: SeriesFolder) -> None:
    """With the true coefficients, the law alone ignores the thrust, which slows the rebound."""
    hits = read_evidence(series).hits
    hit = max(hits, key=lambda one: -(one.verdict.measured.normal_m_s or 0.0))
    vehicle, true = load_vehicle(), hit.verdict.truth
    coefficients = vehicle.materials["acrylic"].coefficients(hit.mode).scaled(1.2, 1.0, 1.0)
    predicted = predict_hit(hit, coefficients, series.mission())
    assert true is not None
    assert true.normal_m_s is not None
    assert true.normal_out_m_s is not None
    assert predicted is not None
    assert predicted[0] == pytest.approx(true.peak_force_n, rel=0.03)
    alone = contact_map(
        CoefficientArrays.from_table(coefficients),
        vehicle.airframe.mass_kg,
        true.normal_m_s,
        0.0,
        Onset(vehicle.onset),
    )
    missed = float(alone.normal_out_m_s) - true.normal_out_m_s
    assert missed > 0.02
    assert abs(predicted[1] - true.normal_out_m_s) < 0.6 * missed


def test_a_series_in_simulation_finds_a_stiffer_wall(capfd: pytest.CaptureFixture[str]) -> None:
    """The wall's k is 1.2 times the configured k; one hit is excluded, and its flight's log is cut off."""
    series = new_series("--hits-per-flight", "6")
    assert main(["series", "fly", "afternoon", "--fast", "--fault", "wall-harder=1.2"]) == 0
    check_the_fastest_hit_is_predicted_with_its_thrust(series)
    (log,) = series.logs().values()
    data = log.read_bytes()
    log.write_bytes(data[: len(data) * 3 // 4])
    assert main(["series", "exclude", "afternoon", "01:2", "--why", "touched a cable"]) == 0
    capfd.readouterr()
    assert main(["series", "status", "afternoon", "--json"]) == 0
    status = json.loads(capfd.readouterr().out)
    mode = status["modes"]["flexible"]
    assert any("touched a cable" in why for why in mode["aside"].values())
    assert [text for text in status["flights"].values() if "cut off" in text]
    assert 2 <= mode["used"] < 6
    true_k = 1.2 * load_vehicle().materials["acrylic"].coefficients(series.settings.modes[0]).k
    _, low, high = mode["coefficients"]["k"]["whole"]
    assert low < true_k < high
    assert main(["series", "report", "afternoon"]) == 0
    page = Path("afternoon/series.html").read_text("utf-8")
    assert "set aside: excluded: touched a cable" in page
    assert re.search(r"1 flight on \d{4}-\d\d-\d\d with the vehicle mine.yaml, 1.3 kg", page)
    assert main(["series", "apply", "afternoon", "--config", "mine.yaml"]) == 0
    applied = load_vehicle("mine.yaml").materials["acrylic"].flexible
    assert applied is not None
    assert applied.k == pytest.approx(true_k, rel=0.05)


def test_a_much_harder_hit_ends_the_batch_and_replays(capfd: pytest.CaptureFixture[str]) -> None:
    series = new_series("--hits-per-flight", "3")
    assert main(["series", "fly", "afternoon", "--fast", "--fault", "wall-harder=8"]) == 1
    (path,) = (series.path / "batches/01/flights").glob(f"*/{LOG_NAME}")
    log = read_log(path)
    (event,) = (e.record for e in log.entries if isinstance(e.record, GuardEvent))
    assert (event.rule, event.action) == ("harder_hit", Override.BREAK_OFF)
    result = replay(log)
    assert result.exact
    assert result.equal
    # The next batch is planned with what this hit has shown.
    capfd.readouterr()
    assert main(["series", "next", "afternoon"]) == 0
    assert "batches/02/mission.yaml" in capfd.readouterr().err


_CHILD = """
import signal, sys
signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))
print("up", flush=True)
signal.pause()
"""
_SERIES = """
import sys
from dart_flight.lab.commands.series_command import run_child
sys.exit(run_child([sys.executable, "-c", sys.argv[1]]))
"""


def test_a_signal_to_the_series_reaches_the_flight() -> None:
    command = [sys.executable, "-c", _SERIES, _CHILD]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as series:
        assert series.stdout is not None
        assert series.stdout.readline() == "up\n"
        series.terminate()
        assert series.wait(30.0) == 7
