"""Retired keys of the vehicle configuration, which are now constants.

For one release a file with such a key still loads: the key is ignored with a warning. With the next release,
the key's row in `RETIRED` is removed, and the key becomes unknown. The constant and its reason are in the
module that uses it; a test compares the values.

To retire a key, remove it from its type and from configs/dart.yaml, and add a row here.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from dart_flight.config.document import Document


class RetiredKeyWarning(UserWarning):
    """Warning that a file contains a key that is now a constant."""


class RetiredKey(NamedTuple):
    """The constant that replaced a key.

    Attributes:
        constant: module below `dart_flight`, and name of the constant in that module.
    """

    value: Any
    constant: str


RETIRED: Final[Mapping[str, RetiredKey]] = {
    "guard.status_timeout_s": RetiredKey(3.0, "core.guard.stream_watch.STATUS_TIMEOUT_S"),
    "guard.actuator_timeout_s": RetiredKey(0.3, "core.guard.stream_watch.ACTUATOR_TIMEOUT_S"),
    "guard.link_lost_s": RetiredKey(5.0, "core.guard.stream_watch.LINK_LOST_S"),
    "guard.stamp_tolerance_s": RetiredKey(0.5, "core.guard.stream_watch.STAMP_TOLERANCE_S"),
    "guard.imu_stuck_s": RetiredKey(0.1, "core.guard.rules.IMU_STUCK_S"),
    "guard.imu_clipped_s": RetiredKey(0.25, "core.guard.rules.IMU_CLIPPED_S"),
    "guard.position_jump_m": RetiredKey(0.3, "core.guard.second_vehicle.POSITION_JUMP_M"),
    "guard.velocity_jump_m_s": RetiredKey(1.5, "core.guard.estimator_watch.VELOCITY_JUMP_M_S"),
    "guard.reset_position_m": RetiredKey(0.05, "core.guard.estimator_watch.RESET_POSITION_M"),
    "guard.reset_velocity_m_s": RetiredKey(0.2, "core.guard.estimator_watch.RESET_VELOCITY_M_S"),
    "guard.estimator_bad_s": RetiredKey(0.3, "core.guard.estimator_watch.ESTIMATOR_BAD_S"),
    "guard.impact_window_s": RetiredKey(2.0, "core.sense.senses.IMPACT_WINDOW_S"),
    "guard.altitude_tolerance_m": RetiredKey(0.25, "core.guard.rules.ALTITUDE_TOLERANCE_M"),
    "guard.battery_low_s": RetiredKey(1.0, "core.guard.rules.BATTERY_LOW_S"),
    "guard.force_margin": RetiredKey(1.15, "core.guard.rules.FORCE_MARGIN"),
    "estimation.attitude_error_rad": RetiredKey(0.01, "core.sense.force.ATTITUDE_ERROR_RAD"),
    "estimation.filter_s": RetiredKey(0.02, "core.sense.force.FILTER_S"),
    "estimation.baseline_s": RetiredKey(0.25, "core.sense.bias.BASELINE_S"),
    "estimation.hover.speed_m_s": RetiredKey(0.4, "core.sense.bias.HOVER_SPEED_M_S"),
    "estimation.hover.rate_rad_s": RetiredKey(0.3, "core.sense.bias.HOVER_RATE_RAD_S"),
    "estimation.hover.time_constant_s": RetiredKey(2.0, "core.sense.bias.LEARNING_S"),
    "estimation.hover.bias_limit_m_s2": RetiredKey(0.4, "core.sense.bias.BIAS_LIMIT_M_S2"),
    "estimation.hover.thrust_scale_limit": RetiredKey(0.25, "core.sense.bias.THRUST_SCALE_LIMIT"),
    "estimation.walls.scatter": RetiredKey(0.05, "planning.contact_fit.CONTACT_SCATTER"),
    "estimation.walls.sure_log_odds": RetiredKey(5.3, "planning.contact_fit.SURE_LOG_ODDS"),
    "detection.release_fraction": RetiredKey(0.4, "core.sense.detector.RELEASE_FRACTION"),
    "detection.peak_drop_fraction": RetiredKey(0.12, "core.sense.detector.PEAK_DROP_FRACTION"),
    "detection.contact_end_s": RetiredKey(0.012, "core.sense.detector.CONTACT_END_S"),
    "detection.sure_sigma": RetiredKey(2.5, "core.sense.detector.SURE_SIGMA"),
    "detection.short_window_s": RetiredKey(0.032, "core.sense.detector.SHORT_WINDOW_S"),
    "detection.long_window_s": RetiredKey(0.1, "core.sense.detector.LONG_WINDOW_S"),
    "detection.pulse_misfit": RetiredKey(3.0, "core.sense.detector.PULSE_MISFIT"),
    "flying.arrive_m": RetiredKey(0.12, "core.mission.course.ARRIVED_M"),
    "flying.arrive_speed_m_s": RetiredKey(0.1, "core.mission.course.ARRIVED_M_S"),
    "flying.arrive_s": RetiredKey(0.3, "core.mission.course.ARRIVED_S"),
    "flying.arrive_mean_s": RetiredKey(0.3, "core.mission.course.MEAN_SPEED_S"),
    "simulation.imu_bias_m_s2": RetiredKey(0.05, "sim.sensors.IMU_BIAS_M_S2"),
    "simulation.gyro_noise_rad_s": RetiredKey(0.01, "sim.sensors.GYRO_NOISE_RAD_S"),
    "simulation.pose_noise_m": RetiredKey(0.001, "sim.sensors.POSE_NOISE_M"),
    "simulation.attitude_noise_rad": RetiredKey(0.002, "sim.sensors.ATTITUDE_NOISE_RAD"),
    "simulation.ground_friction": RetiredKey(0.6, "sim.plant.GROUND_FRICTION"),
    "simulation.gust_time_s": RetiredKey(2.0, "sim.wind.GUST_TIME_S"),
    "simulation.spreads.contact": RetiredKey(0.2, "sim.draws.SPREADS"),
    "simulation.spreads.contact_scatter": RetiredKey(0.05, "sim.draws.SPREADS"),
    "simulation.spreads.lock_true_mode": RetiredKey(0.01, "sim.draws.SPREADS"),
    "simulation.spreads.wall_offset_m": RetiredKey(0.03, "sim.draws.SPREADS"),
    "simulation.spreads.wall_yaw_deg": RetiredKey(4.0, "sim.draws.SPREADS"),
    "simulation.spreads.guard_height_m": RetiredKey(0.02, "sim.draws.SPREADS"),
    "simulation.spreads.mass": RetiredKey(0.03, "sim.draws.SPREADS"),
    "simulation.spreads.wind_m_s": RetiredKey(0.5, "sim.draws.SPREADS"),
    "simulation.spreads.servo": RetiredKey(0.2, "sim.draws.SPREADS"),
    "simulation.spreads.battery": RetiredKey(0.05, "sim.draws.SPREADS"),
    "simulation.spreads.imu": RetiredKey(0.02, "sim.draws.SPREADS"),
    "simulation.spreads.replan_latency_s": RetiredKey(0.02, "sim.draws.SPREADS"),
}


def remove_retired(tree: dict[str, Any]) -> dict[str, Any]:
    """Remove the retired keys, and sections that become empty, from `tree` in place.

    Returns:
        The removed values, by dotted key.
    """
    found: dict[str, Any] = {}
    for key in RETIRED:
        *above, name = key.split(".")
        nodes: list[Any] = [tree]
        for part in above:
            nodes.append(nodes[-1].get(part) if isinstance(nodes[-1], dict) else None)
        if isinstance(nodes[-1], dict) and name in nodes[-1]:
            found[key] = nodes[-1].pop(name)
            for i in range(len(above), 0, -1):
                if nodes[i] == {}:
                    del nodes[i - 1][above[i - 1]]
    return found


def ignore_retired(document: Document) -> None:
    """Remove the retired keys from a vehicle's document and warn about them.

    A key whose value differs from its constant has its own warning. The other keys share one warning.
    """
    found = remove_retired(document.tree)
    same = [key for key, value in found.items() if value == RETIRED[key].value]
    if len(same) > 1:
        text = (
            f"{len(same)} keys are ignored, because they are now fixed at these values: remove "
            f"{', '.join(same)}"
        )
        warnings.warn(document.error((), text).one_line(), RetiredKeyWarning, stacklevel=2)
    for key in found:
        if len(same) > 1 and key in same:
            continue
        text = (
            f"is ignored, because its value is now fixed at {json.dumps(RETIRED[key].value)}: remove the key"
        )
        warnings.warn(document.error(tuple(key.split(".")), text).one_line(), RetiredKeyWarning, stacklevel=2)


def changed_retired(tree: dict[str, Any]) -> list[str]:
    """Remove the retired keys from a configuration, and describe those that differ from their constants."""
    found = remove_retired(tree)
    return [
        f"{key} was {json.dumps(value)} and is now {json.dumps(RETIRED[key].value)}"
        for key, value in found.items()
        if value != RETIRED[key].value
    ]
