"""Single simulated hits that test force estimate and detector: plant, IMU and core parts, no mission.

The plant flies ballistically (constant equal motor commands, so it keeps its tilt) into one wall. The
readings of a perfect IMU are stored, so that the same hit can be estimated under different noise.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator

import msgspec

from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    MissionFrame,
    Quaternion,
    Vec2,
    Vec3,
    add,
    quaternion_from_euler,
    quaternion_from_rotation_vector,
    quaternion_multiply,
)
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    Input,
    LandedState,
    LockPhase,
    LockState,
    Mode,
    OdometrySample,
    StatusSample,
)
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.senses import Senses
from dart_flight.sim.noise import GaussianNoise
from dart_flight.sim.plant import Plant
from dart_flight.sim.sensors import ImuSensor

TICK_US = 4000
LEAD_S = 0.4  # flight before the contact
AFTER_S = 0.22  # observed after the first force
FRAME = MissionFrame(north_m=3.0, east_m=-2.0, down_m=0.0, heading_rad=0.6)
_HOVER_S = 1.0
_START_US = 5_000_000
_ATTITUDE_SIGMA_RAD, _VELOCITY_SIGMA_M_S = 0.005, 0.03


class Hit(msgspec.Struct, frozen=True):
    """One case: velocity at the wall, mode and material, and tilt.

    `lean` is the direction of the horizontal thrust: `in` to the wall, `along` it, or `away` from it.
    """

    normal_m_s: float
    tangential_m_s: float
    mode: Mode
    material: str
    wall_deg: float
    tilt_deg: float
    lean: str


class Tick(msgspec.Struct):
    """True motion and contact force of one 4 ms tick, without noise."""

    t_us: int
    specific_force: Vec3
    q: Quaternion
    position: Vec3
    velocity: Vec3
    contact_n: Vec2  # mean contact force, wall's normal and tangent


class Flown(msgspec.Struct):
    """The truth of a hit: peaks in newton, `cross_us` the tick whose mean force crosses the threshold."""

    hit: Hit
    command: float
    ticks: list[Tick]
    normal: Vec2
    peak_normal: float
    cross_us: int | None
    contacts: int  # that reach the threshold
    friction: list[tuple[int, float]]  # (t_us, newton along the tangent) every millisecond of contact

    def peak_tangential(self, until_us: int) -> float:
        """Return the largest friction force up to `until_us`, signed."""
        return max((f for t, f in self.friction if t <= until_us), key=abs, default=0.0)


def fly_hit(vehicle: VehicleConfig, hit: Hit) -> Flown:
    """Simulate one hit, from `LEAD_S` before it to `AFTER_S` after its first force."""
    angle = math.radians(hit.wall_deg)
    normal = (math.cos(angle), math.sin(angle))
    wall = Wall("wall", (0.0, 0.0), normal, 50.0, hit.material)
    towards = {"in": (-1.0, 0.0), "along": (0.0, 1.0), "away": (1.0, 0.0)}[hit.lean]
    tilt = math.radians(hit.tilt_deg)
    push = GRAVITY_M_S2 * math.tan(tilt)
    accel = (push * towards[0], push * towards[1])
    # Integrate backwards in time from the wall; drag is small and shows in the true speed. A vehicle that
    # leans in starts from rest at the earliest, otherwise it would start behind the wall.
    lead = min(LEAD_S, -0.95 * hit.normal_m_s / push) if hit.lean == "in" and push > 0.0 else LEAD_S
    v0 = (hit.normal_m_s - accel[0] * lead, hit.tangential_m_s - accel[1] * lead)
    x0 = -(v0[0] * lead + 0.5 * accel[0] * lead**2)
    nx, ny = normal
    plant = Plant(vehicle, (wall,), FRAME, FRAME.point_to_ned((x0 * nx, x0 * ny, 5.0)))
    plant.ground_down = 100.0
    plant.velocity = FRAME.vector_to_ned((v0[0] * nx + v0[1] * ny, v0[0] * ny - v0[1] * nx, 0.0))
    plant.q = _attitude(wall, tilt, towards)
    plant.set_mode(hit.mode)
    command = vehicle.thrust.command_for(
        vehicle.airframe.mass_kg * GRAVITY_M_S2 / math.cos(tilt) / len(vehicle.airframe.motors)
    )
    plant.motor = [command] * 4
    return _record(plant, wall, hit, command, vehicle.detection.force_threshold_n)


def _attitude(wall: Wall, tilt: float, towards: Vec2) -> Quaternion:
    """Return the attitude with the leading edge parallel to the wall and the thrust tilted `towards`."""
    yaw = FRAME.yaw_to_ned(wall.parallel_yaw(0.3))
    tn, tt = wall.normal, wall.tangent
    d = FRAME.vector_to_ned(
        (towards[0] * tn[0] + towards[1] * tt[0], towards[0] * tn[1] + towards[1] * tt[1], 0.0)
    )
    # Rotation axis: up x direction, in NED (0, 0, -1) x d.
    axis = (d[1] * tilt, -d[0] * tilt, 0.0)
    return quaternion_multiply(quaternion_from_rotation_vector(axis), quaternion_from_euler(0.0, 0.0, yaw))


def _record(plant: Plant, wall: Wall, hit: Hit, command: float, threshold_n: float) -> Flown:
    ticks: list[Tick] = []
    friction: list[tuple[int, float]] = []
    peaks: list[float] = []  # largest horizontal force of each contact
    peak_n, touching, cross_us, touched_s = 0.0, False, None, math.inf
    commands = (command,) * 4
    while plant.time_s < min(2.0 * LEAD_S + 1.0, touched_s + AFTER_S):
        f = [0.0, 0.0, 0.0]
        mean_n = mean_t = 0.0
        for _ in range(4):
            part = plant.advance(commands, 1)
            f = [f[i] + 0.25 * part[i] for i in range(3)]
            force = wall.to_collision(FRAME.vector_from_ned(plant.contact_force_ned))
            mean_n, mean_t = mean_n + 0.25 * force[0], mean_t + 0.25 * force[1]
            if force[0] > 0.0:
                touched_s = min(touched_s, plant.time_s)
                if not touching:
                    peaks.append(0.0)
                peaks[-1] = max(peaks[-1], math.hypot(force[0], force[1]))
                if len(peaks) == 1:
                    peak_n = max(peak_n, force[0])
                    friction.append((_START_US + round(plant.time_s * 1e6), force[1]))
            touching = force[0] > 0.0
        t_us = _START_US + round(plant.time_s * 1e6)
        if cross_us is None and math.hypot(mean_n, mean_t) >= threshold_n:
            cross_us = t_us
        ticks.append(
            Tick(t_us, (f[0], f[1], f[2]), plant.q, plant.position, plant.velocity, (mean_n, mean_t))
        )
    reached = sum(p >= threshold_n for p in peaks)
    return Flown(hit, command, ticks, wall.normal, peak_n, cross_us, reached, friction)


def estimate_hit(
    vehicle: VehicleConfig, flown: Flown, sigma: float, seed: int
) -> tuple[list[ImpactOnset], ImpactPeak | None]:
    """Estimate a flown hit under IMU noise of `sigma` m/s2 per sample.

    Args:
        vehicle: configuration of the plant and its IMU.
        flown: the hit.
        sigma: noise.
        seed: seed of the noise.
    """
    noise = GaussianNoise(random.Random(seed))
    noisy = msgspec.structs.replace(vehicle.simulation, imu_noise_m_s2=sigma)
    imu = ImuSensor(msgspec.structs.replace(vehicle, simulation=noisy), noise)
    senses, expected = Senses(vehicle), ExpectedContact(False, flown.normal, flown.hit.material)
    senses.state.anchor(FRAME)
    senses.update(LockState(_START_US, LockPhase.SETTLED, flown.hit.mode), expected)
    senses.update(StatusSample(_START_US, _START_US, landed=LandedState.IN_AIR), expected)
    hover = vehicle.thrust.command_for(vehicle.airframe.mass_kg * GRAVITY_M_S2 / 4.0)
    onsets: list[ImpactOnset] = []
    peak: ImpactPeak | None = None
    for i, tick in enumerate([*_hover(flown), *flown.ticks]):
        t = tick.t_us
        if i % 2 == 0:
            for sample in _samples_of(tick, flown.command if t > _START_US else hover, noise):
                senses.update(sample, expected)
        expected = expected._replace(watching=t > _START_US)
        measured, rate = imu.measure(tick.specific_force, (0.0, 0.0, 0.0))
        for event in senses.update(ImuSample(t, t + 1000, measured, rate), expected).impacts:
            if isinstance(event, ImpactOnset):
                onsets.append(event)
            elif isinstance(event, ImpactPeak) and peak is None:
                peak = event
    return onsets, peak


def _hover(flown: Flown) -> list[Tick]:
    """Return a second of hover before the flight, in which noise and bias are learned."""
    q = quaternion_from_euler(0.0, 0.0, 0.0)
    count = round(_HOVER_S * 1e6) // TICK_US
    first = flown.ticks[0]
    return [
        Tick(
            first.t_us - (count - i) * TICK_US,
            (0.0, 0.0, -GRAVITY_M_S2),
            q,
            first.position,
            (0.0, 0.0, 0.0),
            (0.0, 0.0),
        )
        for i in range(count)
    ]


def _samples_of(tick: Tick, command: float, noise: GaussianNoise) -> Iterator[Input]:
    t, s = tick.t_us, _ATTITUDE_SIGMA_RAD
    twist = quaternion_from_rotation_vector(noise.three(s))
    yield AttitudeSample(t // 1000 * 1000, t + 1000, quaternion_multiply(tick.q, twist))
    velocity = add(tick.velocity, noise.three(_VELOCITY_SIGMA_M_S))
    yield OdometrySample(t, t + 1000, tick.position, velocity)
    yield ActuatorSample(t, t + 1000, (command,) * 4)


def grid(
    speeds: tuple[float, ...],
    orientations: tuple[float, ...],
    tilts: tuple[float, ...],
    materials: tuple[str, ...] = ("wood", "acrylic"),
) -> Iterator[Hit]:
    """Yield every combination of speed, mode, material, wall and tilt; lean and sliding are random."""
    rng = random.Random(11)
    for speed in speeds:
        for mode in Mode:
            for material in materials:
                for orientation in orientations:
                    for tilt in tilts:
                        lean = rng.choice(("in", "along", "away")) if tilt else "in"
                        slide = rng.choice((-0.5, 0.0, 0.5)) * speed
                        yield Hit(-speed, slide, mode, material, orientation, tilt, lean)


def direction_error_deg(flown: Flown, peak: ImpactPeak) -> float:
    """Return the angle between estimated and true horizontal force, each built from its two peaks."""
    true = (flown.peak_normal, flown.peak_tangential(peak.detected_us))
    found = (peak.normal_force_n, peak.tangential_force_n)
    size = math.hypot(*true) * math.hypot(*found)
    along = true[0] * found[0] + true[1] * found[1]
    return math.degrees(math.acos(max(-1.0, min(1.0, along / size)))) if size > 0.0 else 0.0


class HitFigures(msgspec.Struct):
    """Figures of one hit; errors are NaN if nothing was detected.

    Attributes:
        reached: whether the true force of a tick reached the threshold.
        delay_samples: samples from that tick to the onset.
        peak_error: relative error of the normal peak.
    """

    hit: Hit
    clipped: bool
    reached: bool
    onsets: int
    contacts: int
    delay_samples: int | None
    peak_error: float
    direction_deg: float
    fitted: bool


def figures_of(mission: Mission, hit: Hit, sigma: float, seed: int) -> HitFigures:
    """Fly one hit and return the figures of its estimate under IMU noise."""
    flown = fly_hit(mission.vehicle, hit)
    onsets, peak = estimate_hit(mission.vehicle, flown, sigma, seed)
    delay = None
    if onsets and flown.cross_us is not None:
        delay = (onsets[0].t_us - flown.cross_us) // TICK_US
    return HitFigures(
        hit=hit,
        clipped=peak is not None and peak.clipped,
        reached=flown.cross_us is not None,
        onsets=len(onsets),
        contacts=flown.contacts,
        delay_samples=delay,
        peak_error=peak.normal_force_n / flown.peak_normal - 1.0 if peak else math.nan,
        direction_deg=direction_error_deg(flown, peak) if peak else math.nan,
        fitted=peak is not None and peak.fitted,
    )
