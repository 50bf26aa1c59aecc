"""The process of a simulated vehicle; its first line of input, from `dry-run`, says which world to fly."""

from __future__ import annotations

import os
import signal
import sys

import msgspec

from dart_flight.sim.embedded_simulator import EmbeddedSimulator
from dart_flight.sim.pipe import SimulatorSpec


def main() -> int:
    """Body of the process; returns its exit status."""
    # The app's terminal must not take the vehicle down: Ctrl-C is the app's business.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    spec = msgspec.json.decode(sys.stdin.buffer.readline(), type=SimulatorSpec)
    if spec.px4 is not None:
        from dart_flight.sim.px4.px4_simulator import Px4Simulator  # noqa: PLC0415  (only where PX4 flies)

        return Px4Simulator(spec, spec.px4).run(sys.stdin.buffer, sys.stdout.buffer)
    if spec.hitl is not None:
        from dart_flight.sim.px4.hitl_simulator import HitlSimulator  # noqa: PLC0415  (needs a serial port)

        return HitlSimulator(spec, spec.hitl).run(sys.stdin.buffer, sys.stdout.buffer)
    EmbeddedSimulator(spec).run(sys.stdin.buffer, sys.stdout.buffer)
    return 0


if __name__ == "__main__":
    # Not sys.exit: the interpreter aborts where a thread still waits in stdin for the app's next line.
    os._exit(main())
