"""Monitoring of the telemetry streams, and the table of their rules: failure, limit, action.

Silence is measured in host time, and the rate is measured by the samples' stamps. The delay is measured by
the samples' stamps, their times of receipt, and the link's round trips.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Final

from dart_flight.base.filters import decay_factor
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ImuSample,
    OdometrySample,
    Override,
    RoundTrip,
)
from dart_flight.base.stamps import leaps
from dart_flight.base.streams import BY_NAME
from dart_flight.config.vehicle.flying import GuardThresholds
from dart_flight.core.guard.rule import Rule, RuleCondition, Scope
from dart_flight.core.sense.state import FlightState

Stamped = ImuSample | AttitudeSample | OdometrySample | ActuatorSample

LINK_LOST_S: Final = 5.0  # silence after which PX4's own failsafe for a lost link has acted
ACTUATOR_TIMEOUT_S: Final = 0.3  # silence of the actuators after which the force estimate is unusable
STATUS_TIMEOUT_S: Final = 3.0  # time of three heartbeats
STAMP_TOLERANCE_S: Final = 0.5  # largest delay of a datagram
_OTHERS_SINCE: Final = 12  # this many samples since the newest IMU sample show that other streams continue
_GAP_US: Final = 500_000  # a silence of this length may have hidden an announcement by PX4
_GAP_MEMORY_US: Final = 3_000_000  # time after a gap in which the gap may explain a change of mode
_RATE_WINDOW_US: Final = 1_000_000
_SHARE: Final = 0.15  # largest fraction of time with late samples; a batch after a pause takes no time
_SHARE_US: Final = 1_000_000
_FORGOTTEN: Final = 0.01  # below this fraction, earlier late samples are forgotten
_STEP_MAX_US: Final = 20_000  # limit of the time that one sample represents
_DRIFT: Final = 2e-4  # largest drift of two clocks, seconds per second
_LAST: Final = 3  # number of kept round trips; if the clock offset is unknown, the shortest bounds the delay
_AGE_MAX_S: Final = 999.0  # reported age, s, of a stream without a sample


class TelemetryDelay:
    """Estimator of the age of a vehicle's samples at their receipt; it needs at least one round trip.

    Stamps do not show a constant delay, because the clock offset hides it. A round trip bounds this delay.
    The autopilot answers at some time between request and receipt, so the clock offset from a round trip is
    wrong by at most half the duration of the round trip. The age of an IMU sample is computed from its stamp,
    its receipt, and the most accurate offset so far. Samples older than `limit_s` are late.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_us = limit_s * 1e6
        self._offset_us: float | None = None  # autopilot's time minus the host's
        self._error_us = 0.0  # error bound of the offset
        self._measured_us = 0  # host time of the offset's measurement
        self._last: deque[int] = deque(maxlen=_LAST)
        self._received_us = 0
        self._share = 0.0
        self.age_us = 0.0  # age of the newest sample
        self._oldest_us = 0.0  # largest age of the samples that were late recently
        self.late = False

    def add_round_trip(self, trip: RoundTrip) -> None:
        took_us = max(0, trip.received_us - trip.sent_us)
        self._last.append(took_us)
        if trip.autopilot_us is None:
            return
        offset_us = trip.autopilot_us - 0.5 * (trip.sent_us + trip.received_us)
        error_us = 0.5 * took_us
        if self._offset_us is not None:
            drifted_us = self._error_us + _DRIFT * (trip.received_us - self._measured_us)
            # If the offset changes by more than both errors, the autopilot's clock has jumped.
            jumped = abs(offset_us - self._offset_us) > drifted_us + error_us
            if error_us > drifted_us and not jumped:
                return
        self._offset_us, self._error_us, self._measured_us = offset_us, error_us, trip.received_us

    def add_sample(self, t_us: int, received_us: int) -> None:
        """Process an IMU sample."""
        if not self._last:
            return
        if self._offset_us is None:
            self.age_us = 0.5 * min(self._last)
        else:
            self.age_us = received_us + self._offset_us - t_us
        step_us = min(max(received_us - self._received_us, 0), _STEP_MAX_US)
        self._received_us = received_us
        kept = decay_factor(step_us, _SHARE_US)
        if self.age_us > self._limit_us:
            self._oldest_us = max(self.age_us, self._oldest_us if self._share > _FORGOTTEN else 0.0)
        self._share = kept * self._share + (1.0 - kept if self.age_us > self._limit_us else 0.0)
        self.late = self._share > _SHARE

    def describe(self, has_paused: bool = False) -> str:
        """Describe the delay; `has_paused` means that a pause of this program may have caused the delay."""
        shortest_us = min(self._last, default=0)
        slow_link = shortest_us > self._limit_us
        also = f", round trip {shortest_us * 1e-3:.0f} ms" if slow_link else ""
        what = "this program reads telemetry" if has_paused and not slow_link else "telemetry arrives"
        oldest_ms, limit_ms = self._oldest_us * 1e-3, self._limit_us * 1e-3
        return f"{what} {oldest_ms:.0f} ms after sampling, limit {limit_ms:.0f} ms{also}"


class StreamWatch:
    """Telemetry streams of one flight.

    Attributes:
        rates_hz: rates of the streams over the last second, measured by the stamps.
        stale: number of consecutive samples whose stamps lie far in the past, by stream.
        delay: age of the samples at their receipt.
        host_us: receipt of the newest stamped sample.
    """

    def __init__(self, guard: GuardThresholds) -> None:
        self.guard = guard
        self.state = FlightState()  # replaced by the core's state at the first step
        self.rates_hz: dict[str, float] = {}
        self.stale: dict[str, int] = {}
        self.delay = TelemetryDelay(guard.telemetry_late_s)
        self.host_us = 0
        self._since_imu = 0  # samples of other streams since the newest IMU sample
        self._counts: dict[str, tuple[int, int]] = {}  # first stamp, and number of samples since
        self._gap_us: int | None = None

    def add_sample(self, name: str, item: Stamped, newest: Stamped | None) -> None:
        """Process a sample of a stream; `newest` is the last sample that the flight state has accepted."""
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
        if leaps(-lag_us):  # not accepted by the state: another vehicle sent it, or the clock jumped
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
        """Whether telemetry has returned after a gap in the last few seconds."""
        return self._gap_us is not None and self.state.now_us - self._gap_us < _GAP_MEMORY_US

    @property
    def others_continue(self) -> bool:
        """Whether other streams continue while the IMU is silent."""
        return self._since_imu >= _OTHERS_SINCE

    def age_s(self, name: str) -> float:
        """Return the host time since a stream's newest receipt; infinite without a sample."""
        newest = getattr(self.state, name)
        return (self.state.host_us - newest.received_us) * 1e-6 if newest is not None else math.inf


def _silence(
    description: str, streams: tuple[str, ...], limit: str | float, words: str = "", alone: str = ""
) -> RuleCondition:
    """Return the condition that all of the given streams have been silent for longer than a limit.

    Args:
        limit: seconds, or the key of the guard's threshold.
        words: format of the message; the fields `s` and `ms` are replaced by the duration in seconds and
            milliseconds.
        alone: key of a shorter limit for the case that other streams continue, so that neither link nor host
            is the cause.
    """
    message = BY_NAME[streams[0]].message if streams[0] in BY_NAME else ""

    def cause(flight: Any) -> str | None:
        watch: StreamWatch = flight.streams
        age_s = min([watch.age_s(name) for name in streams])
        limit_s = getattr(watch.guard, limit) if isinstance(limit, str) else limit
        if age_s <= limit_s and not (alone and watch.others_continue and age_s > getattr(watch.guard, alone)):
            return None
        age_s = min(age_s, _AGE_MAX_S)
        about = watch.state.text_about(message) if message else ""
        return (words or "no data for {ms:.0f} ms").format(s=age_s, ms=1e3 * age_s) + about

    limits = [f"guard.{key}" if isinstance(key, str) else f"{key:g} s" for key in (alone, limit) if key]
    return RuleCondition(description, ", ".join(limits), cause)


def _slow(flight: Any) -> str | None:
    for name, rate_hz in flight.streams.rates_hz.items():
        if rate_hz < BY_NAME[name].expected_hz:
            return f"{name} arrives at {rate_hz:.0f} Hz, minimum {BY_NAME[name].expected_hz:.0f} Hz"
    return None


def _late(flight: Any) -> str | None:
    return flight.streams.delay.describe(flight.has_paused) if flight.streams.delay.late else None


_LINK: Final = ("status", "imu", "attitude", "odometry")
_AIR, _LAND = Scope.AIR, Override.LAND
_SLOWING: Final = frozenset({"stream_rate"})  # when a stream ends, its rate falls first

# fmt: off
STREAM_RULES: tuple[Rule, ...] = tuple(rule._replace(of_streams=True) for rule in (
    Rule("link_lost", Override.RELEASE, _AIR, _silence(
        "no telemetry arrives: PX4's own failsafe must act",
        _LINK, LINK_LOST_S, "no telemetry for {s:.1f} s")),
    Rule("imu_silent", _LAND, _AIR, _silence(
        "IMU stream timed out: impacts cannot be detected",
        ("imu",), "stream_timeout_s", alone="imu_timeout_s"), explains=_SLOWING),
    Rule("attitude_silent", _LAND, _AIR, _silence(
        "attitude stream timed out: force direction unknown", ("attitude",), "stream_timeout_s"),
        explains=_SLOWING),
    Rule("odometry_silent", _LAND, _AIR, _silence(
        "position stream timed out", ("odometry",), "stream_timeout_s"), explains=_SLOWING),
    Rule("actuator_silent", Override.HOLD, Scope.FLYING, _silence(
        "actuator stream timed out: thrust and contact force cannot be separated",
        ("actuator",), ACTUATOR_TIMEOUT_S)),
    Rule("status_silent", _LAND, _AIR, _silence(
        "heartbeat timed out", ("status",), STATUS_TIMEOUT_S, "no heartbeat for {s:.1f} s")),
    Rule("stream_rate", Override.HOLD, Scope.FLYING, RuleCondition(
        "the rate of a stream is below the minimum rate in `base/streams.py`",
        "streams: expected_hz", _slow)),
    Rule("telemetry_late_ground", Override.GIVE_UP, Scope.GROUND, RuleCondition(
        "telemetry arrives too late to react in time", "guard.telemetry_late_s", _late)),
    Rule("telemetry_late", _LAND, _AIR, RuleCondition(
        "telemetry has arrived too late for several samples", "guard.telemetry_late_s", _late),
        explains=frozenset({"imu_silent", "attitude_silent", "odometry_silent", "actuator_silent",
                            "status_silent", "stream_rate"})),
))
# fmt: on
