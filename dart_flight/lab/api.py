"""The functions behind `import dart_flight`, for Python scripts (docs/python.md).

Like the commands, they load missions, vehicles and scenarios, simulate flights, predict contacts, plan
missions, identify coefficients and read flight logs. Invalid input raises `InputError`, which is a
`ValueError`. No function starts an event loop, and every function can be called while an event loop runs.
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
from dart_flight.config.vehicle.configuration import parse_vehicle
from dart_flight.contact.coefficients import CoefficientArrays
from dart_flight.contact.contact_map import Drop, WallContact, collide, contact_map, drop
from dart_flight.lab.identify.estimates import Identification
from dart_flight.lab.identify.flight_trials import trials_at_one
from dart_flight.lab.identify.identify_trials import columns_of, identify_trials
from dart_flight.lab.identify.trials import UNLABELLED, Trial, TrialReading
from dart_flight.lab.predict import prediction
from dart_flight.lab.search import scenario as scenario_files
from dart_flight.lab.search.flown_plan import fly_in_process, fly_mission
from dart_flight.lab.search.mission_writer import mission_text, planned_mission, write_mission
from dart_flight.lab.search.plan import Plan, SearchResult
from dart_flight.lab.search.plan_table import with_objective
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.lab.search.scenario import Objective, Scenario
from dart_flight.lab.search.search import search
from dart_flight.lab.stepwise import FlightSetpoint
from dart_flight.lab.stepwise import SteppedSimulation as Simulation
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.verdict import Verdict, verdict_of
from dart_flight.run.fast import fly_fast
from dart_flight.run.flight_record import FlightRecord
from dart_flight.run.prepare import refuse_unflyable
from dart_flight.sim.draws import parse_vary
from dart_flight.sim.faults.fault_table import Fault, parse_mission_fault

Written = str | Path | Mapping[str, Any]  # the path of a file, or a mapping with its content
Numbers = Sequence[float] | NDArray[Any]
Array = NDArray[np.float64]


# --- missions and vehicles ------------------------------------------------------------------------------


def load_vehicle(path: Written | None = None, settings: Sequence[str] = ()) -> VehicleConfig:
    """Load a vehicle configuration; the method `replace({"airframe.mass_kg": 1.5})` returns a modified copy.

    Args:
        path: a file, or a mapping with its content. Default: the file that a command would use
            (docs/configuration.md).
        settings: `KEY=VALUE` settings that override keys of the configuration, as with `--set`.

    Raises:
        InputError: a key is unknown, or a value has the wrong type or is out of range.
    """
    if isinstance(path, Mapping):
        return load_vehicle_file(path, settings)
    return find_vehicle(path, settings).config


def load_mission(
    mission: Written | Mission,
    vehicle: VehicleConfig | Written | None = None,
    settings: Sequence[str] = (),
) -> Mission:
    """Load a mission and its vehicle; `Mission.replace({"limits.speed_m_s": 2.0})` returns a modified copy.

    Args:
        mission: a file, a mapping with its content, or a loaded mission.
        vehicle: the configuration to use instead of the mission's configuration.
        settings: `KEY=VALUE` settings of the configuration, as with `--set`.

    Raises:
        InputError: the mission or the configuration is invalid.
    """
    if isinstance(vehicle, Mapping):
        vehicle = load_vehicle_file(vehicle)
    if isinstance(mission, Mission):
        if vehicle is None and not settings:
            return mission
        own = mission.vehicle_as_written()
        base = load_vehicle(vehicle) if isinstance(vehicle, str | Path) else vehicle or own
        return mission.replace({"vehicle": _with_settings(base, settings)})
    if isinstance(vehicle, VehicleConfig):
        return mission_files.load_mission(mission, _with_settings(vehicle, settings))
    return mission_files.load_mission(mission, vehicle, settings)


def _with_settings(vehicle: VehicleConfig, settings: Sequence[str]) -> VehicleConfig:
    if not settings:
        return vehicle
    document = Document.from_tree(vehicle.to_dict())
    apply_settings(settings, document)
    return parse_vehicle(document)


# --- flights --------------------------------------------------------------------------------------------


class Flight:
    """A simulated flight.

    Attributes:
        mission: the mission that was flown.
        verdict: the result, with the fields of `dry-run --json`.
    """

    def __init__(self, mission: Mission, verdict: Verdict, record: FlightRecord) -> None:
        self.mission, self.verdict, self._record = mission, verdict, record

    @cached_property
    def log(self) -> Log:
        """The records of the flight by topic, such as `log["/estimate/force"].force_mission`.

        Without `log_dir` the log takes about ten megabytes of memory.
        """
        return self._record.log

    def show(self, height: int = 600) -> None:
        """Show the playback below a notebook's cell or, from a script, in the browser; `height` is in pixels.

        Raises:
            InputError: viser (extra `studio`) is missing, or the vehicle did not take off.
        """
        from dart_flight.lab.studio.scene_page import show_flight  # noqa: PLC0415  (an extra)

        show_flight(self.log, height)

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
    """Fly a mission in simulated time, like `dry-run --fast`; the same seed gives the same flight.

    Args:
        mission: a mission, or a file or mapping for `load_mission`.
        seed: seed of the sensor noise and of the random differences (`vary`).
        vary: properties in which the simulated world differs at random from the mission (docs/draws.md):
            `"all"`, `["mass", "contact=0.3"]`, or standard deviations by name.
        fault: a fault to inject, `NAME[=VALUE][@PHASE]` (docs/faults.md).
        log_dir: folder in which a folder for the log is created; by default the log is kept in memory.

    Raises:
        InputError: the mission cannot be flown, the seed is not a whole number, `vary` contains an unknown
            name, or the fault is unknown.
    """
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or not 0 <= seed < 2**31:
        raise InputError(f"expected a whole number from 0 to {2**31 - 1}, not {seed!r}", key=("seed",))
    mission = load_mission(mission)
    refuse_unflyable(mission)
    spreads = parse_vary(_settings_of(vary), mission.vehicle)
    broken = parse_mission_fault(mission, fault) if isinstance(fault, str) else fault
    folder = None if log_dir is None else Path(log_dir)
    records: list[FlightRecord] = []
    keep = records.append
    verdict = fly_fast(mission, int(seed), folder, fault=broken, spreads=spreads, keep_record=keep)
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
) -> WallContact[float]: ...  # fmt: skip
@overload
def predict(
    vehicle: VehicleConfig, surface: str, mode: str, normal_m_s: Numbers,
    tangential_m_s: float | Numbers = 0.0, *, onset: str | None = None, incidence_deg: float = 0.0,
) -> WallContact[Array]: ...  # fmt: skip
@overload
def predict(
    vehicle: VehicleConfig, surface: str, mode: str, normal_m_s: float,
    tangential_m_s: Numbers, *, onset: str | None = None, incidence_deg: float = 0.0,
) -> WallContact[Array]: ...  # fmt: skip
def predict(
    vehicle: VehicleConfig,
    surface: str,
    mode: str,
    normal_m_s: float | Numbers,
    tangential_m_s: float | Numbers = 0.0,
    *,
    onset: str | None = None,
    incidence_deg: float = 0.0,
) -> WallContact[float] | WallContact[Array]:
    """Return the outcome of a wall hit in closed form (paper, Sec. IV-B).

    Args:
        vehicle: supplies the mass and the materials.
        surface: one of the vehicle's materials.
        mode: `rigid` or `flexible`.
        normal_m_s: velocity at the onset along the wall's outward normal, negative towards the wall, m/s. If
            it is an array, the results are arrays.
        tangential_m_s: velocity at the onset along the wall, m/s; broadcasts with `normal_m_s`.
        onset: onset rule, `lcp` or `touch`; by default the configuration's rule.
        incidence_deg: angle between the leading edge and the wall, 0 to 45 degrees.

    Returns:
        A `contact.contact_map.WallContact`: `normal_out_m_s`, `peak_normal_force_n`, `contact_time_s`, ...

    Raises:
        InputError: the surface, the mode or the onset is unknown, or a velocity does not point
            towards the wall.
    """
    condition = prediction.condition(vehicle, surface, mode, onset, incidence_deg)
    normal, tangential = np.asarray(normal_m_s, dtype=float), np.asarray(tangential_m_s, dtype=float)
    for pair in np.broadcast(normal, tangential):
        prediction.refuse_hit(*map(float, pair))
    if normal.ndim == 0 and tangential.ndim == 0:
        return collide(
            condition.coefficients, condition.mass_kg, float(normal), float(tangential), condition.onset
        )
    table = CoefficientArrays.from_table([condition.coefficients])
    rows = np.zeros(np.broadcast(normal, tangential).shape, dtype=np.intp)
    return contact_map(table, condition.mass_kg, normal, tangential, condition.onset, rows=rows)


def predict_drop(
    vehicle: VehicleConfig, surface: str, mode: str, height_m: float, *, onset: str | None = None
) -> Drop[float]:
    """Return the outcome of a drop from rest; the vehicle falls `height_m` before it touches the ground.

    Raises:
        InputError: an argument is invalid (see `predict`), or the height is not above 0 and at most 100 m.
    """
    condition = prediction.condition(vehicle, surface, mode, onset, 0.0)
    prediction.drop_contact(condition, height_m)  # raises InputError if the height is out of range
    return drop(condition.coefficients, condition.mass_kg, height_m, condition.onset)


# --- planning -------------------------------------------------------------------------------------------


class PlanResult:
    """The result of a search for plans.

    Attributes:
        search: the complete result, with counts, rejections and all feasible candidates.
    """

    def __init__(self, result: SearchResult) -> None:
        self.search = result

    @property
    def plans(self) -> Sequence[Plan]:
        """The best plans, in order."""
        return self.search.plans

    @property
    def mission(self) -> Mission:
        """The best plan as a mission that can be flown."""
        return self.mission_of(1)

    def mission_of(self, rank: int) -> Mission:
        """Return the plan with a given rank as a mission; rank 1 is the best.

        Raises:
            InputError: no plan has this rank.
        """
        scenario = self.search.scenario
        text = mission_text(scenario, self._plan(rank), Path("plan.yaml"))
        mission = mission_files.parse_mission(Document(text, "<plan>"), scenario.vehicle)
        return msgspec.structs.replace(mission, vehicle_source=scenario.vehicle_source)

    def write(self, path: str | Path, rank: int = 1, *, verify: bool = True) -> Path:
        """Write a plan as a mission file.

        If a script has changed the vehicle of the scenario, the changes are not written.

        Args:
            path: the file to write.
            rank: rank of the plan; 1 is the best.
            verify: whether to fly the plan in simulation first and write the results under the key `flown`.
                The 21 flights take half a minute in this process.

        Raises:
            InputError: the file cannot be written, or no plan has this rank.
        """
        plan, scenario = self._plan(rank), self.search.scenario
        record = fly_mission(planned_mission(scenario, plan), fly=fly_in_process).record if verify else None
        write_mission(scenario, plan, Path(path), record)
        return Path(path)

    def _plan(self, rank: int) -> Plan:
        if not 1 <= rank <= len(self.plans):
            raise InputError(f"plan {rank} does not exist, expected 1 to {len(self.plans)}", key=("rank",))
        return self.plans[rank - 1]


def load_scenario(
    scenario: Written, vehicle: VehicleConfig | str | Path | None = None, settings: Sequence[str] = ()
) -> Scenario:
    """Load a scenario, the input of the planner, from a file or from a mapping with its content.

    Args:
        scenario: the file or the mapping.
        vehicle: the configuration to use instead of the scenario's configuration.
        settings: `KEY=VALUE` settings of the configuration, as with `--set`.

    Raises:
        InputError: the scenario or the configuration is invalid.
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
    within_s: float = 60.0,
) -> PlanResult:
    """Choose walls, velocities and modes for a scenario.

    Args:
        scenario: a scenario, or a file or mapping for `load_scenario`.
        vehicle: the configuration to use instead of the scenario's configuration.
        objective: `nearest`, `fastest`, `gentlest`, `robust` or `quickest`; default: that of the scenario.
        top: number of plans to keep.
        seed: seed of the random sets of values that the objective `robust` evaluates.
        within_s: time limit of the search with the objective `quickest`.

    Raises:
        InputError: the scenario is invalid or has no feasible plan; the message names the most frequent
            reason for rejection.
    """
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(scenario, vehicle)
    elif vehicle is not None:
        raise InputError(
            "a loaded scenario already has a vehicle: pass another vehicle to load_scenario", key=("vehicle",)
        )
    if objective is not None:
        if objective not in list(Objective):
            raise InputError(f"{objective!r} is not one of {', '.join(Objective)}", key=("objective",))
        scenario = with_objective(scenario, Objective(objective))
    if scenario.objective is Objective.QUICKEST:
        return PlanResult(plan_quickest(scenario, within_s))
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
    """Identify contact coefficients from recorded trials at one wall; requires SciPy (extra `identify`).

    Args:
        trials: files (CSV, PX4 ULog, flight log), folders of flight logs, flights, logs, or `Trial`s made
            from your own arrays.
        vehicle: supplies the mass and the onset rule; default `load_vehicle()`. The trials of a flight
            log use the configuration in the log.
        mode: state of the arms, for trials that do not record it. From flights, only collisions in this mode
            are used.
        surface: material; from flights, only collisions with this material are used.
        drop: whether the trials are drops. A number is the height of the drops, m.
        onset: onset rule, `lcp` or `touch`; by default the vehicle's rule.
        contact_distance_m: distance that is subtracted from the column `normal_m` of files, m.
        columns: our column name -> header in the CSV files.
        wall: for PX4 logs, the north and east position (m) of the vehicle's centre when the vehicle touches
            the wall, and the heading of the wall's outward normal (degrees).
        mass_kg: vehicle mass to use instead of the configuration's.

    Raises:
        InputError: SciPy is missing, a trial or an option is invalid, or a flight has collisions with several
            materials and `surface` is not given.
    """
    given = list(trials) if isinstance(trials, Sequence) and not isinstance(trials, str) else [trials]
    vehicle = vehicle or load_vehicle()
    if mode not in (None, "rigid", "flexible"):
        raise InputError(f"{mode!r} is not allowed, only: rigid, flexible", key=("mode",))
    reading = TrialReading(
        mode=mode or UNLABELLED,
        surface=surface,
        drop=drop is not False,
        height_m=None if isinstance(drop, bool) else drop,
        contact_distance_m=contact_distance_m,
        columns=columns_of(",".join(f"{name}={header}" for name, header in (columns or {}).items())),
        wall=wall,
        mass_kg=mass_kg,
    )
    own = [trial for source in given for trial in _trials_in(source, surface, reading.mode)]
    paths = [str(source) for source in given if isinstance(source, str | Path)]
    rule = None if onset is None else prediction.onset_rule(vehicle, onset)
    return identify_trials(paths, reading, vehicle, onset=rule, given=own).found


def _trials_in(source: Source, surface: str | None, mode: str) -> list[Trial]:
    """Return the trials that a `Trial`, flight or log contains; return an empty list for a file."""
    if isinstance(source, Trial):
        return [source]
    if isinstance(source, Flight):
        source = source.log
    return trials_at_one(source, surface, mode) if isinstance(source, Log) else []


__all__ = [
    "Flight",
    "FlightSetpoint",
    "Identification",
    "InputError",
    "Log",
    "Mission",
    "PlanResult",
    "Simulation",
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
