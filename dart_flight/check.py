"""`dart-flight check`: everything that can be known on the ground, as findings that end in go or no-go.

Offline: the mission against bounds, walls, speeds, forces, servo times and coefficients. With a connection:
the parameters that matter to a vehicle that flies into walls, explained in words, measured stream rates,
battery, estimator, servo output. A no-go has a name, and only by that name can it be overruled.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping

import msgspec

from dart_flight.config.document import InputError
from dart_flight.config.mission import Collision, Mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.contact.collision_map import collide
from dart_flight.contact.law import Onset
from dart_flight.flight.recovery import recovery_point
from dart_flight.lock.drivers.px4 import parameter_problems, required_parameters
from dart_flight.planning.approach import NoApproachError, plan_approach
from dart_flight.streams import BY_NAME
from dart_flight.vehicle.ground_link import GroundLink, Observation

_CLEARANCE_M = 0.15  # of start and goal from a wall's plane
_WEAK = 1.3  # an impact below this many thresholds may be missed
_MEASURE_S = 3.0
_GAIN_TOLERANCE = 0.02
_NO_TERMINATION = 121212  # CBRK_FLIGHTTERM: PX4's magic number for "off"


class Finding(msgspec.Struct, frozen=True):
    """One thing that was looked at.

    Attributes:
        item: its name, for `--overrule`.
        go: False: a reason not to fly.
        says: what was found, in words.
        overruled: a no-go that the operator has taken upon himself.
    """

    item: str
    go: bool
    says: str
    overruled: bool = False


class CheckReport(msgspec.Struct, frozen=True):
    """All findings, and what follows."""

    mission: str
    go: bool
    findings: list[Finding]


def decide(mission: Mission, findings: Iterable[Finding], overrule: Iterable[str] = ()) -> CheckReport:
    """Go or no-go.

    Raises:
        InputError: an item to overrule is not a no-go.
    """
    found, wanted = list(findings), set(overrule)
    unknown = wanted - {f.item for f in found if not f.go}
    if unknown:
        bad = ", ".join(sorted({f.item for f in found if not f.go})) or "none"
        raise InputError(
            f"{sorted(unknown)[0]!r} is no no-go of this mission, they are: {bad}", key=("--overrule",)
        )
    judged = [
        msgspec.structs.replace(f, overruled=True) if not f.go and f.item in wanted else f for f in found
    ]
    return CheckReport(mission.name, all(f.go or f.overruled for f in judged), judged)


# --- offline -----------------------------------------------------------------------------------------


def check_mission(mission: Mission) -> list[Finding]:
    """What can be judged without a vehicle."""
    findings = _check_places(mission)
    for collision in mission.collisions:
        findings += _check_approach(mission, collision)
        findings += _check_force(mission, collision)
        findings += _check_recovery(mission, collision)
        findings += _check_servo(mission, collision)
    findings += _check_coefficients(mission)
    return findings


def _check_places(mission: Mission) -> list[Finding]:
    findings = []
    for name, point in (("start", mission.start), ("goal", mission.goal.position_m)):
        near = [
            (wall.signed_distance(point), wall.name)
            for wall in mission.walls
            if wall.spans(point) and abs(wall.signed_distance(point)) < _CLEARANCE_M
        ]
        for distance, other in near:
            says = f"{name} is {distance:.2f} m from wall {other}, less than {_CLEARANCE_M:g} m"
            findings.append(Finding(f"{name}_clearance", False, says))
    for wall in mission.walls:
        if mission.bounds.excess2(wall.point) > 0.0:
            says = f"the middle of wall {wall.name} lies outside of bounds_m: it could not be flown to"
            findings.append(Finding("wall_bounds", False, says))
    if not findings:
        findings.append(
            Finding("places", True, "start, goal and walls lie within the bounds, clear of each other")
        )
    return findings


def _check_approach(mission: Mission, collision: Collision) -> list[Finding]:
    item = f"approach_{collision.index}"
    if collision.approach_m_s is None:
        says = f"wall {collision.wall.name} is reached by the recovery from the collision before"
        return [Finding(item, True, says)]
    try:
        approach = plan_approach(mission, collision)
    except NoApproachError as error:
        return [Finding(item, False, str(error))]
    limit = mission.limits.speed_m_s
    if approach.speed_m_s > limit or mission.vehicle.flying.transit_speed_m_s > limit:
        return [Finding(item, False, f"{approach.speed_m_s:.2f} m/s is over limits.speed_m_s {limit:g}")]
    says = (
        f"run-up of {approach.length_m:.2f} m, wall {collision.wall.name} met at "
        f"{approach.speed_m_s:.2f} m/s after {approach.impact_s:.1f} s"
    )
    return [Finding(item, True, says)]


def _velocity(collision: Collision) -> tuple[float, float] | None:
    """(normal, tangential) velocity at the impact, as planned or predicted; None where nobody knows."""
    if collision.approach_m_s is not None:
        return collision.approach_m_s
    if collision.predicted is not None:
        return (collision.predicted.normal_m_s, collision.predicted.tangential_m_s)
    return None


def _hit(mission: Mission, collision: Collision) -> tuple[float, float, float, float] | None:
    """Predicted peak normal and friction force (N), contact time (s), exit speed (m/s)."""
    velocity = _velocity(collision)
    if velocity is None or velocity[0] >= 0.0:
        return None
    vehicle = mission.vehicle
    c = vehicle.materials[collision.wall.material].of(collision.mode)
    hit = collide(c, vehicle.airframe.mass_kg, *velocity, Onset(vehicle.onset))
    return hit.peak_normal_force_n, hit.peak_friction_force_n, hit.contact_time_s, hit.normal_out_m_s


def _check_force(mission: Mission, collision: Collision) -> list[Finding]:
    item, wall = f"force_{collision.index}", collision.wall.name
    hit = _hit(mission, collision)
    if hit is None:
        return [Finding(item, True, f"wall {wall}: not predicted in the mission (`plan` writes it)")]
    normal, friction, _, _ = hit
    force, limit = math.hypot(normal, friction), mission.limits.peak_force_n
    detection = mission.vehicle.detection.force_threshold_n
    full = mission.vehicle.imu.full_scale_m_s2 * mission.vehicle.airframe.mass_kg
    says = f"wall {wall}: {force:.0f} N predicted ({normal:.0f} normal, {friction:.0f} along)"
    if force > limit:
        return [Finding(item, False, f"{says}, over limits.peak_force_n {limit:g}")]
    if normal < _WEAK * detection:
        weak = f"{says}, too near the detection threshold of {detection:g} N: it may go unnoticed"
        return [Finding(item, False, weak)]
    if force > full:
        return [
            Finding(item, False, f"{says}, the IMU clips at {full:.0f} N: the recovery would be too weak")
        ]
    return [Finding(item, True, f"{says}, limit {limit:g} N")]


def _check_recovery(mission: Mission, collision: Collision) -> list[Finding]:
    """Where the recovery leads: to the next wall where that is the plan, and not into one otherwise."""
    hit, item = _hit(mission, collision), f"recovery_{collision.index}"
    place = collision.impact_point or (collision.predicted.position_m if collision.predicted else None)
    velocity = _velocity(collision)
    if hit is None or place is None or velocity is None:
        return []
    along = math.copysign(hit[1], -velocity[1])  # friction is against the motion
    target = recovery_point(
        (place[0], place[1], 0.0),
        collision.wall.normal,
        hit[0],
        along,
        collision.alpha_normal_m_per_n,
        collision.alpha_tangential_m_per_n,
        mission.altitude_m,
    )
    says = f"set-point after wall {collision.wall.name} about ({target[0]:.2f}, {target[1]:.2f})"
    following = next((c for c in mission.collisions if c.index == collision.index + 1), None)
    if following is not None and following.approach_m_s is None:
        beyond = following.wall.signed_distance(target)
        if beyond > 0.0:
            short = f"{says}: {beyond:.2f} m short of wall {following.wall.name}, which it should lead to"
            return [Finding(item, False, short)]
        return [Finding(item, True, f"{says}, leads to wall {following.wall.name}")]
    for wall in mission.walls:
        crossed = wall.signed_distance(place) > 0.0 >= wall.signed_distance(target)
        if wall is not collision.wall and crossed and wall.spans(target):
            return [Finding(item, False, f"{says}: behind wall {wall.name}, which is not to be hit next")]
    outside = mission.bounds.excess2(target)
    if outside > 0.0:
        says += f", {outside:.2f} m outside bounds_m: the goal must be passed before"
    return [Finding(item, True, says)]


def _check_servo(mission: Mission, collision: Collision) -> list[Finding]:
    """Whether the lock can be in the next mode before the wall that the recovery leads to."""
    following = next((c for c in mission.collisions if c.index == collision.index + 1), None)
    if following is None or following.approach_m_s is not None or following.mode is collision.mode:
        return []
    lock, item = mission.vehicle.lock, f"servo_{following.index}"
    needed = lock.relaxation_s + lock.switch_time_s
    here, there = collision.predicted, following.predicted
    hit = _hit(mission, collision)
    if here is not None and there is not None:
        free = there.t_s - here.t_s - here.contact_time_s
        how = "predicted"
    elif hit is not None and collision.impact_point is not None:
        # The quickest that the way can be flown within the mission's speed limit.
        way = following.wall.signed_distance(collision.impact_point)
        free = way / mission.limits.speed_m_s
        how = "at least"
    else:
        return []
    says = f"the lock needs {needed:.2f} s between the contacts, {how} {free:.2f} s there are"
    go = free >= needed or how == "at least"
    if free < needed and go:
        says += "; where it is late, the approach is broken off in flight"
    return [Finding(item, go, says)]


def _check_coefficients(mission: Mission) -> list[Finding]:
    findings = []
    for name in sorted({c.wall.material for c in mission.collisions}):
        source = mission.vehicle.materials[name].source
        assumed = "assumed" in source or not source
        note = " (assumed: the flight may differ; `identify` measures)" if assumed else ""
        findings.append(Finding(f"material_{name}", True, f"{name}: {source or 'no source given'}{note}"))
    return findings


# --- with a vehicle ------------------------------------------------------------------------------------


class Parameter(msgspec.Struct, frozen=True):
    """One of PX4's parameters that matters to a vehicle that collides, and how to read it."""

    name: str
    judge: Callable[[float, Mission], tuple[bool, str]]


_LOSS_ACTIONS = {
    0: "position mode: sticks must be there",
    1: "altitude mode: sticks must be there",
    2: "stabilized: sticks must be there",
    3: "return: it climbs and flies home, whatever stands between",
    4: "land",
    5: "hold",
    6: "terminate: it falls",
    7: "disarm: it falls",
}


def _of_loss(value: float, mission: Mission) -> tuple[bool, str]:
    whole = value + mission.vehicle.guard.deadman_s
    return value <= 1.5, (
        f"without set-points PX4 acts after {value:g} s; with the deadman, a hung program flies on for at "
        f"most {whole:.2f} s"
        + ("" if value <= 1.5 else ", more than a wall at arm's length allows: at most 1.5 s")
    )


def _loss_action(value: float, _: Mission) -> tuple[bool, str]:
    action = round(value)
    return action in (0, 1, 2, 4, 5), f"when set-points are lost: {_LOSS_ACTIONS.get(action, 'unknown')}"


def _rc_exception(value: float, _: Mission) -> tuple[bool, str]:
    ignores = round(value) & 4
    return True, (
        "the loss of the remote control is ignored in offboard: no second way out"
        if ignores
        else "the loss of the remote control ends offboard: fly with one, or it never starts"
    )


def _attitude_limit(value: float, mission: Mission) -> tuple[bool, str]:
    limit = mission.vehicle.guard.tilt_deg
    good = value == 0.0 or value >= limit
    return good, f"PX4 sees a failure from {value:g} degrees on; the guard lands from {limit:g}" + (
        "" if good else ": an impact could trip PX4 first"
    )


def _lockdown(value: float, _: Mission) -> tuple[bool, str]:
    return True, f"a failure within {value:g} s of take-off stops the motors"


def _termination(value: float, _: Mission) -> tuple[bool, str]:
    if round(value) == _NO_TERMINATION:
        return True, "flight termination is off: the attitude failure detector does not stop the motors"
    return True, "flight termination is ON: an attitude failure stops the motors in the air"


def _gyro_rate(value: float, _: Mission) -> tuple[bool, str]:
    return value >= 400.0, f"rate control at up to {value:g} Hz" + (
        "" if value >= 400.0 else ", a contact's torque needs at least 400"
    )


def _disarm_land(value: float, _: Mission) -> tuple[bool, str]:
    return (
        True,
        "never disarms by itself after landing" if value <= 0.0 else f"disarms {value:g} s after landing",
    )


PARAMETERS: tuple[Parameter, ...] = (
    Parameter("COM_OF_LOSS_T", _of_loss),
    Parameter("COM_OBL_RC_ACT", _loss_action),
    Parameter("COM_RCL_EXCEPT", _rc_exception),
    Parameter("FD_FAIL_P", _attitude_limit),
    Parameter("FD_FAIL_R", _attitude_limit),
    Parameter("COM_LKDOWN_TKO", _lockdown),
    Parameter("CBRK_FLIGHTTERM", _termination),
    Parameter("IMU_GYRO_RATEMAX", _gyro_rate),
    Parameter("COM_DISARM_LAND", _disarm_land),
)
# The prediction of where a recovery leads rests on these.
_GAINS = ("MPC_XY_P", "MPC_XY_VEL_P_ACC", "MPC_XY_VEL_D_ACC", "MPC_TILTMAX_AIR", "MPC_Z_P")


def check_vehicle(mission: Mission, url: str) -> list[Finding]:
    """What a connected vehicle says of itself.

    Raises:
        VehicleError: nothing answers at the URL.
    """
    names = [p.name for p in PARAMETERS] + list(_GAINS)
    if mission.vehicle.lock.driver is LockDriver.PX4:
        names += [required.name for required in required_parameters(mission.vehicle.lock)]
    with GroundLink(url, mission.vehicle.connection.timeout_s) as link:
        observed = link.observe(_MEASURE_S)
        values = link.read_parameters(names)
    return [
        *judge_parameters(mission, values),
        *judge_observation(mission, observed),
        *judge_lock(mission, values),
    ]


def judge_parameters(mission: Mission, values: Mapping[str, float]) -> list[Finding]:
    """Parameters as read, explained."""
    findings = []
    for parameter in PARAMETERS:
        if parameter.name not in values:
            findings.append(Finding(parameter.name, True, "not on this vehicle"))
            continue
        go, says = parameter.judge(values[parameter.name], mission)
        findings.append(Finding(parameter.name, go, says))
    for name in _GAINS:
        configured = float(getattr(mission.vehicle.px4, name.lower()))
        actual = values.get(name)
        if actual is not None and abs(actual - configured) > _GAIN_TOLERANCE * abs(configured):
            says = f"{actual:g} on the vehicle, {configured:g} in the configuration: recoveries go elsewhere"
            findings.append(Finding(name, False, says))
    return findings


def judge_observation(mission: Mission, observed: Observation) -> list[Finding]:
    """Rates, battery and estimator as observed."""
    findings = [
        Finding("version", True, f"PX4 {observed.version}" if observed.version else "version not told")
    ]
    for name, rate in observed.rates_hz.items():
        needed = BY_NAME[name].expected_hz
        findings.append(Finding(f"rate_{name}", rate >= needed, f"{rate:.0f} Hz, needs {needed:g}"))
    guard, left, volts = mission.vehicle.guard, observed.battery_remaining, observed.battery_v
    low = (left is not None and left < 2.0 * guard.battery_remaining) or (
        volts is not None and volts < guard.battery_v
    )
    told = ", ".join(
        text
        for text in (
            f"{100.0 * left:.0f} %" if left is not None else "",
            f"{volts:.1f} V" if volts is not None else "",
        )
        if text
    )
    findings.append(Finding("battery", not low, told or "not told"))
    says = "local position valid" if observed.local_position_ok else "no valid local position"
    findings.append(Finding("estimator", observed.local_position_ok, says))
    return findings


def judge_lock(mission: Mission, values: Mapping[str, float]) -> list[Finding]:
    """Whether the lock's servo would move."""
    lock = mission.vehicle.lock
    if lock.driver is LockDriver.MOCK:
        says = "lock.driver is mock: nothing real moves; choose maestro, pwm or px4 (--driver)"
        return [Finding("lock_driver", False, says)]
    if lock.driver is not LockDriver.PX4:
        return [Finding("lock_driver", True, f"{lock.driver.value}; try it with `dart-flight lock toggle`")]
    problems = parameter_problems(lock, values)
    return [
        Finding("lock_driver", not problems, "; ".join(problems) or "PX4's output is set up for the servo")
    ]
