"""Recorder of a contact's samples: it requests a fit when the contact ends, and handles the answer.

The fit (`dart_flight.planning.contact_fit`) runs outside of the core's step. A `ContactRequest` goes out with
the other outputs. A `ContactAnswer` comes in like any other input, or never arrives. If a planned contact
gets no answer, the wall estimate contains neither the mode of the arms nor a fitted plane (`undecided`).
"""

from __future__ import annotations

from collections import deque
from typing import Final

import msgspec

from dart_flight.base.geometry import Quaternion, Vec2, Vec3
from dart_flight.base.records import (
    ContactAnswer,
    ContactEnd,
    ContactRequest,
    ForceEstimate,
    ImpactBody,
    ImpactOnset,
    ImpactPeak,
    LockPhase,
    TorqueEstimate,
    WallEstimate,
)
from dart_flight.base.walls import Wall
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.detector import Events, ExpectedContact
from dart_flight.core.sense.state import FlightState

ANSWER_WITHIN_US: Final = 300_000  # timeout of a fit; approaches from rest are planned later than this
_BEFORE: Final = 4  # samples kept before the first sample above the noise
_MAX: Final = 160  # limit of the samples kept for a contact
# Standard deviation of a plane located by the onset alone. Detection is late, and the body is not round.
_MET_SD_M: Final = 0.03


# One IMU sample of a contact: force, torque, attitude and body rate.
_Sample = tuple[ForceEstimate, TorqueEstimate, Quaternion, Vec3]


class ContactRecorder:
    """Samples of the current contact, the requests for its fit, and their answers.

    `unanswered` contains the requests without an answer, by number.
    """

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._vehicle = vehicle
        self._samples: deque[_Sample] = deque(maxlen=_MAX)
        self._begun: ContactRequest | None = None
        self._number = 0
        self.unanswered: dict[int, ContactRequest] = {}

    def add(self, force: ForceEstimate, torque: TorqueEstimate, q: Quaternion, rate_frd: Vec3) -> None:
        """Record the estimates of the next IMU sample, with attitude and body rate (rad/s, FRD)."""
        self._samples.append((force, torque, q, rate_frd))

    def update(
        self, state: FlightState, slow: Vec2, events: Events, expected: ExpectedContact
    ) -> ContactRequest | None:
        """Handle the detector's events at the newest sample, and return a request when a contact ends.

        `slow` is the slow horizontal force (`ForceBaseline`), mission frame, newton. `expected` is used only
        at the onset.
        """
        for event in events:
            if isinstance(event, ImpactOnset):
                self._begun = self._begin(event, state, slow, expected.wall if event.planned else None)
            elif isinstance(event, ImpactPeak) and self._begun is not None:
                self._begun = msgspec.structs.replace(self._begun, normal=event.normal)
            elif isinstance(event, ContactEnd) and self._begun is not None:
                return self._end(self._begun)
        return None

    def _begin(self, onset: ImpactOnset, state: FlightState, slow: Vec2, wall: Wall | None) -> ContactRequest:
        assert state.frame is not None
        self._number += 1
        force, torque, _, _ = self._samples[-1]
        return ContactRequest(
            t_us=onset.t_us,
            number=self._number,
            onset=onset,
            wall=wall,
            normal=(0.0, 0.0) if wall is None else wall.normal,
            mode_reported=state.lock.mode if state.lock.phase is LockPhase.SETTLED else None,
            frame_heading_rad=state.frame.heading_rad,
            slow_force=slow,
            noise_n=force.noise_n,
            noise_frd_nm=torque.noise_frd_nm,
        )

    def _end(self, begun: ContactRequest) -> ContactRequest:
        samples = list(self._samples)
        earlier = sum(force.t_us < begun.onset.first_us for force, *_ in samples)
        forces, torques, attitudes, rates = zip(*samples[max(0, earlier - _BEFORE) :], strict=True)
        request = msgspec.structs.replace(
            begun,
            t_us=forces[-1].t_us,
            sample_us=tuple([force.t_us for force in forces]),
            force_mission=tuple([force.force_mission for force in forces]),
            push_mission=tuple([force.push_mission for force in forces]),
            clipped=tuple([force.clipped for force in forces]),
            torque_frd=tuple([torque.torque_frd for torque in torques]),
            q_frd_to_ned=attitudes,
            rate_frd=rates,
        )
        self.unanswered[request.number], self._begun = request, None
        return request

    def accept(self, answer: ContactAnswer) -> tuple[ImpactBody | None, WallEstimate | None]:
        """Return the body and wall records of an answer, or (None, None) if the answer has no request."""
        request = self.unanswered.pop(answer.number, None)
        if request is None:
            return None, None
        if request.wall is None:
            return answer.body, None
        if answer.wall is None or answer.wall.wall != request.wall.name:
            return answer.body, undecided(
                request, request.wall, self._vehicle, answer.problem or "no estimate"
            )
        return answer.body, answer.wall

    def overdue(self, now_us: int) -> WallEstimate | None:
        """Return the undecided estimate if the answer for a contact is late, once for each contact."""
        for number, request in self.unanswered.items():
            if now_us - request.t_us > ANSWER_WITHIN_US:
                del self.unanswered[number]
                wall, late = request.wall, f"no answer within {ANSWER_WITHIN_US * 1e-3:.0f} ms"
                return None if wall is None else undecided(request, wall, self._vehicle, late)
        return None


def undecided(request: ContactRequest, wall: Wall, vehicle: VehicleConfig, problem: str = "") -> WallEstimate:
    """Return a wall estimate without a fit.

    The estimate uses the configured coefficients and the known plane. If the plane is uncertain, or
    a probe searches for the wall, the plane of the estimate passes through the point of contact.
    """
    onset, mode = request.onset, request.mode_reported or vehicle.modes[-1]
    c, sd = vehicle.materials[wall.material].coefficients(mode), vehicle.estimation.walls.spread
    is_met = wall.sought or wall.is_uncertain
    (x, y, _), (vx, vy, _) = onset.position_mission, onset.velocity_mission
    place, late_s = (x, y), (onset.t_us - onset.first_us) * 1e-6
    return WallEstimate(
        t_us=request.t_us,
        first_us=onset.first_us,
        wall=wall.name,
        mode_reported=request.mode_reported,
        mode_felt=None,
        log_odds=0.0,
        k_n_per_m=c.k,
        f_ns_per_m=c.f,
        mu_s_per_m=c.mu,
        nu_n=c.nu,
        k_sd=sd,
        f_sd=sd,
        mu_sd=sd,
        nu_sd=sd,
        incidence_rad=0.0,
        incidence_sigma_rad=wall.yaw_sd_rad or 0.0,
        plane_offset_m=wall.signed_distance(place) if is_met else 0.0,
        plane_offset_sigma_m=_MET_SD_M if is_met else float(wall.plane_sd_m(place)),
        plane_point_mission=place if is_met else None,
        plane_normal_mission=wall.normal if is_met else None,
        plane_normal_sigma_rad=wall.yaw_sd_rad if is_met else None,
        centre_mission=(x - late_s * vx, y - late_s * vy),
        problem=problem,
    )
