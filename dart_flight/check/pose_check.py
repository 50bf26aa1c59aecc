"""The check of the motion capture whose poses this program forwards to PX4."""

from __future__ import annotations

from dart_flight.check.findings import CheckFinding
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.vehicle.ground_link import Observation
from dart_flight.vehicle.motion_capture.pose_statistics import GAP_US

_ITEM = "pose_source"
_RATE_SHARE = 0.8  # required fraction of mocap.rate_hz
_LOST = 0.05  # allowed fraction of poses without a tracked body
_AGE_MS, _GROWTH_MS = 100.0, 20.0
_APART_M, _APART_DEG = 0.2, 10.0  # maximum deviation of PX4's estimate from the poses while the vehicle rests
_ARRIVES_HZ = 0.2


def evaluate_poses(config: MotionCapture, observed: Observation) -> list[CheckFinding]:
    """Return a finding for each defect of the poses, or a single finding if the poses are correct.

    Return nothing if this program does not need to forward poses. The vehicle must be at rest.
    """
    poses = observed.poses
    if poses is None:
        absent = observed.pose_problem
        return [] if absent is None else [CheckFinding(_ITEM, False, f"no poses: {absent}")]
    if poses.rate_hz == 0.0:
        why = observed.pose_problem or "the body is not tracked"
        return [CheckFinding(_ITEM, False, f"no poses from {config.url}: {why}")]
    wrong = []
    if poses.rate_hz < _RATE_SHARE * config.rate_hz:
        wrong.append(
            f"{poses.rate_hz:.0f} poses/s, minimum {_RATE_SHARE * config.rate_hz:.0f}: "
            "raise the camera rate or check the network for losses"
        )
    if poses.lost > _LOST or poses.gaps:
        wrong.append(
            f"body lost in {100.0 * poses.lost:.0f} % of the poses, {poses.gaps} gaps of more than "
            f"{1e-6 * GAP_US:g} s, longest {poses.longest_gap_s:.2f} s: check markers and cameras"
        )
    if len(poses.senders) > 1:
        wrong.append(f"two sources send the body: {', '.join(poses.senders)}; stop one of them")
    growth_ms = poses.age_growth_ms or 0.0
    if observed.pose_problem is not None:
        wrong.append(observed.pose_problem)
    elif growth_ms > _GROWTH_MS:
        wrong.append(f"the age of the poses grew by {growth_ms:.0f} ms: use a cable or a lower camera rate")
    elif poses.age_ms is not None and poses.age_ms > _AGE_MS:
        wrong.append(f"poses are {poses.age_ms:.0f} ms old, limit {_AGE_MS:g} ms: use a cable")
    apart_m, apart_deg = poses.distance_to_px4_m, poses.angle_to_px4_deg
    if apart_m is None or apart_deg is None:
        wrong.append("PX4 has no estimate from the poses: check EKF2_EV_CTRL and EKF2_HGT_REF")
    elif apart_m > _APART_M or apart_deg > _APART_DEG:
        wrong.append(
            f"PX4's estimate is {apart_m:.2f} m and {apart_deg:.0f} deg off the poses: "
            "check EKF2_EV_CTRL, and that no other program sends poses"
        )
    findings = [CheckFinding(_ITEM, False, message) for message in wrong]
    if not wrong:
        age = "" if poses.age_ms is None else f", {poses.age_ms:.0f} ms old"
        message = (
            f"{poses.rate_hz:.0f} poses/s{age}; PX4's estimate is {apart_m:.2f} m and {apart_deg:.1f} deg off"
        )
        findings = [CheckFinding(_ITEM, True, message)]
    if poses.age_ms is None:
        message = (
            "the poses have no stamps, or stamps that do not advance in fractions of a second: "
            "the program uses their time of arrival and cannot detect growing delays"
        )
        findings.append(CheckFinding(_ITEM, True, message, remark=True))
    answering = sorted(
        f"system {s.sender.system} component {s.sender.component}"
        for s in observed.sources
        if s.sender.message == "TIMESYNC" and not s.is_vehicle and s.arriving_hz >= _ARRIVES_HZ
    )
    if answering:
        message = (
            f"{', '.join(answering)} sends TIMESYNC. If it replies to PX4, PX4 uses that sender's clock for "
            "pose timestamps and EKF2_EV_DELAY is wrong. Disable TIMESYNC in that sender."
        )
        findings.append(CheckFinding(_ITEM, True, message, remark=True))
    return findings
