"""The command `dart-flight lock` in real time, with real processes and the emulated Maestro."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dart_flight.base.records import LockPhase, Mode
from dart_flight.cli import main
from dart_flight.config.vehicle import LockDriver, Servo, packaged
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.lock.ground import clock_us
from dart_flight.lock.persistence import load_last
from dart_flight.lock.servo import mode_of
from tests.command_fixtures import Refuse, RunJson, Type
from tests.doubles.emulated_maestro import EmulatedMaestro
from tests.real_time import wait_until


class World:
    """A folder with its own configuration and state."""

    def __init__(self, folder: Path, run_json: RunJson) -> None:
        self.folder, self._run_json = folder, run_json
        self.config = folder / "dart.yaml"
        self.config.write_text(packaged("configs", "dart.yaml").read_text())
        self.set("port: /dev/ttyACM0", f"port: {folder / 'maestro'}")
        # A busy test computer delays the answer, which a real controller sends within 1 ms.
        self.set("reply_timeout_s: 0.05", "reply_timeout_s: 0.2")
        self.set("travel_s: null", "travel_s: 0.05")  # shortens the tests

    def set(self, old: str, new: str) -> None:
        text = self.config.read_text()
        assert old in text
        self.config.write_text(text.replace(old, new, 1))

    def command(self, *arguments: str) -> list[str]:
        return ["lock", *arguments, "--config", str(self.config)]

    def report(self, *arguments: str, status: int = 0) -> dict[str, Any]:
        """Run the command and return its report."""
        printed, _ = self._run_json(*self.command(*arguments), status=status)
        return dict(printed)

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "dart_flight", *self.command(*arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )


@pytest.fixture
def world(folder: Path, run_json: RunJson) -> World:
    return World(folder, run_json)


def servo_of(world: World) -> Servo:
    lock = load_vehicle(world.config).lock
    assert lock is not None
    return lock.servo


@pytest.fixture
def maestro(world: World) -> Iterator[EmulatedMaestro]:
    world.set("driver: mock", "driver: maestro")
    servo = servo_of(world)
    with EmulatedMaestro(servo, world.folder / "maestro", clock_us, horn_us=1300.0) as controller:
        yield controller


def test_the_command_moves_the_lock_and_returns_when_it_has_settled(
    world: World, maestro: EmulatedMaestro
) -> None:
    servo = servo_of(world)
    result = world.report("rigid")
    assert result["ok"] is True
    assert result["text"] == "rigid: settled (no feedback)"
    assert result["state"]["feedback"] is False
    assert 0.08 <= result["travel_s"] <= 1.0
    assert mode_of(servo, maestro.horn_us()) is Mode.RIGID
    assert maestro.output_us() == 1980.0  # the pulses stay on
    for expected in (Mode.FLEXIBLE, Mode.RIGID):
        assert world.report("toggle")["state"]["mode"] == expected
        assert mode_of(servo, maestro.horn_us()) is expected


def test_the_release_option_switches_the_pulses_off(
    world: World, maestro: EmulatedMaestro, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(world.command("rigid", "--release")) == 0
    assert capsys.readouterr().out == "maestro: rigid: settled (no feedback); pulses off\n"
    assert maestro.output_us() is None


def test_status_moves_nothing_and_reports_an_unknown_position(
    world: World, maestro: EmulatedMaestro, capsys: pytest.CaptureFixture[str]
) -> None:
    assert world.report("status")["state"]["phase"] == "unknown"
    assert 0x84 not in maestro.received
    assert main(world.command("rigid", "--release")) == 0
    capsys.readouterr()
    assert main(world.command("status")) == 0
    unknown, last = capsys.readouterr().out.splitlines()
    assert unknown == "maestro: unknown; the servo's position is unknown: its pulses are off"
    assert last.startswith("last command: rigid by maestro at ")
    assert last.endswith(", settled (no feedback)")
    world.report("rigid")
    assert world.report("status")["text"] == "rigid: settled (no feedback)"


def test_toggle_needs_a_known_position_or_a_last_command(
    world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(world.command("toggle")) == 2
    assert "specify rigid or flexible" in capsys.readouterr().err
    world.report("flexible")
    assert world.report("toggle")["state"]["mode"] == "rigid"


def test_a_servo_that_does_not_arrive_exits_with_status_1(world: World, maestro: EmulatedMaestro) -> None:
    world.set("timeout_s: 1.5", "timeout_s: 0.3")
    maestro.limits_us = (992.0, 1900.0)
    result = world.report("rigid", status=1)
    assert result["ok"] is False
    assert result["text"] == "fault; the controller outputs 1900 us instead of 1980 us"


def test_a_silent_controller_exits_with_status_1(
    world: World, maestro: EmulatedMaestro, capsys: pytest.CaptureFixture[str]
) -> None:
    maestro.mute()
    assert main(world.command("rigid")) == 1
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "no valid answer" in captured.err


@pytest.mark.parametrize(
    ("old", "new", "arguments", "expected"),
    [
        ("driver: mock", "driver: maestro", (), ": lock.maestro.port: "),
        (
            "chip: null                          # number",
            "chip: 7  # number",
            ("--driver", "pwm"),
            ": lock.pwm.chip: /sys/class/pwm/pwmchip7 does not exist",
        ),
        ("rigid_pulse_us: 1980.0", "rigid_pulse_us: 2400", (), "lock.servo: rigid_pulse_us must be within"),
        ("period_us: 20000.0", "period_us: 1.0", (), "lock.pwm.period_us"),
        ("version: 1", "version: 1", ("--driver", "hand"), "unknown --driver 'hand'"),
        ("/maestro", "/ttyS0", ("--driver", "maestro"), "lock.maestro.port: cannot open"),  # a regular file
    ],
)
def test_wrong_input_is_reported_in_one_line_with_status_2(
    world: World, refusal_of: Refuse, old: str, new: str, arguments: tuple[str, ...], expected: str
) -> None:
    world.set(old, new)
    (world.folder / "ttyS0").write_text("")
    assert expected in refusal_of(*world.command("rigid", *arguments))


# --- two processes, death ----------------------------------------------------------------------------


def wait_for_travel() -> int:
    def pid() -> int | None:
        last = load_last()
        return last.pid if last is not None and last.phase is LockPhase.TRAVELLING else None

    return wait_until(pid, 10.0, "a travel begins")


def test_a_second_process_is_refused_until_the_first_one_dies(
    world: World, maestro: EmulatedMaestro, capsys: pytest.CaptureFixture[str]
) -> None:
    world.set("travel_s: 0.05", "travel_s: 1.4")  # long enough to kill the process during the travel
    first = world.start("rigid")
    try:
        assert wait_for_travel() == first.pid
        assert main(world.command("flexible")) == 2
        who = f"in use by dart-flight lock, process {first.pid}"
        assert capsys.readouterr().err == f"the lock's servo ({world.folder}/maestro) is {who}\n"
        result = world.report("status")
        assert (result["owner_pid"], result["state"]) == (first.pid, None)
        assert result["last_command"]["phase"] == "travelling"
    finally:
        first.send_signal(signal.SIGKILL)
        first.communicate(timeout=10)
    # The process died during the travel: nobody owns the servo, whose pulses are still on.
    assert main(world.command("status")) == 0
    state, last = capsys.readouterr().out.splitlines()
    assert state == "maestro: rigid: settled (no feedback)"
    assert last.endswith("arrival not confirmed")


# --- calibrate ---------------------------------------------------------------------------------------


def test_calibrate_writes_the_two_ends(
    world: World, maestro: EmulatedMaestro, type_lines: Type, capsys: pytest.CaptureFixture[str]
) -> None:
    before = world.config.read_text().splitlines()
    type_lines("".join(f"{line}\n" for line in ("y", "1200", "up", "ok", "1690", "+", "ok", "y")))
    assert main(world.command("calibrate")) == 0
    out, error = capsys.readouterr()
    assert out == "maestro: flexible: settled (no feedback)\n"
    assert "Are the rods free to move?" in error
    assert "up is not a command" in error
    changed = [a for a, b in zip(world.config.read_text().splitlines(), before, strict=True) if a != b]
    assert [line.split("#")[0].strip() for line in changed] == [
        "rigid_pulse_us: 1700.0",
        "flexible_pulse_us: 1200.0",
    ]
    assert maestro.output_us() == 1200.0
    assert servo_of(world).us_per_deg == pytest.approx(500.0 / 90.0)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("n\n", "the servo was not moved"),
        ("y\n1480\nquit\n", "nothing written"),
        ("y\n1480\n", "nothing written"),
        ("y\n1450\nok\n1520\nok\nno\n", "nothing written"),
    ],
)
@pytest.mark.usefixtures("maestro")
def test_an_abandoned_calibration_writes_nothing(
    world: World, type_lines: Type, run_json: RunJson, lines: str, message: str
) -> None:
    before = world.config.read_text()
    type_lines(lines)
    printed, error = run_json(*world.command("calibrate"), status=1)
    assert message in error
    assert printed["ok"] is False
    assert world.config.read_text() == before


def test_calibrate_does_not_write_the_packaged_default(folder: Path, refusal_of: Refuse) -> None:
    assert "is the packaged default" in refusal_of("lock", "calibrate")
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("action", ["rigid", "flexible", "toggle"])
def test_the_mock_warns_first_that_no_real_servo_moves(
    world: World, capsys: pytest.CaptureFixture[str], action: str
) -> None:
    world.report("flexible")
    assert main(world.command(action)) == 0
    first = capsys.readouterr().err.splitlines()[0]
    assert re.fullmatch(r"lock.driver is mock: no real servo moves; choose .+ or \w+ \(--driver\)", first)
    assert all(kind.value in first for kind in LockDriver)
    assert world.report("rigid")["moves"] is False
