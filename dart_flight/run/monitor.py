"""Monitor that estimates forces and detects contacts from a vehicle's telemetry. It sends no setpoints.

MAVSDK's thread passes every record to `TelemetryMonitor`. Another thread processes the records in batches
several times per second. A batch takes a third of the processor time that single records would take. The
monitor sends nothing except requests for slow streams and the poses of a motion capture. If another
`dart-flight` process flies over the same link, the monitor does not slow down the streams of that flight.
`dart-flight monitor` uses this module.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections import deque
from collections.abc import Callable
from typing import get_args

import msgspec

from dart_flight.base.geometry import MissionFrame, Vec3
from dart_flight.base.records import (
    ForceEstimate,
    ImpactPeak,
    Input,
    LandedState,
    LockState,
    PhaseChange,
    PlanTaken,
    PoseSample,
    Record,
    StatusText,
    WallEstimate,
)
from dart_flight.base.streams import SAMPLED, SAMPLED_NAME, Stream
from dart_flight.config.mission import Mission
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.senses import Senses
from dart_flight.lock.state_machine import status_text
from dart_flight.recording.follow import LogFollower
from dart_flight.vehicle import messages
from dart_flight.vehicle.clock import host_us
from dart_flight.vehicle.motion_capture.pose_bridge import MotionCaptureBridge, forwarding
from dart_flight.vehicle.motion_capture.pose_statistics import PoseFigures, PoseStatistics
from dart_flight.vehicle.vehicle_session import VehicleSession, connect

_RATE_WINDOW_S = 1.0
_HEARTBEAT_S = 2.0  # longest wait for a heartbeat; the autopilot sends one per second
_WORK_S = 0.05  # period at which queued records are processed; a screen may be updated less often
_INPUTS = get_args(Input)


class StreamView(msgspec.Struct):
    """One stream: measured and required rate, and age of the newest sample (null before the first sample)."""

    name: str
    rate_hz: float
    expected_hz: float
    age_ms: float | None


class WallView(msgspec.Struct):
    """Estimate of a wall from a contact.

    `prior` contains the configured k, f and mu of the wall's material. `posterior` contains the estimated
    values, and `posterior_sd` their relative standard deviation. `mode_felt` is the mode estimated from the
    contact, or null if undecided.
    """

    wall: str
    mode_felt: str | None
    prior: Vec3
    posterior: Vec3
    posterior_sd: Vec3


class MonitorView(msgspec.Struct):
    """Data for a screen. Forces are in newton, along the axes of `frame`."""

    time_s: float
    frame: str
    force_n: Vec3 | None
    filtered_n: Vec3 | None
    sigma_n: float | None
    clipped: bool
    detection: str
    peaks: list[tuple[float, float, float]]  # of each peak: age in s, normal and tangential force in newton
    thrust_source: str | None
    noise_m_s2: float
    thrust_scale: float
    bias_m_s2: tuple[float, float]
    streams: list[StreamView]
    armed: bool
    flight_mode: str
    landed: str
    battery_v: float | None
    phase: str | None
    lock: str | None  # "none": the vehicle has no lock
    cpu_percent: float
    walls: list[WallView] = msgspec.field(default_factory=list)  # only from the log of a flight
    plan: str | None = None  # result of the newest plan made in flight
    poses: PoseFigures | None = None  # statistics of the motion capture, after the first pose
    pose_problem: str | None = None  # reason why no usable poses arrive


class TelemetryMonitor:
    """Estimator and detector on live telemetry.

    Args:
        frame_known: whether to use the mission's frame; otherwise forces are along north, west and up.
        viewer: callback for every record and for the results of the core's `Senses`; must not block.
    """

    def __init__(
        self, mission: Mission, frame_known: bool, viewer: Callable[[Record], None] = lambda record: None
    ) -> None:
        self._queued: deque[Input] = deque()  # not yet processed
        self._viewer = viewer
        self._senses = Senses(mission.vehicle)
        self._placed = frame_known
        # Without a mission, use the frame with heading 0: north, west, up.
        self._senses.state.anchor(mission.frame_at((0.0, 0.0, 0.0)) if frame_known else MissionFrame())
        self.estimation, self.motors = mission.vehicle.estimation, len(mission.vehicle.airframe.motors)
        self._estimate: ForceEstimate | None = None
        self._peaks: deque[ImpactPeak] = deque(maxlen=5)
        self._counts: dict[str, deque[int]] = {s.name: deque() for s in SAMPLED}
        self._phase: str | None = None
        self._lock: str | None = None if mission.vehicle.has_lock else "none"
        self._materials = {w.name: mission.vehicle.materials[w.material] for w in mission.walls}
        self._walls: dict[str, WallView] = {}
        self._plan: str | None = None
        self.mocap = mission.vehicle.mocap
        self._poses: PoseStatistics | None = None
        self.bridge: MotionCaptureBridge | None = None  # None while this monitor forwards no poses
        self._began_us = host_us()
        self._cpu = (time.monotonic(), time.process_time())

    def process_record(self, record: Record) -> None:
        """Process a record from a flight's log.

        Only inputs, phases, wall estimates and results of plans are used. All other records are ignored.
        """
        if isinstance(record, PhaseChange):
            self._phase = record.after.value
        elif isinstance(record, WallEstimate):
            self._store_wall(record)
        elif isinstance(record, PlanTaken):
            self._plan = "flown" if record.taken else f"not flown: {record.reason}"
        elif isinstance(record, _INPUTS):
            self._process(record)

    def _store_wall(self, estimate: WallEstimate) -> None:
        mode = estimate.mode_felt or estimate.mode_reported
        if mode is None or estimate.wall not in self._materials:
            return
        prior = self._materials[estimate.wall].coefficients(mode)
        self._walls[estimate.wall] = WallView(
            estimate.wall,
            None if estimate.mode_felt is None else estimate.mode_felt.value,
            (prior.k, prior.f, prior.mu),
            (estimate.k_n_per_m, estimate.f_ns_per_m, estimate.mu_s_per_m),
            (estimate.k_sd, estimate.f_sd, estimate.mu_sd),
        )

    def put(self, item: Input) -> None:
        """Queue a record for `process_queued`, from any thread, without blocking."""
        self._queued.append(item)

    def process_queued(self) -> None:
        while self._queued:
            self._process(self._queued.popleft())

    def _process(self, item: Input) -> None:
        self._viewer(item)
        for record in self._sense(item):
            self._viewer(record)

    def _sense(self, item: Input) -> list[Record]:
        """Return the results of `Senses` for an input: a force estimate and impact events."""
        if isinstance(item, PoseSample) and self._poses is None:
            self._poses = PoseStatistics(self.mocap.room_frame(), self.mocap.delay_ms)
        if self._poses is not None:
            self._poses.update(item)
        name = SAMPLED_NAME.get(type(item))
        if name is not None:
            # All processes share the host's clock, so the ages are also correct for the log of a flight.
            self._counts[name].append(getattr(item, "received_us", 0))
        if isinstance(item, StatusText):
            self._read_text(item.text)
            return []
        if isinstance(item, LockState):
            self._lock = status_text(item).removeprefix("lock ")
        sensed = self._senses.update(item, ExpectedContact(self._in_air))
        if sensed.estimate is None:
            return []
        self._estimate = sensed.estimate
        self._peaks.extend(event for event in sensed.impacts if isinstance(event, ImpactPeak))
        return [sensed.estimate, *sensed.impacts]

    @property
    def _in_air(self) -> bool:
        return self._senses.state.status.landed is LandedState.IN_AIR

    def _read_text(self, text: str) -> None:
        # A flying `dart-flight` sends its lock and its phase as STATUSTEXT.
        if text.startswith("lock "):
            self._lock = text.removeprefix("lock ")
        elif text.startswith("phase "):
            self._phase = text.removeprefix("phase ")

    def view(self) -> MonitorView:
        self.process_queued()
        now, state, e = host_us(), self._senses.state, self._estimate
        newest = state.imu.t_us if state.imu else 0
        source = self._senses.motion.thrust.source
        hover = self._senses.motion.hover
        return MonitorView(
            time_s=(now - self._began_us) * 1e-6,
            frame="mission" if self._placed else "north, west, up",
            force_n=e.force_mission if e else None,
            filtered_n=e.filtered_mission if e else None,
            sigma_n=math.sqrt(max(0.0, 0.5 * (e.variance_n2[0] + e.variance_n2[1]))) if e else None,
            clipped=e.clipped if e else False,
            detection=self._senses.detector.stage if self._in_air else "not monitored on the ground",
            peaks=[
                ((newest - p.t_us) * 1e-6, p.normal_force_n, p.tangential_force_n)
                for p in reversed(self._peaks)
            ],
            thrust_source=source.value if source else None,
            noise_m_s2=hover.noise_m_s2,
            thrust_scale=hover.scale,
            bias_m_s2=(hover.bias_x, hover.bias_y),
            streams=[self._stream(stream, now) for stream in SAMPLED],
            armed=state.status.armed,
            flight_mode=state.status.flight_mode.value,
            landed=state.status.landed.value,
            battery_v=state.status.battery_v,
            phase=self._phase,
            lock=self._lock,
            cpu_percent=self._cpu_percent(),
            walls=list(self._walls.values()),
            plan=self._plan,
            poses=self._poses.figures(now) if self._poses is not None else None,
            pose_problem=self.bridge.missing if self.bridge is not None else None,
        )

    def _stream(self, stream: Stream, now: int) -> StreamView:
        seen = self._counts[stream.name]
        newest = seen[-1] if seen else None
        while seen and seen[0] < now - _RATE_WINDOW_S * 1e6:
            seen.popleft()
        age = (now - newest) * 1e-3 if newest is not None else None
        return StreamView(stream.name, len(seen) / _RATE_WINDOW_S, stream.expected_hz, age)

    def _cpu_percent(self) -> float:
        wall, busy = time.monotonic(), time.process_time()
        share = 100.0 * (busy - self._cpu[1]) / max(1e-3, wall - self._cpu[0])
        self._cpu = (wall, busy)
        return share


async def _raise_rates(watcher: TelemetryMonitor, session: VehicleSession) -> None:
    """Request the streams that are slower than a mission requires."""
    await asyncio.sleep(1.5 * _RATE_WINDOW_S)
    slow = [s.name for s in watcher.view().streams if s.rate_hz < s.expected_hz]
    await session.set_rates(slow, watching=True)


async def _may_forward(watcher: TelemetryMonitor, session: VehicleSession) -> bool:
    """Return whether the monitor should forward poses.

    If the vehicle is armed, another program flies it and already forwards the poses.
    """
    if watcher.mocap.url is None:
        return False
    beat = await asyncio.to_thread(session.next, messages.HEARTBEAT, _HEARTBEAT_S)
    return beat is None or not beat.armed


async def monitor_vehicle(
    watcher: TelemetryMonitor,
    url: str,
    timeout_s: float,
    show: Callable[[MonitorView], None],
    period_s: float,
    seconds: float | None,
    opened: Callable[[], None] = lambda: None,
) -> None:
    """Connect as a ground station, run a `TelemetryMonitor` and show a view every period.

    Args:
        timeout_s: timeout of the connection, at most `seconds`.
        seconds: duration, or None to run until cancelled.

    Raises:
        VehicleError: there is no autopilot at the URL.
        InputError: the motion capture cannot be opened.
    """
    wait_s = timeout_s if seconds is None else min(timeout_s, seconds)
    async with connect(url, wait_s, watcher.put, ground=True, opened=opened) as session:
        session.subscribe(watcher.estimation, watcher.motors, guarded=False)
        rates = asyncio.create_task(_raise_rates(watcher, session))
        end = None if seconds is None else time.monotonic() + seconds
        shown_s = time.monotonic()
        poses = contextlib.ExitStack()
        try:
            if await _may_forward(watcher, session):
                watcher.bridge = poses.enter_context(
                    forwarding(watcher.mocap, session.send_message, session.clock, watcher.put)
                )
            while end is None or time.monotonic() < end:
                await asyncio.sleep(_WORK_S)
                watcher.process_queued()
                if time.monotonic() - shown_s >= period_s:
                    shown_s = time.monotonic()
                    show(watcher.view())
        finally:
            poses.close()
            rates.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await rates


def monitor_log(
    watcher: TelemetryMonitor,
    log: LogFollower,
    show: Callable[[MonitorView], None],
    period_s: float,
    seconds: float | None,
    flying: Callable[[], bool],
    viewer: Callable[[Record], None] = lambda record: None,
) -> None:
    """Run a `TelemetryMonitor` on the log of a flight in progress and show a view every period.

    This function does not use the link and does not affect the flight. It ends after `seconds`, at the end of
    the log, or when the flight's process has ended (`flying`). Raise InputError if the log cannot be read, or
    is damaged.
    """
    end = None if seconds is None else time.monotonic() + seconds
    shown_s = -math.inf
    while end is None or time.monotonic() < end:
        alive = flying()  # check before reading, so that the last records are read
        entries = log.read()
        for entry in entries:
            watcher.process_record(entry.record)
            viewer(entry.record)
        now = time.monotonic()
        if now - shown_s >= period_s:
            shown_s = now
            show(watcher.view())
        if log.ended or (not alive and not entries):
            break
        if not entries:
            time.sleep(_WORK_S)
    show(watcher.view())
