"""Installation and first commands in a 64-bit ARM Debian under an emulator; writes docs/results/arm64.md.

    python -m tools.arm64

As root, on x86-64 Debian with debootstrap and qemu-user-static, with the network; a quarter of an hour and
1 GB a release. A fresh minimal root gets a checkout and a user `pi`; `deploy/install.sh` runs whole in it;
then that user checks, flies in simulation, replays, moves the lock, and flies through MAVSDK. Natively, on
this machine, run an emulated Maestro, behind a pseudo-terminal that the root knows as the port of the
configuration, and the simulated vehicle at the other end of MAVSDK's link.

The root's programs run by the kernel's handler for foreign programs; Debian's own rule is registered while
this runs. Where none can be registered (or `--through proot`) they run by proot, which hands each to the
emulator.
"""

from __future__ import annotations

import argparse
import ast
import ctypes
import errno
import os
import re
import shlex
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import NamedTuple

from dart_flight.config.vehicle.configuration import load_vehicle
from tests.doubles.emulated_maestro import EmulatedMaestro
from tests.doubles.ports import free_udp_port
from tools.campaigns.results import RESULTS, ROOT, markdown

PAGE = RESULTS / "arm64.md"
USER = "pi"
PROCESSOR = "cortex-a72"  # of a Raspberry Pi 4: code for a newer one ends as an illegal instruction
HANDLERS = Path("/proc/sys/fs/binfmt_misc")
RULE = Path("/usr/lib/binfmt.d/qemu-aarch64.conf")
CHECKOUT = "home/pi/dart_flight"
INSTALL = f"/{CHECKOUT}/deploy/install.sh"
LAB = "/srv/dart-flight"
MISSION = "missions/single_wall.yaml"
RECORDED = "home/pi/x86-64.mcap"
COMMANDS = (
    "dart-flight --version",
    f"dart-flight check {MISSION}",
    f"dart-flight dry-run {MISSION} --fast",
    "dart-flight dry-run missions/dual_collision.yaml --fast",
    "dart-flight replay flights/*-single-wall/flight.mcap",
    f"dart-flight replay /{RECORDED}",
)
LOCK = ("status", "rigid", "toggle", "toggle", "status")
LINK = (f"check {MISSION}", f"fly {MISSION} --yes")
# The simulated vehicle without what it sends to a ground station.
VEHICLE = """
import sys
from dart_flight.config.mission import load_mission
from dart_flight.sim.standalone import VehiclePortLease, run_vehicle
port = int(sys.argv[2])
lease = VehiclePortLease(port)
run_vehicle(load_mission(sys.argv[1]), 1, (port,), lambda line: None, lease.own_port, lambda record: None)
"""
PACKAGES = """
from importlib.metadata import distributions
for d in sorted(distributions(), key=lambda d: d.name.lower()):
    tags = [t[5:] for t in (d.read_text("WHEEL") or "").splitlines() if t.startswith("Tag: ")]
    print(d.name, d.version, ",".join(tags))
"""
SYSTEM = """
echo "architecture: $(uname -m), $(dpkg --print-architecture)"
. /etc/os-release; echo "system: $PRETTY_NAME, $(cat /etc/debian_version)"
echo "C library: $(getconf GNU_LIBC_VERSION)"
echo "Python: $(python3 --version)"
echo "compilers: $(command -v cc gcc g++ c++ clang rustc cargo || echo none)"
echo "systemd: $(test -d /run/systemd/system && echo runs || echo 'does not run')"
"""
CANNOT_TELL = """
## What this cannot tell

- **Speed and timing.** The times are an emulator's, on another machine, beside other work; for a Pi's see
  [raspberry_pi.md](raspberry_pi.md). Whether a Pi keeps up, whether it throttles: nothing.
- **The serial ports.** A pseudo-terminal has no baud rate, loses no byte and belongs to no USB device: the
  header's port, the Maestro's USB, the udev rules' names and latency timer are untried. The port's group is
  set by hand.
- **systemd.** None runs in the root: the unit and the rules are put in their places and not loaded. What can
  be said of them without: [install.md](install.md).
- **The kernel and Pi OS.** The kernel is this machine's, the root plain Debian; no `config.txt`, no GPIO, no
  hardware PWM. The emulated Cortex-A72 has instructions for AES and SHA that a Pi 4's lacks.
- **The link.** MAVSDK's is UDP on the loopback, to our simulated vehicle. How late `fly` is, whether its new
  trajectory comes in time and whether the guard lets it fly at all says how busy the emulator was. The
  simulated vehicle's arms do not follow the Maestro's horn.
"""


class Done(NamedTuple):
    """A command that has run: as whom, what it ended with, its output, its wall time."""

    command: str
    user: str
    status: int
    output: str
    seconds: float
    note: str = ""


class Machine(NamedTuple):
    """An arm64 root, and what goes before a command that runs in it."""

    root: Path
    prefix: tuple[str, ...]
    environment: Mapping[str, str]

    def run(self, command: str, user: str = "root", folder: str = "/") -> Done:
        """Run a shell command in the root; its output is shown as it comes."""
        print(f"\n[{user}] {command if len(command) < 200 else command[:60].strip() + ' ...'}", flush=True)
        variables = [f"{key}={value}" for key, value in self.environment.items()]
        home = "/root" if user == "root" else f"/home/{user}"
        words = [*self.prefix, "/usr/bin/env", "-i", *variables, f"HOME={home}"]
        words += [] if user == "root" else ["/usr/sbin/runuser", "-u", user, "--"]
        words += ["/bin/sh", "-c", f"cd {folder} && {command}"]
        began, lines = time.monotonic(), []
        with subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=ROOT,
        ) as process:
            assert process.stdout is not None
            for line in process.stdout:
                print(line, end="", flush=True)
                lines.append(line)
        return Done(command, user, process.returncode, "".join(lines), time.monotonic() - began)


# -- how foreign programs run -----------------------------------------------------------------------------


@contextmanager
def handler() -> Iterator[str]:
    """The kernel hands aarch64 programs to the emulator meanwhile; yields why not, or nothing."""
    handled = HANDLERS / "qemu-aarch64"
    if handled.exists():
        yield ""
        return
    mounted = (
        not (HANDLERS / "register").exists()
        and not subprocess.run(
            ["mount", "-t", "binfmt_misc", "none", str(HANDLERS)], capture_output=True, check=False
        ).returncode
    )
    try:
        (HANDLERS / "register").write_text(RULE.read_text(encoding="utf-8"), encoding="utf-8")
        refused = ""
    except OSError as error:
        refused = str(error)
    try:
        yield refused
    finally:
        if handled.exists():
            handled.write_text("-1", encoding="utf-8")
        if mounted:
            subprocess.run(["umount", str(HANDLERS)], check=False)


def by_kernel(root: Path) -> tuple[str, ...]:
    """Into the root with mounts that end with the command."""
    mounts = 'mount --bind /dev/pts "$0/dev/pts" && mount -t proc proc "$0/proc" && exec chroot "$0" "$@"'
    return ("unshare", "--mount", "sh", "-c", mounts, str(root))


def by_proot(root: Path, emulator: str) -> tuple[str, ...]:
    """Into the root with every program's start translated; other users are pretended."""
    proot = ("proot", "-0", "-q", emulator, "-r", str(root), "-b", "/proc", "-b", "/dev/pts", "-w", "/")
    start = "import os, sys, tools.arm64 as a; a.refuse_new_calls(); os.execvp(sys.argv[1], sys.argv[1:])"
    return (sys.executable, "-c", start, *proot)


def refuse_new_calls() -> None:
    """This process and its children hear that the kernel lacks calls whose paths proot does not translate.

    Those are younger than proot; the C library then takes older ones. A seccomp filter in x86-64's numbers.
    """
    load, jump_if_equal, answer = 0x20, 0x15, 0x06  # load the call's number; skip ahead; end with an answer
    calls = (332, 437, 439, 452)  # statx, openat2, faccessat2, fchmodat2
    program = [(load, 0, 0, 0)]
    program += [(jump_if_equal, len(calls) - i, 0, call) for i, call in enumerate(calls)]
    program += [(answer, 0, 0, 0x7FFF_0000), (answer, 0, 0, 0x0005_0000 | errno.ENOSYS)]  # allow; an error
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *row) for row in program))
    described = struct.pack("@HP", len(program), ctypes.addressof(code))
    set_seccomp, mode_filter = 22, 2
    if ctypes.CDLL(None).prctl(set_seccomp, mode_filter, described, 0, 0):
        raise OSError("no filter for system calls")


# -- the root ---------------------------------------------------------------------------------------------


def bootstrap(release: str, root: Path, prefix: tuple[str, ...]) -> None:
    """A minimal Debian, without package lists, as a fresh image may be."""
    first = ["debootstrap", "--arch=arm64", "--variant=minbase", "--foreign", release, str(root)]
    subprocess.run(first, check=True)
    if (root / "proc").is_symlink():  # so in a container; a mount needs a folder
        (root / "proc").unlink()
    (root / "proc").mkdir(exist_ok=True)
    machine = Machine(root, prefix, {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin"})
    if machine.run("/debootstrap/debootstrap --second-stage").status:
        sys.exit(f"debootstrap's second stage failed: {root}/debootstrap/debootstrap.log")
    shutil.rmtree(root / "var/lib/apt/lists")


def copy_checkout(root: Path) -> None:
    """What git has, as it is now."""
    listed = subprocess.run(
        ["git", "-c", f"safe.directory={ROOT}", "ls-files", "-z"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            target = root / CHECKOUT / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target)


def pip_settings(listed: str) -> dict[str, str]:
    """`pip config list` as variables, those that say where packages are; without folders of this machine.

    What the environment says stands above the files.
    """
    kept = ("index-url", "extra-index-url", "trusted-host", "proxy", "default-timeout", "timeout", "cert")
    found: dict[str, str] = {}
    for line in sorted(listed.splitlines(), key=lambda line: line.startswith(":env:")):
        key, _, value = line.partition("=")
        name, words = key.rpartition(".")[2], str(ast.literal_eval(value)).split()
        words = [word for word in words if not word.startswith("file:")]
        if name in kept and words:
            found["PIP_" + name.upper().replace("-", "_")] = " ".join(words)
    return found


def environment(root: Path) -> dict[str, str]:
    """Variables of every command: this machine's way to Python's packages, and the processor."""
    listed = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True
    )
    settings = pip_settings(listed.stdout)
    if "PIP_CERT" in settings:
        shutil.copy(settings["PIP_CERT"], root / "etc/certificates-of-the-host.pem")
        settings["PIP_CERT"] = "/etc/certificates-of-the-host.pem"
    settings |= {key: value for key, value in os.environ.items() if key.lower().endswith("_proxy")}
    path = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
    return {**settings, "PATH": path, "LANG": "C.UTF-8", "QEMU_CPU": PROCESSOR, "SUDO_USER": USER}


# -- what runs in it --------------------------------------------------------------------------------------


def record(root: Path) -> None:
    """A flight, recorded on this machine, to replay in the root."""
    logs = root / "tmp/recorded"
    words = [sys.executable, "-m", "dart_flight", "dry-run", MISSION, "--fast", "--log-dir", str(logs)]
    subprocess.run(words, cwd=ROOT, check=True, capture_output=True)
    shutil.move(next(logs.glob("*/flight.mcap")), root / RECORDED)


@contextmanager
def maestro(root: Path) -> Iterator[EmulatedMaestro]:
    """The emulated Maestro, on the port of the configuration in the root, in that root's group `dialout`."""
    lock = load_vehicle(root / LAB.lstrip("/") / "configs/dart.yaml").lock
    assert lock is not None
    port = root / lock.maestro.port.lstrip("/")
    start = lock.servo.flexible_pulse_us
    groups = (root / "etc/group").read_text(encoding="utf-8")
    (dialout,) = re.findall(r"^dialout:[^:]*:(\d+):", groups, re.MULTILINE)
    with EmulatedMaestro(lock.servo, port, lambda: time.monotonic_ns() // 1000, horn_us=start) as controller:
        os.chown(port.readlink(), 0, int(dialout))  # as the udev rule gives it
        port.readlink().chmod(0o660)
        yield controller


def with_lock(machine: Machine) -> Iterator[Done]:
    """`LOCK`, then `LINK` to a simulated vehicle; each with where the horn of the emulated Maestro went."""
    port = free_udp_port()
    link = f"--driver maestro --connection udpin://127.0.0.1:{port}"
    commands = [f"dart-flight lock {verb} --driver maestro" for verb in LOCK]
    commands += [f"dart-flight {command} {link}" for command in LINK]
    with maestro(machine.root) as controller:
        vehicle = subprocess.Popen([sys.executable, "-c", VEHICLE, MISSION, str(port)], cwd=ROOT)
        try:
            for command in commands:
                before, heard = controller.horn_us(), len(controller.received)
                done = machine.run(command, USER, LAB)
                bytes_, after = len(controller.received) - heard, controller.horn_us()
                yield done._replace(note=f"{bytes_} bytes; horn from {before:.0f} to {after:.0f} µs")
        finally:
            vehicle.terminate()
            vehicle.wait()


def installed(listed: str) -> list[tuple[str, str, str]]:
    """Name, version and tags of each package in the output of `PACKAGES`."""
    return [
        (name, version, tags) for name, version, tags in (line.split(" ") for line in listed.splitlines())
    ]


def compiled(packages: list[tuple[str, str, str]]) -> list[str]:
    """Packages with code made on the machine: only those have a wheel for `linux` instead of `manylinux`."""
    return [name for name, _, tags in packages if re.search(r"-linux_", tags) or not tags]


def megabytes(folder: Path) -> int:
    """Size on the disk."""
    listed = subprocess.run(["du", "-sxm", str(folder)], capture_output=True, text=True, check=True)
    return int(listed.stdout.split()[0])


def section(release: str, root: Path, prefix: tuple[str, ...], outputs: bool) -> tuple[str, bool]:
    """Everything for one release: its part of the page, and whether all ended well."""
    bootstrap(release, root, prefix)
    bare = megabytes(root)
    machine = Machine(root, prefix, environment(root))
    copy_checkout(root)
    machine.run(f"useradd --create-home --shell /bin/bash {USER} && chown -R {USER}: /home/{USER}")
    done = [machine.run(INSTALL)]
    listed = machine.run(f"/opt/dart-flight/venv/bin/python -c {shlex.quote(PACKAGES)}")
    if done[0].status or listed.status:
        return f"\n## {release}\n\nThe installation failed:\n\n{quoted(done[0])}", False
    record(root)
    done += [machine.run(command, USER, LAB) for command in COMMANDS]
    done += [*with_lock(machine), machine.run(INSTALL)._replace(note="(again)")]
    packages = installed(listed.output)
    built = re.findall(r"Building wheel for (\S+)", done[0].output)
    facts = [line.split(": ", 1) for line in machine.run(SYSTEM).output.splitlines()]
    facts += [
        ["size", f"{bare} MB bare, {megabytes(root)} MB in the end"],
        ["compiled here", ", ".join(compiled(packages)) or "nothing"],
        ["wheels built here", ", ".join(dict.fromkeys(built)) or "none"],
        [
            "wheels with code",
            f"{sum('aarch64' in tags for _, _, tags in packages)} of {len(packages)}, for aarch64",
        ],
    ]
    rows = [(f"`{shown(d)}`", d.user, str(d.status), f"{d.seconds:.0f} s", d.note) for d in done]
    text = f"\n## {release}\n\n" + markdown(("", ""), facts) + "\n"
    text += markdown(("command", "as", "exit status", "wall time", "the Maestro"), rows)
    text += "\nVersions: " + ", ".join(f"{name} {version}" for name, version, _ in packages) + ".\n"
    text += "\nThe outputs" + (":\n" if outputs else " where something failed:\n")
    text += "".join(f"\n`{shown(d)}`\n\n{quoted(d)}" for d in done if outputs or d.status)
    # A flight in real time is the emulator's luck.
    failed = [d for d in done if d.status and not d.command.startswith("dart-flight fly")]
    return text, not failed and not compiled(packages)


def shown(done: Done) -> str:
    """A command as it would be typed in the checkout or the laboratory's folder."""
    command = done.command.replace(f"/{CHECKOUT}/", "")
    return re.sub(r"udpin://\S+", "udpin://127.0.0.1:PORT", command)


def quoted(done: Done, last: int = 10) -> str:
    """An output, fenced: the end of an installation; of checks over a link what is no `go`; no address."""
    lines = [re.sub(r"https?://\S+", "...", line).rstrip() for line in done.output.splitlines()]
    kept = lines[-last:] if done.command == INSTALL else lines
    if "--connection" in done.command:
        kept = [line for line in kept if not line.startswith("go   ")]
    return "```\n" + "\n".join(kept) + "\n```\n"


def main() -> int:
    """Every release asked for; 1 where something failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--release", nargs="+", default=["trixie", "bookworm"], help="of Debian")
    parser.add_argument(
        "--folder", type=Path, default=Path("/var/tmp/dart-flight-arm64"), help="for the roots"
    )
    parser.add_argument("--through", choices=("kernel", "proot"), help="by default the kernel where it can")
    parser.add_argument("--keep", action="store_true", help="do not remove the roots")
    options = parser.parse_args()
    emulator = shutil.which("qemu-aarch64-static") or shutil.which("qemu-aarch64")
    if os.geteuid() != 0 or emulator is None or shutil.which("debootstrap") is None:
        sys.exit("needs root, debootstrap and qemu-user-static")
    version = subprocess.run([emulator, "--version"], capture_output=True, text=True, check=True).stdout
    with handler() as refused:
        if options.through == "kernel" and refused:
            sys.exit(f"no handler for foreign programs: {refused}")
        proot = options.through == "proot" or bool(refused)
        if proot and shutil.which("proot") is None:
            sys.exit(f"no handler for foreign programs ({refused}); without one it needs proot")
        means = "proot" if proot else "the kernel's handler for foreign programs"
        print(f"programs run through {means} {refused}")
        parts: list[tuple[str, bool]] = []
        for release in options.release:
            root = options.folder / release
            shutil.rmtree(root, ignore_errors=True)
            root.mkdir(parents=True)
            prefix = by_proot(root, emulator) if proot else by_kernel(root)
            parts.append(section(release, root, prefix, outputs=not parts))
            if not options.keep:
                shutil.rmtree(root)
    head = (
        "# The installation on an emulated 64-bit ARM Debian\n\n"
        f"Measured on {date.today().isoformat()} by `python -m tools.arm64`, on x86-64 under QEMU's\n"
        f"user-mode emulation ({version.split()[2]}, processor {PROCESSOR}), through {means}.\n\n"
        "A fresh minimal Debian, a checkout, `deploy/install.sh` whole, as by `sudo` of a user `pi`;\n"
        f"then that user, in `{LAB}`, with the configuration and missions that the installation put\n"
        "there. Native, on the same machine: the emulated Maestro of `tests/doubles/emulated_maestro.py`,\n"
        "behind a pseudo-terminal, and the simulated vehicle that `check` and `fly` connect to. The second\n"
        "replay is of a flight recorded on x86-64.\n"
    )
    PAGE.write_text(head + "".join(text for text, _ in parts) + CANNOT_TELL, encoding="utf-8")
    print(f"\n{PAGE}")
    return 0 if all(well for _, well in parts) else 1


if __name__ == "__main__":
    sys.exit(main())
