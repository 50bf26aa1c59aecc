"""The simulated vehicle: body, autopilot and lock servo, stepped in ticks of 4 ms."""

from __future__ import annotations

import math

from dart_flight.base.records import Mode
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockDriver, Servo
from dart_flight.lock.servo import ServoModel, mode_of
from dart_flight.sim.embedded_autopilot import TICK_S, Autopilot, make_autopilot
from dart_flight.sim.plant import Plant
from dart_flight.sim.wind import Wind


class LockServo:
    """The lock's servo on the plant: a pulse moves the horn, which locks or unlocks the arms."""

    def __init__(self, plant: Plant, config: Servo) -> None:
        self._plant, self._config = plant, config
        # Before the first pulse the servo rests at the flexible end, so the arms are unlocked.
        self._model = ServoModel(config, config.flexible_pulse_us)
        self._horn_us = math.nan  # the horn's last position
        self._wanted = Mode.FLEXIBLE

    def set_horn(self, pulse_us: float) -> None:
        if pulse_us != self._horn_us:  # usually the horn is at rest
            self._horn_us = pulse_us
            # Between the ends the rods do not hold all four arms, so only the rigid end counts as rigid.
            rigid = mode_of(self._config, pulse_us) is Mode.RIGID
            self._wanted = Mode.RIGID if rigid else Mode.FLEXIBLE
        self._plant.set_mode(self._wanted)

    def track_pulse(self, t_us: int, pulse_us: float | None) -> None:
        """Advance the servo towards a commanded pulse; None keeps the last commanded pulse."""
        if pulse_us is not None:
            self._model.command(t_us, pulse_us)
        self.set_horn(self._model.pulse_at(t_us))


class SimulatedVehicle:
    """Autopilot and lock servo of one simulated vehicle.

    With the `px4` lock driver, the autopilot's output moves the servo; otherwise `set_horn` does. A vehicle
    without a lock has no servo.
    """

    def __init__(self, mission: Mission, seed: int, driver: LockDriver | None) -> None:
        self.autopilot: Autopilot = make_autopilot(mission, seed)
        self._by_autopilot = driver is LockDriver.PX4
        self._wind = Wind(mission.vehicle.simulation, seed, TICK_S)
        self._lock = lock = mission.vehicle.lock
        self._servo = None if lock is None else LockServo(self.autopilot.plant, lock.servo)

    def set_horn(self, pulse_us: float) -> None:
        if self._servo is not None:
            self._servo.set_horn(pulse_us)

    def advance(self) -> None:
        self._wind.step(self.autopilot.plant)
        if self._by_autopilot and self._servo is not None:
            self._servo.track_pulse(self.autopilot.time_us, self.autopilot.lock_pulse_us())
        self.autopilot.step()
