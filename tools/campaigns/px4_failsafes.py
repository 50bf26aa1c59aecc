"""Campaign: PX4's failsafes, terminations and estimator resets in flight, and the guard's reactions.

Each disturbance (docs/results/px4_failsafes.md) begins when the mission reaches a phase, through a second
MAVLink link.
"""

from __future__ import annotations

import math
import re
import socket
import struct
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from pymavlink.dialects.v20 import common as mavlink

from dart_flight.base.geometry import yaw_ned_of
from dart_flight.base.records import (
    AttitudeSample,
    GuardEvent,
    OdometrySample,
    Outcome,
    Phase,
    PhaseChange,
    Record,
    TruthContact,
    TruthSample,
)
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import packaged
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.recording.uncontrolled import TruthExtremes, find_uncontrolled
from dart_flight.run.prepare import load_flyable
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.px4.bridge import geodetic
from tools.campaigns.px4 import parameter_files
from tools.campaigns.results import grouped, markdown

PHASES = {Phase.TRANSIT: 0.3, Phase.APPROACH: 0.2, Phase.RECOVERY: 0.1}  # delay of the disturbance, s
_PORT = 18570  # ground-station port of PX4's first instance
_INSTANCE = re.compile(r"PX4 instance (\d+)")
_JUMP_M = 1.0
_HIT_N = 5.0  # true peak from which a contact counts as a hit
_TRIES = 4  # on a busy computer a flight may end before the disturbance begins


class SecondLink:
    """A second link to PX4, with the vehicle's pose for disturbances."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._pack = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self.yaw_rad, self.position_ned = 0.0, (0.0, 0.0, 0.0)
        self.sticks_lost = threading.Event()
        self.instance: int | None = None

    def find_instance(self, folder: Path) -> None:
        """Read PX4's instance number from the log of its world."""
        for log in folder.glob("*/autopilot.log"):
            found = _INSTANCE.search(log.read_text())
            self.instance = int(found[1]) if found else None

    def send(self, message: Any) -> None:
        """Send one message if the instance is known; the system ID follows the instance."""
        if self.instance is not None:
            message.target_system = self.instance + 1
            self._socket.sendto(message.pack(self._pack), ("127.0.0.1", _PORT + self.instance))

    def command(self, number: int, **parameters: float) -> None:
        """Send COMMAND_LONG; missing parameters are NaN."""
        values = [parameters.get(f"p{i}", math.nan) for i in range(1, 8)]
        self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *values))

    def set_parameters(self, **parameters: float) -> None:
        """Set PX4 parameters; an int is an INT32."""
        for name, value in parameters.items():
            kind, sent = mavlink.MAV_PARAM_TYPE_REAL32, float(value)
            if isinstance(value, int):
                kind, (sent,) = mavlink.MAV_PARAM_TYPE_INT32, struct.unpack("<f", struct.pack("<i", value))
            self.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), sent, kind))

    def hold_sticks(self) -> None:
        """Send centred sticks until `sticks_lost` is set."""
        while not self.sticks_lost.wait(0.05):
            self.send(mavlink.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0))

    def send_heading(self, degrees: float) -> None:
        """Send PX4 an external heading with this error, degrees."""
        self.command(620, p3=math.degrees(self.yaw_rad) + degrees, p7=0.5)

    def send_position(self) -> None:
        """Send PX4 an external position one metre north of the vehicle's own."""
        north, east, down = self.position_ned
        place = [round(degrees * 1e7) for degrees in geodetic((north + _JUMP_M, east, down))]
        values = (math.nan, 0.0, 0.05, math.nan, *place, math.nan)
        self.send(mavlink.MAVLink_command_int_message(1, 1, 0, 43003, 0, 0, *values))


class Disturbance(NamedTuple):
    """One disturbance; `stops_motors`: whether PX4 stops the motors; `off_m`: allowed position error, m."""

    begin: Callable[[SecondLink], None]
    position_from: PositionSource = PositionSource.MOCAP
    parameters: str = ""  # PX4 parameters set before the start
    stops_motors: bool = False
    off_m: float = 0.0


_MOTORS_OFF = (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_CMD_DO_FLIGHTTERMINATION)
DISTURBANCES = {
    "low battery": Disturbance(
        lambda s: s.set_parameters(COM_LOW_BAT_ACT=2, BAT_CRIT_THR=1.5, BAT_LOW_THR=1.6)
    ),
    "RC loss": Disturbance(lambda s: s.sticks_lost.set(), parameters="COM_RC_IN_MODE\t1\t6"),
    "geofence": Disturbance(lambda s: s.set_parameters(GF_ACTION=5, GF_MAX_VER_DIST=0.3), PositionSource.RTK),
    "termination": Disturbance(lambda s: s.command(_MOTORS_OFF[1], p1=1.0), stops_motors=True),
    "kill": Disturbance(lambda s: s.command(_MOTORS_OFF[0], p1=0.0, p2=21196.0), stops_motors=True),
    "heading reset 30 deg": Disturbance(lambda s: s.send_heading(30.0)),
    "heading reset 90 deg": Disturbance(lambda s: s.send_heading(90.0)),
    "position reset 1 m": Disturbance(SecondLink.send_position, PositionSource.RTK, off_m=_JUMP_M),
    "motion capture off": Disturbance(lambda s: s.set_parameters(EKF2_EV_CTRL=0)),
}


class Disturbed(msgspec.Struct, frozen=True):
    """One disturbed flight: the guard's rules with their times and details, and the true outcome.

    Times are seconds since the disturbance; None: before it. `hits` are the speed and the peak force of the
    true contacts after the guard's first rule, from `_HIT_N` on.
    """

    rules: list[tuple[str, float | None, str]]
    outcome: str
    tilt_deg: float
    outside_m: float
    down_m_s: float | None
    problems: list[str]
    hits: list[tuple[float, float]] = []


def cases() -> list[dict[str, str]]:
    """Return the cases: every disturbance in every phase."""
    return [{"disturbance": name, "phase": phase.value} for name in DISTURBANCES for phase in PHASES]


def fly(point: Point, seed: int) -> Disturbed:
    """Fly up to four times, until the disturbance begins before the first rule fires."""
    for _ in range(_TRIES):
        flown = _fly_once(point.case, seed)
        if all(after_s is not None for _, after_s, _ in flown.rules):
            return flown
    return flown


def _fly_once(case: Mapping[str, str], seed: int) -> Disturbed:
    disturbance, link, phase = DISTURBANCES[case["disturbance"]], SecondLink(), Phase(case["phase"])
    gps = disturbance.position_from is not PositionSource.MOCAP
    name = case.get("mission", "paper_single_wall" if gps else "paper_dual_collision")
    mission = load_flyable(packaged("missions", f"{name}.yaml"))
    hits: list[tuple[float, float]] = []
    truth, begun_us = TruthExtremes(mission.bounds), [0]
    rules: list[tuple[str, float | None, str]] = []

    def observe(record: Record) -> None:
        if isinstance(record, TruthSample):
            truth.update(record)
        if link.instance is None:
            link.find_instance(Path(folder))
        if isinstance(record, AttitudeSample):
            link.yaw_rad = yaw_ned_of(record.q_frd_to_ned)
        elif isinstance(record, OdometrySample):
            link.position_ned = record.position_ned
        elif isinstance(record, PhaseChange) and record.after is phase and not begun_us[0]:
            begun_us[0] = record.t_us + round(PHASES[phase] * 1e6)
            threading.Timer(PHASES[phase], disturbance.begin, (link,)).start()
        elif isinstance(record, GuardEvent):
            after_s = (record.t_us - begun_us[0]) * 1e-6 if begun_us[0] else None
            rules.append((record.rule, after_s, record.detail))
        elif isinstance(record, TruthContact) and rules and record.peak_normal_force_n >= _HIT_N:
            hits.append((-record.normal_in_m_s, record.peak_normal_force_n))

    with tempfile.TemporaryDirectory() as folder:
        changed = disturbance.parameters and f"1\t1\t{disturbance.parameters}"
        if disturbance.parameters:
            threading.Thread(target=link.hold_sticks, daemon=True).start()
        source, files = disturbance.position_from, parameter_files(Path(folder), changed)
        flown = fly_px4(
            mission, None, seed, Path(folder), position_from=source, parameter_files=files, viewer=observe
        )
    link.sticks_lost.set()
    completed = flown.outcome is Outcome.COMPLETED
    problems = list(
        find_uncontrolled(truth, completed, bool(rules), 0.5 + disturbance.off_m, disturbance.stops_motors)
    )
    down_m_s = None if disturbance.stops_motors else truth.landing_m_s
    tilt_deg = math.degrees(truth.tilt_rad)
    return Disturbed(rules, flown.outcome.value, tilt_deg, truth.excursion_m, down_m_s, problems, hits)


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a row for every disturbance, with the time of each rule in each phase."""
    heads = ("disturbance", "guard rules, s after it", "tilt °", "landing m/s",
             "uncontrolled")  # fmt: skip
    return markdown(heads, [[*key, *_cells(mine)] for key, mine in grouped(rows, "disturbance").items()])


def _cells(mine: Sequence[Disturbed]) -> list[str]:
    times: dict[str, list[str]] = {}
    for flown in mine:
        for rule, after_s, _ in flown.rules:
            times.setdefault(rule, []).append("before" if after_s is None else f"{after_s:.2f}")
    landings_m_s = [flown.down_m_s for flown in mine if flown.down_m_s is not None]
    return [
        "<br>".join(f"`{rule}` {', '.join(seconds)}" for rule, seconds in times.items()) or "none",
        f"{max(flown.tilt_deg for flown in mine):.0f}",
        f"{max(landings_m_s):.2f}" if landings_m_s else "-",
        "; ".join(problem for flown in mine for problem in flown.problems) or "no",
    ]
