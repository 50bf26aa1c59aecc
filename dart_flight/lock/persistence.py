"""Persistent state of the lock: the last command to the servo, and the process that owns the servo.

The last command is a file in the state folder. After a restart the file shows the requested position, but not
the position of the horn. The owner holds a file in a folder that all accounts share, because the service and
an operator over SSH have different state folders.
"""

from __future__ import annotations

import os
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import msgspec

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.config.document import InputError, write_problem
from dart_flight.config.held_files import HeldError, HeldFile, Lease, program_name, shared_file
from dart_flight.config.state_folder import cannot, ensure_folder, state_dir
from dart_flight.config.vehicle import LockDriver

# --- the last command --------------------------------------------------------------------------------


class LastCommand(msgspec.Struct, frozen=True):
    """The last command to the servo, its origin, and the last known progress.

    Attributes:
        at_utc: wall-clock time of the last change of the lock's state, ISO 8601.
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
        """Return a line such as "rigid by mock at ..., settled"."""
        how = {
            LockPhase.SETTLED: "settled" + ("" if self.feedback else " (no feedback)"),
            LockPhase.TRAVELLING: "arrival not confirmed",
        }.get(self.phase, "ended in a fault")
        return f"{self.mode} by {self.driver} at {self.at_utc}, {how}"


class CommandStore:
    """Stores the last command atomically at every change of the lock's state.

    Attributes:
        problem: reason why the last state was not stored, or None. The lock moves even if the state cannot be
            stored, for example on a full disk.
    """

    def __init__(self, driver: LockDriver, folder: Path | None = None) -> None:
        self._driver = driver
        self._folder = ensure_folder(folder or state_dir())
        self._mode: Mode | None = None
        self.problem: str | None = None

    def store(self, state: LockState) -> None:
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
            why = write_problem(self._folder, error)
            self.problem = f"cannot write the last command to {self._folder}: {why}"
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
    """Return the last stored command, or None if no command is stored or the file is damaged."""
    path = (folder or state_dir()) / "last_command.json"
    try:
        return msgspec.json.decode(path.read_bytes(), type=LastCommand)
    except (FileNotFoundError, ValueError):
        return None
    except OSError as error:
        raise cannot("read", path, error) from None


def delete_last(folder: Path | None = None) -> None:
    """Delete the stored command, because the servo is about to be moved without the state machine."""
    ((folder or state_dir()) / "last_command.json").unlink(missing_ok=True)


# --- the owner ---------------------------------------------------------------------------------------


class ServoOwner(msgspec.Struct, frozen=True):
    """The process that owns a servo, and its program."""

    pid: int
    program: str


class ServoInUseError(InputError):
    """Another process owns the servo; `pid` is the owner's process number, or None if unknown."""

    def __init__(self, device: str, owner: ServoOwner | None) -> None:
        by = "another process" if owner is None else f"{owner.program}, process {owner.pid}"
        super().__init__(f"the lock's servo ({device}) is in use by {by}")
        self.pid = None if owner is None else owner.pid


class ServoDevice(NamedTuple):
    """The hardware that only one process at a time may use to move a servo.

    Attributes:
        key: identifier of the hardware; two names of the same device have the same key.
        words: name of the hardware in messages.
    """

    key: str
    words: str


class ServoOwnership(Lease):
    """The right to move a servo.

    Args:
        lasting: whether this process owns the servo until the process ends, and passes the servo to child
            processes (`held_files.pass_kept`).
    """

    def __init__(self, device: ServoDevice, *, lasting: bool = False) -> None:
        self._device, self._lasting = device, lasting
        self._file = HeldFile(shared_file(f"servo-{device.key}"))

    def acquire(self) -> None:
        """Acquire the servo, or take it over from the parent process.

        Raises:
            ServoInUseError: another process, or another object in this process, owns the servo.
        """
        try:
            self._file.acquire(msgspec.json.encode(ServoOwner(os.getpid(), program_name())))
        except HeldError as error:
            raise ServoInUseError(self._device.words, _owner_in(error.content)) from None
        if self._lasting:
            self._file.keep()

    def release(self) -> None:
        self._file.release()


def _owner_in(content: bytes) -> ServoOwner | None:
    try:
        return msgspec.json.decode(content, type=ServoOwner)
    except ValueError:
        return None
