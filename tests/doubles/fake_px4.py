"""A stand-in for PX4 on the simulator link: a TCP client that answers every HIL_SENSOR but cannot fly.

`install` writes it into a folder as bin/px4. Tests of the launch and the world process use it if there is no
PX4. `behaviour` selects its fault.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Iterable
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from dart_flight.config.mission import load_mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import packaged
from dart_flight.sim.px4.launch import flight_parameters
from tests.doubles.scripted_peer import Mavlink, ScriptedPeer, TcpLink

ROOT = Path(__file__).parents[2]


class FakePx4(ScriptedPeer):
    """The client's end of the simulator link; while the context is open, it answers every HIL_SENSOR.

    Args:
        port: TCP port of the simulator.

    Attributes:
        controls: actuator controls in every answer.
        armed: whether the answers report an armed vehicle.
    """

    def __init__(self, port: int) -> None:
        super().__init__(
            TcpLink(port), Mavlink(), {"HIL_SENSOR": lambda sensor: [self.outputs(sensor.time_usec)]}
        )
        self.controls: tuple[float, ...] = (0.0,) * 16
        self.armed = False

    def outputs(self, time_us: int) -> mavlink.MAVLink_message:
        """Return one HIL_ACTUATOR_CONTROLS."""
        return mavlink.MAVLink_hil_actuator_controls_message(
            time_us, list(self.controls), 128 if self.armed else 0, 1
        )


_CLIENT = """#!/bin/sh
store={folder}/parameters-$2
case "$3" in
set)
  case " {missing} " in *" $4 "*) echo "ERROR [param] Parameter $4 not found."; exit 0 ;; esac
  value=$5
  case " {stuck} " in *" $4 "*) value=0.0000 ;; esac
  echo "x * $4 [1,2] : $value" >> $store ;;
show)
  echo "Symbols: x = used, + = saved, * = unsaved"
  echo "x   SYS_AUTOSTART [1,2] : 10016"
  sed 's/^/    /; s/$/ [1,2] : 0.0000/' {folder}/known
  test ! -e $store || cat $store
  test ! -e {folder}/booted || cat {folder}/after_boot ;;
esac
"""


def install(
    folder: Path,
    behaviour: str = "fly",
    version: str = "Release 1.16.0",
    *,
    known: Iterable[str] = (),
    missing: str = "",
    stuck: str = "",
    overwritten: str = "",
) -> Path:
    """Write a PX4 installation whose program is this file, and return its folder.

    Args:
        folder: folder of the installation.
        behaviour: `fly`, or the fault: `ends`, `stubborn`, `deaf` or `dies`.
        version: version that the program reports.
        known: additional parameters; those of an indoor flight always exist.
        missing: names of parameters that do not exist, separated by spaces.
        stuck: names of parameters that stay 0 when set.
        overwritten: parameter that the start-up script sets to 77.
    """
    (folder / "bin").mkdir(parents=True)
    airframes = folder / "etc" / "init.d-posix" / "airframes"
    airframes.mkdir(parents=True)
    (airframes / "10016_none_iris").touch()
    (airframes.parent / "rcS").touch()
    program = folder / "bin" / "px4"
    program.write_text(
        f"#!/bin/sh\nexport PYTHONPATH={ROOT}\n"
        f'exec {sys.executable} -m tests.doubles.fake_px4 {behaviour} "$@"\n'
    )
    program.chmod(0o755)
    reporter = folder / "bin" / "px4-ver"
    reporter.write_text(f"#!/bin/sh\necho 'HW arch: PX4_SITL'\necho 'PX4 version: {version} (17825792)'\n")
    reporter.chmod(0o755)
    vehicle = load_mission(packaged("missions", "paper_dual_collision.yaml")).vehicle
    names = {*known, *flight_parameters(vehicle, PositionSource.MOCAP)} - set(missing.split())
    (folder / "known").write_text("".join(f"{name}\n" for name in sorted(names)))
    (folder / "after_boot").write_text(f"x * {overwritten} [1,2] : 77\n" if overwritten else "")
    client = folder / "bin" / "px4-param"
    client.write_text(_CLIENT.format(folder=folder, missing=missing, stuck=stuck))
    client.chmod(0o755)
    return folder


def _connect(port: int) -> FakePx4:
    """Retry until the simulator listens, as PX4 does."""
    while True:
        try:
            return FakePx4(port)
        except ConnectionRefusedError:
            time.sleep(0.01)


def main() -> None:
    """Run the program: px4 -i INSTANCE -d ETC."""
    behaviour, instance = sys.argv[1], int(sys.argv[3])
    # A test reads from this file how the program was started.
    about = {"arguments": sys.argv[2:], "cwd": os.getcwd(), "environment": dict(os.environ)}
    Path("started.json").write_text(json.dumps(about))
    if behaviour == "ends":
        print("ERROR [init] something is wrong")
        sys.exit(3)
    if behaviour == "stubborn":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    print("INFO  [simulator_mavlink] Waiting for simulator to accept connection on TCP port", flush=True)
    if behaviour == "deaf":
        time.sleep(60.0)
    fake = _connect(4560 + instance)
    (Path(sys.argv[5]).parent / "booted").touch()
    print("INFO  [px4] Startup script returned successfully", flush=True)
    Path("log/today").mkdir(parents=True)
    Path("log/today/flight.ulg").write_bytes(b"ULog of a fake")
    with fake:
        if behaviour == "dies":
            fake.wait_for(lambda: len(fake.received) >= 4000, 60.0, "4000 sensor messages")
            os.kill(os.getpid(), signal.SIGKILL)
        fake.ended.wait()


if __name__ == "__main__":
    main()
