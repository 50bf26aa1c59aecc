"""Finding, starting, checking and stopping PX4, with a double of it."""

from __future__ import annotations

import errno
import json
import os
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from dart_flight.base.records import TruthContact, TruthSample
from dart_flight.cli import main
from dart_flight.cli.px4_options import position_warnings
from dart_flight.config.mission import load_mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import packaged
from dart_flight.run.simulator_process import Px4SimulatorProcess, SimulatorError
from dart_flight.sim.pipe import Px4SimulatorSpec, Ready, SimulatorSpec
from dart_flight.sim.px4 import launch
from dart_flight.sim.px4.installation import find_install
from dart_flight.sim.px4.launch import (
    ONBOARD_PORT,
    SIMULATOR_PORT,
    Px4Error,
    arguments,
    check_version,
    claim_instance,
    environment,
    flight_parameters,
    parse_version,
    select_parameters,
)
from tests.command_fixtures import Refuse
from tests.doubles.other_process import is_alive, running
from tests.doubles.px4_install import install
from tests.real_time import wait_until

MISSION = packaged("missions", "paper_dual_collision.yaml")


def test_the_callers_environment_does_not_configure_px4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PX4_PARAM_MPC_XY_P", "9")
    monkeypatch.setenv("PX4_SIM_SPEED_FACTOR", "5")
    found = find_install(install(tmp_path / "px4"))
    assert arguments(found, 3) == [str(found.program), "-i", "3", "-d", str(found.etc)]
    assert "/" in arguments(found, 0)[0]
    env = environment()
    assert env["PX4_SIM_MODEL"] == "none_iris"
    # Parameters are set through PX4's client, which every version has, never by the environment.
    assert not [name for name in env if name.startswith("PX4_PARAM_")]
    assert "PX4_SIM_SPEED_FACTOR" not in env


def test_a_refused_port_or_lock_is_not_reported_as_a_running_px4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    locks = tmp_path / "px4_lock"
    for number in range(10):
        Path(f"{locks}-{number}").touch()
    monkeypatch.setattr(launch, "_LOCK_FILES", str(locks))
    with monkeypatch.context() as patched:
        patched.setattr(f"{launch.__name__}.fcntl.lockf", no_locks)
        with pytest.raises(Px4Error, match=r"px4_lock-\d cannot be locked: No locks available"):
            claim_instance()

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(f"{launch.__name__}.socket.create_server", refuse)
    with pytest.raises(Px4Error, match=r"TCP port 456\d cannot be opened: Permission denied"):
        claim_instance()


def test_a_claimed_instance_is_exclusive_until_its_release() -> None:
    first = claim_instance()
    second = claim_instance()
    assert second.number > first.number
    assert second.listen().getsockname()[1] == SIMULATOR_PORT + second.number
    first.release()
    third = claim_instance()
    assert third.number == first.number
    third.release()
    second.release()


@pytest.mark.parametrize(
    ("kind", "port"), [(socket.SOCK_STREAM, SIMULATOR_PORT), (socket.SOCK_DGRAM, ONBOARD_PORT)]
)
def test_an_instance_with_an_occupied_port_is_skipped(kind: socket.SocketKind, port: int) -> None:
    free = claim_instance()
    free.release()
    with socket.socket(socket.AF_INET, kind) as occupied:
        occupied.bind(("127.0.0.1", port + free.number))
        if kind is socket.SOCK_STREAM:
            occupied.listen()
        other = claim_instance()
        other.release()
    assert other.number != free.number


def test_an_instance_whose_lock_file_is_held_by_px4_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ports of a PX4 in another network namespace are invisible."""
    monkeypatch.setattr(launch, "_LOCK_FILES", str(tmp_path / "px4_lock"))
    free = claim_instance()
    free.release()
    lock = tmp_path / f"px4_lock-{free.number}"
    lock.touch()
    hold = "import fcntl, sys; f = open(sys.argv[1], 'r+b'); fcntl.lockf(f, fcntl.LOCK_EX)"
    with running(hold, str(lock)):
        other = claim_instance()
        other.release()
    assert other.number != free.number
    third = claim_instance()  # a leftover file holds no lock
    third.release()
    assert third.number == free.number


@pytest.mark.parametrize("kind", ["_LOCK_FILES", "_SOCKETS"])
def test_an_instance_with_files_of_another_account_is_skipped(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """PX4 could not replace these files; the kernel may refuse this even to root (fs.protected_regular)."""
    monkeypatch.setattr(launch, kind, str(tmp_path / "px4"))
    free = claim_instance()
    free.release()
    (tmp_path / f"px4-{free.number}").touch()
    monkeypatch.setattr(f"{launch.__name__}.os.geteuid", lambda: os.getuid() + 1)
    other = claim_instance()
    other.release()
    assert other.number != free.number


def test_another_account_does_not_claim_the_same_instance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other account has a state folder of its own, and PX4 has not yet opened a port."""
    first = claim_instance()
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path))
    second = claim_instance()
    second.release()
    first.release()
    assert second.number != first.number


@pytest.mark.parametrize(
    ("answer", "version"),
    [
        ("HW arch: PX4_SITL\nPX4 version: Release 1.16.0 (17825792)\n", (1, 16, 0)),
        ("PX4 version: 1.14.3 80 (17695568)\nOS: Linux\nOS version: Release 6.1.0\n", (1, 14, 3)),
        ("nothing of the sort", None),
    ],
)
def test_the_version_is_parsed_from_px4s_output(answer: str, version: tuple[int, int, int] | None) -> None:
    assert parse_version(answer) == version


@pytest.mark.parametrize("version", [(1, 14, 4), (1, 16, 2), (1, 18, 0)])
def test_a_tested_version_is_accepted(version: tuple[int, int, int]) -> None:
    assert check_version(version, "/px4") is None


def test_an_old_version_is_refused_and_an_untested_one_is_noted() -> None:
    assert "v1.19.1" in (check_version((1, 19, 1), "/px4") or "")
    assert "does not report" in (check_version(None, "/px4") or "")
    with pytest.raises(Px4Error, match=r"v1\.13\.3 in /px4 is too old"):
        check_version((1, 13, 3), "/px4")


# --- the world process with the double -----------------------------------------------------------


class WatchedWorld:
    """A world process and its reports."""

    def __init__(self, folder: Path, px4: Path, speed: float = 10.0) -> None:
        mission = load_mission(MISSION)
        self.folder = folder
        folder.mkdir()
        self.truths: list[TruthSample | TruthContact] = []
        self.log = folder / "autopilot.log"
        spec = SimulatorSpec(
            mission,
            1,
            [],
            str(self.log),
            Px4SimulatorSpec(
                str(px4),
                str(folder),
                flight_parameters(mission.vehicle, PositionSource.MOCAP),
                PositionSource.MOCAP,
            ),
            speed=speed,
        )
        self.world = Px4SimulatorProcess(spec, self.truths.append)

    def wait_ready(self) -> Ready:
        """Wait until PX4 runs, and return its description."""
        self.world.wait_ready()
        assert self.world.ready is not None
        return self.world.ready


Start = Callable[..., WatchedWorld]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Install the double of PX4 and start a world with it: `start("dies")`."""
    worlds: list[WatchedWorld] = []

    def start(
        behaviour: str = "fly", version: str = "Release 1.16.0", name: str = "flight", **faults: str
    ) -> WatchedWorld:
        px4 = tmp_path / "px4"
        if not worlds:
            install(px4, behaviour, version, **faults)
        worlds.append(WatchedWorld(tmp_path / name, px4))
        return worlds[-1]

    yield start
    for watched in worlds:
        watched.world.close(5.0)


def test_the_world_starts_px4_in_a_fresh_folder_and_ends_it(tmp_path: Path, start: Start) -> None:
    """A parameter that the version lacks is skipped."""
    watched = start(missing="COM_RAM_MAX")
    ready = watched.wait_ready()
    assert ready.version == "1.16.0"
    about = json.loads((watched.folder / "px4" / "started.json").read_text())
    assert Path(about["cwd"]) == watched.folder / "px4"
    parameters = (tmp_path / "px4" / f"parameters-{about['arguments'][1]}").read_text()
    assert "EKF2_EV_CTRL [1,2] : 11\n" in parameters
    log_text = watched.log.read_text()
    assert "parameters set and read back" in log_text
    assert "this version has no COM_RAM_MAX" in log_text
    assert watched.world.port == 14540 + int(about["arguments"][1])
    wait_until(lambda: watched.truths, 10.0, "the truth")
    watched.world.close(10.0)
    assert not Path(f"/proc/{ready.pid}").exists()
    assert (watched.folder / "px4.ulg").read_bytes() == b"ULog of a fake"
    assert not (watched.folder / "px4").exists()


def test_a_stubborn_px4_is_killed(start: Start) -> None:
    watched = start("stubborn")
    ready = watched.wait_ready()
    watched.world.close(10.0)
    assert not Path(f"/proc/{ready.pid}").exists()


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        ({"behaviour": "ends"}, "PX4 ended with status 3 before it connected: ERROR .init. something"),
        ({"version": "Release 1.13.2"}, "PX4 v1.13.2 in /.*/px4 is too old"),
        ({"missing": "FD_FAIL_R"}, "no parameter FD_FAIL_R, which must be 60:"),
        # A start-up script may overwrite a parameter that was set before.
        ({"overwritten": "EKF2_HGT_REF"}, r"parameter not accepted: EKF2_HGT_REF: set to 3, PX4 has 77"),
    ],
)
def test_an_unusable_px4_is_reported_with_its_reason_in_one_line(
    start: Start, faults: dict[str, str], message: str
) -> None:
    with pytest.raises(SimulatorError, match=message) as caught:
        start(**faults).wait_ready()
    assert "\n" not in str(caught.value)


def test_the_command_reports_a_rejected_parameter_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    px4 = install(tmp_path / "px4", stuck="EKF2_EV_CTRL")
    assert main(["dry-run", str(MISSION), "--px4", str(px4), "--log-dir", str(tmp_path / "flights")]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if "EKF2_EV_CTRL" in line]
    assert len(lines) == 1
    assert "EKF2_EV_CTRL: set to 11, PX4 has 0" in lines[0]


@pytest.mark.parametrize(
    ("count", "problem"),
    [
        (6, "CA_ROTOR_COUNT is 6, but the configuration has 4 motors"),
        (3, "is 3, but the configuration"),
        (0, "is 0, but the configuration"),
    ],
)
def test_a_wrong_number_of_rotors_is_reported_before_px4_starts(
    count: int, problem: str, tmp_path: Path, refusal_of: Refuse
) -> None:
    px4, own = install(tmp_path / "px4"), tmp_path / "own.params"
    own.write_text(f"1 1 CA_ROTOR_COUNT {count} 6\n")
    logs = tmp_path / "logs"
    assert problem in refusal_of("dry-run", MISSION, "--px4", px4, "--params", own, "--log-dir", logs)
    assert not logs.exists()


def test_a_renamed_parameter_is_set_by_its_new_name() -> None:
    wanted = flight_parameters(load_mission(MISSION).vehicle, PositionSource.RTK)
    before = dict.fromkeys(wanted, 0.0)
    assert select_parameters(wanted, before)["EKF2_GPS_DELAY"] == 100.0
    after = {**before, "SENS_GPS0_DELAY": 10.0}
    del after["EKF2_GPS_DELAY"]
    chosen = select_parameters(wanted, after)
    assert chosen["SENS_GPS0_DELAY"] == 100.0
    assert "EKF2_GPS_DELAY" not in chosen
    del after["SENS_GPS0_DELAY"]  # this delay is required under one of its names
    with pytest.raises(Px4Error, match="EKF2_GPS_DELAY"):
        select_parameters(wanted, after)


def test_the_death_of_px4_in_flight_is_reported_to_the_app(start: Start) -> None:
    watched = start("dies")
    watched.wait_ready()
    wait_until(lambda: watched.world.died, 30.0, "the death of PX4")
    assert watched.world.cause == "PX4 was killed by SIGKILL"


def test_killing_the_world_kills_px4(start: Start) -> None:
    watched = start()
    px4 = watched.wait_ready().pid
    os.kill(watched.world.process.pid, 9)
    wait_until(lambda: watched.world.died and not is_alive(px4), 15.0, "the death of both")
    assert watched.world.cause == "the process of the plant under PX4 was killed by SIGKILL"


@pytest.mark.rest
def test_two_simultaneous_worlds_have_separate_instances(start: Start) -> None:
    worlds = [start(name=name) for name in ("one", "two")]
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(WatchedWorld.wait_ready, worlds))
    assert worlds[0].world.port != worlds[1].world.port


# --- the command -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--px4", "/nowhere"], "no PX4 SITL in this folder"),
        (["--outdoor"], "--outdoor needs --px4"),
        (["--fast", "--speed", "2"], "--fast always runs at full speed"),
        (["--px4", "/nowhere", "--gps", "rtk"], "--gps needs --outdoor"),
        (["--px4", "/nowhere", "--fast"], "exclude each other"),
    ],
)
def test_wrong_options_are_reported_in_one_line(options: list[str], message: str, refusal_of: Refuse) -> None:
    assert message in refusal_of("dry-run", MISSION, *options)


def test_plain_gps_causes_a_warning() -> None:
    assert "needs RTK, motion capture or" in position_warnings(PositionSource.PLAIN)[0]
    assert position_warnings(PositionSource.RTK) == position_warnings(PositionSource.MOCAP) == []


def test_a_surveyed_frame_is_refused_with_gps(tmp_path: Path, refusal_of: Refuse) -> None:
    text = MISSION.read_text().replace("north_m: 0.0", "north_m: 3.0")
    text = text.replace("../configs/dart.yaml", str(packaged("configs", "dart.yaml")))
    mission = tmp_path / "surveyed.yaml"
    mission.write_text(text)
    px4 = install(tmp_path / "px4")
    line = refusal_of("dry-run", mission, "--px4", px4, "--outdoor", "--log-dir", tmp_path)
    assert "origin: takeoff" in line
