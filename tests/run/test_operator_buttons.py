"""Replies to the ground station's buttons in every state, and the transmitter's switch."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.records import Mode, Phase, Request
from dart_flight.run.operator_buttons import (
    AGAIN_S,
    Button,
    Errand,
    RcSwitch,
    StandbyButtons,
    StandbyState,
    reply_before_take_off,
    reply_in_flight,
)
from dart_flight.vehicle.command_server import Press, Result

OK, LATER, NO = Result.ACCEPTED, Result.TEMPORARILY_REJECTED, Result.DENIED
MISSIONS = ("wall", "square", "hairpin")
READY = StandbyState(MISSIONS, armed=False, remote_control=True)


# --- in flight ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", Phase)
def test_the_reply_in_flight_depends_on_button_and_phase(phase: Phase) -> None:
    replies = {button: reply_in_flight(Press(button, 1), phase, "lock rigid: settled") for button in Button}
    results = {button: reply.result for button, reply in replies.items()}
    contact = phase is Phase.CONTACT
    assert results == {
        Button.LOCK_RIGID: LATER if contact else NO,
        Button.LOCK_FLEXIBLE: LATER if contact else NO,
        Button.CONTINUE: OK if phase is Phase.PAUSE else LATER if contact else NO,
        Button.LAND: NO if phase is Phase.DONE else OK,
        Button.CHECK: OK,
        Button.FLY: NO,
    }
    assert replies[Button.CHECK].text == f"in flight: {phase}; lock rigid: settled"
    # The only effects are landing, until the vehicle lands, and continuing, in a pause.
    effects = {button: reply.effect for button, reply in replies.items() if reply.effect is not None}
    wanted: dict[Button, Request] = {}
    if phase not in (Phase.LANDING, Phase.DONE):
        wanted[Button.LAND] = Request.LAND
    if phase is Phase.PAUSE:
        wanted[Button.CONTINUE] = Request.CONTINUE
    assert effects == wanted


@given(st.integers(-1, 300), st.integers(-1, 300), st.sampled_from(Phase), st.text(max_size=20))
def test_no_button_ever_releases_the_vehicle(button: int, value: int, phase: Phase, lock: str) -> None:
    reply = reply_in_flight(Press(button, value), phase, lock)
    assert reply.effect in (None, Request.LAND, Request.CONTINUE)
    assert reply.text
    if button not in tuple(Button):
        assert (reply.result, reply.effect) == (NO, None)


# --- in standby --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("press", "state", "result", "effect"),
    [
        (Press(1), READY, OK, Mode.RIGID),
        (Press(2), READY, OK, Mode.FLEXIBLE),
        (Press(1), READY._replace(armed=True), OK, Mode.RIGID),  # a pilot flies by hand
        (Press(1), READY._replace(has_lock=False), NO, None),
        (Press(1), READY._replace(travelling=Mode.FLEXIBLE), LATER, None),
        (Press(1), READY._replace(travelling=Mode.RIGID), OK, Mode.RIGID),
        (Press(3), READY, NO, None),
        (Press(4), READY, NO, None),
        (Press(5), READY, OK, Errand(False, (1, 2, 3))),
        (Press(5, 2), READY, OK, Errand(False, (2,))),
        (Press(5, 4), READY, NO, None),
        (Press(5), READY._replace(remote_control=False), OK, Errand(False, (1, 2, 3))),
        (Press(5), READY._replace(armed=True), NO, None),
        (Press(6, 1), READY._replace(armed=None), NO, None),
        (Press(5), StandbyState(()), NO, None),
        (Press(6, 1), READY, OK, None),  # the first press only asks for confirmation
        (Press(6, 0), READY, NO, None),
        (Press(6, 4), READY, NO, None),
        (Press(6, 1), READY._replace(remote_control=False), NO, None),
        (Press(6, 1), READY._replace(armed=True), NO, None),
        (Press(6, 1), StandbyState(()), NO, None),
        (Press(0), READY, NO, None),
        (Press(7), READY, NO, None),
    ],
)
def test_the_reply_in_standby_depends_on_button_and_state(
    press: Press, state: StandbyState, result: Result, effect: object | None
) -> None:
    reply = StandbyButtons().reply(press, state, 100.0)
    assert (reply.result, reply.effect) == (result, effect), reply.text


def test_fly_needs_two_presses() -> None:
    buttons = StandbyButtons()
    first = buttons.reply(Press(6, 2), READY, 100.0)
    assert first.text == "fly square? press again within 10 s"
    assert buttons.reply(Press(6, 2), READY, 102.0).effect == Errand(True, (2,))
    assert buttons.reply(Press(6, 2), READY, 103.0).effect is None, "the third press must start a new pair"


@pytest.mark.parametrize(
    "between",
    [
        [],  # too late
        [(Press(6, 1), 101.0)],  # another mission
        [(Press(5), 101.0)],
        [(Press(1), 101.0)],
    ],
)
def test_two_presses_that_do_not_match_start_no_flight(between: list[tuple[Press, float]]) -> None:
    buttons = StandbyButtons()
    buttons.reply(Press(6, 2), READY, 100.0)
    for press, now_s in between:
        assert not isinstance(buttons.reply(press, READY, now_s).effect, Errand) or press.button == 5
    late_s = 102.0 if between else 100.0 + AGAIN_S + 0.1
    assert buttons.reply(Press(6, 2), READY, late_s).effect is None


@pytest.mark.parametrize("button", range(8))
def test_before_take_off_only_land_has_an_effect(button: int) -> None:
    reply = reply_before_take_off(Press(button, 1))
    lands = button == Button.LAND
    assert (reply.effect, reply.result) == ((Request.LAND, OK) if lands else (None, LATER))


def test_land_cancels_the_first_press_of_fly() -> None:
    buttons = StandbyButtons()
    assert buttons.reply(Press(Button.LAND), READY, 99.0).result == NO
    buttons.reply(Press(6, 2), READY, 100.0)
    assert buttons.reply(Press(Button.LAND), READY, 101.0).text == "take-off cancelled"
    assert buttons.reply(Press(6, 2), READY, 102.0).effect is None


@given(st.lists(st.floats(3.0, 3.5), min_size=1, max_size=3), st.booleans())
def test_a_repeated_command_does_not_count_as_a_second_press(intervals_s: list[float], marked: bool) -> None:
    """If an answer is lost, QGroundControl repeats the command up to three times, without marking it."""
    buttons, now_s = StandbyButtons(), 100.0
    assert buttons.reply(Press(6, 1), READY, now_s).effect is None
    for interval_s in intervals_s:
        now_s += interval_s
        assert buttons.reply(Press(6, 1, repeated=marked), READY, now_s).effect is None
    assert buttons.reply(Press(6, 1), READY, now_s + 1.0).effect == Errand(True, (1,)), (
        "the second real press must fly"
    )


@given(
    st.lists(
        st.tuples(st.integers(-1, 8), st.integers(-1, 4), st.booleans(), st.floats(0.0, 20.0)), max_size=12
    ),
    st.sampled_from([READY, READY._replace(armed=True), READY._replace(remote_control=False)]),
)
def test_a_flight_starts_only_after_two_presses_of_one_button(
    presses: list[tuple[int, int, bool, float]], state: StandbyState
) -> None:
    buttons, now_s = StandbyButtons(), 0.0
    before: tuple[Press, float] | None = None
    for button, value, repeated, later_s in presses:
        now_s += later_s
        press = Press(button, value, repeated)
        reply = buttons.reply(press, state, now_s)
        if isinstance(reply.effect, Errand) and reply.effect.fly:
            assert state.remote_control
            assert not state.armed
            assert before is not None
            assert before[0][:2] == press[:2]
            assert now_s - before[1] <= AGAIN_S
            assert not repeated
        before = (press, now_s)


# --- the transmitter's switch ------------------------------------------------------------------------------


def lock_moves(*pulses: tuple[float, int]) -> list[tuple[float, Mode]]:
    switch = RcSwitch()
    found = [(at_s, switch.update(pulse_us, at_s)) for at_s, pulse_us in pulses]
    return [(at_s, mode) for at_s, mode in found if mode is not None]


def steady(start_s: float, end_s: float, pulse_us: int) -> list[tuple[float, int]]:
    return [(start_s + 0.1 * i, pulse_us) for i in range(round(10 * (end_s - start_s)))]


def test_each_switch_movement_moves_the_lock_once() -> None:
    pulses = steady(0, 2, 1000) + steady(2, 4, 2000) + steady(4, 6, 1000)
    assert [mode for _, mode in lock_moves(*pulses)] == [Mode.RIGID, Mode.FLEXIBLE]


@pytest.mark.parametrize("pulse_us", [1000, 1500, 2000])
def test_the_initial_switch_position_does_not_move_the_lock(pulse_us: int) -> None:
    assert lock_moves(*steady(0, 5, pulse_us)) == []


def test_the_middle_position_and_short_pulses_do_not_move_the_lock() -> None:
    assert lock_moves(*steady(0, 1, 1000), *steady(1, 3, 1500), *steady(3, 4, 1000)) == []
    assert lock_moves(*steady(0, 1, 1000), *steady(1.0, 1.3, 2000), *steady(1.3, 3, 1000)) == []
    # A move through the middle to the other end counts; noise around one threshold does not.
    assert [m for _, m in lock_moves(*steady(0, 1, 1000), *steady(1, 2, 1500), *steady(2, 3, 2000))] == [
        Mode.RIGID
    ]
    noisy = [(0.1 * i, 1680 + 40 * (i % 2)) for i in range(50)]
    assert lock_moves(*steady(-2, 0, 1000), *noisy) == []


def test_the_switch_position_after_a_signal_loss_does_not_move_the_lock() -> None:
    assert lock_moves(*steady(0, 1, 1000), *steady(4, 6, 2000)) == []
    assert lock_moves(*steady(0, 1, 1000), *steady(1, 4, 0), *steady(4, 6, 2000)) == []
    lost = lock_moves(*steady(0, 1, 1000), *steady(4, 5, 2000), *steady(5, 6, 1000))
    assert [mode for _, mode in lost] == [Mode.FLEXIBLE]


@given(st.lists(st.integers(0, 3000), max_size=60))
def test_the_switch_never_requests_the_same_mode_twice_in_a_row(pulses: list[int]) -> None:
    found = [mode for _, mode in lock_moves(*((0.3 * i, pulse) for i, pulse in enumerate(pulses)))]
    assert all(a is not b for a, b in pairwise(found))
