"""`dart-flight parameters` at the command line, against the embedded autopilot's parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from dart_flight.config.parameter_file import Value, format_parameters, load_parameters
from dart_flight.config.vehicle import packaged
from tests.command_fixtures import Refuse, RunJson, exit_status
from tests.doubles.parameter_vehicle import Losses, ParameterVehicle
from tests.doubles.ports import free_udp_port
from tests.flights.test_embedded_flights import simulated_vehicle

SINGLE = str(packaged("missions", "paper_single_wall.yaml"))


class ParametersCommand:
    """`dart-flight parameters` on a vehicle at a URL, with the folder of saved values."""

    def __init__(self, run_json: RunJson, url: str, folder: Path) -> None:
        self._run_json = run_json
        self._words = ["parameters", SINGLE, "--connection", url, "--save-dir", str(folder)]

    def __call__(self, *options: object, status: int = 0) -> tuple[Any, str]:
        return self._run_json(*self._words, *options, status=status)


@pytest.mark.rest
@pytest.mark.mavlink
def test_parameters_are_listed_written_and_restored(
    folder: Path, run_json: RunJson, capsys: pytest.CaptureFixture[str]
) -> None:
    with simulated_vehicle(SINGLE) as url:
        parameters = ParametersCommand(run_json, url, folder)
        listed, _ = parameters(status=1)
        differing = {row["name"]: row for row in listed["parameters"]}
        assert (differing["COM_OBL_RC_ACT"]["vehicle"], differing["COM_OBL_RC_ACT"]["wanted"]) == (5, 4)
        assert differing["COM_OBL_RC_ACT"]["why"].startswith("If the companion computer is lost")
        assert listed["position_from"] == "mocap"
        # The embedded autopilot has no files with restart flags.
        assert "@reboot_required" in listed["restart_source"]
        written, output = parameters("--write", "--yes")
        assert (written["refused"], set(written["written"])) == ({}, set(differing))
        assert "previous values: " in output
        assert exit_status("parameters", SINGLE, "--connection", url) == 0
        assert "all parameters have the desired values" in capsys.readouterr().err
        restored, _ = parameters("--restore", written["saved"], "--yes")
        assert {row["name"]: row["wanted"] for row in restored["parameters"]} == {
            name: row["vehicle"] for name, row in differing.items()
        }


def test_a_missing_save_folder_is_refused(folder: Path, refusal_of: Refuse) -> None:
    url = ("--connection", "udpin://127.0.0.1:14999")
    assert "--save-dir" in refusal_of("parameters", SINGLE, *url, "--save-dir", folder / "none")


def _rest(*values: object) -> object:
    return pytest.param(*values, marks=pytest.mark.rest)


# Whether the list of parameters is damaged or not: only a name that the vehicle lacks is absent.
@pytest.mark.mavlink
@pytest.mark.parametrize(
    ("losses", "states", "status"),
    [
        (Losses(share=0.4), {"OLD_GONE_01": "absent", "MPC_XY_P": "present"}, 0),
        _rest(
            Losses(mute={"MPC_XY_P", "MAV_TYPE"}), {"OLD_GONE_01": "absent", "MPC_XY_P": "not answered"}, 1
        ),
        _rest(Losses(broken_index=3), {"OLD_GONE_01": "not answered", "MPC_XY_P": "present"}, 1),
        _rest(Losses(unlisted={"MPC_XY_P", "SYS_HITL"}), {"OLD_GONE_44": "absent", "MPC_XY_P": "present"}, 0),
    ],
    ids=["entries lost once", "values lost", "an entry lost for ever", "not in the list"],
)
def test_absent_means_missing_from_the_complete_list(
    folder: Path, run_json: RunJson, losses: Losses, states: dict[str, str], status: int
) -> None:
    port = free_udp_port()
    parameters = ParametersCommand(run_json, f"udpin://127.0.0.1:{port}", folder)
    with ParameterVehicle(SINGLE, port, losses) as vehicle:
        wanted: dict[str, Value] = {f"OLD_GONE_{k:02d}": k for k in range(45)}
        wanted |= {name: vehicle.values[name] for name in ("MPC_XY_P", "SYS_HITL", "MPC_Z_P")}
        file = folder / "other_version.params"
        file.write_text(format_parameters(wanted, []))
        listed, messages = parameters("--restore", file, status=status)
        assert vehicle.requests < 4 * len(wanted)
    assert {name: listed["states"][name] for name in states} == states
    assert {row["name"]: row["state"] for row in listed["parameters"]} == {
        name: state for name, state in listed["states"].items() if state != "present"
    }
    assert listed["states"]["MPC_Z_P"] == "present"
    assert messages.count("Traceback") == 0


@pytest.mark.mavlink
@pytest.mark.parametrize("dies_after", [None, pytest.param(2, marks=pytest.mark.rest)])
def test_written_means_read_back_after_px4_has_limited_the_values(
    folder: Path, run_json: RunJson, dies_after: int | None
) -> None:
    port, file = free_udp_port(), folder / "some.params"
    parameters = ParametersCommand(run_json, f"udpin://127.0.0.1:{port}", folder)
    names = ["MPC_XY_P", "MPC_Z_P", "COM_OF_LOSS_T", "SYS_AUTOSTART"]
    with ParameterVehicle(SINGLE, port, Losses(limits={"MPC_Z_P": 1.5}, dies_after=dies_after)) as vehicle:
        before = dict(vehicle.values)
        wanted: dict[str, Value] = {"MPC_XY_P": 1.3, "MPC_Z_P": 9.0, "COM_OF_LOSS_T": 0.7}
        file.write_text(format_parameters({**wanted, "SYS_AUTOSTART": 16777217}, []))
        report, messages = parameters("--restore", file, "--yes", status=1)
    if dies_after is None:
        assert report["written"] == [names[0], *names[2:]]
        assert report["refused"] == {"MPC_Z_P": "MPC_Z_P is 1.5 after writing 9"}
        assert (report["read_back"], report["problem"]) == (True, None)
        assert vehicle.values["SYS_AUTOSTART"] == 16777217
    else:
        assert report["written"] == names[:dies_after]
        assert report["read_back"] is False
        assert "the vehicle stopped responding" in report["problem"]
        assert f"not written: {', '.join(names[dies_after:])}" in messages
        assert load_parameters(report["saved"])["MPC_XY_P"].value == pytest.approx(before["MPC_XY_P"])
