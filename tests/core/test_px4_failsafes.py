"""PX4 failsafes: detected at the first evidence, named with their cause, not mistaken for a pilot."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.records import (
    FlightMode,
    LandedState,
    MissionEnd,
    Override,
    Phase,
    Setpoint,
    StatusText,
    SystemStatus,
    VehicleCommand,
)
from dart_flight.core.guard.failsafe import _MEMORY_US, FailsafeEvidence
from tests.core.conftest import HandFedCore, core_in, of_kind

ENTER = "commander_failsafe_enter"


def send_text(c: HandFedCore, text: str, event: str = "") -> None:
    c.feed(StatusText(c.t_us, c.t_us, "critical", text, event))


def flying() -> HandFedCore:
    c = core_in(Phase.APPROACH)
    c.set_status(system_status=SystemStatus.ACTIVE)
    assert c.core.phase is Phase.APPROACH
    return c


@pytest.mark.parametrize(
    ("text", "event", "mode"),
    [
        ("Critical battery level: switching to Land", "", FlightMode.LAND),
        ("Critical battery level: switching to Land", ENTER, FlightMode.LAND),
        ("Manual control loss: switching to RTL", ENTER, FlightMode.RETURN),
        ("GCS connection loss: switching to Land in 5 seconds", ENTER + "_hold", FlightMode.HOLD),
        ("Manual control loss: switching to Position mode", ENTER, FlightMode.MANUAL),
        ("Failsafe activated: switching to Land\nGeofence violation", ENTER + "_generic", FlightMode.LAND),
    ],
)
def test_a_failsafe_is_named_with_its_cause(text: str, event: str, mode: FlightMode) -> None:
    c = flying()
    send_text(c, text, event)
    send_text(c, "Failsafe activated")  # the generic text that follows does not replace the cause
    text = text.replace("\n", "; ")
    c.set_status(flight_mode=mode, system_status=SystemStatus.CRITICAL)
    assert c.fired_details[-1] == ("px4_failsafe", f"{text}; PX4 is in {mode.value}")
    (end,) = of_kind(MissionEnd, c.outputs)
    assert (end.outcome, end.reason) == ("aborted", f"px4_failsafe: {text}; PX4 is in {mode.value}")


@pytest.mark.parametrize(
    ("text", "event"),
    [
        ("Failsafe activated", ""),
        ("Failsafe activated: switching to Hold", ENTER + "_generic"),
        ("Failsafe activated: Autopilot disengaged, switching to Descend", ENTER + "_autopilot_disengaged"),
        ("Geofence breached: switching to Return", ""),
        ("Low battery level: switching to Land", ""),
        ("in another language", ENTER),
    ],
)
def test_a_failsafe_text_breaks_off_before_a_heartbeat_reports_the_mode(text: str, event: str) -> None:
    c = flying()
    send_text(c, text, event)
    assert c.fired_details == [("failsafe_announced", text)]
    assert c.core.override is Override.BREAK_OFF
    c.outputs.clear()
    c.run(0.5)
    assert all(o.velocity_ned is None for o in c.outputs if isinstance(o, Setpoint))  # no approach velocity


@pytest.mark.parametrize("status", [SystemStatus.CRITICAL, SystemStatus.EMERGENCY])
def test_the_heartbeat_status_alone_is_evidence_of_a_failsafe(status: SystemStatus) -> None:
    c = flying()
    c.set_status(system_status=status)
    assert c.fired_details == [("failsafe_announced", "PX4 reports a failsafe and gives no cause")]
    c.set_status(flight_mode=FlightMode.LAND)  # at once: no further evidence is needed
    assert c.fired_details[-1] == (
        "px4_failsafe",
        "PX4 reports a failsafe and gives no cause; PX4 is in land",
    )


def test_a_mode_received_just_before_its_failsafe_status_is_not_a_pilot() -> None:
    c = flying()
    c.set_status(flight_mode=FlightMode.LAND)
    c.run(0.004)
    c.set_status(system_status=SystemStatus.CRITICAL)
    assert c.fired_rules == ["px4_failsafe"]


@pytest.mark.parametrize(
    ("text", "event"),
    [
        ("Low battery level, return advised", ENTER + "_low_bat"),
        ("Critical battery level, land now", ENTER + "_crit_bat_warn"),
        ("Failsafe warning: GCS connection loss", ENTER + "_warn"),
        ("Switching to mode Hold is currently not available", "commander_modeswitch_not_avail"),
        ("Takeoff detected", "commander_takeoff_detected"),
    ],
)
def test_a_warning_does_not_end_the_flight(text: str, event: str) -> None:
    c = flying()
    send_text(c, text, event)
    c.run(0.5)
    assert c.fired_details == []
    c.set_status(flight_mode=FlightMode.MANUAL)
    assert c.fired_rules == ["pilot"]


def test_a_failsafe_text_before_take_off_ends_nothing() -> None:
    c = HandFedCore()
    send_text(c, "Failsafe activated")
    c.run(0.1)
    assert c.fired_details == []


@pytest.mark.parametrize("words", ["Kill engaged", "Failsafe activated: switching to terminate", None])
def test_a_termination_is_reported_before_streams_are_silent(words: str | None) -> None:
    c = flying()
    c.silent |= {"actuator"}
    if words is None:
        c.set_status(system_status=SystemStatus.FLIGHT_TERMINATION, flight_mode=FlightMode.UNKNOWN)
    else:
        send_text(c, words)
    c.run(1.0)
    rule, detail = c.fired_details[-1]
    assert rule == "terminated"
    assert detail == "PX4 has stopped the motors" + (f": {words}" if words else "")
    assert len(c.fired_details) == 1
    (end,) = of_kind(MissionEnd, c.outputs)
    assert end.outcome == "aborted"
    assert not [o for o in c.outputs[c.outputs.index(end) :] if isinstance(o, Setpoint | VehicleCommand)]


def test_a_kill_after_touchdown_is_no_termination_of_the_flight() -> None:
    c = flying()
    c.set_status(landed=LandedState.ON_GROUND, system_status=SystemStatus.FLIGHT_TERMINATION)
    assert "terminated" not in c.fired_rules


@given(
    st.lists(
        st.tuples(
            st.sampled_from(
                ["Failsafe activated", "A: switching to Land", "Failsafe warning: B", "Armed", "Kill engaged"]
            ),
            st.integers(0, 4_000_000),
        ),
        max_size=8,
    )
)
def test_status_texts_are_evidence_for_a_limited_time(texts: list[tuple[str, int]]) -> None:
    evidence, now_us = FailsafeEvidence(), 10_000_000
    for text, after_us in texts:
        now_us += after_us
        evidence.add_text(StatusText(now_us, now_us, "critical", text), now_us)
        if "switching to" in text:
            assert evidence.announcement(now_us) == text
    now_us += _MEMORY_US
    assert evidence.announcement(now_us) is None
    assert evidence.termination(now_us) is None
    assert not evidence.is_mentioned(now_us)
    assert evidence.words(now_us) == ""
