"""`dart-flight parameters` at the command line, against the embedded autopilot's parameters."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dart_flight.cli import main
from tests.flights.test_embedded_flights import SINGLE, simulated_vehicle


@pytest.mark.mavlink
def test_parameters_are_listed_written_and_restored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))

    def run(*options: str) -> tuple[int, dict, str]:  # type: ignore[type-arg]
        status = main(["parameters", SINGLE, "--connection", url, "--save-dir", str(tmp_path), *options])
        out, err = capsys.readouterr()
        return status, json.loads(out) if "--json" in options else {}, out + err

    with simulated_vehicle(SINGLE) as url:
        status, listed, _ = run("--json")
        assert status == 1
        differing = {row["name"]: row for row in listed["parameters"]}
        assert (differing["COM_OBL_RC_ACT"]["vehicle"], differing["COM_OBL_RC_ACT"]["wanted"]) == (5, 4)
        assert differing["COM_OBL_RC_ACT"]["why"].startswith("Companion computer lost")
        assert listed["position_from"] == "mocap"
        # The embedded autopilot has no files with restart flags.
        assert "@reboot_required" in listed["restart_source"]
        status, written, output = run("--write", "--yes", "--json")
        assert (status, written["refused"], set(written["written"])) == (0, {}, set(differing))
        assert "previous values: " in output
        status, _, output = run()
        assert (status, "all parameters have the wanted values" in output) == (0, True)
        status, restored, _ = run("--restore", written["saved"], "--yes", "--json")
        assert status == 0
        assert {row["name"]: row["wanted"] for row in restored["parameters"]} == {
            name: row["vehicle"] for name, row in differing.items()
        }


def test_a_missing_save_folder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    url = ("--connection", "udpin://127.0.0.1:14999")
    assert main(["parameters", SINGLE, *url, "--save-dir", str(tmp_path / "none")]) == 2
    assert "--save-dir" in capsys.readouterr().err
