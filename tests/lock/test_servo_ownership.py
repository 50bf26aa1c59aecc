"""One servo has one owner: between processes, accounts and state folders, and from a parent to its child."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from dart_flight.config import held_files
from dart_flight.config.document import InputError
from dart_flight.config.held_files import shared_file
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import LockConfig, LockDriver, packaged
from dart_flight.lock.drivers import ActuatorLink, DriverError, owned_driver
from dart_flight.lock.drivers.pwm import PwmDriver
from dart_flight.lock.persistence import ServoInUseError
from dart_flight.run.app import FlightApp
from tests.accounts import NOBODY, open_to_all
from tests.lock.rigs import Vary

ROOT = Path(__file__).parents[2]
URL = "udpin://127.0.0.1:24871"
# A process that owns the servo of a configuration, and with "pass" starts a child that takes the servo over.
HOLD = f"""
import os, subprocess, sys, time
import msgspec
from dart_flight.config.held_files import pass_kept
from dart_flight.config.vehicle import LockConfig
from dart_flight.lock.drivers import ActuatorLink, owned_driver, pwm
from tests.lock.rigs import Vary
if sys.argv[4:]:
    os.setgroups([])
    os.umask(0o077)
    os.setresgid(*3 * (int(sys.argv[4]),))
    os.setresuid(*3 * (int(sys.argv[4]),))
config = msgspec.json.decode(sys.argv[1], type=LockConfig)
link = ActuatorLink(lambda index, value: None, {URL!r})
with owned_driver(config, clock_us=lambda: 0, link=link, lasting=sys.argv[2] == "pass"):
    if sys.argv[2] == "fork" and os.fork() == 0:
        time.sleep(60)
    if sys.argv[2] != "pass":
        print("held", os.getpid(), flush=True)
        time.sleep(60)
descriptors, variable = pass_kept()
command = [sys.executable, "-c", sys.argv[3], sys.argv[1], "hold"]
child = subprocess.Popen(command, pass_fds=descriptors, env=os.environ | variable)
child.wait()
print("child ended", flush=True)
time.sleep(60)
"""


def use(config: LockConfig) -> None:
    """Own the servo for a moment."""
    link = ActuatorLink(lambda index, value: None, URL)
    with owned_driver(config, clock_us=lambda: 0, link=link):
        pass


def fly(config: LockConfig) -> None:
    """Fly with this lock on a link without a vehicle."""
    mission = load_mission(packaged("missions", "single_wall.yaml"))
    vehicle = msgspec.structs.replace(mission.vehicle, lock=config)
    app = FlightApp(msgspec.structs.replace(mission, vehicle=vehicle), URL, lambda record, number: None)
    asyncio.run(app.run())


def command_of(config: LockConfig, how: str, account: int | None) -> list[str]:
    more = [] if account is None else [str(account)]
    return [sys.executable, "-c", HOLD, msgspec.json.encode(config).decode(), how, HOLD, *more]


class Holder:
    """Another process that owns a servo, with another state folder and maybe another account."""

    def __init__(
        self, folder: Path, config: LockConfig, how: str = "hold", account: int | None = None
    ) -> None:
        environment = os.environ | {"DART_FLIGHT_STATE_DIR": str(folder / "other")}
        self.process = subprocess.Popen(
            command_of(config, how, account),
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            start_new_session=True,
        )
        assert self.process.stdout is not None
        self.pid = int(self.process.stdout.readline().split()[1])

    def end(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.communicate()


@pytest.fixture(autouse=True)
def _own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))
    yield
    monkeypatch.undo()
    folder = shared_file("x").parent
    for path in folder.glob(f"dart-flight-servo-*{tmp_path.name}*"):  # of killed processes
        path.unlink()


@pytest.fixture
def chip(tmp_path: Path) -> Path:
    """The files of a PWM chip, under the name that the kernel gives and a link to it."""
    chip = tmp_path / "devices" / "pwmchip0"
    chip.mkdir(parents=True)
    (chip / "npwm").write_text("4\n")
    for name in ("sys", "same"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "pwmchip0").symlink_to(chip)
    return chip


@pytest.fixture
def pwm(vary: Vary, chip: Path, tmp_path: Path) -> LockConfig:
    return vary(driver=LockDriver.PWM, pwm={"sysfs_dir": str(tmp_path / "sys"), "chip": 0, "channel": 1})


@pytest.fixture
def holders() -> Iterator[list[Holder]]:
    started: list[Holder] = []
    yield started
    for holder in started:
        holder.end()


@pytest.mark.parametrize(
    ("driver", "name"),
    [
        (LockDriver.PWM, "pwmchip0, channel 1"),
        (LockDriver.MAESTRO, "/servo-by-id"),
        (LockDriver.PX4, f"an output of PX4 on {URL}"),
    ],
)
def test_a_device_in_use_is_refused_under_each_of_its_names(
    driver: LockDriver, name: str, pwm: LockConfig, tmp_path: Path, holders: list[Holder]
) -> None:
    (tmp_path / "ttyACM7").touch()
    (tmp_path / "servo-by-id").symlink_to(tmp_path / "ttyACM7")
    replace = msgspec.structs.replace
    maestro = replace(pwm.maestro, port=str(tmp_path / "ttyACM7"))
    first = replace(pwm, driver=driver, maestro=maestro)
    second = replace(
        first,
        maestro=replace(maestro, port=str(tmp_path / "servo-by-id"), channel=3),
        pwm=replace(first.pwm, sysfs_dir=str(tmp_path / "same")),
    )
    holders.append(Holder(tmp_path, first))
    with pytest.raises(ServoInUseError) as caught:
        use(second)
    assert caught.value.pid == holders[0].pid
    assert re.fullmatch(
        rf"the lock's servo \(.*{re.escape(name)}\) is in use by a Python program, process {holders[0].pid}",
        str(caught.value),
    )
    holders[0].process.kill()
    holders[0].process.wait()
    use(second)


def test_other_servos_and_the_mock_have_other_owners(
    pwm: LockConfig, tmp_path: Path, holders: list[Holder]
) -> None:
    replace = msgspec.structs.replace
    holders.append(Holder(tmp_path, pwm))
    use(replace(pwm, pwm=replace(pwm.pwm, channel=2)))
    mock = replace(pwm, driver=LockDriver.MOCK)
    holders.append(Holder(tmp_path, mock))
    use(mock)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs a second account")
@pytest.mark.parametrize("mode", [None, 0o644, 0o600])
@pytest.mark.parametrize("first", [0, NOBODY])
def test_accounts_exclude_each_other(
    first: int, mode: int | None, pwm: LockConfig, tmp_path: Path, holders: list[Holder]
) -> None:
    """Another program may have created the file, and other accounts may only read it, or not even that."""
    open_to_all(tmp_path)
    if mode is not None:
        path = shared_file(f"servo-{PwmDriver(pwm).device().key}")
        path.touch()
        path.chmod(mode)
    second = NOBODY if first == 0 else 0
    if mode == 0o600 and first == NOBODY:
        first, second = second, first
    holders.append(Holder(tmp_path, pwm, account=first))
    done = subprocess.run(command_of(pwm, "hold", second), capture_output=True, text=True, check=False)
    if mode == 0o600:
        assert done.stderr.endswith(f"{path}: cannot open: Permission denied; sudo chmod 666 {path}\n")
    elif mode == 0o644 and first == NOBODY:
        assert "is in use by another process" in done.stderr
    else:
        assert f"is in use by a Python program, process {holders[0].pid}" in done.stderr


def test_a_child_takes_the_servo_over_without_a_gap(
    pwm: LockConfig, tmp_path: Path, holders: list[Holder]
) -> None:
    holder = Holder(tmp_path, pwm, "pass")  # the first line is the child's
    holders.append(holder)
    parent = holder.process
    assert holder.pid != parent.pid
    with pytest.raises(ServoInUseError, match=f"process {holder.pid}$"):
        use(pwm)
    os.kill(holder.pid, signal.SIGKILL)
    assert parent.stdout is not None
    assert parent.stdout.readline() == "child ended\n"
    with pytest.raises(ServoInUseError):  # its parent still owns the servo
        use(pwm)
    parent.kill()
    parent.wait()
    use(pwm)


def test_a_flight_keeps_the_servo_of_a_parent_that_died(
    pwm: LockConfig, tmp_path: Path, holders: list[Holder]
) -> None:
    holder = Holder(tmp_path, pwm, "pass")
    holders.append(holder)
    holder.process.kill()
    holder.process.wait()
    with pytest.raises(ServoInUseError, match=f"process {holder.pid}$"):
        use(pwm)


def test_a_crash_frees_the_servo_even_if_a_forked_child_survives(
    pwm: LockConfig, tmp_path: Path, holders: list[Holder]
) -> None:
    holders.append(Holder(tmp_path, pwm, "fork"))
    os.kill(holders[0].pid, signal.SIGKILL)
    holders[0].process.wait()
    use(pwm)


def test_only_one_owner_is_allowed_within_a_process(pwm: LockConfig) -> None:
    with owned_driver(pwm, clock_us=lambda: 0), pytest.raises(ServoInUseError) as caught:
        use(pwm)
    assert caught.value.pid == os.getpid()
    use(pwm)


def test_a_flight_is_refused_before_it_connects(
    pwm: LockConfig, tmp_path: Path, holders: list[Holder]
) -> None:
    holders.append(Holder(tmp_path, pwm))
    with pytest.raises(ServoInUseError, match=f"process {holders[0].pid}$"):
        fly(pwm)


def test_a_flight_without_the_servos_chip_is_refused(pwm: LockConfig, chip: Path) -> None:
    (chip / "npwm").unlink()
    chip.rmdir()
    with pytest.raises(DriverError, match="pwmchip0 does not exist"):
        use(pwm)
    with pytest.raises(InputError, match=r"lock\.pwm\.chip: .* does not exist"):
        fly(pwm)


def test_a_computer_without_a_shared_folder_is_refused_in_one_line(
    pwm: LockConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(held_files, "_SHARED", (tmp_path, tmp_path / "absent"))
    with pytest.raises(InputError, match=r"cannot reserve servo or PX4: .* is world-writable") as caught:
        use(pwm)
    assert "\n" not in str(caught.value)


def test_only_simulated_time_has_drivers_without_an_owner() -> None:
    """Every other program gets its driver from `owned_driver`, which owns the servo."""
    users = [
        str(path.relative_to(ROOT / "dart_flight"))
        for path in (ROOT / "dart_flight").rglob("*.py")
        if "make_driver(" in path.read_text("utf-8")
    ]
    assert sorted(users) == ["lock/drivers/__init__.py", "run/fast.py"]
