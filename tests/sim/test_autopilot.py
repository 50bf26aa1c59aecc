"""The embedded autopilot behaves like PX4 in everything that the application relies on."""

import math
from pathlib import Path

import pytest

from dart_flight.base.geometry import distance2
from dart_flight.base.records import FlightMode, LandedState
from dart_flight.check.px4_parameters import parameter_names
from dart_flight.config.mission import load_mission
from dart_flight.sim.cascade import TrajectorySetpoint
from dart_flight.sim.embedded_autopilot import Autopilot, make_autopilot

ROOT = Path(__file__).parents[2]
NAN = math.nan


@pytest.fixture
def autopilot() -> Autopilot:
    return make_autopilot(load_mission(ROOT / "missions/paper_dual_collision.yaml"), 1)


def run(autopilot: Autopilot, seconds: float, setpoint: TrajectorySetpoint | None = None) -> None:
    end = autopilot.now_s + seconds
    while autopilot.now_s < end:
        if setpoint is not None:
            autopilot.set_trajectory(setpoint)
        autopilot.step()


def airborne(autopilot: Autopilot) -> TrajectorySetpoint:
    run(autopilot, 1.0)
    target = TrajectorySetpoint((0.0, 0.0, -1.0), yaw=0.0)
    autopilot.set_trajectory(target)
    assert autopilot.set_mode(FlightMode.OFFBOARD)
    assert autopilot.arm()
    run(autopilot, 6.0, target)
    return target


def test_the_autopilot_has_every_parameter_that_check_reads(autopilot: Autopilot) -> None:
    """MAVSDK requests a missing parameter repeatedly for three seconds."""
    assert not set(parameter_names()) - set(autopilot.parameters)


def test_arming_waits_for_the_estimator(autopilot: Autopilot) -> None:
    assert not autopilot.arm()
    run(autopilot, 1.0)
    assert autopilot.arm()


def test_offboard_mode_needs_setpoints(autopilot: Autopilot) -> None:
    run(autopilot, 1.0)
    assert not autopilot.set_mode(FlightMode.OFFBOARD)
    autopilot.set_trajectory(TrajectorySetpoint((0.0, 0.0, 0.0)))
    assert autopilot.set_mode(FlightMode.OFFBOARD)


def test_a_takeoff_command_while_disarmed_is_accepted_without_effect(autopilot: Autopilot) -> None:
    run(autopilot, 1.0)
    assert autopilot.take_off()
    run(autopilot, 2.0)
    assert autopilot.plant.on_ground


def test_the_autopilot_holds_a_position_setpoint(autopilot: Autopilot) -> None:
    airborne(autopilot)
    run(autopilot, 6.0, TrajectorySetpoint((0.8, -0.5, -1.2), yaw=0.5))
    assert math.dist(autopilot.plant.position, (0.8, -0.5, -1.2)) < 0.06
    assert autopilot.landed is LandedState.IN_AIR


def test_the_autopilot_follows_velocity_setpoints(autopilot: Autopilot) -> None:
    airborne(autopilot)
    run(autopilot, 3.0, TrajectorySetpoint((NAN, NAN, -1.0), (0.5, 0.0, NAN), yaw=0.0))
    assert autopilot.plant.velocity[0] == pytest.approx(0.5, abs=0.07)


def test_the_offboard_loss_failsafe_holds_then_lands(autopilot: Autopilot) -> None:
    airborne(autopilot)
    modes = []
    for seconds in (0.9, 0.3):
        run(autopilot, seconds)
        modes.append(autopilot.mode)
    assert modes == [FlightMode.OFFBOARD, FlightMode.HOLD]
    where = autopilot.plant.position
    run(autopilot, 4.5)
    assert distance2(autopilot.plant.position, where) < 0.1
    run(autopilot, 1.0)
    modes.append(autopilot.mode)
    assert modes[-1] is FlightMode.LAND
    run(autopilot, 6.0)
    assert autopilot.landed is LandedState.ON_GROUND
    assert not autopilot.armed


@pytest.mark.parametrize(("mode", "stops_after_s"), [(FlightMode.LAND, 0.0), (FlightMode.HOLD, 0.5)])
def test_a_landing_returns_to_where_it_began_and_a_hold_to_where_it_stops(
    autopilot: Autopilot, mode: FlightMode, stops_after_s: float
) -> None:
    airborne(autopilot)
    run(autopilot, 3.0, TrajectorySetpoint((NAN, NAN, -1.0), (0.8, 0.0, NAN), yaw=0.0))
    (north, _, _), speed = autopilot.estimator.position, autopilot.estimator.velocity[0]
    assert autopilot.set_mode(mode)
    run(autopilot, 8.0)
    assert autopilot.plant.position[0] == pytest.approx(north + stops_after_s * speed, abs=0.15)


def test_the_autopilot_does_not_disarm_in_the_air_unless_forced(autopilot: Autopilot) -> None:
    airborne(autopilot)
    assert not autopilot.disarm()
    assert autopilot.disarm(force=True)


def test_the_estimate_stays_near_the_truth(autopilot: Autopilot) -> None:
    airborne(autopilot)
    run(autopilot, 3.0, TrajectorySetpoint((1.0, 0.3, -1.0), yaw=0.0))
    assert math.dist(autopilot.estimator.position, autopilot.plant.position) < 0.01
    assert math.dist(autopilot.estimator.velocity, autopilot.plant.velocity) < 0.05


def test_the_lock_output_follows_the_parameters(autopilot: Autopilot) -> None:
    assert autopilot.lock_pulse_us() is None
    autopilot.set_actuator(1, 1.0)
    lock = autopilot.vehicle.lock
    assert lock is not None
    assert autopilot.lock_pulse_us() == pytest.approx(lock.px4.max_pulse_us)
    autopilot.parameters["COM_PREARM_MODE"] = 0
    assert autopilot.lock_pulse_us() is None  # the output is off while disarmed
