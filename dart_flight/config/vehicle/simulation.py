"""What only the simulated vehicle needs."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from msgspec import Meta

from dart_flight.config.section import Fraction, Section, Volts
from dart_flight.config.vehicle.estimation import ArmVibration

Wind = Annotated[float, Meta(ge=-50.0, le=50.0)]
Lever = Annotated[float, Meta(ge=-1.0, le=1.0)]


class BodyModel(StrEnum):
    """What of the simulated vehicle touches a wall."""

    POINT = "point"
    GUARDS = "guards"


class ContactBody(Section, frozen=True):
    """The simulated vehicle as a body that touches walls.

    Attributes:
        body: point: the centre of mass, as in the paper's equations; guards: two guard points a side.
        guard_out_m: from the centre of mass to the guards' plane.
        guard_along_m: from the middle of a side to either of its guards.
        guard_height_m: of the guards above the centre of mass.
        friction_lever_share: share of the guards' lever at which friction acts; 0: through the centre of
            mass, 1: at the guards.
        vertical_lever_m: how far outside of the centre of mass the vertical force acts.
        fold_share: share of a guard's penetration by which its free arm swings back, its motor with it; 0:
            motors stay where they are.
        scatter: standard deviation of the coefficients from hit to hit, relative.
        half_engaged: the rods stop half-way: the arms are neither locked nor free.
    """

    body: BodyModel = BodyModel.GUARDS
    guard_out_m: Annotated[float, Meta(gt=0.0, le=2.0)] = 0.20
    guard_along_m: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.13
    guard_height_m: Annotated[float, Meta(ge=-0.5, le=0.5)] = 0.0
    friction_lever_share: Fraction = 0.3
    vertical_lever_m: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.01
    fold_share: Fraction = 0.7
    scatter: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    half_engaged: bool = False


class ImuRinging(Section, frozen=True):
    """What turning motors and the frame shake into the accelerometer, per axis of the reported sample, RMS.

    Attributes:
        white_m_s2: without any colour, beside imu_noise_m_s2.
        tone_m_s2: of one tone.
        tone_hz_low: the tone wanders from here ...
        tone_hz_high: ... to here, over seconds.
    """

    white_m_s2: Annotated[float, Meta(ge=0.0, le=50.0)] = 0.0
    tone_m_s2: Annotated[float, Meta(ge=0.0, le=50.0)] = 0.0
    tone_hz_low: Annotated[float, Meta(gt=0.0, le=1000.0)] = 50.0
    tone_hz_high: Annotated[float, Meta(gt=0.0, le=1000.0)] = 200.0

    def __post_init__(self) -> None:
        if self.tone_hz_low > self.tone_hz_high:
            raise ValueError(f"tone_hz_low {self.tone_hz_low:g} must not exceed tone_hz_high")


class Simulation(Section, frozen=True, kw_only=True):
    """What only the simulated vehicle needs.

    Attributes:
        imu_noise_m_s2: standard deviation of one accelerometer sample, per axis.
        pose_rate_hz: of the motion capture.
        pose_delay_s: of the motion capture.
        arm_vibration: of the unlocked arms, as the simulated IMU feels it; null: none.
        ground_stiffness_n_m: of the ground under a resting vehicle.
        ground_damping_n_s_m: of the ground under a resting vehicle.
        battery_v: voltage that is reported.
        wind_north_east_m_s: [north, east], steady; where the air goes to.
        gust_m_s: standard deviation of gusts beside the steady wind, per axis.
        contact: the vehicle as a body that touches walls.
        imu_ringing: what motors and frame shake into the accelerometer while the motors turn; null: nothing.
        imu_position_m: [forward, right, down] of the centre of mass, where the IMU really is.
        replan_latency_s: from a request to plan anew to its answer, where time is simulated.
        position_from: where the embedded autopilot has its position from: mocap: motion capture; rtk, plain:
            a GPS receiver with or without corrections. A real PX4 has options for it.
        operator_s: from the beginning of a pause to the operator's word, where time is simulated; null: there
            is none, the pause runs out.
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
