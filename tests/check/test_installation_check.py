"""The checks of `doctor`, and what its report must not contain."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dart_flight.base.errors import FlightError
from dart_flight.check import installation_check
from dart_flight.check.findings import CheckFinding
from dart_flight.check.installation_check import Computer, check_disk, check_packages, check_ports, check_px4
from dart_flight.cli import main
from dart_flight.sim.px4.installation import ENVIRONMENT
from tests.command_fixtures import RunJson
from tests.doubles.px4_install import install

# No word of the findings has two of these letters side by side.
NAMES = st.text("jqxz", min_size=3, max_size=8)


@pytest.fixture(autouse=True)
def no_px4_of_this_computer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(ENVIRONMENT, "")
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("HOME", str(tmp_path / "no-home"))


def finding_of(findings: Iterator[CheckFinding], item: str) -> CheckFinding:
    return next(finding for finding in findings if finding.item == item)


def test_the_version_of_the_px4_that_starts_is_reported(tmp_path: Path) -> None:
    folder = install(tmp_path / "opt" / "px4", "deaf", "Release 1.16.2")
    found = finding_of(check_px4(Computer(tmp_path, {})), "px4")
    assert (found.go, found.remark) == (True, False)
    assert found.message == f"PX4 v1.16.2 in {folder} starts"


@pytest.mark.parametrize(
    ("behaviour", "version", "message"),
    [
        ("ends", "Release 1.16.0", "PX4 ended with status 3 before it connected: ERROR"),
        ("deaf", "Release 1.13.2", "PX4 v1.13.2 in .* is too old"),
    ],
)
def test_a_px4_that_cannot_fly_fails_the_check(
    behaviour: str, version: str, message: str, tmp_path: Path
) -> None:
    install(tmp_path / "opt" / "px4", behaviour, version)
    found = finding_of(check_px4(Computer(tmp_path, {})), "px4")
    assert not found.go
    assert re.search(message, found.message)


def test_only_a_named_px4_must_exist(tmp_path: Path) -> None:
    absent = finding_of(check_px4(Computer(tmp_path, {})), "px4")
    assert (absent.go, absent.remark) == (True, True)
    wrong = finding_of(check_px4(Computer(tmp_path, {ENVIRONMENT: str(tmp_path)})), "px4")
    assert (wrong.go, wrong.remark) == (False, False)


def test_a_missing_package_is_a_remark_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    versions = {"scipy": None, "pyulog": "1.3"}
    monkeypatch.setattr(installation_check, "_version_of", lambda name: versions.get(name, "1.0"))
    found = finding_of(check_packages(Computer()), "identify")
    assert (found.go, found.remark) == (True, True)
    assert found.message.startswith("missing: scipy; ")
    versions["mavsdk"] = None
    found = finding_of(check_packages(Computer()), "packages")
    assert (found.go, found.remark, found.message) == (False, False, "missing: mavsdk")


def test_a_package_with_a_condition_belongs_to_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    required = [
        "numpy>=1.26",
        'tomli>=2; python_version < "3.11"',
        'ruckig>=0.17; (platform_machine != "aarch64" or python_version < "3.13") and extra == "plan"',
    ]
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: required)
    monkeypatch.setattr(installation_check, "_version_of", lambda package: "1.0")
    found = list(check_packages(Computer()))
    assert [(f.item, f.message) for f in found] == [
        ("packages", "numpy 1.0, tomli 1.0"),
        ("plan", "ruckig 1.0"),
    ]


def test_a_port_that_cannot_be_opened_is_a_remark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dev").mkdir()
    for name in ("ttyACM0", "ttyUSB1"):
        (tmp_path / "dev" / name).touch()
    assert finding_of(check_ports(Computer(tmp_path)), "ports").message == "ttyACM0, ttyUSB1"
    monkeypatch.setattr(os, "access", lambda path, mode: "ACM" not in str(path))
    found = finding_of(check_ports(Computer(tmp_path)), "ports")
    assert found.remark
    assert "cannot open ttyACM0: run `sudo usermod -aG dialout $USER`" in found.message


def test_a_state_folder_that_cannot_be_made_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "file" / "state"))
    found = finding_of(check_disk(Computer()), "state")
    assert not found.go
    assert "Not a directory" in found.message


def test_the_command_fails_if_a_check_fails(
    tmp_path: Path, run_json: RunJson, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer, _ = run_json("doctor")
    assert answer["go"]
    assert {f["item"] for f in answer["findings"]} >= {"program", "packages", "sim", "px4", "ports", "clock"}
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path))
    assert main(["doctor"]) == 1


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    user=NAMES,
    host=NAMES,
    serial=NAMES,
    spaced=st.booleans(),
    fault=st.sampled_from(["px4", "start", "state"]),
)
def test_a_report_has_no_names_and_serial_numbers(
    user: str, host: str, serial: str, spaced: bool, fault: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    root = tmp_path_factory.mktemp("root")
    home = root / (f"{host} {user}" if spaced else host) / user
    by_id = root / "dev" / "serial" / "by-id" / f"usb-{serial}"
    by_id.mkdir(parents=True)
    (root / "dev" / "ttyUSB0").touch()
    px4 = install(home / "PX4-Autopilot" / "build" / "px4_sitl_default")
    with pytest.MonkeyPatch.context() as patched:
        for name, value in {"HOME": str(home), "USER": user, "LOGNAME": user, "HOSTNAME": host}.items():
            patched.setenv(name, value)
        patched.setattr("socket.gethostname", lambda: host)
        patched.setattr("platform.node", lambda: host)
        patched.setattr("platform.release", lambda: f"6.1.0-{host}")
        patched.setattr(installation_check, "measure_lateness_s", lambda: 0.0)
        patched.chdir(home)
        if fault == "px4":
            (px4 / "bin" / "px4").chmod(0o644)
            patched.setenv(ENVIRONMENT, str(px4))
        elif fault == "state":
            (home / "file").touch()
            patched.setenv("DART_FLIGHT_STATE_DIR", str(home / "file" / "state"))

        def start(_: object) -> None:
            raise FlightError(f"{px4}/bin/px4 does not start: {home}/lib is missing")

        patched.setattr("dart_flight.sim.px4.launch.read_version", start)
        findings = installation_check.check_installation(Computer(root, private=True))
    text = json.dumps([(f.item, f.message) for f in findings])
    assert "px4" in text
    for name in (user, host, serial, str(home), str(root)):
        assert name not in text


def test_the_report_is_a_file_of_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "report.txt"
    assert main(["doctor", "--report", str(report)]) == 0
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"wrote {report}\n")
    assert report.read_text().startswith("program: dart-flight ")
