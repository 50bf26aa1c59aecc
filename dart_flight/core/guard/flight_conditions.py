"""The conditions that the guard's rules evaluate: the flight state, and the history that the rules need.

`observe` is called once per step, before the rules. If a stream has the autopilot's stamps, durations use
these stamps. A simulator that runs faster than real time therefore gives the same durations. Only silence is
measured in host time.
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
    PoseSample,
    Request,
    RoundTrip,
    StatusSample,
    StatusText,
    SystemStatus,
)
from dart_flight.config.mission import Mission
from dart_flight.core.guard.estimator_watch import EstimatorWatch
from dart_flight.core.guard.failsafe import FailsafeEvidence, in_failsafe
from dart_flight.core.guard.pose_watch import PoseWatch
from dart_flight.core.guard.second_vehicle import OtherVehicles
from dart_flight.core.guard.stream_watch import Stamped, StreamWatch
from dart_flight.core.mission.position_loop import STOP_TIME_S, stop_share
from dart_flight.core.sense.senses import IMPACT_WINDOW_S, Sensed
from dart_flight.core.sense.state import FlightState

_DOUBT_US: Final = 100_000  # host time within which a vehicle's first sample follows its heartbeat
_CLIP_SHARE: Final = 0.99
# A vehicle that keeps this tilt near the ground lies on its side, which PX4 does not detect.
LYING_TILT_DEG: Final = 60.0
_FALLING_M_S2: Final = 4.9  # a vehicle with a smaller specific force falls; in hover it is twice this limit
_LYING_BELOW_M: Final = 0.5  # largest estimated height of a lying vehicle; a fall disturbs the estimate
# The body rates are not tested: PX4's rate loop shakes a vehicle that lies on its side at up to 2.5 rad/s.
_STILL_M_S: Final = 0.5
_ATTITUDE_OLD_US: Final = 100_000
_SURELY_DOWN: Final = 3.0  # largest ratio of a landing's duration to the descent from the flight space's top
_PAUSE_US: Final = 40_000  # a longer host time between two ticks (period 20 ms) counts as a pause
_PAUSE_MEMORY_US: Final = 3_000_000


class FlightConditions:
    """The conditions of one flight that the rules evaluate."""

    def __init__(self, mission: Mission) -> None:
        self.mission = mission
        self.config = mission.vehicle.guard
        self.phase = Phase.READYING
        self.state = FlightState()  # replaced by the core's state at the first step
        self.force: ForceEstimate | None = None  # this step's estimate
        self.request: OperatorRequest | None = None  # this step's request
        self.thrust_ratio: float | None = None  # newest known value of `Sensed.thrust_ratio`
        self.land_asked = False
        self.kill_asked = False
        self.was_offboard = False
        self.was_armed = False
        self.was_inside = False  # whether the vehicle has been above the floor of the flight space
        self.impact: ImpactOnset | None = None  # the newest impact
        self._impact_window_us = IMPACT_WINDOW_S * 1e6
        self.stuck_since_us: int | None = None
        self.clipped_since_us: int | None = None
        self.battery_low_since_us: int | None = None
        self.falling_since_us: int | None = None  # start of a fall with stopped motors
        self.lying_since_us: int | None = None  # time since which the vehicle lies tilted and still
        self._ground_m: float | None = None  # height before take-off
        # Time at which the vehicle was first armed in land mode: autopilot time and host time.
        self._landing_since_us: tuple[int, int] | None = None
        self.streams = StreamWatch(self.config)
        self.estimator = EstimatorWatch()
        self.others = OtherVehicles()
        mocap = mission.vehicle.mocap
        self.poses = None if mocap.url is None else PoseWatch(mocap)
        self._left_since_us: int | None = None  # host time at which PX4 left offboard mode
        self._failsafe = FailsafeEvidence()
        self._stepped_us = 0  # host time at the previous step
        self._pause_us = self._paused_us = 0  # longest recent pause of this program, and when it ended
        self.landing_timeout_s = self._landing_timeout_s()
        self._full_scale = _CLIP_SHARE * mission.vehicle.imu.full_scale_m_s2
        self._imu: ImuSample | None = None

    def observe(self, item: Input, state: FlightState, sensed: Sensed, phase: Phase) -> None:
        """Process an input and the results of its step; `state` already includes the input."""
        # Compare types: `isinstance` takes eight times as long for a record of another kind.
        self.phase, self.force = phase, sensed.estimate
        if state is not self.state:
            self.state = self.streams.state = state
        self.request = item if type(item) is OperatorRequest else None
        self.thrust_ratio = sensed.thrust_ratio or self.thrust_ratio
        for event in sensed.impacts:
            if type(event) is ImpactOnset:
                # A contact disturbs the estimator and the altitude for a while.
                self.impact = event
        self.estimator.begin(state.now_us, self.just_after_impact)
        host_us = state.host_us
        if host_us - self._stepped_us > _PAUSE_US and self._stepped_us:
            self._record_pause(host_us)
        self._stepped_us = host_us
        if self.poses is not None:
            self.poses.tick(host_us)
        if type(item) is ImuSample:
            self._handle_stamp("imu", item, state.imu)
            if item is state.imu:
                self.estimator.resets.add_imu(item)
                self._handle_imu(item)
            self.streams.delay.add_sample(item.t_us, item.received_us)
        elif type(item) is AttitudeSample:
            self._handle_stamp("attitude", item, state.attitude)
            if item is state.attitude:
                self.estimator.resets.add_attitude(item)
        elif type(item) is OdometrySample:
            self._handle_odometry(item)
        elif type(item) is ActuatorSample:
            self._handle_stamp("actuator", item, state.actuator)
            self._handle_motors(item)
        elif type(item) is EstimatorSample:
            self.estimator.add_report(item, phase)
        elif type(item) is StatusSample:
            self._handle_status(item)
        elif type(item) is RoundTrip:
            self.streams.delay.add_round_trip(item)
        elif type(item) is OtherVehicle:
            self.others.add_system(item.system)
        elif type(item) is PoseSample and self.poses is not None:
            self.poses.add_pose(item, state, phase)
        elif type(item) is StatusText and not item.found_here:
            self._failsafe.add_text(item, state.now_us)
        self.estimator.finish(state.status.local_position_ok)

    # -- conditions for the rules --

    def is_asked(self, request: Request) -> bool:
        return self.request is not None and self.request.request is request

    @property
    def circumstances(self) -> str:
        """Text that lists possible causes of a stream's failure: another vehicle, a pause; or empty."""
        other = self.others.other_system
        known = f"; {other}" if other is not None else ""
        if self.has_paused:
            known += (
                f"; the computer is too busy: this program did not run for {self._pause_us * 1e-3:.0f} ms"
            )
        return known

    @property
    def has_paused(self) -> bool:
        return bool(self._pause_us) and self.state.host_us - self._paused_us < _PAUSE_MEMORY_US

    @property
    def just_after_impact(self) -> bool:
        """Whether an impact was recent; its effects on estimator and altitude are then not faults."""
        impact = self.impact
        return impact is not None and self.state.now_us - impact.t_us < self._impact_window_us

    @property
    def failsafe_reported(self) -> bool:
        """Whether PX4 reports a failsafe, or has mentioned one in the last few seconds."""
        return in_failsafe(self.state.status.system_status) or self._failsafe.is_mentioned(self.state.now_us)

    @property
    def failsafe_announced(self) -> str | None:
        if in_failsafe(self.state.status.system_status) and not self.status_unreliable:
            return self.failsafe_words
        return self._failsafe.announcement(self.state.now_us)

    @property
    def failsafe_hands_to_sticks(self) -> bool:
        return self._failsafe.hands_to_sticks(self.state.now_us)

    @property
    def failsafe_words(self) -> str:
        """PX4's text about the cause of a failsafe, or a text which says that PX4 gives no cause."""
        return self._failsafe.words(self.state.now_us) or "PX4 reports a failsafe and gives no cause"

    @property
    def termination(self) -> str | None:
        """Message that PX4 has terminated the flight, or None.

        On the ground the result is always None, because a landing ends with a kill.
        """
        if not self.was_armed or self.state.on_ground:
            return None
        words = self._failsafe.termination(self.state.now_us)
        if words is not None:
            return f"PX4 has stopped the motors: {words}"
        terminated = self.state.status.system_status is SystemStatus.FLIGHT_TERMINATION
        return "PX4 has stopped the motors" if terminated and not self.status_unreliable else None

    @property
    def unrequested_mode(self) -> FlightMode | None:
        """The current flight mode if PX4 has certainly left offboard without a request; otherwise None."""
        mode = self._mode_left_to
        # Another vehicle may have sent the mode. In manual mode this is harmless: the guard sends nothing.
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

        Another vehicle, not yet detected, may have sent the reported mode. During this time the guard makes
        no decision and sends nothing. If PX4 has announced the mode change, or telemetry has just returned
        after a gap, the mode change counts as certain.
        """
        if self._left_since_us is None or self.failsafe_reported or self.streams.was_cut_off:
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
        """Whether another vehicle is detected or suspected; the status may then be that vehicle's."""
        return self.others.is_suspected(self.streams.host_us)

    def duration_s(self, since_us: int | None) -> float:
        """Return the duration of a condition in autopilot time, or 0 if the condition does not hold."""
        return 0.0 if since_us is None else (self.state.now_us - since_us) * 1e-6

    def stop_excess_m(self) -> float:
        """Return how far outside the bounds the vehicle would come to rest if it braked now, metres."""
        (x, y, _), (vx, vy, _) = self.state.position, self.state.velocity
        bounds = self.mission.bounds
        if bounds.excess2((x + STOP_TIME_S * vx, y + STOP_TIME_S * vy)) <= 0.0:
            return 0.0  # the bounds are convex, so no earlier point lies outside
        stop_s = STOP_TIME_S * stop_share(self.mission.walls, (x, y), (vx, vy))
        return bounds.excess2((x + stop_s * vx, y + stop_s * vy))

    @property
    def landing_s(self) -> float:
        """Time in land mode while armed: the smaller of autopilot time and host time.

        If only autopilot time counted, a jump of the stamps could make the guard stop the motors in the air.
        """
        if self._landing_since_us is None:
            return 0.0
        autopilot_us, host_us = self._landing_since_us
        return min(self.state.now_us - autopilot_us, self.state.host_us - host_us) * 1e-6

    def _landing_timeout_s(self) -> float | None:
        """Return the longest allowed time in land mode, or None if there is no limit."""
        if self.config.kill_after_s is None:
            return None
        way_down_s = self.mission.bounds.z[1] / self.mission.vehicle.px4.mpc_land_speed
        return max(self.config.kill_after_s, _SURELY_DOWN * way_down_s)

    def _handle_stamp(self, name: str, item: Stamped, newest: Stamped | None) -> None:
        self.streams.add_sample(name, item, newest)
        self.others.add_sample(name, item)

    def _record_pause(self, host_us: int) -> None:
        """Record a pause of this program, from the previous step until `host_us`."""
        pause_us = host_us - self._stepped_us
        if pause_us > self._pause_us or host_us - self._paused_us > _PAUSE_MEMORY_US:
            self._pause_us, self._paused_us = pause_us, host_us

    def _handle_imu(self, item: ImuSample) -> None:
        before, self._imu = self._imu, item
        same = before is not None and before.specific_force_frd == item.specific_force_frd
        self.stuck_since_us = (self.stuck_since_us or item.t_us) if same else None
        (x, y, z), full = item.specific_force_frd, self._full_scale
        clipped = abs(x) >= full or abs(y) >= full or abs(z) >= full
        self.clipped_since_us = (self.clipped_since_us or item.t_us) if clipped else None

    def _update_lying(self) -> None:
        state = self.state
        if not self.was_armed:
            self._ground_m = state.position[2]
        ground_m, attitude = self._ground_m, state.attitude
        lies = (
            ground_m is not None
            and attitude is not None
            and state.tilt_rad > math.radians(LYING_TILT_DEG)
            and state.now_us - attitude.t_us < _ATTITUDE_OLD_US
            and state.position[2] - ground_m < _LYING_BELOW_M
            and norm(state.velocity) < _STILL_M_S
            and not self.status_unreliable
        )
        self.lying_since_us = (self.lying_since_us or state.now_us) if lies else None

    def _handle_motors(self, item: ActuatorSample) -> None:
        imu = self._imu
        falls = imu is not None and not any(item.motors) and norm(imu.specific_force_frd) < _FALLING_M_S2
        self.falling_since_us = (self.falling_since_us or item.t_us) if falls else None

    def _handle_odometry(self, item: OdometrySample) -> None:
        state = self.state
        if not state.is_plausible(item):  # an implausible sample must not be compared with the next one
            self.estimator.reject_odometry(item)
            return
        self._handle_stamp("odometry", item, state.odometry)
        if item is state.odometry:
            self.estimator.add_odometry(item)
        self._update_lying()
        self.was_inside = self.was_inside or state.position[2] >= self.mission.bounds.z[0]

    def _handle_status(self, item: StatusSample) -> None:
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
