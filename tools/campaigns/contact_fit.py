"""Campaign: mode and coefficients estimated from one contact, compared with the drawn world
(docs/results/contact_fit.md).

A flight ends when its contact has been evaluated. The seed draws approach velocity, mode, and whether the
lock obeys. It also draws the wall's coefficients (standard deviation 30 %) and their scatter between contacts
(5 %).
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from dart_flight.base.geometry import wrap_angle
from dart_flight.base.records import Mode, Phase, PhaseChange, Record, TruthContact, WallEstimate, World
from dart_flight.config.file_kinds import FileKind, load_document
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.contact.contact_map import collide
from dart_flight.contact.law import Onset
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.lock.drivers.mock import MockFaults
from dart_flight.lock.servo import ServoFaults
from dart_flight.recording.verdict import VerdictBuilder
from dart_flight.run.fast import FastFlight
from dart_flight.sim.draws import draw_world
from tools.campaigns.results import NoResultError, grouped, markdown

_LONGEST_S = 40.0
_STUCK = MockFaults(servo=ServoFaults(stuck=True))
_Z_95 = 1.959964
_CONTACT = {"contact": 0.3, "contact_scatter": 0.05}
_OTHERS = _CONTACT | {
    "wall_yaw_deg": 4.0, "wall_offset_m": 0.03, "mass": 0.03, "wind_m_s": 0.5, "battery": 0.05,
}  # fmt: skip
_OTHER_ARMS = tuple(
    f"simulation.arm_vibration.{key}"
    for key in ("frequency_hz=23", "damping_ratio=0.2", "mass_fraction=0.12")
)


class FlightSet(NamedTuple):
    """The common properties of the flights of a set; `settings` apply to the simulated vehicle alone."""

    material: str
    slides: bool
    spreads: dict[str, float]
    settings: tuple[str, ...] = ()


_HALF = "simulation.contact.half_engaged=true"
SETS = {
    "wood": FlightSet("wood", True, _CONTACT),
    "sliding": FlightSet("acrylic", True, _CONTACT),
    "headon": FlightSet("acrylic", False, _CONTACT),
    "wood-all": FlightSet("wood", True, _OTHERS),
    "sliding-all": FlightSet("acrylic", True, _OTHERS),
    "wood-shaken": FlightSet("wood", True, _OTHERS | {"imu": 0.02}),
    "headon-arms": FlightSet("acrylic", False, _CONTACT, _OTHER_ARMS),
    "half": FlightSet("acrylic", True, _CONTACT, (_HALF,)),
}


class EstimatedContact(msgspec.Struct, frozen=True):
    """One contact: the estimate and the truth.

    Attributes:
        by_time: mode whose contact duration with this material is nearest to the measured one.
        after_ms: time from the true end of the contact to the evaluation.
        direction_error_deg: None without an estimate of the direction.
        coefficients: name -> estimate, its relative standard deviation, and truth.
    """

    true_mode: Mode
    mode_felt: Mode | None
    mode_reported: Mode | None
    by_time: Mode | None
    after_ms: float
    plane_error_m: float
    direction_error_deg: float | None
    coefficients: dict[str, tuple[float, float, float]]

    @property
    def is_wrong(self) -> bool:
        """Whether the estimated mode is wrong."""
        return self.mode_felt not in (None, self.true_mode)


def cases() -> list[dict[str, str]]:
    """Return the cases: every set."""
    return [{"set": name} for name in SETS]


def mission_of(case: dict[str, str], seed: int) -> tuple[Mission, bool]:
    """Return the single-wall mission with approach and mode of a seed, and whether the lock disobeys."""
    chosen, rng = SETS[case["set"]], random.Random(f"{case['set']} {seed}")
    half = _HALF in chosen.settings
    normal = -rng.uniform(0.5, 1.2)
    along = (0.2, 0.6) if chosen.slides else (0.0, 0.0)
    tangential = rng.choice((-1.0, 1.0)) * rng.uniform(*along)
    mode = Mode.RIGID if half else rng.choice(list(Mode))
    disobeys = not half and rng.random() < 0.5
    document = load_document("missions/paper_single_wall.yaml", FileKind.MISSION)
    tree = document.tree
    tree["start"]["position_m"] = [0.0, 0.5]
    tree["bounds_m"]["y"] = [-3.5, 4.5]
    tree["walls"]["acrylic"] |= {"material": chosen.material, "length_m": 6.0}
    approach = {"normal_m_s": normal, "tangential_m_s": tangential}
    tree["collisions"][0] |= {"mode": mode.value, "approach": approach}
    tree["limits"] = {"speed_m_s": 4.0, "peak_force_n": 300.0}
    return parse_mission(document, None, list(chosen.settings)), disobeys


def fly(point: Point, seed: int) -> EstimatedContact:
    """Fly until the first contact is evaluated.

    Raises:
        NoResultError: there was no contact.
    """
    case = dict(point.case)
    mission, disobeys = mission_of(case, seed)
    commanded = mission.collisions[0].mode
    world = draw_world(mission, seed, SETS[case["set"]].spreads)
    builder = VerdictBuilder(mission)
    estimates: list[tuple[int, WallEstimate]] = []
    contacts: list[TruthContact] = []

    def observe(record: Record, number: int) -> None:
        builder.add(record)
        if isinstance(record, WallEstimate):
            estimates.append((flight.autopilot.time_us, record))
        elif isinstance(record, TruthContact):
            contacts.append(record)
        elif isinstance(record, PhaseChange) and record.after is Phase.PREPARE and sticks_rigid:
            assert flight.mock is not None
            flight.mock.inject(_STUCK)  # the rods stay inserted, so the arms stay rigid

    sticks_rigid = disobeys and commanded is Mode.FLEXIBLE
    faults = _STUCK if disobeys and commanded is Mode.RIGID else None
    flight = FastFlight(mission, seed, observe=observe, world=world._replace(lock_faults=faults))
    while flight.core.end is None and flight.autopilot.now_s < _LONGEST_S and not (estimates and contacts):
        flight.tick()
    if not estimates or not contacts:
        raise NoResultError("no contact")
    (estimated_us, estimate), contact = estimates[0], contacts[0]
    true, planned = world.mission.walls[0], mission.walls[0]
    x, y, _ = contact.position_mission
    away = true.signed_distance((x, y))
    touched = (x - away * true.normal[0], y - away * true.normal[1])
    wall = world.mission.vehicle.materials[true.material].coefficients(contact.mode)
    hits = builder.build(World.FAST, seed).collisions
    found = estimate.plane_normal_mission
    turned = None if found is None else wrap_angle(math.atan2(*found[::-1]) - math.atan2(*true.normal[::-1]))
    return EstimatedContact(
        contact.mode,
        estimate.mode_felt,
        estimate.mode_reported,
        _mode_by_time(planned.material, mission, hits[0].contact_time_ms if hits else None),
        (estimated_us - contact.end_us) * 1e-3,
        estimate.plane_offset_m - planned.signed_distance(touched),
        None if turned is None else math.degrees(turned),
        {
            "k": (estimate.k_n_per_m, estimate.k_sd, wall.k),
            "f": (estimate.f_ns_per_m, estimate.f_sd, wall.f),
            "mu": (estimate.mu_s_per_m, estimate.mu_sd, wall.mu),
        },
    )


def _mode_by_time(material: str, mission: Mission, measured_ms: float | None) -> Mode | None:
    if measured_ms is None:
        return None
    vehicle = mission.vehicle

    def mismatch(mode: Mode) -> float:
        c = vehicle.materials[material].coefficients(mode)
        hit = collide(c, vehicle.airframe.mass_kg, -1.0, 0.0, Onset(vehicle.onset))
        return abs(math.log(max(measured_ms, 1.0) * 1e-3 / hit.contact_time_s))

    return min(Mode, key=mismatch)


_HEADS = (
    "set", "contacts", "wrong", "undecided", "wrong by duration", "direction rms °", "place rms mm",
    "intervals hold k, f, mu",
)  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a row for every set."""
    return markdown(_HEADS, [[*key, *_cells(mine)] for key, mine in grouped(rows, "set").items()])


def _cells(mine: Sequence[EstimatedContact]) -> list[str]:
    correct = [c for c in mine if c.mode_felt in (None, c.true_mode)]
    turned = [c.direction_error_deg for c in mine if c.direction_error_deg is not None]
    covered = [
        100 * sum(abs(true / value - 1.0) <= _Z_95 * sd for value, sd, true in found) / len(found)
        for name in ("k", "f", "mu")
        if (found := [c.coefficients[name] for c in correct])
    ]
    return [
        str(len(mine)),
        str(sum(c.is_wrong for c in mine)),
        str(sum(c.mode_felt is None for c in mine)),
        str(sum(c.by_time is not c.true_mode for c in mine)),
        f"{_rms(turned):.2f}" if turned else "-",
        f"{_rms([1e3 * c.plane_error_m for c in mine]):.1f}",
        ", ".join(f"{share:.0f}" for share in covered) + " %",
    ]


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(math.fsum(v * v for v in values) / len(values))
