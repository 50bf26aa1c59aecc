"""Settings of the simulated vehicle."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from msgspec import Meta

from dart_flight.config.section import Fraction, Section, Volts
from dart_flight.config.vehicle.estimation import ArmVibration

Wind = Annotated[float, Meta(ge=-50.0, le=50.0)]
Lever = Annotated[float, Meta(ge=-1.0, le=1.0)]


class BodyModel(StrEnum):
    """Points of the simulated vehicle that touch a wall: the centre of mass, or the guards."""

    POINT = "point"
    GUARDS = "guards"


class ContactBody(Section, frozen=True):
    """The simulated vehicle as a body that touches walls.

    Attributes:
        body: point: the centre of mass, as in the paper's equations; guards: two guard points per side.
        guard_out_m: distance from the centre of mass to the guards' plane.
        guard_along_m: distance from the middle of a side to each of its two guards.
        guard_height_m: height of the guards above the centre of mass.
        guard_height_sd_m: standard deviation of that height between flights; `check` allows for it, and
            `--vary guard_height_m` draws it.
        friction_lever_share: lever arm of friction about the centre of mass, as a fraction of the guards'
            lever arm; 0: friction acts at the centre of mass, 1: at the guards.
        vertical_lever_m: lever arm of the wall's vertical force, outwards from the centre of mass.
        fold_share: movement of an unlocked arm and its motor, as a fraction of the guard's penetration; 0:
            motors do not move.
        scatter: relative standard deviation of the coefficients between impacts with the same wall.
        half_engaged: whether the rods stop half-way, which leaves the arms neither locked nor unlocked.
    """

    body: BodyModel = BodyModel.GUARDS
    guard_out_m: Annotated[float, Meta(gt=0.0, le=2.0)] = 0.20
    guard_along_m: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.13
    guard_height_m: Annotated[float, Meta(ge=-0.5, le=0.5)] = 0.0
    guard_height_sd_m: Annotated[float, Meta(ge=0.0, le=0.2)] = 0.02
    friction_lever_share: Fraction = 0.3
    vertical_lever_m: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.01
    fold_share: Fraction = 0.7
    scatter: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    half_engaged: bool = False


class ImuRinging(Section, frozen=True):
    """Vibration of motors and frame in the accelerometer's samples, as RMS values per axis.

    Attributes:
        white_m_s2: white noise, in addition to imu_noise_m_s2.
        tone_m_s2: amplitude of one tone.
        tone_hz_low: lower end of the range in which the tone's frequency drifts over seconds.
        tone_hz_high: upper end of that range.
    """

    white_m_s2: Annotated[float, Meta(ge=0.0, le=50.0)] = 0.0
    tone_m_s2: Annotated[float, Meta(ge=0.0, le=50.0)] = 0.0
    tone_hz_low: Annotated[float, Meta(gt=0.0, le=1000.0)] = 50.0
    tone_hz_high: Annotated[float, Meta(gt=0.0, le=1000.0)] = 200.0

    def __post_init__(self) -> None:
        if self.tone_hz_low > self.tone_hz_high:
            raise ValueError(f"tone_hz_low {self.tone_hz_low:g} must not exceed tone_hz_high")


class Simulation(Section, frozen=True, kw_only=True):
    """Settings of the simulated vehicle.

    Attributes:
        imu_noise_m_s2: standard deviation of one accelerometer sample, per axis.
        pose_rate_hz: rate of the motion capture's poses.
        pose_delay_s: age of a motion-capture pose when it reaches the autopilot.
        arm_vibration: vibration of the unlocked arms in the simulated IMU; null: none.
        ground_stiffness_n_m: stiffness of the ground under a resting vehicle.
        ground_damping_n_s_m: damping of the ground under a resting vehicle.
        battery_v: reported voltage.
        wind_north_east_m_s: steady wind velocity, [north, east].
        gust_m_s: standard deviation of gusts in addition to the steady wind, per axis.
        contact: the vehicle as a body that touches walls.
        imu_ringing: vibration in the accelerometer while the motors turn; null: none.
        imu_position_m: true position of the IMU relative to the centre of mass, [forward, right, down].
        replan_latency_s: time from a replanning request to its answer, in simulated time.
        position_from: position source of the embedded autopilot: mocap: motion capture; rtk, plain: a GPS
            receiver with or without corrections. If a real PX4 flies the simulated vehicle, command-line
            options select its position source.
        operator_s: time from the beginning of a pause until the operator continues, in simulated time; null:
            the operator does not respond, and the pause times out.
    """

    imu_noise_m_s2: Annotated[float, Meta(ge=0.0, le=50.0)]
    pose_rate_hz: Annotated[float, Meta(ge=1.0, le=1000.0)]
    pose_delay_s: Annotated[float, Meta(ge=0.0, le=1.0)]
    arm_vibration: ArmVibration | None = None
    ground_stiffness_n_m: Annotated[float, Meta(ge=1.0, le=1000000.0)]
    ground_damping_n_s_m: Annotated[float, Meta(ge=0.0, le=100000.0)]
    battery_v: Volts
    wind_north_east_m_s: tuple[Wind, Wind]
    gust_m_s: Annotated[float, Meta(ge=0.0, le=50.0)]
    contact: ContactBody = ContactBody()
    imu_ringing: ImuRinging | None = None
    imu_position_m: tuple[Lever, Lever, Lever] = (0.0, 0.0, 0.0)
    replan_latency_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.04
    position_from: Literal["mocap", "rtk", "plain"] = "mocap"
    operator_s: Annotated[float, Meta(ge=0.0, le=600.0)] | None = 2.0
