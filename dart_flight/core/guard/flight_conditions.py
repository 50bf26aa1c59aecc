"""What the guard's rules look at: the flight state, and the little that has to be remembered between samples.

`observe` is called once per step, before the rules. Memories are kept in the autopilot's stamps where a
stream has them, so that a simulator at several times real time is judged as real time is; silence alone is
judged by host time.
"""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import norm
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    EstimatorSample,
    FlightMode,
    ForceEstimate,
    ImpactOnset,
    ImuSample,
    Input,
    OdometrySample,
    OperatorRequest,
    OtherVehicle,
    Phase,
    RoundTrip,
    StatusSample,
    StatusText,
    SystemStatus,
)
from dart_flight.config.mission import Mission
from dart_flight.core.guard.estimator_resets import REACH_US, EstimatorResets
from dart_flight.core.guard.failsafe import FailsafeEvidence, in_failsafe
from dart_flight.core.guard.second_vehicle import SecondClockDetector, SecondPositionDetector
from dart_flight.core.guard.telemetry_delay import TelemetryDelay
from dart_flight.core.mission.phases import ON_GROUND
from dart_flight.core.mission.position_loop import STOP_TIME_S, stop_share
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState

_GAP_MEMORY_US: Final = 3_000_000  # a gap this long ago explains a change of mode
_UNSURE_US: Final = 250_000  # in which a second vehicle shows for certain
_DOUBT_US: Final = 100_000  # host time; another vehicle's samples come within this of its mode
_GAP_US: Final = 500_000  # of silence, in which PX4 may have said anything
_RATE_WINDOW_US: Final = 1_000_000
_LEAP_US: Final = 1_000_000
_CLIP_SHARE: Final = 0.99
_FALLING_M_S2: Final = 4.9  # half of what carries the vehicle
_SURELY_DOWN: Final = 3.0  # times the way down from the top of the flight space
_PAUSE_US: Final = 40_000  # host time goes on by 20 ms at most, by ticks: after more this program did not run
_PAUSE_MEMORY_US: Final = 3_000_000
# PX4 may align its heading in the climb if it had none on the ground.
_ALIGNING: Final = frozenset((*ON_GROUND, Phase.CLIMB))
Stamped = ImuSample | AttitudeSample | OdometrySample | ActuatorSample


class _StampHistory:
    """What is remembered of one stream's stamps: its clocks, and the samples since a stamp."""

    def __init__(self, name: str, tolerance_us: float) -> None:
        self.name, self.clocks = name, SecondClockDetector(tolerance_us)
        self.first_us: int | None = None
        self.count = 0


class FlightConditions:
    """One flight as the rules see it."""

    def __init__(self, mission: Mission) -> None:
        self.mission = mission
        self.config = mission.vehicle.guard
        self.phase = Phase.READYING
        self.state = FlightState()  # replaced by the core's at the first step
        self.force: ForceEstimate | None = None  # of this step
        self.request: OperatorRequest | None = None  # of this step
        self.thrust_ratio: float | None = None  # over the last seconds of free flight
        self.land_asked = False
        self.was_offboard = False
        self.was_armed = False
        self.was_inside = False  # has been above the floor of the flight space
        self.impact: ImpactOnset | None = None  # the newest
        self.rates_hz: dict[str, float] = {}
        self.stale: dict[str, int] = {}  # samples in a row whose stamp lies far in the past, where there are
        self.since_imu = 0  # samples of other streams since the newest of the IMU
        self.stuck_since_us: int | None = None
        self.clipped_since_us: int | None = None
        self.battery_low_since_us: int | None = None
        self.falling_since_us: int | None = None  # motors stopped, and next to nothing carries the vehicle
        self.flags_bad_since_us: int | None = None
        # In land mode and armed: autopilot's and host's time.
        self._landing_since_us: tuple[int, int] | None = None
        self.jump: str = ""
        self._resets = EstimatorResets()
        self._reset_phase = Phase.READYING  # at the newest reset
        self._tolerance_us = self.config.stamp_tolerance_s * 1e6
        self._imu_stream = _StampHistory("imu", self._tolerance_us)
        self._attitude_stream = _StampHistory("attitude", self._tolerance_us)
        self._odometry_stream = _StampHistory("odometry", self._tolerance_us)
        self._actuator_stream = _StampHistory("actuator", self._tolerance_us)
        self._clocks = (
            self._imu_stream.clocks,
            self._attitude_stream.clocks,
            self._odometry_stream.clocks,
            self._actuator_stream.clocks,
        )
        self._places = SecondPositionDetector(self.config.position_jump_m)
        self.lateness = TelemetryDelay(self.config.telemetry_late_s)
        self._other_system: int | None = None
        self.second_vehicle: str | None = None  # how a second vehicle on the link shows; it does not go away
        self._left_since_us: int | None = None  # host time since when the mode says that offboard was left
        self._failsafe = FailsafeEvidence()
        self._gap_us: int | None = None
        self._host_us = 0  # of the newest stamped sample
        self._seen_us = 0  # host time at the step before
        self._pause_us = self._paused_us = 0  # longest pause of this program lately, and its end
        self.surely_down_s = self._surely_down_s()
        self._full_scale = _CLIP_SHARE * mission.vehicle.imu.full_scale_m_s2
        self._imu: ImuSample | None = None
        self._estimator_bad = False

    def observe(self, item: Input, state: FlightState, sensed: Sensed, phase: Phase) -> None:
        """Take the step's input, which has gone into `state`, and what it has taught."""
        self.state, self.phase, self.force = state, phase, sensed.estimate
        self.request = item if isinstance(item, OperatorRequest) else None
        self.thrust_ratio = sensed.thrust_ratio or self.thrust_ratio
        for event in sensed.impacts:
            if isinstance(event, ImpactOnset):
                # For a while the contact explains what estimator and altitude do.
                self.impact = event
        self.jump = ""
        host_us = state.host_us
        if host_us - self._seen_us > _PAUSE_US and self._seen_us:
            self._see_pause(host_us)
        self._seen_us = host_us
        if isinstance(item, ImuSample):
            self._see_stamp(self._imu_stream, item, state.imu)
            self._see_imu(item)
            self.lateness.take_sample(item.t_us, item.received_us)
        elif isinstance(item, AttitudeSample):
            self._see_stamp(self._attitude_stream, item, state.attitude)
            if item is state.attitude:
                self._resets.take_attitude(item)
        elif isinstance(item, OdometrySample):
            if state.is_plausible(item):  # else no difference to it means anything
                self._see_stamp(self._odometry_stream, item, state.odometry)
                self._see_odometry(item)
                self.was_inside = self.was_inside or state.position[2] >= self.mission.bounds.z[0]
            else:
                away_m, fast_m_s = norm(item.position_ned), norm(item.velocity_ned)
                self.jump = f"implausible: {away_m:.3g} m from the origin at {fast_m_s:.3g} m/s"
        elif isinstance(item, ActuatorSample):
            self._see_stamp(self._actuator_stream, item, state.actuator)
            self._see_motors(item)
        elif isinstance(item, EstimatorSample):
            self._see_estimator(item)
        elif isinstance(item, StatusSample):
            self._see_status(item)
        elif isinstance(item, RoundTrip):
            self.lateness.take_round_trip(item)
        elif isinstance(item, OtherVehicle):
            self._other_system = item.system
        elif isinstance(item, StatusText) and not item.found_here:
            self._failsafe.take_text(item, state.now_us)
        self._see_flags()

    # -- what rules ask --

    @property
    def other_system(self) -> str | None:
        """Another vehicle on the link, in words: one that is told apart, or one that is not."""
        if self._other_system is not None:
            return f"system {self._other_system} sends on the same link"
        return self.second_vehicle

    @property
    def circumstances(self) -> str:
        """What else is known where a stream fails, to be appended; empty where nothing is."""
        known = ""
        if self._other_system is not None:
            known += f"; system {self._other_system} sends on the same link"
        if self._pause_us and self.state.host_us - self._paused_us < _PAUSE_MEMORY_US:
            known += (
                f"; the computer is too busy: this program did not run for {self._pause_us * 1e-3:.0f} ms"
            )
        return known

    @property
    def just_after_impact(self) -> bool:
        """Shortly after an impact: what the contact does to estimator and altitude is no fault."""
        return self._since_impact_us() < self.config.impact_window_s * 1e6

    @property
    def failsafe_said(self) -> bool:
        """Whether PX4 reports a failsafe, or has mentioned one within the last seconds."""
        return in_failsafe(self.state.status.system_status) or self._failsafe.is_mentioned(self.state.now_us)

    @property
    def failsafe_announced(self) -> str | None:
        """PX4's announcement that its failsafe takes over, or None if there is none."""
        if in_failsafe(self.state.status.system_status) and not self.status_unreliable:
            return self.failsafe_words
        return self._failsafe.announcement(self.state.now_us)

    @property
    def failsafe_hands_to_sticks(self) -> bool:
        """Whether the announced failsafe ends in a mode flown by stick."""
        return self._failsafe.hands_to_sticks(self.state.now_us)

    @property
    def failsafe_words(self) -> str:
        """PX4's text about the cause of a failsafe, or a sentence that it gave none."""
        return self._failsafe.words(self.state.now_us) or "PX4 reports a failsafe and gives no cause"

    @property
    def termination(self) -> str | None:
        """PX4's termination of the flight, as text, or None if there is none.

        Status and texts count only in the air: a kill after touchdown ends a landing.
        """
        if not self.was_armed or self.state.on_ground:
            return None
        words = self._failsafe.termination(self.state.now_us)
        if words is not None:
            return f"PX4 has stopped the motors: {words}"
        terminated = self.state.status.system_status is SystemStatus.FLIGHT_TERMINATION
        return "PX4 has stopped the motors" if terminated and not self.status_unreliable else None

    @property
    def was_cut_off(self) -> bool:
        """Whether telemetry has come back within the last seconds after a gap."""
        return self._gap_us is not None and self.state.now_us - self._gap_us < _GAP_MEMORY_US

    @property
    def unrequested_mode(self) -> FlightMode | None:
        """The flight mode, once PX4 has left offboard without being asked to."""
        mode = self._mode_left_to
        # The modes of two vehicles come in turn; sticks are a pilot's, and from then on nothing is sent.
        if (
            mode is not None
            and mode is not FlightMode.MANUAL
            and (self.status_unreliable or self.mode_change_unexplained)
        ):
            return None
        return mode

    @property
    def mode_change_unexplained(self) -> bool:
        """Whether PX4 seems to have left offboard a moment ago, by itself or by a pilot's switch.

        It may be the mode of another vehicle, whose first sample is still to come: until then nothing is
        decided, and nothing is sent. What PX4 has announced, or a gap explains, is in no doubt.
        """
        if self._left_since_us is None or self.failsafe_said or self.was_cut_off:
            return False
        young = self.state.host_us - self._left_since_us < _DOUBT_US
        return young and self._mode_left_to is not None

    @property
    def _mode_left_to(self) -> FlightMode | None:
        mode = self.state.status.flight_mode
        if not self.was_offboard or mode in (FlightMode.OFFBOARD, FlightMode.UNKNOWN):
            return None
        if self.land_asked and (mode is FlightMode.LAND or self.state.on_ground):
            return None
        return mode

    @property
    def status_unreliable(self) -> bool:
        """Whether the slow state may be another vehicle's: there is one, or the last moments look like it."""
        if self.second_vehicle is not None:
            return True
        odd = [clocks.odd_us for clocks in self._clocks]
        return any(
            odd_us is not None and self._host_us - odd_us < _UNSURE_US
            for odd_us in (*odd, self._places.odd_us)
        )

    def age_s(self, newest: Stamped | None) -> float:
        """Host time since a stream's newest sample was received, seconds; infinite where there was none."""
        return (self.state.host_us - newest.received_us) * 1e-6 if newest is not None else math.inf

    @property
    def status_age_s(self) -> float:
        """Host time since the autopilot's slow state was received, seconds."""
        return (self.state.host_us - self.state.status.received_us) * 1e-6

    def lasting_s(self, since_us: int | None) -> float:
        """How long something has been going on, autopilot time, seconds; 0 where it is not."""
        return 0.0 if since_us is None else (self.state.now_us - since_us) * 1e-6

    def stop_excess_m(self) -> float:
        """How far outside of the bounds the vehicle would stop if told so now; a wall stops it earlier."""
        (x, y, _), (vx, vy, _) = self.state.position, self.state.velocity
        bounds = self.mission.bounds
        if bounds.excess2((x + STOP_TIME_S * vx, y + STOP_TIME_S * vy)) <= 0.0:
            return 0.0  # the bounds are convex: then no earlier point lies outside either
        stop_s = STOP_TIME_S * stop_share(self.mission.walls, (x, y), (vx, vy))
        return bounds.excess2((x + stop_s * vx, y + stop_s * vy))

    @property
    def landing_s(self) -> float:
        """How long the vehicle has been in land mode and armed, seconds.

        By the autopilot's time and by the host's: stamps that jump must not stop motors in the air.
        """
        if self._landing_since_us is None:
            return 0.0
        autopilot_us, host_us = self._landing_since_us
        return min(self.state.now_us - autopilot_us, self.state.host_us - host_us) * 1e-6

    def _surely_down_s(self) -> float | None:
        """After this long in land mode a vehicle is down, whatever its estimator says; None: never so."""
        if self.config.kill_after_s is None:
            return None
        way_down_s = self.mission.bounds.z[1] / self.mission.vehicle.px4.mpc_land_speed
        return max(self.config.kill_after_s, _SURELY_DOWN * way_down_s)

    def reset_step(self) -> str | None:
        """Return the step of position or velocity during an estimator reset, as text, or None."""
        reset, c = self._resets.newest, self.config
        if reset is None or self.state.now_us - reset.t_us > REACH_US or self.just_after_impact:
            return None
        if reset.position_m > c.reset_position_m or reset.velocity_m_s > c.reset_velocity_m_s:
            return f"by {reset.position_m:.2f} m and {reset.velocity_m_s:.2f} m/s"
        return None

    @property
    def heading_step_rad(self) -> float:
        """Step of the heading during an estimator reset, radians; 0 while PX4 may align its heading."""
        reset = self._resets.newest
        if reset is None or self.state.now_us - reset.t_us > 2 * REACH_US or self._reset_phase in _ALIGNING:
            return 0.0
        return reset.heading_rad

    def _since_impact_us(self) -> float:
        return math.inf if self.impact is None else self.state.now_us - self.impact.t_us

    def _see_stamp(self, stream: _StampHistory, item: Stamped, newest: Stamped | None) -> None:
        t_us, received_us = item.t_us, item.received_us
        if received_us > self._host_us:
            if self._host_us and received_us - self._host_us > _GAP_US:
                self._gap_us = self.state.now_us
            self._host_us = received_us
        self.since_imu = 0 if stream is self._imu_stream else self.since_imu + 1
        if self.second_vehicle is None:
            self._look_for_second(stream.clocks, item, t_us, received_us)
        lag_us = (newest or item).t_us - t_us
        if lag_us > self._tolerance_us:
            self.stale[stream.name] = self.stale.get(stream.name, 0) + 1
            return
        if -lag_us > _LEAP_US:  # not taken yet: another vehicle's, or a clock that has jumped
            return
        if self.stale:
            self.stale.pop(stream.name, None)
        if stream.first_us is None:
            stream.first_us = t_us
        span_us = t_us - stream.first_us
        if span_us >= _RATE_WINDOW_US:
            self.rates_hz[stream.name] = stream.count * 1e6 / span_us
            stream.first_us, stream.count = t_us, 0
        stream.count += 1

    def _look_for_second(
        self, clocks: SecondClockDetector, item: Stamped, t_us: int, received_us: int
    ) -> None:
        clocks.update(t_us, received_us)
        if clocks.odd_us is not None:
            # One stream alone may come by two ways, one of them late; a vehicle sends them all.
            apart_s = [c.apart_s(received_us) for c in self._clocks]
            found = [seconds for seconds in apart_s if seconds is not None]
            if len(found) > 1 and max(found) - min(found) < self.config.stamp_tolerance_s:
                self.second_vehicle = f"two alternating clocks, {found[0]:.1f} s apart"
        if isinstance(item, OdometrySample):
            self._places.update(item)
            apart_m = self._places.apart_m(received_us)
            if apart_m is not None:
                self.second_vehicle = f"odometry with two alternating positions, {apart_m:.1f} m apart"

    def _see_pause(self, host_us: int) -> None:
        """This program has not run since the step before: no tick has come, either."""
        pause_us = host_us - self._seen_us
        if pause_us > self._pause_us or host_us - self._paused_us > _PAUSE_MEMORY_US:
            self._pause_us, self._paused_us = pause_us, host_us

    def _see_imu(self, item: ImuSample) -> None:
        if item is not self.state.imu:
            return
        self._resets.take_imu(item)
        before, self._imu = self._imu, item
        same = before is not None and before.specific_force_frd == item.specific_force_frd
        self.stuck_since_us = (self.stuck_since_us or item.t_us) if same else None
        (x, y, z), full = item.specific_force_frd, self._full_scale
        clipped = abs(x) >= full or abs(y) >= full or abs(z) >= full
        self.clipped_since_us = (self.clipped_since_us or item.t_us) if clipped else None

    def _see_motors(self, item: ActuatorSample) -> None:
        imu = self._imu
        falls = imu is not None and not any(item.motors) and norm(imu.specific_force_frd) < _FALLING_M_S2
        self.falling_since_us = (self.falling_since_us or item.t_us) if falls else None

    def _see_odometry(self, item: OdometrySample) -> None:
        if item is not self.state.odometry:
            return
        away_m, faster_m_s = self._resets.take_odometry(item)
        if self.just_after_impact:
            return
        if away_m > self.config.position_jump_m:
            self.jump = f"position by {away_m:.2f} m"
        if faster_m_s > self.config.velocity_jump_m_s:
            self.jump = f"velocity by {faster_m_s:.2f} m/s"

    def _see_estimator(self, item: EstimatorSample) -> None:
        if item.reset_counter is not None and self._resets.take_counter(
            item.reset_counter, self.state.now_us
        ):
            self._reset_phase = self.phase
        if item.healthy is not None:
            self._estimator_bad = not item.healthy

    def _see_status(self, item: StatusSample) -> None:
        if item.flight_mode is FlightMode.OFFBOARD:
            self.was_offboard = True
            self._left_since_us = None
        elif self._left_since_us is None and item.flight_mode is not FlightMode.UNKNOWN:
            self._left_since_us = item.received_us
        self.was_armed = self.was_armed or item.armed
        if not (item.armed and item.flight_mode is FlightMode.LAND):
            self._landing_since_us = None
        elif self._landing_since_us is None:
            self._landing_since_us = (self.state.now_us, self.state.host_us)
        low = (
            item.battery_remaining is not None and item.battery_remaining < self.config.battery_remaining
        ) or (item.battery_v is not None and item.battery_v < self.config.battery_v)
        self.battery_low_since_us = (self.battery_low_since_us or self.state.now_us) if low else None

    def _see_flags(self) -> None:
        if (self.state.status.local_position_ok and not self._estimator_bad) or self.just_after_impact:
            self.flags_bad_since_us = None
        elif self.flags_bad_since_us is None and self.state.now_us:  # 0: nothing with a stamp has come yet
            self.flags_bad_since_us = self.state.now_us
