"""The break-off after a wrong reset of PX4's heading, in a closed loop with a PX4 whose heading is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    IDENTITY,
    Vec2,
    quaternion_conjugate,
    quaternion_from_euler,
    quaternion_multiply,
    wrap_angle,
)
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    EstimatorSample,
    GuardEvent,
    ImuSample,
    Mode,
    OdometrySample,
    Output,
    Override,
    Request,
    Setpoint,
    Tick,
    VehicleCommand,
)
from dart_flight.core.guard.dead_reckoning import (
    _DETECTED_S,
    _LONGEST_S,
    _RESET_M,
    _SAME_M,
    _SAME_M_S,
    WRONG_RAD,
    DeadReckoning,
)
from dart_flight.core.guard.estimator_resets import EstimatorResets
from tests.core.conftest import HandFedCore, of_kind

_DT_S, _LAG_S = 0.004, 0.15
_TURNS_RAD_S = 1.0
_CORRECTED_S = 1.0  # PX4 accepts the heading of motion capture again
_RESET_S = 1.95  # PX4 resets its position to motion capture


def turned(vector: Vec2, by_rad: float) -> Vec2:
    c, s = math.cos(by_rad), math.sin(by_rad)
    return (c * vector[0] - s * vector[1], s * vector[0] + c * vector[1])


class MisledVehicle:
    """A vehicle under a PX4 that rotates accelerations by an error of its heading; north, east."""

    def __init__(self, core: HandFedCore, error_rad: Callable[[float], float]) -> None:
        self.core, self._error_rad = core, error_rad
        self.position: Vec2 = core.position_ned[:2]
        self.velocity: Vec2 = core.velocity_ned[:2]
        self.yaw_rad = 0.0
        self._estimated = (self.position, self.velocity)
        self._acceleration: Vec2 = (0.0, 0.0)
        self._q = quaternion_from_euler(0.0, 0.0, 0.0)
        self.path: list[Vec2] = []

    def fly(self, seconds: float) -> None:
        """Fly for this time, or until a landing is requested, which PX4 would fly without setpoints."""
        for tick in range(round(seconds / _DT_S)):
            if any(isinstance(o, VehicleCommand) for o in self._step(tick * _DT_S)):
                return

    def _step(self, t_s: float) -> list[Output]:
        before = len(self.core.outputs)
        c, error = self.core, self._error_rad(t_s)
        px4 = c.core.mission.vehicle.px4
        asked = next((o for o in reversed(c.outputs) if isinstance(o, Setpoint)), None)
        wanted = (0.0, 0.0)
        if asked is not None:
            (place, speed), v_sp = self._estimated, asked.velocity_ned or (0.0, 0.0, 0.0)
            push = asked.acceleration_ned or (0.0, 0.0, 0.0)
            kv, kp = px4.mpc_xy_vel_p_acc, px4.mpc_xy_p
            north, east = (
                kv * (kp * (asked.position_ned[i] - place[i]) + v_sp[i] - speed[i]) + push[i] for i in (0, 1)
            )
            wanted = (north, east)
            off = wrap_angle(asked.yaw_ned_rad - self.yaw_rad - error)
            self.yaw_rad += max(-_TURNS_RAD_S * _DT_S, min(_TURNS_RAD_S * _DT_S, off))
        truly = turned(wanted, -error)
        north, east = (x + (y - x) * _DT_S / _LAG_S for x, y in zip(self._acceleration, truly, strict=True))
        a = self._acceleration = (north, east)
        self.velocity, self.position = _moved(self.velocity, self.position, a)
        self._estimated = _moved(self._estimated[1], self._estimated[0], turned(a, error))[::-1]
        if _RESET_S <= t_s < _RESET_S + _DT_S:
            self._estimated = (self.position, self.velocity)
            c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=3))
        self.path.append(self.position)
        self._feed(error)
        return c.outputs[before:]

    def _feed(self, error_rad: float) -> None:
        c, (north, east), before = self.core, self._acceleration, self._q
        ahead, right = turned((north, east), -self.yaw_rad)
        pitch = -math.atan2(ahead, GRAVITY_M_S2)
        roll = math.atan2(right * math.cos(pitch), GRAVITY_M_S2)
        self._q = quaternion_from_euler(roll, pitch, self.yaw_rad)
        _, *half = quaternion_multiply(quaternion_conjugate(before), self._q)
        rate = (2.0 * half[0] / _DT_S, 2.0 * half[1] / _DT_S, 2.0 * half[2] / _DT_S)
        lift = math.hypot(north, east, GRAVITY_M_S2)
        c.t_us += 4000
        t = c.t_us
        estimated = quaternion_multiply(quaternion_from_euler(0.0, 0.0, error_rad), self._q)
        (x, y), (vx, vy) = self._estimated
        noise = c.noise_m_s2 * (t // 4000 % 2)
        c.feed(ImuSample(t, t, (0.0, 0.0, noise - lift), rate))
        c.feed(AttitudeSample(t, t, estimated))
        if (t // 4000) % 2 == 0:
            c.feed(OdometrySample(t, t, (x, y, -1.0), (vx, vy, 0.0)))
        c.feed(ActuatorSample(t, t, c.motors))
        if (t // 4000) % 5 == 0:
            c.feed(Tick(t))
        if (t // 4000) % 50 == 0:
            c.set_status()


def _moved(velocity: Vec2, position: Vec2, acceleration: Vec2) -> tuple[Vec2, Vec2]:
    vx, vy = (v + _DT_S * a for v, a in zip(velocity, acceleration, strict=True))
    return (vx, vy), (position[0] + _DT_S * vx, position[1] + _DT_S * vy)


def misled(error_deg: float, until_s: float = _CORRECTED_S) -> MisledVehicle:
    """Return a vehicle half a metre before the wood, at 1 m/s, whose heading steps by this angle."""
    c = HandFedCore()
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=1))
    c.enter_approach()
    c.position_ned, c.velocity_ned = (0.5, 0.5, -1.0), (0.4, 0.9, 0.0)
    c.run(0.1)
    vehicle = MisledVehicle(c, lambda t_s: math.radians(error_deg) if t_s < until_s else 0.0)
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=2))
    return vehicle


@pytest.mark.parametrize("error_deg", [30.0, -30.0, 90.0, -90.0, 150.0, 180.0])
def test_a_break_off_with_a_wrong_heading_stops_before_the_wall(error_deg: float) -> None:
    vehicle = misled(error_deg)
    vehicle.fly(3.0)
    rules = [o.rule for o in of_kind(GuardEvent, vehicle.core.outputs)]
    assert rules[0] == "heading_reset"
    wall = vehicle.core.core.mission.collisions[0].wall
    nearest_m = min(wall.signed_distance((north, -east)) for north, east in vehicle.path)
    assert nearest_m > 0.1
    assert math.hypot(*vehicle.velocity) < 0.3
    assert abs(math.degrees(wrap_angle(vehicle.yaw_rad))) < 20.0


def test_a_jump_back_after_a_wrong_heading_is_no_further_fault() -> None:
    vehicle = misled(90.0)
    vehicle.fly(2.5)
    assert [o.rule for o in of_kind(GuardEvent, vehicle.core.outputs)] == ["heading_reset"]


def test_the_guard_keeps_the_true_heading_if_px4_never_corrects_its_own() -> None:
    vehicle = misled(60.0, until_s=math.inf)
    vehicle.fly(2.5)
    assert abs(math.degrees(wrap_angle(vehicle.yaw_rad))) < 10.0


@pytest.mark.parametrize("phase", ["on the ground", "in the climb"])
def test_an_alignment_of_the_heading_before_the_mission_leaves_no_error(phase: str) -> None:
    """PX4 may find its heading late; the heading before that is not the true one."""
    c = HandFedCore()
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=1))
    if phase == "in the climb":
        c.enter_climb()
    else:
        c.set_lock(Mode.RIGID)
        c.run(0.2)
    c.q = quaternion_from_euler(0.0, 0.0, math.radians(90.0))
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=2))
    c.run(0.1)
    c.position_ned = (0.0, 0.0, -1.0)
    c.run(1.5)
    c.request(Request.LAND)
    held = of_kind(Setpoint, c.run(0.2))
    assert c.core.override is Override.BREAK_OFF or phase == "on the ground"
    assert all(setpoint.acceleration_ned is None for setpoint in held)


def test_the_drift_of_the_gyro_after_a_harmless_reset_is_no_error_of_the_heading() -> None:
    resets = EstimatorResets()
    resets.update_counter(0, 0)
    for tick in range(1, 2500):
        t_us = 4000 * tick
        resets.add_imu(ImuSample(t_us, t_us, (0.0, 0.0, -9.81), (0.0, 0.0, 0.02)))  # the vehicle stands still
        resets.add_attitude(AttitudeSample(t_us, t_us, quaternion_from_euler(0.0, 0.0, 0.0)))
        resets.add_odometry(OdometrySample(t_us, t_us, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        if tick == 50:
            assert resets.update_counter(1, t_us)
    assert resets.heading_error_rad == 0.0
    assert resets.reckoned is None


@pytest.mark.parametrize(
    ("after_s", "was_wrong_rad", "error_rad", "away_m", "away_m_s", "step_m", "finished"),
    [
        (0.5 * _DETECTED_S, 0.0, 0.0, 0.0, 0.0, 0.0, False),  # a step of the heading may still be detected
        (1.5 * _DETECTED_S, 0.0, 0.0, 9.0, 9.0, 0.0, True),  # the reset left the heading right
        (1.0, 0.0, 2.0 * WRONG_RAD, 0.0, 0.0, 0.0, False),  # the heading is wrong
        (1.0, 2.0 * WRONG_RAD, 0.0, 2.0 * _SAME_M, 0.0, 0.0, False),  # the position is still off
        (1.0, 2.0 * WRONG_RAD, 0.0, 0.0, 2.0 * _SAME_M_S, 0.0, False),  # the velocity is still off
        (1.0, 2.0 * WRONG_RAD, 0.0, 0.5 * _SAME_M, 0.5 * _SAME_M_S, 0.0, True),  # PX4 has recovered
        (1.0, 2.0 * WRONG_RAD, 0.0, 2.0 * _SAME_M, 0.0, 2.0 * _RESET_M, True),  # PX4 has reset its position
        (1.1 * _LONGEST_S, 2.0 * WRONG_RAD, 0.0, 9.0, 9.0, 0.0, True),
        (1.1 * _LONGEST_S, 0.0, 2.0 * WRONG_RAD, 9.0, 9.0, 0.0, True),
    ],
)
def test_the_guard_trusts_px4_again_once_its_heading_and_its_motion_are_right(
    after_s: float,
    was_wrong_rad: float,
    error_rad: float,
    away_m: float,
    away_m_s: float,
    step_m: float,
    finished: bool,
) -> None:
    """`was_wrong_rad` is the error of an earlier sample, `error_rad` that of the present one."""
    reckoning = DeadReckoning(OdometrySample(0, 0, (0.0, 0.0, -1.0), (0.0, 0.0, 0.0)), IDENTITY)
    reckoning.is_finished(OdometrySample(1, 1, (0.0, 0.0, -1.0), (0.0, 0.0, 0.0)), was_wrong_rad, 0.0)
    t_us = round(1e6 * after_s)
    reckoning.add_imu(ImuSample(t_us, t_us, (0.0, 0.0, -GRAVITY_M_S2), (0.0, 0.0, 0.0)), IDENTITY)
    sample = OdometrySample(t_us, t_us, (away_m, 0.0, -1.0), (0.0, away_m_s, 0.0))
    assert reckoning.is_finished(sample, error_rad, step_m) is finished
