"""Translation of the flight's records to standard schemas, for the live view and for the export of a log.

The frames are `mission` (x along the mission's heading, y left, z up) and its child `vehicle` (forward, left,
up). In `lab.scene`, only this module converts vectors from PX4's NED and FRD. The conversion uses
`MissionFrame`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from foxglove.messages import (
    FrameTransform,
    FrameTransforms,
    Log,
    LogLevel,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    Vector3,
)

from dart_flight.base.geometry import (
    IDENTITY,
    MissionFrame,
    Vec3,
    attitude_in,
    norm,
    subtract,
    tilt_of,
)
from dart_flight.base.geometry import Quaternion as Rotation
from dart_flight.base.records import (
    AttitudeSample,
    ForceEstimate,
    ImpactPeak,
    LockPhase,
    LockState,
    Mode,
    OdometrySample,
    PhaseChange,
    Record,
    Setpoint,
    StatusSample,
    TruthContact,
    TruthSample,
)
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import Servo
from dart_flight.lab.map_model import room_map
from dart_flight.lab.scene import drawing, outlines
from dart_flight.lab.scene.downsampling import SCENE_US
from dart_flight.lab.scene.scalars import ForceState, TrueForce, VehicleState
from dart_flight.lock.servo import ServoModel
from dart_flight.planning.predicted_flight import predict_mission
from dart_flight.recording.anchor import MissionFrameReader
from dart_flight.recording.events import Event, EventFormatter, Level

TRANSFORMS, LOG = "/tf", "/log"
ROOM, PLAN, VEHICLE, PATH = "/scene/room", "/scene/plan", "/scene/vehicle", "/scene/path"
FORCES, SET_POINT, HITS = "/scene/forces", "/scene/setpoint", "/scene/hits"
OUTLINES = ("/points/room", "/points/vehicle", "/points/path")
SCENES = (ROOM, PLAN, VEHICLE, PATH, FORCES, SET_POINT, HITS)
# Each message on these channels is complete, so a viewer that connects late needs only the newest one.
LASTING = frozenset((*SCENES, *OUTLINES, TRANSFORMS))

_MIN_ARROW_N = 3.0  # minimum force that is drawn, above the estimate's noise
_PATH_STEP_M = 0.03
_PATH_US = 250_000
_MAX_PATH = 500  # maximum number of points; beyond it, every second point is dropped and the step is doubled
_LEVELS = {
    Level.DEBUG: LogLevel.Debug,
    Level.INFO: LogLevel.Info,
    Level.WARNING: LogLevel.Warning,
    Level.ERROR: LogLevel.Error,
    Level.FATAL: LogLevel.Fatal,
}


class Message(NamedTuple):
    """A message for a channel, with the autopilot's time.

    `content` is a message of foxglove.messages or a record of `scalars`.
    """

    topic: str
    t_us: int
    content: Any


class FlownTrajectory:
    """The path flown so far, as points at least `_step_m` apart.

    If there are too many points, every second point is dropped, and `_step_m` is doubled.
    """

    def __init__(self) -> None:
        self.points: list[Vec3] = []
        self._step_m = _PATH_STEP_M

    def add(self, point: Vec3) -> None:
        if self.points and norm(subtract(point, self.points[-1])) < self._step_m:
            return
        self.points.append(point)
        if len(self.points) > _MAX_PATH:
            self.points = self.points[::2]
            self._step_m *= 2.0


class SceneTranslator:
    """A translator that receives the records of a flight in order and returns messages for them.

    Args:
        frame: the mission frame in local NED, if known beforehand. If not, the frame comes from the flight's
            anchor record. Until that record, each reported position counts as the take-off point.
        show_room: whether to show the mission's room and plan.
        from_truth: whether to show the true motion of the vehicle. Set this if another program flies the
            vehicle that this software simulates.
    """

    def __init__(
        self,
        mission: Mission,
        frame: MissionFrame | None = None,
        show_room: bool = True,
        from_truth: bool = False,
    ) -> None:
        self._mission, self._given, self._show_room = mission, frame, show_room
        self._from_truth = from_truth
        self._anchor, self._events = MissionFrameReader(mission), EventFormatter()
        self._provisional: MissionFrame | None = None
        lock = mission.vehicle.lock
        self._servo = None if lock is None else lock.servo
        self._horn = None if self._servo is None else ServoModel(self._servo, self._servo.flexible_pulse_us)
        self._q: Rotation | None = None
        self._position: Vec3 | None = None
        self._status: StatusSample | None = None
        self._phase, self._arms = "", "unknown" if mission.vehicle.has_lock else Mode.RIGID.value
        self._estimated_n: Vec3 = (0.0, 0.0, 0.0)
        self._true_n: Vec3 = (0.0, 0.0, 0.0)
        self._drawn_forces = False
        self._true_us = -SCENE_US
        self._path, self._path_us = FlownTrajectory(), -_PATH_US
        self._hits: list[tuple[Vec3, str]] = []
        self._begun = False
        self._handlers: dict[type[Record], Callable[[Any], list[Message]]] = {
            OdometrySample: self._on_odometry,
            AttitudeSample: self._on_attitude,
            ForceEstimate: self._on_force,
            TruthSample: self._on_truth,
            TruthContact: self._on_truth_contact,
            Setpoint: self._on_setpoint,
            LockState: self._on_lock,
            StatusSample: self._on_status,
            PhaseChange: self._on_phase,
            ImpactPeak: self._on_peak,
        }

    def translate(self, record: Record) -> list[Message]:
        t_us = getattr(record, "t_us", 0)
        messages = [] if self._begun else self._begin(t_us)
        self._anchor.add(record)
        handler = self._handlers.get(type(record))
        if handler is not None:
            messages += handler(record)
        event = self._events.format_event(record)
        if event is not None:
            messages.append(_log(t_us, event))
        return messages

    @property
    def _frame(self) -> MissionFrame | None:
        return self._given or self._anchor.frame or self._provisional

    def _begin(self, t_us: int) -> list[Message]:
        """Return the first messages: the vehicle at its start and, if `show_room` is set, room and plan."""
        self._begun = True
        # Viewers need a transform before anything else, so begin level at the start.
        (x, y) = self._mission.start if self._show_room else (0.0, 0.0)
        messages = [_transform(t_us, (x, y, 0.0), IDENTITY), *self._vehicle(t_us)]
        if self._show_room:
            shown = room_map(self._mission)
            messages.append(_scene(ROOM, t_us, *drawing.room(shown, t_us)))
            plan = drawing.planned(predict_mission(self._mission), self._mission, t_us)
            messages.append(_scene(PLAN, t_us, plan))
            points = outlines.cloud(t_us, drawing.MISSION, outlines.room(shown))
            messages.append(Message(OUTLINES[0], t_us, points))
        return messages

    def _on_attitude(self, sample: AttitudeSample) -> list[Message]:
        self._q = sample.q_frd_to_ned
        return []

    def _on_odometry(self, sample: OdometrySample) -> list[Message]:
        if self._given is None and self._anchor.frame is None:
            self._provisional = self._mission.frame_at(sample.position_ned)
        frame = self._frame
        if self._q is None or frame is None:
            return []
        position = frame.point_from_ned(sample.position_ned)
        return self._moved(sample.t_us, position, frame.vector_from_ned(sample.velocity_ned), self._q, frame)

    def _moved(
        self, t_us: int, position: Vec3, velocity: Vec3, q_frd_to_ned: Rotation, frame: MissionFrame
    ) -> list[Message]:
        self._position = position
        self._path.add(position)
        messages = [
            _transform(t_us, position, attitude_in(frame, q_frd_to_ned)),
            self._state(t_us, position, velocity, q_frd_to_ned),
            *self._forces(t_us, position),
        ]
        if not 0 <= t_us - self._path_us < _PATH_US:
            self._path_us = t_us
            path = drawing.line([*self._path.points, position], drawing.BLUE, 3.0)
            messages.append(_scene(PATH, t_us, drawing.entity(t_us, "flown", lines=[path])))
            points = outlines.cloud(t_us, drawing.MISSION, [(self._path.points, outlines.BLUE)])
            messages.append(Message(OUTLINES[2], t_us, points))
        return messages

    def _state(self, t_us: int, position: Vec3, velocity: Vec3, q: Rotation) -> Message:
        status = self._status
        state = VehicleState(
            t_us=t_us,
            x_m=position[0],
            y_m=position[1],
            height_m=position[2],
            speed_m_s=norm(velocity),
            tilt_deg=math.degrees(tilt_of(q)),
            phase=self._phase,
            arms=self._arms,
            horn_share=self._horn_share(t_us),
            battery_v=None if status is None else status.battery_v,
            battery_remaining=None if status is None else status.battery_remaining,
        )
        return Message(VehicleState.topic, t_us, state)

    def _horn_share(self, t_us: int) -> float:
        """Return the fraction by which the lock's rods are inserted; 1 for a vehicle without a lock."""
        if self._horn is None or self._servo is None:
            return 1.0
        return locked_fraction(self._servo, self._horn.pulse_at(t_us))

    def _on_truth(self, truth: TruthSample) -> list[Message]:
        force, t_us = truth.contact_force_mission, truth.t_us
        self._true_n = _stronger(self._true_n, force)
        messages = [
            Message(TrueForce.topic, t_us, TrueForce(t_us, *self._along_wall(force, truth.position_mission)))
        ]
        if not self._from_truth or 0 <= t_us - self._true_us < SCENE_US:
            return messages
        self._true_us = t_us
        messages += self._update_arms(truth.mode.value, t_us)
        frame = MissionFrame(heading_rad=math.radians(self._mission.frame.heading_deg))
        return messages + self._moved(
            t_us, truth.position_mission, truth.velocity_mission, truth.q_frd_to_ned, frame
        )

    def _on_force(self, estimate: ForceEstimate) -> list[Message]:
        force, t_us = estimate.force_mission, estimate.t_us
        self._estimated_n = _stronger(self._estimated_n, force)
        parts = self._along_wall(force, self._position)
        return [Message(ForceState.topic, t_us, ForceState(t_us, *parts, estimate.clipped))]

    def _along_wall(self, force: Vec3, position: Vec3 | None) -> tuple[float, float, float, float]:
        """Return a force as (magnitude, normal, tangential, upward component) at the nearest wall.

        If there is no wall, the normal and tangential components are the components along x and y.
        """
        walls = self._mission.walls if self._show_room and position is not None else ()
        if not walls or position is None:
            return (norm(force), *force)
        nearest = min(walls, key=lambda wall: math.dist(wall.foot(position), position[:2]))
        normal, along, down = nearest.to_collision(force)
        return (norm(force), normal, along, -down)

    def _forces(self, t_us: int, position: Vec3) -> list[Message]:
        """Return arrows for the strongest forces since the last update.

        When the force has ended, return one update without arrows, which clears the display.
        """
        pairs = ((self._true_n, drawing.GREY), (self._estimated_n, drawing.RED))
        self._true_n = self._estimated_n = (0.0, 0.0, 0.0)
        arrows = [drawing.arrow(position, n, colour) for n, colour in pairs if norm(n) >= _MIN_ARROW_N]
        if not arrows and not self._drawn_forces:
            return []
        self._drawn_forces = bool(arrows)
        return [_scene(FORCES, t_us, drawing.entity(t_us, "force", arrows=arrows))]

    def _on_peak(self, peak: ImpactPeak) -> list[Message]:
        x, y, z = peak.position_mission
        self._hits.append(((x, y, z), f"{len(self._hits) + 1}: {peak.normal_force_n:.0f} N"))
        return [self._hit_marks(peak.t_us)]

    def _on_truth_contact(self, contact: TruthContact) -> list[Message]:
        if not self._from_truth:
            return []  # `_on_peak` shows the measured hits instead
        words = f"hit {contact.wall} {contact.mode}: {contact.peak_normal_force_n:.1f} N normal"
        at = contact.position_mission
        self._hits.append((at, f"{len(self._hits) + 1}: {contact.peak_normal_force_n:.0f} N"))
        return [self._hit_marks(contact.t_us), _log(contact.t_us, Event(Level.INFO, "contact", words))]

    def _hit_marks(self, t_us: int) -> Message:
        marks = drawing.entity(
            t_us,
            "hits",
            spheres=[drawing.ball(at, 0.06, drawing.RED) for at, _ in self._hits],
            texts=[drawing.text((at[0], at[1], at[2] + 0.3), words) for at, words in self._hits],
        )
        return _scene(HITS, t_us, marks)

    def _on_setpoint(self, point: Setpoint) -> list[Message]:
        frame = self._frame
        if frame is None:
            return []
        at = frame.point_from_ned(point.position_ned)
        colour = drawing.RED if point.recovery else drawing.PURPLE
        lines = [] if self._position is None else [drawing.line([self._position, at], drawing.PURPLE, 1.0)]
        marks = drawing.entity(point.t_us, "setpoint", spheres=[drawing.ball(at, 0.05, colour)], lines=lines)
        return [_scene(SET_POINT, point.t_us, marks)]

    def _on_lock(self, state: LockState) -> list[Message]:
        if state.phase is LockPhase.SETTLED and state.mode is not None:
            arms = state.mode.value
        else:
            arms = state.phase.value
        moved = state.mode is not None and state.phase in (LockPhase.TRAVELLING, LockPhase.SETTLED)
        if moved and self._horn is not None and self._servo is not None and state.mode is not None:
            self._horn.command(state.commanded_us or state.t_us, self._servo.pulse_us(state.mode))
        return self._update_arms(arms, state.t_us)

    def _update_arms(self, arms: str, t_us: int) -> list[Message]:
        changed, self._arms = arms != self._arms, arms
        return self._vehicle(t_us) if changed else []

    def _vehicle(self, t_us: int) -> list[Message]:
        airframe = self._mission.vehicle.airframe
        points = outlines.cloud(t_us, drawing.VEHICLE, outlines.vehicle(airframe, self._arms))
        return [
            _scene(VEHICLE, t_us, drawing.vehicle(airframe, self._arms, t_us)),
            Message(OUTLINES[1], t_us, points),
        ]

    def _on_status(self, status: StatusSample) -> list[Message]:
        self._status = status
        return []

    def _on_phase(self, change: PhaseChange) -> list[Message]:
        self._phase = change.after.value
        return []


def _stronger(a: Vec3, b: Vec3) -> Vec3:
    return b if norm(b) > norm(a) else a


def _scene(topic: str, t_us: int, *entities: SceneEntity) -> Message:
    return Message(topic, t_us, SceneUpdate(entities=list(entities)))


def _transform(t_us: int, position: Vec3, q: Rotation) -> Message:
    x, y, z = position
    transform = FrameTransform(
        timestamp=drawing.timestamp(t_us),
        parent_frame_id=drawing.MISSION,
        child_frame_id=drawing.VEHICLE,
        translation=Vector3(x=x, y=y, z=z),
        rotation=Quaternion(w=q[0], x=q[1], y=q[2], z=q[3]),
    )
    return Message(TRANSFORMS, t_us, FrameTransforms(transforms=[transform]))


def _log(t_us: int, event: Event) -> Message:
    line = Log(
        timestamp=drawing.timestamp(t_us), level=_LEVELS[event.level], message=event.text, name=event.source
    )
    return Message(LOG, t_us, line)


def locked_fraction(servo: Servo, horn_pulse_us: float) -> float:
    """Return the position of the horn between the flexible end (0) and the rigid end (1), clipped."""
    share = (horn_pulse_us - servo.flexible_pulse_us) / (servo.rigid_pulse_us - servo.flexible_pulse_us)
    return max(0.0, min(1.0, share))
