"""How hard may a wall be hit, and what ends it? Single hits along planned trajectories.

    python -m tools.campaigns.faster_hits              # 700 flights, about 15 minutes of one core
    python -m tools.campaigns.faster_hits --seeds 5    # of each cell of the envelope, instead of 2
    python -m tools.campaigns.faster_hits --px4 DIR    # some on a real PX4, one at a time, in real time

A flight goes from rest into a wall at a velocity that is asked for, comes off it and goes to rest at a goal
2 m before the wall, as `dart_flight plan` with `objective: quickest` plans it; the mission's limits are
raised so that force and speed end nothing by themselves. Everything else is drawn (`--vary all`). In the
envelope the true wall stands turned by a given angle of incidence, elsewhere as drawn.

Uncontrolled is what `tools.campaigns.faults` says: not ended, left armed, no cause, out of the bounds,
tilted by 80 degrees, hard on the ground. Recovered is a flight that completed and lay still at the goal by
the truth. Flights go to `build/faster_hits.jsonl` as they come; the tables of docs/results/faster_hits.md are
written from that file, between the page's markers. Flights on PX4 are judged by their logs, and kept beside,
in `build/faster_hits_px4.jsonl`.
"""

from __future__ import annotations

import argparse
import functools
import math
import statistics
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.base.geometry import Vec3, distance2, norm, subtract, tilt_of
from dart_flight.base.records import (
    GuardEvent,
    Mode,
    OdometrySample,
    Outcome,
    Override,
    Phase,
    PhaseChange,
    Record,
    TruthContact,
    TruthSample,
    World,
)
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import LockDriver, VehicleConfig, load_vehicle, packaged
from dart_flight.lab.search.mission_writer import trajectory_keys
from dart_flight.lab.search.optimal_trajectory import (
    ContactResponse,
    Hit,
    HitLimits,
    MotionLimits,
    Part,
    Problem,
    Visit,
    solve,
)
from dart_flight.lab.statistics import wilson
from dart_flight.recording.reader import read_log
from dart_flight.recording.uncontrolled import find_uncontrolled
from dart_flight.recording.verdict import Verdict, VerdictBuilder
from dart_flight.run.fast import FastFlight
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.draws import draw_world, parse_vary, with_walls
from tools.campaigns.faults import Watch, judge, run_out
from tools.campaigns.kept import fly_missing
from tools.campaigns.results import RESULTS, markdown, measured_by

KEPT = Path("build/faster_hits.jsonl")
KEPT_PX4 = Path("build/faster_hits_px4.jsonl")
PAGE, FIRST, LAST = RESULTS / "faster_hits.md", "<!-- flown -->\n", "<!-- end -->"
FIRST_PX4 = "<!-- flown on px4 -->\n"
NORMAL_M_S = tuple(0.5 * k for k in range(2, 9))
TANGENTIAL_M_S = (0.0, 0.5, 1.0)
INCIDENCE_DEG = (0.0, 5.0, 10.0)
FRICTION_RATIO = 0.5  # friction over normal force, to which the law of friction is taken to hold
TOUCH_M_S = 0.6  # of the gentle hit that comes first, where one does
# (mode, normal speed, flights) after a touch, everything drawn.
HELD = (
    ("flexible", 3.0, 200),
    ("rigid", 2.3, 60),
    ("rigid", 2.0, 60),
    ("flexible", 4.0, 20),
    ("rigid", 3.0, 20),
    ("flexible", 3.5, 20),
    ("rigid", 3.5, 20),
    ("rigid", 4.0, 20),
)
SINGLE = 8  # flights at each speed without a touch, everything drawn
HELD_SEED = 28001  # rules were made while looking at seeds up to 27260; these came after them
PX4 = (  # likewise, on a real PX4
    ("flexible", 2.0, 5),
    ("flexible", 3.0, 10),
    ("flexible", 3.5, 5),
    ("rigid", 2.0, 5),
    ("rigid", 2.3, 10),
)
PX4_SEED = 28501  # likewise: 22001 to 22010 and 24001 to 24505 were looked at
_WALL_M, _BACK_M = 3.0, 2.0
_MOTION = (5.0, 8.0, 30.0)  # acceleration m/s2, jerk m/s3, tilt degrees
_JUDGED_S = 1.0  # after the hit, for tilt, height and estimate
_SETTLED_US = 16_000  # two samples of the odometry
_NEAR_M, _STILL_M_S = 0.25, 0.3


class Job(msgspec.Struct, frozen=True):
    """One flight.

    Attributes:
        mode: of the arms.
        normal_m_s, tangential_m_s: speeds at the hit.
        touch_m_s: speed of a gentle hit before it; None: there is none.
        incidence_deg: by which the true wall is turned; None: as drawn.
        seed: of noise and draws.
    """

    mode: str
    normal_m_s: float
    tangential_m_s: float
    touch_m_s: float | None
    incidence_deg: float | None
    seed: int


class Flown(msgspec.Struct):
    """One flight in a few figures.

    Attributes:
        outcome, rule, detail: of the verdict, and the guard's rule that ended it.
        problems: why it counts as uncontrolled.
        recovered: completed, and still at the goal by the truth.
        closing_m_s, exit_m_s: true velocity along the true wall's normal before and after the contact.
        peak_n: true normal force.
        clipped: the accelerometer reached its full scale.
        tilt_deg, height_m, velocity_error_m_s: the most within a second from the hit; how far the vehicle
            left its height, and how far the estimated velocity is off the true one.
        position_error_m: the most in the whole flight.
    """

    outcome: str
    rule: str
    detail: str
    problems: list[str]
    recovered: bool
    closing_m_s: float | None
    exit_m_s: float | None
    peak_n: float | None
    clipped: bool
    tilt_deg: float
    height_m: float
    velocity_error_m_s: float
    position_error_m: float


@functools.cache
def vehicle_of() -> VehicleConfig:
    """The vehicle of the shipped missions."""
    return load_vehicle(packaged("configs", "dart.yaml"))


def contact_of(mode: str) -> ContactResponse:
    """What a mode makes of a hit at the wall."""
    wall = Wall("wall", (_WALL_M, 0.0), (-1.0, 0.0), 8.0, "acrylic", half_vehicle_m=0.2)
    return ContactResponse.of(vehicle_of(), wall, Mode(mode))


@functools.cache
def mission_of(
    mode: str,
    normal_m_s: float,
    tangential_m_s: float = 0.0,
    touch_m_s: float | None = None,
    thrust_m_s2: tuple[float, float] | None = None,
) -> Mission:
    """A flight from rest into a wall at given speeds, and back to rest.

    Args:
        mode: of the arms.
        normal_m_s, tangential_m_s: speeds at the hit.
        touch_m_s: speed of a gentle hit of the same wall that comes first; None: there is none.
        thrust_m_s2: push of the thrust off the wall at the hit; None: the planner's.

    Raises:
        ValueError: the planner finds none.
    """
    vehicle = vehicle_of()
    wall = Wall("wall", (_WALL_M, 0.0), (-1.0, 0.0), 8.0, "acrylic", half_vehicle_m=0.2)
    room_m = 1.0 + 0.6 * normal_m_s + normal_m_s**2 / 8.0
    start, goal = (_WALL_M - room_m, -tangential_m_s), (_WALL_M - _BACK_M, 0.0)
    speed_m_s = math.hypot(normal_m_s, tangential_m_s) + 0.3
    peak_n = vehicle_of().detection.force_threshold_n
    hits = HitLimits(1000.0, None, None, FRICTION_RATIO, peak_n)
    if thrust_m_s2 is not None:
        hits = hits._replace(thrust_m_s2=dict.fromkeys(Mode, thrust_m_s2))
    along = math.copysign(tangential_m_s, wall.tangent[1])  # towards positive y
    hit = Hit(wall, Mode(mode), Visit(wall.point, 0.04), velocity_m_s=(-normal_m_s, along))
    before: tuple[Hit | Visit, ...] = ()
    if touch_m_s is not None:
        before = (
            Hit(wall, Mode(mode), Visit(wall.point, 0.04), velocity_m_s=(-touch_m_s, 0.0)),
            Visit(start, 0.3),
        )
    found = solve(
        Problem(
            vehicle,
            start,
            goal,
            (*(Part(event, ()) for event in (*before, hit)), Part(None, ())),
            MotionLimits(speed_m_s, *_MOTION),
            hits,
            vehicle.flying.replan_within_s,
        )
    )
    if found is None:
        raise ValueError(f"no trajectory at {normal_m_s} and {tangential_m_s} m/s, {mode}")
    tree: dict[str, Any] = {
        "version": 1,
        "name": "faster_hit",
        "start": {"position_m": start, "altitude_m": 1.0},
        "goal": {"position_m": goal, "capture_radius_m": 0.15, "hold_s": 1.0},
        "bounds_m": {"x": (start[0] - 1.5, _WALL_M + 1.0), "y": (-4.0, 4.0), "z": (0.3, 2.5)},
        "walls": {
            wall.name: {
                "point_m": wall.point,
                "normal": wall.normal,
                "length_m": wall.length_m,
                "material": wall.material,
            }
        },
        "limits": {
            "speed_m_s": speed_m_s + 0.7,
            "acceleration_m_s2": _MOTION[0],
            "jerk_m_s3": _MOTION[1],
            "peak_force_n": 1000.0,
        },
    }
    keys = trajectory_keys(vehicle, {wall.name: wall}, found)
    return load_mission(msgspec.to_builtins(tree | keys), vehicle)


_SEEN = (TruthContact, TruthSample, OdometrySample, PhaseChange, GuardEvent)


class _Onlooker:
    """What truth and estimate did from the hit on."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self.contacts: list[TruthContact] = []
        self.landing_from: TruthSample | None = None
        self.tilt = self.height_m = self.velocity_error_m_s = 0.0
        self._velocity: Vec3 | None = None
        self._last: TruthSample | None = None
        self._hit_us: int | None = None

    def take(self, record: Record) -> None:
        """See a record."""
        if isinstance(record, TruthContact):
            self.contacts.append(record)
        elif isinstance(record, PhaseChange):
            self._see_phase(record)
        elif isinstance(record, OdometrySample):
            frame = self._mission.frame_at(record.position_ned)  # velocities need no origin
            self._velocity = frame.vector_from_ned(record.velocity_ned)
        elif isinstance(record, TruthSample):
            self._last = record
            self._see(record)

    def _see_phase(self, change: PhaseChange) -> None:
        if change.after is Phase.LANDING:
            self.landing_from = self._last
        elif change.after is Phase.CONTACT and change.collision == len(self._mission.collisions):
            self._hit_us = change.t_us

    @property
    def hit(self) -> TruthContact | None:
        """The contact that the flight is about; None: it never came."""
        if self._hit_us is None:
            return None
        return next((c for c in self.contacts if c.end_us > self._hit_us), None)

    def _see(self, record: TruthSample) -> None:
        if self._hit_us is None or record.t_us - self._hit_us > _JUDGED_S * 1e6:
            return
        self.tilt = max(self.tilt, tilt_of(record.q_frd_to_ned))
        altitude_m = self._mission.altitude_m
        self.height_m = max(self.height_m, abs(record.position_mission[2] - altitude_m))
        # Within a contact a sample that is a few milliseconds old is off by what the wall has done since.
        hit = self.hit
        over = hit is not None and record.t_us > self.contacts[-1].end_us + _SETTLED_US
        if over and self._velocity is not None:
            off = norm(subtract(self._velocity, record.velocity_mission))
            self.velocity_error_m_s = max(self.velocity_error_m_s, off)

    def rests_near(self, goal: Sequence[float]) -> bool:
        """Whether the vehicle lay still at the goal when it began to land."""
        at = self.landing_from
        if at is None:
            return False
        near = distance2(at.position_mission, (goal[0], goal[1])) < _NEAR_M
        return near and norm(at.velocity_mission) < _STILL_M_S


def fly_mission(
    mission: Mission, seed: int, incidence_deg: float | None = None, spreads: dict[str, float] | None = None
) -> Flown:
    """One flight, on to the ground, in a world that is drawn.

    Args:
        mission: of one hit.
        seed: of noise and draws.
        incidence_deg: by which the true wall is turned, instead of what is drawn.
        spreads: of the draws; None: all.
    """
    spreads = parse_vary(["all"], mission.vehicle) if spreads is None else spreads
    if incidence_deg is not None:
        spreads = {**spreads, "wall_yaw_deg": 0.0}
    world = draw_world(mission, seed, spreads)
    if incidence_deg:
        turned = {w.name: w.turned(math.radians(incidence_deg)) for w in world.mission.walls}
        world = with_walls(world, turned)
    watch, builder, onlooker = Watch(mission), VerdictBuilder(mission), _Onlooker(mission)

    def observe(record: Record, number: int) -> None:
        builder.take(record)
        watch.take(record)
        onlooker.take(record)

    flight = FastFlight(
        mission, seed, LockDriver.MOCK, faults=world.lock_faults, observe=observe, world=world
    )
    problems: list[str] = []
    try:
        flight.run()
        run_out(flight)
    except Exception as error:
        problems.append(f"exception {type(error).__name__}: {error}")
    verdict = builder.build(World.FAST, seed)
    fired = _fired(verdict)
    problems += judge(flight, watch, None, verdict.outcome, fired[0])
    return _flown(mission, verdict, fired, onlooker, problems)


def _fired(verdict: Verdict) -> tuple[str, str]:
    """The guard's rule that ended a flight, and its detail; empty where none did."""
    if verdict.outcome == Outcome.COMPLETED:
        return "", ""
    return next(((g.rule, g.detail) for g in verdict.guard if g.action is not Override.NONE), ("", ""))


def _flown(
    mission: Mission, verdict: Verdict, fired: tuple[str, str], onlooker: _Onlooker, problems: list[str]
) -> Flown:
    completed = verdict.outcome == Outcome.COMPLETED
    hit = onlooker.hit
    return Flown(
        outcome=verdict.outcome.value,
        rule=fired[0],
        detail=fired[1],
        problems=problems,
        recovered=completed and hit is not None and onlooker.rests_near(mission.goal.position_m),
        closing_m_s=None if hit is None else -hit.normal_in_m_s,
        exit_m_s=None if hit is None else hit.normal_out_m_s,
        peak_n=None if hit is None else hit.peak_normal_force_n,
        clipped=any(c.clipped for c in verdict.collisions),
        tilt_deg=math.degrees(onlooker.tilt),
        height_m=onlooker.height_m,
        velocity_error_m_s=onlooker.velocity_error_m_s,
        position_error_m=verdict.ekf_error_m or 0.0,
    )


def fly_on_px4(job: Job, directory: Path) -> Flown:
    """One flight of the campaign under a real PX4, everything drawn; judged by its log."""
    mission = mission_of(job.mode, job.normal_m_s, job.tangential_m_s, job.touch_m_s)
    spreads = parse_vary(["all"], mission.vehicle)
    with tempfile.TemporaryDirectory() as folder:
        verdict = fly_px4(mission, directory, job.seed, Path(folder), spreads=spreads)
        return flown_of(verdict, mission)


def flown_of(verdict: Verdict, mission: Mission) -> Flown:
    """A flight by its log; what is no rule of the guard may have ended it, too."""
    assert verdict.log is not None
    watch, onlooker = Watch(mission), _Onlooker(mission)
    seen = [e.record for e in read_log(verdict.log).entries if isinstance(e.record, _SEEN)]
    # Truth and estimate come on threads of their own: the log has either first.
    for record in sorted(seen, key=lambda r: r.end_us if isinstance(r, TruthContact) else r.t_us):
        watch.take(record)
        onlooker.take(record)
    fired = _fired(verdict)
    if verdict.outcome != Outcome.COMPLETED and not fired[0]:
        rule, _, detail = (verdict.reason or "").partition(": ")
        fired = (rule, detail)
    completed = verdict.outcome == Outcome.COMPLETED
    problems = list(find_uncontrolled(watch.truth, completed, bool(fired[0])))
    if not watch.is_down:
        problems.append("in the air at last")
    return _flown(mission, verdict, fired, onlooker, problems)


def fly(job: Job) -> Flown:
    """One flight of the campaign."""
    mission = mission_of(job.mode, job.normal_m_s, job.tangential_m_s, job.touch_m_s)
    return fly_mission(mission, job.seed, job.incidence_deg)


# --- what is flown -----------------------------------------------------------------------------------------


def is_within_law(mode: str, tangential_m_s: float) -> bool:
    """Whether the friction of a hit is still within what its law was measured at."""
    return contact_of(mode).mu_s_per_m * tangential_m_s <= FRICTION_RATIO


def held_jobs(
    cells: Sequence[tuple[str, float, int]] = HELD, first_seed: int = HELD_SEED, most: int | None = None
) -> list[Job]:
    """Hits along the normal in worlds in which everything is drawn.

    Args:
        cells: mode, normal speed, flights.
        first_seed: of every cell.
        most: flights of a cell; None: as the cell says.
    """
    return [
        Job(mode, normal, 0.0, TOUCH_M_S, None, first_seed + k)
        for mode, normal, flights in cells
        for k in range(flights if most is None else min(flights, most))
    ]


def single_jobs() -> list[Job]:
    """The same without a touch, over all speeds."""
    return [
        Job(mode, normal, 0.0, None, None, HELD_SEED + k)
        for mode in ("flexible", "rigid")
        for normal in NORMAL_M_S
        for k in range(SINGLE)
    ]


def envelope_jobs(seeds: int) -> list[Job]:
    """Every cell of the envelope, after a touch."""
    return [
        Job(mode, normal, tangential, TOUCH_M_S, incidence, 1 + seed)
        for mode in ("flexible", "rigid")
        for tangential in TANGENTIAL_M_S
        if is_within_law(mode, tangential)
        for normal in NORMAL_M_S
        for incidence in INCIDENCE_DEG
        for seed in range(seeds)
    ]


# --- the page ----------------------------------------------------------------------------------------------

_FIGURES = (
    "flights", "recovered", "uncontrolled", "met at, m/s (median)", "tilt ° (median, most)",
    "speed left (median, least)",
    "peak N (median, most)", "clipped", "velocity off by, m/s (median, most)", "ended by",
)  # fmt: skip


def _figures(flights: Sequence[Flown]) -> list[str]:
    """Of some flights alike, in the order of `_FIGURES`; what did not come to the hit has none of it."""
    hit = [f for f in flights if f.closing_m_s]
    ended = Counter(f"`{f.rule}`" for f in flights if f.outcome != Outcome.COMPLETED)

    def most(pick: Callable[[Flown], float], digits: int, worst: Callable[[list[float]], float] = max) -> str:
        values = [pick(f) for f in hit]
        if not values:
            return "–"
        return f"{statistics.median(values):.{digits}f}, {worst(values):.{digits}f}"

    return [
        str(len(flights)),
        str(sum(f.recovered for f in flights)),
        str(sum(bool(f.problems) for f in flights)),
        f"{statistics.median([f.closing_m_s or 0.0 for f in hit]):.2f}" if hit else "–",
        most(lambda f: f.tilt_deg, 0),
        most(lambda f: (f.exit_m_s or 0.0) / (f.closing_m_s or 1.0), 2, min),
        most(lambda f: f.peak_n or 0.0, 0),
        str(sum(f.clipped for f in flights)),
        most(lambda f: f.velocity_error_m_s, 2),
        ", ".join(f"{rule} {count}" for rule, count in ended.most_common()) or "–",
    ]


def _rate(flights: Sequence[Flown]) -> str:
    recovered = sum(f.recovered for f in flights)
    low, high = wilson(recovered, len(flights))
    return f"{100 * recovered / len(flights):.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def _of(flown: dict[Job, Flown], *key: object) -> list[Flown]:
    return [f for job, f in flown.items() if msgspec.structs.astuple(job)[:5] == key]


def _held_table(flown: dict[Job, Flown], cells: Sequence[tuple[str, float, int]]) -> str:
    """Hits along the normal after a touch, everything drawn."""
    rows = [
        [mode, f"{normal:.1f}", _rate(flights), *_figures(flights)]
        for mode, normal, _ in sorted(cells)
        if (flights := _of(flown, mode, normal, 0.0, TOUCH_M_S, None))
    ]
    return markdown(("mode", "closing m/s", "recovered (95 %)", *_FIGURES), rows)


def px4_tables(flown: dict[Job, Flown]) -> str:
    """What was flown on PX4, and each flight that did not recover or was uncontrolled."""
    measured = measured_by("tools.campaigns.faster_hits --px4 DIR", "under PX4 SITL in real time")
    text = f"{measured} After a touch at {TOUCH_M_S} m/s, everything drawn, seeds from {PX4_SEED}:\n\n"
    text += _held_table(flown, PX4)
    rows = [
        [
            job.mode,
            f"{job.normal_m_s:.1f}",
            str(job.seed),
            f"{f.rule}: {f.detail}" if f.rule else f.outcome,
            "–" if f.closing_m_s is None else f"{f.closing_m_s:.2f}",
            f"{f.tilt_deg:.0f}",
            "; ".join(f.problems) or "–",
        ]
        for job, f in flown.items()
        if f.problems or not f.recovered
    ]
    if rows:
        heads = ("mode", "closing m/s", "seed", "ended by", "met at, m/s", "tilt °", "uncontrolled")
        text += "\nEvery flight that did not recover:\n\n" + markdown(heads, rows)
    return text


def tables(flown: dict[Job, Flown]) -> str:
    """Held seeds, the middle of the envelope without a touch, and the envelope."""

    def of(*key: object) -> list[Flown]:
        return _of(flown, *key)

    heads = ("mode", "closing m/s", "recovered (95 %)", *_FIGURES)
    text = f"**After a touch at {TOUCH_M_S} m/s**, everything drawn, seeds from {HELD_SEED}:\n\n"
    text += _held_table(flown, HELD)
    rows = [
        [mode, f"{normal:.1f}", _rate(flights), *_figures(flights)]
        for mode in ("flexible", "rigid")
        for normal in NORMAL_M_S
        if (flights := of(mode, normal, 0.0, None, None))
    ]
    text += "\n**The first hit of a flight**, everything drawn, the same seeds:\n\n" + markdown(heads, rows)
    text += f"\n**After a touch at {TOUCH_M_S} m/s**, the wall turned by the incidence, all else drawn:\n\n"
    rows = []
    for mode in ("flexible", "rigid"):
        for tangential in TANGENTIAL_M_S:
            if not is_within_law(mode, tangential):
                beyond = f"friction ratio {contact_of(mode).mu_s_per_m * tangential:.1f}: not flown"
                rows.append([mode, "all", f"{tangential:.1f}", "all", *["–"] * (len(_FIGURES) - 1), beyond])
                continue
            for normal in NORMAL_M_S:
                for incidence in INCIDENCE_DEG:
                    flights = of(mode, normal, tangential, TOUCH_M_S, incidence)
                    if flights:
                        cell = [mode, f"{normal:.1f}", f"{tangential:.1f}", f"{incidence:.0f}"]
                        rows.append([*cell, *_figures(flights)])
    return text + markdown(("mode", "closing m/s", "sliding m/s", "incidence °", *_FIGURES), rows)


def _put(page: str, first: str, text: str) -> str:
    """The page with a text between a marker and the end that follows it."""
    head, rest = page.split(first)
    return head + first + text + LAST + rest.partition(LAST)[2]


def write_page(flown: dict[Job, Flown]) -> None:
    """Put the tables between the markers of the page, and today's date on it."""
    measured = f"{measured_by('tools.campaigns.faster_hits')}\n"
    head, first, rest = PAGE.read_text().partition(FIRST)
    head = "".join(
        measured if line.startswith("Measured on ") else line for line in head.splitlines(keepends=True)
    )
    PAGE.write_text(_put(head + first + rest, FIRST, tables(flown)))


def main() -> int:
    """Fly what is missing and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, help="of each cell of the envelope (2); on PX4 at most, of each")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--px4", type=Path, metavar="DIR", help="fly on this PX4, one flight at a time")
    arguments = parser.parse_args()
    if arguments.px4 is not None:
        jobs = held_jobs(PX4, PX4_SEED, arguments.seeds)
        fly_one = functools.partial(fly_on_px4, directory=arguments.px4)
        flown = dict(zip(jobs, fly_missing(KEPT_PX4, jobs, fly_one, tuple[Job, Flown], 1), strict=True))
        PAGE.write_text(_put(PAGE.read_text(), FIRST_PX4, px4_tables(flown)))
        return 0
    jobs = [*held_jobs(), *single_jobs(), *envelope_jobs(2 if arguments.seeds is None else arguments.seeds)]
    flown = dict(zip(jobs, fly_missing(KEPT, jobs, fly, tuple[Job, Flown], arguments.processes), strict=True))
    write_page(flown)
    return 0


if __name__ == "__main__":
    sys.exit(main())
