"""What outlives the process: the last command to the servo, and which process has it now.

Both live in the state folder. The last command is a command: after a restart it says what was asked of the
servo, not where the horn is.
"""

from __future__ import annotations

import os
import tempfile
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.config.document import InputError
from dart_flight.config.state_folder import REMEDY, HeldError, HeldFile, Lease, state_dir, usable
from dart_flight.config.vehicle import LockDriver

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
            LockPhase.TRAVELLING: "arrival not confirmed",
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
        self._folder = usable(folder or state_dir())
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
    """Return the last command that was written down; None if there is none or it is damaged.

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


class ServoOwnership(Lease):
    """The right to move the servo: a `HeldFile`, `lock.pid`, with the owner's process number in it."""

    def __init__(self, folder: Path | None = None) -> None:
        self._file = HeldFile((folder or state_dir()) / "lock.pid")

    def acquire(self) -> None:
        """Take the servo.

        Raises:
            ServoTakenError: another process, or another part of this one, has it.
            InputError: the state folder cannot be used.
        """
        try:
            self._file.acquire(f"{os.getpid()}\n".encode())
        except HeldError as error:
            raise ServoTakenError(_pid_in(error.content)) from None

    def release(self) -> None:
        """Give the servo back; harmless when it is not held."""
        self._file.release()


def _pid_in(content: bytes) -> int | None:
    try:
        return int(content)
    except ValueError:
        return None
