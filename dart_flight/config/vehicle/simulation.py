"""What only the simulated vehicle needs."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from dart_flight.config.section import Seconds, Section, Volts
from dart_flight.config.vehicle.estimation import ArmVibration

Wind = Annotated[float, Meta(ge=-50.0, le=50.0)]


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
    """

    imu_noise_m_s2: Annotated[float, Meta(ge=0.0, le=50.0)]
    imu_bias_m_s2: Annotated[float, Meta(ge=0.0, le=20.0)]
    imu_delay_s: Annotated[float, Meta(ge=0.0, le=1.0)]
    gyro_noise_rad_s: Annotated[float, Meta(ge=0.0, le=10.0)]
    pose_rate_hz: Annotated[float, Meta(ge=1.0, le=1000.0)]
    pose_noise_m: Annotated[float, Meta(ge=0.0, le=10.0)]
    pose_delay_s: Annotated[float, Meta(ge=0.0, le=1.0)]
    attitude_noise_rad: Annotated[float, Meta(ge=0.0, le=1.0)]
    arm_vibration: ArmVibration
    ground_stiffness_n_m: Annotated[float, Meta(ge=1.0, le=1000000.0)]
    ground_damping_n_s_m: Annotated[float, Meta(ge=0.0, le=100000.0)]
    ground_friction: Annotated[float, Meta(ge=0.0, le=10.0)]
    battery_v: Volts
    wind_north_east_m_s: tuple[Wind, Wind]
    gust_m_s: Annotated[float, Meta(ge=0.0, le=50.0)]
    gust_time_s: Seconds
