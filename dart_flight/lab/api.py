"""What a Python script does with this package: the functions behind `import dart_flight` (docs/python.md).

They are the commands without the command line: missions, vehicles and scenarios from files or from Python,
flights in the fast world, predictions, plans, identification, flight logs as arrays. Wrong input raises
`InputError`, a `ValueError`. Nothing here starts an event loop or minds one that runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.config import mission as mission_files
from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import Mission
from dart_flight.config.provenance import find_vehicle
from dart_flight.config.settings import apply_settings
from dart_flight.config.vehicle import VehicleConfig, packaged
from dart_flight.config.vehicle import load_vehicle as load_vehicle_file
from dart_flight.config.vehicle.configuration import vehicle_of
from dart_flight.contact.coefficients import CoefficientArrays
from dart_flight.contact.contact_map import Drop, WallHit, collide, contact_map, drop
from dart_flight.lab.identify.estimates import Identification
from dart_flight.lab.identify.flight_trials import trials_at_one
from dart_flight.lab.identify.identify_trials import columns_of, identify_trials
from dart_flight.lab.identify.trials import UNLABELLED, Trial, TrialReading
from dart_flight.lab.predict import prediction
from dart_flight.lab.search import scenario as scenario_files
from dart_flight.lab.search.flown_plan import fly_in_process, fly_mission
from dart_flight.lab.search.mission_writer import mission_text, planned_mission, write_mission
from dart_flight.lab.search.plan_table import with_objective
from dart_flight.lab.search.scenario import Objective, Scenario
from dart_flight.lab.search.search import Plan, SearchResult, search
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.verdict import Verdict, verdict_of
from dart_flight.run.fast import fly_fast
from dart_flight.run.flight_record import FlightRecord
from dart_flight.run.prepare import refuse_unflyable
from dart_flight.sim.draws import parse_vary
from dart_flight.sim.faults.fault_table import Fault, parse_fault_of

Written = str | Path | Mapping[str, Any]  # a file, or what it would hold
Numbers = Sequence[float] | NDArray[Any]
Array = NDArray[np.float64]


# --- what is flown --------------------------------------------------------------------------------------


def load_vehicle(path: Written | None = None, settings: Sequence[str] = ()) -> VehicleConfig:
    """A vehicle's configuration; `replace({"airframe.mass_kg": 1.5})` gives another.

    Args:
        path: of the file, or a mapping of what it would hold. Without: $DART_FLIGHT_CONFIG, else
            ./configs/dart.yaml or the only file there, else the packaged one.
        settings: `KEY=VALUE` that differ from it, as with `--set`.

    Raises:
        InputError: a key is unknown, or a value is of the wrong kind or out of range.
    """
    if isinstance(path, Mapping):
        return load_vehicle_file(path, settings)
    return find_vehicle(path, settings).config


def load_mission(
    mission: Written | Mission,
    vehicle: VehicleConfig | Written | None = None,
    settings: Sequence[str] = (),
) -> Mission:
    """A mission and the vehicle that flies it; `replace({"limits.speed_m_s": 2.0})` gives another.

    Args:
        mission: a file, or a mapping of what it would hold; a mission is itself.
        vehicle: the configuration, instead of the one that the mission names.
        settings: `KEY=VALUE` of the configuration, as with `--set`.

    Raises:
        InputError: in the mission or in the configuration.
    """
    if isinstance(vehicle, Mapping):
        vehicle = load_vehicle_file(vehicle)
    if isinstance(mission, Mission):
        if vehicle is None and not settings:
            return mission
        taken = load_vehicle(vehicle) if isinstance(vehicle, str | Path) else vehicle or mission.vehicle
        return mission.replace({"vehicle": _with_settings(taken, settings)})
    if isinstance(vehicle, VehicleConfig):
        return mission_files.load_mission(mission, _with_settings(vehicle, settings))
    return mission_files.load_mission(mission, vehicle, settings)


def _with_settings(vehicle: VehicleConfig, settings: Sequence[str]) -> VehicleConfig:
    if not settings:
        return vehicle
    document = Document.of(vehicle.to_dict())
    apply_settings(settings, document)
    return vehicle_of(document)


# --- flights --------------------------------------------------------------------------------------------


class Flight:
    """A simulated flight.

    Attributes:
        mission: that was flown.
        verdict: what it amounted to, as `dry-run --json` has it.
    """

    def __init__(self, mission: Mission, verdict: Verdict, record: FlightRecord) -> None:
        self.mission, self.verdict, self._record = mission, verdict, record

    @cached_property
    def log(self) -> Log:
        """Every record: `log["/estimate/force"].force_mission`. Some ten megabytes, unless on disk."""
        return self._record.log

    def __repr__(self) -> str:
        v = self.verdict
        return (
            f"<flight of {v.mission}, seed {v.seed}: {v.outcome.value}{f', {v.reason}' if v.reason else ''}>"
        )


def simulate(
    mission: Mission | Written,
    seed: int = 1,
    *,
    vary: str | Iterable[str] | Mapping[str, float] | None = None,
    fault: str | Fault | None = None,
    log_dir: str | Path | None = None,
) -> Flight:
    """Fly a mission in simulated time, as `dry-run --fast` does; the same seed gives the same flight.

    Args:
        mission: `load_mission` makes it of a file or of a mapping.
        seed: of the noise, and of what is drawn.
        vary: what of the simulated world is drawn (docs/draws.md): `"all"`, `["mass", "contact=0.3"]`, or
            standard deviations by name.
        fault: what goes wrong, `NAME[=VALUE][@PHASE]` (docs/faults.md).
        log_dir: the log goes into a folder of its own in this one; without, it is kept in memory.

    Raises:
        InputError: the mission cannot be flown, the seed is no whole number, or what is to be drawn or to go
            wrong is unknown.
    """
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or not 0 <= seed < 2**31:
        raise InputError(f"expected a whole number from 0 to {2**31 - 1}, not {seed!r}", key=("seed",))
    mission = load_mission(mission)
    refuse_unflyable(mission)
    spreads = parse_vary(_settings_of(vary), mission.vehicle)
    broken = parse_fault_of(mission, fault) if isinstance(fault, str) else fault
    folder = None if log_dir is None else Path(log_dir)
    records: list[FlightRecord] = []
    take = records.append
    verdict = fly_fast(mission, int(seed), folder, fault=broken, spreads=spreads, take_record=take)
    return Flight(mission, verdict, records[0])


def _settings_of(vary: str | Iterable[str] | Mapping[str, float] | None) -> list[str]:
    if vary is None:
        return []
    if isinstance(vary, str):
        return [vary]
    if isinstance(vary, Mapping):
        return [f"{name}={float(sd)!r}" for name, sd in vary.items()]
    return list(vary)


# --- the contact law ------------------------------------------------------------------------------------


@overload
def predict(
    vehicle: VehicleConfig, surface: str, mode: str, normal_m_s: float,
    tangential_m_s: float = 0.0, *, onset: str | None = None, incidence_deg: float = 0.0,
) -> WallHit[float]: ...  # fmt: skip
@overload
def predict(
    vehicle: VehicleConfig, surface: str, mode: str, normal_m_s: Numbers,
    tangential_m_s: float | Numbers = 0.0, *, onset: str | None = None, incidence_deg: float = 0.0,
) -> WallHit[Array]: ...  # fmt: skip
@overload
def predict(
    vehicle: VehicleConfig, surface: str, mode: str, normal_m_s: float,
    tangential_m_s: Numbers, *, onset: str | None = None, incidence_deg: float = 0.0,
) -> WallHit[Array]: ...  # fmt: skip
def predict(
    vehicle: VehicleConfig,
    surface: str,
    mode: str,
    normal_m_s: float | Numbers,
    tangential_m_s: float | Numbers = 0.0,
    *,
    onset: str | None = None,
    incidence_deg: float = 0.0,
) -> WallHit[float] | WallHit[Array]:
    """What comes out of a wall hit, in closed form (paper, Sec. IV-B).

    Args:
        vehicle: its mass and materials.
        surface: a material of the vehicle's.
        mode: `rigid` or `flexible`.
        normal_m_s: velocity at the onset along the wall's outward normal, negative; arrays give arrays.
        tangential_m_s: velocity along the wall; broadcasts with it.
        onset: `lcp` or `touch`; the configuration's by default.
        incidence_deg: leading edge against the wall, 0 to 45.

    Returns:
        `normal_out_m_s`, `peak_normal_force_n`, `contact_time_s`, ... (`contact.contact_map.WallHit`).

    Raises:
        InputError: the surface, the mode or the onset is unknown, or a velocity does not approach the wall.
    """
    what = prediction.condition(vehicle, surface, mode, onset, incidence_deg)
    normal, tangential = np.asarray(normal_m_s, dtype=float), np.asarray(tangential_m_s, dtype=float)
    for pair in np.broadcast(normal, tangential):
        prediction.refuse_hit(*map(float, pair))
    if normal.ndim == 0 and tangential.ndim == 0:
        return collide(what.coefficients, what.mass_kg, float(normal), float(tangential), what.onset)
    table = CoefficientArrays.of([what.coefficients])
    rows = np.zeros(np.broadcast(normal, tangential).shape, dtype=np.intp)
    return contact_map(table, what.mass_kg, normal, tangential, what.onset, rows=rows)


def predict_drop(
    vehicle: VehicleConfig, surface: str, mode: str, height_m: float, *, onset: str | None = None
) -> Drop[float]:
    """What comes out of a drop, released at rest `height_m` above the plane of first touch.

    Raises:
        InputError: as `predict`, or the height is not above 0 and up to 100 m.
    """
    what = prediction.condition(vehicle, surface, mode, onset, 0.0)
    prediction.drop_contact(what, height_m)  # refuses heights
    return drop(what.coefficients, what.mass_kg, height_m, what.onset)


# --- planning -------------------------------------------------------------------------------------------


class PlanResult:
    """What a search found.

    Attributes:
        search: the whole of it: counts, refusals, maps.
    """

    def __init__(self, result: SearchResult) -> None:
        self.search = result

    @property
    def plans(self) -> Sequence[Plan]:
        """The best ones, in order."""
        return self.search.plans

    @property
    def mission(self) -> Mission:
        """The best plan as a mission, to be flown."""
        return self.mission_of(1)

    def mission_of(self, rank: int) -> Mission:
        """A plan as a mission; 1 is the best.

        Raises:
            InputError: there are not that many.
        """
        scenario = self.search.scenario
        text = mission_text(scenario, self._plan(rank), Path("plan.yaml"))
        mission = mission_files.parse_mission(Document(text, "<plan>"), scenario.vehicle)
        return msgspec.structs.replace(mission, vehicle_source=scenario.vehicle_source)

    def write(self, path: str | Path, rank: int = 1, *, verify: bool = True) -> Path:
        """Write a plan as a mission file; what was changed in Python of its vehicle is not in it.

        Args:
            path: of the file.
            rank: of the plan.
            verify: whether to fly the plan in simulation first (21 flights in this process, half a minute)
                and write the results into the file (`flown`).

        Raises:
            InputError: it cannot be written, or there are not that many plans.
        """
        plan, scenario = self._plan(rank), self.search.scenario
        record = fly_mission(planned_mission(scenario, plan), fly=fly_in_process).record if verify else None
        write_mission(scenario, plan, Path(path), record)
        return Path(path)

    def _plan(self, rank: int) -> Plan:
        if not 1 <= rank <= len(self.plans):
            raise InputError(f"{rank}, there are plans 1 to {len(self.plans)}", key=("rank",))
        return self.plans[rank - 1]


def load_scenario(
    scenario: Written, vehicle: VehicleConfig | str | Path | None = None, settings: Sequence[str] = ()
) -> Scenario:
    """What the planner is asked: a scenario file, or a mapping of what it would hold.

    Args:
        scenario: the file or the mapping.
        vehicle: the configuration, instead of the one that the scenario names.
        settings: `KEY=VALUE` of the configuration, as with `--set`.

    Raises:
        InputError: in the scenario or in the configuration.
    """
    if isinstance(vehicle, VehicleConfig):
        return scenario_files.load_scenario(scenario, vehicle=_with_settings(vehicle, settings))
    return scenario_files.load_scenario(scenario, vehicle, settings=settings)


def plan(
    scenario: Scenario | Written,
    *,
    vehicle: VehicleConfig | str | Path | None = None,
    objective: str | None = None,
    top: int = 10,
    seed: int = 1,
) -> PlanResult:
    """Choose walls, velocities and modes for a scenario.

    Args:
        scenario: `load_scenario` makes it of a file or of a mapping.
        vehicle: the configuration, instead of the one that the scenario names.
        objective: `nearest`, `fastest`, `gentlest` or `robust`, instead of the scenario's.
        top: how many plans to keep.
        seed: of the draws of `robust`.

    Raises:
        InputError: in the scenario, or nothing is feasible; the message says what stands in the way most.
    """
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(scenario, vehicle)
    elif vehicle is not None:
        raise InputError("a loaded scenario has its vehicle: give it to load_scenario", key=("vehicle",))
    if objective is not None:
        if objective not in list(Objective):
            raise InputError(f"{objective!r} is none of {', '.join(Objective)}", key=("objective",))
        scenario = with_objective(scenario, Objective(objective))
    return PlanResult(search(scenario, top, seed))


# --- identification -------------------------------------------------------------------------------------

Source = str | Path | Trial | Log | Flight


def identify(
    trials: Source | Sequence[Source],
    *,
    vehicle: VehicleConfig | None = None,
    mode: str | None = None,
    surface: str | None = None,
    drop: bool | float = False,
    onset: str | None = None,
    contact_distance_m: float = 0.0,
    columns: Mapping[str, str] | None = None,
    wall: tuple[float, float, float] | None = None,
    mass_kg: float | None = None,
) -> Identification:
    """Contact coefficients from recorded trials at one wall; needs SciPy (the extra `identify`).

    Args:
        trials: files (CSV, PX4 ULog, flight log), folders of flight logs, flights, logs, or `Trial`s of your
            own arrays.
        vehicle: its mass and rule for the onset count; by default that of `load_vehicle()`. A flight log says
            its own, which counts for it.
        mode: state of the arms where the trials do not say it; of flights, their collisions in it.
        surface: of flights, their collisions with this material.
        drop: the trials are drops, or the height in m.
        onset: `lcp` or `touch`; the vehicle's by default.
        contact_distance_m: is subtracted from `normal_m` of files.
        columns: our name -> header of CSV files.
        wall: of PX4 logs: north, east (m) of a point of the plane, heading of its normal (degrees).
        mass_kg: of the vehicle, instead of the configuration's.

    Raises:
        InputError: SciPy is missing, a trial or an option cannot be used, a collision is with another wall.
    """
    given = list(trials) if isinstance(trials, Sequence) and not isinstance(trials, str) else [trials]
    vehicle = vehicle or load_vehicle()
    if mode not in (None, "rigid", "flexible"):
        raise InputError(f"{mode!r} is not allowed, only: rigid, flexible", key=("mode",))
    how = TrialReading(
        mode=mode or UNLABELLED,
        surface=surface,
        drop=drop is not False,
        height_m=None if isinstance(drop, bool) else drop,
        contact_distance_m=contact_distance_m,
        columns=columns_of(",".join(f"{name}={header}" for name, header in (columns or {}).items())),
        wall=wall,
        mass_kg=mass_kg,
    )
    own = [trial for one in given for trial in _trials_in(one, surface, how.mode)]
    paths = [str(one) for one in given if isinstance(one, str | Path)]
    rule = None if onset is None else prediction.onset_rule(vehicle, onset)
    return identify_trials(paths, how, vehicle, onset=rule, given=own).found


def _trials_in(source: Source, surface: str | None, mode: str) -> list[Trial]:
    """The trials of what is no file."""
    if isinstance(source, Trial):
        return [source]
    if isinstance(source, Flight):
        source = source.log
    return trials_at_one(source, surface, mode) if isinstance(source, Log) else []


__all__ = [
    "Flight",
    "Identification",
    "InputError",
    "Log",
    "Mission",
    "PlanResult",
    "Trial",
    "VehicleConfig",
    "Verdict",
    "identify",
    "load_mission",
    "load_scenario",
    "load_vehicle",
    "packaged",
    "plan",
    "predict",
    "predict_drop",
    "read_log",
    "simulate",
    "verdict_of",
]
