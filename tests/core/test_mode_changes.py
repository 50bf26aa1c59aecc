"""Changes of PX4's mode and a kill switch: a pilot, a failsafe, or neither."""

from __future__ import annotations

import pytest

from dart_flight.base.records import FlightMode, Phase, Setpoint, StatusText, VehicleCommand
from dart_flight.core.guard.failsafe import _MEMORY_US
from dart_flight.core.guard.flight_conditions import _DOUBT_US
from dart_flight.core.guard.rules import _FALL_S
from dart_flight.core.guard.stream_watch import _GAP_MEMORY_US, _GAP_US
from tests.core.conftest import RULES_WITHOUT_JUMP, core_in, known
from tests.core.guard_causes import CAUSES

GAP_S, GAP_MEMORY_S, TEXT_MEMORY_S = 1e-6 * _GAP_US, 1e-6 * _GAP_MEMORY_US, 1e-6 * _MEMORY_US
DOUBT_S = 1e-6 * _DOUBT_US
LENIENT = tuple(rule for rule in RULES_WITHOUT_JUMP if not rule.name.endswith("_silent"))


@pytest.mark.parametrize(
    ("name", "outcome"),
    [
        ("pilot", "released"),
        ("operator_release", "released"),
        ("px4_failsafe", "aborted"),
        ("disarmed", "aborted"),
    ],
)
def test_only_a_person_releases_a_flight(name: str, outcome: str) -> None:
    c = CAUSES[name].fire()
    c.run(0.3)
    assert known(c.core.end).outcome == outcome


def test_hold_mode_after_a_gap_is_a_failsafe_and_manual_mode_is_a_pilot() -> None:
    for mode, rule in ((FlightMode.HOLD, "px4_failsafe"), (FlightMode.MANUAL, "pilot")):
        c = core_in(Phase.APPROACH)
        c.silence()
        c.run(1.5)
        c.silent.clear()
        c.run(0.02)
        c.set_status(flight_mode=mode)
        assert c.fired[-1].rule == rule


@pytest.mark.parametrize(("more_s", "rule"), [(-0.2, "pilot"), (0.2, "px4_failsafe")])
def test_a_gap_explains_a_mode_change_only_if_it_is_long_enough(more_s: float, rule: str) -> None:
    c = core_in(Phase.APPROACH, rules=LENIENT)
    c.silence()
    c.run(GAP_S + more_s)
    c.silent.clear()
    c.run(0.02)
    c.set_status(flight_mode=FlightMode.HOLD)
    c.run(DOUBT_S + 0.01)
    assert c.fired[-1].rule == rule


@pytest.mark.parametrize(("more_s", "rule"), [(-0.1, "px4_failsafe"), (0.1, "pilot")])
@pytest.mark.parametrize(("cause", "memory_s"), [("text", TEXT_MEMORY_S), ("gap", GAP_MEMORY_S)])
def test_a_text_or_a_gap_explains_a_mode_change_for_a_limited_time(
    cause: str, memory_s: float, more_s: float, rule: str
) -> None:
    c = core_in(Phase.APPROACH, rules=LENIENT)
    if cause == "text":
        c.feed(StatusText(c.t_us, c.t_us, "critical", "Failsafe activated"))
    else:
        c.silent |= {"imu", "attitude", "odometry", "actuator"}
        c.run(GAP_S + 0.2)
        c.silent.clear()
    c.run(memory_s + more_s)
    c.set_status(flight_mode=FlightMode.HOLD)
    c.run(DOUBT_S + 0.01)
    assert c.fired[-1].rule == rule


def test_a_switch_to_hold_silences_the_mission_at_once_and_ends_it_after_a_doubt() -> None:
    c = core_in(Phase.APPROACH)
    c.outputs.clear()
    c.set_status(flight_mode=FlightMode.HOLD)
    c.run(DOUBT_S - 0.01)
    assert not c.fired
    c.run(0.02)
    assert c.fired_rules == ["pilot"]
    assert c.core.end is not None
    assert not [o for o in c.outputs if isinstance(o, Setpoint | VehicleCommand)]


def test_a_brief_change_of_mode_only_interrupts_the_setpoints() -> None:
    c = core_in(Phase.APPROACH)
    c.set_status(flight_mode=FlightMode.HOLD)
    c.run(0.5 * DOUBT_S)
    c.set_status(flight_mode=FlightMode.OFFBOARD)
    assert any(isinstance(o, Setpoint) for o in c.run(0.2))
    assert not c.fired


def test_a_kill_switch_is_detected_by_the_fall_before_px4_disarms() -> None:
    """The fall breaks another rule only after 0.3 s, and PX4 stays armed for 5 s more."""
    c = core_in(Phase.APPROACH)
    c.motors, c.falling = (0.0,) * 4, True
    c.run(_FALL_S)
    assert not c.fired
    c.run(0.04)
    assert c.fired_rules == ["disarmed"]
    assert c.core.end is not None
    assert c.core.end.reason is not None
    falling_ms = 1e3 * (_FALL_S + 0.004)
    assert c.core.end.reason.endswith(f"the vehicle has been falling for {falling_ms:.0f} ms")


@pytest.mark.parametrize("falling", [True, False])
def test_zero_throttle_or_free_fall_alone_is_no_kill_switch(falling: bool) -> None:
    c = core_in(Phase.APPROACH)
    c.motors, c.falling = c.motors if falling else (0.0,) * 4, falling
    c.run(0.3)
    assert "disarmed" not in set(c.fired_rules)
