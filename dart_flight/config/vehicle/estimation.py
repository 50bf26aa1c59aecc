"""The estimate of the external force and the detection of impacts in it."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from msgspec import Meta

from dart_flight.config.section import Fraction, Section, Volts


class ThrustSource(StrEnum):
    """What the thrust is computed from; `auto` takes the motors' speed where it comes often enough."""

    AUTO = "auto"
    ESC = "esc"
    ACTUATOR = "actuator"


class BatteryModel(Section, frozen=True):
    """Thrust at a command against battery voltage: thrust = curve * (voltage / reference_v) ** exponent.

    Attributes:
        reference_v: battery voltage at which thrust.full_n was calibrated.
        exponent: 0: the voltage does not matter; `calibrate thrust` fits it.
    """

    reference_v: Volts
    exponent: Annotated[float, Meta(ge=0.0, le=5.0)]


class ArmVibration(Section, frozen=True):
    """The damped in-plane vibration of the unlocked arms, as the IMU feels it.

    Attributes:
        frequency_hz: undamped natural frequency.
        damping_ratio: 0: none, 1: critical.
        mass_fraction: the arms' share of the vehicle's mass.
    """

    frequency_hz: Annotated[float, Meta(ge=0.1, le=1000.0)]
    damping_ratio: Fraction
    mass_fraction: Fraction


class WallPrior(Section, frozen=True):
    """What is believed of a wall before it is met, and when a mode counts as felt (docs/felt.md).

    Attributes:
        spread: standard deviation of k, f, mu and nu of a wall from the table's, relative.
    """

    spread: Annotated[float, Meta(gt=0.0, le=2.0)] = 0.3


class Estimation(Section, frozen=True, kw_only=True):
    """The estimate of the external force (docs/force.md).

    Attributes:
        thrust_source: where the thrust comes from; auto: esc where it comes often enough, else actuator.
        thrust_error_n: standard deviation of the whole thrust after calibration.
        esc_thrust_n_per_rpm2: one motor's thrust over its speed squared, m g / (sum of rpm^2) at hover; null:
            motor speeds are not used.
        imu_noise_m_s2: standard deviation of one sample, until it has been measured in flight.
        baseline_limit_n: largest force that the baseline takes off.
        arm_vibration: what the IMU feels of the unlocked arms; null: not taken out.
        walls: what is believed of a wall before it is met.
        position_drift_m_s: standard deviation of the velocity with which PX4's position drifts where GPS's
            velocity carries it: what is known of the mission frame between two contacts (docs/anchors.md).
    """

    thrust_source: ThrustSource
    thrust_error_n: Annotated[float, Meta(ge=0.0, le=100.0)]
    esc_thrust_n_per_rpm2: Annotated[float, Meta(gt=0.0, le=1e-3)] | None
    battery: BatteryModel
    imu_noise_m_s2: Annotated[float, Meta(gt=0.0, le=50.0)]
    baseline_limit_n: Annotated[float, Meta(ge=0.0, le=1000.0)]
    arm_vibration: ArmVibration | None = None
    walls: WallPrior = WallPrior()
    position_drift_m_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.04

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
    """When a force is an impact.

    Attributes:
        force_threshold_n: horizontal force, less the baseline, from which on it is an impact.
        threshold_test: magnitude: of the horizontal force; per_axis: the larger of its mission components.
        peak_wait_s: longest wait for the peak after the onset.
        refractory_s: time after a contact in which no new impact is registered.
        noise_sigma: the threshold is at least this many times the learnt noise of what is compared with it.
    """

    force_threshold_n: Annotated[float, Meta(gt=0.0, le=1000.0)]
    threshold_test: ThresholdTest
    peak_wait_s: Annotated[float, Meta(gt=0.0, le=10.0)]
    refractory_s: Annotated[float, Meta(ge=0.0, le=10.0)]
    noise_sigma: Annotated[float, Meta(gt=0.0, le=100.0)] = 5.0
