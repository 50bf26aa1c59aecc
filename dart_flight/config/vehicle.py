"""`configs/dart.yaml`: the vehicle, its sensors, its materials, the lock and every threshold.

The types here are the schema (`docs/schemas/`); the numbers and their sources are in the file.
"""

from __future__ import annotations

import os
from enum import StrEnum
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from dart_flight.config.document import Document, InputError
from dart_flight.samples import Mode

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of every part of a file: frozen, unknown keys refused."""


class Coefficients(Section, frozen=True):
    """Contact coefficients of one material in one mode (paper, Sec. IV-B and V-A).

    Attributes:
        k: stiffness, N/m.
        f: damping, N s/m.
        mu: friction, s/m (friction force = mu * normal force * tangential speed).
        nu: bound of the vertical contact force, N.
    """

    k: Positive
    f: NotNegative
    mu: NotNegative
    nu: NotNegative


class Material(Section, frozen=True):
    """Coefficients per mode, and whether they are measured or assumed."""

    rigid: Coefficients
    flexible: Coefficients
    source: str = ""

    def of(self, mode: Mode) -> Coefficients:
        """The coefficients of a mode."""
        return self.rigid if mode is Mode.RIGID else self.flexible


class Airframe(Section, frozen=True):
    """The vehicle as a body."""

    mass_kg: Positive
    contact_distance_m: NotNegative
    incidence_rigid_deg: Annotated[float, Meta(ge=0.0, le=45.0)]
    drag_per_s: tuple[NotNegative, NotNegative, NotNegative]
    inertia_kg_m2: tuple[Positive, Positive, Positive]
    arm_x_m: Positive
    arm_y_m: Positive


class Thrust(Section, frozen=True):
    """Thrust of one motor: full_n * (factor u² + (1 - factor) u), u from 0 to 1, with first-order lag."""

    full_n: Positive
    model_factor: Fraction
    motor_lag_s: NotNegative

    def force_n(self, command: float) -> float:
        """Steady thrust in newton of one motor at a command from 0 to 1."""
        u = max(0.0, min(1.0, command))
        return self.full_n * (self.model_factor * u * u + (1.0 - self.model_factor) * u)

    def command_for(self, force_n: float) -> float:
        """The command from 0 to 1 that gives a steady thrust; saturates."""
        relative = max(0.0, min(1.0, force_n / self.full_n))
        a = self.model_factor
        if a < 1e-6:
            return relative
        b = 1.0 - a
        return float((-b + (b * b + 4.0 * a * relative) ** 0.5) / (2.0 * a))


class Imu(Section, frozen=True):
    """What the IMU can read."""

    full_scale_m_s2: Positive
    rate_hz: Positive
    tick_s: Positive  # what one reported sample is averaged over
    antialias_hz: Positive  # -3 dB of the accelerometer's own low-pass, first order


class Observer(StrEnum):
    """Which estimate of the external force the detector and the recovery use."""

    ACCELERATION = "acceleration"
    MOMENTUM = "momentum"


class ThrustSource(StrEnum):
    """What the thrust is computed from; `auto` takes the best that is fresh, in this order from ESC on."""

    AUTO = "auto"
    ESC = "esc"
    ACTUATOR = "actuator"
    ATTITUDE_TARGET = "attitude_target"


class Battery(Section, frozen=True):
    """Thrust at a command against battery voltage: thrust = curve * (voltage / reference_v) ** exponent."""

    reference_v: Positive
    exponent: NotNegative


class HoverBias(Section, frozen=True):
    """What is learnt while the vehicle hovers: accelerometer bias, thrust scale, noise."""

    speed_m_s: Positive
    rate_rad_s: Positive
    time_constant_s: Positive
    bias_limit_m_s2: NotNegative
    thrust_scale_limit: Fraction


class ArmVibration(Section, frozen=True):
    """The damped in-plane vibration of the flexible arms, as the IMU feels it."""

    frequency_hz: Positive
    damping_ratio: Fraction
    mass_fraction: Fraction


class Estimation(Section, frozen=True):
    """The estimate of the external force."""

    observer: Observer
    momentum_gain_per_s: Positive
    thrust_source: ThrustSource
    thrust_timeout_s: Positive
    thrust_error_n: NotNegative
    esc_thrust_n_per_rpm2: Positive | None
    battery: Battery
    attitude_error_rad: NotNegative
    imu_noise_m_s2: Positive
    filter_s: NotNegative
    baseline_s: Positive
    baseline_limit_n: NotNegative
    arm_vibration: ArmVibration | None
    hover: HoverBias

    def __post_init__(self) -> None:
        if self.thrust_source is ThrustSource.ESC and self.esc_thrust_n_per_rpm2 is None:
            raise ValueError("thrust_source esc needs esc_thrust_n_per_rpm2")

    @property
    def uses_esc(self) -> bool:
        """Whether measured motor speeds may be the source of thrust."""
        return self.esc_thrust_n_per_rpm2 is not None and self.thrust_source in (
            ThrustSource.AUTO,
            ThrustSource.ESC,
        )


class ThresholdTest(StrEnum):
    """How the horizontal force is compared with the threshold."""

    MAGNITUDE = "magnitude"
    PER_AXIS = "per_axis"


class Detection(Section, frozen=True):
    """When an impact is an impact."""

    force_threshold_n: Positive
    threshold_test: ThresholdTest
    release_fraction: Fraction
    peak_drop_fraction: Fraction
    peak_wait_s: Positive
    contact_end_s: Positive
    refractory_s: NotNegative
    sure_sigma: NotNegative


class Guard(Section, frozen=True):
    """Thresholds of the guard's rules."""

    stream_timeout_s: Positive
    status_timeout_s: Positive
    altitude_tolerance_m: Positive
    tilt_deg: Annotated[float, Meta(gt=0.0, le=180.0)]
    wall_overrun_m: Positive
    retreat_m: Positive
    imu_timeout_s: Positive
    actuator_timeout_s: Positive
    link_lost_s: Positive
    stamp_tolerance_s: Positive
    imu_stuck_s: Positive
    imu_clipped_s: Positive
    position_jump_m: Positive
    velocity_jump_m_s: Positive
    reset_position_m: Positive
    reset_velocity_m_s: Positive
    estimator_bad_s: NotNegative
    impact_window_s: NotNegative
    battery_remaining: Fraction
    battery_v: NotNegative
    battery_low_s: NotNegative
    kill_after_s: Positive | None
    force_margin: Annotated[float, Meta(ge=1.0)]
    wall_late_s: Positive
    wall_early_m: Positive
    deadman_s: Annotated[float, Meta(ge=0.1, le=2.0)]


class Flying(Section, frozen=True):
    """How the executive flies between the collisions."""

    climb_speed_m_s: Positive
    transit_speed_m_s: Positive
    acceleration_m_s2: Positive
    yaw_rate_deg_s: Positive
    steady_run_s: NotNegative
    arrive_m: Positive
    arrive_speed_m_s: Positive
    arrive_s: NotNegative
    ready_timeout_s: Positive


class Cam(Section, frozen=True):
    """Cam of the locking mechanism: l = r_cam - r cos(theta), theta_0 to theta_0 + 90° (paper, eq. 1)."""

    r_cam_mm: Positive
    r_mm: Positive
    theta0_deg: Annotated[float, Meta(ge=0.0, le=90.0)]  # from 0 to 180° the law has one inverse

    def __post_init__(self) -> None:
        if self.r_mm > self.r_cam_mm:
            raise ValueError(f"r_mm {self.r_mm:g} must not exceed r_cam_mm {self.r_cam_mm:g}")


class Servo(Section, frozen=True):
    """The servo and its calibration: pulse width and cam angle of the two ends, speed, end stops."""

    rigid_pulse_us: Annotated[float, Meta(gt=0.0)]
    flexible_pulse_us: Annotated[float, Meta(gt=0.0)]
    rigid_deg: float
    flexible_deg: float
    direction: Literal[-1, 1]  # 1: the cam angle grows with the pulse width
    min_pulse_us: Positive
    max_pulse_us: Positive
    tolerance_us: Positive
    supply_v: Annotated[float, Meta(ge=4.8, le=6.0)]
    s_per_60deg_at_4v8: Positive
    s_per_60deg_at_6v0: Positive
    settle_margin_s: NotNegative
    travel_s: Positive | None = None  # measured; overrides the catalogue's speed

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
        """Calibrated pulse width of a mode's end."""
        return self.rigid_pulse_us if mode is Mode.RIGID else self.flexible_pulse_us

    @property
    def us_per_deg(self) -> float:
        """Pulse width per degree of cam angle, positive; from the two points."""
        return abs(self.rigid_pulse_us - self.flexible_pulse_us) / abs(self.rigid_deg - self.flexible_deg)

    @property
    def s_per_deg(self) -> float:
        """Seconds per degree: the measured full travel, else the catalogue interpolated by supply voltage."""
        if self.travel_s is not None:
            return self.travel_s / abs(self.rigid_deg - self.flexible_deg)
        share = (self.supply_v - 4.8) / (6.0 - 4.8)
        return (self.s_per_60deg_at_4v8 + share * (self.s_per_60deg_at_6v0 - self.s_per_60deg_at_4v8)) / 60.0

    @property
    def full_travel_s(self) -> float:
        """Seconds from one mode's end to the other's, without margin."""
        return self.s_per_deg * abs(self.rigid_deg - self.flexible_deg)


class Maestro(Section, frozen=True):
    """Serial servo controller (Pololu Maestro)."""

    port: str
    channel: Annotated[int, Meta(ge=0, le=23)]
    baud: Annotated[int, Meta(ge=300, le=200_000)]
    speed_limit_us_s: Annotated[float, Meta(ge=0.0, le=25.0 * 16383)]  # 0: none; steps of 25 us/s
    reply_timeout_s: Annotated[float, Meta(gt=0.0, le=1.0)]

    def __post_init__(self) -> None:
        if not self.port:
            raise ValueError("port must name a serial port, such as /dev/ttyACM0")
        if self.speed_limit_us_s % 25.0 != 0.0:
            raise ValueError(f"speed_limit_us_s {self.speed_limit_us_s:g} must be a multiple of 25")


class Pwm(Section, frozen=True):
    """Hardware PWM of the Raspberry Pi, through sysfs."""

    sysfs_dir: str
    chip: Annotated[int, Meta(ge=0)]
    channel: Annotated[int, Meta(ge=0)]
    period_us: Annotated[float, Meta(ge=2_500.0, le=50_000.0)]


class Px4Output(Section, frozen=True):
    """PX4's own servo output, through `set_actuator`."""

    actuator_index: Annotated[int, Meta(ge=1, le=6)]
    bank: Literal["MAIN", "AUX"]
    pin: Annotated[int, Meta(ge=1, le=16)]
    timer: Annotated[int, Meta(ge=0, le=7)]
    min_pulse_us: Annotated[float, Meta(ge=800.0, le=1400.0)]  # what PX4 allows for PWM_<bank>_MIN<pin>
    max_pulse_us: Annotated[float, Meta(ge=1600.0, le=2200.0)]  # ... and for PWM_<bank>_MAX<pin>


class LimitSwitch(Section, frozen=True):
    """Switches at one or both ends of the travel, on GPIO lines; an end without one has no feedback."""

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
    """What moves the servo."""

    MAESTRO = "maestro"
    PWM = "pwm"
    PX4 = "px4"
    MOCK = "mock"


class LockStartup(StrEnum):
    """What the lock does when the program starts: move to a known end, or believe what it finds."""

    HOME = "home"
    ADOPT = "adopt"


class LockConfig(Section, frozen=True):
    """The locking mechanism."""

    driver: LockDriver
    startup: LockStartup
    home_mode: Mode
    relaxation_s: NotNegative
    timeout_s: Positive
    debounce_s: NotNegative
    cam: Cam
    servo: Servo
    maestro: Maestro
    pwm: Pwm
    px4: Px4Output
    limit_switch: LimitSwitch | None = None

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
                    f"the cam's range {theta0:g} to {theta0 + 90.0:g} degrees goes over the servo's end "
                    f"stops: {angle:g} degrees is {pulse:.0f} us, allowed {servo.min_pulse_us:g} to "
                    f"{servo.max_pulse_us:g}"
                )
        if self.timeout_s <= self.switch_time_s:
            raise ValueError(
                f"timeout_s {self.timeout_s:g} must be longer than the travel with its margin, "
                f"{self.switch_time_s:.3f} s"
            )
        if self.driver is LockDriver.PX4:
            for name in ("rigid_pulse_us", "flexible_pulse_us"):
                if not self.px4.min_pulse_us <= getattr(servo, name) <= self.px4.max_pulse_us:
                    raise ValueError(
                        f"servo.{name} must be within px4.min_pulse_us {self.px4.min_pulse_us:g} and "
                        f"px4.max_pulse_us {self.px4.max_pulse_us:g}"
                    )
        if self.driver is LockDriver.PWM and servo.max_pulse_us >= self.pwm.period_us:
            raise ValueError(
                f"servo.max_pulse_us must be below pwm.period_us {self.pwm.period_us:g}, the servo's frame"
            )

    @property
    def ramp_us_s(self) -> float | None:
        """Speed limit of the pulse width itself in us/s, where the driver has one."""
        limit = self.maestro.speed_limit_us_s
        return limit if self.driver is LockDriver.MAESTRO and limit > 0.0 else None

    @property
    def switch_time_s(self) -> float:
        """Seconds from the driver's taking the command to `settled`: travel, speed limit and margin."""
        travel, servo = self.servo.full_travel_s, self.servo
        if self.ramp_us_s is not None:
            travel = max(travel, abs(servo.rigid_pulse_us - servo.flexible_pulse_us) / self.ramp_us_s)
        return travel + servo.settle_margin_s


class Connection(Section, frozen=True):
    """How to reach the autopilot."""

    url: str
    timeout_s: Positive


class Px4Parameters(Section, frozen=True, rename="upper"):
    """PX4 parameters that the flight model and the embedded autopilot use, by PX4's own names."""

    mpc_xy_p: Positive
    mpc_z_p: Positive
    mpc_xy_vel_p_acc: Positive
    mpc_xy_vel_i_acc: NotNegative
    mpc_xy_vel_d_acc: NotNegative
    mpc_z_vel_p_acc: Positive
    mpc_z_vel_i_acc: NotNegative
    mpc_z_vel_d_acc: NotNegative
    mpc_xy_vel_max: Positive
    mpc_z_vel_max_up: Positive
    mpc_z_vel_max_dn: Positive
    mpc_tiltmax_air: Annotated[float, Meta(gt=0.0, lt=90.0)]
    mpc_land_speed: Positive
    mpc_thr_min: Fraction
    mpc_thr_max: Fraction
    mc_roll_p: Positive
    mc_pitch_p: Positive
    mc_yaw_p: Positive
    mc_rollrate_p: Positive
    mc_rollrate_i: NotNegative
    mc_rollrate_d: NotNegative
    mc_pitchrate_p: Positive
    mc_pitchrate_i: NotNegative
    mc_pitchrate_d: NotNegative
    mc_yawrate_p: Positive
    mc_yawrate_i: NotNegative
    mis_takeoff_alt: Positive
    com_of_loss_t: Positive
    com_disarm_land: float


class Simulation(Section, frozen=True):
    """What only the simulated vehicle needs."""

    imu_noise_m_s2: NotNegative
    imu_bias_m_s2: NotNegative
    imu_delay_s: NotNegative
    gyro_noise_rad_s: NotNegative
    pose_rate_hz: Positive
    pose_noise_m: NotNegative
    pose_delay_s: NotNegative
    attitude_noise_rad: NotNegative
    arm_vibration: ArmVibration
    ground_stiffness_n_m: Positive
    ground_damping_n_s_m: NotNegative
    ground_friction: NotNegative
    battery_v: Positive
    wind_north_east_m_s: tuple[float, float]
    gust_m_s: NotNegative
    gust_time_s: Positive


class VehicleConfig(Section, frozen=True):
    """The whole of `configs/dart.yaml`."""

    version: Literal[1]
    airframe: Airframe
    thrust: Thrust
    imu: Imu
    estimation: Estimation
    materials: dict[str, Material]
    onset: Literal["lcp", "touch"]
    vertical_force_sign: Literal[-1, 1]
    detection: Detection
    guard: Guard
    flying: Flying
    lock: LockConfig
    connection: Connection
    px4: Px4Parameters
    simulation: Simulation

    def hover_thrust_fraction(self) -> float:
        """Thrust at hover as a fraction of full thrust (what PX4 calls MPC_THR_HOVER)."""
        return self.airframe.mass_kg * 9.81 / (4.0 * self.thrust.full_n)


def packaged(*parts: str) -> Path:
    """A file of `configs/` or `missions/`: from the checkout, else the copy in the installed package."""
    checkout = Path(__file__).resolve().parents[2].joinpath(*parts)
    if checkout.exists():
        return checkout
    return Path(str(resources.files("dart_flight").joinpath("data", *parts)))


def default_config_path() -> Path:
    """$DART_FLIGHT_CONFIG, else ./configs/dart.yaml, else the packaged default."""
    named = os.environ.get("DART_FLIGHT_CONFIG")
    if named:
        return Path(named)
    local = Path("configs/dart.yaml")
    return local if local.exists() else packaged("configs", "dart.yaml")


def load_vehicle(path: str | Path | None = None) -> VehicleConfig:
    """Load and validate a vehicle configuration.

    Raises:
        InputError: as `Document`; or the thrust cannot carry the mass.
    """
    document = Document.load(path or default_config_path())
    config = document.convert(VehicleConfig)
    if config.hover_thrust_fraction() > 0.8:
        raise document.error(
            ("thrust", "full_n"),
            f"four motors of {config.thrust.full_n:g} N hover {config.airframe.mass_kg:g} kg at "
            f"{config.hover_thrust_fraction():.0%} of full thrust, at most 80 % is flown",
        )
    return config


__all__ = ["Coefficients", "InputError", "VehicleConfig", "default_config_path", "load_vehicle", "packaged"]
