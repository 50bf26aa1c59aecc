"""A UDP proxy between vehicle and app that loses, delays, reorders, duplicates and records datagrams.

    python -m tools.lossy_proxy --listen 14540 --to 14541 --loss 5 --delay-ms 20 --record build/wire.csv

The vehicle sends to `--listen`. The app listens on `--to` (`fly --connection udpin://127.0.0.1:14541`), and
its answers return through the proxy. `--record` writes one line per forwarded datagram: monotonic time in
seconds, `down` (to the app) or `up` (to the vehicle), and MAVLink message id. The proxy ends on SIGTERM or
SIGINT.
"""

from __future__ import annotations

import argparse
import random
import select
import signal
import socket
import sys
import time
from pathlib import Path
from typing import IO

from dart_flight.sim.faults.impairment import Impairment, LossyLink

_WAIT_S = 0.001  # timing resolution of delayed datagrams


def message_id(datagram: bytes) -> int:
    """Return the id of the first MAVLink message in a datagram (either version), or -1."""
    if len(datagram) >= 10 and datagram[0] == 0xFD:
        return int.from_bytes(datagram[7:10], "little")
    if len(datagram) >= 6 and datagram[0] == 0xFE:
        return datagram[5]
    return -1


class Proxy:
    """The two sockets and the impaired links between them."""

    def __init__(
        self, listen: int, to: int, impairment: Impairment, seed: int, record: IO[str] | None
    ) -> None:
        self._vehicle_side = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        # Share the port, because a starting `simulate` briefly listens on it.
        self._vehicle_side.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._vehicle_side.bind(("127.0.0.1", listen))
        self._app_side = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._app_side.bind(("127.0.0.1", 0))
        self._app = ("127.0.0.1", to)
        self._vehicle: tuple[str, int] | None = None
        self._down: LossyLink[bytes] = LossyLink(seed)
        self._up: LossyLink[bytes] = LossyLink(seed + 1)
        self._down.impairment = self._up.impairment = impairment
        self._record = record
        self.stopped = False

    def run(self) -> None:
        """Forward until `stopped`."""
        sockets = [self._vehicle_side, self._app_side]
        while not self.stopped:
            readable, _, _ = select.select(sockets, [], [], _WAIT_S)
            for side in readable:
                self._receive(side)
            self._send()

    def _receive(self, side: socket.socket) -> None:
        try:
            data, sender = side.recvfrom(4096)
        except OSError:  # nobody listened when an earlier datagram was sent
            return
        now = time.monotonic()
        if side is self._vehicle_side:
            self._vehicle = sender
            self._down.push(now, data)
        else:
            self._up.push(now, data)

    def _send(self) -> None:
        now = time.monotonic()
        for data in self._down.pop(now):
            self._forward(self._app_side, data, self._app, "down", now)
        for data in self._up.pop(now):
            if self._vehicle is not None:
                self._forward(self._vehicle_side, data, self._vehicle, "up", now)

    def _forward(
        self, side: socket.socket, data: bytes, to: tuple[str, int], direction: str, now: float
    ) -> None:
        try:
            side.sendto(data, to)
        except OSError:
            return
        if self._record is not None:
            self._record.write(f"{now:.4f},{direction},{message_id(data)}\n")


def main() -> int:
    """Run the proxy from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--listen", type=int, default=14540)
    parser.add_argument("--to", type=int, default=14541)
    parser.add_argument("--loss", type=float, default=0.0, help="per cent")
    parser.add_argument("--delay-ms", type=float, default=0.0)
    parser.add_argument("--reorder", type=float, default=0.0, help="per cent")
    parser.add_argument("--duplicate", type=float, default=0.0, help="per cent")
    parser.add_argument("--seed", type=int, default=random.randrange(2**31))
    parser.add_argument("--record", type=Path)
    options = parser.parse_args()
    impairment = Impairment(
        loss=0.01 * options.loss,
        delay_s=1e-3 * options.delay_ms,
        reorder=0.01 * options.reorder,
        duplicate=0.01 * options.duplicate,
    )
    record = open(options.record, "w", buffering=1) if options.record else None  # noqa: SIM115
    proxy = Proxy(options.listen, options.to, impairment, options.seed, record)

    def stop(_number: int, _frame: object) -> None:
        proxy.stopped = True

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    proxy.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
