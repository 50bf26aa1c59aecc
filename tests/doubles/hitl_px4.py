"""A real PX4 without lockstep as a flight controller in hardware-in-the-loop mode, on two serial cables.

The modules of PX4's POSIX build `px4_sitl_nolockstep` support SYS_HITL, but its start-up script does not.
This double changes the lines of the script that differ in a board's script under SYS_HITL 1.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from dart_flight.check.hitl_check import hitl_parameters
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource, Value
from dart_flight.sim.px4.installation import find_install
from dart_flight.sim.px4.launch import claim_instance, environment, flight_parameters, values_of
from tests.doubles.serial_cable import SerialCable

ENVIRONMENT = "DART_PX4_HITL_DIR"  # a build without lockstep
TELEM2_BYTES_S = 92_160.0  # 921600 baud with a start and a stop bit
_BOOT_S = 40.0


class HitlPx4:
    """`with HitlPx4(directory, folder, mission) as px4: dry-run --hitl px4.usb_url --connection px4.url`.

    Args:
        directory: folder of the build without lockstep.
        folder: empty working folder.
        mission: mission with the vehicle whose parameters are set.
        changes: other values of parameters; None keeps PX4's default.
        hil: whether PX4 was restarted after SYS_HITL was set.

    Attributes:
        usb, telem2: the two cables; the program uses their second ends.
    """

    def __init__(
        self,
        directory: str | Path,
        folder: Path,
        mission: Mission,
        changes: Mapping[str, Value | None] | None = None,
        *,
        hil: bool = True,
    ) -> None:
        self._install, self._folder = find_install(directory), folder
        self._changes, self._hil = dict(changes or {}), hil
        self._parameters = {
            **values_of(flight_parameters(mission.vehicle, PositionSource.MOCAP)),
            **{name: one.value for name, one in hitl_parameters().items()},
        }
        self.usb, self.telem2 = SerialCable(), SerialCable(TELEM2_BYTES_S)
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def usb_url(self) -> str:
        """The URL for `--hitl`."""
        return f"serial://{self.usb.ends[1]}:921600"

    @property
    def url(self) -> str:
        """The URL for `--connection`."""
        return f"serial://{self.telem2.ends[1]}:921600"

    def __enter__(self) -> HitlPx4:
        self._instance = claim_instance()
        self.usb.__enter__()
        self.telem2.__enter__()
        script = self._folder / "rcS.hitl"
        script.write_text(self._script())
        log = self._folder / "px4.log"
        number = str(self._instance.number)
        with log.open("wb") as out:
            self._process = subprocess.Popen(
                [str(self._install.program), "-i", number, "-d", "-s", str(script), str(self._install.etc)],
                cwd=self._folder,
                env=environment(),
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        end_s = time.monotonic() + _BOOT_S
        while b"Startup script returned" not in log.read_bytes():
            if self._process.poll() is not None or time.monotonic() > end_s:
                raise RuntimeError(f"PX4 did not boot: {log.read_text(errors='replace')[-2000:]}")
            time.sleep(0.1)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGTERM)
            try:
                self._process.wait(3.0)
            except subprocess.TimeoutExpired:
                os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
        self.telem2.__exit__(kind, error, trace)
        self.usb.__exit__(kind, error, trace)
        self._instance.release()

    def is_armed(self) -> bool:
        """Return whether PX4 reports itself armed."""
        command = [str(self._install.program.with_name("px4-commander")), "--instance"]
        command += [str(self._instance.number), "status"]
        output = subprocess.run(command, capture_output=True, text=True, timeout=10.0, check=False).stdout
        found = re.search(r"\b(Armed|Disarmed)\b", output)
        if found is None:
            raise RuntimeError(f"unexpected status of the commander: {output!r}")
        return found[1] == "Armed"

    def _script(self) -> str:
        text = (self._install.etc / "init.d-posix" / "rcS").read_text()

        def replace(old: str, new: str) -> None:
            nonlocal text
            if text.count(old) != 1:
                raise RuntimeError(f"the start-up script has {old!r} {text.count(old)} times, expected once")
            text = text.replace(old, new)

        wanted = {**self._parameters, **self._changes}
        lines = [f"param set {n} {_text(v)}" for n, v in wanted.items() if v is not None]
        replace("\t. px4-rc.simulator\n", "\techo no simulator\n")
        replace("dataman start\n", "\n".join([*lines, "dataman start", ""]))
        if self._hil:
            replace("\nsensors start\n", "\nsensors start -h\n")
            replace("\ncommander start\n", "\ncommander start -h\n")
            replace("pwm_out_sim start -m sim", "pwm_out_sim start -m hil")
        # A board starts the USB port in mode config, and TELEM2 as in docs/field.md.
        replace(
            ". px4-rc.mavlink\n",
            f"mavlink start -d {self.usb.ends[0]} -b 2000000 -m config -x -Z\n"
            f"mavlink start -d {self.telem2.ends[0]} -b 921600 -m onboard -r 80000 -x -Z\n",
        )
        text = text.replace("system_power_simulator start\n", "")
        return re.sub(r"if param greater SIM_BAT_DRAIN 0.*?fi\n", "", text, count=1, flags=re.DOTALL)


def _text(value: Value) -> str:
    return str(value) if isinstance(value, int) else format(value, ".9g")
