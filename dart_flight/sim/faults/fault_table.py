"""The table of the faults of a simulated flight, their parser, and the faults of the simulated vehicle.

`dry-run --fault NAME[=VALUE][@PHASE]` adds a fault. The fault begins when the mission first reaches the
phase, or immediately without a phase. A fault without a duration lasts until the end of the flight.

The site of a fault decides which part applies the fault. `VehicleFault` applies faults of plant, sensors and
autopilot. `pose_feed` applies faults of the forwarded poses (`mocap`). `link` faults act on the messages
between vehicle and application. `lock` faults act on the mock servo, and `app` faults on the program itself.
"""

from __future__ import annotations

import math
from enum import StrEnum

import msgspec

from dart_flight.base.geometry import GRAVITY_M_S2, scale
from dart_flight.base.records import FlightMode, Phase, PhaseChange, Record
from dart_flight.config.document import InputError, unknown_name
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.lock.drivers.mock import MockFaults
from dart_flight.lock.servo import ServoFaults
from dart_flight.planning.positioning import simulated_source
from dart_flight.sim.cascade import TrajectorySetpoint
from dart_flight.sim.faults.impairment import Impairment
from dart_flight.sim.simulated_vehicle import SimulatedVehicle

_GUST_S = 0.6
_INTRUDER_EVERY = 12  # ticks between setpoints of a second ground station, about 20 Hz as in this program


class FaultSite(StrEnum):
    """The part of a simulated flight on which a fault acts."""

    APP = "app"
    LINK = "link"
    LOCK = "lock"
    SENSOR = "sensor"
    MOCAP = "mocap"
    AUTOPILOT = "autopilot"
    PLANT = "plant"


class FaultKind(msgspec.Struct, frozen=True):
    """A row of the fault table; `value` is the default size in `unit`, and a size is from `low` to `high`."""

    name: str
    site: FaultSite
    description: str
    unit: str = ""
    value: float = 0.0
    low: float = 0.0
    high: float = 0.0

    @property
    def needs_real_time(self) -> bool:
        """Whether the fault affects the host's time or the link, so that the world must run in real time."""
        about_link = self.site is FaultSite.LINK or self.name == "clock-back"
        return about_link or (self.site is FaultSite.APP and self.name != "disk-full")


_P = FaultSite
KINDS: tuple[FaultKind, ...] = (
    FaultKind("hang-core", _P.APP, "the core thread hangs"),
    FaultKind("hang-loop", _P.APP, "the event loop hangs"),
    FaultKind("hang-lock", _P.APP, "a call in C holds Python's interpreter lock"),
    FaultKind("sigstop", _P.APP, "the program is stopped (SIGSTOP)"),
    FaultKind("sigkill", _P.APP, "the program is killed (SIGKILL, as when memory runs out)"),
    FaultKind("disk-full", _P.APP, "the disk of the flight log is full"),
    FaultKind("link-loss", _P.LINK, "the link is down for this time (0: permanently)", "s", 0.0, 0.0, 60.0),
    FaultKind("packet-loss", _P.LINK, "messages are lost", "%", 10.0, 0.0, 100.0),
    FaultKind("delay", _P.LINK, "messages are delayed", "ms", 50.0, 0.0, 2000.0),
    FaultKind(
        "jitter", _P.LINK, "each message has a random delay of up to this time", "ms", 100.0, 0.0, 2000.0
    ),
    FaultKind("reorder", _P.LINK, "messages arrive 20 ms late, after newer messages", "%", 10.0, 0.0, 100.0),
    FaultKind("duplicate", _P.LINK, "messages are duplicated", "%", 10.0, 0.0, 100.0),
    FaultKind(
        "second-vehicle",
        _P.LINK,
        "another vehicle with the same system id sends on the link; its clock is ahead by this time",
        "s",
        238.0,
        -1000.0,
        1000.0,
    ),
    FaultKind("imu-dropout", _P.LINK, "the telemetry contains no IMU samples"),
    FaultKind("imu-stuck", _P.SENSOR, "the reported IMU samples repeat the last reading"),
    FaultKind("imu-clip", _P.SENSOR, "the accelerometer clips at this acceleration", "g", 4.0, 1.2, 16.0),
    FaultKind(
        "ekf-jump", _P.SENSOR, "estimate and motion capture jump north by this distance", "m", 0.5, -3.0, 3.0
    ),
    FaultKind(
        "heading-reset",
        _P.SENSOR,
        "the estimated heading steps clockwise by this angle; motion capture corrects the heading",
        "deg",
        30.0,
        -180.0,
        180.0,
    ),
    FaultKind(
        "ev-delay",
        _P.AUTOPILOT,
        "PX4 assumes that motion-capture poses have this age on arrival (EKF2_EV_DELAY)",
        "ms",
        150.0,
        0.0,
        300.0,
    ),
    FaultKind(
        "clock-back", _P.AUTOPILOT, "the autopilot's clock jumps back by this time", "s", 5.0, 0.0, 1000.0
    ),
    FaultKind("low-battery", _P.AUTOPILOT, "remaining charge", "%", 10.0, 0.0, 100.0),
    FaultKind("pilot", _P.AUTOPILOT, "the pilot takes over in position mode"),
    FaultKind("kill-switch", _P.AUTOPILOT, "the pilot's kill switch: motors off, disarmed 5 s later"),
    FaultKind(
        "second-gcs",
        _P.AUTOPILOT,
        "a second ground station sends setpoints at this distance north of the vehicle",
        "m",
        1.0,
        -5.0,
        5.0,
    ),
    FaultKind("servo-stuck", _P.LOCK, "the lock's servo does not move"),
    FaultKind(
        "servo-slow",
        _P.LOCK,
        "the travel time of the lock's servo is longer by this factor",
        "x",
        4.0,
        1.0,
        100.0,
    ),
    FaultKind("servo-unplugged", _P.LOCK, "the servo's controller does not answer"),
    FaultKind("wall-missing", _P.PLANT, "the walls are missing"),
    FaultKind(
        "wall-nearer", _P.PLANT, "the walls are nearer than planned by this distance", "m", 0.3, -1.0, 1.0
    ),
    FaultKind("other-material", _P.PLANT, "each wall has the stiffest material other than its own"),
    FaultKind(
        "wall-harder", _P.PLANT, "the walls are stiffer than planned by this factor", "x", 4.0, 0.1, 20.0
    ),
    FaultKind("gust", _P.PLANT, "a gust of 0.6 s along the wall's normal", "m/s", 5.0, -15.0, 15.0),
    FaultKind("mocap-lost", _P.MOCAP, "the marker body is not tracked for this long", "s", 1.0, 0.0, 60.0),
    FaultKind(
        "mocap-flip",
        _P.MOCAP,
        "markers are swapped: the body is rotated by this angle",
        "deg",
        90.0,
        0.0,
        180.0,
    ),
    FaultKind(
        "mocap-other-body",
        _P.MOCAP,
        "the poses are those of another vehicle, this distance north of the start",
        "m",
        1.0,
        -10.0,
        10.0,
    ),
    FaultKind("mocap-late", _P.MOCAP, "poses arrive with this additional delay", "ms", 50.0, 0.0, 1000.0),
    FaultKind("mocap-slow", _P.MOCAP, "poses arrive at this rate", "Hz", 10.0, 1.0, 50.0),
)
BY_NAME = {kind.name: kind for kind in KINDS}

# The name of a phase in `--fault` -> the core's phase.
PHASES: dict[str, Phase] = {
    "take-off": Phase.CLIMB,
    "waypoint": Phase.WAYPOINT,
    "pause": Phase.PAUSE,
    "transit": Phase.TRANSIT,
    "approach": Phase.APPROACH,
    "contact": Phase.CONTACT,
    "recovery": Phase.RECOVERY,
    "goal": Phase.GOAL,
    "landing": Phase.LANDING,
}


class Fault(msgspec.Struct, frozen=True):
    """A fault in a flight.

    Attributes:
        value: size of the fault, in the unit of the fault's kind.
        phase: key of `PHASES`, or None for a fault from the start of the flight.
        after_s: delay after the start of the phase.
    """

    name: str
    value: float
    phase: str | None = None
    after_s: float = 0.0

    @property
    def kind(self) -> FaultKind:
        return BY_NAME[self.name]


def parse_mission_fault(mission: Mission, text: str) -> Fault:
    """Parse `NAME[=VALUE][@PHASE]` as a fault for the mission's vehicle (see `parse_fault`)."""
    has_mocap = simulated_source(mission) is PositionSource.MOCAP
    fault = parse_fault(text, mission.vehicle.has_lock, has_mocap)
    if fault.kind.site is FaultSite.MOCAP and mission.vehicle.mocap.url is None:
        raise InputError(f"{fault.name}: this fault needs forwarded poses: add --mocap", key=("--fault",))
    return fault


def parse_fault(text: str, has_lock: bool = True, has_mocap: bool = True) -> Fault:
    """Parse `NAME[=VALUE][@PHASE]`.

    Raises:
        InputError: the fault or phase does not exist, the value is out of range, or the vehicle lacks the
            lock or motion capture that the fault needs.
    """
    body, at, phase = text.partition("@")
    name, equals, number = body.partition("=")
    if name not in BY_NAME:
        raise InputError(unknown_name(name, list(BY_NAME), "fault"), key=("--fault",))
    kind = BY_NAME[name]
    if kind.site is FaultSite.LOCK and not has_lock:
        raise InputError(f"{name}: this vehicle has no lock", key=("--fault",))
    if name == "ev-delay" and not has_mocap:
        raise InputError(
            f"{name}: needs motion capture, but this vehicle's position comes from GPS", key=("--fault",)
        )
    if at and phase not in PHASES:
        raise InputError(unknown_name(phase, list(PHASES), "phase"), key=("--fault",))
    value = kind.value
    if equals:
        try:
            value = float(number)
        except ValueError:
            raise InputError(f"{number!r} is not a number", key=("--fault",)) from None
        if not kind.low <= value <= kind.high:
            allowed = f"{kind.low:g} to {kind.high:g} {kind.unit}" if kind.unit else "no value"
            raise InputError(f"{name} takes {allowed}, not {number}", key=("--fault",))
    return Fault(name, value, phase or None)


class Trigger:
    """The trigger of a fault: it begins `after_s` after the mission first reaches the fault's phase."""

    def __init__(self, fault: Fault) -> None:
        self._fault = fault
        self._since_us: int | None = None

    def process(self, record: Record) -> bool:
        """Return whether the phase of the fault has begun."""
        if self._since_us is None:
            first = self._fault.phase is None
            if first and hasattr(record, "t_us"):
                self._since_us = record.t_us
            elif isinstance(record, PhaseChange) and record.after == PHASES[self._fault.phase or "landing"]:
                self._since_us = None if first else record.t_us
        return self._since_us is not None

    def is_due(self, now_us: int) -> bool:
        """Return whether the fault has begun; a fault without phase and delay begins before any record."""
        if self._fault.phase is None and self._fault.after_s == 0.0:
            return True
        return self._since_us is not None and now_us - self._since_us >= self._fault.after_s * 1e6


# --- application of the faults -----------------------------------------------------------------------------


def make_impairment(fault: Fault) -> Impairment:
    share = fault.value * 0.01
    return {
        "link-loss": Impairment(down=True),
        "packet-loss": Impairment(loss=share),
        "delay": Impairment(delay_s=fault.value * 1e-3),
        "jitter": Impairment(jitter_s=fault.value * 1e-3),
        "reorder": Impairment(reorder=share),
        "duplicate": Impairment(duplicate=share),
        "imu-dropout": Impairment(),
        "second-vehicle": Impairment(),
    }[fault.name]


def make_mock_faults(fault: Fault) -> MockFaults:
    return {
        "servo-stuck": MockFaults(servo=ServoFaults(stuck=True)),
        "servo-slow": MockFaults(servo=ServoFaults(slow=fault.value or 1.0)),
        "servo-unplugged": MockFaults(unplugged=True),
    }[fault.name]


class VehicleFault:
    """An active fault of plant, sensor or autopilot in a simulated vehicle; call `tick` every 4 ms."""

    def __init__(self, vehicle: SimulatedVehicle, fault: Fault) -> None:
        self._autopilot, self._fault = vehicle.autopilot, fault
        self._began_s = vehicle.autopilot.now_s
        self._ticks = 0
        getattr(self, "_begin_" + fault.name.replace("-", "_"))()

    def tick(self) -> None:
        """Apply the effects that change over time."""
        self._ticks += 1
        a = self._autopilot
        if self._fault.name == "gust" and a.now_s - self._began_s > _GUST_S:
            a.plant.wind_ned = (0.0, 0.0, 0.0)
        elif self._fault.name == "second-gcs" and self._ticks % _INTRUDER_EVERY == 0:
            x, y, z = a.estimator.position
            a.set_trajectory(TrajectorySetpoint((x + self._fault.value, y, z)))

    # -- sensors --

    def _begin_imu_stuck(self) -> None:
        self._autopilot.imu_stuck = True

    def _begin_imu_clip(self) -> None:
        self._autopilot.imu_sensor.full_scale_m_s2 = self._fault.value * GRAVITY_M_S2

    def _begin_ekf_jump(self) -> None:
        shift = (self._fault.value, 0.0, 0.0)
        self._autopilot.pose_filter.shift(shift)
        self._autopilot.pose_sensor.offset_ned = shift

    def _begin_heading_reset(self) -> None:
        self._autopilot.estimator.turn(math.radians(self._fault.value))

    # -- autopilot --

    def _begin_ev_delay(self) -> None:
        self._autopilot.assume_pose_delay(self._fault.value * 1e-3)

    def _begin_clock_back(self) -> None:
        self._autopilot.plant.time_offset_us -= round(self._fault.value * 1e6)

    def _begin_low_battery(self) -> None:
        self._autopilot.battery_left = self._fault.value * 0.01

    def _begin_pilot(self) -> None:
        self._autopilot.set_mode(FlightMode.MANUAL)

    def _begin_kill_switch(self) -> None:
        self._autopilot.kill()

    def _begin_second_gcs(self) -> None:
        pass  # `tick` applies this fault

    # -- plant --

    def _begin_wall_missing(self) -> None:
        self._autopilot.plant.planes.clear()
        self._autopilot.plant.posts.clear()

    def _begin_wall_nearer(self) -> None:
        plant, d = self._autopilot.plant, self._fault.value
        here = plant.frame.point_from_ned(plant.position)
        for plane in plant.planes:
            if -1.0 < plane.wall.signed_distance(here) < d + 0.1:
                continue  # skip a wall that would move into the vehicle, because no survey is that wrong
            plane.move(d)

    def _begin_other_material(self) -> None:
        vehicle = self._autopilot.vehicle
        materials, softest = vehicle.materials, vehicle.modes[-1]
        for plane in self._autopilot.plant.planes:
            others = [name for name in materials if name != plane.wall.material]
            stiffest = max(
                others, key=lambda name: materials[name].coefficients(softest).k, default=plane.wall.material
            )
            plane.wall = msgspec.structs.replace(plane.wall, material=stiffest)

    def _begin_wall_harder(self) -> None:
        plant, factor = self._autopilot.plant, self._fault.value
        scaled = {
            name: msgspec.structs.replace(
                material,
                **{m.value: material.coefficients(m).scaled(factor, 1.0, 1.0) for m in plant.vehicle.modes},
            )
            for name, material in plant.vehicle.materials.items()
        }
        plant.vehicle = msgspec.structs.replace(plant.vehicle, materials=scaled)

    def _begin_gust(self) -> None:
        plant = self._autopilot.plant
        here = plant.frame.point_from_ned(plant.position)
        near = min(plant.planes, key=lambda p: abs(p.wall.signed_distance(here)), default=None)
        normal = near.normal if near is not None else (1.0, 0.0, 0.0)
        plant.wind_ned = scale(normal, -self._fault.value)
