"""Checks of this installation, for `doctor`: packages, PX4, serial ports, permissions, disk and clock.

They need no mission and no vehicle. To add a check, add one line to `INSTALLATION_CHECKS`.
"""

from __future__ import annotations

import ctypes
import grp
import importlib.metadata
import multiprocessing
import os
import platform
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from dart_flight import __version__
from dart_flight.base.errors import FlightError
from dart_flight.base.processes import LATE_S, measure_lateness_s
from dart_flight.check.computer_load import check_computer
from dart_flight.check.findings import CheckFinding
from dart_flight.config.document import InputError
from dart_flight.config.packages import install_command
from dart_flight.config.state_folder import ensure_folder, state_dir
from dart_flight.sim.px4.installation import ENVIRONMENT, PACKAGES, find_install

_DISTRIBUTION = "dart-flight"
_NOT_FOR_USERS = ("dev", "full", "mutants", "site")  # extras of developers, and the sum of the others
_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+).*?;.*\bextra == ['\"](?P<extra>\w+)['\"]$")
_PORTS = ("ttyACM*", "ttyUSB*", "ttyAMA*", "serial[0-9]")
_LEAST_SPACE = 1e9  # bytes; a log of ten minutes takes less than a tenth of this
_TIME_ERROR = 5  # adjtimex(2): the clock is not synchronized
_TIMEX_BYTES = 512  # at least the size of the kernel's struct timex
_PATH = re.compile(r"(?<![\w*.-])[~/][^\s:,;]*")  # absolute, or in a home folder


@dataclass
class Computer:
    """The computer that the checks examine.

    Attributes:
        root: root of the file system with `dev`, `opt` and `proc`.
        environ: environment variables.
        private: whether findings must not contain paths of this account, because others will read them.
    """

    root: Path = Path("/")
    environ: Mapping[str, str] = field(default_factory=lambda: os.environ)
    private: bool = False

    def shown(self, path: Path) -> str:
        """Return the text for a path."""
        packaged = {f"/{package}" for package in PACKAGES}
        return str(path) if not self.private or str(path) in packaged else "a folder of this account"

    def redacted(self, text: str, folder: Path = Path("/")) -> str:
        """Return the text of an error that may mention `folder`, for `private` without paths."""
        if not self.private:
            return text
        named = self.environ.get(ENVIRONMENT, "/")
        own = {str(folder), named, os.path.realpath(named), self.environ.get("HOME", "/"), str(state_dir())}
        for path in sorted(own, key=len, reverse=True):  # a path may contain spaces
            text = text.replace(path, "/")
        return _PATH.sub("PATH", text)


class InstallationCheck(NamedTuple):
    """A check of this installation."""

    name: str
    run: Callable[[Computer], Iterable[CheckFinding]]


def check_program(computer: Computer) -> Iterator[CheckFinding]:
    """Report the versions of program, Python, system and processor, which are always acceptable."""
    board = computer.root / "proc" / "device-tree" / "model"  # on a Raspberry Pi
    model = board.read_text().strip("\0\n") if board.exists() else platform.machine()
    kernel = re.match(r"[\d.]*", platform.release())  # a kernel's own suffix may contain a name
    try:
        system = platform.freedesktop_os_release()["PRETTY_NAME"]
    except OSError:
        system = sys.platform
    message = (
        f"dart-flight {__version__}, Python {platform.python_version()}, {system}, kernel "
        f"{kernel[0] if kernel else ''}, {model}, {os.cpu_count()} processors"
    )
    yield CheckFinding("program", True, message)


def check_packages(computer: Computer) -> Iterator[CheckFinding]:
    """Check that the packages of each extra are installed; a missing extra is a remark."""
    try:
        required = importlib.metadata.requires(_DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        yield CheckFinding("packages", True, "this program is not installed by pip: no extras", remark=True)
        return
    extras: dict[str, list[str]] = {}
    for line in sorted(required):
        found = _REQUIREMENT.match(line)
        if found is None:  # a package of every installation
            name = re.split(r"[^\w.-]", line)[0]
            extras.setdefault("packages", []).append(name)
        elif found["extra"] not in _NOT_FOR_USERS and found["name"] != _DISTRIBUTION:
            extras.setdefault(found["extra"], []).append(found["name"])
    for extra, names in sorted(extras.items(), key=lambda item: item[0] != "packages"):
        versions = {name: _version_of(name) for name in names}
        missing = [name for name, version in versions.items() if version is None]
        message = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
        needed = extra == "packages"
        if missing:
            message = f"missing: {', '.join(missing)}"
            if not needed and not computer.private:
                message += f"; {install_command(extra)}"
        yield CheckFinding(extra, not (missing and needed), message, remark=bool(missing) and not needed)


def _version_of(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def check_px4(computer: Computer) -> Iterator[CheckFinding]:
    """Find PX4, and start it for a moment to read its version; without a PX4 this is a remark."""
    try:
        install = find_install(None, computer.environ, computer.root)
    except InputError as error:
        message = computer.redacted(error.one_line())
        if error.hints:
            message = "no PX4 found; `dart-flight dry-run MISSION --px4` lists three ways to get one"
        named = bool(computer.environ.get(ENVIRONMENT))
        yield CheckFinding("px4", not named, message, remark=not named)
        return
    where = computer.shown(install.folder)
    try:
        from dart_flight.sim.px4.launch import check_version, read_version  # noqa: PLC0415

        version = read_version(install)
        note = check_version(version, where)
    except ImportError:
        yield CheckFinding("px4", True, f"PX4 in {where}, not started without pymavlink", remark=True)
    except (FlightError, InputError) as error:
        yield CheckFinding("px4", False, f"PX4 in {where}: {computer.redacted(str(error), install.folder)}")
    else:
        text = "of unknown version" if version is None else "v" + ".".join(map(str, version))
        message = f"PX4 {text} in {where} starts" + (f"; {note}" if note else "")
        yield CheckFinding("px4", True, message, remark=note is not None)


def check_ports(computer: Computer) -> Iterator[CheckFinding]:
    """Check that this account can open the serial ports; their names in `by-id` have serial numbers."""
    ports = sorted(port for pattern in _PORTS for port in (computer.root / "dev").glob(pattern))
    closed = [port for port in ports if not os.access(port, os.R_OK | os.W_OK)]
    message = ", ".join(port.name for port in ports) or "none"
    if closed:
        groups = {_group_of(port) for port in closed}
        message += (
            f"; this account cannot open {', '.join(port.name for port in closed)}: run "
            f"`sudo usermod -aG {','.join(sorted(groups))} $USER` and log in again"
        )
    yield CheckFinding("ports", True, message, remark=bool(closed))


def _group_of(port: Path) -> str:
    """Return the group of a serial port; the group of a person is not a group for ports."""
    number = port.stat().st_gid
    try:
        return grp.getgrgid(number).gr_name if 0 < number < 1000 else "dialout"
    except KeyError:
        return "dialout"


def check_realtime(computer: Computer) -> Iterator[CheckFinding]:
    """Try real-time scheduling, and measure for half a second how late this program wakes up."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except OSError:
        message = "real-time scheduling is not permitted: `chrt -r 1` needs a limit rtprio or root"
        yield CheckFinding("realtime", True, message, remark=True)
    else:
        os.sched_setscheduler(0, *before)
        yield CheckFinding("realtime", True, "real-time scheduling is permitted (`chrt -r 1`)")
    late_s = measure_lateness_s()
    message = f"this program lags by up to {late_s * 1e3:.0f} ms"
    late = late_s > LATE_S
    if late:
        message += ": the computer is too busy for a real-time flight"
    yield CheckFinding("lateness", True, message, remark=late)


def check_disk(computer: Computer) -> Iterator[CheckFinding]:
    """Check the working folder, which receives the logs, and the state folder."""
    folders: dict[str, tuple[str, Callable[[], Path]]] = {
        "disk": ("working folder", lambda: Path.cwd() / "flights"),
        "state": ("state folder", lambda: ensure_folder(state_dir())),
    }
    for item, (name, find) in folders.items():
        try:
            folder = find()
            there = next(one for one in (folder, *folder.parents) if one.exists())
            free = shutil.disk_usage(there).free
        except (OSError, InputError) as error:
            yield CheckFinding(item, False, f"{name}: {computer.redacted(str(error))}")
            continue
        go = os.access(there, os.W_OK)
        message = f"{name}: {free / 1e9:.1f} GB free"
        if not go:
            message = f"{name}: this account cannot write there"
        yield CheckFinding(item, go, message, remark=go and free < _LEAST_SPACE)


def check_clock(computer: Computer) -> Iterator[CheckFinding]:
    """Ask the kernel whether the clock is synchronized; flights use it only for the dates of their logs."""
    state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    good = 0 <= state < _TIME_ERROR
    message = "synchronized"
    if not good:
        message = "not known to be synchronized; the dates of logs may be wrong"
    yield CheckFinding("clock", True, message, remark=not good)


def check_shared_memory(computer: Computer) -> Iterator[CheckFinding]:
    """Check that parallel flights can create their locks in shared memory."""
    try:
        multiprocessing.get_context("spawn").Lock()
        free = shutil.disk_usage("/dev/shm").free
    except OSError as error:
        message = (
            f"{error.strerror}; parallel flights need a writable /dev/shm (in a container: --tmpfs /dev/shm)"
        )
        yield CheckFinding("shared_memory", False, message)
    else:
        yield CheckFinding("shared_memory", True, f"{free / 1e6:.0f} MB free")


INSTALLATION_CHECKS: tuple[InstallationCheck, ...] = (
    InstallationCheck("program", check_program),
    InstallationCheck("packages", check_packages),
    InstallationCheck("px4", check_px4),
    InstallationCheck("ports", check_ports),
    InstallationCheck("realtime", check_realtime),
    InstallationCheck("disk", check_disk),
    InstallationCheck("clock", check_clock),
    InstallationCheck("shared_memory", check_shared_memory),
    InstallationCheck("health", lambda computer: check_computer()),
)


def check_installation(computer: Computer) -> list[CheckFinding]:
    """Run all checks of this installation and return their findings."""
    return [finding for check in INSTALLATION_CHECKS for finding in check.run(computer)]
