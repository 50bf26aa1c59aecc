"""Files of another account, an account without a home, and devices whose names contain colons."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dart_flight.base.errors import FlightError
from dart_flight.base.records import LockPhase, LockState, Mode, World
from dart_flight.check.bringup.progress import create_record, save_record
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.edit import write_values
from dart_flight.config.link_url import endpoint_of, link_problem, mavsdk_url, parse_link
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import LockDriver, packaged
from dart_flight.lab.campaign.campaign_folder import write_atomically
from dart_flight.lab.campaign.table import Table
from dart_flight.lock.persistence import CommandStore
from dart_flight.run.flight_record import FlightRecord
from dart_flight.vehicle.link import LinkLease
from tests.accounts import NOBODY, open_to_all

UNKNOWN = 12345
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs a second account")


@pytest.fixture(scope="module")
def mission() -> Mission:
    return load_mission(packaged("missions", "single_wall.yaml"))


@pytest.fixture
def account(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of an account, as which the test runs; `sudo` has left the folder `left` in it."""
    open_to_all(tmp_path)
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "left" / "state"))
    (tmp_path / "left" / "state" / "links").mkdir(parents=True)
    (tmp_path / "left" / "file").write_text("version: 1\n")
    os.chown(tmp_path, NOBODY, NOBODY)
    os.seteuid(NOBODY)
    yield tmp_path
    os.seteuid(0)


def store_command() -> None:
    store = CommandStore(LockDriver.PWM)
    store.store(LockState(t_us=5, phase=LockPhase.SETTLED, mode=Mode.RIGID, commanded_us=1))
    raise InputError(store.problem or "stored")


@needs_root
@pytest.mark.parametrize(
    ("write", "named"),
    [
        (lambda folder, mission: FlightRecord(mission, World.FAST, 1, folder), ""),
        (lambda folder, mission: FlightRecord(mission, World.FAST, 1, folder / "deeper" / "still"), ""),
        (lambda folder, mission: Table(folder / "file", ["seed"]), "/file"),
        (lambda folder, mission: write_atomically(folder / "campaign" / "asked.json", b""), ""),
        (lambda folder, mission: LinkLease("udpin://127.0.0.1:24872", "check").acquire(), "/state/links"),
        (lambda folder, mission: store_command(), "/state"),
        (lambda folder, mission: write_values(folder / "file", {("version",): 2}), ""),
        (lambda folder, mission: save_record(create_record(mission.flown_vehicle(), "x"), folder), ""),
    ],
    ids=["flights", "new folder", "table", "campaign", "link", "last command", "configuration", "bringup"],
)
def test_a_file_left_by_root_is_named_with_its_owner_and_the_remedy(
    write: Callable[[Path, Mission], object], named: str, account: Path, mission: Mission
) -> None:
    with pytest.raises((InputError, FlightError)) as caught:
        write(account / "left", mission)
    left = account / "left"
    assert re.search(
        f"Permission denied: (it|{left}{named}) belongs to root; sudo chown -R nobody {left}$",
        str(caught.value),
    )


@needs_root
def test_a_folder_of_the_system_is_not_to_be_given_away(account: Path, mission: Mission) -> None:
    with pytest.raises(InputError, match=r"/usr belongs to root; choose a folder that you can write to$"):
        FlightRecord(mission, World.FAST, 1, Path("/usr/flights"))
    (account / "own").mkdir(mode=0o555)
    with pytest.raises(
        InputError, match=f"the mode of {account}/own does not permit writing; chmod u\\+w {account}/own$"
    ):
        FlightRecord(mission, World.FAST, 1, account / "own")


@needs_root
@pytest.mark.parametrize("command", [["lock", "rigid", "--driver", "mock"], ["check", "--connection"]])
def test_an_account_without_a_home_is_told_to_name_the_state_folder(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if command[-1] == "--connection":
        command = [
            "check",
            str(packaged("missions", "single_wall.yaml")),
            "--connection",
            "udpin://127.0.0.1:24873",
        ]
    for name in ("HOME", "DART_FLIGHT_STATE_DIR", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    os.setresuid(UNKNOWN, -1, -1)
    try:
        assert main(command) == 2
    finally:
        os.setresuid(0, -1, -1)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "home" in line]
    assert line.endswith(": set DART_FLIGHT_STATE_DIR to a folder that you can write to")


@pytest.mark.parametrize(
    "name",
    [
        "ttyAMA0",
        "by-path/platform-fd500000.pcie-pci-0000:01:00.0-usb-0:1.2:1.0-port0",
        "by-id/usb-a:b",
        "a:57600",
    ],
)
def test_a_serial_device_may_contain_colons(name: str, tmp_path: Path) -> None:
    device = tmp_path / "ttyUSB0"
    device.touch()
    link = tmp_path / name
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(device)
    url = f"serial://{link}:921600"
    parsed = parse_link(url)
    assert parsed is not None
    assert (parsed.place, parsed.number, link_problem(url)) == (str(link), 921600, None)
    assert endpoint_of(url) == endpoint_of(f"serial://{device}:57600")
    assert mavsdk_url(url) == (f"serial://{device}:921600" if ":" in name else url)
    assert link_problem(f"serial://{link}") is not None or name == "a:57600"
