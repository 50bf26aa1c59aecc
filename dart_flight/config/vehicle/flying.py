"""Motion between the contacts, and the thresholds at which the guard overrides it."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from dart_flight.config.section import Fraction, Metres, Seconds, SecondsOrZero, Section, Speed


class GuardThresholds(Section, frozen=True):
    """Thresholds of the guard's rules (docs/guard.md).

    Attributes:
        stream_timeout_s: IMU, attitude or odometry silent for longer than this: land.
        tilt_deg: tilt above this: land.
        wall_overrun_m: this far behind the wall's plane without a contact: break off.
        retreat_m: distance from the wall that is kept after breaking off.
        imu_timeout_s: only the IMU silent for longer than this: land.
        battery_remaining: remaining charge below this share: land.
        battery_v: battery voltage below this: land.
        kill_after_s: still armed in PX4's land mode for longer than this: motors off; null: never.
        wall_late_s: no contact this long after the planned impact: break off.
        wall_early_m: a contact more than this in front of the wall's plane is not with the planned wall:
            break off.
        deadman_s: core thread or event loop blocked for longer than this: the program is killed.
        telemetry_late_s: delay of samples above this: do not take off, or land.
        position_sd_m: standard deviation of the horizontal position reported by PX4; above this a mission
            with walls does not take off, or lands.
        position_delay_s: time by which the position estimate leads or lags the IMU; above this: break off;
            null: not checked.
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
        acceleration_m_s2: largest acceleration of the reference.
        jerk_m_s3: largest jerk of the reference; null: derived from speed and acceleration.
        yaw_rate_deg_s: largest yaw rate of the reference.
        steady_run_s: time at constant speed before the wall, so that the impact velocity is reached.
        setpoint_delay_s: delay from the stamp of an odometry sample until the autopilot executes the setpoint
            computed from it; the reference is evaluated this much later. null: 0.024 with PX4, none in the
            embedded simulator.
        attitude_delay_s: share of the thrust's lead time that the attitude's rate loop needs before it
            responds. null: 0.05 with PX4, none in the embedded simulator.
        ready_timeout_s: longest wait for telemetry, offboard mode, arming, the end of climb or transit.
        replan_within_s: time from the end of a contact to the start of a trajectory planned in flight; the
            planner must finish within it.
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
