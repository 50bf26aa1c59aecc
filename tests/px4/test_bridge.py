"""The simulator's side of PX4's TCP link: lockstep, message contents, saturation, loss of PX4."""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from dart_flight.base.records import Mode
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import LockDriver, packaged
from dart_flight.lock.drivers.px4_output import actuator_value
from dart_flight.run.prepare import with_driver
from dart_flight.sim.px4 import bridge as px4_bridge
from dart_flight.sim.px4.bridge import (
    ACCELEROMETER_LIMIT_M_S2,
    HOME_LAT_DEG,
    HOME_LON_DEG,
    HilLink,
    Px4LostError,
    Px4Vehicle,
    accelerometer_output,
    geodetic,
    servo_channel,
    with_motors,
)
from tests.doubles.fake_px4 import FakePx4

COUNTS_PER_M_S2 = 2048.0 / 9.80665


@pytest.fixture
def mission() -> Mission:
    return load_mission(packaged("missions", "paper_dual_collision.yaml"))


Pair = tuple[HilLink, FakePx4]


@pytest.fixture
def booting() -> Iterator[Pair]:
    """A link to a PX4 that does not answer yet, until a test enters its context."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        fake = FakePx4(listener.getsockname()[1])
        link = HilLink(listener.accept()[0])
    yield link, fake
    link.close()


@pytest.fixture
def pair(booting: Pair) -> Iterator[Pair]:
    """A link to a PX4 that answers every HIL_SENSOR."""
    with booting[1]:
        yield booting


class Bridge:
    """A vehicle whose simulator has a link to the fake PX4."""

    def __init__(self, pair: Pair, mission: Mission, **options: Any) -> None:
        self.link, self.fake = pair
        self.vehicle = Px4Vehicle(mission, 1, self.link, **options)

    def fly(self, ticks: int, arriving: str = "HIL_SENSOR") -> list[Any]:
        """Advance by `ticks`, and return the messages of a kind that PX4 has received by then."""
        for _ in range(ticks):
            self.vehicle.step()
        sensors, now_us = "HIL_SENSOR", self.vehicle.time_us
        self.fake.wait_for(
            lambda: self.fake.received_of(sensors)[-1].time_usec == now_us, 10.0, "the last tick"
        )
        return self.fake.received_of(arriving)


@pytest.fixture
def bridge(pair: Pair, mission: Mission) -> Bridge:
    """A vehicle with motion capture."""
    return Bridge(pair, mission)


def test_the_plant_has_the_motors_of_px4s_parameters(mission: Mission, pair: Pair) -> None:
    own = mission.vehicle.airframe
    assert own.arm_x_m is not None
    wider = tuple(msgspec.structs.replace(motor, x_m=1.5 * motor.x_m) for motor in own.motors)
    vehicle = Px4Vehicle(with_motors(mission, wider), 1, pair[0])
    assert vehicle.plant.motors == wider
    assert vehicle.plant.mass == own.mass_kg


def test_px4_answers_every_tick_on_the_simulators_clock(bridge: Bridge) -> None:
    link, vehicle = bridge.link, bridge.vehicle
    for i in range(250):
        vehicle.step()
        assert link.controls.time_us == vehicle.time_us == (i + 1) * 4000
    assert link.locked
    sensors = bridge.fake.received_of("HIL_SENSOR")
    assert [m.time_usec for m in sensors] == [4000 * (i + 1) for i in range(250)]
    assert {m.id for m in sensors} == {0}
    # At rest: gravity upwards on the accelerometer, pressure of the home altitude, the earth's field.
    assert sum(m.zacc for m in sensors) / 250 == pytest.approx(-9.81, abs=0.2)
    slow = [m for m in sensors if m.fields_updated & 0x200]
    assert len(slow) == 50
    assert sum(m.abs_pressure for m in slow) / 50 == pytest.approx(955.98, abs=0.3)
    assert sum(m.zmag for m in slow) / 50 == pytest.approx(0.428, abs=0.01)
    assert sum(m.pressure_alt for m in slow) / 50 == pytest.approx(488.0, abs=0.5)


def test_px4_receives_poses_and_no_gps_indoors(bridge: Bridge) -> None:
    poses = bridge.fly(250, "ODOMETRY")
    assert 95 <= len(poses) <= 100
    assert not bridge.fake.received_of("HIL_GPS")
    assert math.isnan(poses[-1].vx)
    assert math.hypot(poses[-1].x, poses[-1].y, poses[-1].z) < 0.01
    # A pose precedes the HIL_SENSOR of its tick, which advances the clock that PX4 stamps the pose with.
    assert bridge.fake.received[-1].get_type() == "HIL_SENSOR"


def test_px4_receives_gps_and_no_poses_outdoors(mission: Mission, pair: Pair) -> None:
    outdoors = Bridge(pair, mission, position_from=PositionSource.RTK)
    fixes = outdoors.fly(500, "HIL_GPS")
    assert 18 <= len(fixes) <= 20
    assert not outdoors.fake.received_of("ODOMETRY")
    for fix in fixes:
        assert fix.fix_type == 6
        assert abs(fix.lat - HOME_LAT_DEG * 1e7) < 12  # 0.13 m
        assert abs(fix.alt - 488_000) < 150
        assert fix.eph == 2


def test_motor_commands_reach_the_plant_and_lift_it(bridge: Bridge) -> None:
    bridge.fake.controls, bridge.fake.armed = (0.8,) * 4 + (0.0,) * 12, True
    bridge.fly(250)
    assert bridge.vehicle.armed
    position = bridge.vehicle.plant.position
    assert position[2] < -1.0
    assert math.hypot(*position[:2]) < 0.05


def test_the_servo_follows_its_channel_only_while_armed(mission: Mission, pair: Pair) -> None:
    mission = with_driver(mission, LockDriver.PX4)
    bridge = Bridge(pair, mission)
    fake, plant = bridge.fake, bridge.vehicle.plant
    lock = mission.vehicle.lock
    assert lock is not None
    controls = [0.0] * 16
    controls[servo_channel(mission.vehicle)] = actuator_value(lock, lock.servo.rigid_pulse_us)
    fake.controls = tuple(controls)
    modes = []
    for armed, ticks in ((False, 100), (True, 60), (True, 40)):
        fake.armed = armed
        bridge.fly(ticks)
        modes.append(plant.mode)
    # Outputs of a disarmed PX4 do not move the servo, and after 0.24 s it still travels.
    assert modes == [Mode.FLEXIBLE, Mode.FLEXIBLE, Mode.RIGID]


@pytest.mark.parametrize("value", [160.0, -160.0, 300.0, -300.0, 156.9, -156.9])
def test_a_saturated_reading_is_sent_as_px4s_clipping_count(value: float) -> None:
    sent = accelerometer_output(value, 156.9)
    # PX4 converts to single precision, truncates the fraction, and keeps 16 bits.
    (single,) = struct.unpack("f", struct.pack("f", sent))
    assert int(single * COUNTS_PER_M_S2) == int(math.copysign(32767, value))


def test_a_reading_below_full_scale_is_unchanged() -> None:
    for value in (0.0, -9.81, 100.0, -156.0):
        assert accelerometer_output(value, 156.9) == value
    assert accelerometer_output(-100.0, 78.4) == -78.4  # an 8 g sensor
    assert accelerometer_output(400.0, 313.8) == ACCELEROMETER_LIMIT_M_S2  # PX4's upper limit


def test_an_impact_beyond_full_scale_is_sent_saturated_and_counted(bridge: Bridge) -> None:
    plant = bridge.vehicle.plant
    plant.set_mode(Mode.RIGID)
    acrylic = plant.planes[1]
    # 4 m/s into the wall at x = 1.65 m: 254 N, 20 g.
    plant.position = (acrylic.point[0] - 0.05, 0.0, -1.0)
    plant.velocity = (4.0, 0.0, 0.0)
    lowest = min(m.xacc for m in bridge.fly(25))
    assert lowest == pytest.approx(-ACCELEROMETER_LIMIT_M_S2, abs=1e-3)
    assert bridge.vehicle.clipped >= 3


def test_the_plant_runs_without_answers_only_while_px4_boots(
    mission: Mission, booting: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(px4_bridge, "_ANSWER_WAIT_S", 0.3)
    link, fake = booting
    vehicle = Px4Vehicle(mission, 1, link)
    for _ in range(3):
        vehicle.step()
    assert not link.locked
    present_us = vehicle.time_us + 4000

    def answer(sensor: Any) -> list[Any]:
        time.sleep(0.1 if sensor.time_usec == present_us else 0.0)
        return [fake.outputs(sensor.time_usec)]

    fake.answers["HIL_SENSOR"] = answer
    with fake:  # it answers the earlier ticks first, which extends the wait for the present one
        vehicle.step()
        assert link.locked
        assert link.controls.time_us == vehicle.time_us == present_us
        fake.answers.clear()
        with pytest.raises(Px4LostError, match="has not answered"):
            vehicle.step()


def test_a_closed_connection_is_a_lost_px4(mission: Mission, booting: Pair) -> None:
    bridge = Bridge(booting, mission)
    with bridge.fake:
        bridge.fly(3)
    with pytest.raises(Px4LostError, match="closed"):
        bridge.vehicle.step()


def test_bytes_that_are_not_mavlink_are_skipped(bridge: Bridge) -> None:
    bridge.fake.send_bytes(b"\xfd\x09garbage" * 20)
    bridge.fly(50)
    assert bridge.link.locked


def test_geodetic_is_the_inverse_of_px4s_projection() -> None:
    # PX4's projection is azimuthal equidistant on a sphere; at this range a plane is accurate to 1 mm.
    for north, east in ((0.0, 0.0), (10.0, -20.0), (-100.0, 50.0)):
        latitude, longitude = geodetic((north, east, 0.0))
        a, b = math.radians(latitude), math.radians(HOME_LAT_DEG)
        d = math.radians(longitude - HOME_LON_DEG)
        c = math.acos(min(1.0, math.sin(b) * math.sin(a) + math.cos(b) * math.cos(a) * math.cos(d)))
        k = c / math.sin(c) if c > 1e-9 else 1.0
        x = k * (math.cos(b) * math.sin(a) - math.sin(b) * math.cos(a) * math.cos(d)) * 6371000.0
        y = k * math.cos(a) * math.sin(d) * 6371000.0
        assert [x, y] == pytest.approx([north, east], abs=0.01)


def test_wind_reaches_the_plant_and_still_air_does_not(mission: Mission, pair: Pair) -> None:
    wind = {"vehicle.simulation.wind_north_east_m_s": [5.0, 0.0], "vehicle.simulation.gust_m_s": 0.5}
    windy, still = Bridge(pair, mission.replace(wind)), Bridge(pair, mission)
    windy.fly(100)
    north, east, _ = windy.vehicle.plant.wind_ned
    assert 3.0 < north < 7.0
    assert east != 0.0
    assert still.vehicle.plant.wind_ned == (0.0, 0.0, 0.0)
