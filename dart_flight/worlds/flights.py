"""Whole flights, one function per world: set up, fly, clean up, return the verdict.

What the commands, the tests and the campaigns call. Every flight leaves a folder with its log.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.parameters import PositionSource
from dart_flight.config.scenario import Scenario
from dart_flight.config.vehicle import LockDriver, Px4Parameters
from dart_flight.core.flight_core import FlightCore
from dart_flight.core.mission.approach import NoApproachError
from dart_flight.lock.drivers.mock import MockFaults
from dart_flight.planning.envelope import impact_problem
from dart_flight.planning.positioning import frame_problem
from dart_flight.recording.about import describe_flight
from dart_flight.recording.px4_log import read_px4_log
from dart_flight.recording.writer import FlightLog, new_flight_folder
from dart_flight.samples import Record
from dart_flight.vehicle.clock import Clock, LockstepClock
from dart_flight.verdict import Verdict, VerdictBuilder
from dart_flight.worlds.app import FlightApp, Progress
from dart_flight.worlds.app import Sabotage as SabotageHook

if TYPE_CHECKING:  # simulation is an extra
    from dart_flight.sim.faults.kinds import Fault
    from dart_flight.worlds.vehicle_process import WorldProcess

LOG_NAME = "flight.mcap"
DEADMAN_NOTE = "deadman.txt"
_LOCKSTEP_PAUSE_S = 0.5


def load_flyable(path: str | Path, config: str | Path | None = None) -> Mission:
    """Load a mission and make sure that its approaches have room and its impacts keep to its limit.

    Raises:
        InputError: the file is wrong, an approach cannot be flown, or an impact is over the force limit.
    """
    mission = load_mission(path, config)
    try:
        FlightCore(mission)
    except NoApproachError as error:
        raise InputError(str(error), source=str(path)) from None
    problem = impact_problem(mission)
    if problem is not None:
        raise InputError(problem, source=str(path))
    return mission


def with_driver(mission: Mission, driver: LockDriver) -> Mission:
    """The mission with another lock driver."""
    lock = msgspec.structs.replace(mission.vehicle.lock, driver=driver)
    vehicle = msgspec.structs.replace(mission.vehicle, lock=lock)
    return msgspec.structs.replace(mission, vehicle=vehicle)


def with_standoff(mission: Mission, standoff_m: float) -> Mission:
    """The mission's rehearsal: every contact replaced by stopping so far before the wall.

    Raises:
        InputError: not a distance from 0.1 to 2 m.
    """
    if not 0.1 <= standoff_m <= 2.0:
        raise InputError(f"{standoff_m:g} m, allowed is 0.1 to 2 m", key=("--standoff",))
    return msgspec.structs.replace(mission, standoff_m=standoff_m)


def with_vehicle_parameters(scenario: Scenario, url: str) -> Scenario:
    """The scenario with the PX4 parameters that the vehicle at a connection really has.

    Raises:
        VehicleError: nothing answers, or it has none of the parameters.
        InputError: one of them is out of the range that the flight model can take.
    """
    from dart_flight.vehicle.ground_link import GroundLink  # noqa: PLC0415
    from dart_flight.vehicle.session import VehicleError  # noqa: PLC0415

    vehicle = scenario.vehicle
    own = msgspec.to_builtins(vehicle.px4)
    with GroundLink(url, vehicle.connection.timeout_s) as link:
        found = link.read_parameters(own)
    if not found:
        raise VehicleError(f"the vehicle on {url} tells none of its parameters")
    try:
        px4 = msgspec.convert({**own, **found}, Px4Parameters)
    except msgspec.ValidationError as error:
        raise InputError(f"the vehicle's parameters: {error}", source=url) from None
    return msgspec.structs.replace(scenario, vehicle=msgspec.structs.replace(vehicle, px4=px4))


def _open_log(mission: Mission, world: str, seed: int | None, log_dir: Path) -> FlightLog:
    try:
        path = new_flight_folder(log_dir, mission.name) / LOG_NAME
        return FlightLog(path, describe_flight(mission, world, seed))
    except OSError as error:
        raise InputError(f"cannot write the flight log: {error.strerror}", source=str(log_dir)) from None


def _relative(path: Path) -> str:
    with contextlib.suppress(ValueError):
        return str(path.resolve().relative_to(Path.cwd()))
    return str(path)


def fly_fast(
    mission: Mission,
    seed: int,
    log_dir: Path | None,
    progress: Progress = lambda record: None,
    lock_faults: MockFaults | None = None,
    fault: Fault | None = None,
) -> Verdict:
    """Fly in process in simulated time; `log_dir` None leaves no log (campaigns).

    `lock_faults` are those of the mock servo from the start on; `fault` is what goes wrong, and when.

    Raises:
        InputError: the log cannot be written, or the lock driver has no place in simulated time.
    """
    from dart_flight.worlds.fast import FastFlight  # noqa: PLC0415  (only simulation needs it)

    driver = mission.vehicle.lock.driver
    if driver not in (LockDriver.MOCK, LockDriver.PX4):
        raise InputError(f"the lock driver {driver.value} cannot be simulated, only mock and px4")
    verdict = VerdictBuilder(mission)
    log = _open_log(mission, "fast", seed, log_dir) if log_dir is not None else None

    def observe(record: Record, number: int) -> None:
        verdict.take(record)
        progress(record)
        if log is not None:
            log.put(record, number)

    FastFlight(mission, seed, driver, faults=lock_faults, observe=observe, fault=fault).run()
    if log is not None:
        log.close()
    return verdict.build("fast", seed, _relative(log.path) if log is not None else None)


def fly_embedded(
    mission: Mission,
    seed: int,
    log_dir: Path,
    progress: Progress = lambda record: None,
    *,
    deadman: bool = False,
    fault: Fault | None = None,
) -> Verdict:
    """Fly through MAVSDK over UDP against the embedded autopilot, in real time.

    `deadman` starts the process that kills this one when it hangs; `fault` is what goes wrong.

    Raises:
        InputError: the log cannot be written.
        WorldError, VehicleError: the simulated vehicle did not start or did not answer.
    """
    try:
        from dart_flight.sim.pipe import WorldSpec  # noqa: PLC0415
        from dart_flight.worlds.sabotage import Sabotage  # noqa: PLC0415
        from dart_flight.worlds.vehicle_process import EmbeddedWorld, free_udp_port, world_log  # noqa: PLC0415
    except ImportError as error:
        raise InputError(f"simulation needs {error.name}: pip install 'dart-flight[sim]'") from None

    port = free_udp_port()
    log = _open_log(mission, "embedded", seed, log_dir)
    spec = WorldSpec(
        mission.source,
        msgspec.json.encode(mission.vehicle).decode(),
        seed,
        [port],
        mission.vehicle.lock.driver,
        world_log(log.path.parent),
    )
    verdict, _ = _fly_in_world(
        mission,
        log,
        lambda on_truth: EmbeddedWorld(spec, on_truth),
        port,
        progress,
        deadman=deadman,
        saboteur=None if fault is None else lambda world: Sabotage(fault, world, log.path),
    )
    return verdict.build("embedded", seed, _relative(log.path))


def fly_px4(
    mission: Mission,
    directory: str | Path | None,
    seed: int,
    log_dir: Path,
    progress: Progress = lambda record: None,
    *,
    gps: str | None = None,
    speed: float = 1.0,
    parameter_files: tuple[Path, ...] = (),
) -> Verdict:
    """Fly through MAVSDK over UDP against a real PX4 SITL on our plant, in lockstep.

    Args:
        mission: what to fly.
        directory: PX4's, with bin and etc; None: the environment's DART_PX4_DIR.
        seed: of the sensors' noise.
        log_dir: where the flight's folder goes; PX4's ULog is kept in it as `px4.ulg`.
        progress: sees every record.
        gps: `rtk` or `plain`; None: indoors, motion capture and no GPS.
        speed: simulated seconds per second.
        parameter_files: PX4 parameters on top of `configs/px4/`.

    Raises:
        InputError: there is no PX4, a parameter file is wrong, or the mission's frame cannot be had with GPS.
        WorldError, VehicleError: PX4 did not start or did not answer.
    """
    try:
        from dart_flight.sim.pipe import Px4Spec, WorldSpec  # noqa: PLC0415
        from dart_flight.sim.px4.launch import find_install, flight_parameters  # noqa: PLC0415
        from dart_flight.worlds.vehicle_process import Px4World, world_log  # noqa: PLC0415
    except ImportError as error:
        raise InputError(f"simulation needs {error.name}: pip install 'dart-flight[sim]'") from None

    install = find_install(directory)
    problem = frame_problem(mission, PositionSource(gps or "mocap"))
    if problem is not None:
        raise InputError(problem, source=mission.source, key=("frame", "origin"))
    mission = _for_lockstep(mission, speed)
    parameters = flight_parameters(mission.vehicle, gps, list(parameter_files))
    log = _open_log(mission, "px4", seed, log_dir)
    folder = log.path.parent
    spec = WorldSpec(
        mission.source,
        msgspec.json.encode(mission.vehicle).decode(),
        seed,
        [],
        mission.vehicle.lock.driver,
        world_log(folder),
        Px4Spec(str(install.program.parents[1]), str(folder.resolve()), parameters, gps, speed),
    )
    verdict, world = _fly_in_world(
        mission, log, lambda on_truth: Px4World(spec, on_truth), None, progress, LockstepClock(speed)
    )
    ulog = folder / "px4.ulg"
    kept = _relative(ulog) if ulog.exists() else None
    built = verdict.build("px4", seed, _relative(log.path), kept)
    built.px4 = read_px4_log(ulog, world.version)
    return built


def _for_lockstep(mission: Mission, speed: float) -> Mission:
    """The mission with a guard that lets the simulator pause.

    In lockstep a stall of the machine stops the vehicle's time, too: silence counts from half a second of
    vehicle time on, where the configuration's limit is shorter.
    """
    guard = mission.vehicle.guard
    timeout_s = max(guard.stream_timeout_s, _LOCKSTEP_PAUSE_S / speed)
    guard = msgspec.structs.replace(guard, stream_timeout_s=timeout_s)
    vehicle = msgspec.structs.replace(mission.vehicle, guard=guard)
    return msgspec.structs.replace(mission, vehicle=vehicle)


def _fly_in_world(
    mission: Mission,
    log: FlightLog,
    make_world: Callable[[Callable[[Record], None]], WorldProcess],
    port: int | None,
    progress: Progress,
    clock: Clock | None = None,
    *,
    deadman: bool = False,
    saboteur: Callable[[WorldProcess], SabotageHook] | None = None,
) -> tuple[VerdictBuilder, WorldProcess]:
    """Start a world, fly in it, end it; closes the log. `port` None: the world says where it sends to."""
    verdict = VerdictBuilder(mission)

    def on_truth(record: Record) -> None:
        log.put(record, 0)
        verdict.take(record)

    try:
        world = make_world(on_truth)
        try:
            world.wait_ready()
            where = port if port is not None else world.port
            note = log.path.with_name(DEADMAN_NOTE) if deadman else None
            sabotage = None if saboteur is None else saboteur(world)
            url = f"udpin://127.0.0.1:{where}"
            app = FlightApp(mission, url, log, verdict, world, progress, clock, note, sabotage)
            asyncio.run(app.run())
        finally:
            world.close()
    finally:
        log.close()
    return verdict, world


def fly_vehicle(
    mission: Mission,
    url: str,
    log_dir: Path,
    progress: Progress = lambda record: None,
    sabotage: SabotageHook | None = None,
) -> Verdict:
    """Fly on whatever answers at a connection URL, with a deadman.

    `sabotage` breaks the app from inside; for tests.

    Raises:
        InputError: the log cannot be written.
        VehicleError: nothing answers.
    """
    log = _open_log(mission, "drone", None, log_dir)
    verdict = VerdictBuilder(mission)
    try:
        note = log.path.with_name(DEADMAN_NOTE)
        asyncio.run(FlightApp(mission, url, log, verdict, None, progress, None, note, sabotage).run())
    finally:
        log.close()
    return verdict.build("drone", None, _relative(log.path))


# --- many flights ------------------------------------------------------------------------------------


class Spread(msgspec.Struct):
    """A figure over many flights."""

    median: float
    low: float
    high: float


class Summary(msgspec.Struct):
    """Many flights of one mission in a few figures."""

    runs: int
    completed: int
    reasons: dict[str, int]
    goal_miss_m: Spread | None
    final_error_m: Spread | None
    max_tilt_deg: Spread | None
    peak_force_error_percent: Spread | None


def _fast_run(arguments: tuple[Mission, int, str | None]) -> Verdict:
    mission, seed, log_dir = arguments
    return fly_fast(mission, seed, Path(log_dir) if log_dir else None)


def fly_fast_many(
    mission: Mission, seeds: Iterable[int], log_dir: Path | None, done: Callable[[Verdict], None]
) -> list[Verdict]:
    """Many fast flights, spread over the processor's cores, in the order of the seeds."""
    jobs = [(mission, seed, str(log_dir) if log_dir else None) for seed in seeds]
    verdicts = []
    with ProcessPoolExecutor() as pool:
        for verdict in pool.map(_fast_run, jobs):
            done(verdict)
            verdicts.append(verdict)
    return verdicts


def summarise(verdicts: list[Verdict]) -> Summary:
    """Counts and spreads over many flights."""
    reasons: dict[str, int] = {}
    for v in verdicts:
        if v.reason is not None:
            rule = v.reason.split(":")[0]
            reasons[rule] = reasons.get(rule, 0) + 1
    return Summary(
        runs=len(verdicts),
        completed=sum(v.outcome == "completed" for v in verdicts),
        reasons=reasons,
        goal_miss_m=_spread(v.goal_miss_m for v in verdicts),
        final_error_m=_spread(v.final_error_m for v in verdicts),
        max_tilt_deg=_spread(v.max_tilt_deg for v in verdicts),
        peak_force_error_percent=_spread(_force_errors(verdicts)),
    )


def _force_errors(verdicts: list[Verdict]) -> Iterator[float]:
    for v in verdicts:
        for c in v.collisions:
            measured = c.measured.peak_force_n
            true = c.truth.peak_force_n if c.truth else None
            if measured is not None and true:
                yield 100.0 * (measured / true - 1.0)


def _spread(values: Iterable[Any]) -> Spread | None:
    known = sorted(v for v in values if v is not None)
    if not known:
        return None
    return Spread(known[len(known) // 2], known[0], known[-1])
