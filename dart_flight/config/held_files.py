"""Files that mark which process holds a resource, such as a link or a servo.

Files for servos and PX4 instances are in a folder that all accounts of the computer share. Files for links
are in the state folder. Functions raise `InputError` if a file cannot be created, read, written or locked.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import stat
import sys
import time
from abc import ABC, abstractmethod
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from dart_flight.config.document import InputError
from dart_flight.config.state_folder import REMEDY, cannot

_ATTEMPTS, _PAUSE_S = 3, 0.02
_LONGEST = 65536
_LONGEST_NAME = 180
_SHARED: Final = (Path("/run/lock"), Path("/dev/shm"))
_FOR_ALL: Final = stat.S_ISVTX | stat.S_IWOTH
_KEPT: Final = "DART_FLIGHT_KEPT_FILES"  # its value has a line `descriptor=path` for each kept file


def shared_file(name: str) -> Path:
    """Return the path of a file in the folder that all accounts of this computer share.

    The choice depends only on the folder's mode, not on the account, so that all programs choose the same
    folder.
    """
    name = re.sub(r"[^A-Za-z0-9.@_-]+", "-", name)
    if len(name) > _LONGEST_NAME:
        name = f"{name[:_LONGEST_NAME]}-{hashlib.sha256(name.encode()).hexdigest()[:16]}"
    for folder in _SHARED:
        with contextlib.suppress(OSError):
            if folder.stat().st_mode & _FOR_ALL == _FOR_ALL:
                return folder / f"dart-flight-{name}"
    places = " nor ".join(str(folder) for folder in _SHARED)
    raise InputError(
        f"cannot reserve servo or PX4: neither {places} is world-writable; run: "
        f"sudo install -d -m 1777 {_SHARED[0]}"
    )


def lock_file(descriptor: int, path: Path, remedy: str, *, shared: bool = False) -> bool:
    """Try to lock an open file without waiting; return whether the lock was acquired.

    Args:
        descriptor: descriptor of the open file; closing it ends the lock.
        path: path of the file, for the error.
        remedy: advice for the operator if the file system cannot lock files (NFS without a lock daemon).
        shared: whether the lock tolerates other shared locks.
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
        content: description of the holder; empty if the holder has not written anything yet.
    """

    def __init__(self, content: bytes) -> None:
        super().__init__("in use")
        self.content = content


class HeldFile:
    """An advisory lock on a file that contains a description of its holder.

    `acquire` creates the file, and `release` removes it. The kernel releases the lock when the process ends
    for any reason. Two parts of one process exclude each other as well. A forked child does not inherit the
    locks of its parent. A process that has called `keep` holds the file until the process ends. With
    `pass_kept` a child process holds the file, too. Every account can hold the file, even if another account
    has created it. `remedy` is the advice of an error.
    """

    def __init__(self, path: Path, remedy: str = REMEDY) -> None:
        self._path, self._remedy = path, remedy
        self._descriptor: int | None = None

    def acquire(self, content: bytes) -> None:
        """Acquire the lock and write the description of the holder.

        Raises:
            HeldError: another holder has the lock.
        """
        if any(held._path == self._path for held in _held):
            raise HeldError(read_held(self._path) or b"")
        kept = _kept_files().get(self._path)
        if kept is not None and not _is_at(
            kept, self._path
        ):  # the file was deleted, so another process may have locked its successor
            os.close(_kept_files().pop(self._path))
            kept = None
        self._descriptor = self._lock() if kept is None else os.dup(kept)
        _held.add(self)
        try:
            self.write(content)
        except InputError:
            self.release()
            raise

    def write(self, content: bytes) -> None:
        """Replace the file's content. If the file could be opened only for reading, do nothing."""
        assert self._descriptor is not None
        if fcntl.fcntl(self._descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            return
        try:
            os.pwrite(self._descriptor, content, 0)
            os.ftruncate(self._descriptor, len(content))
        except OSError as error:
            raise _cannot("write", self._path, error, self._remedy) from None

    def keep(self) -> None:
        """Hold the file until this process ends, even if `release` and `acquire` are called again."""
        assert self._descriptor is not None
        if self._path not in _kept_files():
            _kept_files()[self._path] = os.dup(self._descriptor)

    def release(self) -> None:
        """Unlock and remove the file, if it is held; if the file cannot be removed, only unlock it."""
        if self._descriptor is not None:
            if self._path not in _kept_files():
                with contextlib.suppress(OSError):
                    self._path.unlink()
            self.drop()

    def drop(self) -> None:
        """Close the file in a forked child, without releasing the parent's lock."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
            _held.discard(self)

    def _lock(self) -> int:
        other = b""
        for attempt in range(_ATTEMPTS):
            if attempt:  # wait: the holder may be a process that locks the file briefly, to check it
                time.sleep(_PAUSE_S)
            descriptor = self._open(last=attempt == _ATTEMPTS - 1)
            if descriptor is None:
                continue
            locked = False
            try:
                if not lock_file(descriptor, self._path, self._remedy):
                    other = os.pread(descriptor, _LONGEST, 0)
                elif _is_at(descriptor, self._path):  # the path still leads to the locked file
                    locked = True
                    return descriptor
            finally:
                if not locked:
                    os.close(descriptor)
        raise HeldError(other)

    def _open(self, *, last: bool) -> int | None:
        """Return the descriptor of the open file, or None if another attempt may succeed.

        Creating and opening are separate steps: with fs.protected_regular, the kernel refuses O_CREAT for
        another account's file in a folder such as /run/lock.
        """
        flags = os.O_CLOEXEC | os.O_NOFOLLOW
        try:
            descriptor = os.open(self._path, flags | os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            pass
        except OSError as error:
            raise _cannot("create", self._path, error, self._remedy) from None
        else:
            os.fchmod(descriptor, 0o666)  # fchmod ignores the umask
            return descriptor
        for access in (os.O_RDWR, os.O_RDONLY):  # a read-only file can be locked, but not written
            try:
                return os.open(self._path, flags | access)
            except FileNotFoundError:
                return None  # the previous holder has just removed the file
            except OSError as error:
                problem = error
        if last:
            raise _cannot("open", self._path, problem, self._remedy)
        return None  # another program may have created the file and not yet set its mode


def pass_kept() -> tuple[list[int], dict[str, str]]:
    """Return the kept files for a child process: the descriptors to pass, and an environment variable."""
    kept = _kept_files()
    lines = "\n".join(f"{descriptor}={path}" for path, descriptor in kept.items())
    return list(kept.values()), {_KEPT: lines} if kept else {}


def _kept_files() -> dict[Path, int]:
    """Return the descriptor of each kept file, including files passed on by the parent process."""
    global _kept  # noqa: PLW0603
    if _kept is None:
        _kept = {}
        for line in os.environ.pop(_KEPT, "").splitlines():
            number, _, name = line.partition("=")
            with contextlib.suppress(OSError, ValueError, InputError):
                if _is_at(int(number), Path(name)):
                    os.set_inheritable(int(number), False)
                    _kept[Path(name)] = int(number)
    return _kept


class Lease(ABC):
    """Base of exclusive rights: a context manager that acquires and releases the right."""

    @abstractmethod
    def acquire(self) -> None:
        """Acquire the right, or raise the subclass's error if another process holds it."""

    @abstractmethod
    def release(self) -> None:
        """Release the right, if it is held."""

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def read_held(path: Path) -> bytes | None:
    """Return the content that the holder of a file wrote, or None if the file is not held."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise _cannot("read", path, error) from None
    try:
        free = lock_file(descriptor, path, REMEDY, shared=True)
        return None if free else os.pread(descriptor, _LONGEST, 0)
    finally:
        os.close(descriptor)


def program_name() -> str:
    """Return the name of this program and its command, such as `dart-flight standby`."""
    program, *arguments = sys.argv or [""]
    path = Path(program)
    if path.name != "dart-flight" and path.parent.name != "dart_flight":
        return path.name if path.suffix == ".py" else "a Python program"
    return " ".join(["dart-flight", *arguments[:1]])


def _cannot(do: str, path: Path, error: OSError, remedy: str = REMEDY) -> InputError:
    if path.parent not in _SHARED:
        return cannot(do, path, error, remedy)
    remedy = f"make {path.parent} writable (in a systemd unit: ReadWritePaths={path.parent})"
    if error.errno in (errno.EACCES, errno.EPERM):
        remedy = f"sudo chmod 666 {path}"
    return InputError(f"cannot {do}: {error.strerror}; {remedy}", source=str(path))


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False
    except OSError as error:
        raise _cannot("read", path, error) from None


_held: set[HeldFile] = set()
_kept: dict[Path, int] | None = None


def _drop_all() -> None:
    for held in list(_held):
        held.drop()
    while _kept:
        os.close(_kept.popitem()[1])


# A forked child shares the open file and its flock, which would otherwise outlive the parent.
os.register_at_fork(after_in_child=_drop_all)
