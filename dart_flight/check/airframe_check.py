"""PX4's airframe (CA_ROTOR*) against the configuration's."""

from __future__ import annotations

from collections.abc import Mapping

from dart_flight.check.findings import CheckFinding
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.rotors import motors_of, rotor_differences


def judge_airframe(mission: Mission, values: Mapping[str, float]) -> list[CheckFinding]:
    """Whether PX4 flies the motors that the configuration describes.

    Thrust is summed over the motors and their torque taken off motor by motor: another number, order or
    direction makes both wrong. Other distances only scale the torque, and PX4's own may be in any unit.

    Args:
        mission: for its vehicle.
        values: PX4's parameters as read.
    """
    item, motors = "airframe", mission.vehicle.airframe.motors
    try:
        actual = motors_of(values, "PX4")
    except InputError as error:
        return [CheckFinding(item, True, f"not compared: {error}", remark=True)]
    other, sizes = rotor_differences(motors, actual)
    if other:
        hint = "; `calibrate airframe` prints PX4's"
        return [CheckFinding(item, False, "; ".join(other) + hint)]
    if sizes:
        return [CheckFinding(item, True, "; ".join(sizes) + ": measure, and set both", remark=True)]
    return [CheckFinding(item, True, f"{len(motors)} motors, as in PX4")]
