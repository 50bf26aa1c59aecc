"""What only the simulated vehicle needs."""

from __future__ import annotations

from dart_flight.config.section import NotNegative, Positive, Section
from dart_flight.config.vehicle.estimation import ArmVibration


class ImuRinging(Section, frozen=True):
    """What motors and frame shake into the accelerometer, per axis of the reported sample, root mean square.

    Attributes:
        white_m_s2: without any colour, beside imu_noise_m_s2.
        tone_m_s2: of one tone.
        tone_hz_low: the tone wanders from here ...
        tone_hz_high: ... to here, over seconds.
    """

    white_m_s2: NotNegative = 0.0
    tone_m_s2: NotNegative = 0.0
    tone_hz_low: Positive = 50.0
    tone_hz_high: Positive = 200.0

    def __post_init__(self) -> None:
        if self.tone_hz_low > self.tone_hz_high:
            raise ValueError(f"tone_hz_low {self.tone_hz_low:g} must not exceed tone_hz_high")


class Simulation(Section, frozen=True):
    """What only the simulated vehicle needs.

    Attributes:
        imu_noise_m_s2: standard deviation of one accelerometer sample, per axis.
        imu_bias_m_s2: standard deviation of the accelerometer's bias, per axis.
        imu_delay_s: without effect; kept so that older files load.
        gyro_noise_rad_s: standard deviation of one gyro sample, per axis.
        pose_rate_hz: of the motion capture.
        pose_noise_m: standard deviation of the motion capture's position, per axis.
        pose_delay_s: of the motion capture.
        attitude_noise_rad: standard deviation of the motion capture's attitude, per axis.
        arm_vibration: of the unlocked arms, as the simulated IMU feels it.
        ground_stiffness_n_m: of the ground under a resting vehicle.
        ground_damping_n_s_m: of the ground under a resting vehicle.
        ground_friction: friction coefficient of the ground.
        battery_v: voltage that is reported.
        wind_north_east_m_s: [north, east], steady; where the air goes to.
        gust_m_s: standard deviation of gusts beside the steady wind, per axis.
        gust_time_s: correlation time of the gusts.
        imu_ringing: what motors and frame shake into the accelerometer; null: nothing.
    """

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
    imu_ringing: ImuRinging | None = None
