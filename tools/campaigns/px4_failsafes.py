"""PX4's own failsafes, terminations and estimator resets in flight: what the guard makes of each.

    DART_PX4_DIR=... python -m tools.campaigns.px4_failsafes [--only NAME] [--phase PHASE]

Each begins when the mission reaches a phase, by a second MAVLink link: PX4's parameters, sticks that fall
silent, commands. A row is uncontrolled by the judgement of `tools.campaigns.faults`.
"""

from __future__ import annotations

import argparse
import math
import socket
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from dart_flight.base.geometry import yaw_ned_of
from dart_flight.base.records import AttitudeSample, GuardEvent, OdometrySample, Phase, PhaseChange, Record
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import packaged
from dart_flight.run.prepare import load_flyable
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.px4.bridge import geodetic
from tools.campaigns.faults import Watch, judge_truth
from tools.campaigns.results import RESULTS, measured_by

PHASES = (Phase.TRANSIT, Phase.APPROACH, Phase.RECOVERY)
_AFTER_S = {Phase.TRANSIT: 0.3, Phase.APPROACH: 0.2, Phase.RECOVERY: 0.1}
_PORT = 18570  # PX4's link to a ground station, first instance
_FORCED = 21196.0
_STICKS_S = 0.05
_JUMP_M = 1.0


class Second:
    """A second link to PX4, and what of the vehicle is needed to disturb it."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._pack = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self.yaw_rad, self.position_ned = 0.0, (0.0, 0.0, 0.0)
        self.sticks_lost = threading.Event()

    def send(self, message: Any) -> None:
        """Send one message to PX4."""
        self._socket.sendto(message.pack(self._pack), ("127.0.0.1", _PORT))

    def command(self, number: int, **parameters: float) -> None:
        """Send COMMAND_LONG; parameters that are not given are NaN."""
        values = [parameters.get(f"p{i}", math.nan) for i in range(1, 8)]
        self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *values))

    def set(self, **parameters: float) -> None:
        """Set PX4 parameters; an int is an INT32."""
        for name, value in parameters.items():
            kind, sent = mavlink.MAV_PARAM_TYPE_REAL32, float(value)
            if isinstance(value, int):
                kind, (sent,) = mavlink.MAV_PARAM_TYPE_INT32, struct.unpack("<f", struct.pack("<i", value))
            self.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), sent, kind))

    def hold_sticks(self) -> None:
        """Send centred sticks until they are lost."""
        while not self.sticks_lost.wait(_STICKS_S):
            self.send(mavlink.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0))


def _turn(degrees: float) -> Callable[[Second], None]:
    return lambda s: s.command(620, p3=math.degrees(s.yaw_rad) + degrees, p7=0.5)


def _move(s: Second) -> None:
    north, east, down = s.position_ned
    latitude, longitude = geodetic((north + _JUMP_M, east, down))
    places = (round(latitude * 1e7), round(longitude * 1e7), math.nan)
    values = (math.nan, 0.0, 0.05, math.nan)
    s.send(mavlink.MAVLink_command_int_message(1, 1, 0, 43003, 0, 0, *values, *places))


class Row(NamedTuple):
    """One disturbance.

    Attributes:
        begin: brings it about.
        position_from: what PX4 flies by.
        parameters: of PX4 from the start on.
        falls: the vehicle is meant to fall.
        off_m: how far off the position may be.
    """

    begin: Callable[[Second], None]
    position_from: PositionSource = PositionSource.MOCAP
    parameters: str = ""
    falls: bool = False
    off_m: float = 0.0


_KILL = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
ROWS = {
    "low battery": Row(lambda s: s.set(COM_LOW_BAT_ACT=2, BAT_CRIT_THR=1.5, BAT_LOW_THR=1.6)),
    "RC loss": Row(lambda s: s.sticks_lost.set(), parameters="COM_RC_IN_MODE\t1\t6"),
    "geofence": Row(lambda s: s.set(GF_ACTION=5, GF_MAX_VER_DIST=0.3), PositionSource.RTK),
    "termination": Row(lambda s: s.command(mavlink.MAV_CMD_DO_FLIGHTTERMINATION, p1=1.0), falls=True),
    "kill": Row(lambda s: s.command(_KILL, p1=0.0, p2=_FORCED), falls=True),
    "motion capture off": Row(lambda s: s.set(EKF2_EV_CTRL=0)),
    "heading reset 30 deg": Row(_turn(30.0)),
    "heading reset 90 deg": Row(_turn(90.0)),
    "position reset 1 m": Row(_move, PositionSource.RTK, off_m=_JUMP_M),
}


def fly(name: str, phase: Phase, seed: int = 1) -> list[str]:
    """Fly one disturbance in one phase; returns the cells of its row."""
    row, second = ROWS[name], Second()
    gps = row.position_from is not PositionSource.MOCAP
    mission = load_flyable(packaged("missions", f"paper_{'single_wall' if gps else 'dual_collision'}.yaml"))
    watch, said, begun = Watch(mission), [], []

    def begin() -> None:
        time.sleep(_AFTER_S[phase])
        begun.append(time.monotonic())
        row.begin(second)

    def see(record: Record) -> None:
        watch.take(record)
        if isinstance(record, AttitudeSample):
            second.yaw_rad = yaw_ned_of(record.q_frd_to_ned)
        elif isinstance(record, OdometrySample):
            second.position_ned = record.position_ned
        elif isinstance(record, PhaseChange) and record.after is phase and not begun:
            threading.Thread(target=begin, daemon=True).start()
        elif isinstance(record, GuardEvent):
            late_s = f"{time.monotonic() - begun[0]:.2f} s" if begun else "before"
            said.append(f"`{record.rule}` ({late_s}): {record.detail}")

    with tempfile.TemporaryDirectory() as folder:
        files: tuple[Path, ...] = ()
        if row.parameters:
            files = (Path(folder) / "row.params",)
            files[0].write_text(f"1\t1\t{row.parameters}\n")
            threading.Thread(target=second.hold_sticks, daemon=True).start()
        verdict = fly_px4(
            mission,
            None,
            seed,
            Path(folder),
            position_from=row.position_from,
            parameter_files=files,
            viewer=see,
        )
        second.sticks_lost.set()
    problems = list(judge_truth(watch, verdict.outcome, "said" if said else "", 0.5 + row.off_m, row.falls))
    figures = f"{math.degrees(watch.tilt):.0f}", f"{watch.excursion:.2f}", f"{watch.landing:.2f}"
    end = "**" + "; ".join(problems) + "**" if problems else "controlled"
    return [name, phase.value, verdict.outcome, "<br>".join(said) or "-", *figures, end]


def report(rows: list[list[str]], version: str) -> str:
    """The page."""
    head = [
        "disturbance",
        "phase",
        "outcome",
        "rules, seconds after it, words",
        "tilt deg",
        "outside m",
        "down m/s",
        "",
    ]
    table = ["| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows)]
    return "\n".join(
        [
            "# PX4's failsafes in flight",
            "",
            measured_by("tools.campaigns.px4_failsafes"),
            "",
            f"PX4 {version} SITL, seed 1. Geofence and position reset: RTK, single wall; others:",
            "motion capture, dual collision. Tilt, distance outside of the bounds, speed at the ground are",
            "true. A terminated or killed vehicle falls.",
            "",
            *table,
            "",
        ]
    )


def main() -> int:
    """Run it from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=ROWS, action="append")
    parser.add_argument("--phase", choices=[p.value for p in PHASES], action="append")
    parser.add_argument("--report-dir", type=Path, default=RESULTS)
    parser.add_argument("--version", default="v1.18", help="as the page calls it")
    a = parser.parse_args()
    rows = []
    for name in a.only or ROWS:
        for phase in PHASES:
            if not a.phase or phase.value in a.phase:
                rows.append(fly(name, phase))
                print(" | ".join(rows[-1]), flush=True)
    if not (a.only or a.phase):
        (a.report_dir / "px4_failsafes.md").write_text(report(rows, a.version))
    return 0


if __name__ == "__main__":
    sys.exit(main())
