"""Persistent state of the lock: the last command to the servo, and the process that owns the servo.

Both are files in the state folder. After a restart the last command shows what was requested of the servo. It
does not show the position of the horn.
"""

from __future__ import annotations

import os
import tempfile
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.config.document import InputError
from dart_flight.config.state_folder import REMEDY, HeldError, HeldFile, Lease, ensure_folder, state_dir
from dart_flight.config.vehicle import LockDriver

# --- the last command --------------------------------------------------------------------------------


class LastCommand(msgspec.Struct, frozen=True):
    """The last command to the servo, its origin, and the last known progress.

    Attributes:
        driver: driver that sent the command.
        mode: commanded mode.
        at_utc: wall-clock time of the last change of the lock's state, ISO 8601.
        pid: process that sent the command.
        phase: phase after this change; `travelling` means that the process ended during the travel.
        feedback: whether a limit switch confirmed the position.
    """

    driver: LockDriver
    mode: Mode
    at_utc: str
    pid: int
    phase: LockPhase
    feedback: bool = False

    def describe(self) -> str:
        """Return a line for the operator, such as "rigid by mock at ..., settled"."""
        how = {
            LockPhase.SETTLED: "settled" + ("" if self.feedback else " (no feedback)"),
            LockPhase.TRAVELLING: "arrival not confirmed",
        }.get(self.phase, "ended in a fault")
        return f"{self.mode} by {self.driver} at {self.at_utc}, {how}"


class CommandStore:
    """Stores the last command at every change of the lock's state.

    Attributes:
        problem: reason why the last state was not stored, or None. The lock moves even if the state cannot be
            stored, for example on a full disk.
    """

    def __init__(self, driver: LockDriver, folder: Path | None = None) -> None:
        """Find or create the folder.

        Raises:
            InputError: the folder cannot be created.
        """
        self._driver = driver
        self._folder = ensure_folder(folder or state_dir())
        self._mode: Mode | None = None
        self.problem: str | None = None

    def store(self, state: LockState) -> None:
        """Store a state atomically; if no command led to the state, store nothing."""
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
    """Return the last stored command, or None if no command is stored or the file is damaged.

    Raises:
        InputError: the file cannot be read.
    """
    path = (folder or state_dir()) / "last_command.json"
    try:
        return msgspec.json.decode(path.read_bytes(), type=LastCommand)
    except (FileNotFoundError, msgspec.DecodeError):
        return None
    except OSError as error:
        raise InputError(f"cannot read: {error.strerror}; {REMEDY}", source=str(path)) from None


def delete_last(folder: Path | None = None) -> None:
    """Delete the stored command, because the servo is about to be moved without the state machine."""
    ((folder or state_dir()) / "last_command.json").unlink(missing_ok=True)


# --- the owner ---------------------------------------------------------------------------------------


class ServoInUseError(Exception):
    """Another process owns the servo.

    Attributes:
        pid: process number of the other process, or None if unknown.
    """

    def __init__(self, pid: int | None) -> None:
        owner = "another process" if pid is None else f"process {pid}"
        super().__init__(f"the lock's servo is in use by {owner}")
        self.pid = pid


class ServoOwnership(Lease):
    """The right to move the servo: the owner holds `lock.pid`, which contains the owner's process number."""

    def __init__(self, folder: Path | None = None) -> None:
        self._file = HeldFile((folder or state_dir()) / "lock.pid")

    def acquire(self) -> None:
        """Acquire the servo.

        Raises:
            ServoInUseError: another process, or another object in this process, owns the servo.
            InputError: the state folder cannot be used.
        """
        try:
            self._file.acquire(f"{os.getpid()}\n".encode())
        except HeldError as error:
            raise ServoInUseError(_pid_in(error.content)) from None

    def release(self) -> None:
        """Release the servo, if this object owns the servo."""
        self._file.release()


def _pid_in(content: bytes) -> int | None:
    try:
        return int(content)
    except ValueError:
        return None
