"""A stand-in for PX4 on the simulator link: a TCP client that answers every HIL_SENSOR but cannot fly.

`px4_install` writes it into a folder as bin/px4. Tests of the launch and the world process use it if there is
no PX4. `behaviour` selects its fault.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from tests.doubles.scripted_peer import Mavlink, ScriptedPeer, TcpLink


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
            fake.wait_for(lambda: len(fake.received) >= 3000, 60.0, "twelve seconds of sensor messages")
            os.kill(os.getpid(), signal.SIGKILL)
        fake.ended.wait()


if __name__ == "__main__":
    main()
