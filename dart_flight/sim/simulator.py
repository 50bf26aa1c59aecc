"""The process of a simulated vehicle; its first input line, from `dry-run`, selects the world."""

from __future__ import annotations

import os
import signal
import sys

import msgspec

from dart_flight.sim.embedded_simulator import EmbeddedSimulator
from dart_flight.sim.pipe import SimulatorSpec


def main() -> int:
    # Ctrl-C in the app's terminal must not end the vehicle: the app handles it.
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
    # With sys.exit the interpreter would abort while a thread waits for the next line of stdin.
    os._exit(main())
