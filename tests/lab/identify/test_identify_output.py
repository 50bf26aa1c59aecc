"""The output of `identify`: the result, the entry of a material, the quality of the fit and refusals."""

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
from dart_flight.recording.reader import read_log
from tests.doubles.synthetic_trials import drop_trial, wall_trial, write_csv
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


def test_a_partial_entry_lists_identified_and_assumed_coefficients(
    drops: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "felt.yaml"
    arguments = ["identify", *drops, "--mode", "rigid", "--drop", "--surface", "felt", "-o", str(out)]
    assert main([*arguments, "--json"]) == 0
    streams = capsys.readouterr()
    found = json.loads(streams.out)["coefficients"]["rigid"]
    assert found["nu"] is None
    assert found["k"]["value"] == pytest.approx(VEHICLE.materials["concrete"].rigid.k, rel=0.03)
    text = out.read_text()
    assert f"k: {found['k']['value']:.6g}" in text
    assert "nu not determined by the trials, assumed" in text
    assert "assumed: mu of rigid, nu of rigid" in text, "`check` shows the source"
    assert "# flexible: unknown from these trials" in text
    assert "a configuration also needs mode flexible" in streams.err
    assert "mu of rigid, nu of rigid" in streams.err


def test_an_entry_with_both_modes_of_good_fits_is_accepted_by_the_configuration(
    drops: list[str], hits: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, entries = tmp_path / "felt.yaml", []
    for trials in ([*hits, "--mode", "flexible"], [*drops, "--mode", "rigid", "--drop"]):
        assert main(["identify", *trials, "--surface", "felt", "-o", str(out)]) == 0
        streams = capsys.readouterr()
        assert "fit: good" in streams.out
        assert "95 %" in streams.out
        assert "poor" not in streams.err
        entries.append(out.read_text().splitlines())
    flexible = next(line for line in entries[0] if line.startswith("    flexible:"))
    entry = [flexible if "# flexible" in line else line for line in entries[1]]
    config = tmp_path / "dart.yaml"
    text = packaged("configs", "dart.yaml").read_text()
    config.write_text(text.replace("\n  concrete:\n", "\n" + "\n".join(entry[1:]) + "\n  concrete:\n", 1))
    material = load_vehicle(config).materials["felt"]
    assert material.coefficients(Mode.RIGID).nu == 0.0
    assert "assumed" in material.source


def test_the_result_is_printed_although_the_file_cannot_be_written(
    drops: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "missing" / "felt.yaml"
    arguments = [
        "identify",
        *drops,
        "--mode",
        "rigid",
        "--drop",
        "--surface",
        "felt",
        "-o",
        str(out),
        "--json",
    ]
    assert main(arguments) == 2
    streams = capsys.readouterr()
    assert json.loads(streams.out)["coefficients"]["rigid"]["k"]["value"] > 0.0
    assert "cannot write" in streams.err


@pytest.mark.rest
def test_wall_impacts_read_as_drops_are_reported_as_a_poor_fit(
    hits: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "entry.yaml"
    arguments = ["identify", *hits, "--drop", "--mode", "flexible", "--surface", "acrylic", "-o", str(out)]
    assert main([*arguments, "--json"]) == 0
    streams = capsys.readouterr()
    fit = json.loads(streams.out)["fit"]
    assert fit["good"] is False
    assert "--drop" in fit["messages"][0]
    assert "poor fit: the residual of normal_m" in streams.err
    assert "POOR FIT" in out.read_text()


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return the one line of a refusal."""
    assert main(["identify", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_drop_is_refused_for_a_flight_log(
    flown: SharedFlights, drops: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = str(flown("paper_single_wall", 1).log), tmp_path / "entry.yaml"
    for arguments in (
        [log, "--drop"],
        [log, "--drop", "0.2", "--surface", "acrylic", "-o", str(out)],
        [str(Path(log).parent), "--drop"],
        [*drops, log, "--drop"],
    ):
        message = refusal(capsys, *arguments)
        assert message == f"{log}: drop: a flight log contains wall collisions, not drops: omit --drop\n"
    assert not out.exists()


@pytest.mark.parametrize(
    "option", [["--wall", "3", "2", "225"], ["--columns", "time_s=t"]], ids=lambda arguments: arguments[0]
)
def test_an_option_for_another_file_type_is_refused(
    flown: SharedFlights, option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    message = refusal(capsys, str(flown("paper_single_wall", 1).log), *option)
    assert message.startswith(f"{option[0].removeprefix('--')}: applies only to .")


@pytest.mark.rest
def test_mode_selects_among_the_collisions_of_a_flight(
    flown: SharedFlights, capsys: pytest.CaptureFixture[str]
) -> None:
    """The dual collision hits wood in flexible mode, then acrylic in rigid mode."""
    log = str(flown("paper_dual_collision", 1).log)
    assert main(["identify", log, "--mode", "rigid", "--json"]) == 0
    streams = capsys.readouterr()
    assert list(json.loads(streams.out)["coefficients"]) == ["rigid"]
    assert "not the vehicle of the configuration" not in streams.err
    message = refusal(capsys, log, "--mode", "flexible", "--surface", "acrylic")
    assert "no collision with acrylic in flexible mode in this flight" in message


def test_a_flight_log_is_identified_with_the_mass_of_its_vehicle(
    flown: SharedFlights, hits: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the configuration's mass, k would be wrong by a third."""
    log, other = str(flown("paper_single_wall", 1).log), tmp_path / "light.yaml"
    other.write_text(packaged("configs", "dart.yaml").read_text().replace("mass_kg: 1.3", "mass_kg: 0.9"))
    assert main(["identify", log, "--config", str(other), "--json"]) == 0
    streams = capsys.readouterr()
    found = json.loads(streams.out)
    assert "not the vehicle of the configuration (0.9 kg)" in streams.err
    assert found["vehicle"]["mass_kg"] == 1.3
    k = VEHICLE.materials["acrylic"].coefficients(Mode.FLEXIBLE).k
    assert found["coefficients"]["flexible"]["k"]["value"] == pytest.approx(k, rel=0.04)
    message = refusal(capsys, *hits, log, "--mode", "flexible", "--config", str(other))
    assert "the trial is of another vehicle (0.9 kg, not 1.3 kg): identify the vehicles separately" in message


@pytest.mark.rest
def test_a_given_mass_overrides_the_logs_mass_with_a_warning(
    flown: SharedFlights, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(flown("paper_single_wall", 1).log)
    assert main(["identify", log, "--mass", "0.9", "--json"]) == 0
    streams = capsys.readouterr()
    assert "the fit uses a mass of 0.9 kg, but the forces in the flight logs assume 1.3 kg" in streams.err
    k = VEHICLE.materials["acrylic"].coefficients(Mode.FLEXIBLE).k
    assert abs(json.loads(streams.out)["coefficients"]["flexible"]["k"]["value"] / k - 1.0) > 0.1


@pytest.mark.rest
def test_rotation_of_the_vehicle_widens_the_interval_of_friction(flown: SharedFlights) -> None:
    """Friction turns a body with guards. A fit of a point underestimates mu, a fit of the guards does not."""
    log = read_log(flown("paper_single_wall", 1).log)
    (trial,) = trials_at_one(log, "acrylic")
    (contact,) = (e.record for e in log.entries if isinstance(e.record, TruthContact))
    assert trial.turn_rad_s == pytest.approx(abs(contact.rate_out_frd[2]), abs=0.3)
    truth = VEHICLE.materials["acrylic"].coefficients(Mode.FLEXIBLE).mu
    for turns in (True, False):
        given = replace(trial, contact=None)
        given = given if turns else replace(given, turn_rad_s=0.0)
        found = identify([given], VEHICLE.airframe.mass_kg, Onset(VEHICLE.onset))
        mu = found.coefficients["flexible"]["mu"]
        assert mu is not None
        assert any("the vehicle turned at up to" in note for note in found.notes) == turns
        assert (mu.low <= truth <= mu.high) == turns
        assert mu.value < 0.9 * truth
    found = identify([trial], VEHICLE.airframe.mass_kg, Onset(VEHICLE.onset))
    mu, statistical = found.coefficients["flexible"]["mu"], found.statistical["flexible"]["mu"]
    assert mu is not None
    assert statistical is not None
    assert [fitted.used for fitted in found.trials] == ["guards"]
    assert mu.value == pytest.approx(truth, rel=0.1)
    assert mu.low < statistical.low < truth < statistical.high < mu.high
