"""What a contact says of its wall and of the arms: coefficients in either mode, and which mode it was.

Both modes are the same contact law with other coefficients, so both are fitted to the readings of the whole
contact (`contact_fit.py`), each from what is believed of the wall in that mode: the configuration's values
with their spread, later what the contacts before have left. What a mode says of the readings against the
other is their odds; where they are not sure, or no mode fits, it is undecided. A vehicle without a lock has
one mode: that is fitted, and there is nothing to tell apart.

Unlocked arms swing, and the IMU feels that. The force estimate has it taken out where the lock says
unlocked; a mode that the lock does not say gets its own readings. docs/felt.md.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from dart_flight.base.geometry import Vec2, rotate
from dart_flight.base.records import ContactEnd, ImpactOnset, LockPhase, Mode, WallEstimate
from dart_flight.base.walls import Wall
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.contact.law import Onset
from dart_flight.core.sense.arm_vibration import ArmFilter
from dart_flight.core.sense.contact_fit import (
    PLACE_M,
    WALL_RAD,
    Belief,
    Body,
    ContactFit,
    ContactReading,
    ObservedContact,
)
from dart_flight.core.sense.detector import Events, ExpectedContact
from dart_flight.core.sense.incidence import (
    ContactSample,
    ContactSampleBuffer,
    middle_of,
    seen_incidence,
)
from dart_flight.core.sense.state import FlightState

HIT_SCATTER: Final = 0.05  # of k, f, mu and nu from one hit to the next at the same wall, relative
SURE_LOG_ODDS: Final = 5.3  # 200 to 1; at most one mode in a thousand is wrong (docs/felt.md)
_BEFORE: Final = 4  # samples of the contact from before the first one that was over the noise
_FEWEST: Final = 4  # readings in contact
_SLOWEST_M_S: Final = 0.02
_POSITION_M: Final = 0.01  # deviation of PX4's position against the walls' frame
_UNKNOWN_SPREAD: Final = 0.8  # of the coefficients of a wall of unknown material, relative
_KNOWN_MATERIAL: Final = 6.0  # sum of three squared deviations: beyond it a wall is of no known material
_MET_SD_M: Final = 0.03  # of a plane that only the onset tells: late detection, and a body that is no circle
_MAX_MISFIT: Final = 2.0  # mean square of the residuals over their errors: beyond it this is no such contact


class WallEstimator:
    """Follows the planned contacts and says at the end of each what was felt of the wall.

    Args:
        vehicle: its body, and what is believed of the materials.
        samples: of force and torque; whoever owns them adds each before `take`.
    """

    def __init__(self, vehicle: VehicleConfig, samples: ContactSampleBuffer) -> None:
        self._vehicle, self._prior = vehicle, vehicle.estimation.walls
        a = vehicle.airframe
        self._body = Body(
            a.mass_kg,
            a.guard_along_m,
            a.contact_distance_m,
            Onset(vehicle.onset),
            vehicle.vertical_force_sign,
        )
        self._beliefs: dict[tuple[str, Mode], Belief] = {}
        self._samples = samples
        self._slow: Vec2 = (0.0, 0.0)
        self._onset: ImpactOnset | None = None
        self._wall: Wall | None = None
        self._reported: Mode | None = None
        self._job: _PendingEstimate | None = None

    @property
    def is_busy(self) -> bool:
        """Whether a contact is being judged, a little at every sample."""
        return self._job is not None

    def update(
        self, state: FlightState, slow: Vec2, events: Events, expected: ExpectedContact
    ) -> WallEstimate | None:
        """What the detector made of the newest sample's force; arguments as `IncidenceEstimator.update`."""
        for event in events:
            if isinstance(event, ImpactOnset):
                self._wall = expected.wall if event.planned else None
                self._onset, self._slow, self._job = event, slow, None
                lock = state.lock
                self._reported = lock.mode if lock.phase is LockPhase.SETTLED else None
            elif isinstance(event, ContactEnd) and self._onset is not None and self._wall is not None:
                self._job = self._begin(self._onset, self._wall, state)
                self._onset = None
        # A little at every sample, so that none of them waits for the whole.
        if self._job is None or self._job.advance():
            return None
        job, self._job = self._job, None
        return self._judge(job)

    def _begin(self, onset: ImpactOnset, wall: Wall, state: FlightState) -> _PendingEstimate:
        modes = self._vehicle.modes
        before = {mode: self._belief(wall, mode) for mode in modes}
        contacts = self._contacts(onset, wall, state)
        fits = (
            {}
            if contacts is None
            else {mode: ContactFit(contacts[mode], before[mode], HIT_SCATTER, self._body) for mode in modes}
        )
        return _PendingEstimate(self._samples.newest.force.t_us, onset, wall, self._reported, before, fits)

    def _judge(self, job: _PendingEstimate) -> WallEstimate:
        fits = {mode: found for mode, fit in job.fits.items() if (found := fit.result()) is not None}
        onset, wall, reported = job.onset, job.wall, job.reported
        odds, felt = 0.0, None
        if len(fits) == len(Mode):  # else there is nothing to tell apart
            best = min(fit.misfit for fit in fits.values())
            odds = (fits[Mode.RIGID].evidence - fits[Mode.FLEXIBLE].evidence) / max(1.0, best)
            if abs(odds) >= SURE_LOG_ODDS and best <= _MAX_MISFIT:
                felt = Mode.RIGID if odds > 0.0 else Mode.FLEXIBLE
        likely = Mode.RIGID if odds > 0.0 else self._vehicle.modes[-1]
        told = felt or reported or likely
        belief, fitted = job.before[told], fits.get(told)
        angle, offset = 0.0, 0.0
        place: Vec2 | None = None
        normal: Vec2 | None = None
        normal_sd: float | None = None
        offset_sd, angle_sd = _known(wall, onset)
        if wall.sought or wall.is_uncertain:  # at least where it was met is known
            place, normal, normal_sd = onset.position_mission[:2], wall.normal, wall.yaw_sd_rad
            offset, offset_sd = wall.signed_distance(place), _MET_SD_M
        if fitted is not None:
            belief = fitted.belief
            # Else the readings speak against the mode that the lock says, though not loudly enough.
            if told is likely:
                self._beliefs[wall.name, told] = belief
            angle, angle_sd = fitted.incidence_rad, fitted.incidence_sd
            contact = job.fits[told].contact
            back_s = (onset.t_us - contact.begin_us) * 1e-6
            there = wall.signed_distance(onset.position_mission) - contact.velocity[0] * back_s
            offset, offset_sd = there - fitted.place_m, math.hypot(fitted.place_sd, _POSITION_M)
            normal = wall.turned(contact.incidence_rad - fitted.incidence_rad).normal
            normal_sd = fitted.incidence_sd
            (x, y, _), (vx, vy, _), away = onset.position_mission, onset.velocity_mission, fitted.place_m
            place = (x - back_s * vx - away * normal[0], y - back_s * vy - away * normal[1])
        unknown = fitted is not None and not wall.material_known
        return WallEstimate(
            t_us=job.t_us,
            first_us=onset.first_us,
            wall=wall.name,
            mode_reported=reported,
            mode_felt=felt,
            log_odds=odds,
            k_n_per_m=belief.k,
            f_ns_per_m=belief.f,
            mu_s_per_m=belief.mu,
            nu_n=belief.nu,
            k_sd=belief.k_sd,
            f_sd=belief.f_sd,
            mu_sd=belief.mu_sd,
            nu_sd=belief.nu_sd,
            incidence_rad=angle,
            incidence_sigma_rad=angle_sd,
            plane_offset_m=offset,
            plane_offset_sigma_m=offset_sd,
            plane_point_mission=place,
            plane_normal_mission=normal,
            plane_normal_sigma_rad=normal_sd,
            centre_mission=_centre_at_touch(onset),
            material=self._likely_material(belief, told) if unknown else None,
        )

    def _likely_material(self, felt: Belief, mode: Mode) -> str | None:
        """The material of the table that the coefficients fit best; None where none does."""
        spread2 = self._prior.spread**2

        def misfit(name: str) -> float:
            c = self._vehicle.materials[name].of(mode)
            pairs = ((felt.k, felt.k_sd, c.k), (felt.f, felt.f_sd, c.f), (felt.mu, felt.mu_sd, c.mu))
            return sum(math.log(value / of) ** 2 / (sd * sd + spread2) for value, sd, of in pairs if of > 0.0)

        best = min(self._vehicle.materials, key=misfit)
        return best if misfit(best) <= _KNOWN_MATERIAL else None

    def _belief(self, wall: Wall, mode: Mode) -> Belief:
        found = self._beliefs.get((wall.name, mode))
        if found is not None:
            return found
        c, sd = self._vehicle.materials[wall.material].of(mode), self._prior.spread
        if not wall.material_known:
            c, sd = middle_of(m.of(mode) for m in self._vehicle.materials.values()), _UNKNOWN_SPREAD
        return Belief(c.k, c.f, c.mu, c.nu, sd, sd, sd, sd)

    def _contacts(
        self, onset: ImpactOnset, wall: Wall, state: FlightState
    ) -> dict[Mode, ObservedContact] | None:
        """The readings as each mode would have them; None where they are too few."""
        frame = state.frame
        before, inside = self._samples.since(onset.first_us, _BEFORE)
        samples = before + inside
        velocity = wall.to_collision(onset.velocity_mission)
        if frame is None or len(inside) < _FEWEST or velocity[0] > -_SLOWEST_M_S:
            return None
        tick_s = self._vehicle.imu.tick_s
        begin_us = samples[0].force.t_us - round((tick_s + self._vehicle.imu.filter_lag_s) * 1e6)
        touched_s = (onset.first_us - begin_us) * 1e-6 - 0.75 * tick_s
        seen = seen_incidence(frame, samples[0].q, wall.normal)
        taken_out = self._reported is not Mode.RIGID
        noise_n = max(1e-2, inside[0].force.noise_n)
        return {
            mode: ObservedContact(
                self._readings(samples, wall, taken_out, mode is Mode.FLEXIBLE),
                begin_us,
                touched_s,
                (velocity[0], velocity[1]),
                seen,
                noise_n,
                *_known(wall, onset),
                max(1e-4, abs(inside[0].torque.noise_frd_nm[2])),
            )
            for mode in self._vehicle.modes
        }

    def _readings(
        self, samples: list[ContactSample], wall: Wall, taken_out: bool, swings: bool
    ) -> list[ContactReading]:
        """The readings, with the arms' swinging taken out where they swing."""
        arms = self._vehicle.estimation.arm_vibration
        tick_s, mass = self._vehicle.imu.tick_s, self._body.mass
        turn = ArmFilter(arms, tick_s) if arms is not None and taken_out != swings else None
        nx, ny = wall.normal
        turned, last_us = 0.0, samples[0].force.t_us - round(tick_s * 1e6)
        ticks = []
        for sample in samples:
            force, torque, q, rate = sample.force, sample.torque, sample.q, sample.rate
            h = (force.t_us - last_us) * 1e-6
            last_us = force.t_us
            fx, fy = force.force_mission[0] - self._slow[0], force.force_mission[1] - self._slow[1]
            if turn is not None:
                ax, ay = fx / mass, fy / mass
                ax, ay = turn.remove(ax, ay, h) if swings else turn.add(ax, ay)
                fx, fy = mass * ax, mass * ay
            px, py = force.push_mission
            px, py = px + self._slow[0], py + self._slow[1]
            turning = -rotate(q, rate)[2]  # the mission's z points up
            turned += h * turning
            ticks.append(
                ContactReading(
                    h,
                    fx * nx + fy * ny,
                    fx * ny - fy * nx,
                    force.force_mission[2],
                    px * nx + py * ny,
                    px * ny - py * nx,
                    force.clipped,
                    turned - 0.5 * h * turning,
                    turning,
                    rotate(q, torque.torque_frd)[2],
                )
            )
        return ticks


def _centre_at_touch(onset: ImpactOnset) -> Vec2:
    """Where the vehicle's centre was when the force began, mission frame."""
    (x, y, _), (vx, vy, _) = onset.position_mission, onset.velocity_mission
    late_s = (onset.t_us - onset.first_us) * 1e-6
    return (x - late_s * vx, y - late_s * vy)


def _known(wall: Wall, onset: ImpactOnset) -> tuple[float, float]:
    """How well place (m) and direction (rad) of a wall are known before a contact."""
    place_sd = float(wall.plane_sd_m(onset.position_mission))
    return max(PLACE_M, place_sd), max(WALL_RAD, wall.yaw_sd_rad or 0.0)


class _PendingEstimate(NamedTuple):
    """A contact that is being judged.

    Attributes:
        t_us: newest sample that it rests on.
        onset: of the contact.
        wall: that was expected.
        reported: mode by the lock.
        before: what was believed.
        fits: none where the readings are too few.
    """

    t_us: int
    onset: ImpactOnset
    wall: Wall
    reported: Mode | None
    before: dict[Mode, Belief]
    fits: dict[Mode, ContactFit]

    def advance(self) -> bool:
        """A step of each fit; False once all have settled."""
        under_way = [fit.advance() for fit in self.fits.values()]
        return any(under_way)
