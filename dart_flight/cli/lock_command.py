"""`dart-flight lock`: move the locking mechanism, report its state, or calibrate its servo."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.cli import EXIT_INCOMPLETE, EXIT_OK
from dart_flight.cli.options import add_driver_option, link_of, refuse_unwritable
from dart_flight.cli.terminal import emit_json, messages, print_status, tables
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import Document, InputError
from dart_flight.config.edit import write_values
from dart_flight.config.provenance import find_vehicle
from dart_flight.config.vehicle import LockConfig, LockDriver
from dart_flight.config.vehicle.configuration import default_config_path
from dart_flight.lock.calibration import HELP, Calibration, CalibrationError
from dart_flight.lock.drivers import DRIVERS, ActuatorLink, Driver, DriverError, driver_names
from dart_flight.lock.drivers.px4_output import parameter_problems, required_parameters
from dart_flight.lock.ground import GroundLock, calibration, ground_driver
from dart_flight.lock.persistence import CommandStore, LastCommand, ServoInUseError, delete_last, load_last
from dart_flight.lock.state_machine import describe
from dart_flight.vehicle.link import LinkLease


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("rigid", "flexible", "toggle", "status", "calibrate"))
    add_driver_option(parser)
    parser.add_argument("--connection", metavar="URL", help="connection to the autopilot, for the px4 driver")
    parser.add_argument(
        "--release",
        action="store_true",
        help="switch the pulses off when the lock has settled (default: keep them on to hold the rods)",
    )
    parser.add_argument("--yes", action="store_true", help="with calibrate: write without confirmation")


def run(arguments: argparse.Namespace) -> int:
    """Return 0 if the lock has reached the requested mode."""
    path = Path(arguments.config) if arguments.config else default_config_path()
    vehicle, source = find_vehicle(path)
    arguments.vehicle = source
    if vehicle.lock is None:
        raise InputError("this vehicle has no lock", source=str(path))
    config = _with_driver(vehicle.lock, arguments.driver, path)
    if arguments.action == "calibrate":
        refuse_unwritable(arguments, path)
    if config.driver is not LockDriver.PX4:
        return _owned(arguments, config, path, None)
    from dart_flight.vehicle.ground_link import GroundLink

    url = link_of(arguments, vehicle.connection)
    with LinkLease(url, "lock"), GroundLink(url, vehicle.connection.timeout_s) as link:
        problems = parameter_problems(
            config, link.read_parameters(required.name for required in required_parameters(config))
        )
        for problem in problems:
            print_status(f"PX4 cannot move the servo: {problem}")
        if problems and arguments.action != "status":
            return EXIT_INCOMPLETE
        return _owned(arguments, config, path, ActuatorLink(link.set_actuator, url))


def _owned(arguments: argparse.Namespace, config: LockConfig, path: Path, link: ActuatorLink | None) -> int:
    """Reserve the servo and carry out the action. If another process owns the servo, `status` reports it.

    Raises:
        ServoInUseError: another process owns the servo, and the action is not `status`.
    """
    last = load_last()
    try:
        with ground_driver(config, last, link) as driver:
            return _with_servo(arguments, config, path, driver, last)
    except ServoInUseError as error:
        status = arguments.action == "status"
        if status:
            print_status(error)
        if status or arguments.json:
            _report(arguments, config, None, ok=status, owner_pid=error.pid)
        if not status:
            raise
        return EXIT_OK
    except DriverError as error:
        if error.key:
            raise Document.load(path).error(("lock", *error.key), str(error)) from None
        print_status(f"lock: {error}")
        return EXIT_INCOMPLETE


def _with_driver(config: LockConfig, driver: LockDriver | None, path: Path) -> LockConfig:
    if driver is None:
        return config
    try:
        return msgspec.structs.replace(config, driver=driver)
    except ValueError as error:
        raise Document.load(path).error(("lock",), str(error)) from None


def _with_servo(
    arguments: argparse.Namespace, config: LockConfig, path: Path, driver: Driver, last: LastCommand | None
) -> int:
    driver.open()
    if not DRIVERS[config.driver].moves and arguments.action != "status":
        real = driver_names(lambda entry: entry.moves)
        print_status(f"lock.driver is {config.driver.value}: no real servo moves; choose {real} (--driver)")
    if arguments.action == "calibrate":
        return _calibrate(arguments, config, path, driver)
    store = CommandStore(config.driver)
    lock = GroundLock(config, driver, store.store)
    state = lock.read_state()
    wanted = None
    if arguments.action != "status":
        if arguments.action != "toggle":
            wanted = Mode(arguments.action)
        elif state.mode is not None:
            wanted = state.mode.other
        elif last is not None and last.driver is config.driver:
            wanted = last.mode.other
        else:
            raise InputError(
                f"toggle: the position is unknown ({describe(state)}) and no command is on record; "
                "specify rigid or flexible"
            )
        state = lock.move(wanted, release=arguments.release)
        if store.problem is not None:
            print_status(store.problem)
    reached = wanted is None or (state.phase is LockPhase.SETTLED and state.mode is wanted)
    _report(arguments, config, state, ok=reached)
    return EXIT_OK if reached else EXIT_INCOMPLETE


def _report(
    arguments: argparse.Namespace,
    config: LockConfig,
    state: LockState | None,
    *,
    ok: bool,
    owner_pid: int | None = None,
) -> None:
    print_vehicle(arguments.vehicle, arguments)
    last = load_last()
    if arguments.json:
        report: dict[str, Any] = {
            "action": arguments.action,
            "driver": config.driver,
            "moves": DRIVERS[config.driver].moves,
            "ok": ok,
            "state": state,
            "text": None if state is None else describe(state),
            "travel_s": None,
            "last_command": last,
            "owner_pid": owner_pid,
            "vehicle": arguments.vehicle,
        }
        if state is not None and state.settled_us is not None and state.commanded_us is not None:
            report["travel_s"] = (state.settled_us - state.commanded_us) * 1e-6
        emit_json(report)
        return
    if state is not None:
        tables().print(f"{config.driver}: {describe(state)}", soft_wrap=True)
    if last is not None and arguments.action == "status":
        tables().print(f"last command: {last.describe()}", soft_wrap=True)


# --- calibrate -----------------------------------------------------------------------------------------


def _calibrate(arguments: argparse.Namespace, config: LockConfig, path: Path, driver: Driver) -> int:
    steps = calibration(config, driver)
    if driver.read().pulse_us is None:
        print_status(
            f"If you answer y, the servo immediately moves to {steps.pulse_us:g} us. "
            "Are the rods free to move? [y/N]"
        )
        if not _yes(arguments):
            return _unchanged(arguments, config, "the servo was not moved")
    delete_last()
    driver.set_pulse(steps.pulse_us)
    print_status(HELP)
    if not _seek(steps):
        return _unchanged(arguments, config, "cancelled: nothing written")
    found = steps.result()
    for key, value in steps.values().items():
        before = getattr(config.servo, str(key[-1]))
        print_status(f"{key[-1]}: {before:g} -> {value:g}")
    print_status(f"Write this to {path}? [y/N]")
    if not _yes(arguments):
        return _unchanged(arguments, config, "nothing written")
    write_values(path, steps.values())
    lock = GroundLock(found, driver, CommandStore(config.driver).store)
    lock.read_state()
    state = lock.move(Mode.FLEXIBLE, release=arguments.release)
    settled = state.phase is LockPhase.SETTLED
    _report(arguments, found, state, ok=settled)
    return EXIT_OK if settled else EXIT_INCOMPLETE


def _unchanged(arguments: argparse.Namespace, config: LockConfig, why: str) -> int:
    messages().print(why)
    if arguments.json:
        _report(arguments, config, None, ok=False)
    return EXIT_INCOMPLETE


def _seek(steps: Calibration) -> bool:
    """Process input lines until both ends of the servo are known; return False if the operator quits."""
    while steps.current_end is not None:
        print_status(f"{steps.current_end} end, now {steps.pulse_us:g} us:")
        line = sys.stdin.readline()
        if not line or line.strip().lower() in ("quit", "q"):
            return False
        try:
            steps.execute(line)
        except CalibrationError as error:
            print_status(str(error))
    return True


def _yes(arguments: argparse.Namespace) -> bool:
    return bool(arguments.yes) or sys.stdin.readline().strip().lower() in ("y", "yes")
