"""Motion between the contacts, and the thresholds at which the guard overrides it."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from dart_flight.config.section import Fraction, Metres, Seconds, SecondsOrZero, Section, Speed


class GuardThresholds(Section, frozen=True):
    """Thresholds of the guard's rules (docs/guard.md).

    Attributes:
        stream_timeout_s: if the IMU, attitude or odometry is silent for longer than this, the vehicle lands.
        tilt_deg: if the tilt exceeds this angle, the vehicle breaks off.
        wall_overrun_m: if the vehicle is this far behind the wall's plane without a contact, it breaks off.
        retreat_m: distance that the vehicle keeps from the wall after breaking off.
        imu_timeout_s: if the IMU is silent for longer than this while the other streams continue, the vehicle
            lands.
        battery_remaining: if the remaining charge is below this fraction, the vehicle lands.
        battery_v: if the battery voltage is below this, the vehicle lands.
        kill_after_s: if the vehicle is still armed in PX4's land mode after this time, and after three times
            the expected descent time, the motors stop; null: never.
        wall_late_s: if no contact occurs within this time after the planned impact, the vehicle breaks off.
        wall_early_m: a contact farther than this in front of the wall's plane is not a contact with the
            planned wall, and the vehicle breaks off.
        deadman_s: if the core thread or the event loop is blocked for longer than this, the program is
            killed.
        telemetry_late_s: if samples are delayed by more than this, the vehicle does not take off; in flight
            it lands.
        position_sd_m: largest standard deviation of the horizontal position reported by PX4. Above this value
            the vehicle does not take off for a mission with walls; in flight it lands.
        position_delay_s: largest time by which the position estimate may lead or lag the IMU. Above this
            value the vehicle breaks off; null: not checked.
    """

    stream_timeout_s: Seconds
    tilt_deg: Annotated[float, Meta(gt=0.0, le=180.0)]
    wall_overrun_m: Metres
    retreat_m: Metres
    imu_timeout_s: Seconds
    battery_remaining: Fraction
    battery_v: Annotated[float, Meta(ge=0.0, le=100.0)]
    kill_after_s: Seconds | None
    wall_late_s: Seconds
    wall_early_m: Metres
    deadman_s: Annotated[float, Meta(ge=0.1, le=2.0)]
    telemetry_late_s: Seconds = 0.075
    position_sd_m: Metres = 0.1
    position_delay_s: Seconds | None = None


class Flying(Section, frozen=True):
    """Motion of the vehicle between the collisions.

    Attributes:
        climb_speed_m_s: largest speed of the climb.
        transit_speed_m_s: largest speed of transits, to the run-up point and to the goal.
        acceleration_m_s2: largest acceleration of the reference, the motion that the setpoints command.
        jerk_m_s3: largest jerk of the reference; null: derived from speed and acceleration.
        yaw_rate_deg_s: largest yaw rate of the reference.
        steady_run_s: time at constant speed before the wall, in which the vehicle settles at the impact
            velocity.
        setpoint_delay_s: time from the stamp of an odometry sample until the autopilot executes the setpoint
            for this sample. The setpoint is the reference at the sample's time plus this delay. null: 0.024
            with PX4, 0 in the embedded simulator.
        attitude_delay_s: delay of the attitude's rate loop, in addition to setpoint_delay_s. The setpoint's
            acceleration and jerk are those of the reference at the sample's time plus both delays. null: 0.05
            with PX4, 0 in the embedded simulator.
        ready_timeout_s: timeout for telemetry, for offboard mode, for arming, and for the end of a climb or
            transit.
        replan_within_s: time from the end of a contact to the start of a trajectory planned in flight; the
            planner must finish within this time.
    """

    climb_speed_m_s: Speed
    transit_speed_m_s: Speed
    acceleration_m_s2: Annotated[float, Meta(gt=0.0, le=50.0)]
    yaw_rate_deg_s: Annotated[float, Meta(gt=0.0, le=720.0)]
    steady_run_s: SecondsOrZero
    ready_timeout_s: Seconds
    replan_within_s: Annotated[float, Meta(gt=0.0, le=2.0)] = 0.1
    jerk_m_s3: Annotated[float, Meta(gt=0.0, le=1000.0)] | None = None
    setpoint_delay_s: Annotated[float, Meta(ge=0.0, le=0.2)] | None = None
    attitude_delay_s: Annotated[float, Meta(ge=0.0, le=0.15)] | None = None
