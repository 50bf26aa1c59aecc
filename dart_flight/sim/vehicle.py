"""The simulated vehicle as a whole: body, autopilot and lock servo, stepped in ticks of 4 ms."""

from __future__ import annotations

from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.lock.servo import ServoModel, mode_of
from dart_flight.samples import Mode
from dart_flight.sim.autopilot import Autopilot, make_autopilot


class SimulatedVehicle:
    """Autopilot and lock servo of one simulated vehicle.

    Args:
        mission: walls and start.
        seed: of the sensors' noise.
        driver: `px4` moves the servo by the autopilot's own output; with any other the horn is told.
    """

    def __init__(self, mission: Mission, seed: int, driver: LockDriver) -> None:
        self.autopilot: Autopilot = make_autopilot(mission, seed)
        self._servo_config = mission.vehicle.lock.servo
        self._index = mission.vehicle.lock.px4.actuator_index
        self._by_autopilot = driver is LockDriver.PX4
        # Without pulses the arms are free: the servo rests at the flexible end.
        self._servo = ServoModel(self._servo_config, self._servo_config.flexible_pulse_us)

    def set_horn(self, pulse_us: float) -> None:
        """Where the mock servo's horn is, as a pulse width."""
        # Between the ends no rod holds all four arms: not rigid means flexible.
        mode = mode_of(self._servo_config, pulse_us)
        self.autopilot.plant.set_mode(Mode.RIGID if mode is Mode.RIGID else Mode.FLEXIBLE)

    def advance(self) -> None:
        """One tick: servo, plant, autopilot."""
        if self._by_autopilot:
            t_us = self.autopilot.time_us
            pulse = self.autopilot.actuator_pulse_us(self._index)
            if pulse is not None:
                self._servo.command(t_us, pulse)
            self.set_horn(self._servo.pulse_at(t_us))
        self.autopilot.step()
