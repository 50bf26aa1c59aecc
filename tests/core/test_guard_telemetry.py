"""The guard's rules on telemetry: streams, clocks, pauses of this program, a second vehicle."""

from __future__ import annotations

import re

import pytest

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    FlightMode,
    GuardEvent,
    ImuSample,
    Input,
    LandedState,
    OdometrySample,
    OtherVehicle,
    Override,
    Phase,
    RoundTrip,
    Setpoint,
    StatusText,
    Tick,
    VehicleAction,
    VehicleCommand,
)
from dart_flight.base.stamps import FASTEST
from dart_flight.base.streams import BY_NAME
from dart_flight.core.guard.flight_conditions import _PAUSE_MEMORY_US, _PAUSE_US
from dart_flight.core.guard.rules import _STALE_SAMPLES, RULES
from dart_flight.core.guard.second_vehicle import (
    _REACH_US,
    _TURNS,
    _WINDOW_US,
    POSITION_JUMP_M,
    SecondClockDetector,
    SecondPositionDetector,
)
from dart_flight.core.guard.stream_watch import STAMP_TOLERANCE_S
from tests.core.conftest import RULES_WITHOUT_JUMP, HandFedCore, core_in, known, of_kind
from tests.core.guard_causes import CAUSES, alternate_vehicles, delay_telemetry

STAMP_TOLERANCE_US, TOLERANCE_US = round(1e6 * STAMP_TOLERANCE_S), 100_000.0


@pytest.mark.parametrize(
    ("name", "named"),
    [
        *((name, False) for name in ("pilot", "tilt", "bounds")),
        *((f"{stream}_silent", True) for stream in ("imu", "attitude", "odometry", "actuator", "status")),
        *((name, True) for name in ("link_lost", "stream_rate", "stamps_backwards")),
        *((name, True) for name in ("telemetry_late", "telemetry_late_ground", "not_ready")),
    ],
)
def test_another_system_on_the_link_is_named_if_a_stream_fails(name: str, named: bool) -> None:
    rules = tuple(rule for rule in RULES_WITHOUT_JUMP if rule.name != "second_vehicle_ground")
    c = CAUSES[name].fire(rules, other=7)
    event = next(e for e in c.fired if e.rule == name)
    assert event.detail.endswith("system 7 sends on the same link") is named


@pytest.mark.parametrize(("every_us", "after_us"), [(4_000, 96_000), (20_000, 240_000)])
def test_rules_are_checked_at_the_same_interval_without_ticks(every_us: int, after_us: int) -> None:
    """Checks are more than 20 ms apart: with a sample every 4 ms, 80 ms without IMU are found after 96 ms.

    With a sample every 20 ms, a dozen have not arrived by then, so the timeout is the 0.2 s of any stream.
    """
    c = core_in(Phase.APPROACH, rules=tuple(rule for rule in RULES if rule.name == "imu_silent"))
    c.run(0.02)
    c.feed(Tick(c.t_us))
    last_us = c.t_us
    while not c.fired:
        c.t_us += every_us
        c.feed(AttitudeSample(c.t_us, c.t_us, c.q))
    assert c.t_us - last_us == after_us


PAUSE_MEMORY_S = 1e-6 * _PAUSE_MEMORY_US


@pytest.mark.parametrize(
    ("paused_us", "later_s", "named"),
    [
        (_PAUSE_US + 20_000, PAUSE_MEMORY_S - 0.2, True),
        (_PAUSE_US - 10_000, 0.1, False),
        (_PAUSE_US + 20_000, PAUSE_MEMORY_S + 0.1, False),
    ],
)
def test_a_pause_of_this_program_is_named_for_a_limited_time(
    paused_us: int, later_s: float, named: bool
) -> None:
    c = core_in(Phase.APPROACH)
    c.t_us += paused_us  # no sample, and no tick either
    c.run(later_s)
    c.silent.add("imu")
    c.run(0.1)
    (event,) = c.fired
    assert event.rule == "imu_silent"
    assert (f"did not run for {(paused_us + 4000) / 1000:.0f} ms" in event.detail) is named


def test_the_longest_of_several_recent_pauses_is_named() -> None:
    c = core_in(Phase.APPROACH)
    for paused_us in (60_000, 80_000, 50_000):
        c.t_us += paused_us
        c.run(0.5)
    c.silent.add("imu")
    c.run(0.1)
    assert "did not run for 8" in c.fired[0].detail


def test_a_position_after_a_pause_of_its_stream_is_no_jump() -> None:
    c = core_in(Phase.TRANSIT, rules=RULES)
    before = c.fired_rules
    c.silent.add("odometry")
    c.run(0.15)
    c.shift(north_m=0.4)
    c.silent.clear()
    c.run(0.1)
    assert c.fired_rules == before


def test_a_pause_of_all_streams_is_tolerated_longer_than_one_of_the_imu() -> None:
    """A busy host delays all streams by a tenth of a second; the guard lands if the pause lasts longer."""
    c = core_in(Phase.APPROACH)
    c.silent |= {"imu", "attitude", "odometry", "actuator"}
    c.run(0.15)
    assert not c.fired
    c.run(0.1)
    assert c.fired


def test_single_late_datagrams_are_no_backwards_clock() -> None:
    c = core_in(Phase.APPROACH)
    for _ in range(20):
        c.feed(AttitudeSample(c.t_us - 2 * STAMP_TOLERANCE_US, c.t_us, c.q))
        c.run(0.02)
    assert not c.fired


@pytest.mark.parametrize("stream", ["imu", "attitude", "odometry"])
def test_backwards_stamps_are_detected_in_every_stream(stream: str) -> None:
    c = core_in(Phase.APPROACH)
    for i in range(_STALE_SAMPLES):
        t_us = c.t_us - 2 * STAMP_TOLERANCE_US + 8000 * i
        samples: dict[str, Input] = {
            "imu": ImuSample(t_us, c.t_us, (0.0, 0.0, -9.81 + 1e-4 * i), (0.0, 0.0, 0.0)),
            "attitude": AttitudeSample(t_us, c.t_us, c.q),
            "odometry": OdometrySample(t_us, c.t_us, c.position_ned, c.velocity_ned),
        }
        c.feed(samples[stream])
    c.feed(Tick(c.t_us + 20_000))
    assert c.fired_rules == ["stamps_backwards"]
    assert c.fired[0].detail.startswith(f"{stream}: {_STALE_SAMPLES} samples in a row")


def test_a_low_rate_of_motor_commands_is_named() -> None:
    c = core_in(Phase.APPROACH)
    c.silent.add("actuator")
    for _ in range(25):
        c.run(0.1)
        c.feed(ActuatorSample(c.t_us, c.t_us, c.motors))
    assert c.fired_details == [
        ("stream_rate", f"actuator arrives at 10 Hz, minimum {BY_NAME['actuator'].expected_hz:.0f} Hz")
    ]


@pytest.mark.parametrize("odometry_every", [1, 2])
@pytest.mark.parametrize("ahead_s", [238.0, -238.0, 2.0, -0.7])
def test_alternating_clocks_are_two_vehicles_and_time_does_not_jump(
    ahead_s: float, odometry_every: int
) -> None:
    """This holds even if the samples of the two vehicles alternate in all streams."""
    c = core_in(Phase.APPROACH)
    c.odometry_every = odometry_every
    before_us = c.t_us
    alternate_vehicles(c, round(ahead_s * 1e6), 0.0, 0.1)
    assert c.fired_rules == ["second_vehicle"]
    assert f"{abs(ahead_s):.1f} s apart" in c.fired[0].detail
    assert 0 <= c.core.state.now_us - before_us < 1_000_000


def test_alternating_positions_with_one_clock_are_two_vehicles() -> None:
    c = core_in(Phase.APPROACH, rules=RULES)
    alternate_vehicles(c, 0, 3.0, 0.1)
    assert c.fired[-1].rule == "second_vehicle"  # after the jump, which is detected first
    assert "3.0 m apart" in c.fired[-1].detail
    assert c.core.override is Override.LAND


def test_a_position_after_a_gap_is_not_compared_with_earlier_ones() -> None:
    """The vehicle may have flown back during the gap, which indicates no second vehicle."""
    places, t_us = SecondPositionDetector(POSITION_JUMP_M), 0

    def difference_m(north_m: float, after_s: float = 0.02) -> float | None:
        nonlocal t_us
        t_us += round(after_s * 1e6)
        places.update(OdometrySample(t_us, t_us, (north_m, 0.0, -1.0), (0.0, 0.0, 0.0)))
        return places.position_difference_m(t_us)

    for _ in range(5):
        for north_m in (0.0, 3.0):
            assert difference_m(north_m, 1.1e-6 * _REACH_US) is None
            assert difference_m(3.0 - north_m) is None  # one jump, not two
    assert [difference_m(north_m) for north_m in (0.0, 3.0, 0.0, 3.0, 0.0)][-1] == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("north_m", "speed_m_s", "after_us", "odd"),
    [
        (POSITION_JUMP_M - 0.1, 0.0, _REACH_US, False),
        (3.0, 0.0, _REACH_US, True),
        (3.0, 0.0, _REACH_US + 1, False),
        (0.4 + POSITION_JUMP_M - 0.1, 2.0, 200_000, False),  # the vehicle flies 0.4 m in this time
        (0.4 + POSITION_JUMP_M + 0.1, 2.0, 200_000, True),
    ],
)
def test_successive_positions_differ_by_flight_and_tolerance(
    north_m: float, speed_m_s: float, after_us: int, odd: bool
) -> None:
    places = SecondPositionDetector(POSITION_JUMP_M)
    for t_us, x in ((5, 0.0), (5 + after_us, north_m)):
        places.update(OdometrySample(t_us, t_us, (x, 0.0, -1.0), (speed_m_s, 0.0, 0.0)))
    assert (places.odd_us is not None) is odd


@pytest.mark.parametrize(("back_us", "seconds_apart"), [(0, None), (50_000, None), (600_000, 0.6)])
def test_alternating_stamps_are_two_clocks_if_farther_apart_than_late_datagrams(
    back_us: int, seconds_apart: float | None
) -> None:
    clocks = SecondClockDetector(TOLERANCE_US)
    for i in range(8):
        t_us = 10_000_000 + 10_000 * i
        clocks.update(t_us, t_us)
        clocks.update(t_us - back_us, t_us)
    assert clocks.clock_difference_s(10_070_000) == pytest.approx(seconds_apart)
    assert (clocks.odd_us is not None) is (seconds_apart is not None)


@pytest.mark.parametrize(
    ("turns", "age_us", "detected"),
    [
        (_TURNS - 1, 0, False),
        (_TURNS, 0, True),
        # The first of the alternations, which are 0.1 s apart, leaves the window.
        (_TURNS, _WINDOW_US - 100_000 * (_TURNS - 1), True),
        (_TURNS, _WINDOW_US - 100_000 * (_TURNS - 1) + 1, False),
    ],
)
def test_two_clocks_are_detected_by_several_alternations_within_a_window(
    turns: int, age_us: int, detected: bool
) -> None:
    clocks = SecondClockDetector(TOLERANCE_US)
    for i in range(turns + 1):
        t_us = 10_000_000 + 100_000 * i
        clocks.update(t_us, t_us)
        clocks.update(t_us - 5_000_000, t_us)
    assert (clocks.clock_difference_s(t_us + age_us) is not None) is detected


@pytest.mark.parametrize(("more_us", "odd"), [(-100_000, False), (100_000, True)])
def test_a_stamp_further_ahead_than_the_elapsed_time_belongs_to_another_clock(
    more_us: int, odd: bool
) -> None:
    """The limit is the reach plus the elapsed time of the host in the fastest simulation."""
    clocks = SecondClockDetector(TOLERANCE_US)
    clocks.update(10_000_000, 0)
    clocks.update(10_000_000 + _REACH_US + FASTEST * 250_000 + more_us, 250_000)
    assert (clocks.odd_us is not None) is odd


def test_a_clock_that_is_set_back_repeatedly_is_one_clock() -> None:
    """A replayed stream does this: no second clock continues from the earlier time."""
    clocks = SecondClockDetector(TOLERANCE_US)
    for i in range(8):
        t_us = 10_000_000 + 10_000 * i
        clocks.update(t_us, t_us)
        clocks.update(5_000_000, t_us)
    assert clocks.clock_difference_s(10_070_000) is None


def test_a_second_vehicle_becomes_the_reason_after_an_earlier_rule() -> None:
    """Both rules land, so the second one changes only the reason."""
    c = core_in(Phase.APPROACH)
    c.silent = {"odometry"}
    c.run(0.3)
    assert c.fired_rules == ["odometry_silent"]
    c.silent = set()
    alternate_vehicles(c, 238_000_000, 0.0, 0.1)
    assert c.fired_rules == ["odometry_silent", "second_vehicle"]


def test_telemetry_that_waited_for_this_program_is_not_attributed_to_the_link() -> None:
    c = core_in(Phase.APPROACH)
    c.feed(RoundTrip(c.t_us, c.t_us, c.t_us))
    c.run(0.1)
    c.host_ahead_us += 100_000  # a pause, after which the program does not catch up
    c.run(0.3)
    (event,) = c.fired
    assert (event.rule, event.detail) == (
        "telemetry_late",
        "this program reads telemetry 100 ms after sampling, limit 75 ms; the computer is too busy: this "
        "program did not run for 104 ms",
    )


def test_late_telemetry_becomes_the_reason_after_a_silent_stream() -> None:
    """Both rules land; each names the other system on the link, which may be the cause."""
    c = core_in(Phase.APPROACH)
    c.feed(OtherVehicle(c.t_us, c.t_us, 7))
    c.silent = {"odometry"}
    c.run(0.3)
    c.silent = set()
    delay_telemetry(c)
    late = "telemetry arrives 500 ms after sampling, limit 75 ms, round trip 1000 ms"
    assert c.fired_details == [
        ("odometry_silent", "no data for 220 ms; system 7 sends on the same link"),
        ("telemetry_late", f"{late}; system 7 sends on the same link"),
    ]
    c.set_status(flight_mode=FlightMode.LAND, landed=LandedState.ON_GROUND, armed=False)
    c.run(0.3)
    assert known(c.core.end).reason == f"telemetry_late: {late}; system 7 sends on the same link"


def test_the_status_of_the_other_vehicle_does_not_end_the_flight() -> None:
    """The other vehicle is disarmed in another mode: no pilot, no landing and no end of the flight."""
    c = core_in(Phase.APPROACH)
    alternate_vehicles(c, 238_000_000, 3.0, 0.1)
    assert VehicleAction.LAND in c.actions
    c.set_status(armed=False, flight_mode=FlightMode.HOLD, landed=LandedState.ON_GROUND)
    alternate_vehicles(c, 238_000_000, 3.0, 2.0)
    assert c.fired_rules == ["second_vehicle"]
    assert c.core.end is None


@pytest.mark.parametrize("ahead_us", [238_000_000, 0])
def test_a_mode_received_before_the_other_vehicles_samples_is_not_a_pilot(ahead_us: int) -> None:
    c = core_in(Phase.APPROACH)
    c.outputs.clear()
    c.set_status(armed=False, flight_mode=FlightMode.HOLD, landed=LandedState.ON_GROUND)
    c.run(0.02)
    assert not [o for o in c.outputs if isinstance(o, GuardEvent | Setpoint | VehicleCommand)]
    alternate_vehicles(c, ahead_us, 3.0, 0.1)
    assert c.fired[-1].rule == "second_vehicle"
    assert not {"pilot", "px4_failsafe", "disarmed"} & set(c.fired_rules)
    alternate_vehicles(c, ahead_us, 3.0, 2.0)
    assert VehicleAction.LAND in c.actions
    assert c.core.end is None


def test_a_pilot_can_take_over_beside_a_second_vehicle() -> None:
    c = core_in(Phase.APPROACH)
    alternate_vehicles(c, 238_000_000, 3.0, 0.1)
    c.set_status(flight_mode=FlightMode.MANUAL)
    assert c.fired[-1].rule == "pilot"


@pytest.mark.parametrize("back_s", [5.0, 400.0])
def test_a_single_backwards_jump_of_a_clock_is_reported_as_backwards_stamps(back_s: float) -> None:
    c = core_in(Phase.APPROACH)
    us = round(back_s * 1e6)
    for i in range(1, 60):
        t, received = c.t_us - us + 4000 * i, c.t_us + 4000 * i
        c.feed(AttitudeSample(t, received, c.q))
        c.feed(ImuSample(t, received, (0.0, 0.0, -9.81 + 1e-4 * i), (0.0, 0.0, 0.0)))
        c.feed(OdometrySample(t, received, c.position_ned, c.velocity_ned))
        c.feed(Tick(received))
    assert c.fired_rules == ["stamps_backwards"]


def test_a_clock_that_jumps_ahead_is_accepted_eventually() -> None:
    c = core_in(Phase.APPROACH)
    for i in range(1, 60):
        t, received = c.t_us + 50_000_000 + 4000 * i, c.t_us + 4000 * i
        c.feed(AttitudeSample(t, received, c.q))
        c.feed(ImuSample(t, received, (0.0, 0.0, -9.81 + 1e-4 * i), (0.0, 0.0, 0.0)))
    assert known(c.core.state.imu).t_us > c.t_us + 50_000_000
    assert "second_vehicle" not in c.fired_rules


def test_a_pause_of_this_program_is_named_as_the_cause_of_silence() -> None:
    c = core_in(Phase.APPROACH)
    c.run(0.1)
    c.t_us += 400_000  # no sample, and no tick either
    c.run(0.004)
    assert c.fired[0].rule.endswith("_silent")
    expected = r"no data for 40\d ms; the computer is too busy: this program did not run for 40\d ms"
    assert re.fullmatch(expected, c.fired[0].detail)
    c = HandFedCore()  # a silent vehicle is not attributed to the computer
    c.enter_approach()
    c.silent.add("attitude")
    c.run(0.3)
    assert c.fired_details == [("attitude_silent", "no data for 220 ms")]


def test_another_system_on_the_link_is_refused_only_before_take_off() -> None:
    c = HandFedCore()
    c.run(0.1)
    c.feed(OtherVehicle(c.t_us, c.t_us, 7))
    assert c.fired_details == [("second_vehicle_ground", "system 7 sends on the same link")]
    assert c.core.end is not None
    c = core_in(Phase.APPROACH)
    c.feed(OtherVehicle(c.t_us, c.t_us, 7))  # its samples are distinguished
    c.run(0.2)
    assert not c.fired


def test_a_stream_without_usable_messages_is_silent_and_its_cause_is_named() -> None:
    c = core_in(Phase.APPROACH, rules=tuple(r for r in RULES if r.name == "actuator_silent"))
    c.feed(
        StatusText(c.t_us, c.t_us, "error", "ODOMETRY arrives, but no message is usable: the velocity is NaN")
    )
    unusable = "ACTUATOR_OUTPUT_STATUS arrives, but no message is usable: the motors' outputs are invalid"
    c.feed(StatusText(c.t_us, c.t_us, "error", unusable))
    c.silent.add("actuator")
    c.run(0.6)
    event = of_kind(GuardEvent, c.outputs)[0]
    assert event.detail.endswith(f"ms; {unusable}")
