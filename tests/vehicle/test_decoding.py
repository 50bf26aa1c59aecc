"""What MAVLink's messages become: units, missing values, messages in parts."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace
from typing import Any

import pytest

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    EscSample,
    EstimatorSample,
    ImuSample,
    Input,
    OdometrySample,
    StatusSample,
)
from dart_flight.vehicle.clock import ClockEstimate
from dart_flight.vehicle.vehicle_session import VehicleSession


class Decoder:
    """A session without a link, fed messages; what it makes of them."""

    def __init__(self, motors: int = 4) -> None:
        self.seen: list[Input] = []
        session = self.session = VehicleSession.__new__(VehicleSession)
        session._deliver, session._motors, session.clock = self.seen.append, motors, ClockEstimate()
        session._rpm, session._rpm_us, session._reset_counter = [], None, None
        session._status = StatusSample(0, 0)

    def last(self, kind: type[Any]) -> Any:
        return [item for item in self.seen if isinstance(item, kind)][-1]

    def count(self, kind: type[Any]) -> int:
        return sum(isinstance(item, kind) for item in self.seen)


def message(**fields: object) -> Any:
    return SimpleNamespace(fields_json=json.dumps(fields))


@pytest.mark.parametrize(
    ("pwm_us", "throttle"),
    [(None, 0.0), (900, 0.0), (1000, 0.0), (1250, 0.25), (1500, 0.5), (2000, 1.0), (2100, 1.0)],
)
def test_a_motors_output_is_a_share_of_its_range(pwm_us: float | None, throttle: float) -> None:
    decoder = Decoder()
    decoder.session._on_actuator(message(time_usec=7, actuator=[pwm_us, 1500, 1500, 1500, 1000]), None)
    found = decoder.last(ActuatorSample)
    assert (found.t_us, found.motors) == (7, (pytest.approx(throttle), 0.5, 0.5, 0.5))


def test_too_few_outputs_are_none() -> None:
    decoder = Decoder(motors=6)
    decoder.session._on_actuator(message(time_usec=7, actuator=[1500] * 4), None)
    assert decoder.seen == []


def test_odometry_is_a_place_and_an_estimator() -> None:
    decoder = Decoder()
    whole: dict[str, Any] = {"time_usec": 9, "x": 1.0, "y": 2.0, "z": -3.0, "vx": 0.1, "vy": 0.2, "vz": 0.3}
    decoder.session._on_odometry(message(**whole, reset_counter=4), None)
    decoder.session._on_odometry(message(**whole, reset_counter=4), None)
    odometry = decoder.last(OdometrySample)
    assert (odometry.t_us, odometry.position_ned, odometry.velocity_ned) == (
        9,
        (1.0, 2.0, -3.0),
        (0.1, 0.2, 0.3),
    )
    assert decoder.count(EstimatorSample) == 1  # only where the counter changes
    for name in ("x", "y", "z", "vx", "vy", "vz"):
        decoder.session._on_odometry(message(**{**whole, name: None}, reset_counter=4), None)
    assert decoder.count(OdometrySample) == 2  # NaN until its estimator is ready


def test_speeds_of_six_motors_come_in_two_messages() -> None:
    decoder = Decoder(motors=6)
    decoder.session._on_esc(message(time_usec=5, index=4, rpm=[9, 9, 9, 9]), None)  # its first part is lost
    assert decoder.seen == []
    decoder.session._on_esc(message(time_usec=6, index=0, rpm=[1, 2, 3, 4]), None)
    decoder.session._on_esc(message(time_usec=7, index=4, rpm=[9, 9, 9, 9]), None)  # of another moment
    assert decoder.seen == []
    decoder.session._on_esc(message(time_usec=8, index=0, rpm=[1, 2, 3, 4]), None)
    decoder.session._on_esc(message(time_usec=8, index=4, rpm=[5, 6, 0, 0]), None)
    found = decoder.last(EscSample)
    assert (found.t_us, found.rpm) == (8, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    assert decoder.count(EscSample) == 1


def test_a_part_about_motors_that_are_none_is_no_second_sample() -> None:
    """Eight channels of a controller, four of them in use."""
    decoder = Decoder()
    for index in (0, 4):
        decoder.session._on_esc(message(time_usec=8, index=index, rpm=[1, 2, 3, 4]), None)
    assert decoder.count(EscSample) == 1


def test_an_attitude_that_is_not_known_is_none() -> None:
    decoder = Decoder()
    unknown = SimpleNamespace(timestamp_us=3, w=math.nan, x=0.0, y=0.0, z=0.0)
    decoder.session._on_attitude(unknown, None)
    assert decoder.seen == []
    decoder.session._on_attitude(SimpleNamespace(timestamp_us=3, w=1.0, x=0.0, y=0.0, z=0.0), None)
    assert decoder.last(AttitudeSample).q_frd_to_ned == (1.0, 0.0, 0.0, 0.0)


def test_an_imu_sample_keeps_its_axes_and_tells_the_clock() -> None:
    decoder = Decoder()
    imu = SimpleNamespace(
        timestamp_us=1_000_000,
        acceleration_frd=SimpleNamespace(forward_m_s2=1.0, right_m_s2=2.0, down_m_s2=3.0),
        angular_velocity_frd=SimpleNamespace(forward_rad_s=4.0, right_rad_s=5.0, down_rad_s=6.0),
    )
    decoder.session._on_imu(imu, None)
    found = decoder.last(ImuSample)
    assert (found.specific_force_frd, found.rate_frd) == ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
    assert decoder.session.clock.offset_us == 1_000_000 - found.received_us


@pytest.mark.parametrize(
    ("volts", "percent", "expected"),
    [(15.5, 80.0, (15.5, 0.8)), (math.nan, math.nan, (None, None)), (15.5, math.nan, (15.5, None))],
)
def test_a_battery_tells_what_it_knows(
    volts: float, percent: float, expected: tuple[float | None, float | None]
) -> None:
    decoder = Decoder()
    decoder.session._on_battery(SimpleNamespace(voltage_v=volts, remaining_percent=percent), None)
    status = decoder.last(StatusSample)
    assert (status.battery_v, status.battery_remaining) == expected
