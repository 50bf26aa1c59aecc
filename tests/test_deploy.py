"""The files of the field kit agree: units, udev rules, mavlink-router configuration and installer."""

from __future__ import annotations

import configparser
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from dart_flight.cli import build_parser
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.run.operator_buttons import Button
from dart_flight.vehicle.command_server import COMPONENT, USER_COMMAND

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
UNIT = DEPLOY / "systemd" / "dart-flight@.service"
STANDBY = DEPLOY / "systemd" / "dart-flight-standby.service"
ACTIONS = DEPLOY / "qgroundcontrol" / "dart_flight.json"
RULES = DEPLOY / "udev" / "99-dart-flight.rules"
INSTALLER = DEPLOY / "install.sh"


def ini(path: Path) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None)  # some keys occur several times
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read_string(path.read_text())
    return parser


# --- systemd ---------------------------------------------------------------------------------------------


@pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="no systemd-analyze here: unit not verified"
)
def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
    # Another executable replaces the program, which is not installed here.
    text = re.sub(r"^ExecStart=\S+", f"ExecStart={sys.executable}", UNIT.read_text(), flags=re.M)
    unit = tmp_path / "dart-flight@single_wall.service"
    unit.write_text(text)
    command = ["systemd-analyze", "verify", "--man=no", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    unit.write_text(text.replace("WatchdogSec=1", "WatchdogSek=1"))
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert "WatchdogSek" in done.stderr, "a wrong key must be reported"


@pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="no systemd-analyze here: exposure not measured"
)
def test_the_unit_has_the_exposure_level_of_the_page() -> None:
    command = ["systemd-analyze", "security", "--offline=true", "--threshold=25", str(UNIT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stdout[-400:]
    found = re.search(r"exposure level for \S+: ([\d.]+)", done.stdout)
    assert found is not None
    assert f"exposure level {found[1]}" in (ROOT / "docs" / "field.md").read_text()


def test_the_unit_permits_only_what_a_flight_needs() -> None:
    """A flight needs serial ports, GPIO, network and folders, but no capability and no other device."""
    text, service = UNIT.read_text(), dict(line.partition("=")[::2] for line in UNIT.read_text().splitlines())
    assert service["CapabilityBoundingSet"] == ""
    assert service["DevicePolicy"] == "closed"
    assert set(re.findall(r"^DeviceAllow=char-(\S+) rw$", text, re.M)) == {
        "ttyAMA", "ttyS", "ttyUSB", "ttyACM", "gpiochip",
    }  # fmt: skip
    assert {"AF_UNIX", "AF_INET"} <= set(service["RestrictAddressFamilies"].split())
    assert service["ReadWritePaths"].split() == [service["WorkingDirectory"], "-/run/lock"]
    assert "PrivateDevices" not in service
    assert "ProtectKernelTunables" not in service, "the PWM driver's files are in /sys"


def test_the_command_of_the_unit_parses_and_its_mission_exists() -> None:
    service = ini(UNIT)["Service"]
    program, *arguments = shlex.split(service["ExecStart"].replace("%i", "single_wall"))
    assert program.endswith("/bin/dart-flight")
    parsed = build_parser([arguments[0]]).parse_args(arguments)
    assert (parsed.command, parsed.yes) == ("fly", True)
    assert (ROOT / parsed.mission).exists()


def test_the_unit_never_starts_by_itself() -> None:
    unit = ini(UNIT)
    assert not unit.has_section("Install")
    assert unit["Service"]["Restart"] == "no"
    assert not UNIT.read_text().count("WantedBy")


def test_the_timeouts_of_the_unit_fit_the_configuration() -> None:
    service, vehicle = ini(UNIT)["Service"], load_vehicle(ROOT / "configs" / "dart.yaml")
    assert service["Type"] == "notify"
    assert float(service["WatchdogSec"]) > 2.0 * vehicle.guard.deadman_s, "the deadman must act first"
    assert float(service["TimeoutStartSec"]) > 2.0 * vehicle.connection.timeout_s
    # `stop` aborts within half a minute, then lands from the altitude of the shipped missions.
    assert float(service["TimeoutStopSec"]) > 30.0 + 2.0 / vehicle.px4.mpc_land_speed


def test_the_standby_unit_starts_at_boot_and_otherwise_equals_the_flight_unit() -> None:
    service, flight = ini(STANDBY)["Service"], ini(UNIT)["Service"]
    program, command, missions = service["ExecStart"].split()
    assert (program, command, missions) == (flight["ExecStart"].split()[0], "standby", "$MISSIONS")
    assert service["EnvironmentFile"] == f"-{service['WorkingDirectory']}/standby.env"
    assert ini(STANDBY)["Install"]["WantedBy"] == "multi-user.target"
    # A flight must survive the end of standby, and must have the time to land.
    assert service["KillMode"] == "process"
    assert service["TimeoutStopSec"] == flight["TimeoutStopSec"]
    differing = {"ExecStart", "ExecReload", "EnvironmentFile", "TimeoutStartSec", "WatchdogSec", "KillMode"}
    differing |= {"Restart", "RestartSec", "RestartPreventExitStatus"}
    same = {key: value for key, value in flight.items() if key not in differing}
    assert {key: value for key, value in service.items() if key not in differing} == same


@pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="no systemd-analyze here: unit not verified"
)
def test_systemd_accepts_the_standby_unit(tmp_path: Path) -> None:
    unit = tmp_path / STANDBY.name
    unit.write_text(re.sub(r"^ExecStart=\S+", f"ExecStart={sys.executable}", STANDBY.read_text(), flags=re.M))
    command = ["systemd-analyze", "verify", "--man=no", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


# --- QGroundControl --------------------------------------------------------------------------------------


def test_the_qgroundcontrol_actions_have_the_documented_form() -> None:
    """docs.qgroundcontrol.com defines the keys of custom MAVLink actions, and their types."""
    found = json.loads(ACTIONS.read_text(encoding="utf-8"))
    assert (found["version"], found["fileType"], set(found)) == (
        1,
        "MavlinkActions",
        {"version", "fileType", "actions"},
    )
    parameters = {f"param{n}" for n in range(1, 8)}
    labels = [action["label"] for action in found["actions"]]
    assert len(set(labels)) == len(labels)
    for action in found["actions"]:
        assert {"label", "description", "mavCmd"} <= set(action) <= {
            "label", "description", "mavCmd", "compId", *parameters,
        }  # fmt: skip
        assert all(isinstance(action[key], str) and action[key] for key in ("label", "description"))
        assert all(isinstance(action[key], int | float) for key in set(action) - {"label", "description"})


def test_every_button_of_the_program_has_an_action() -> None:
    found = json.loads(ACTIONS.read_text(encoding="utf-8"))["actions"]
    assert {(a["mavCmd"], a["compId"]) for a in found} == {(USER_COMMAND, COMPONENT)}
    assert {a["param1"] for a in found} == set(Button)
    assert [a["param2"] for a in found if a["param1"] == Button.FLY] == [1, 2, 3]
    page = (ROOT / "docs" / "ground_station.md").read_text(encoding="utf-8")
    for action in found:
        assert f"*{action['label'].rstrip(' 123')}" in page, action["label"]


# --- udev ------------------------------------------------------------------------------------------------

_MATCH = r"(?:ACTION|SUBSYSTEM|DRIVER|ATTRS?\{\w+\}|ENV\{\w+\})(?:==|!=)"
_ASSIGN = r"(?:SYMLINK\+=|GROUP=|MODE=|ENV\{\w+\}=|ATTR\{\w+\}=)"
_PART = re.compile(rf'(?P<what>{_MATCH}|{_ASSIGN})"(?P<value>[^"]*)"')


def rules() -> list[dict[str, str]]:
    found = []
    for line in RULES.read_text().splitlines():
        if line and not line.startswith("#"):
            parts = [_PART.fullmatch(part.strip()) for part in line.split(", ")]
            assert all(parts), line
            found.append({part["what"]: part["value"] for part in parts if part})
    return found


def test_the_udev_rules_create_the_documented_links() -> None:
    page = (ROOT / "docs" / "field.md").read_text()
    links = {rule["SYMLINK+="]: rule for rule in rules() if "SYMLINK+=" in rule}
    assert set(links) == {"dart-autopilot", "dart-servo"}
    assert links["dart-autopilot"]["ATTRS{idVendor}=="] == "0403"
    assert links["dart-servo"]["ATTRS{idVendor}=="] == "1ffb"
    for name in links:
        assert f"/dev/{name}" in page
    for rule in rules():
        # All ATTRS of a rule must belong to one parent device, as vendor and product do.
        assert not [key for key in rule if key.startswith("ATTRS") and "id" not in key]


def _udevadm_verifies() -> bool:
    if shutil.which("udevadm") is None:
        return False
    done = subprocess.run(["udevadm", "verify", "--help"], capture_output=True, check=False)
    return done.returncode == 0


@pytest.mark.skipif(not _udevadm_verifies(), reason="no `udevadm verify` here (systemd 254 or newer)")
def test_udevadm_accepts_the_rules() -> None:
    subprocess.run(["udevadm", "verify", str(RULES)], check=True, timeout=60)


# --- mavlink-router --------------------------------------------------------------------------------------


def test_the_router_uses_the_configured_link() -> None:
    router = ini(DEPLOY / "mavlink-router" / "main.conf")
    uart = router["UartEndpoint autopilot"]
    url = load_vehicle(ROOT / "configs" / "dart.yaml").connection.url
    assert url == f"serial://{uart['Device']}:{uart['Baud']}"
    ours, station = router["UdpEndpoint dart-flight"], router["UdpEndpoint qgroundcontrol"]
    assert (ours["Mode"], ours["Address"]) == ("Normal", "127.0.0.1")
    page = (ROOT / "docs" / "field.md").read_text()
    assert f"--connection udpin://{ours['Address']}:{ours['Port']}" in page
    assert f"port {station['Port']}" in page.replace("\n", " ")


# --- installer -------------------------------------------------------------------------------------------


def test_the_installer_is_valid_shell_and_its_files_exist() -> None:
    subprocess.run(["sh", "-n", str(INSTALLER)], check=True, timeout=60)
    text = INSTALLER.read_text()
    named = re.findall(r'"\$here/([\w@./-]+)"', text)
    assert {"constraints.txt", "deploy/udev/99-dart-flight.rules"} <= set(named)
    for name in named:
        assert (ROOT / name).exists(), name
    assert INSTALLER.stat().st_mode & 0o111
    unit = ini(UNIT)["Service"]
    assert unit["WorkingDirectory"] in text
    assert Path(unit["ExecStart"].split()[0]).parents[1].as_posix() in text


@pytest.mark.skipif(sys.platform != "linux", reason="for Linux")
def test_the_installer_without_root_ends_with_one_line(tmp_path: Path) -> None:
    fake = tmp_path / "id"
    fake.write_text("#!/bin/sh\necho 1000\n")
    fake.chmod(0o755)
    done = subprocess.run(
        ["sh", str(INSTALLER)],
        env={"PATH": f"{tmp_path}:/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (2, "run this script with sudo\n")


# --- wheels ----------------------------------------------------------------------------------------------


def test_every_dependency_of_the_pi_is_pinned() -> None:
    # `make wheels` checks that each pin has a wheel, which needs the network.
    rows = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {row.partition("==")[0] for row in rows if row and not row.startswith("#")}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    required = list(project["dependencies"])
    for extra in ("sim", "identify", "report", "live"):
        required += project["optional-dependencies"][extra]
    names = {canonicalize_name(Requirement(item).name) for item in required}
    assert {"mavsdk", "msgspec", "pymavlink", "matplotlib"} <= names
    assert names <= {canonicalize_name(name) for name in pinned}
