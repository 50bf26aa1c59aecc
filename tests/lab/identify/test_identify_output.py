"""What `identify` hands back: what it found, whatever becomes of the file, and whether to believe it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dart_flight.base.records import Mode, TruthContact
from dart_flight.cli import main
from dart_flight.config.vehicle import packaged
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.fit import identify
from dart_flight.lab.identify.flight_trials import trials_at_one
from dart_flight.lab.identify.synthetic_trials import drop_trial, wall_trial, write_csv
from dart_flight.recording.reader import read_log
from tests.shared_flights import SharedFlights

pytest.importorskip("scipy")

VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))


@pytest.fixture
def drops(tmp_path: Path) -> list[str]:
    random = np.random.default_rng(2)
    concrete = VEHICLE.materials["concrete"]
    paths = []
    for height in (0.05, 0.2):
        path = tmp_path / f"drop_{height:g}.csv"
        write_csv(drop_trial(concrete.rigid, height, random), path)
        paths.append(str(path))
    return paths


@pytest.fixture
def hits(tmp_path: Path) -> list[str]:
    random = np.random.default_rng(1)
    paths = []
    for speed in (0.6, 1.2):
        path = tmp_path / f"hit_{speed:g}.csv"
        c = VEHICLE.materials["acrylic"].coefficients(Mode.FLEXIBLE)
        write_csv(
            wall_trial(c, -speed, random, mode="flexible", tangential_m_s=0.5, with_vertical=True), path
        )
        paths.append(str(path))
    return paths


def test_a_new_material_keeps_what_is_known(
    drops: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "felt.yaml"
    words = ["identify", *drops, "--mode", "rigid", "--drop", "--surface", "felt", "-o", str(out)]
    assert main([*words, "--json"]) == 0
    streams = capsys.readouterr()
    found = json.loads(streams.out)["coefficients"]["rigid"]
    assert found["nu"] is None
    assert found["k"]["value"] == pytest.approx(VEHICLE.materials["concrete"].rigid.k, rel=0.03)
    text = out.read_text()
    assert f"k: {found['k']['value']:.6g}" in text
    assert "nu not determined by the trials, assumed" in text
    assert "assumed: mu of rigid, nu of rigid" in text, "in the source, which `check` shows"
    assert "# flexible: unknown from these trials" in text
    assert "a configuration also needs mode flexible" in streams.err
    assert "mu of rigid, nu of rigid" in streams.err


def test_with_both_modes_the_entry_is_accepted(
    drops: list[str], hits: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "felt.yaml"
    assert main(["identify", *hits, "--mode", "flexible", "--surface", "felt", "-o", str(out)]) == 0
    flexible = next(line for line in out.read_text().splitlines() if line.startswith("    flexible:"))
    assert main(["identify", *drops, "--mode", "rigid", "--drop", "--surface", "felt", "-o", str(out)]) == 0
    entry = out.read_text().splitlines()
    entry = [flexible if "# flexible" in line else line for line in entry]
    config = tmp_path / "dart.yaml"
    text = packaged("configs", "dart.yaml").read_text()
    config.write_text(text.replace("\n  concrete:\n", "\n" + "\n".join(entry[1:]) + "\n  concrete:\n", 1))
    material = load_vehicle(config).materials["felt"]
    assert material.coefficients(Mode.RIGID).nu == 0.0
    assert "assumed" in material.source


def test_what_was_found_is_printed_before_a_file_that_cannot_be_written(
    drops: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "missing" / "felt.yaml"
    words = ["identify", *drops, "--mode", "rigid", "--drop", "--surface", "felt", "-o", str(out), "--json"]
    assert main(words) == 2
    streams = capsys.readouterr()
    assert json.loads(streams.out)["coefficients"]["rigid"]["k"]["value"] > 0.0
    assert "cannot write" in streams.err


def test_a_good_fit_is_called_good(
    drops: list[str], hits: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    for words in ([*drops, "--drop", "--mode", "rigid"], [*hits, "--mode", "flexible"]):
        assert main(["identify", *words]) == 0
        streams = capsys.readouterr()
        assert "fit: good" in streams.out
        assert "95 %" in streams.out
        assert "poor" not in streams.err


def test_wall_hits_taken_for_drops_are_noticed(
    hits: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "entry.yaml"
    words = ["identify", *hits, "--drop", "--mode", "flexible", "--surface", "acrylic", "-o", str(out)]
    assert main([*words, "--json"]) == 0
    streams = capsys.readouterr()
    fit = json.loads(streams.out)["fit"]
    assert fit["good"] is False
    assert "--drop" in fit["says"][0]
    assert "poor fit: the residual of normal_m" in streams.err
    assert "POOR FIT" in out.read_text()


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line that the call is refused with."""
    assert main(["identify", *words]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_a_flight_log_has_no_drops(
    flown: SharedFlights, drops: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = str(flown("paper_single_wall", 1).log), tmp_path / "entry.yaml"
    for words in (
        [log, "--drop"],
        [log, "--drop", "0.2", "--surface", "acrylic", "-o", str(out)],
        [str(Path(log).parent), "--drop"],
        [*drops, log, "--drop"],
    ):
        said = refused(capsys, *words)
        assert said == f"{log}: drop: a flight log contains wall collisions, not drops: omit --drop\n"
    assert not out.exists()


@pytest.mark.parametrize(
    "option", [["--wall", "3", "2", "225"], ["--columns", "time_s=t"]], ids=lambda words: words[0]
)
def test_an_option_for_files_of_another_kind_is_refused(
    flown: SharedFlights, option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(capsys, str(flown("paper_single_wall", 1).log), *option)
    assert said.startswith(f"{option[0].removeprefix('--')}: applies to .")


def test_mode_chooses_among_the_collisions_of_a_flight(
    flown: SharedFlights, capsys: pytest.CaptureFixture[str]
) -> None:
    """The dual collision meets wood with flexible arms, then acrylic with rigid ones."""
    log = str(flown("paper_dual_collision", 1).log)
    for mode in ("flexible", "rigid"):
        assert main(["identify", log, "--mode", mode, "--json"]) == 0
        assert list(json.loads(capsys.readouterr().out)["coefficients"]) == [mode]
    said = refused(capsys, log, "--mode", "flexible", "--surface", "acrylic")
    assert "no collision with acrylic in flexible mode in this flight" in said


def test_a_flight_log_is_of_the_vehicle_that_flew(
    flown: SharedFlights, hits: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever configuration is at hand: with another mass k would be off by a third."""
    log, other = str(flown("paper_single_wall", 1).log), tmp_path / "light.yaml"
    other.write_text(packaged("configs", "dart.yaml").read_text().replace("mass_kg: 1.3", "mass_kg: 0.9"))
    found = {}
    for config in (packaged("configs", "dart.yaml"), other):
        assert main(["identify", log, "--config", str(config), "--json"]) == 0
        streams = capsys.readouterr()
        found[config] = json.loads(streams.out)
        assert ("not the configuration's (0.9 kg)" in streams.err) == (config == other)
    right, same = found.values()
    assert same["coefficients"] == right["coefficients"]
    assert same["vehicle"]["mass_kg"] == 1.3
    k = VEHICLE.materials["acrylic"].coefficients(Mode.FLEXIBLE).k
    assert right["coefficients"]["flexible"]["k"]["value"] == pytest.approx(k, rel=0.04)
    said = refused(capsys, *hits, log, "--mode", "flexible", "--config", str(other))
    assert "a trial of another vehicle (0.9 kg, not 1.3 kg): identify the vehicles separately" in said


def test_a_mass_that_is_not_the_logs_is_taken_and_named(
    flown: SharedFlights, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(flown("paper_single_wall", 1).log)
    assert main(["identify", log, "--mass", "0.9", "--json"]) == 0
    streams = capsys.readouterr()
    assert "the fit uses a mass of 0.9 kg, but the forces in the flight logs assume 1.3 kg" in streams.err
    k = VEHICLE.materials["acrylic"].coefficients(Mode.FLEXIBLE).k
    assert abs(json.loads(streams.out)["coefficients"]["flexible"]["k"]["value"] / k - 1.0) > 0.1


def test_a_vehicle_that_turns_widens_what_is_said_of_friction(flown: SharedFlights) -> None:
    """The body with guards is turned by friction, and the law is a point's: mu comes out too low."""
    log = read_log(flown("paper_single_wall", 1).log)
    (trial,) = trials_at_one(log, "acrylic")
    (contact,) = (e.record for e in log.entries if isinstance(e.record, TruthContact))
    assert trial.turn_rad_s == pytest.approx(abs(contact.rate_out_frd[2]), abs=0.3)
    truth = VEHICLE.materials["acrylic"].coefficients(Mode.FLEXIBLE).mu
    for turns in (True, False):
        given = trial if turns else replace(trial, turn_rad_s=0.0)
        found = identify([given], VEHICLE.airframe.mass_kg, Onset(VEHICLE.onset))
        mu = found.coefficients["flexible"]["mu"]
        assert mu is not None
        assert any("the vehicle turned at up to" in note for note in found.notes) == turns
        assert (mu.low <= truth <= mu.high) == turns
        assert mu.value < 0.9 * truth
