"""Lockstep with the application: simulated time does not advance until the application has answered.

The world counts the messages that it has sent. The application reports in `Stepped` which of these messages
the core has processed, and which messages the application has sent. Time waits until

- the core has processed all telemetry and poses,
- all setpoints and poses from the application have reached the autopilot,
- all commands, lock orders and plans have their results.

A busy computer therefore makes a simulated flight slower but never different.

If a datagram is lost, time waits for `_LOST_S` and then advances by one tick. The next message replaces the
lost message: if the core has processed a message, all older messages of the same stream count as processed.
A setpoint or pose from the application that does not arrive also counts as lost, because MAVSDK repeats
setpoints only in offboard mode.

Whenever time waits for `_LOST_S`, the world's log names what is missing.
"""

from __future__ import annotations

import math
import select
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final, Protocol

from dart_flight.base.errors import FlightError
from dart_flight.sim.embedded_autopilot import TICK_US
from dart_flight.sim.pipe import Stepped

_SILENT_S: Final = 10.0  # after this host time without an answer, the flight ends
_LOST_S: Final = 1.0  # after this host time, an unanswered message counts as lost and is logged
_POLL_S: Final = 0.05  # host time between two polls if no descriptor wakes the world
_STEP_MAX_S: Final = 0.2  # host time counted at most for one poll, because the process may be suspended
_SENDER_S: Final = 0.2  # wait at most this host time for the autopilot's sender to catch up
_SENDER: Final = "the autopilot to send its telemetry"
_TELEMETRY: Final = "the application to process its telemetry"
_SENT: Final = {kind: f"a {kind} of the application" for kind in ("setpoint", "pose")}
_MAY_BE_LOST: Final = (_TELEMETRY, *_SENT.values())
_SETPOINT_TOLERANCE: Final = 1e-5  # relative; MAVLink carries single precision


class SilentParticipantError(FlightError):
    """A participant in the lockstep did not answer."""


class LinkEnd(Protocol):
    """The autopilot's side of the link, as an interface for lockstep."""

    @property
    def sent_us(self) -> Mapping[str, int]:
        """The newest stamp sent on each telemetry stream, microseconds."""

    @property
    def arrived(self) -> Mapping[str, Sequence[float]]:
        """Values of the last message of each kind that has reached the autopilot, as in `Stepped.sent`."""

    def answer_requests(self) -> None:
        """While time stands still, answer the requests that have arrived."""


class Lockstep:
    """The rule that decides whether simulated time may advance.

    Args:
        answers_at_rest: whether the autopilot answers requests while time stands still. A real PX4 does not
            answer, so time advances while PX4 has an outstanding request. Even then, time waits for the core
            to process telemetry.
        waits_at_first: whether time stands still until the application's first report.
        sender_lag_us: largest delay of the autopilot's telemetry in simulated time; 0 if the autopilot sends
            in the world's thread.
    """

    def __init__(
        self,
        autopilot: LinkEnd,
        *,
        answers_at_rest: bool,
        waits_at_first: bool,
        sender_lag_us: int = 0,
        log: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._autopilot, self._answers_at_rest = autopilot, answers_at_rest
        self._waits_at_first, self._sender_lag_us = waits_at_first, sender_lag_us
        self._log, self._named = log, False
        self._lost: dict[str, tuple[float | None, ...]] = {}  # values that count as lost, by kind
        self._report: Stepped | None = None
        self._unanswered_s = 0.0  # host time waited since the last report
        self._from_us: dict[str, int] = {}
        self._published: dict[str, int] = {}  # newest number on each stream that the world itself sends

    @property
    def engaged(self) -> bool:
        """Whether the world currently waits for the application."""
        return self._waits_at_first if self._report is None else self._report.flies

    @property
    def limits_pace(self) -> bool:
        """Whether lockstep limits the pace of the world; if so, no other limit is needed."""
        report = self._report
        return self.engaged and not (report is not None and report.commands and not self._answers_at_rest)

    def update(self, report: Stepped) -> None:
        if self._report is None:
            # Do not wait for messages that were sent before the application listened.
            self._from_us = self._sent()
        self._report, self._unanswered_s = report, 0.0

    def publish(self, stream: str, number: int) -> None:
        """Store the number of the newest message on a stream that the world sends; numbers must increase."""
        self._published[stream] = number

    def _sent(self) -> dict[str, int]:
        return {**self._autopilot.sent_us, **self._published}

    def outstanding(self, next_us: int) -> str | None:
        """Name a missing message or result, or return None if time may advance to `next_us`."""
        report = self._report
        if report is None:
            return "the application to connect" if self._waits_at_first else None
        if not report.flies:
            return None
        if report.commands and self._answers_at_rest:
            return "the result of a command"
        # The application's clock is the newest stamp, so a message with the due time must arrive first.
        if report.plan_due_us is not None and next_us > report.plan_due_us + TICK_US + self._sender_lag_us:
            return "the planner"
        # MAVSDK may hold a setpoint back until a command has its result.
        if not report.commands:
            for kind, values in report.sent.items():
                if values != self._lost.get(kind) and not self._has_arrived(kind, values):
                    return _SENT[kind]
        if (
            self._sender_lag_us
            and self._autopilot.sent_us.get("imu", next_us) < next_us - self._sender_lag_us
        ):
            return _SENDER
        batch_end_us = report.streams.get("imu", 0) + report.batch_us + self._sender_lag_us
        if report.batch_us and next_us <= batch_end_us:
            return None
        for stream, sent_us in self._sent().items():
            if sent_us > max(report.streams.get(stream, 0), self._from_us.get(stream, 0)):
                return _TELEMETRY
        return None

    def wait(self, next_us: int, wake: Sequence[int], look: Callable[[], bool]) -> None:
        """Block until simulated time may advance to `next_us`.

        Args:
            wake: descriptors that become readable when data has arrived.
            look: processes the application's lines and returns whether the application is still connected.

        Raises:
            SilentParticipantError: the application has sent nothing for 10 s of host time.
        """
        polled_s, waited_s = time.monotonic(), 0.0
        while look():
            # Process arrived data before calling `select`, which wakes only for unread data.
            self._autopilot.answer_requests()
            missing = self.outstanding(next_us)
            if missing is None:
                self._name(None, waited_s)
                return
            now_s = time.monotonic()
            # Do not count time in which this process did not run.
            step_s, polled_s = min(now_s - polled_s, _STEP_MAX_S), now_s
            waited_s += step_s
            if self._report is not None:
                self._unanswered_s += step_s
                if waited_s > _LOST_S:
                    self._name(missing, waited_s)
                if max(self._unanswered_s, waited_s) > _SILENT_S:
                    text = f"the simulation waited {_SILENT_S:g} s for {missing}{self._difference(missing)}"
                    raise SilentParticipantError(text)
                if missing in _MAY_BE_LOST and waited_s > _LOST_S:
                    self._lost = dict(self._report.sent)
                    return
                if missing is _SENDER and waited_s > _SENDER_S:
                    return
            select.select(wake, [], [], _POLL_S)

    def _name(self, missing: str | None, waited_s: float) -> None:
        """Log once that an answer has been missing for a long time, and log when time advances again."""
        if missing is not None and not self._named:
            self._log(f"the simulation has waited {waited_s:.1f} s for {missing}{self._difference(missing)}")
        elif missing is None and self._named:
            self._log("the simulation continues")
        self._named = missing is not None

    def _difference(self, missing: str) -> str:
        """Return a suffix for a log message: what was sent, and what has arrived."""
        if missing is _TELEMETRY and self._report is not None:
            processed = self._report.streams
            return "".join(
                f", {stream} {processed.get(stream, 0)} of {sent}"
                for stream, sent in self._sent().items()
                if sent > processed.get(stream, 0)
            )
        kind = next((kind for kind, text in _SENT.items() if text == missing), None)
        if kind is None or self._report is None:
            return ""
        sent = self._report.sent.get(kind, ())
        arrived = self._autopilot.arrived.get(kind, ())
        return f": sent {_in_words(sent)}, arrived {_in_words(arrived)}"

    def _has_arrived(self, kind: str, wanted: Sequence[float | None]) -> bool:
        arrived = self._autopilot.arrived.get(kind, ())
        return len(arrived) == len(wanted) and all(
            value is None
            or math.isclose(value, here, rel_tol=_SETPOINT_TOLERANCE, abs_tol=_SETPOINT_TOLERANCE)
            for value, here in zip(wanted, arrived, strict=True)
        )


def _in_words(values: Sequence[float | None]) -> str:
    return " ".join("-" if value is None else f"{value:.3f}" for value in values) or "nothing"
