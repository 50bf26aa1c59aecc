"""Whole flights, one function per world: set up, fly, clean up, return the verdict.

What the commands, the tests and the campaigns call. Every flight leaves a folder with its log.
"""

from __future__ import annotations

import asyncio
import contextlib
import platform
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.app import FlightApp, Progress
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.flight.core import FlightCore
from dart_flight.lock.drivers.mock import MockFaults
from dart_flight.planning.approach import NoApproachError
from dart_flight.recording.writer import FlightLog, new_flight_folder
from dart_flight.samples import Record
from dart_flight.verdict import Verdict, VerdictBuilder

LOG_NAME = "flight.mcap"


def load_flyable(path: str | Path, config: str | Path | None = None) -> Mission:
    """Load a mission and make sure that its approaches have room.

    Raises:
        InputError: the file is wrong, or an approach cannot be flown.
    """
    mission = load_mission(path, config)
    try:
        FlightCore(mission)
    except NoApproachError as error:
        raise InputError(str(error), source=str(path)) from None
    return mission


def with_driver(mission: Mission, driver: LockDriver) -> Mission:
    """The mission with another lock driver."""
    lock = msgspec.structs.replace(mission.vehicle.lock, driver=driver)
    vehicle = msgspec.structs.replace(mission.vehicle, lock=lock)
    return msgspec.structs.replace(mission, vehicle=vehicle)


def _open_log(mission: Mission, world: str, seed: int | None, log_dir: Path) -> FlightLog:
    about = {"mission": mission.name, "mission_source": mission.source, "world": world}
    about["seed"] = "" if seed is None else str(seed)
    about["host"] = f"{platform.node()} {platform.machine()} Python {platform.python_version()}"
    about["vehicle"] = msgspec.json.encode(mission.vehicle).decode()
    with contextlib.suppress(OSError):
        about["mission_text"] = Path(mission.source).read_text(encoding="utf-8")
    try:
        return FlightLog(new_flight_folder(log_dir, mission.name) / LOG_NAME, about)
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
) -> Verdict:
    """Fly in process in simulated time; `log_dir` None leaves no log (campaigns).

    `lock_faults` are those of the mock servo.

    Raises:
        InputError: the log cannot be written, or the lock driver has no place in simulated time.
    """
    from dart_flight.sim.fast import FastFlight  # noqa: PLC0415  (only simulation needs it)

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

    FastFlight(mission, seed, driver, faults=lock_faults, observe=observe).run()
    if log is not None:
        log.close()
    return verdict.build("fast", seed, _relative(log.path) if log is not None else None)


def fly_embedded(
    mission: Mission, seed: int, log_dir: Path, progress: Progress = lambda record: None
) -> Verdict:
    """Fly through MAVSDK over UDP against the embedded autopilot, in real time.

    Raises:
        InputError: the log cannot be written.
        WorldError, VehicleError: the simulated vehicle did not start or did not answer.
    """
    try:
        from dart_flight.sim.harness import EmbeddedWorld, free_udp_port, world_log  # noqa: PLC0415
        from dart_flight.sim.process import WorldSpec  # noqa: PLC0415
    except ImportError as error:
        raise InputError(f"simulation needs {error.name}: pip install 'dart-flight[sim]'") from None

    driver = mission.vehicle.lock.driver
    port = free_udp_port()
    log = _open_log(mission, "embedded", seed, log_dir)
    verdict = VerdictBuilder(mission)

    def on_truth(record: Record) -> None:
        log.put(record, 0)
        verdict.take(record)

    spec = WorldSpec(
        mission.source,
        msgspec.json.encode(mission.vehicle).decode(),
        seed,
        [port],
        driver,
        world_log(log.path.parent),
    )
    world = EmbeddedWorld(spec, on_truth)
    try:
        world.wait_ready()
        app = FlightApp(mission, f"udpin://127.0.0.1:{port}", log, verdict, world, progress)
        asyncio.run(app.run())
    finally:
        world.close()
        log.close()
    return verdict.build("embedded", seed, _relative(log.path))


def fly_vehicle(
    mission: Mission, url: str, log_dir: Path, progress: Progress = lambda record: None
) -> Verdict:
    """Fly on whatever answers at a connection URL.

    Raises:
        InputError: the log cannot be written.
        VehicleError: nothing answers.
    """
    log = _open_log(mission, "drone", None, log_dir)
    verdict = VerdictBuilder(mission)
    try:
        asyncio.run(FlightApp(mission, url, log, verdict, None, progress).run())
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
