"""`dart-flight predict` and `tables` on the command line, as tables, JSON and plots."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import pytest

from dart_flight.cli import main
from dart_flight.config.packages import install_command
from dart_flight.config.vehicle import Coefficients, packaged
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.contact.contact_map import drop
from dart_flight.contact.law import Onset
from dart_flight.lab.paper import tables as paper

DATA = Path(__file__).parents[2] / "data"
PAGE = Path(__file__).parents[3] / "docs" / "paper_tables.md"
WALL = ["predict", "--surface", "acrylic", "--mode", "rigid", "--velocity", "-1.0", "0.5"]
DROP = ["predict", "--surface", "concrete", "--mode", "flexible", "--drop", "0.2"]


def as_json(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, float]:
    assert main([*arguments, "--json"]) == 0
    numbers: dict[str, float] = json.loads(capsys.readouterr().out)
    return numbers


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return the one line of a refusal; check status 2 and an empty standard output."""
    try:
        status = main(list(arguments))
    except SystemExit as usage:
        status = int(usage.code or 0)
    streams = capsys.readouterr()
    assert status == 2
    assert streams.out == ""
    assert streams.err.count("\n") == 1, streams.err
    return streams.err


def test_a_wall_impact_is_predicted_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    numbers = as_json(capsys, *WALL)
    assert {
        "normal_out_m_s", "tangential_out_m_s", "contact_time_s", "penetration_m", "peak_normal_force_n",
        "peak_friction_force_n", "impulse_n_s",
    } <= set(numbers)  # fmt: skip
    assert numbers["peak_normal_force_n"] == pytest.approx(63.6, abs=0.05)
    # The vertical force is nu, in newtons, over nearly all of the contact.
    assert 0.8 < numbers["vertical_impulse_n_s"] / (5.0 * numbers["contact_time_s"]) < 1.0


@pytest.mark.parametrize("onset", ["lcp", "touch"])
def test_a_drop_prediction_in_json_matches_the_reference(
    capsys: pytest.CaptureFixture[str], onset: str
) -> None:
    numbers = as_json(capsys, *DROP, "--onset", onset)
    with (DATA / "drop_tests.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected = next(r for r in rows if (r["onset"], r["mode"], r["height_m"]) == (onset, "flexible", "0.2"))
    for name in ("contact_time_s", "max_rebound_speed_m_s", "peak_force_n", "impulse_n_s"):
        assert numbers[name] == pytest.approx(float(expected[name]), rel=1e-9)


def test_velocities_in_scientific_notation_are_accepted(capsys: pytest.CaptureFixture[str]) -> None:
    wall = [*WALL[:5], "--velocity"]
    assert as_json(capsys, *wall, "-5e-1", "-2.5e-05") == as_json(capsys, *wall, "-0.5", "-0.000025")


def test_a_table_is_printed_on_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(WALL) == 0
    out = capsys.readouterr().out
    assert "63.6063" in out
    assert "55.56" in out
    assert main(DROP) == 0
    assert "max rebound speed" in capsys.readouterr().out


def test_incidence_makes_a_flexible_vehicle_rigid(capsys: pytest.CaptureFixture[str]) -> None:
    hit = ["predict", "--surface", "acrylic", "--mode", "flexible", "--velocity", "-1", "0"]
    soft, turned = as_json(capsys, *hit), as_json(capsys, *hit, "--incidence-deg", "15")
    stiff = as_json(capsys, "predict", "--surface", "acrylic", "--mode", "rigid", "--velocity", "-1", "0")
    assert soft["peak_normal_force_n"] < 0.6 * stiff["peak_normal_force_n"]
    almost = as_json(capsys, *hit, "--incidence-deg", "14.9")
    assert turned == stiff
    assert almost == soft


def test_a_batch_matches_the_reference_collisions(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with (DATA / "wall_collisions.csv").open() as file:
        rows = list(csv.DictReader(file))
    path = tmp_path / "hits.csv"
    lines = ["mode,normal_m_s,tangential_m_s"]
    lines += [f"{r['mode']},{r['vx_in_m_s']},{r['vy_in_m_s']}" for r in rows]
    path.write_text("\n".join(lines) + "\n")
    batch = ["predict", "--surface", "acrylic", "--batch", str(path)]
    assert main(batch) == 0
    computed = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert len(computed) == len(rows)
    for line, expected in zip(computed, rows, strict=True):
        assert line["mode"] == expected["mode"]
        assert float(line["normal_m_s"]) == float(expected["vx_in_m_s"])
        assert float(line["normal_out_m_s"]) == pytest.approx(float(expected["lcp_vx_out_m_s"]), rel=1e-9)
        assert float(line["peak_friction_force_n"]) == pytest.approx(
            float(expected["lcp_peak_friction_force_n"]), rel=1e-9, abs=1e-12
        )
    assert main([*batch, "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["collisions"]) == len(rows)


def test_an_invalid_batch_line_is_reported_with_its_number(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "hits.csv"
    for text, message in {
        "mode,normal_m_s\nrigid,-1\n": "missing column tangential_m_s",
        "mode,normal_m_s,tangential_m_s\nrigid,-1,0\nstiff,-1,0\n": ":3: mode: 'stiff' is not allowed",
        "mode,normal_m_s,tangential_m_s\nrigid,nan,0\n": ":2: normal_m_s: 'nan' is not a speed",
        "mode,normal_m_s,tangential_m_s\nrigid,-1\n": ":2: tangential_m_s",
    }.items():
        path.write_text(text)
        assert message in refusal(capsys, "predict", "--surface", "acrylic", "--batch", str(path))
    assert "cannot read" in refusal(
        capsys, "predict", "--surface", "acrylic", "--batch", str(tmp_path / "none.csv")
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["predict", "--surface", "steel", "--mode", "rigid", "--drop", "0.1"], "unknown surface 'steel'"),
        ([*WALL[:5], "--velocity", "1.0", "0"], "does not approach"),
        ([*WALL[:5], "--velocity", "nan", "0"], "normal nan m/s"),
        ([*DROP[:5], "--drop", "-0.1"], "expected a height"),
        ([*DROP[:5], "--drop", "inf"], "expected a height"),
        ([*WALL, "--incidence-deg", "60"], "angle from 0 to 45"),
        (["predict", "--surface", "acrylic", "--velocity", "-1", "0"], "--mode is required"),
        (WALL[:5], "required"),
        ([*WALL, "--plot", "hit.xyz"], "hit.xyz"),
        ([*WALL, "--plot", "/nowhere/hit.png"], "cannot write"),
    ],
)
def test_invalid_input_is_refused_in_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert message in refusal(capsys, *arguments)


def test_a_contact_that_never_ends_has_no_contact_time(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    # At this small height, damping and weight keep the vehicle on the ground.
    numbers = as_json(capsys, "predict", "--surface", "concrete", "--mode", "rigid", "--drop", "0.0001")
    assert numbers["contact_time_s"] is None
    plot = tmp_path / "down.png"
    assert (
        main(["predict", "--surface", "concrete", "--mode", "rigid", "--drop", "0.0001", "--plot", str(plot)])
        == 0
    )
    assert "never ends" in capsys.readouterr().out


def test_plots_contain_their_labels(tmp_path: Path) -> None:
    path = tmp_path / "plot.svg"
    assert main([*WALL, "--plot", str(path)]) == 0
    assert "along the wall" in path.read_text()
    assert main([*DROP, "--plot", str(path)]) == 0
    text = path.read_text()
    assert "paper: largest rebound 1.34 m/s" in text
    assert "paper: contact 145 ms" in text


@pytest.mark.rest
def test_predictions_need_neither_scipy_nor_matplotlib() -> None:
    code = (
        "import sys\n"
        "from dart_flight.cli import main\n"
        f"assert main({[*WALL, '--json']!r}) == 0 and main(['tables', '--json']) == 0\n"
        "assert not {'scipy', 'matplotlib'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_missing_matplotlib_is_reported_with_the_package_to_install(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert install_command("report") in refusal(capsys, *WALL, "--plot", "x.png")


# --- tables ---------------------------------------------------------------------------------------------


def test_the_page_in_docs_is_up_to_date(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    config = str(packaged("configs", "dart.yaml"))
    assert main(["tables", "-o", str(path), "--config", config]) == 0
    assert path.read_text() == PAGE.read_text()


def test_tables_agree_with_the_published_drops(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tables", "--json"]) == 0
    tables = json.loads(capsys.readouterr().out)
    assert len(tables["drops"]) == 8
    for row in tables["drops"]:
        assert abs(row["contact_time_error"]) < 0.18
        assert abs(row["rebound_error"]) < 0.11
    assert 6.5 < tables["stiffness_ratio"]["model"]["concrete"] < 7.5
    assert {row["mode"] for row in tables["flight"]} == {"rigid", "flexible"}
    assert main(["tables"]) == 0
    assert "Drop tests" in capsys.readouterr().out


@pytest.mark.rest
def test_tables_depend_on_the_vehicles_coefficients() -> None:
    vehicle = load_vehicle(packaged("configs", "dart.yaml"))
    changed = type(vehicle)(
        **{name: getattr(vehicle, name) for name in vehicle.__struct_fields__ if name != "materials"},
        materials=vehicle.materials | {"concrete": vehicle.materials["acrylic"]},
    )
    assert paper.page(changed) != paper.page(vehicle)
    assert paper.stiffness_ratios(changed)["concrete"] == pytest.approx(3.36)


def test_a_refit_matches_one_drop_height_but_not_both() -> None:
    vehicle = load_vehicle(packaged("configs", "dart.yaml"))
    for onset in Onset:
        for refit in paper.refits(vehicle.airframe.mass_kg, onset):
            rows = [row for row in paper.DROPS if row.mode is refit.mode]
            coefficients = Coefficients(k=refit.k_n_per_m, f=refit.f_ns_per_m, mu=0.0, nu=0.0)
            # The errors match the closed form of each drop.
            for row, errors in zip(rows, refit.errors, strict=True):
                computed = drop(coefficients, vehicle.airframe.mass_kg, row.height_m, onset)
                assert errors[0] == pytest.approx(
                    computed.contact_time_s / row.contact_time_s - 1.0, abs=1e-9
                )
                rebound = computed.max_rebound_speed_m_s / row.max_rebound_speed_m_s - 1.0
                assert errors[1] == pytest.approx(rebound, abs=1e-9)
            fitted = [e for row, e in zip(rows, refit.errors, strict=True) if row.height_m in refit.fitted]
            worst = max(abs(x) for pair in fitted for x in pair)
            assert (worst < 1e-3) == (len(refit.fitted) == 1)
