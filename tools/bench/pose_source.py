"""An emulated OptiTrack system in real time, for `tools.bench.poses`; a separate process.

    python -m tools.bench.pose_source HZ

The source prints its URL, then sends the resting vehicle of `tools.bench.impact_source` as a tracked body HZ
times a second until it is killed.
"""

from __future__ import annotations

import sys
import time

from dart_flight.base.geometry import IDENTITY
from dart_flight.config.mission import load_mission
from dart_flight.sim.motion_capture import BODY, make_server
from tools.bench.impact_source import MISSION, POSITION_NED


def main(rate_hz: float) -> None:
    """Send frames at an even rate."""
    room = load_mission(MISSION).vehicle.mocap.room_frame()
    position, attitude = room.pose_from_ned(POSITION_NED, IDENTITY)
    server = make_server("optitrack", BODY)
    print(server.url, flush=True)
    due = time.monotonic()
    while True:
        server.publish(time.monotonic_ns() // 1000, position, attitude)
        due += 1.0 / rate_hz
        time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main(float(sys.argv[1]))
