"""The simulation `dart_flight.Simulation`: a script supplies the setpoint of each step (docs/python.md).

The simulation contains the vehicle of the fast world, but neither a mission nor the guard. The vehicle
consists of plant, sensors, embedded autopilot, lock servo and the force estimator of the flight core.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import Vec3, distance2, tilt_of
from dart_flight.base.records import ClockOffset, FlightMode, Mode
from dart_flight.base.walls import Wall
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.senses import Senses
from dart_flight.lock.servo import ServoModel, mode_of
from dart_flight.sim.cascade import TrajectorySetpoint
from dart_flight.sim.embedded_autopilot import TICK_S
from dart_flight.sim.simulated_vehicle import SimulatedVehicle
from dart_flight.sim.telemetry_sender import TelemetrySender

Array = NDArray[np.float64]
_NO_CONTACT: Final = ExpectedContact()
_FREE: Final = (math.nan, math.nan, math.nan)
_LONGEST_CLIMB_S: Final = 20.0
_AT_START_M, _AT_REST_M_S = 0.05, 0.05
_DOWN_RAD: Final = 0.5 * math.pi  # tilt above which the vehicle counts as turned over


class FlightSetpoint(NamedTuple):
    """A setpoint of PX4's position controller, mission frame.

    A vector that is None is not controlled. NaN in x or y of a vector frees both horizontal components, and
    NaN in z frees the vertical component. PX4 does not control free components.

    Attributes:
        position_mission, velocity_mission, acceleration_mission: m, m/s, m/s2.
        yaw_rad: heading, counter-clockwise from the mission's x axis.
        mode: mode to which the lock moves; None leaves the lock as it is.
    """

    position_mission: Vec3 | None = None
    velocity_mission: Vec3 | None = None
    acceleration_mission: Vec3 | None = None
    yaw_rad: float | None = None
    mode: Mode | None = None


class SteppedObservation(NamedTuple):
    """The state of the vehicle, as far as the companion computer can measure or estimate it.

    Attributes:
        time_s: simulated time since `reset`.
        position, velocity: estimated by the autopilot, mission frame, m and m/s, shape (3,).
        attitude: estimated quaternion (w, x, y, z), body FRD to NED, shape (4,).
        force: estimated external force, mission frame, N, shape (3,); zeros before the first estimate.
        mode: mode of the lock's horn; None while the horn moves.
        walls: walls nearer than `view_m`, nearest first, shape (n, 5). Columns: x and y of the wall's point
            (m), x and y of the wall's normal, and the free distance (m). The vehicle's centre can move this
            distance towards the wall before the vehicle touches the wall. Point and normal are in the mission
            frame.
        contacts: number of contacts that have ended since `reset`.
        is_down: whether the vehicle has landed, or has tilted by more than 90 degrees.
    """

    time_s: float
    position: Array
    velocity: Array
    attitude: Array
    force: Array
    mode: Mode | None
    walls: Array
    contacts: int
    is_down: bool


def _to_ned(vector_mission: Vec3 | None, convert: Callable[[Vec3], Vec3]) -> Vec3:
    if vector_mission is None:
        return _FREE
    x, y, z = vector_mission
    level_free, z_free = math.isnan(x) or math.isnan(y), math.isnan(z)
    north, east, down = convert((0.0 if level_free else x, 0.0 if level_free else y, 0.0 if z_free else z))
    return (
        math.nan if level_free else north,
        math.nan if level_free else east,
        math.nan if z_free else down,
    )


class SteppedSimulation:
    """A simulated vehicle in the air that advances by one period for each setpoint.

    Args:
        mission: a mission or its file, which supplies vehicle, walls and start. The mission's collisions are
            not flown.
        seed: seed of the sensors' noise.
        period_s: simulated time of one step; a multiple of 4 ms.
        view_m: largest distance at which a wall appears in the observations; by default every wall appears.

    Raises:
        InputError: the period is not a positive multiple of 4 ms, or the mission is invalid.
    """

    def __init__(
        self,
        mission: Mission | str | Path,
        seed: int = 1,
        *,
        period_s: float = 0.02,
        view_m: float = math.inf,
    ) -> None:
        self._ticks_per_step = round(period_s / TICK_S)
        if self._ticks_per_step < 1 or abs(self._ticks_per_step * TICK_S - period_s) > 1e-9:
            raise InputError(
                f"{period_s:g} s, expected a positive multiple of {TICK_S:g} s", key=("period_s",)
            )
        self.mission = mission if isinstance(mission, Mission) else load_mission(mission)
        self.period_s, self._seed, self._view_m = period_s, seed, view_m
        self.reset()

    def reset(self, seed: int | None = None) -> SteppedObservation:
        """Restart with the vehicle hovering at the mission's start, and return the first observation.

        The same seed gives the same simulation.

        Args:
            seed: new seed; by default the current seed.
        """
        self._seed = self._seed if seed is None else seed
        mission = self.mission
        self._vehicle = SimulatedVehicle(mission, self._seed, LockDriver.MOCK)
        self._autopilot = self._vehicle.autopilot
        self._senses = Senses(mission.vehicle)
        self._sender = TelemetrySender(self._vehicle)
        self._senses.update(ClockOffset(self._autopilot.time_us, 0), _NO_CONTACT)
        self._frame = self._autopilot.plant.frame
        self._senses.state.anchor(self._frame)
        self._ticks = self._contacts = 0
        self._force: Vec3 = (0.0, 0.0, 0.0)
        self._setpoint = TrajectorySetpoint()
        self._servo: ServoModel | None = None
        if mission.vehicle.lock is not None:
            config = mission.vehicle.lock.servo
            self._servo = ServoModel(config, config.pulse_us(mission.transit_mode))
        self._take_off()
        self._start_us = self._autopilot.time_us
        return self._observe()

    def step(self, setpoint: FlightSetpoint | None = None) -> SteppedObservation:
        """Advance by one period and return the observation at its end.

        Args:
            setpoint: new setpoint; None keeps the previous setpoint.
        """
        if setpoint is not None:
            self._command(setpoint)
        for _ in range(self._ticks_per_step):
            self._tick()
        return self._observe()

    def _take_off(self) -> None:
        autopilot, mission = self._autopilot, self.mission
        start = (*mission.start, mission.altitude_m)
        while not autopilot.estimator.ok:
            self._tick()
        self._command(FlightSetpoint(start))
        autopilot.set_mode(FlightMode.OFFBOARD)
        autopilot.arm()
        end_s = autopilot.now_s + _LONGEST_CLIMB_S
        while autopilot.now_s < end_s:
            self._tick()
            position = self._frame.point_from_ned(autopilot.estimator.position)
            if (
                math.dist(position, start) < _AT_START_M
                and math.hypot(*autopilot.estimator.velocity) < _AT_REST_M_S
            ):
                return

    def _command(self, s: FlightSetpoint) -> None:
        frame = self._frame
        self._setpoint = TrajectorySetpoint(
            _to_ned(s.position_mission, frame.point_to_ned),
            _to_ned(s.velocity_mission, frame.vector_to_ned),
            _to_ned(s.acceleration_mission, frame.vector_to_ned),
            math.nan if s.yaw_rad is None else frame.yaw_to_ned(s.yaw_rad),
        )
        self._autopilot.set_trajectory(self._setpoint)
        if s.mode is not None and self._servo is not None:
            self._servo.command(self._autopilot.time_us, self._servo.servo.pulse_us(s.mode))

    def _tick(self) -> None:
        autopilot = self._autopilot
        autopilot.set_trajectory(self._setpoint)  # MAVSDK also repeats the setpoint
        if self._servo is not None:
            self._vehicle.set_horn(self._servo.pulse_at(autopilot.time_us))
        self._vehicle.advance()
        self._ticks += 1
        for sample in self._sender.samples(self._ticks, autopilot.time_us):
            estimate = self._senses.update(sample, _NO_CONTACT).estimate
            if estimate is not None:
                self._force = estimate.force_mission
        self._contacts += len(autopilot.plant.finished)
        autopilot.plant.finished.clear()

    def _observe(self) -> SteppedObservation:
        estimator, frame = self._autopilot.estimator, self._frame
        position = frame.point_from_ned(estimator.position)
        mode: Mode | None = Mode.RIGID
        if self._servo is not None:
            mode = mode_of(self._servo.servo, self._servo.pulse_at(self._autopilot.time_us))
        return SteppedObservation(
            (self._autopilot.time_us - self._start_us) * 1e-6,
            np.array(position),
            np.array(frame.vector_from_ned(estimator.velocity)),
            np.array(estimator.q),
            np.array(self._force),
            mode,
            self._walls_in_view(position),
            self._contacts,
            not self._autopilot.armed or tilt_of(self._autopilot.plant.q) > _DOWN_RAD,
        )

    def _walls_in_view(self, position: Vec3) -> Array:
        walls: list[tuple[float, Wall]] = [
            (wall.signed_distance(position), wall)
            for wall in self.mission.flat_walls
            if distance2(position, wall.point) <= self._view_m + 0.5 * wall.length_m
        ]
        rows = [
            (*wall.point[:2], *wall.normal[:2], distance)
            for distance, wall in sorted(walls, key=lambda one: one[0])
            if abs(distance) <= self._view_m
        ]
        return np.array(rows, dtype=np.float64).reshape(len(rows), 5)
