"""Connection to the autopilot, and its parameters."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from dart_flight.config.link_url import link_problem
from dart_flight.config.section import Fraction, Seconds, Section, Speed

Gain = Annotated[float, Meta(gt=0.0, le=1000.0)]
GainOrZero = Annotated[float, Meta(ge=0.0, le=1000.0)]


class ConnectionConfig(Section, frozen=True):
    """Connection to the autopilot.

    Attributes:
        url: connection URL of MAVSDK, such as serial:///dev/ttyAMA0:921600 or udpin://0.0.0.0:14540.
        timeout_s: timeout for the autopilot's heartbeat.
    """

    url: str
    timeout_s: Seconds

    def __post_init__(self) -> None:
        problem = link_problem(self.url)
        if problem is not None:
            raise ValueError(f"url {problem}")


class GroundStation(Section, frozen=True):
    """The ground station whose buttons control the program (docs/ground_station.md).

    Attributes:
        system_id: MAVLink system id of the ground station; commands from any other system are denied.
    """

    system_id: Annotated[int, Meta(ge=1, le=255)] = 255


class Px4Parameters(Section, frozen=True, rename="upper"):
    """PX4 parameters that the flight model and the embedded autopilot use, by PX4's own names.

    Attributes:
        mpc_xy_p: velocity per horizontal position error, 1/s.
        mpc_z_p: velocity per vertical position error, 1/s.
        mpc_xy_vel_p_acc: acceleration per horizontal velocity error, 1/s.
        mpc_xy_vel_i_acc: acceleration per integral of the horizontal velocity error, 1/s2.
        mpc_xy_vel_d_acc: fraction of the measured horizontal acceleration that PX4 subtracts from its
            command.
        mpc_z_vel_p_acc: acceleration per vertical velocity error, 1/s.
        mpc_z_vel_i_acc: acceleration per integral of the vertical velocity error, 1/s2.
        mpc_z_vel_d_acc: fraction of the measured vertical acceleration that PX4 subtracts from its command.
        mpc_xy_vel_max: largest horizontal velocity setpoint, m/s.
        mpc_z_vel_max_up: largest climb velocity setpoint, m/s.
        mpc_z_vel_max_dn: largest descent velocity setpoint, m/s.
        mpc_tiltmax_air: largest tilt setpoint in the air, degrees.
        mpc_land_speed: descent speed of a landing, m/s.
        mpc_thr_min: smallest collective thrust, 0 to 1.
        mpc_thr_max: largest collective thrust, 0 to 1.
        mc_roll_p: roll rate per roll error, 1/s.
        mc_pitch_p: pitch rate per pitch error, 1/s.
        mc_yaw_p: yaw rate per yaw error, 1/s.
        mc_rollrate_p: normalised torque per roll rate error, s/rad.
        mc_rollrate_i: normalised torque per integral of the roll rate error, 1/rad.
        mc_rollrate_d: opposing normalised torque per roll acceleration, s2/rad.
        mc_pitchrate_p: normalised torque per pitch rate error, s/rad.
        mc_pitchrate_i: normalised torque per integral of the pitch rate error, 1/rad.
        mc_pitchrate_d: opposing normalised torque per pitch acceleration, s2/rad.
        mc_yawrate_p: normalised torque per yaw rate error, s/rad.
        mc_yawrate_i: normalised torque per integral of the yaw rate error, 1/rad.
        mis_takeoff_alt: height of PX4's own take-off, m.
        com_of_loss_t: time without setpoints after which PX4's failsafe acts, s.
        com_disarm_land: time on the ground after which PX4 disarms, s; 0 or negative: never.
        mpc_veld_lp: cut-off frequency of the low-pass filter on the derivative in the velocity loop's D
            terms, Hz.
    """

    mpc_xy_p: Gain
    mpc_z_p: Gain
    mpc_xy_vel_p_acc: Gain
    mpc_xy_vel_i_acc: GainOrZero
    mpc_xy_vel_d_acc: GainOrZero
    mpc_z_vel_p_acc: Gain
    mpc_z_vel_i_acc: GainOrZero
    mpc_z_vel_d_acc: GainOrZero
    mpc_xy_vel_max: Speed
    mpc_z_vel_max_up: Speed
    mpc_z_vel_max_dn: Speed
    mpc_tiltmax_air: Annotated[float, Meta(gt=0.0, lt=90.0)]
    mpc_land_speed: Speed
    mpc_thr_min: Fraction
    mpc_thr_max: Fraction
    mc_roll_p: Gain
    mc_pitch_p: Gain
    mc_yaw_p: Gain
    mc_rollrate_p: Gain
    mc_rollrate_i: GainOrZero
    mc_rollrate_d: GainOrZero
    mc_pitchrate_p: Gain
    mc_pitchrate_i: GainOrZero
    mc_pitchrate_d: GainOrZero
    mc_yawrate_p: Gain
    mc_yawrate_i: GainOrZero
    mis_takeoff_alt: Annotated[float, Meta(gt=0.0, le=100.0)]
    com_of_loss_t: Annotated[float, Meta(gt=0.0, le=60.0)]
    com_disarm_land: Annotated[float, Meta(ge=-1.0, le=600.0)]
    mpc_veld_lp: Annotated[float, Meta(gt=0.0, le=100.0)] = 5.0  # PX4's default
