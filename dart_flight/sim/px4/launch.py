"""Starting and stopping a real PX4 (SITL) for one flight.

PX4 runs in a new working folder and in a separate session. PX4 gets the first free instance number, which
defines the ports. PX4's own client sets the parameters while PX4 waits for its simulator. Every version since
v1.14 waits at the same point of its start: after the airframe's defaults are applied, and before estimator
and controllers start. Functions that talk to PX4 raise Px4Error if it ends or does not answer.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import re
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError
from dart_flight.config.held_files import HeldError, HeldFile, shared_file
from dart_flight.config.parameter_file import (
    Parameter,
    PositionSource,
    Value,
    is_same_value,
    load_parameters,
    parse_listing,
    show_value,
    vehicle_files,
)
from dart_flight.config.rotors import COUNT, MAV_TYPES, motors_from_parameters, rotor_parameters
from dart_flight.config.vehicle import LockDriver, Motor, Px4Parameters, VehicleConfig, packaged
from dart_flight.lock.drivers.px4_output import ACTUATOR_SET_1, PREARM_ALWAYS
from dart_flight.sim.px4.bridge import servo_channel
from dart_flight.sim.px4.installation import CLIENT, MODEL, Install
from dart_flight.vehicle.link import LinkInUseError, LinkLease, feed_name, find_holder, udp_port_is_free

# Tested versions, with results in docs/px4.md; versions before 1.14 have other parameter names.
TESTED: tuple[tuple[int, int], ...] = ((1, 14), (1, 15), (1, 16), (1, 17), (1, 18))
OLDEST = (1, 14)
SIMULATOR_PORT, ONBOARD_PORT = 4560, 14540
# Each name is followed by "-" and the number. The lock file is locked while that instance runs.
_LOCK_FILES, _SOCKETS = "/tmp/px4_lock", "/tmp/px4-sock"
_LOCAL_PORTS = (14580, 18570, 14280, 13030)  # UDP, plus the instance number
_INSTANCES = range(10)  # the tenth and later instances of PX4 send to one shared port
_TERM_WAIT_S = 2.0
_WAITING = "Waiting for simulator to accept connection"
_BOOTED = "Startup script returned successfully"
_VERSION = "px4-ver"
_ANSWER_S = 5.0
MOTOR_1 = 101  # output function "Motor 1"
_CELL_V = 3.9  # cell voltage of a simulated battery in flight
_DIGITS = 5.1e-5  # tolerance: `px4-param show` writes four decimals
_SET_PDEATHSIG = 1


class Px4Error(FlightError):
    """PX4 cannot be started, or its version is not supported."""


# --- parameters --------------------------------------------------------------------------------------


def parameter_files(position_from: PositionSource) -> list[Path]:
    """Return the packaged files, in order of application."""
    return [*vehicle_files(position_from), packaged("configs", "px4", "simulation.params")]


def flight_parameters(
    vehicle: VehicleConfig, position_from: PositionSource, extra: list[Path] | None = None
) -> dict[str, Parameter]:
    """Return all parameters for PX4.

    Airframe and configuration give the first values, which the packaged files override. The user's own files
    in `extra` override all others.
    """
    own = airframe_parameters(vehicle)
    parameters = {name: Parameter(name, value, "the configuration") for name, value in own.items()}
    files = [load_parameters(path) for path in [*parameter_files(position_from), *(extra or [])]]
    measured = vehicle.mocap.measured_parameters().items()
    own_files = len(files) - len(extra or [])
    files.insert(own_files, {name: Parameter(name, value, "the configuration") for name, value in measured})
    for file in files:
        for name, parameter in file.items():
            before = parameters.get(name)
            # A user's file does not remove the packaged file's information about versions.
            if before is not None and not parameter.absent:
                parameter = msgspec.structs.replace(parameter, absent=before.absent, renamed=before.renamed)
            parameters[name] = parameter
    return parameters


def values_of(parameters: Mapping[str, Parameter]) -> dict[str, Value]:
    return {name: parameter.value for name, parameter in parameters.items()}


def select_parameters(parameters: Mapping[str, Parameter], known: Mapping[str, float]) -> dict[str, Value]:
    """Return the parameters to set in a PX4 that has the parameters `known`, under the names of this PX4.

    Raises:
        Px4Error: PX4 lacks a parameter that the parameter's file does not mark as `absent`.
    """
    chosen: dict[str, Value] = {}
    for name, parameter in parameters.items():
        if name in known:
            chosen[name] = parameter.value
        elif parameter.renamed in known:
            chosen.setdefault(str(parameter.renamed), parameter.value)
        elif not parameter.absent or parameter.renamed is not None:
            raise Px4Error(
                f"this PX4 has no parameter {name}, which must be {parameter.value:g}: "
                "docs/px4.md does not list this version of PX4, or the name is wrong"
            )
    return chosen


def describe_mismatch(wanted: Mapping[str, Value], actual: Mapping[str, float]) -> str | None:
    """Describe the first parameter that differs from its set value."""
    for name, value in wanted.items():
        has = actual.get(name)
        near = _DIGITS if isinstance(value, float) else 0.0
        if has is None or not is_same_value(has, value, near):
            return f"{name}: set to {show_value(value)}, PX4 has {'none' if has is None else show_value(has)}"
    return None


def airframe_parameters(vehicle: VehicleConfig) -> dict[str, Value]:
    """Return motors, thrust curve, gains and servo as PX4 parameters."""
    parameters: dict[str, Value] = {}
    motors = vehicle.airframe.motors
    parameters |= rotor_parameters(motors)
    if len(motors) in MAV_TYPES:
        parameters["MAV_TYPE"] = MAV_TYPES[len(motors)]
    for i in range(len(motors)):
        parameters[f"PWM_MAIN_FUNC{i + 1}"] = MOTOR_1 + i
    for axis, place in zip("XYZ", vehicle.imu.position_m, strict=True):
        parameters[f"EKF2_IMU_POS_{axis}"] = place
    parameters["THR_MDL_FAC"] = vehicle.thrust.square_share
    parameters["MPC_THR_HOVER"] = vehicle.hover_thrust_fraction()
    parameters["BAT1_N_CELLS"] = max(1, round(vehicle.simulation.battery_v / _CELL_V))
    for field in msgspec.structs.fields(Px4Parameters):
        parameters[field.encode_name] = float(getattr(vehicle.px4, field.name))
    if vehicle.lock is not None and vehicle.lock.driver is LockDriver.PX4:
        # In SITL the servo is on a simulated MAIN output, regardless of the vehicle's pin.
        function = ACTUATOR_SET_1 + vehicle.lock.px4.actuator_index - 1
        parameters[f"PWM_MAIN_FUNC{servo_channel(vehicle) + 1}"] = function
        parameters["COM_PREARM_MODE"] = PREARM_ALWAYS
    return parameters


def motors_from(parameters: Mapping[str, Value], vehicle: VehicleConfig) -> tuple[Motor, ...]:
    """Return the motors that PX4 will assume, from `parameters` and otherwise from the configuration.

    Raise InputError if their numbers of motors differ.
    """
    own = rotor_parameters(vehicle.airframe.motors)
    count = parameters.get(COUNT, own[COUNT])
    if count != own[COUNT]:
        raise InputError(
            f"{COUNT} is {count:g}, but the configuration has {own[COUNT]:g} motors", source="--params"
        )
    return motors_from_parameters({**own, **parameters}, "--params")


def environment() -> dict[str, str]:
    """Return the environment of the PX4 process, without variables of the caller that could affect PX4.

    Variables are not used to set parameters: PX4 reads PX4_PARAM_* variables only since v1.16, and in an
    order that depends on the version.
    """
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "LANG", "TZ") if name in os.environ}
    kept["PX4_SIM_MODEL"] = MODEL
    return kept


def arguments(install: Install, instance: int) -> list[str]:
    """Return PX4's command line; -d starts PX4 without a shell. The program's path must contain a slash."""
    return [str(install.program), "-i", str(instance), "-d", str(install.etc)]


# --- instance ----------------------------------------------------------------------------------------


class Instance:
    """A claimed PX4 instance (0 to 9, defines the ports); its simulator port does not listen yet."""

    def __init__(self, number: int, listener: socket.socket, held: contextlib.ExitStack) -> None:
        self.number, self._listener, self._held = number, listener, held

    def listen(self) -> socket.socket:
        self._listener.listen(1)
        return self._listener

    def release(self) -> None:
        self._listener.close()
        self._held.close()


def claim_instance() -> Instance:
    """Claim the first PX4 instance whose ports are free; raise Px4Error if all ten are in use."""
    for number in _INSTANCES:
        with contextlib.ExitStack() as held:
            try:
                # A lease is of this account. The file excludes other accounts and network namespaces.
                file = HeldFile(shared_file(f"px4-instance-{number}"))
                file.acquire(b"")
                held.callback(file.release)
                # The sender leases the port that PX4 sends to here; the receiver leases it in the app.
                held.enter_context(LinkLease(feed_name(ONBOARD_PORT + number), "dry-run --px4"))
            except (HeldError, LinkInUseError):
                continue
            taken = find_holder(f"udpin://127.0.0.1:{ONBOARD_PORT + number}") is not None
            listener = None if taken else _free_simulator_port(number)
            if listener is not None:
                return Instance(number, listener, held.pop_all())
    raise Px4Error(
        f"all {len(_INSTANCES)} PX4 instances are in use: stop one (they use ports from 4560 and 14540 on)"
    )


def _free_simulator_port(number: int) -> socket.socket | None:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        with socket.create_server(("127.0.0.1", SIMULATOR_PORT + number)):
            pass  # nothing listens on the port; binding alone would not show this
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", SIMULATOR_PORT + number))
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            return None
        raise Px4Error(f"TCP port {SIMULATOR_PORT + number} cannot be opened: {error.strerror}") from None
    ports = [ONBOARD_PORT + number, *(port + number for port in _LOCAL_PORTS)]
    if all(map(udp_port_is_free, ports)) and not _instance_is_taken(number):
        return listener
    listener.close()
    return None


def _instance_is_taken(instance: int) -> bool:
    """Return whether a running PX4 holds the instance's lock file, or another account has left its files.

    Only their owner can use such files: PX4 opens the lock file with O_CREAT, which the kernel may refuse
    even to root (fs.protected_regular), and it deletes the socket.
    """
    lock_file = f"{_LOCK_FILES}-{instance}"
    for path in (lock_file, f"{_SOCKETS}-{instance}"):
        with contextlib.suppress(FileNotFoundError):
            if os.stat(path).st_uid != os.geteuid():
                return True
    try:
        with open(lock_file, "r+b") as lock:
            fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except (BlockingIOError, PermissionError):
        return True
    except OSError as error:
        raise Px4Error(f"{lock_file} cannot be locked: {error.strerror}") from None
    return False


# --- the process -------------------------------------------------------------------------------------


def _die_with_parent() -> None:
    """Make the kernel kill this child when its parent ends: PX4 without a simulator runs forever."""
    ctypes.CDLL(None).prctl(_SET_PDEATHSIG, signal.SIGKILL)


class Px4:
    """One running PX4, started from the main thread: when the starting thread ends, the kernel kills PX4.

    PX4 works in `folder/px4`, and its console output goes to `folder/px4.log`.
    """

    def __init__(self, install: Install, instance: int, folder: Path) -> None:
        self._install, self.instance, self._folder = install, instance, folder
        self.work = folder / "px4"
        self.console = folder / "px4.log"
        self.work.mkdir(parents=True, exist_ok=False)
        try:
            with open(self.console, "wb") as console:
                self._process = subprocess.Popen(
                    arguments(install, instance),
                    cwd=self.work,
                    env=environment(),
                    stdin=subprocess.DEVNULL,
                    stdout=console,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                    preexec_fn=_die_with_parent,  # noqa: PLW1509  (no other thread runs yet)
                )
        except OSError as error:
            raise Px4Error(f"{install.program} does not start: {error.strerror}") from None

    @property
    def pid(self) -> int:
        """Process id of PX4, which is also the id of its session and process group."""
        return self._process.pid

    def ending(self) -> str | None:
        """Describe how the process ended, or return None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        if code < 0:
            return f"PX4 was killed by {signal.Signals(-code).name}"
        return f"PX4 ended with status {code}"

    def wait_waiting(self, timeout_s: float = 10.0) -> None:
        """Wait until PX4 waits for its simulator; the simulator must not listen yet."""
        deadline = time.monotonic() + timeout_s
        while not self._console_contains(_WAITING):
            self._check_alive("before it connected")
            if time.monotonic() > deadline:
                raise Px4Error(f"PX4 did not start within {timeout_s:g} s{self._last_error()}")
            time.sleep(0.02)

    def set_parameters(self, parameters: Mapping[str, Parameter]) -> dict[str, Value]:
        """Set parameters while PX4 waits for its simulator, and read every parameter back.

        Return the parameters that were set, without those that this version of PX4 does not need. Px4Error
        names a parameter that is unknown to PX4 or not accepted.
        """
        known = self.parameters()
        if not known:
            raise Px4Error(f"PX4 does not report its parameters{self._last_error()}")
        chosen = select_parameters(parameters, known)
        for name, value in chosen.items():
            self._answer(CLIENT, "set", name, str(value) if isinstance(value, int) else f"{value:.9g}")
        self.check_parameters(chosen, self.parameters())
        return chosen

    @staticmethod
    def check_parameters(wanted: Mapping[str, Value], actual: Mapping[str, float]) -> None:
        """Raise Px4Error if a parameter does not have the value that was set."""
        problem = describe_mismatch(wanted, actual)
        if problem is not None:
            raise Px4Error(f"parameter not accepted: {problem}")

    def version(self) -> tuple[int, int, int] | None:
        """Return PX4's version, or None if PX4 does not report it; call while PX4 waits for its simulator."""
        with contextlib.suppress(Px4Error):
            return parse_version(self._answer(_VERSION, "all"))
        return None

    def wait_connected(self, listener: socket.socket, timeout_s: float = 10.0) -> socket.socket:
        """Accept PX4's simulator connection."""
        listener.settimeout(0.1)
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            with contextlib.suppress(TimeoutError):
                return listener.accept()[0]
            self._check_alive("before it connected")
        raise Px4Error(f"PX4 did not connect to its simulator within {timeout_s:g} s{self._last_error()}")

    def _check_alive(self, when: str) -> None:
        ending = self.ending()
        if ending is not None:
            raise Px4Error(f"{ending} {when}{self._last_error()}")

    def _console_contains(self, words: str) -> bool:
        with contextlib.suppress(OSError):
            return words.encode() in self.console.read_bytes()
        return False

    def booted(self) -> bool:
        """Return whether the start-up script has finished."""
        return self._console_contains(_BOOTED)

    def _last_error(self) -> str:
        with contextlib.suppress(OSError):
            lines = self.console.read_text(errors="replace").splitlines()
            errors = [line for line in lines if "ERROR" in line] or lines
            if errors:
                return f": {errors[-1].strip()}"
        return ""

    def parameters(self) -> dict[str, float]:
        """Return all parameters; after booting, PX4 answers only while the lockstep continues."""
        return parse_listing(self._answer(CLIENT, "show", "-a"))

    def _answer(self, program: str, *arguments: str) -> str:
        """Run one of PX4's client programs, such as `px4-param`, and return its output."""
        client = self._install.program.parent / program
        try:
            done = subprocess.run(
                [str(client), "--instance", str(self.instance), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                timeout=_ANSWER_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired):
            self._check_alive(f"before it answered the command {program}")
            raise Px4Error(f"PX4 does not answer {program} {' '.join(arguments)}") from None
        return done.stdout.decode(errors="replace")

    def stop(self) -> None:
        """End PX4 and all its processes: SIGTERM, then SIGKILL to its session."""
        if self._process.poll() is None:
            self._process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_TERM_WAIT_S)
        # PX4's start-up script may still run; before the first sensor message PX4 handles no other signal.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()
        for kind in (_LOCK_FILES, _SOCKETS):  # otherwise no other account could use the instance
            with contextlib.suppress(OSError):
                os.unlink(f"{kind}-{self.instance}")

    def keep_log(self) -> Path | None:
        """If PX4 has written a ULog, move it to the flight's folder and delete the working folder."""
        logs = sorted(self.work.glob("log/**/*.ulg"), key=lambda path: path.stat().st_size)
        if not logs:
            return None
        kept = self._folder / "px4.ulg"
        logs[-1].replace(kept)
        shutil.rmtree(self.work, ignore_errors=True)
        return kept


def read_version(install: Install) -> tuple[int, int, int] | None:
    """Start PX4 for a moment and return its version, or None if PX4 does not report it."""
    instance = claim_instance()
    try:
        with tempfile.TemporaryDirectory() as folder:
            px4 = Px4(install, instance.number, Path(folder))
            try:
                px4.wait_waiting()
                return px4.version()
            finally:
                px4.stop()
    finally:
        instance.release()


def parse_version(answer: str) -> tuple[int, int, int] | None:
    """Return the version in the output of `px4-ver all`, such as (1, 16, 0)."""
    found = re.search(r"PX4 version:.*?(\d+)\.(\d+)\.(\d+)", answer)
    if found is None:
        return None
    return (int(found[1]), int(found[2]), int(found[3]))


def check_version(version: tuple[int, int, int] | None, folder: str) -> str | None:
    """Return a remark if docs/px4.md has no flights with this version; raise Px4Error if too old.

    Args:
        version: version of PX4, or None if PX4 does not report it.
        folder: folder of PX4, for the error.
    """
    flown = "tested versions: " + ", ".join(f"v{a}.{b}" for a, b in TESTED)
    if version is None:
        return f"PX4 does not report its version; {flown}"
    text = ".".join(map(str, version))
    if version[:2] < OLDEST:
        raise Px4Error(
            f"PX4 v{text} in {folder} is too old: at least v{OLDEST[0]}.{OLDEST[1]} is needed; {flown}"
        )
    if version[:2] not in TESTED:
        return f"PX4 v{text}; {flown}"
    return None
