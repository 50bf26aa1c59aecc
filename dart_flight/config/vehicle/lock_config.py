"""Configuration of the lock: cam, servo and drivers."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from msgspec import Meta

from dart_flight.base.records import Mode
from dart_flight.config.section import Seconds, Section


class Cam(Section, frozen=True):
    """Cam of the locking mechanism: it moves the rods by l = r_cam - r cos(theta) (paper, eq. 1).

    Theta ranges from theta_0 to theta_0 + 90°.

    Attributes:
        r_cam_mm: radius r_cam of the equation.
        r_mm: radius r of the equation, at most r_cam_mm.
        theta0_deg: theta_0 of the equation: the cam angle with retracted rods.
    """

    r_cam_mm: Annotated[float, Meta(gt=0.0, le=200.0)]
    r_mm: Annotated[float, Meta(gt=0.0, le=200.0)]
    # Between 0 and 180° the equation has a single inverse.
    theta0_deg: Annotated[float, Meta(ge=0.0, le=90.0)]

    def __post_init__(self) -> None:
        if self.r_mm > self.r_cam_mm:
            raise ValueError(f"r_mm {self.r_mm:g} must not exceed r_cam_mm {self.r_cam_mm:g}")


class Servo(Section, frozen=True):
    """The servo and its calibration: pulse widths and cam angles at the two ends, speed, end stops.

    Attributes:
        rigid_pulse_us: pulse width with locked arms; `dart-flight lock calibrate` writes it.
        flexible_pulse_us: pulse width with unlocked arms; `dart-flight lock calibrate` writes it.
        rigid_deg: cam angle at rigid_pulse_us, within the cam's range.
        flexible_deg: cam angle at flexible_pulse_us, within the cam's range.
        direction: 1: the cam angle increases with the pulse width; -1: it decreases.
        min_pulse_us: shortest allowed pulse.
        max_pulse_us: longest allowed pulse.
        tolerance_us: the servo is at an end if its pulse width is within this tolerance of the end's.
        supply_v: supply voltage of the servo, 4.8 to 6.0 V.
        s_per_60deg_at_4v8: time for 60 degrees at 4.8 V, s.
        s_per_60deg_at_6v0: time for 60 degrees at 6.0 V, s.
        settle_margin_s: time added to the travel time before the lock counts as settled.
        travel_s: measured time of the full travel, which replaces the two times for 60 degrees; null: not
            measured.
    """

    rigid_pulse_us: Annotated[float, Meta(gt=0.0, le=5000.0)]
    flexible_pulse_us: Annotated[float, Meta(gt=0.0, le=5000.0)]
    rigid_deg: Annotated[float, Meta(ge=-360.0, le=360.0)]
    flexible_deg: Annotated[float, Meta(ge=-360.0, le=360.0)]
    direction: Literal[-1, 1]
    min_pulse_us: Annotated[float, Meta(gt=0.0, le=5000.0)]
    max_pulse_us: Annotated[float, Meta(gt=0.0, le=5000.0)]
    tolerance_us: Annotated[float, Meta(gt=0.0, le=1000.0)]
    supply_v: Annotated[float, Meta(ge=4.8, le=6.0)]
    s_per_60deg_at_4v8: Annotated[float, Meta(gt=0.0, le=5.0)]
    s_per_60deg_at_6v0: Annotated[float, Meta(gt=0.0, le=5.0)]
    settle_margin_s: Annotated[float, Meta(ge=0.0, le=10.0)]
    travel_s: Annotated[float, Meta(gt=0.0, le=30.0)] | None = None

    def __post_init__(self) -> None:
        low, high = self.min_pulse_us, self.max_pulse_us
        if low >= high:
            raise ValueError(f"min_pulse_us {low:g} must be below max_pulse_us {high:g}")
        for name in ("rigid_pulse_us", "flexible_pulse_us"):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must be within the servo's range {low:g} to {high:g}")
        span_us = self.rigid_pulse_us - self.flexible_pulse_us
        if abs(span_us) <= 2.0 * self.tolerance_us:
            raise ValueError(
                "rigid_pulse_us and flexible_pulse_us must differ by more than twice "
                f"tolerance_us {self.tolerance_us:g}"
            )
        span_deg = self.rigid_deg - self.flexible_deg
        if span_deg == 0.0:
            raise ValueError("rigid_deg and flexible_deg must differ")
        if span_us * span_deg * self.direction < 0.0:
            raise ValueError(
                f"direction {self.direction} contradicts the two points: from flexible to rigid the pulse "
                f"changes by {span_us:+g} us and the angle by {span_deg:+g} degrees"
            )

    def pulse_us(self, mode: Mode) -> float:
        return self.rigid_pulse_us if mode is Mode.RIGID else self.flexible_pulse_us

    @property
    def us_per_deg(self) -> float:
        """Pulse width per degree of cam angle, positive, computed from the calibration of the two ends."""
        return abs(self.rigid_pulse_us - self.flexible_pulse_us) / abs(self.rigid_deg - self.flexible_deg)

    @property
    def s_per_deg(self) -> float:
        """Seconds per degree, from the measured travel time, or from the catalogue's times at `supply_v`."""
        if self.travel_s is not None:
            return self.travel_s / abs(self.rigid_deg - self.flexible_deg)
        share = (self.supply_v - 4.8) / (6.0 - 4.8)
        return (self.s_per_60deg_at_4v8 + share * (self.s_per_60deg_at_6v0 - self.s_per_60deg_at_4v8)) / 60.0

    @property
    def full_travel_s(self) -> float:
        """Travel time between the two ends, seconds, without margin."""
        return self.s_per_deg * abs(self.rigid_deg - self.flexible_deg)


class DriverSection(Section, frozen=True):
    """Base of the drivers' sections; only the section of the chosen driver is checked."""

    @property
    def ramp_us_s(self) -> float | None:
        """Speed limit of the pulse width, us/s, or None if the driver has none."""
        return None

    def refuse_servo(self, servo: Servo) -> None:
        """Raise ValueError if the driver cannot move the servo to both ends."""


class Maestro(DriverSection, frozen=True):
    """Serial servo controller (Pololu Maestro), for the `maestro` driver.

    Attributes:
        port: serial port, such as /dev/ttyACM0.
        channel: the servo's channel on the controller.
        baud: baud rate of the serial line.
        speed_limit_us_s: speed limit of the pulse width, a multiple of 25; 0: none.
        reply_timeout_s: timeout for a reply from the controller.
    """

    port: str
    channel: Annotated[int, Meta(ge=0, le=23)]
    baud: Annotated[int, Meta(ge=300, le=200_000)]
    speed_limit_us_s: Annotated[float, Meta(ge=0.0, le=25.0 * 16383)]
    reply_timeout_s: Annotated[float, Meta(gt=0.0, le=1.0)]

    def __post_init__(self) -> None:
        if not self.port:
            raise ValueError("port must name a serial port, such as /dev/ttyACM0")
        if self.speed_limit_us_s % 25.0 != 0.0:
            raise ValueError(f"speed_limit_us_s {self.speed_limit_us_s:g} must be a multiple of 25")

    @property
    def ramp_us_s(self) -> float | None:
        return self.speed_limit_us_s or None


class Pwm(DriverSection, frozen=True):
    """Hardware PWM of the Raspberry Pi through sysfs, for the `pwm` driver.

    Attributes:
        sysfs_dir: folder of the kernel's PWM chips.
        chip: number N of pwmchipN; null: the Raspberry Pi's own chip, whose number depends on the kernel.
        channel: channel of the servo on the chip; null: the channel of GPIO 18.
        period_us: period of the pulses.
    """

    sysfs_dir: str
    chip: Annotated[int, Meta(ge=0)] | None
    channel: Annotated[int, Meta(ge=0)] | None
    period_us: Annotated[float, Meta(ge=2_500.0, le=50_000.0)]

    def refuse_servo(self, servo: Servo) -> None:
        if servo.max_pulse_us >= self.period_us:
            raise ValueError(
                f"servo.max_pulse_us must be below pwm.period_us {self.period_us:g}, the period of the pulses"
            )


class Px4Output(DriverSection, frozen=True):
    """PX4's own servo output through `set_actuator`, for the `px4` driver.

    Attributes:
        actuator_index: index of PX4's output function "Peripheral via Actuator Set", 1 to 6.
        bank: bank of the servo's pin.
        pin: number of the pin in its bank.
        timer: number of the pin's timer group, which must run at 50 Hz (`PWM_<bank>_TIM<timer>`).
        min_pulse_us: pulse width for actuator value -1, `PWM_<bank>_MIN<pin>`.
        max_pulse_us: pulse width for actuator value 1, `PWM_<bank>_MAX<pin>`.
    """

    actuator_index: Annotated[int, Meta(ge=1, le=6)]
    bank: Literal["MAIN", "AUX"]
    pin: Annotated[int, Meta(ge=1, le=16)]
    timer: Annotated[int, Meta(ge=0, le=7)]
    # PX4's allowed ranges of PWM_<bank>_MIN and PWM_<bank>_MAX.
    min_pulse_us: Annotated[float, Meta(ge=800.0, le=1400.0)]
    max_pulse_us: Annotated[float, Meta(ge=1600.0, le=2200.0)]

    def refuse_servo(self, servo: Servo) -> None:
        for name in ("rigid_pulse_us", "flexible_pulse_us"):
            if not self.min_pulse_us <= getattr(servo, name) <= self.max_pulse_us:
                raise ValueError(
                    f"servo.{name} must be from px4.min_pulse_us {self.min_pulse_us:g} to "
                    f"px4.max_pulse_us {self.max_pulse_us:g}"
                )


class LimitSwitch(Section, frozen=True):
    """Switches at one or both ends of the travel, on GPIO lines; an end without a switch has no feedback.

    Attributes:
        chip: GPIO chip, such as /dev/gpiochip0.
        rigid_line: line of the switch at the rigid end; null: there is no switch.
        flexible_line: line of the switch at the flexible end; null: there is no switch.
        active_low: whether a closed switch pulls its line to ground.
    """

    chip: str
    rigid_line: Annotated[int, Meta(ge=0)] | None = None
    flexible_line: Annotated[int, Meta(ge=0)] | None = None
    active_low: bool = True

    def __post_init__(self) -> None:
        if self.rigid_line is None and self.flexible_line is None:
            raise ValueError("needs rigid_line, flexible_line or both")
        if self.rigid_line == self.flexible_line:
            raise ValueError("rigid_line and flexible_line must differ")


class LockDriver(StrEnum):
    """Drivers of the servo."""

    MAESTRO = "maestro"
    PWM = "pwm"
    PX4 = "px4"
    MOCK = "mock"


class LockStartup(StrEnum):
    """Action of the lock at program start: move to a known end, or keep the current position."""

    HOME = "home"
    ADOPT = "adopt"


NO_LOCK = "none"  # value of `driver` if the vehicle has no lock; the other keys are then ignored


class LockConfig(Section, frozen=True):
    """The locking mechanism (docs/lock.md); without this section, or with driver `none`, there is none.

    Attributes:
        driver: driver of the servo; mock: a modelled servo; none: there is no lock, and other keys are
            ignored.
        startup: home: move to home_mode; adopt: use the current position.
        home_mode: mode into which `home` moves the lock.
        relaxation_s: time that the lock waits after a contact before it may move, so that the arms can spring
            back.
        timeout_s: the lock is in fault if its travel takes longer, or if a limit switch cannot be read for
            longer.
        debounce_s: minimum duration of a limit-switch change or pulse loss; shorter changes are ignored.
        limit_switch: {chip: /dev/gpiochip0, rigid_line: 23, flexible_line: 24, active_low: true}, with one or
            both lines; null: there is no switch, and a movement of the lock counts as complete after the
            travel time.
        rc_channel: RC channel of a switch that moves the lock while the program is in standby; a high value
            selects rigid; null: none.
    """

    driver: LockDriver
    startup: LockStartup
    home_mode: Mode
    relaxation_s: Annotated[float, Meta(ge=0.0, le=10.0)]
    timeout_s: Seconds
    debounce_s: Annotated[float, Meta(ge=0.0, le=10.0)]
    cam: Cam
    servo: Servo
    maestro: Maestro
    pwm: Pwm
    px4: Px4Output
    limit_switch: LimitSwitch | None = None
    rc_channel: Annotated[int, Meta(ge=1, le=18)] | None = None

    def __post_init__(self) -> None:
        servo, theta0 = self.servo, self.cam.theta0_deg
        for name in ("rigid_deg", "flexible_deg"):
            if not theta0 <= getattr(servo, name) <= theta0 + 90.0:
                raise ValueError(
                    f"servo.{name} {getattr(servo, name):g} is outside the cam's range "
                    f"{theta0:g} to {theta0 + 90.0:g} degrees"
                )
        for angle in (theta0, theta0 + 90.0):
            pulse = servo.flexible_pulse_us + servo.direction * servo.us_per_deg * (
                angle - servo.flexible_deg
            )
            if not servo.min_pulse_us - 1e-6 <= pulse <= servo.max_pulse_us + 1e-6:
                raise ValueError(
                    f"the cam's range {theta0:g} to {theta0 + 90.0:g} degrees exceeds the servo's end "
                    f"stops: {angle:g} degrees needs {pulse:.0f} us, but the end stops are at "
                    f"{servo.min_pulse_us:g} and {servo.max_pulse_us:g} us"
                )
        if self.timeout_s <= self.switch_time_s:
            raise ValueError(
                f"timeout_s {self.timeout_s:g} must be longer than the travel time plus its margin, "
                f"{self.switch_time_s:.3f} s"
            )
        if self.driver_section is not None:
            self.driver_section.refuse_servo(servo)

    @property
    def driver_section(self) -> DriverSection | None:
        """Section of the chosen driver, or None if the driver has no section."""
        section: DriverSection | None = getattr(self, self.driver.value, None)
        return section

    @property
    def ramp_us_s(self) -> float | None:
        return None if self.driver_section is None else self.driver_section.ramp_us_s

    @property
    def switch_time_s(self) -> float:
        """Time from an accepted command to `settled`, s: the travel at limited speed, plus the margin."""
        travel, servo = self.servo.full_travel_s, self.servo
        if self.ramp_us_s is not None:
            travel = max(travel, abs(servo.rigid_pulse_us - servo.flexible_pulse_us) / self.ramp_us_s)
        return travel + servo.settle_margin_s
