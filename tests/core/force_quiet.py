"""Aggressive simulated flight without any contact, in which the detector must not report an impact.

The embedded autopilot flies velocity reversals, hard braking, yaw spins, climbs and drops. The wind has
gusts, turbulence and prop wash. Thrust curve and drag differ from the estimator's, and samples are lost or
late.
"""

from __future__ import annotations

import math
import random

import msgspec

from dart_flight.base.geometry import MissionFrame, Vec3, yaw_ned_of
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    FlightMode,
    ImpactOnset,
    ImuSample,
    Input,
    LandedState,
    LockPhase,
    LockState,
    Mode,
    OdometrySample,
    StatusSample,
)
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.senses import Senses
from dart_flight.sim.cascade import TrajectorySetpoint
from dart_flight.sim.embedded_autopilot import Autopilot
from dart_flight.sim.plant import Plant

_NAN = math.nan


class QuietFlight(msgspec.Struct):
    """Results of a flight: false detections, largest tilt, largest true horizontal force of the wind."""

    false_hits: list[str]
    max_tilt_deg: float
    wind_force_n: float


def _plant_vehicle(vehicle: VehicleConfig, sigma: float, rng: random.Random) -> VehicleConfig:
    """Return the true vehicle: thrust differs by up to 8 %, drag by up to 30 %, IMU noise is `sigma`."""
    thrust = vehicle.thrust.scaled(rng.uniform(0.92, 1.08))
    b = vehicle.airframe.drag_per_s
    drag = (b[0] * rng.uniform(0.7, 1.3), b[1] * rng.uniform(0.7, 1.3), b[2])
    airframe = msgspec.structs.replace(vehicle.airframe, drag_per_s=drag)
    simulation = msgspec.structs.replace(vehicle.simulation, imu_noise_m_s2=sigma)
    return msgspec.structs.replace(vehicle, thrust=thrust, airframe=airframe, simulation=simulation)


class _Weather:
    """Steady wind, gusts (1 - cos, 2 to 4 m/s within 0.5 s) and turbulence or prop wash near a wall."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._gust_at, self._gust = 0.0, (0.0, 0.0)
        self._wash_until = -1.0
        self._turbulence = [0.0, 0.0, 0.0]

    def at(self, t: float) -> tuple[float, float, float]:
        rng = self._rng
        if t > self._gust_at + 2.0:
            self._gust_at = t + rng.uniform(0.5, 4.0)
            size, angle = rng.uniform(2.0, 4.0), rng.uniform(0.0, 2.0 * math.pi)
            self._gust = (size * math.cos(angle), size * math.sin(angle))
            if rng.random() < 0.3:
                self._wash_until = t + rng.uniform(1.0, 4.0)
        phase = (t - self._gust_at) / 1.0
        share = 0.5 * (1.0 - math.cos(2.0 * math.pi * phase)) if 0.0 < phase < 1.0 else 0.0
        # First-order noise of 6 Hz: 0.4 m/s in the open, 1.5 m/s in the wash of a wall.
        keep, sigma = math.exp(-2.0 * math.pi * 6.0 * 0.004), 1.5 if t < self._wash_until else 0.4
        for i in range(3):
            self._turbulence[i] = keep * self._turbulence[i] + rng.gauss(
                0.0, sigma * math.sqrt(1.0 - keep * keep)
            )
        w = self._turbulence
        return (1.0 + share * self._gust[0] + w[0], share * self._gust[1] + w[1], w[2])


class _Pilot:
    """Setpoints that change hard every second or so, within a box of 12 m."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._until = 0.0
        self._kind, self._yaw, self._spin = "hold", 0.0, 0.0
        self._target = [0.0, 0.0, -20.0]
        self._velocity = (0.0, 0.0)

    def setpoint(self, t: float, position: Vec3, yaw: float) -> TrajectorySetpoint:
        rng = self._rng
        if t > self._until:
            self._until = t + rng.uniform(0.6, 2.5)
            self._kind = rng.choice(("hold", "step", "velocity", "velocity", "brake"))
            self._spin = rng.choice((0.0, 0.0, 1.5, -3.0, 3.0))
            self._target = [rng.uniform(-6.0, 6.0), rng.uniform(-6.0, 6.0), rng.uniform(-25.0, -15.0)]
            speed, angle = rng.uniform(2.0, 5.0), rng.uniform(0.0, 2.0 * math.pi)
            self._velocity = (speed * math.cos(angle), speed * math.sin(angle))
            if math.hypot(position[0], position[1]) > 6.0:
                self._kind = "step"
        self._yaw = yaw + 0.3 * self._spin  # ahead of the vehicle: it turns at about this rate
        z = self._target[2]
        if self._kind == "step":
            return TrajectorySetpoint((self._target[0], self._target[1], z), yaw=self._yaw)
        if self._kind == "velocity":
            return TrajectorySetpoint((_NAN, _NAN, z), (*self._velocity, _NAN), yaw=self._yaw)
        if self._kind == "brake":
            return TrajectorySetpoint((_NAN, _NAN, z), (0.0, 0.0, _NAN), yaw=self._yaw)
        return TrajectorySetpoint((0.0, 0.0, z), yaw=self._yaw)


class _Flight:
    """One flight: vehicle, link with its faults, estimator and detector."""

    def __init__(self, mission: Mission, sigma: float, seed: int) -> None:
        self.rng = random.Random(seed)
        vehicle = mission.vehicle
        plant = Plant(_plant_vehicle(vehicle, sigma, self.rng), (), MissionFrame())
        self.autopilot = Autopilot(plant, seed)
        self.senses, self.expected = Senses(vehicle), ExpectedContact()
        self.senses.state.anchor(MissionFrame())
        mode = self.rng.choice(list(Mode))
        plant.set_mode(mode)
        self._sense(LockState(0, LockPhase.SETTLED, mode))
        self.pilot, self.weather = _Pilot(self.rng), _Weather(self.rng)
        self.late: list[tuple[int, ImuSample]] = []
        self.freeze = 0
        self.max_tilt = 0.0

    def tick(self) -> list[object]:
        """Advance by 4 ms; return the detector's events."""
        a = self.autopilot
        a.plant.wind_ned = self.weather.at(a.now_s)
        a.step()
        t, e = a.time_us, a.estimator
        self.max_tilt = max(self.max_tilt, self.senses.state.tilt_rad)
        if (t // 4000) % 2 == 0 and self.rng.random() > 0.02 and self.freeze <= 0:
            self._sense(AttitudeSample(t // 1000 * 1000, t + 1000, e.q))
            self._sense(OdometrySample(t, t + 1000, e.position, e.velocity))
            self._sense(ActuatorSample(t + 1500, t + 1500, a.motors))
        self.freeze -= 1
        if self.freeze < -500 and self.rng.random() < 0.002:
            self.freeze = self.rng.randrange(3, 12)  # all streams but the IMU pause for up to 50 ms
        if (t // 4000) % 25 == 0:
            self._sense(StatusSample(t, t, a.armed, a.mode, a.landed, e.ok))
        return self._imu(t)

    def _imu(self, t: int) -> list[object]:
        """Process the IMU sample; 1 % are lost and 1 % arrive a tick late, after the next one."""
        a = self.autopilot
        sample = ImuSample(a.imu.t_us, t + 1000, a.imu.specific_force_frd, a.imu.rate_frd)
        fate = self.rng.random()
        if fate < 0.01:
            return []
        if fate < 0.02:
            self.late.append((t, sample))
            return []
        events = self._sense(sample)
        while self.late:
            events += self._sense(self.late.pop(0)[1])
        return events

    def _sense(self, item: Input) -> list[object]:
        return list(self.senses.update(item, self.expected).impacts)


def fly_quiet(mission: Mission, seconds: float, sigma: float, seed: int) -> QuietFlight:
    """Fly hard without contact; `sigma` is the IMU noise in m/s2 per sample."""
    f = _Flight(mission, sigma, seed)
    a = f.autopilot
    out = QuietFlight([], 0.0, 0.0)
    for _ in range(round(seconds / 0.004)):
        _fly(f)
        # Like the executive, expect no contact on the ground or in the first half metre of the climb.
        in_air = f.senses.state.status.landed is LandedState.IN_AIR and a.mode is FlightMode.OFFBOARD
        f.expected = ExpectedContact(in_air and a.estimator.position[2] < -0.5)
        for event in f.tick():
            if isinstance(event, ImpactOnset):
                force = math.hypot(event.force_mission[0], event.force_mission[1])
                tilt_deg = math.degrees(f.senses.state.tilt_rad)
                out.false_hits.append(f"{a.now_s:.2f} s: {force:.1f} N, tilt {tilt_deg:.0f} deg")
        b, w = a.vehicle.airframe.drag_per_s, a.plant.wind_ned
        force = mission.vehicle.airframe.mass_kg * math.hypot(b[0] * w[0], b[1] * w[1])
        out.wind_force_n = max(out.wind_force_n, force)
    out.max_tilt_deg = math.degrees(f.max_tilt)
    return out


def _fly(f: _Flight) -> None:
    """Take off and fly hard."""
    a = f.autopilot
    if not a.armed:
        a.set_trajectory(TrajectorySetpoint((0.0, 0.0, -20.0)))
        if a.estimator.ok and a.set_mode(FlightMode.OFFBOARD):
            a.arm()
        return
    a.set_trajectory(f.pilot.setpoint(a.now_s, a.estimator.position, yaw_ned_of(a.estimator.q)))
