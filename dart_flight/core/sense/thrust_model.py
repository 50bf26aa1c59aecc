"""Thrust model: total thrust and thrust per motor, for the force and torque estimators.

`estimation.thrust_source` selects the source. With measured motor speeds, the thrust is c rpm^2 with c =
`estimation.esc_thrust_n_per_rpm2`; lag and voltage are not needed. With motor commands, the thrust is
computed by the curve of `thrust:`, with a first-order lag and the battery voltage. `auto` uses the motor
speeds only if they arrive often enough to resolve the controller's reaction to a contact. The thrust scale
learnt in hover corrects the thrust from both sources (`core/sense/bias.py`). docs/force.md has the equations.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from dart_flight.base.arithmetic import sum_in_order
from dart_flight.base.filters import decay_factor
from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.records import ActuatorSample, EscSample
from dart_flight.config.vehicle import ThrustSource, VehicleConfig

Each = tuple[float, ...]  # one value per motor

# `auto` ignores motor speeds with a longer period, because switching sources would look like a force.
_ESC_PERIOD_US: Final = 20_000
_PENDING: Final = 16  # largest number of stored commands that are newer than the IMU sample


class LaggedCommands:
    """Values that follow stamped commands with a first-order lag.

    A command takes effect at its own stamp, even if it arrives later. Commands whose stamps do not increase
    are discarded.
    """

    def __init__(self, lag_s: float) -> None:
        self._lag_us = lag_s * 1e6
        self._pending: deque[tuple[int, Each]] = deque(maxlen=_PENDING)
        self._target: Each | None = None
        self._now_us = 0
        self.newest_us = -(1 << 60)
        self.value: Each = ()

    def update(self, t_us: int, values: Each) -> None:
        if t_us <= self.newest_us:
            return
        self.newest_us = t_us
        if self._target is None:
            # Assume that the first command has been in effect for a long time.
            self._target = self.value = values
        else:
            self._pending.append((t_us, values))

    def advance(self, t_us: int) -> None:
        """Advance `value` to `t_us`; an earlier stamp has no effect."""
        pending = self._pending
        while pending and pending[0][0] <= t_us:
            stamp, values = pending.popleft()
            self._relax(stamp)
            self._target = values
        self._relax(t_us)

    def _relax(self, t_us: int) -> None:
        step = t_us - self._now_us
        if step <= 0 or self._target is None:
            return
        self._now_us = t_us
        a, b = self._target, self.value
        if a == b:
            return
        left = decay_factor(step, self._lag_us)
        if len(a) != len(b):
            raise ValueError(f"{len(a)} commands after {len(b)}")
        self.value = tuple([to + (b[i] - to) * left for i, to in enumerate(a)])


class ThrustModel:
    """Model of the total thrust along the body's up axis: the mean over an IMU tick, newton.

    Attributes:
        source: source of the last result. None if no source has data yet; hover thrust is then assumed.
        each_n: thrust of each motor at the stamp of the last result, or None if not known yet.
    """

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._config = vehicle.estimation
        self._wanted = self._config.thrust_source
        self._auto = self._wanted is ThrustSource.AUTO
        self._per_rpm2 = self._config.esc_thrust_n_per_rpm2
        self._curve, self._full_n = vehicle.thrust, vehicle.thrust.max_thrust_n
        self._square = vehicle.thrust.model_factor
        self._hover_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        self._motors = LaggedCommands(vehicle.thrust.motor_lag_s)
        self._esc: EscSample | None = None
        self._esc_period_us = 1 << 60
        self._voltage_factor = 1.0
        self._last_n: float | None = None
        self.source: ThrustSource | None = None
        self.each_n: Each | None = None

    def add_commands(self, sample: ActuatorSample) -> None:
        self._motors.update(sample.t_us, sample.motors)

    def update_esc(self, sample: EscSample) -> None:
        if self._esc is not None:
            if sample.t_us <= self._esc.t_us:
                return
            self._esc_period_us = sample.t_us - self._esc.t_us
        self._esc = sample

    def update_voltage(self, volts: float | None) -> None:
        """Store the battery voltage; None or zero keeps the previous one."""
        battery = self._config.battery
        if volts is not None and volts > 0.0:
            self._voltage_factor = (volts / battery.reference_v) ** battery.exponent

    def mean_over_tick(self, t_us: int) -> float:
        """Return the mean thrust between the previous call's stamp and `t_us`, newton."""
        raw = self._at(t_us)
        before = self._last_n if self._last_n is not None else raw
        self._last_n = raw
        return 0.5 * (before + raw)

    def _at(self, t_us: int) -> float:
        wanted, auto = self._wanted, self._auto
        esc, motors = self._esc, self._motors
        # A fixed source has no timeout, because an old value is better than none.
        per_rpm2 = self._per_rpm2
        if esc is not None and per_rpm2 is not None:
            often = self._esc_period_us <= _ESC_PERIOD_US and esc.t_us >= t_us - _ESC_PERIOD_US
            if wanted is ThrustSource.ESC or (auto and often):
                self.source = ThrustSource.ESC
                self.each_n = tuple([per_rpm2 * rpm * rpm for rpm in esc.rpm])
                squares = 0.0
                for rpm in esc.rpm:
                    squares += rpm * rpm
                return per_rpm2 * squares
        if motors.newest_us > 0 and (auto or wanted is ThrustSource.ACTUATOR):
            self.source = ThrustSource.ACTUATOR
            motors.advance(t_us)
            return self._by_curve(motors.value)
        self.each_n = None
        self.source = None
        return self._hover_n

    def _by_curve(self, commands: Each) -> float:
        """Return the total thrust from the configured curve, newton, and set `each_n`."""
        f, volts = self._square, self._voltage_factor
        if f is None:
            self.each_n = each = tuple([force * volts for force in self._curve.forces_n(commands)])
            return sum_in_order(each)
        full, g = self._full_n * volts, 1.0 - f
        each_n: list[float] = []
        squares = linear = 0.0
        for u in commands:
            each_n.append(full * u * (f * u + g))
            squares += u * u
            linear += u
        self.each_n = tuple(each_n)
        return self._full_n * (f * squares + g * linear) * volts
