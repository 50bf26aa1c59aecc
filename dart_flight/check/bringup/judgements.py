"""Pure functions that convert the samples of a bring-up step to a finding; `steps` uses them.

Axes are the vehicle's, FRD: x forward, y to the right, z down. An accelerometer at rest measures the support
force: (0, 0, -g) when level, a negative x with the nose down, a negative y with the right side down.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from enum import StrEnum

import msgspec

from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    IDENTITY,
    Quaternion,
    RoomFrame,
    Vec2,
    Vec3,
    norm,
    subtract,
    wrap_deg,
    yaw_ned_of,
)
from dart_flight.base.records import ImuSample, LockPhase, LockState, Mode, OdometrySample
from dart_flight.check.bringup.pose_motion import MotionEstimate
from dart_flight.check.telemetry_check import StreamRate
from dart_flight.config.vehicle import LockConfig
from dart_flight.config.vehicle.mocap import MotionCapture

_WINDOW_US = 500_000  # minimum time for which the vehicle must be held still
_STILL_M_S2 = 0.6  # maximum standard deviation of the specific force in a steady hand
_TILTED_DEG = (20.0, 60.0)
_AXIS_DEG = 30.0  # direction tolerance when the operator tilts, pushes or carries the vehicle
_LEVEL_DEG = 12.0
_PUSH_M_S2 = 3.0
_PUSH_US = 30_000  # averaging time, longer than a bump and shorter than a push
_CARRIED_M = 0.4
_RESTING_M_S = 0.15
_TURNED_RAD_S, _TILTING_RAD_S, _CARRIED_M_S2 = 0.3, 0.15, 0.5  # minimum motion for identifying the axes
_SAME_RATES, _SAME_FORCES = 0.9, 0.7  # minimum correlations; unrelated rates correlate by up to 0.8
_POSE_AXIS_DEG = 10.0
_SCALE = 0.1
_OLDEST_POSE_MS = 100.0


class StepOutcome(StrEnum):
    """The outcome of a bring-up step."""

    PASS = "pass"
    FAIL = "fail"
    SKIPPED = "skipped"
    NEEDS_OPERATOR = "needs operator"


Measured = dict[str, float | str | None]


class StepFinding(msgspec.Struct, frozen=True):
    """The outcome of a step, its explanation, and the measured values, whose names contain the units."""

    result: StepOutcome
    message: str
    measured: Measured = {}


def passed(message: str, **measured: float | str | None) -> StepFinding:
    return StepFinding(StepOutcome.PASS, message, measured)


def failed(message: str, **measured: float | str | None) -> StepFinding:
    """Return the finding of a failed step; the message names the remedy."""
    return StepFinding(StepOutcome.FAIL, message, measured)


# --- link ----------------------------------------------------------------------------------------------


def evaluate_link(
    rates: Sequence[StreamRate], round_trip_s: float | None, limit_s: float, errors: Mapping[str, float]
) -> StepFinding:
    """Check the rates of the streams that a mission needs, the round trip and the link's errors.

    Args:
        round_trip_s: shortest round trip, or None if the vehicle did not answer TIMESYNC.
        errors: `drop_rate_comm` (in units of 0.01 %) and `errors_comm` of SYS_STATUS.
    """
    measured: Measured = {f"{stream.name}_hz": round(stream.rate_hz, 1) for stream in rates}
    measured["round_trip_ms"] = None if round_trip_s is None else round(1e3 * round_trip_s, 2)
    measured |= errors
    slow = [stream for stream in rates if not stream.enough]
    if any(stream.unusable for stream in slow):
        message = "; ".join(f"{stream.name}: {stream.unusable}" for stream in slow if stream.unusable)
        return failed(message, **measured)
    if slow:
        message = (
            "too slow: "
            + "; ".join(f"{stream.name} {stream.describe}" for stream in slow)
            + ". Raise SER_TEL2_BAUD and MAV_1_RATE, set MAV_1_MODE to Onboard"
        )
        return failed(message, **measured)
    if round_trip_s is not None and round_trip_s > limit_s:
        message = (
            f"the round trip takes {1e3 * round_trip_s:.0f} ms, limit {1e3 * limit_s:.0f} ms: remove the "
            "radio or the bridge from the link"
        )
        return failed(message, **measured)
    if errors.get("drop_rate_comm", 0.0) > 100.0:
        share = errors["drop_rate_comm"] / 100.0
        return failed(
            f"the flight controller loses {share:.1f} % of the messages: check the wires, including ground",
            **measured,
        )
    return passed("all streams arrive at their rates", **measured)


# --- IMU -----------------------------------------------------------------------------------------------


def mean_while_still(samples: Sequence[ImuSample]) -> Vec3 | None:
    """Return the mean specific force of the last half second, m/s2, FRD.

    The result is None if the samples span less than half a second, or if the vehicle moves.
    """
    if not samples or samples[-1].t_us - samples[0].t_us < _WINDOW_US:
        return None
    since = samples[-1].t_us - _WINDOW_US
    forces = [s.specific_force_frd for s in samples if s.t_us >= since]
    n = len(forces)
    mean = tuple(sum(f[k] for f in forces) / n for k in range(3))
    spread = max(math.sqrt(sum((f[k] - mean[k]) ** 2 for f in forces) / n) for k in range(3))
    return (mean[0], mean[1], mean[2]) if spread <= _STILL_M_S2 else None


def tilt_between_deg(level: Vec3, now: Vec3) -> float:
    """Return the angle between two specific forces measured at rest, degrees."""
    cosine = sum(a * b for a, b in zip(level, now, strict=True)) / max(1e-9, norm(level) * norm(now))
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def is_tilted(level: Vec3, now: Vec3) -> bool:
    return _TILTED_DEG[0] <= tilt_between_deg(level, now) <= _TILTED_DEG[1]


def evaluate_level(level: Vec3) -> StepFinding | None:
    """Return a finding if the specific force does not match a level vehicle; None if it is correct."""
    tilt = math.degrees(math.atan2(math.hypot(level[0], level[1]), -level[2]))
    measured: Measured = {f"level_{axis}_m_s2": round(v, 2) for axis, v in zip("xyz", level, strict=True)}
    if tilt > 180.0 - 3 * _LEVEL_DEG:
        message = "the IMU reads upside down: set SENS_BOARD_ROT to match the board's mounting"
        return failed(message, **measured)
    if tilt > _LEVEL_DEG:
        message = (
            f"the IMU reads {tilt:.0f} degrees off level: level the vehicle; if it is level, calibrate "
            "SENS_BOARD_X_OFF and SENS_BOARD_Y_OFF"
        )
        return failed(message, **measured)
    if abs(norm(level) - GRAVITY_M_S2) > 0.5:
        message = (
            f"the IMU reads {norm(level):.2f} m/s2 at rest, not {GRAVITY_M_S2:.2f}: calibrate its "
            "accelerometer"
        )
        return failed(message, **measured)
    return None


def evaluate_axes(level: Vec3, nose_down: Vec3, right_down: Vec3) -> StepFinding:
    """Check the IMU's forward and right axes from the mean specific forces in three attitudes, m/s2, FRD."""
    wrong = evaluate_level(level)
    if wrong is not None:
        return wrong
    # The reading tilts away from the lowered side: nose down gives -x, right side down gives -y.
    forward = _heading_deg(subtract(nose_down, level)) - 180.0
    right = _heading_deg(subtract(right_down, level)) + 90.0
    forward, right = wrap_deg(forward), wrap_deg(right)
    measured: Measured = {"forward_error_deg": round(forward, 1), "right_error_deg": round(right, 1)}
    if abs(forward) <= _AXIS_DEG and abs(right) <= _AXIS_DEG:
        return passed("the IMU's axes match the vehicle's", **measured)
    if abs(wrap_deg(forward - right)) <= 2.0 * _AXIS_DEG:
        turned = 90.0 * round((forward + 0.5 * wrap_deg(right - forward)) / 90.0)
        message = (
            f"the axes are rotated by {turned:.0f} degrees: set SENS_BOARD_ROT to match the board's mounting"
        )
        return failed(message, **measured)
    message = (
        "the axes are mirrored, or the vehicle was not tilted nose down and then right side down: repeat "
        "the step"
    )
    return failed(message, **measured)


# --- force ---------------------------------------------------------------------------------------------


class Push(msgspec.Struct, frozen=True):
    """A push measured by the IMU: time of detection, and acceleration along x and y, FRD."""

    t_us: int
    acceleration_m_s2: Vec2


def find_push(samples: Sequence[ImuSample], level: Vec3) -> Push | None:
    """Return the first push or None; a push is a horizontal acceleration that lasts longer than a bump."""
    start = 0
    for end, last in enumerate(samples):
        while last.t_us - samples[start].t_us > _PUSH_US:
            start += 1
        if start == 0 and last.t_us - samples[0].t_us < 0.8 * _PUSH_US:
            continue
        window = samples[start : end + 1]
        x, y = (sum(s.specific_force_frd[k] - level[k] for s in window) / len(window) for k in (0, 1))
        if math.hypot(x, y) > _PUSH_M_S2:
            return Push(last.t_us, (x, y))
    return None


def evaluate_push(push: Vec2, force: Vec2) -> StepFinding:
    """Check that a forward push points forward in the IMU and in the force estimate.

    Args:
        push: acceleration measured by the IMU, FRD x and y, m/s2.
        force: estimated external force at the same time, FRD x and y, newton.
    """
    push_deg, force_deg = (
        math.degrees(math.atan2(push[1], push[0])),
        math.degrees(math.atan2(force[1], force[0])),
    )
    size = math.hypot(*force)
    measured: Measured = {
        "push_direction_deg": round(push_deg, 1),
        "force_direction_deg": round(force_deg, 1),
        "force_n": round(size, 1),
    }
    if abs(push_deg) > 2.0 * _AXIS_DEG:
        message = (
            f"the push pointed {_side(push_deg)}, not forward: repeat the push from behind; "
            "if you did push forward, repeat imu_axes"
        )
        return failed(message, **measured)
    if abs(wrap_deg(force_deg - push_deg)) > _AXIS_DEG:
        message = (
            f"the estimated force points {_side(force_deg)}, the push pointed {_side(push_deg)}: "
            "attitude or yaw is wrong"
        )
        return failed(message, **measured)
    return passed("the estimated force of a forward push points forward", **measured)


# --- servo ---------------------------------------------------------------------------------------------


def evaluate_servo(config: LockConfig, moves: Sequence[tuple[Mode, LockState, bool | None]]) -> StepFinding:
    """Check that the lock reaches the commanded modes, and report its travel times.

    Args:
        moves: commanded mode, final state and confirmation of each move. The operator confirms whether the
            arms are in that mode. The confirmation is None if a limit switch has reported the mode, or if the
            lock has not settled.
    """
    measured: Measured = {}
    wrong = []
    for mode, state, confirmed in moves:
        measured[f"{mode}_travel_s"] = None
        if state.settled_us is not None and state.commanded_us is not None:
            measured[f"{mode}_travel_s"] = round((state.settled_us - state.commanded_us) * 1e-6, 3)
        if state.phase is not LockPhase.SETTLED:
            message = (
                f"{mode}: {state.reason or state.phase}; check supply, cable and `dart-flight lock status`"
            )
            return failed(message, **measured)
        if confirmed is False:
            wrong.append(mode)
    measured["travel_by"] = "switch" if all(state.feedback for _, state, _ in moves) else "configured time"
    if len(wrong) == len(moves):
        message = (
            "the lock moves in the wrong direction: swap lock.servo.rigid_pulse_us and flexible_pulse_us "
            "(`dart-flight lock calibrate`)"
        )
        return failed(message, **measured)
    if wrong:
        message = (
            f"the lock was commanded {wrong[0]}, but the arms are not {wrong[0]}: calibrate both ends "
            "(`dart-flight lock calibrate`)"
        )
        return failed(message, **measured)
    travel_s = config.servo.full_travel_s
    return passed(
        f"the lock reaches both ends; the configured time of a full travel is {travel_s:.2f} s", **measured
    )


# --- position ------------------------------------------------------------------------------------------


def measure_displacement(samples: Sequence[OdometrySample], q: Quaternion) -> Vec2 | None:
    """Return the displacement forward and to the right, relative to the initial heading, metres.

    The result is None if the distance is too short, or if the vehicle is still moving.

    Args:
        samples: odometry since the start.
        q: attitude at the start, FRD to NED.
    """
    if not samples:
        return None
    first, last = samples[0].position_ned, samples[-1]
    n, e = last.position_ned[0] - first[0], last.position_ned[1] - first[1]
    if math.hypot(n, e) < _CARRIED_M or math.hypot(*last.velocity_ned[:2]) > _RESTING_M_S:
        return None
    yaw = yaw_ned_of(q)
    return (n * math.cos(yaw) + e * math.sin(yaw), e * math.cos(yaw) - n * math.sin(yaw))


def evaluate_position(forward: Vec2, right: Vec2) -> StepFinding:
    """Check the estimated displacements of a vehicle carried forward and then to its right, metres."""
    f = math.degrees(math.atan2(forward[1], forward[0]))
    r = wrap_deg(math.degrees(math.atan2(right[1], right[0])) - 90.0)
    measured: Measured = {
        "forward_m": round(math.hypot(*forward), 2),
        "forward_error_deg": round(f, 1),
        "right_m": round(math.hypot(*right), 2),
        "right_error_deg": round(r, 1),
    }
    if abs(f) <= _AXIS_DEG and abs(r) <= _AXIS_DEG:
        return passed("the position follows the vehicle", **measured)
    if abs(wrap_deg(f - r)) <= 2.0 * _AXIS_DEG:
        turned = 90.0 * round(f / 90.0)
        message = f"position or heading is rotated by {f:.0f} degrees" + (
            f": rotate the source's axes by {turned:.0f} degrees to PX4's north, east, down" if turned else ""
        )
        return failed(message, **measured)
    message = (
        "left and right are swapped: the source's frame is probably ENU, or its y axis points left; set "
        "the frame to north, east, down"
    )
    return failed(message, **measured)


def is_moved_enough(motion: MotionEstimate) -> bool:
    x, y, z = motion.turned_rad_s
    return z > _TURNED_RAD_S and min(x, y) > _TILTING_RAD_S and motion.carried_m_s2 > _CARRIED_M_S2


def evaluate_motion(
    motion: MotionEstimate, config: MotionCapture, round_trip_s: float | None, heading_off_deg: float | None
) -> StepFinding:
    """Evaluate the motion-capture poses of a vehicle that the operator has moved by hand.

    Args:
        motion: estimate from poses, gyro and accelerometer.
        config: configuration that was used to convert the poses.
        round_trip_s: round trip of the link, or None if unknown. The round trip contains the delay of a pose
            from this program to PX4, and the delay of an IMU sample from PX4 to this program.
        heading_off_deg: PX4's heading minus the heading of the poses, or None if unknown.
    """
    delay_ms = 1e3 * max(0.0, motion.latency_s + (round_trip_s or 0.0))
    body_yaw_deg = math.degrees(math.atan2(motion.body_to_frd[1, 0], motion.body_to_frd[0, 0]))
    body_tilt_deg = math.degrees(math.acos(max(-1.0, min(1.0, float(motion.body_to_frd[2, 2])))))
    measured: Measured = {
        "delay_ms": round(delay_ms, 1),
        "rate_agreement": round(motion.rate_correlation, 3),
        "force_agreement": round(motion.force_correlation, 3),
        "scale": round(motion.scale, 3),
        "body_yaw_error_deg": round(body_yaw_deg, 1),
        "heading_error_deg": None if heading_off_deg is None else round(heading_off_deg, 1),
    }
    wrong = None
    if motion.rate_correlation < _SAME_RATES:
        wrong = (
            f"the body {config.url} does not rotate with this vehicle (correlation "
            f"{motion.rate_correlation:.2f}): the body belongs to another vehicle, or its markers are swapped"
        )
    elif motion.force_correlation < -_SAME_FORCES:
        wrong = "the room is mirrored: its axes are left-handed; change the sign of one axis at the source"
    elif _angle_deg(motion.up_room, (0.0, 0.0, -1.0)) > _POSE_AXIS_DEG:
        axis = _axis_of_room(motion.up_room, config)
        wrong = f"wrong axis: the room's {axis} axis points up, but mocap.up is {config.up}"
    elif body_tilt_deg > _POSE_AXIS_DEG:
        wrong = (
            f"wrong axis: the body is tilted by {body_tilt_deg:.0f} degrees relative to the vehicle; define "
            "the body again while the vehicle is level"
        )
    elif abs(body_yaw_deg) > _POSE_AXIS_DEG:
        nose_deg = wrap_deg(config.body_yaw_deg + body_yaw_deg)
        wrong = f"the body's yaw is wrong: set mocap.body_yaw_deg to {nose_deg:.0f}"
    elif motion.force_correlation < _SAME_FORCES:
        wrong = (
            "the body's motion does not match the accelerometer (correlation "
            f"{motion.force_correlation:.2f}): "
            "carry the vehicle farther; if the step fails again, check mocap.body_offset_m"
        )
    elif abs(motion.scale - 1.0) > _SCALE:
        wrong = (
            f"lengths are {motion.scale:.2f} times the true lengths: set the unit to metres or calibrate the "
            "cameras"
        )
    elif delay_ms > _OLDEST_POSE_MS:
        wrong = (
            f"poses are {delay_ms:.0f} ms old when they reach PX4, limit {_OLDEST_POSE_MS:g} ms: use a "
            "cable or less processing in the motion capture"
        )
    elif heading_off_deg is not None and abs(heading_off_deg) > _POSE_AXIS_DEG:
        wrong = (
            f"PX4's heading is {heading_off_deg:.0f} degrees off the heading of the poses: add 8 to "
            "EKF2_EV_CTRL, so that PX4 uses the heading of the poses, or correct mocap.heading_deg"
        )
    if wrong is not None:
        return failed(wrong, **measured)
    return passed(f"poses are {delay_ms:.0f} ms old when they reach PX4", **measured)


def _angle_deg(a: Vec3, b: Vec3) -> float:
    return math.degrees(math.acos(max(-1.0, min(1.0, sum(x * y for x, y in zip(a, b, strict=True))))))


def _axis_of_room(direction_ned: Vec3, config: MotionCapture) -> str:
    """Return the name of the room's axis, such as -y, that is nearest to a direction."""
    room = RoomFrame(config.up == "y", math.radians(config.heading_deg))
    parts = room.pose_from_ned(direction_ned, IDENTITY)[0]
    k = max(range(3), key=lambda i: abs(parts[i]))
    return ("-" if parts[k] < 0.0 else "") + "xyz"[k]


# --- remote control ------------------------------------------------------------------------------------


def evaluate_remote(received: bool, modes: Collection[str]) -> StepFinding:
    measured: Measured = {"modes": ", ".join(modes)}
    if not received:
        return failed(
            "PX4 receives no remote control: switch it on and bind it; check RC_INPUT and COM_RC_IN_MODE",
            **measured,
        )
    if len(modes) < 2:
        message = (
            "the flight mode did not change: assign a switch (RC_MAP_FLTMODE, COM_FLTMODE1 to 6) and flip "
            "the switch"
        )
        return failed(message, **measured)
    return passed("the flight mode follows the mode switch", **measured)


# --- helpers -------------------------------------------------------------------------------------------


def _heading_deg(v: Vec3) -> float:
    return math.degrees(math.atan2(v[1], v[0]))


def _side(angle_deg: float) -> str:
    """Return the side of the vehicle, such as left, that is nearest to a direction in body axes."""
    names = ("forward", "right", "back", "left")
    return names[round(wrap_deg(angle_deg) / 90.0) % 4]
