"""Settings of the external-force estimate and of the impact detection."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from msgspec import Meta

from dart_flight.config.section import Fraction, Section, Volts


class ThrustSource(StrEnum):
    """Source of the thrust; `auto` uses the motor speeds if they arrive often enough."""

    AUTO = "auto"
    ESC = "esc"
    ACTUATOR = "actuator"


class BatteryModel(Section, frozen=True):
    """Dependence of the thrust on the battery voltage: thrust = curve * (voltage / reference_v) ** exponent.

    Attributes:
        reference_v: battery voltage at which thrust.full_n was calibrated.
        exponent: 0 if the thrust does not depend on the voltage; `calibrate thrust` fits the exponent.
    """

    reference_v: Volts
    exponent: Annotated[float, Meta(ge=0.0, le=5.0)]


class ArmVibration(Section, frozen=True):
    """Damped in-plane vibration of the unlocked arms, as measured by the IMU.

    Attributes:
        frequency_hz: undamped natural frequency.
        damping_ratio: 0 without damping, 1 at critical damping.
        mass_fraction: the arms' fraction of the vehicle's mass.
    """

    frequency_hz: Annotated[float, Meta(ge=0.1, le=1000.0)]
    damping_ratio: Fraction
    mass_fraction: Fraction


class WallPrior(Section, frozen=True):
    """Prior of a wall's coefficients, before a contact (docs/contact_fit.md).

    Attributes:
        spread: relative standard deviation of a wall's k, f, mu and nu about the table's values.
    """

    spread: Annotated[float, Meta(gt=0.0, le=2.0)] = 0.3


class Estimation(Section, frozen=True, kw_only=True):
    """The estimate of the external force (docs/force.md).

    Attributes:
        thrust_source: source of the thrust; auto: esc if motor speeds arrive often enough, else actuator.
        thrust_error_n: standard deviation of the total thrust after calibration.
        esc_thrust_n_per_rpm2: one motor's thrust divided by the square of its speed, m g / (sum of rpm^2) at
            hover; null: motor speeds are not used.
        imu_noise_m_s2: initial standard deviation of one sample, until it is measured in flight.
        baseline_limit_n: largest horizontal baseline force. The baseline follows the force between contacts
            and is subtracted before detection.
        arm_vibration: vibration of the unlocked arms, removed from the IMU's samples; null: not removed.
        walls: prior of a wall's coefficients.
        position_drift_m_s: standard deviation of the drift velocity of PX4's position when PX4 relies on GPS
            velocity. The error of the mission frame between two contacts follows from this value
            (docs/anchors.md).
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
    """Comparison of the horizontal force with the threshold."""

    MAGNITUDE = "magnitude"
    PER_AXIS = "per_axis"


class Detection(Section, frozen=True):
    """Criteria for an impact.

    Attributes:
        force_threshold_n: an impact is detected if the horizontal force minus its baseline exceeds this
            threshold.
        threshold_test: the force that is compared with the threshold. magnitude: the horizontal force;
            per_axis: the larger of its two components along the mission's axes.
        peak_wait_s: longest time from the onset until the detector reports the peak.
        refractory_s: time after a contact in which no new impact is registered.
        noise_sigma: the threshold is at least this multiple of the measured noise of the tested force.
    """

    force_threshold_n: Annotated[float, Meta(gt=0.0, le=1000.0)]
    threshold_test: ThresholdTest
    peak_wait_s: Annotated[float, Meta(gt=0.0, le=10.0)]
    refractory_s: Annotated[float, Meta(ge=0.0, le=10.0)]
    noise_sigma: Annotated[float, Meta(gt=0.0, le=100.0)] = 5.0
