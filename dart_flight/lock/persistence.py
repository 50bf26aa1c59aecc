"""What outlives the process: the last command to the servo, and which process has it now.

Both live in `$DART_FLIGHT_STATE_DIR`, by default in the XDG state folder. The last command is a command:
after a restart it says what was asked of the servo, not where the horn is.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType

import msgspec

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import LockDriver
from dart_flight.samples import LockPhase, LockState, Mode


def state_dir() -> Path:
    """`$DART_FLIGHT_STATE_DIR`, else `$XDG_STATE_HOME/dart-flight`, else `~/.local/state/dart-flight`."""
    named = os.environ.get("DART_FLIGHT_STATE_DIR")
    if named:
        return Path(named)
    xdg = os.environ.get("XDG_STATE_HOME")
    return (Path(xdg) if xdg else Path.home() / ".local" / "state") / "dart-flight"


def _usable(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot use the state folder: {error.strerror}; set DART_FLIGHT_STATE_DIR", source=str(folder)
        ) from None
    return folder


# --- the last command --------------------------------------------------------------------------------


class LastCommand(msgspec.Struct, frozen=True):
    """The last command to the servo, where it came from, and how far the servo was known to have got.

    Attributes:
        driver: through which driver.
        mode: where to.
        at_utc: wall-clock time of the last change, ISO 8601.
        pid: the process.
        phase: of the state then; `travelling` means the process ended before it was over.
        feedback: whether a limit switch had confirmed it.
    """

    driver: LockDriver
    mode: Mode
    at_utc: str
    pid: int
    phase: LockPhase
    feedback: bool = False

    def describe(self) -> str:
        """In words, for people."""
        how = {
            LockPhase.SETTLED: "settled then" + ("" if self.feedback else " (no feedback)"),
            LockPhase.TRAVELLING: "not seen to arrive",
        }.get(self.phase, "ended in a fault")
        return f"{self.mode} through {self.driver} at {self.at_utc}, {how}"


class CommandStore:
    """Writes down the last command at every change of the lock's state.

    Attributes:
        problem: why the last state could not be written; None: it was. A full disk does not stop a lock.
    """

    def __init__(self, driver: LockDriver, folder: Path | None = None) -> None:
        """Find the folder.

        Raises:
            InputError: it cannot be made.
        """
        self._driver = driver
        self._folder = _usable(folder or state_dir())
        self._mode: Mode | None = None
        self.problem: str | None = None

    def note(self, state: LockState) -> None:
        """Write a state down, whole or not at all; a state that follows no command is not written."""
        self._mode = state.mode or self._mode
        if state.commanded_us is None or self._mode is None:
            return
        last = LastCommand(
            driver=self._driver,
            mode=self._mode,
            at_utc=datetime.now(UTC).isoformat(timespec="milliseconds"),
            pid=os.getpid(),
            phase=state.phase,
            feedback=state.feedback,
        )
        try:
            self._write(msgspec.json.encode(last))
        except OSError as error:
            self.problem = f"cannot write the last command to {self._folder}: {error.strerror}"
        else:
            self.problem = None

    def _write(self, content: bytes) -> None:
        descriptor, name = tempfile.mkstemp(dir=self._folder, prefix=".lock")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(content)
            os.replace(name, self._folder / "last_command.json")
        except OSError:
            Path(name).unlink(missing_ok=True)
            raise


def load_last(folder: Path | None = None) -> LastCommand | None:
    """The last command that was written down; None where there is none or it cannot be understood."""
    try:
        return msgspec.json.decode(
            ((folder or state_dir()) / "last_command.json").read_bytes(), type=LastCommand
        )
    except (OSError, msgspec.DecodeError):
        return None


def forget_last(folder: Path | None = None) -> None:
    """The servo is about to be moved past the state machine: what was written down says nothing any more."""
    ((folder or state_dir()) / "last_command.json").unlink(missing_ok=True)


# --- the owner ---------------------------------------------------------------------------------------


class ServoTakenError(Exception):
    """Another process has the servo.

    Attributes:
        pid: of the other process; None where it cannot be told.
    """

    def __init__(self, pid: int | None) -> None:
        owner = "another process" if pid is None else f"process {pid}"
        super().__init__(f"the lock's servo is in use by {owner}")
        self.pid = pid


class ServoOwnership:
    """A record lock on `lock.pid`: the system gives it back when its process ends, however it ends.

    Record locks are of the process, so a child does not keep the lock of a parent that died. The file must
    be opened nowhere else in the process: closing any descriptor of it would give the lock up.
    """

    _held_here = False

    def __init__(self, folder: Path | None = None) -> None:
        self._path = (folder or state_dir()) / "lock.pid"
        self._descriptor: int | None = None

    def acquire(self) -> None:
        """Take the servo.

        Raises:
            ServoTakenError: another process, or another part of this one, has it.
            InputError: the state folder cannot be used.
        """
        if ServoOwnership._held_here:
            raise ServoTakenError(os.getpid())
        _usable(self._path.parent)
        try:
            descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise InputError(
                f"cannot write: {error.strerror}; set DART_FLIGHT_STATE_DIR", source=str(self._path)
            ) from None
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            owner = _pid_in(descriptor)
            os.close(descriptor)
            raise ServoTakenError(owner) from None
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        self._descriptor = descriptor
        ServoOwnership._held_here = True

    def release(self) -> None:
        """Give the servo back; harmless when it is not held."""
        if self._descriptor is not None:
            os.ftruncate(self._descriptor, 0)
            os.close(self._descriptor)
            self._descriptor = None
            ServoOwnership._held_here = False

    def __enter__(self) -> ServoOwnership:
        self.acquire()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def _pid_in(descriptor: int) -> int | None:
    try:
        return int(os.pread(descriptor, 32, 0))
    except (OSError, ValueError):
        return None
