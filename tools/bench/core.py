"""Benchmark of whole simulated flights and their parts: the core's step, plant and autopilot.

    python -m tools.bench.core

The measurement runs in separate processes, with the source tree and, after `make compiled`, with the compiled
package (docs/speed.md).
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

import msgspec

from dart_flight.base.records import (
    ClockOffset,
    ImuSample,
    Input,
    Mode,
    Setpoint,
    TruthSample,
    VehicleAction,
    VehicleCommand,
    World,
)
from dart_flight.config.mission import Mission, load_mission
from dart_flight.core.flight_core import FlightCore
from dart_flight.run.fast import FLIGHT_MODES, FastFlight, simulated_driver
from dart_flight.run.flight_record import FlightRecord
from dart_flight.sim.cascade import TrajectorySetpoint
from dart_flight.sim.simulated_vehicle import SimulatedVehicle

ROOT = Path(__file__).parents[2]
COMPILED = ROOT / "build" / "compiled"
MISSIONS = (
    "paper_dual_collision",
    "dual_collision_replan",
    "paper_single_wall",
)  # two walls with recovery setpoints, two walls with replanning, one wall
_REPEATS = 5
_CHUNK = 50  # number of inputs or ticks in a timed piece of work
_NAN3 = (float("nan"),) * 3
_KINDS = get_args(Input)


class Figures(msgspec.Struct):
    """The figures of one process, in seconds; all except `flown_s` are processor times.

    Attributes:
        compiled: whether the core was compiled.
        flight_s: time of a flight with its verdict, without a log, by mission.
        flown_s: simulated duration of the flight, by mission.
        step_s: time of one step of the core, averaged over all inputs of a flight.
        imu_step_s: time of one step with an IMU sample.
        vehicle_s: time of plant and autopilot in one dual collision.
    """

    compiled: bool
    flight_s: dict[str, float]
    flown_s: dict[str, float]
    step_s: float
    imu_step_s: float
    vehicle_s: float


class _Recorded(NamedTuple):
    """The inputs of core and vehicle in a flight; `orders` lists the orders that arrived after each tick."""

    inputs: list[Input]
    orders: dict[int, list[Setpoint | VehicleCommand | Mode]]
    ticks: int


def measure() -> Figures:
    """Measure in this process, with the package that it imports."""
    missions = {name: load_mission(ROOT / "missions" / f"{name}.yaml") for name in MISSIONS}
    dual = missions[MISSIONS[0]]
    recorded = _record(dual)
    flown = {name: _flown_s(mission) for name, mission in missions.items()}
    return Figures(
        not str(sys.modules[FlightCore.__module__].__file__).endswith(".py"),
        {name: _sum_of_shortest_s(partial(_fly, mission)) for name, mission in missions.items()},
        flown,
        _sum_of_shortest_s(partial(_step, dual, recorded.inputs)) / len(recorded.inputs),
        _imu_step_s(dual, recorded.inputs),
        _sum_of_shortest_s(partial(_drive, dual, recorded)),
    )


def _sum_of_shortest_s(times_of: Callable[[], list[float]]) -> float:
    """Run the same pieces of work several times; return the sum of the shortest time of every piece.

    Other load on the machine rarely delays the same piece in every run.
    """
    runs = [times_of() for _ in range(_REPEATS)]
    return float(sum(min(pieces) for pieces in zip(*runs, strict=True)))


def _fly(mission: Mission) -> list[float]:
    clock, times = time.process_time, []
    begin = clock()
    record = FlightRecord(mission, World.FAST, 1, None)
    flight = FastFlight(mission, 1, observe=record)
    flight.step(ClockOffset(flight.host_us, 0))
    if flight.lock is not None:
        flight.lock.start()
    core, tick = flight.core, flight.tick
    while core.end is None:
        for _ in range(_CHUNK):
            if core.end is None:
                tick()
        times.append(clock() - begin)
        begin = clock()
    record.build()
    return [*times, clock() - begin]


def _flown_s(mission: Mission) -> float:
    flight = FastFlight(mission, 1)
    flight.run()
    return flight.autopilot.now_s


def _record(mission: Mission) -> _Recorded:
    inputs: list[Input] = []
    orders: dict[int, list[Setpoint | VehicleCommand | Mode]] = {}

    def observe(record: Any, number: int) -> None:
        tick = round(flight.autopilot.now_s / 0.004)
        if isinstance(record, _KINDS):
            inputs.append(record)
        elif isinstance(record, Setpoint | VehicleCommand):
            orders.setdefault(tick, []).append(record)
        elif isinstance(record, TruthSample):
            orders.setdefault(tick, []).append(record.mode)

    flight = FastFlight(mission, 1, observe=observe)
    flight.run()
    return _Recorded(inputs, orders, round(flight.autopilot.now_s / 0.004))


def _step(mission: Mission, inputs: list[Input]) -> list[float]:
    clock, times, step = time.process_time, [], FlightCore(mission).step
    for first in range(0, len(inputs), _CHUNK):
        part = inputs[first : first + _CHUNK]
        begin = clock()
        for item in part:
            step(item)
        times.append(clock() - begin)
    return times


def _imu_step_s(mission: Mission, inputs: list[Input]) -> float:
    """Return the time of a step with an IMU sample, including force estimate, detector and pulse fit."""

    def times_of() -> list[float]:
        clock, times, step = time.process_time, [], FlightCore(mission).step
        for item in inputs:
            if isinstance(item, ImuSample):
                begin = clock()
                step(item)
                times.append(clock() - begin)
            else:
                step(item)
        return times

    return _sum_of_shortest_s(times_of) / sum(isinstance(item, ImuSample) for item in inputs)


def _drive(mission: Mission, recorded: _Recorded) -> list[float]:
    """Simulate the vehicle with the recorded orders and without a core; return the times of its ticks."""
    clock, times = time.process_time, []
    vehicle = SimulatedVehicle(mission, 1, simulated_driver(mission))
    autopilot, advance = vehicle.autopilot, vehicle.advance
    for first in range(1, recorded.ticks + 1, _CHUNK):
        begin = clock()
        for tick in range(first, min(first + _CHUNK, recorded.ticks + 1)):
            advance()
            for order in recorded.orders.get(tick, ()):
                if isinstance(order, Mode):
                    autopilot.plant.set_mode(order)
                elif isinstance(order, Setpoint):
                    autopilot.set_trajectory(
                        TrajectorySetpoint(
                            order.position_ned,
                            order.velocity_ned or _NAN3,
                            order.acceleration_ned or _NAN3,
                            order.yaw_ned_rad,
                        )
                    )
                elif order.action is VehicleAction.ARM:
                    autopilot.arm()
                elif order.action in FLIGHT_MODES:
                    autopilot.set_mode(FLIGHT_MODES[order.action])
        times.append(clock() - begin)
    return times


def measure_package(package: Path) -> Figures:
    """Return the figures of a process that imports the package from this folder."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(package), str(ROOT)))}
    command = [sys.executable, "-P", "-c", "from tools.bench.core import print_figures; print_figures()"]
    done = subprocess.run(command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, check=True)
    return msgspec.json.decode(done.stdout, type=Figures)


def print_figures() -> None:
    """Measure in this process and print the figures as JSON."""
    print(msgspec.json.encode(measure()).decode())


def rows() -> list[dict[str, Any]]:
    """Return rows for the benchmark table.

    `core step` is the processor time of one step, averaged over a whole flight's inputs, in microseconds;
    `core step imu` averages over the IMU samples alone. `plant and autopilot` is the processor time of one
    dual collision in seconds. `fast flight` is the processor time of one flight with its verdict, without a
    log. Its baseline is the simulated time, so the ratio is a multiple of real time. For the compiled
    package, the baseline of the parts is the interpreted package.
    """
    pure = measure_package(ROOT)
    found = _rows_of(pure, None)
    if COMPILED.exists():
        found += _rows_of(measure_package(COMPILED), pure)
    return found


def _rows_of(figures: Figures, pure: Figures | None) -> list[dict[str, Any]]:
    if figures.compiled is (pure is None):
        raise RuntimeError("expected one interpreted and one compiled package, but got the same kind twice")
    suffix = "" if pure is None else ", compiled"
    parts = [
        ("core step", figures.step_s, 1e6, "us", pure and pure.step_s),
        ("core step imu", figures.imu_step_s, 1e6, "us", pure and pure.imu_step_s),
        ("plant and autopilot", figures.vehicle_s, 1.0, "s", pure and pure.vehicle_s),
    ]
    found = [
        {
            "name": name + suffix,
            "value": value * per,
            "unit": unit,
            "baseline": before * per if before else None,
            "ratio": before / value if before else None,
        }
        for name, value, per, unit, before in parts
    ]
    for name, processor_s in figures.flight_s.items():
        flown_s = figures.flown_s[name]
        found.append(
            {
                "name": f"fast flight {name}{suffix}",
                "value": processor_s,
                "unit": "s",
                "baseline": flown_s,
                "ratio": flown_s / processor_s,
            }
        )
    return found


if __name__ == "__main__":
    for row in rows():
        print(row)
