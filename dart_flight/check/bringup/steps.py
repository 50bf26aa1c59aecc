"""The steps of a bring-up: instruct the operator, wait for the action, measure and evaluate.

Each step detects the operator's action in the telemetry (held still, tilted, pushed, carried). The operator
therefore keeps both hands on the vehicle and does not need the keyboard.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from dart_flight.base.geometry import Quaternion, Vec2, Vec3, rotate_back
from dart_flight.base.records import (
    AttitudeSample,
    ImuSample,
    Input,
    LockPhase,
    LockState,
    Mode,
    OdometrySample,
    PoseSample,
    StatusSample,
)
from dart_flight.check.bringup import judgements
from dart_flight.check.bringup.judgements import StepFinding, StepOutcome, failed
from dart_flight.check.bringup.pose_motion import (
    Array,
    MotionEstimate,
    NotEnoughMotionError,
    estimate_motion,
    heading_offset_deg,
)
from dart_flight.check.telemetry_check import StreamRate, stream_rates
from dart_flight.check.vehicle_check import round_trip_limit_s
from dart_flight.config.link_url import parse_link
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.senses import Senses
from dart_flight.lock.drivers import DRIVERS, ActuatorLink, DriverError
from dart_flight.lock.ground import GroundLock, ground_driver
from dart_flight.lock.persistence import CommandStore, load_last
from dart_flight.vehicle import messages
from dart_flight.vehicle.baud_rate import listen_for_mavlink
from dart_flight.vehicle.ground_link import GroundLink, unusable_streams
from dart_flight.vehicle.vehicle_session import NoAnswerError, VehicleError

_SERVO = "servo"
_OBSERVE_S = 3.0
WAIT_S = 60.0
_CONNECT_S = 10.0
_ATTITUDE_S = 2.0
_STATUS_S = 1.5  # SYS_STATUS arrives at least once per second
_RADIO_S = 2.0
_POLL_S = 0.05
_KEPT = 4000  # maximum number of stored samples per stream
_MOTION_S = 12.0  # duration of the motion by hand
_NEW_MOTION_S = 2.0  # interval between comparisons of the motion

Found = TypeVar("Found")


class Operator(Protocol):
    """The operator at the vehicle."""

    def instruct(self, text: str) -> None:
        """Show an instruction or a finding."""

    def confirm(self, question: str) -> bool:
        """Ask a yes-or-no question; True is yes."""


class NotDoneError(Exception):
    """The operator's action was not detected in time; the text names the action."""


class Telemetry:
    """A store of the samples since the last `clear`, from which `force_at` estimates the force."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self.imu: deque[ImuSample] = deque(maxlen=_KEPT)
        self.attitude: deque[AttitudeSample] = deque(maxlen=_KEPT)
        self.odometry: deque[OdometrySample] = deque(maxlen=_KEPT)
        self.poses: deque[PoseSample] = deque(maxlen=_KEPT)
        self.modes: dict[str, None] = {}
        self._all: deque[Input] = deque(maxlen=4 * _KEPT)

    def store(self, record: Input) -> None:
        """Store a record from MAVSDK's thread or a pose from the motion capture's thread."""
        if isinstance(record, PoseSample):
            self.poses.append(record)
            return
        self._all.append(record)
        if isinstance(record, ImuSample):
            self.imu.append(record)
        elif isinstance(record, AttitudeSample):
            self.attitude.append(record)
        elif isinstance(record, OdometrySample):
            self.odometry.append(record)
        elif isinstance(record, StatusSample):
            self.modes.setdefault(record.flight_mode.value)

    def clear(self) -> None:
        """Discard the samples; keep the newest flight mode."""
        for kept in (self.imu, self.attitude, self.odometry, self.poses):
            kept.clear()
        self.modes = dict.fromkeys(list(self.modes)[-1:])

    def force_at(self, t_us: int) -> Vec2 | None:
        """Return the core's estimate of the external force at a time, FRD x and y, newton, or None."""
        senses, frame = Senses(self._mission.vehicle), self._mission.frame_at((0.0, 0.0, 0.0))
        senses.state.anchor(frame)
        found = None
        for record in list(self._all):
            estimate = senses.update(record, ExpectedContact(False)).estimate
            if estimate is not None and estimate.t_us <= t_us:
                found = estimate
        q = attitude_at(self.attitude, t_us)
        if found is None or q is None:
            return None
        force_frd = rotate_back(q, frame.vector_to_ned(found.force_mission))
        return force_frd[:2]


def attitude_at(samples: Sequence[AttitudeSample], t_us: int) -> Quaternion | None:
    return next((s.q_frd_to_ned for s in reversed(list(samples)) if s.t_us <= t_us), None)


class Bringup:
    """A runner of bring-up steps for one vehicle. The link stays open between steps.

    Args:
        mission: specifies the vehicle and the required streams.
        url: MAVSDK connection URL.
        wait_s: timeout for an action of the operator, seconds.
        opened: called after the link has opened, for example `LinkLease.lock_device`.
    """

    def __init__(
        self,
        mission: Mission,
        url: str,
        operator: Operator,
        wait_s: float = WAIT_S,
        opened: Callable[[], None] = lambda: None,
    ) -> None:
        self._mission, self._url, self._operator, self._wait_s = mission, url, operator, wait_s
        self._opened = opened
        self._telemetry = Telemetry(mission)
        self._link: GroundLink | None = None
        self._rates: list[StreamRate] = []

    def do(self, step: Step) -> StepFinding:
        try:
            return step.run(self)
        except NotDoneError as error:
            return failed(f"not detected within {self._wait_s:g} s: {error}")
        except NoAnswerError as error:
            return failed(f"{error.message}: check the wire to the flight controller (TX)")
        except VehicleError as error:
            return failed(self._explain_silence(str(error)))

    def close(self) -> None:
        if self._link is not None:
            self._link.__exit__(None, None, None)
            self._link = None

    def _connect(self) -> GroundLink:
        """Return the link; the first call opens it and requests the streams."""
        if self._link is None:
            timeout_s, mocap = min(self._wait_s, _CONNECT_S), self._mission.vehicle.mocap
            link = GroundLink(self._url, timeout_s, self._telemetry.store, mocap)
            self._link = link.__enter__()
            self._opened()
            observed = link.observe(self._mission.vehicle, _OBSERVE_S)
            self._rates = stream_rates(observed.rates_hz, unusable_streams(observed.sources))
        return self._link

    def _explain_silence(self, message: str) -> str:
        """Return why no autopilot answers; on a serial port, the received bytes show the reason."""
        link = parse_link(self._url)
        if link is None or link.kind != "serial":
            return message
        try:
            found = listen_for_mavlink(link.place, link.number)
        except OSError as error:
            return f"{message}; {link.place}: {error.strerror}"
        if found.console:
            return (
                f"a console answers on {link.place} ({found.console!r}), but no MAVLink arrives: set "
                "MAV_1_CONFIG to the autopilot's port that has the cable, or disable the login console on "
                f"{link.place}"
            )
        if not found.received:
            return f"no data arrives on {link.place}: check TX and RX, MAV_1_CONFIG and the power"
        if found.baud is None:
            return (
                f"data arrives on {link.place}, but no MAVLink at any usual baud rate: check that no console "
                "uses this port"
            )
        if found.baud != link.number:
            return (
                f"wrong baud rate: MAVLink arrives at {found.baud}, but the link's URL has {link.number}: "
                "correct the URL or SER_TEL2_BAUD"
            )
        return f"{message}, but MAVLink arrives: its sender is not an autopilot, or the TX wire is open"

    def needs_operator(self, step: Step) -> bool:
        """Return whether a step needs an operator; without a lock, the servo's step does not."""
        return step.by_hand and (step.name != _SERVO or self._mission.vehicle.has_lock)

    # -- steps --

    def evaluate_link(self) -> StepFinding:
        link = self._connect()
        round_trip_s = link.round_trip_s()
        status = link.newest(messages.SYS_STATUS, _STATUS_S)
        errors: dict[str, float] = {}
        if status is not None:
            errors |= {"drop_rate_comm": status.drop_rate_comm, "errors_comm": status.errors_comm}
        return judgements.evaluate_link(self._rates, round_trip_s, round_trip_limit_s(self._mission), errors)

    def evaluate_axes(self) -> StepFinding:
        """Check the IMU's axes by readings with the vehicle level, nose down and right side down."""
        self._connect()
        level = self._wait_until_held("Level the vehicle and do not touch it.", lambda force: True)
        wrong = judgements.evaluate_level(level)
        if wrong is not None:
            return wrong
        tilted = partial(judgements.is_tilted, level)
        nose = self._wait_until_held(
            "Lift the vehicle's tail: nose down by about 30 degrees. Hold the vehicle still.", tilted
        )
        self._wait_until_held("Level the vehicle again.", lambda force: not tilted(force))
        right = self._wait_until_held(
            "Lift the vehicle's left side: right side down by about 30 degrees. Hold the vehicle still.",
            tilted,
        )
        return judgements.evaluate_axes(level, nose, right)

    def evaluate_force(self) -> StepFinding:
        """Check the direction of the force that is estimated during a push."""
        self._connect()
        self._telemetry.clear()
        level = self._wait_until_held("Hold the vehicle level and still.", lambda force: True)
        t = self._telemetry
        push = self._wait(
            "Push the vehicle forward sharply, from behind.", lambda: judgements.find_push(list(t.imu), level)
        )
        force = t.force_at(push.t_us)
        if force is None:
            return failed("no force estimate: PX4 sends no attitude or motor outputs; run the step link")
        return judgements.evaluate_push(push.acceleration_m_s2, force)

    def evaluate_servo(self) -> StepFinding:
        """Move the lock to both ends and evaluate the moves."""
        config = self._mission.vehicle.lock
        if config is None:
            return StepFinding(StepOutcome.SKIPPED, "this vehicle has no lock")
        kind = config.driver
        if not DRIVERS[kind].moves:
            return failed(f"lock.driver is {kind.value}: no real servo moves; choose another driver")
        link = ActuatorLink(self._connect().set_actuator, self._url) if kind is LockDriver.PX4 else None
        if not self._operator.confirm(
            "The servo is about to move. Are the propellers off and your fingers clear?"
        ):
            return StepFinding(
                StepOutcome.NEEDS_OPERATOR, "the operator did not confirm: the servo was not moved"
            )
        try:
            with ground_driver(config, load_last(), link) as driver:
                driver.open()
                lock = GroundLock(config, driver, CommandStore(kind).store)
                lock.read_state()
                moves = [self._move(lock, mode) for mode in (Mode.FLEXIBLE, Mode.RIGID, Mode.FLEXIBLE)]
        except DriverError as error:
            return failed(f"{error}")
        return judgements.evaluate_servo(config, moves[1:])  # skip the first move, whose start is unknown

    def _move(self, lock: GroundLock, mode: Mode) -> tuple[Mode, LockState, bool | None]:
        state = lock.move(mode)
        if state.phase is not LockPhase.SETTLED or state.feedback:
            return mode, state, None
        how = "locked, with the rods in their slots" if mode is Mode.RIGID else "free"
        return mode, state, self._operator.confirm(f"Commanded {mode}. Are the arms {how}?")

    def evaluate_position(self) -> StepFinding:
        """Check the motion capture's poses, if any, and the estimated position of a carried vehicle."""
        link = self._connect()
        poses = None
        if self._mission.vehicle.mocap.url is not None:
            poses = self._measure_poses(link)
            if poses.result is not StepOutcome.PASS:
                return poses
        forward = self._wait_until_carried(
            "Hold the vehicle level, carry it 0.5 m forward along its nose, and stand still."
        )
        right = self._wait_until_carried(
            "Carry the vehicle 0.5 m to its right side without turning it, and stand still."
        )
        position = judgements.evaluate_position(forward, right)
        if poses is None:
            return position
        measured = {**poses.measured, **position.measured}
        return StepFinding(position.result, f"{poses.message}; {position.message}", measured)

    def _measure_poses(self, link: GroundLink) -> StepFinding:
        """Compare the poses with gyro and accelerometer while the operator moves the vehicle."""
        t, config = self._telemetry, self._mission.vehicle.mocap
        t.clear()
        reported = False

        def find_tracked() -> bool | None:
            nonlocal reported
            if not reported and (problem := link.pose_problem) is not None:
                reported = True
                self._operator.instruct(f"No poses yet: {problem}.")
            return any(p.tracked for p in t.poses) or None

        with contextlib.suppress(NotDoneError):
            self._wait(f"Waiting for poses from {config.url}.", find_tracked)
        if not any(p.tracked for p in list(t.poses)):
            return failed(f"no poses from {config.url}: {link.pose_problem or 'the body is not tracked'}")
        t.clear()
        tried_s = 0.0

        def find() -> MotionEstimate | None:
            nonlocal tried_s
            moved_s = 1e-6 * (t.imu[-1].t_us - t.imu[0].t_us) if t.imu else 0.0
            now_s = time.monotonic()
            if moved_s < _MOTION_S or now_s - tried_s < _NEW_MOTION_S:
                return None
            tried_s = now_s
            with contextlib.suppress(NotEnoughMotionError):
                found = self._estimate_motion()
                return found if judgements.is_moved_enough(found) else None
            return None

        motion = self._wait(
            "For 12 s: quickly turn the vehicle left and right by 90 degrees, tilt its nose and its side, "
            "and carry it forward and back by 0.5 m.",
            find,
        )
        return judgements.evaluate_motion(motion, config, link.round_trip_s(), self._heading_offset(motion))

    def _tracked_poses(self) -> tuple[Array, Array, Array]:
        """Return times of receipt (s), positions (m) and attitudes of the tracked poses, local NED."""
        room = self._mission.vehicle.mocap.room_frame()
        poses = [p for p in list(self._telemetry.poses) if p.tracked]
        shown = [room.pose_to_ned(p.position_room, p.q_body_to_room) for p in poses]
        times_s = np.array([1e-6 * p.t_us for p in poses])
        return times_s, np.array([p for p, _ in shown]), np.array([q for _, q in shown])

    def _estimate_motion(self) -> MotionEstimate:
        imu = list(self._telemetry.imu)
        return estimate_motion(
            *self._tracked_poses(),
            np.array([1e-6 * s.t_us for s in imu]),
            np.array([s.rate_frd for s in imu]),
            np.array([s.specific_force_frd for s in imu]),
        )

    def _heading_offset(self, motion: MotionEstimate) -> float | None:
        times_s, _, shown = self._tracked_poses()
        own = list(self._telemetry.attitude)
        own_s = np.array([1e-6 * s.t_us for s in own])
        return heading_offset_deg(
            times_s - motion.latency_s, shown, own_s, np.array([s.q_frd_to_ned for s in own])
        )

    def evaluate_remote(self) -> StepFinding:
        link, t = self._connect(), self._telemetry
        t.clear()
        received = link.newest(messages.RC_CHANNELS, _RADIO_S) is not None
        if received:
            with contextlib.suppress(NotDoneError):
                self._wait("Flip the mode switch to another mode and back.", lambda: len(t.modes) > 1 or None)
        return judgements.evaluate_remote(received, list(t.modes))

    # -- waiting --

    def _wait_until_held(self, text: str, is_so: Callable[[Vec3], bool]) -> Vec3:
        """Return the mean specific force, m/s2, once the vehicle is held still as instructed."""
        t = self._telemetry
        t.imu.clear()

        def find() -> Vec3 | None:
            mean = judgements.mean_while_still(list(t.imu))
            return mean if mean is not None and is_so(mean) else None

        return self._wait(text, find)

    def _wait_until_carried(self, text: str) -> Vec2:
        t = self._telemetry
        t.odometry.clear()
        end_s = time.monotonic() + _ATTITUDE_S
        while not t.attitude and time.monotonic() < end_s:
            time.sleep(_POLL_S)
        if not t.attitude:
            raise NotDoneError("the attitude")
        q = t.attitude[-1].q_frd_to_ned

        def find() -> Vec2 | None:
            if not t.odometry:
                return None
            return judgements.measure_displacement(list(t.odometry), q)

        return self._wait(text, find)

    def _wait(self, text: str, find: Callable[[], Found | None]) -> Found:
        """Show an instruction and poll `find` until it returns a result.

        Raises:
            NotDoneError: `find` returned no result in time.
        """
        self._operator.instruct(text)
        end_s = time.monotonic() + self._wait_s
        while (found := find()) is None:
            if time.monotonic() > end_s:
                raise NotDoneError(text)
            time.sleep(_POLL_S)
        return found


class Step(NamedTuple):
    """A step; `by_hand` states whether the step needs an operator at the vehicle."""

    name: str
    subject: str
    run: Callable[[Bringup], StepFinding]
    by_hand: bool = True


STEPS: tuple[Step, ...] = (
    Step("link", "the rates, errors and round trip of the link", Bringup.evaluate_link, by_hand=False),
    Step("imu_axes", "the IMU's axes match the vehicle's", Bringup.evaluate_axes),
    Step("force_sign", "the estimated force of a push has the right direction", Bringup.evaluate_force),
    Step(
        _SERVO,
        "the lock's servo moves in the right direction; this step also measures its travel time",
        Bringup.evaluate_servo,
    ),
    Step("position", "the estimated position follows the carried vehicle", Bringup.evaluate_position),
    Step(
        "remote_control",
        "PX4 receives the remote control, and its switch changes the mode",
        Bringup.evaluate_remote,
    ),
)
