"""The state folder: data that outlives a process, and files that mark which process holds a resource.

`$DART_FLIGHT_STATE_DIR` names the folder; the default is in the XDG state folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from abc import ABC, abstractmethod
from pathlib import Path
from types import TracebackType
from typing import Self

from dart_flight.config.document import InputError

_ATTEMPTS, _PAUSE_S = 3, 0.02
_LONGEST = 65536
REMEDY = "set DART_FLIGHT_STATE_DIR to a local disk"


def state_dir() -> Path:
    """Return `$DART_FLIGHT_STATE_DIR`, `$XDG_STATE_HOME/dart-flight` or `~/.local/state/dart-flight`."""
    named = os.environ.get("DART_FLIGHT_STATE_DIR")
    if named:
        return Path(named)
    xdg = os.environ.get("XDG_STATE_HOME")
    return (Path(xdg) if xdg else Path.home() / ".local" / "state") / "dart-flight"


def ensure_folder(folder: Path) -> Path:
    """Return the folder; create it if it is missing.

    Raises:
        InputError: the folder cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot use the state folder: {error.strerror}; set DART_FLIGHT_STATE_DIR", source=str(folder)
        ) from None
    return folder


def lock_file(descriptor: int, path: Path, remedy: str, *, shared: bool = False) -> bool:
    """Try to lock an open file without waiting; return whether the lock was acquired.

    Args:
        descriptor: descriptor of the open file; closing it ends the lock.
        path: path of the file, for the error.
        remedy: advice to the operator if the file system cannot lock files.
        shared: whether the lock tolerates other shared locks.

    Raises:
        InputError: the file system cannot lock files; an example is NFS without a lock daemon.
    """
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise InputError(f"cannot lock {path}: {error.strerror}; {remedy}") from None
    return True


class HeldError(Exception):
    """Another process, or another part of this process, holds the file.

    Attributes:
        content: content that the holder has written; empty if the holder has not written anything yet.
    """

    def __init__(self, content: bytes) -> None:
        super().__init__("in use")
        self.content = content


class HeldFile:
    """An advisory lock on a file that contains a description of its holder.

    The kernel releases the lock when the process ends for any reason. Two parts of one process exclude each
    other as well. A forked child does not inherit the locks of its parent.

    Args:
        path: the file; created by `acquire`, removed by `release`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor: int | None = None

    def acquire(self, content: bytes) -> None:
        """Acquire the lock and write the description of the holder.

        Args:
            content: description to write.

        Raises:
            HeldError: another holder has the lock.
            InputError: the file cannot be written.
        """
        other = b""
        for attempt in range(_ATTEMPTS):
            if attempt:  # the holder may only be checking the lock
                time.sleep(_PAUSE_S)
            descriptor = self._open()
            try:
                if not lock_file(descriptor, self._path, REMEDY):
                    other = os.pread(descriptor, _LONGEST, 0)
                elif _is_at(descriptor, self._path):  # otherwise the previous holder has removed the file
                    self._descriptor = descriptor
                    break
            finally:
                if self._descriptor is None:
                    os.close(descriptor)
        else:
            raise HeldError(other)
        _held.add(self)
        try:
            self.write(content)
        except InputError:
            self.release()
            raise

    def write(self, content: bytes) -> None:
        """Replace the file's content.

        Raises:
            InputError: the file cannot be written.
        """
        assert self._descriptor is not None
        try:
            os.pwrite(self._descriptor, content, 0)
            os.ftruncate(self._descriptor, len(content))
        except OSError as error:
            raise InputError(f"cannot write: {error.strerror}; {REMEDY}", source=str(self._path)) from None

    def release(self) -> None:
        """Unlock and remove the file, if it is held; if the file cannot be removed, only unlock it."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                self._path.unlink()
            self.drop()

    def drop(self) -> None:
        """Close the file without releasing the lock, as in a forked child."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
            _held.discard(self)

    def _open(self) -> int:
        ensure_folder(self._path.parent)
        try:
            return os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise InputError(f"cannot write: {error.strerror}; {REMEDY}", source=str(self._path)) from None


class Lease(ABC):
    """An exclusive right, as a context manager that acquires and releases it."""

    @abstractmethod
    def acquire(self) -> None:
        """Acquire the right."""

    @abstractmethod
    def release(self) -> None:
        """Release the right; has no effect if it is not held."""

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def read_held(path: Path) -> bytes | None:
    """Return the content that the holder of a file wrote, or None if the file is not held.

    Raises:
        InputError: the file cannot be read or locked.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InputError(f"cannot read: {error.strerror}; {REMEDY}", source=str(path)) from None
    try:
        free = lock_file(descriptor, path, REMEDY, shared=True)
        return None if free else os.pread(descriptor, _LONGEST, 0)
    finally:
        os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    """Return whether a path still names the file that is open as `descriptor`.

    Raises:
        InputError: the path cannot be read.
    """
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False
    except OSError as error:
        raise InputError(f"cannot read: {error.strerror}; {REMEDY}", source=str(path)) from None


_held: set[HeldFile] = set()


def _drop_all() -> None:
    for held in list(_held):
        held.drop()


# A forked child shares the open file and its flock, which would otherwise outlive the parent.
os.register_at_fork(after_in_child=_drop_all)
