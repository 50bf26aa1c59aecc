"""Signals that end a program: repeats, different signals, and an ignored SIGHUP."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from dart_flight.base import signals
from dart_flight.base.signals import STOP_SIGNALS, StopSignals

PACKAGE = Path(signals.__file__).parents[1]
INT, TERM, HUP = STOP_SIGNALS


@pytest.fixture(autouse=True)
def _default_handlers() -> Iterator[None]:
    """The test runner may ignore some signals."""
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    for number in STOP_SIGNALS:
        signal.signal(number, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    ("arrivals", "counted"),
    [
        ([(0.0, TERM), (0.01, TERM)], [TERM]),  # GNU timeout: the program, then its group
        ([(0.0, HUP), (0.1, HUP), (0.29, HUP)], [HUP]),  # shell, kernel
        ([(0.0, INT), (0.01, TERM)], [INT, TERM]),
        ([(0.0, TERM), (0.01, INT), (0.02, TERM), (0.03, INT)], [TERM, INT]),
        ([(0.0, INT), (0.31, INT)], [INT, INT]),
        ([(0.0, INT), (0.2, INT), (0.4, INT)], [INT, INT]),
    ],
)
def test_the_same_signal_within_300_ms_counts_once(
    arrivals: list[tuple[float, signal.Signals]],
    counted: list[signal.Signals],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    times = iter([time_s for time_s, _ in arrivals])
    monkeypatch.setattr("dart_flight.base.signals.time.monotonic", lambda: next(times))
    handled: list[signal.Signals] = []
    repeats: list[signal.Signals] = []
    with StopSignals(handled.append, repeats.append):
        for _, number in arrivals:
            signal.raise_signal(number)
    assert handled == counted
    assert len(repeats) == len(arrivals) - len(counted)


@pytest.mark.parametrize("handler", [signal.SIG_IGN, signal.default_int_handler])
def test_an_ignored_hangup_stays_ignored_and_others_are_restored(handler: signal._HANDLER) -> None:
    signal.signal(HUP, handler)
    handled: list[signal.Signals] = []
    with StopSignals(handled.append):
        signal.raise_signal(HUP)
    assert handled == ([] if handler is signal.SIG_IGN else [HUP])
    assert signal.getsignal(HUP) is handler
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(TERM)


def test_every_program_handles_a_hangup_by_the_same_mechanism() -> None:
    """The deadman ignores every signal; the pool keeps the signals of its group from its processes."""
    users = {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py") if "SIGHUP" in path.read_text()}
    handled = {name for name in users if "signal.SIGHUP" in (PACKAGE / name).read_text()}
    assert handled == {"base/signals.py", "run/deadman.py", "run/many_flights.py", "run/workers.py"}
