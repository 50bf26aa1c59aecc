"""Identification of synthetic trials: true coefficients, intervals that cover them, and unknowns as None."""

from __future__ import annotations

import functools
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from dart_flight.base.records import Mode
from dart_flight.cli import main
from dart_flight.config.packages import install_command
from dart_flight.config.vehicle import packaged
from dart_flight.config.vehicle.airframe import Coefficients
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Estimate, Identification
from dart_flight.lab.identify.fit import identify
from dart_flight.lab.identify.recorded_impact import find_impact
from dart_flight.lab.identify.trials import Series, Trial
from dart_flight.lab.predict.path import ContactMotion
from tests.doubles.synthetic_trials import MASS_KG, drop_trial, wall_trial, write_csv
from tests.doubles.ulog_file import write_ulog

pytest.importorskip("scipy")

VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))
ACRYLIC, CONCRETE = VEHICLE.materials["acrylic"], VEHICLE.materials["concrete"]


def impacts(
    c: Coefficients,
    mode: Mode = Mode.FLEXIBLE,
    *,
    seed: int = 1,
    speeds: tuple[float, ...] = (0.5, 1.0, 1.5),
    onset: Onset = Onset.LCP,
    plane_m: float = 0.012,
    full: bool = False,
) -> list[Trial]:
    random = np.random.default_rng(seed)
    return [
        wall_trial(
            c, -v, random, onset=onset, plane_m=plane_m, mode=mode.value, name=f"hit {i}",
            tangential_m_s=0.5 if full else None, with_vertical=full,
        )
        for i, v in enumerate(speeds)
    ]  # fmt: skip


@functools.cache
def identified(mode: Mode = Mode.FLEXIBLE, onset: Onset = Onset.LCP) -> Identification:
    """Return the identification of three clean impacts on acrylic."""
    return identify(impacts(ACRYLIC.coefficients(mode), mode, onset=onset), MASS_KG, onset)


def estimate_of(found: Identification, mode: Mode, name: str) -> Estimate:
    estimate = found.coefficients[mode.value][name]
    assert estimate is not None
    return estimate


def relative_width(e: Estimate) -> float:
    return (e.high - e.low) / (2.0 * e.value)


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("onset", list(Onset))
def test_wall_impacts_give_the_true_coefficients(mode: Mode, onset: Onset) -> None:
    found = identified(mode, onset)
    for name in ("k", "f"):
        estimate = estimate_of(found, mode, name)
        true = getattr(ACRYLIC.coefficients(mode), name)
        # The full width of the interval is 3.9 standard deviations.
        assert abs(estimate.value - true) < estimate.high - estimate.low
        assert 0.002 < relative_width(estimate) < 0.08
    assert found.plane_m is not None
    assert found.plane_m.value == pytest.approx(0.012, abs=0.002)
    assert found.residuals["normal_m"] == pytest.approx(0.001, rel=0.15)
    assert found.coefficients[mode.value]["mu"] is None
    assert found.coefficients[mode.value]["nu"] is None
    assert any("mu (friction) is unknown" in note for note in found.notes)


@pytest.mark.parametrize("mode", list(Mode))
def test_drops_give_the_coefficients_and_an_offset_plane(mode: Mode) -> None:
    c = CONCRETE.coefficients(mode)
    random = np.random.default_rng(2)
    trials = [drop_trial(c, 0.05, random, plane_m=-0.009, mode=mode.value) for _ in range(2)]
    found = identify(trials, MASS_KG, Onset.LCP)
    for name in ("k", "f"):
        estimate = estimate_of(found, mode, name)
        assert abs(estimate.value - getattr(c, name)) < estimate.high - estimate.low
        assert estimate.value == pytest.approx(getattr(c, name), rel=0.08)
    assert found.plane_m is not None
    assert found.plane_m.value == pytest.approx(-0.009, abs=0.001)


def test_friction_and_vertical_coefficients_are_identified() -> None:
    c = ACRYLIC.coefficients(Mode.FLEXIBLE)
    found = identify(impacts(c, full=True), MASS_KG, Onset.LCP)
    for name, true in (("mu", c.mu), ("nu", c.nu)):
        estimate = estimate_of(found, Mode.FLEXIBLE, name)
        assert abs(estimate.value - true) < estimate.high - estimate.low
        assert relative_width(estimate) < 0.1
    assert found.vertical_side == 1, "the vertical force lifts, as in the paper"
    assert found.trials[0].tangential_m_s == pytest.approx(0.5, abs=0.01)


def test_trials_at_one_speed_give_a_wide_interval() -> None:
    c = ACRYLIC.rigid
    spread = identified(Mode.RIGID)
    single = identify(impacts(c, Mode.RIGID, speeds=(1.0, 1.0, 1.0)), MASS_KG, Onset.LCP)
    assert relative_width(estimate_of(single, Mode.RIGID, "k")) > 2.0 * relative_width(
        estimate_of(spread, Mode.RIGID, "k")
    )
    for name in ("k", "f"):
        estimate = estimate_of(single, Mode.RIGID, name)
        assert estimate.low - (estimate.high - estimate.low) < getattr(c, name) < 2.0 * estimate.high


def test_force_readings_narrow_the_interval() -> None:
    c = ACRYLIC.coefficients(Mode.FLEXIBLE)
    random = np.random.default_rng(3)
    trials = [wall_trial(c, -1.0, random, mode="flexible", force_noise_n=1.0) for _ in range(2)]
    without = [Trial(t.name, {"normal_m": t.normal}, t.mode) for t in trials]
    with_force, bare = (identify(ts, MASS_KG, Onset.LCP) for ts in (trials, without))
    estimate = estimate_of(with_force, Mode.FLEXIBLE, "k")
    assert relative_width(estimate) < 0.7 * relative_width(estimate_of(bare, Mode.FLEXIBLE, "k"))
    assert abs(estimate.value - c.k) < estimate.high - estimate.low
    assert with_force.residuals["normal_force_n"] == pytest.approx(1.0, rel=0.2)


def test_both_modes_share_one_plane() -> None:
    trials = impacts(ACRYLIC.rigid, Mode.RIGID, speeds=(1.0,)) + impacts(
        ACRYLIC.coefficients(Mode.FLEXIBLE), seed=5
    )
    found = identify(trials, MASS_KG, Onset.LCP)
    assert set(found.coefficients) == {"rigid", "flexible"}
    # A single rigid impact leaves the plane unknown; the flexible impacts provide it.
    alone = identify(trials[:1], MASS_KG, Onset.LCP)
    shared = estimate_of(found, Mode.RIGID, "k")
    assert relative_width(shared) < relative_width(estimate_of(alone, Mode.RIGID, "k"))
    assert abs(shared.value - ACRYLIC.rigid.k) < shared.high - shared.low


@pytest.mark.rest
@pytest.mark.parametrize("mode", list(Mode))
def test_the_controllers_acceleration_around_the_contact_is_estimated(mode: Mode) -> None:
    # As in flight, the controller accelerates in the approach and brakes hard after the release.
    c = ACRYLIC.coefficients(mode)
    random = np.random.default_rng(12)
    trials = []
    for speed in (0.5, 1.0, 1.5):
        contact = ContactMotion(c, MASS_KG, -speed, Onset.LCP, acceleration_m_s2=-0.8)
        t = np.arange(-0.5, contact.end_s + 0.3, 1.0 / 240.0)
        braking = 0.5 * (-3.0 + 0.8) * np.maximum(t - contact.end_s, 0.0) ** 2
        x = contact.normal(t)[0] + braking + random.normal(0.0, 0.001, t.size)
        trials.append(Trial(f"{speed}", {"normal_m": Series(t, x)}, mode.value))
    found = identify(trials, MASS_KG, Onset.LCP)
    assert any("not straight" in note for note in found.notes)
    for name in ("k", "f"):
        estimate = estimate_of(found, mode, name)
        assert abs(estimate.value - getattr(c, name)) < estimate.high - estimate.low
        assert relative_width(estimate) < 0.08
    assert found.residuals["normal_m"] == pytest.approx(0.001, rel=0.15)
    before, after = np.mean([trial.push_m_s2 for trial in found.trials], axis=0)
    assert before == pytest.approx(-0.8, abs=0.3)
    assert after == pytest.approx(-3.0, abs=0.7)


def test_outliers_do_not_bias_the_stiffness() -> None:
    trials = impacts(ACRYLIC.coefficients(Mode.FLEXIBLE))
    for trial in trials:
        trial.normal.value[::37] += 0.05
    found = identify(trials, MASS_KG, Onset.LCP)
    estimate = estimate_of(found, Mode.FLEXIBLE, "k")
    assert abs(estimate.value - ACRYLIC.coefficients(Mode.FLEXIBLE).k) < estimate.high - estimate.low


@pytest.mark.rest
def test_filtered_recordings_get_wider_intervals() -> None:
    # Correlated noise of 1 mm carries less information than white noise of 1 mm.
    trials = [
        wall_trial(
            ACRYLIC.coefficients(Mode.FLEXIBLE), -v, np.random.default_rng(1), noise_m=0.0, mode="flexible"
        )
        for v in (0.5, 1.0, 1.5)
    ]
    random = np.random.default_rng(2)
    for trial in trials:
        noise = 0.0
        for i in range(trial.normal.value.size):
            noise = 0.8 * noise + random.normal(0.0, 0.0006)
            trial.normal.value[i] += noise
    estimate = estimate_of(identify(trials, MASS_KG, Onset.LCP), Mode.FLEXIBLE, "k")
    white = estimate_of(identified(), Mode.FLEXIBLE, "k")
    assert relative_width(estimate) > 1.5 * relative_width(white)
    assert abs(estimate.value - ACRYLIC.coefficients(Mode.FLEXIBLE).k) < estimate.high - estimate.low


def test_derived_velocities_count_once() -> None:
    trials = impacts(ACRYLIC.coefficients(Mode.FLEXIBLE))
    derived = [
        Trial(
            t.name,
            t.series | {"normal_m_s": Series(t.normal.time_s, np.gradient(t.normal.value, t.normal.time_s))},
            t.mode,
        )
        for t in trials
    ]
    double = identify(derived, MASS_KG, Onset.LCP)
    assert estimate_of(double, Mode.FLEXIBLE, "k") == estimate_of(identified(), Mode.FLEXIBLE, "k")
    assert any("derivative" in note for note in double.notes)


def test_measured_velocities_narrow_the_interval() -> None:
    random = np.random.default_rng(8)
    trials = []
    for t in impacts(ACRYLIC.coefficients(Mode.FLEXIBLE)):
        clean = wall_trial(
            ACRYLIC.coefficients(Mode.FLEXIBLE), -1.0, random, noise_m=0.0, plane_m=0.012, mode="flexible"
        )
        speed = np.gradient(clean.normal.value, clean.normal.time_s)
        noisy = Series(clean.normal.time_s, speed + random.normal(0.0, 0.005, speed.size))
        position = Series(
            clean.normal.time_s, clean.normal.value + random.normal(0.0, 0.001, clean.normal.value.size)
        )
        trials.append(Trial(t.name, {"normal_m": position, "normal_m_s": noisy}, "flexible"))
    found = identify(trials, MASS_KG, Onset.LCP)
    bare = identify([Trial(t.name, {"normal_m": t.normal}, t.mode) for t in trials], MASS_KG, Onset.LCP)
    assert relative_width(estimate_of(found, Mode.FLEXIBLE, "f")) < 0.8 * relative_width(
        estimate_of(bare, Mode.FLEXIBLE, "f")
    )


def test_the_impact_is_found_in_a_long_recording() -> None:
    random = np.random.default_rng(4)
    trial = wall_trial(ACRYLIC.rigid, -0.8, random, before_s=0.6, plane_m=0.01)
    time, value = trial.normal
    step = time[1] - time[0]
    # Slow turns 1 m away fill a minute before the impact.
    early = np.arange(time[0] - 60.0, time[0] - step, step)
    distance = value[0] + 0.3 * (1.0 - np.cos(0.8 * (early - early[-1])))
    noisy = distance + random.normal(0.0, 0.001, early.size)
    long = Series(np.concatenate((early, time)), np.concatenate((noisy, value)))
    impact = find_impact(Trial("long", {"normal_m": long}))
    assert impact.turn_s == pytest.approx(float(time[np.argmin(value)]), abs=0.02)
    assert impact.approach_m_s == pytest.approx(-0.8, abs=0.03)


def test_the_first_of_several_bounces_is_fitted() -> None:
    from tests.oracles.stepping import simulate

    path = simulate(
        CONCRETE.rigid, MASS_KG, (0.2, 0.0, 0.0), (0.0, 0.0, 0.0), Onset.LCP,
        step_s=1e-4, duration_s=1.2, acceleration_m_s2=(-9.81, 0.0, 0.0),
    )  # fmt: skip
    random = np.random.default_rng(1)
    x = path.position_m[::10, 0] + random.normal(0.0, 0.0005, path.time_s[::10].size)
    trial = Trial("bounces", {"normal_m": Series(path.time_s[::10], x)}, "rigid", -9.81)
    found = identify([trial], MASS_KG, Onset.LCP)
    assert found.trials[0].normal_m_s == pytest.approx(-1.95, abs=0.03)
    assert estimate_of(found, Mode.RIGID, "k").value == pytest.approx(5500.0, rel=0.1)


# --- the command ----------------------------------------------------------------------------------------


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return the one line of a refusal; check status 2 and an empty standard output."""
    status = main(["identify", *arguments])
    streams = capsys.readouterr()
    assert status == 2
    assert streams.out == ""
    assert streams.err.count("\n") == 1, streams.err
    return streams.err


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i, trial in enumerate(impacts(ACRYLIC.coefficients(Mode.FLEXIBLE), full=True), 1):
        write_csv(trial, tmp_path / f"hit_{i}.csv")
    return tmp_path


def test_command_writes_an_entry_that_the_configuration_accepts(
    capsys: pytest.CaptureFixture[str], folder: Path
) -> None:
    files = [str(folder / f"hit_{i}.csv") for i in (1, 2, 3)]
    entry, plot = folder / "entry.yaml", folder / "fit.png"
    options = ["--mode", "flexible", "--surface", "acrylic", "-o", str(entry), "--plot", str(plot)]
    assert main(["identify", *files, *options, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    k = result["coefficients"]["flexible"]["k"]
    assert k["low"] < k["value"] < k["high"]
    assert set(result["coefficients"]["flexible"]) == {"k", "f", "mu", "nu"}
    assert "normal_m" in result["residuals"]
    assert plot.read_bytes().startswith(b"\x89PNG")

    # A vehicle loads with the entry in place of the shipped materials.
    shipped = packaged("configs", "dart.yaml").read_text()
    begin, end = shipped.index("materials:"), shipped.index("onset:")
    config = folder / "dart.yaml"
    config.write_text(shipped[:begin] + entry.read_text() + shipped[end:])
    vehicle = load_vehicle(config)
    assert vehicle.materials["acrylic"].coefficients(Mode.FLEXIBLE).k == pytest.approx(k["value"], rel=1e-5)
    assert vehicle.materials["acrylic"].rigid == ACRYLIC.rigid
    hit = ["predict", "--config", str(config), "--surface", "acrylic", "--mode", "flexible"]
    assert main([*hit, "--velocity", "-1", "0.5"]) == 0


def test_drop_heights_of_the_centre_of_mass_need_the_contact_distance(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    random = np.random.default_rng(6)
    trial = drop_trial(CONCRETE.coefficients(Mode.FLEXIBLE), 0.05, random, plane_m=0.205)
    path = tmp_path / "drop.csv"
    write_csv(trial, path)
    assert "--contact-distance" in refusal(capsys, str(path), "--drop", "0.05")
    command = ["identify", "--drop", str(path), "--contact-distance", "0.2", "--mode", "flexible", "--json"]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["coefficients"]["flexible"]["k"]["value"] == pytest.approx(750.0, rel=0.05)
    assert result["coefficients"]["flexible"]["mu"] is None
    assert result["plane_m"]["value"] == pytest.approx(0.005, abs=0.002)


def test_other_headers_and_separators_are_read_with_named_columns(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    trial = impacts(ACRYLIC.coefficients(Mode.FLEXIBLE), speeds=(1.0,))[0]
    path = tmp_path / "other.csv"
    lines = ["# exported", "t;x", *(f"{t:.6f};{x:.6f}" for t, x in zip(*trial.normal, strict=True))]
    path.write_text("\ufeff" + "\n".join(lines))
    assert "missing column time_s" in refusal(capsys, str(path))
    assert main(["identify", str(path), "--columns", "time_s=t,normal_m=x", "--json"]) == 0
    assert "unlabelled" in json.loads(capsys.readouterr().out)["coefficients"]
    assert "no column 'z'" in refusal(capsys, str(path), "--columns", "time_s=t,normal_m=z")
    assert "NAME=HEADER" in refusal(capsys, str(path), "--columns", "when=t")


def test_unusable_trials_are_refused_with_the_reason(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    trial = impacts(ACRYLIC.rigid, Mode.RIGID, speeds=(1.0,))[0]
    time, value = trial.normal
    path = tmp_path / "trial.csv"

    def refusal_of_samples(t: object, x: object) -> str:
        rows = zip(np.asarray(t).tolist(), np.asarray(x).tolist(), strict=True)
        path.write_text("time_s,normal_m\n" + "\n".join(f"{a!r},{b!r}" for a, b in rows) + "\n")
        message = refusal(capsys, str(path))
        assert message.startswith(str(path))
        return message

    assert "no impact found" in refusal_of_samples(time, 1.0 - 0.3 * (time - time[0]))
    assert "no impact found" in refusal_of_samples(time, 1.0 + 0.0005 * np.sin(900.0 * time))
    assert "millimetres" in refusal_of_samples(time, 1000.0 * value)
    assert "metres" in refusal_of_samples(time, 60.0 * value)
    assert "is time_s in seconds?" in refusal_of_samples(1000.0 * time, value)
    holes = value.copy()
    holes[40] = np.nan
    assert ":42: normal_m: 'nan' is not a number" in refusal_of_samples(time, holes)
    back = time.copy()
    back[50] = back[48]
    assert ":52: time_s: time does not increase" in refusal_of_samples(back, value)
    assert "before the plane" in refusal_of_samples(time, value + 0.4)
    assert "behind the plane" in refusal_of_samples(time, value - 0.8)
    assert "too few" in refusal_of_samples(time[:5], value[:5])
    path.write_text("")
    assert "empty" in refusal(capsys, str(path))
    path.write_bytes(b"\xff\xfe\x00\x01")
    assert "not UTF-8" in refusal(capsys, str(path))
    assert "unknown kind" in refusal(capsys, str(tmp_path / "trial.bag"))
    assert "cannot read" in refusal(capsys, str(tmp_path / "none.csv"))
    assert "no trials" in refusal(capsys)


def test_incompatible_options_are_refused(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    file = str(folder / "hit_2.csv")
    assert "--surface" in refusal(capsys, file, "-o", str(folder / "x.yaml"))
    # The result is printed; only the entry is refused.
    assert main(["identify", file, "--surface", "acrylic", "-o", str(folder / "x.yaml")]) == 2
    streams = capsys.readouterr()
    assert "--mode" in streams.err
    assert "coefficients" in streams.out
    assert not (folder / "x.yaml").exists()
    assert "expected 0 to 1" in refusal(capsys, file, "--contact-distance", "200")


def test_missing_scipy_is_reported_with_the_package_to_install(
    capsys: pytest.CaptureFixture[str], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)
    message = refusal(capsys, str(folder / "hit_1.csv"))
    assert f"needs SciPy: {install_command('identify')}" in message


# --- PX4 logs -------------------------------------------------------------------------------------------


def test_a_px4_log_gives_the_true_coefficients(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    # The wall is in the north-east and its normal points south-west; the level vehicle heads east.
    heading = np.radians(225.0)
    normal = np.array([np.cos(heading), np.sin(heading)])
    wall = np.array([3.0, 2.0])
    trial = wall_trial(
        ACRYLIC.coefficients(Mode.FLEXIBLE), -1.0, np.random.default_rng(9), rate_hz=250.0, force_noise_n=0.3,
        plane_m=0.01, tangential_m_s=0.4,
    )  # fmt: skip
    along = np.array([-normal[1], normal[0]])
    time = 1e6 * trial.normal.time_s
    place = wall + np.outer(trial.normal.value, normal) + np.outer(trial.series["tangential_m"].value, along)
    force = np.outer(trial.series["normal_force_n"].value / MASS_KG, normal)
    quarter = float(np.sqrt(0.5))
    path = tmp_path / "flight.ulg"
    time = time - time[0]
    write_ulog(
        path,
        {
            ("vehicle_local_position", 0): (
                "float x;float y;float z;float vx;float vy;float vz;",
                [(t, [n, e, -1.0, 0.0, 0.0, 0.0]) for t, (n, e) in zip(time, place, strict=True)],
            ),
            ("vehicle_attitude", 0): ("float[4] q;", [(t, [quarter, 0.0, 0.0, quarter]) for t in time[::2]]),
            ("sensor_combined", 0): (
                "float[3] accelerometer_m_s2;float[3] gyro_rad;",
                # In FRD of this vehicle, forward is east and right is south.
                [(t, [e, -n, -9.81, 0.0, 0.0, 0.0]) for t, (n, e) in zip(time, force, strict=True)],
            ),
        },
    )
    assert "--wall" in refusal(capsys, str(path))
    command = ["identify", str(path), "--wall", "3", "2", "225", "--mode", "flexible", "--json"]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["coefficients"]["flexible"]["k"]["value"] == pytest.approx(1250.0, rel=0.05)
    assert result["residuals"]["normal_force_n"] == pytest.approx(0.3, rel=0.3)
    assert result["trials"][0]["tangential_m_s"] == pytest.approx(0.4, abs=0.02)
    path.write_bytes(b"not a log")
    assert "not a readable ULog" in refusal(capsys, str(path), "--wall", "3", "2", "225")
