"""The telemetry streams that the guard watches, and the table of their rules: failure, limit, action.

Silence is measured by host time, the rate by stamps, the delay by stamps, receipts and round trips.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Final

from dart_flight.base.filters import kept_share
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ImuSample,
    OdometrySample,
    Override,
    RoundTrip,
)
from dart_flight.base.streams import BY_NAME
from dart_flight.config.vehicle.flying import GuardThresholds
from dart_flight.core.guard.rule import Judge, Rule, Scope
from dart_flight.core.sense.state import FlightState

Stamped = ImuSample | AttitudeSample | OdometrySample | ActuatorSample

LINK_LOST_S: Final = 5.0  # PX4's own failsafe for a lost link has had its time by then
ACTUATOR_TIMEOUT_S: Final = 0.3  # force cannot be told from thrust for a third of a second at most
STATUS_TIMEOUT_S: Final = 3.0  # three heartbeats
STAMP_TOLERANCE_S: Final = 0.5  # a datagram that comes later than others is never so late
_OTHERS_SINCE: Final = 12  # a tenth of a second of one other stream
_GAP_US: Final = 500_000  # of silence, in which PX4 may have said anything
_GAP_MEMORY_US: Final = 3_000_000  # a gap this long ago explains a change of mode
_RATE_WINDOW_US: Final = 1_000_000
_LEAP_US: Final = 1_000_000
_SHARE: Final = 0.15  # of about the last second; what comes in one batch after a pause takes no time
_SHARE_US: Final = 1_000_000
_STEP_MAX_US: Final = 20_000  # a sample stands for the time since the one before, and for no more than this
_DRIFT: Final = 2e-4  # of two clocks against each other, seconds per second, at most
_LAST: Final = 3  # round trips, of which the shortest counts where the clocks cannot be compared
_AGE_MAX_S: Final = 999.0  # a stream that never came is infinitely old


class TelemetryDelay:
    """Age of the samples of one vehicle; nothing is known of it before the first round trip.

    A delay that is always the same does not show in stamps: the offset between the clocks hides it. A round
    trip bounds it: the time with which the autopilot answers lies between asking and hearing, so the offset
    that it gives is wrong by half the round trip at most. The best one so far relates the stamp of an IMU
    sample to its receipt.

    Args:
        limit_s: samples older than this are late.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_us = limit_s * 1e6
        self._offset_us: float | None = None  # autopilot's time less the host's
        self._error_us = 0.0  # of it, at most
        self._measured_us = 0  # host time
        self._last: deque[int] = deque(maxlen=_LAST)
        self._received_us = 0
        self._share = 0.0
        self.age_us = 0.0  # of the newest sample
        self.late = False

    def take_round_trip(self, trip: RoundTrip) -> None:
        """A request and its answer."""
        took_us = max(0, trip.received_us - trip.sent_us)
        self._last.append(took_us)
        if trip.autopilot_us is None:
            return
        offset_us = trip.autopilot_us - 0.5 * (trip.sent_us + trip.received_us)
        error_us = 0.5 * took_us
        if self._offset_us is not None:
            drifted_us = self._error_us + _DRIFT * (trip.received_us - self._measured_us)
            # Further apart than both can be wrong: the autopilot's clock has jumped.
            jumped = abs(offset_us - self._offset_us) > drifted_us + error_us
            if error_us > drifted_us and not jumped:
                return
        self._offset_us, self._error_us, self._measured_us = offset_us, error_us, trip.received_us

    def take_sample(self, t_us: int, received_us: int) -> None:
        """An IMU sample: when it was taken, and when it came."""
        if not self._last:
            return
        if self._offset_us is None:
            self.age_us = 0.5 * min(self._last)
        else:
            self.age_us = received_us + self._offset_us - t_us
        step_us = min(max(received_us - self._received_us, 0), _STEP_MAX_US)
        self._received_us = received_us
        kept = kept_share(step_us, _SHARE_US)
        self._share = kept * self._share + (1.0 - kept if self.age_us > self._limit_us else 0.0)
        self.late = self._share > _SHARE

    def describe(self) -> str:
        """What is known, in words."""
        shortest_us = min(self._last, default=0)
        also = f", round trip {shortest_us * 1e-3:.0f} ms" if shortest_us > self._limit_us else ""
        return f"telemetry arrives {self.age_us * 1e-3:.0f} ms after it was sampled{also}"


class StreamWatch:
    """What is known of the telemetry streams of one flight.

    Attributes:
        rates_hz: of the streams by stamps, over the last second.
        stale: samples in a row whose stamp lies far in the past, where there are.
        delay: age of the samples when they come.
        host_us: receipt of the newest stamped sample.
    """

    def __init__(self, guard: GuardThresholds) -> None:
        self.guard = guard
        self.state = FlightState()  # replaced by the core's at the first step
        self.rates_hz: dict[str, float] = {}
        self.stale: dict[str, int] = {}
        self.delay = TelemetryDelay(guard.telemetry_late_s)
        self.host_us = 0
        self._since_imu = 0  # samples of other streams since the newest of the IMU
        self._counts: dict[str, tuple[int, int]] = {}  # first stamp, and samples since
        self._gap_us: int | None = None

    def take(self, name: str, item: Stamped, newest: Stamped | None) -> None:
        """Take a sample of a stream; `newest` is the one that the flight state has accepted last."""
        t_us, received_us = item.t_us, item.received_us
        if received_us > self.host_us:
            if self.host_us and received_us - self.host_us > _GAP_US:
                self._gap_us = self.state.now_us
            self.host_us = received_us
        self._since_imu = 0 if name == "imu" else self._since_imu + 1
        lag_us = (newest or item).t_us - t_us
        if lag_us > STAMP_TOLERANCE_S * 1e6:
            self.stale[name] = self.stale.get(name, 0) + 1
            return
        if -lag_us > _LEAP_US:  # not taken yet: another vehicle's, or a clock that has jumped
            return
        if self.stale:
            self.stale.pop(name, None)
        first_us, count = self._counts.get(name, (t_us, 0))
        span_us = t_us - first_us
        if span_us >= _RATE_WINDOW_US:
            self.rates_hz[name] = count * 1e6 / span_us
            first_us, count = t_us, 0
        self._counts[name] = (first_us, count + 1)

    @property
    def was_cut_off(self) -> bool:
        """Whether telemetry has come back within the last seconds after a gap."""
        return self._gap_us is not None and self.state.now_us - self._gap_us < _GAP_MEMORY_US

    @property
    def others_go_on(self) -> bool:
        """Whether other streams go on while the IMU is silent."""
        return self._since_imu >= _OTHERS_SINCE

    def age_s(self, name: str) -> float:
        """Return host time since a stream's newest sample was received, seconds; infinite without one."""
        newest = getattr(self.state, name)
        return (self.state.host_us - newest.received_us) * 1e-6 if newest is not None else math.inf


def _silence(
    description: str, streams: tuple[str, ...], limit: str | float, words: str = "", alone: str = ""
) -> Judge:
    """Return the judge of streams that have been silent together for longer than a limit.

    Args:
        description: for the manual's table.
        streams: by name.
        limit: seconds, or the key of the guard's thresholds that has them.
        words: how the silence is told; `s` and `ms` are its duration.
        alone: key of the limit while other streams go on: then neither link nor host is the cause.
    """
    message = BY_NAME[streams[0]].message if streams[0] in BY_NAME else ""

    def cause(v: Any) -> str | None:
        watch: StreamWatch = v.streams
        age_s = min([watch.age_s(name) for name in streams])
        limit_s = getattr(watch.guard, limit) if isinstance(limit, str) else limit
        if age_s <= limit_s and not (alone and watch.others_go_on and age_s > getattr(watch.guard, alone)):
            return None
        age_s = min(age_s, _AGE_MAX_S)
        about = watch.state.text_about(message) if message else ""
        return (words or "for {ms:.0f} ms").format(s=age_s, ms=1e3 * age_s) + about

    limits = [f"guard.{key}" if isinstance(key, str) else f"{key:g} s" for key in (alone, limit) if key]
    return Judge(description, ", ".join(limits), cause)


def _slow(v: Any) -> str | None:
    for name, rate_hz in v.streams.rates_hz.items():
        if rate_hz < BY_NAME[name].expected_hz:
            return f"{name} at {rate_hz:.0f} Hz, needs {BY_NAME[name].expected_hz:.0f}"
    return None


def _late(v: Any) -> str | None:
    return v.streams.delay.describe() if v.streams.delay.late else None


SAMPLED: Final = ("imu", "attitude", "odometry", "actuator")
_LINK: Final = ("status", "imu", "attitude", "odometry")
_AIR, _LAND = Scope.AIR, Override.LAND

# fmt: off
STREAM_RULES: tuple[Rule, ...] = tuple(rule._replace(of_streams=True) for rule in (
    Rule("link_lost", Override.RELEASE, _AIR, _silence(
        "no telemetry at all: PX4's own failsafe must act",
        _LINK, LINK_LOST_S, "no telemetry for {s:.1f} s")),
    Rule("imu_silent", _LAND, _AIR, _silence(
        "IMU stream timed out: impacts cannot be detected",
        ("imu",), "stream_timeout_s", alone="imu_timeout_s")),
    Rule("attitude_silent", _LAND, _AIR, _silence(
        "attitude stream timed out: force direction unknown", ("attitude",), "stream_timeout_s")),
    Rule("odometry_silent", _LAND, _AIR, _silence(
        "position stream timed out", ("odometry",), "stream_timeout_s")),
    Rule("actuator_silent", Override.HOLD, Scope.FLYING, _silence(
        "actuator stream timed out: thrust and contact force cannot be separated",
        ("actuator",), ACTUATOR_TIMEOUT_S)),
    Rule("status_silent", _LAND, _AIR, _silence(
        "heartbeat timed out", ("status",), STATUS_TIMEOUT_S, "for {s:.1f} s")),
    Rule("stream_rate", Override.HOLD, Scope.FLYING, Judge(
        "a stream comes at less than the rate that a mission needs (`base/streams.py`)",
        "streams: expected_hz", _slow)),
    Rule("telemetry_late_ground", Override.GIVE_UP, Scope.GROUND, Judge(
        "telemetry arrives too late to act on", "guard.telemetry_late_s", _late)),
    Rule("telemetry_late", _LAND, _AIR, Judge(
        "telemetry has been late for more than a moment", "guard.telemetry_late_s", _late),
        explains=frozenset({"imu_silent", "attitude_silent", "odometry_silent", "status_silent"})),
))
# fmt: on
