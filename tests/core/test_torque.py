"""Torque estimate, the lever of the IMU, side and incidence, and a sample of the campaign `torque`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import IDENTITY, MissionFrame, Vec3, advance_attitude, norm
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ContactRequest,
    ContactSide,
    ImpactBody,
    ImpactPeak,
    ImuSample,
    LandedState,
    LockPhase,
    LockState,
    Mode,
    OdometrySample,
    StatusSample,
    TorqueEstimate,
    TruthContact,
)
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.angular_motion import AngularMotion
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.senses import Senses
from dart_flight.core.sense.thrust_model import ThrustModel
from dart_flight.core.sense.torque import _ADDED, _MAX_SLOW_NM, _NOISE_TIME_S, _SLOW_S, TorqueEstimator
from dart_flight.planning.contact_fit import ContactFitter
from dart_flight.sim.plant import Plant
from tests.core.conftest import HOVER, known
from tests.shared_campaigns import campaign_rows
from tests.shared_flights import SharedFlights
from tests.sim.plants import VEHICLE, WALL, before_the_wall, body_vehicle

MASS, DT_S = VEHICLE.airframe.mass_kg, 0.004
NO_CONTACT = ExpectedContact()
component = st.floats(-3.0, 3.0)
vectors = st.tuples(component, component, component)


# --- rotation -------------------------------------------------------------------------------------------


@given(force=vectors, rate=vectors, change=vectors, at=vectors)
def test_the_lever_of_the_imu_is_compensated_in_any_rotation(
    force: Vec3, rate: Vec3, change: Vec3, at: Vec3
) -> None:
    """Against alpha x r + w x (w x r) by numpy, with w and alpha the means over the tick."""
    turning = AngularMotion()
    before = np.subtract(rate, np.multiply(0.002, change))
    after = np.add(rate, np.multiply(0.002, change))
    for t_us, w in ((4000, before), (8000, after)):
        turning.update(ImuSample(t_us, t_us, (0.0, 0.0, 0.0), (float(w[0]), float(w[1]), float(w[2]))))
    reading = np.add(force, np.add(np.cross(change, at), np.cross(rate, np.cross(rate, at))))
    found = turning.at_centre((float(reading[0]), float(reading[1]), float(reading[2])), at)
    assert found == pytest.approx(force, abs=1e-9)


def test_a_gap_in_the_stream_gives_no_rotation() -> None:
    turning = AngularMotion()
    turning.update(ImuSample(4000, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    turning.update(ImuSample(304_000, 0, (0.0, 0.0, 0.0), (5.0, 0.0, 0.0)))
    assert not turning.known
    assert turning.acceleration == (0.0, 0.0, 0.0)
    assert TorqueEstimator(VEHICLE).estimate(304_000, turning, None, 1.0, False) is None


def force_while_spinning(vehicle: VehicleConfig, at: Vec3) -> list[float]:
    """Return the horizontal force estimates of a vehicle that spins at up to 8 rad/s in a hover, newton."""
    senses = Senses(vehicle)
    senses.state.anchor(MissionFrame())
    senses.update(StatusSample(0, 0, landed=LandedState.ON_GROUND), NO_CONTACT)  # where nothing is learnt
    q, forces, last = IDENTITY, [], 0.0
    for i in range(250):
        t = 1_000_000 + 4000 * i
        rate = 8.0 * min(1.0, max(0.0, (i - 100) / 100))
        mean, change = 0.5 * (rate + last), (rate - last) / 0.004
        last = rate
        q = advance_attitude(q, (0.0, 0.0, mean), 0.004)
        senses.update(AttitudeSample(t, t, q), NO_CONTACT)
        senses.update(OdometrySample(t, t, (0.0, 0.0, -1.0), (0.0, 0.0, 0.0)), NO_CONTACT)
        senses.update(ActuatorSample(t, t, (HOVER,) * 4), NO_CONTACT)
        x, y, _ = at
        force = (-change * y - mean * mean * x, change * x - mean * mean * y, -9.81)
        estimate = known(senses.update(ImuSample(t, t, force, (0.0, 0.0, rate)), NO_CONTACT).estimate)
        forces.append(math.hypot(estimate.force_mission[0], estimate.force_mission[1]))
    return forces


def test_a_spinning_vehicle_measures_no_friction() -> None:
    at = (0.05, -0.03, 0.0)
    known = msgspec.structs.replace(VEHICLE, imu=msgspec.structs.replace(VEHICLE.imu, position_m=at))
    assert max(force_while_spinning(known, at)) < 0.05
    # Without the position of the IMU, there is a spurious force of m w^2 r.
    assert max(force_while_spinning(VEHICLE, at)) == pytest.approx(MASS * 64.0 * math.hypot(*at[:2]), rel=0.1)


# --- torque against the plant ---------------------------------------------------------------------------


class SensedHit(NamedTuple):
    """Estimates and truth of a simulated hit, without noise."""

    torques: list[TorqueEstimate]
    true: list[Vec3]  # mean over the same ticks
    bodies: list[ImpactBody]
    peaks: list[ImpactPeak]
    contact: TruthContact | None


def sense_hit(
    plant: Plant,
    vehicle: VehicleConfig,
    commands: tuple[float, float, float, float],
    heading_rad: float = 0.0,
) -> SensedHit:
    """Fly a plant past its first contact and feed its IMU to the senses."""
    senses, fitter, frame = Senses(vehicle), ContactFitter(vehicle), MissionFrame(heading_rad=heading_rad)
    senses.state.anchor(frame)
    nx, ny, _ = frame.vector_from_ned(plant.frame.vector_to_ned((*WALL.normal, 0.0)))
    wall = msgspec.structs.replace(WALL, normal=(nx, ny))
    expected = ExpectedContact(True, (nx, ny), WALL.material, wall)
    senses.update(StatusSample(0, 0, landed=LandedState.IN_AIR), expected)
    senses.update(LockState(0, LockPhase.SETTLED, plant.mode), expected)
    out = SensedHit([], [], [], [], None)
    while plant.time_s < 0.6:
        reading, sums = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        for _ in range(4):
            part = plant.advance(commands, 1)
            reading = [reading[i] + 0.25 * part[i] for i in range(3)]
            sums = [sums[i] + 0.25 * plant.contact_torque_frd[i] for i in range(3)]
        t = 1_000_000 + round(plant.time_s * 1e6)
        senses.update(AttitudeSample(t, t, plant.q), expected)
        senses.update(OdometrySample(t, t, plant.position, plant.velocity), expected)
        senses.update(ActuatorSample(t, t, commands), expected)
        sensed = senses.update(ImuSample(t, t, (reading[0], reading[1], reading[2]), plant.rate), expected)
        if sensed.torque is None:
            continue
        out.torques.append(sensed.torque)
        out.true.append((sums[0], sums[1], sums[2]))
        out.peaks.extend(e for e in sensed.impacts if isinstance(e, ImpactPeak))
        for request in sensed.contact:
            if isinstance(request, ContactRequest):
                answer = fitter.answer(request)
                out.bodies.append(known(answer.body))
    return out._replace(contact=plant.finished[0] if plant.finished else None)


@pytest.mark.parametrize("yaw", [-0.12, 0.03, 0.09])
@pytest.mark.parametrize("mode", list(Mode))
def test_the_estimated_torque_matches_the_torque_of_the_wall(mode: Mode, yaw: float) -> None:
    # Folding arms move their motors, which causes an unknown torque that no wall exerts.
    vehicle = body_vehicle(fold_share=0.0)
    sensed = sense_hit(before_the_wall(vehicle, mode, -1.0, 0.4, yaw), vehicle, (HOVER,) * 4)
    top = max(norm(t) for t in sensed.true)
    assert top > 0.5
    worst = max(math.dist(e.torque_frd, t) for e, t in zip(sensed.torques, sensed.true, strict=True))
    # The remaining error is timing: means of the truth over 4 ms are compared at their ends.
    assert worst < 0.1 * top
    assert sensed.contact is not None
    last = sensed.bodies[-1]
    assert last.peak_torque_nm == pytest.approx(sensed.contact.peak_torque_nm, rel=0.1, abs=0.15)
    assert last.incidence_rad == pytest.approx(sensed.contact.incidence_rad, abs=math.radians(1.0))
    assert last.lead_m * sensed.contact.lead_m > 0.0
    assert last.side is ContactSide.from_lead(sensed.contact.lead_m)


@pytest.mark.parametrize("heading_rad", [0.4, -1.1])
def test_contact_estimates_do_not_depend_on_the_mission_heading(heading_rad: float) -> None:
    vehicle = body_vehicle()
    one, other = (
        sense_hit(before_the_wall(vehicle, Mode.RIGID, -1.0, 0.3, 0.06), vehicle, (HOVER,) * 4, heading)
        for heading in (0.0, heading_rad)
    )
    assert one.bodies
    for a, b in zip(one.bodies, other.bodies, strict=True):
        assert b.incidence_rad == pytest.approx(a.incidence_rad, abs=1e-6)
        assert b.torque_peak_frd == pytest.approx(a.torque_peak_frd, abs=1e-6)


@pytest.mark.parametrize("mode", list(Mode))
def test_a_centred_hit_has_no_torque(mode: Mode) -> None:
    vehicle = body_vehicle(vertical_lever_m=0.0, fold_share=0.0)
    sensed = sense_hit(before_the_wall(vehicle, mode, -1.0, 0.0, 0.0), vehicle, (HOVER,) * 4)
    assert max(norm(e.torque_frd) for e in sensed.torques) < 1e-6
    assert [body.side for body in sensed.bodies] == [ContactSide.BOTH]
    assert sensed.bodies[-1].peak_torque_nm < 1e-3


@settings(max_examples=8, deadline=None)
@given(
    yaw=st.floats(-0.15, 0.15),
    normal=st.floats(-1.5, -0.5),
    tangential=st.floats(-0.5, 0.5),
    mode=st.sampled_from(list(Mode)),
)
@pytest.mark.rest
def test_a_mirrored_hit_gives_mirrored_estimates(
    yaw: float, normal: float, tangential: float, mode: Mode
) -> None:
    """The mirror image of a hit has the other side, the opposite incidence and the opposite yaw torque."""
    vehicle = body_vehicle()
    one = sense_hit(before_the_wall(vehicle, mode, normal, tangential, yaw), vehicle, (HOVER,) * 4)
    other = sense_hit(before_the_wall(vehicle, mode, normal, -tangential, -yaw), vehicle, (HOVER,) * 4)
    assert one.bodies
    for a, b in zip(one.bodies, other.bodies, strict=True):
        assert b.incidence_rad == pytest.approx(-a.incidence_rad, abs=1e-4)
        assert b.peak_torque_nm == pytest.approx(a.peak_torque_nm, rel=1e-3, abs=1e-4)
    for x, y in zip(one.torques, other.torques, strict=True):
        assert y.torque_frd[2] == pytest.approx(-x.torque_frd[2], abs=1e-6)


def test_a_contact_on_the_right_is_reported_as_right() -> None:
    """Yawed to the left, the right guard hits first and is pushed back: the vehicle yaws to the right."""
    vehicle = body_vehicle()
    # The wall is to the north; a yaw of -5 degrees (FRD) is to the left.
    sensed = sense_hit(
        before_the_wall(vehicle, Mode.RIGID, -1.0, 0.0, -math.radians(5.0)), vehicle, (HOVER,) * 4
    )
    last = sensed.bodies[-1]
    assert (last.side, last.lead_m > 0.0, last.incidence_rad > 0.0) == (ContactSide.RIGHT, True, True)
    assert last.torque_peak_frd[2] > 1.0


@pytest.mark.parametrize(
    "difference", [(0.05, -0.05, -0.05, 0.05), (0.05, -0.05, 0.05, -0.05), (0.05, 0.05, -0.05, -0.05)]
)
def test_motor_torques_are_not_external_torques(difference: tuple[float, float, float, float]) -> None:
    """Roll, pitch and yaw come from the motors alone."""
    plant = Plant(VEHICLE, (), MissionFrame())
    plant.position, plant.ground_down, plant.motor = (0.0, 0.0, -50.0), 100.0, [HOVER] * 4
    torque, thrust = TorqueEstimator(VEHICLE), ThrustModel(VEHICLE)
    turning, largest, motors = AngularMotion(), 0.0, 0.0
    for i in range(100):
        t = 1_000_000 + 4000 * i
        sign = 1.0 if i // 10 % 2 == 0 else -1.0
        commands = tuple(HOVER + sign * d for d in difference)
        a, b, c, d = commands
        thrust.add_commands(ActuatorSample(t, t, (a, b, c, d)))
        plant.advance((a, b, c, d), 4)
        turning.update(ImuSample(t + 4000, t, (0.0, 0.0, 0.0), plant.rate))
        thrust.mean_over_tick(t + 4000)
        found = torque.estimate(t + 4000, turning, thrust.each_n, 1.0, learns=False)
        if found is not None and i > 45:  # skip the transient of the first commands
            largest = max(largest, norm(found.torque_frd))
            j = VEHICLE.airframe.inertia_kg_m2
            motors = max(motors, *(abs(j[k] * turning.acceleration[k]) for k in range(3)))
    assert motors > 0.01
    assert largest < 0.1 * motors


def test_a_constant_torque_is_learned_and_subtracted() -> None:
    """The centre of mass is 5 mm ahead of the motors' centre; gyro noise adds noise to the torque."""
    rng = np.random.default_rng(8)
    torque, turning = TorqueEstimator(VEHICLE), AngularMotion()
    each = tuple(MASS * 9.81 / 4.0 + d for d in (-0.12, 0.12, -0.12, 0.12))
    a, b, c, d = each
    estimates = []
    for i in range(2000):
        t = 1_000_000 + 4000 * i
        x, y, z = rng.normal(0.0, 0.01, 3)
        turning.update(ImuSample(t, t, (0.0, 0.0, -9.81), (float(x), float(y), float(z))))
        found = torque.estimate(t, turning, (a, b, c, d), 1.0, True)
        if found is not None:
            estimates.append(found)
    assert abs(np.mean([s.torque_frd[1] for s in estimates[:50]])) > 0.03
    late = np.array([s.torque_frd for s in estimates[1000:]])
    assert np.abs(late.mean(axis=0)).max() < 0.005
    inertia = VEHICLE.airframe.inertia_kg_m2
    for k in range(3):
        white = inertia[k] * math.sqrt(2.0) * 0.01 / 0.004
        assert late[:, k].std() == pytest.approx(white, rel=0.1)
        assert estimates[-1].noise_frd_nm[k] == pytest.approx(white, rel=0.25)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_lasting_torque_beyond_the_learning_limit_stays_visible(axis: int, sign: float) -> None:
    torque, turning, found = TorqueEstimator(VEHICLE), AngularMotion(), list[float]()
    lasting_nm = sign * (_MAX_SLOW_NM + 0.2)
    for i in range(2000):
        t, rate = 1_000_000 + 4000 * i, [0.0, 0.0, 0.0]
        rate[axis] = lasting_nm / VEHICLE.airframe.inertia_kg_m2[axis] * DT_S * i
        turning.update(ImuSample(t, t, (0.0, 0.0, -9.81), (rate[0], rate[1], rate[2])))
        estimate = torque.estimate(t, turning, None, 1.0, True)
        if estimate is not None:
            found.append(estimate.torque_frd[axis])
    assert found[0] == pytest.approx(lasting_nm, rel=0.01)
    assert found[-1] == pytest.approx(sign * 0.2, abs=0.01)


def test_constant_torque_and_noise_are_learned_at_their_rates() -> None:
    torque, turning = TorqueEstimator(VEHICLE), AngularMotion()
    jx = VEHICLE.airframe.inertia_kg_m2[0]
    estimates = []
    for t_us, rate in ((1_000_000, 0.0), (1_004_000, 0.02), (1_008_000, 0.04), (1_012_000, 0.06)):
        turning.update(ImuSample(t_us, t_us, (0.0, 0.0, -9.81), (rate, 0.0, 0.0)))
        found = torque.estimate(t_us, turning, None, 1.0, learns=True)
        if found is not None:
            estimates.append(found)
    kept = 1.0
    for i, found in enumerate(estimates):
        kept *= 1.0 - DT_S / _SLOW_S
        assert found.torque_frd[0] == pytest.approx(kept * jx * 5.0)
        variance = 1e-3
        for _ in range(i):
            variance = variance * (1.0 - DT_S / _NOISE_TIME_S) + _ADDED
        assert found.noise_frd_nm == pytest.approx((math.sqrt(variance),) * 3, rel=1e-3 if i == 0 else 1e-9)


def test_a_hit_of_a_body_is_not_fitted_with_the_pulse_of_a_point() -> None:
    """If one guard leads, the fitted pulse would be 5 % too low, but the sampled peak is correct."""
    vehicle = body_vehicle()
    # As learned in a second of quiet flight.
    quiet = msgspec.structs.replace(vehicle.estimation, imu_noise_m_s2=0.2)
    vehicle = msgspec.structs.replace(vehicle, estimation=quiet)
    hit = sense_hit(before_the_wall(vehicle, Mode.RIGID, -1.2, 0.0, 0.1), vehicle, (HOVER,) * 4)
    assert hit.contact is not None
    assert not hit.peaks[0].fitted
    assert hit.peaks[0].normal_force_n == pytest.approx(hit.contact.peak_normal_force_n, rel=0.03)


# --- flights --------------------------------------------------------------------------------------------


def test_the_verdict_reports_incidence_side_and_torque(flown: SharedFlights) -> None:
    verdict = flown("paper_single_wall", 2).verdict
    measured, truth = verdict.collisions[0].measured, verdict.collisions[0].truth
    assert truth is not None
    assert measured.incidence_deg == pytest.approx(known(truth.incidence_deg), abs=2.0)
    assert measured.contact_side is not None
    assert measured.peak_torque_nm is not None
    assert verdict.collisions[0].planned.contact_side is None


@pytest.mark.rest
def test_a_sample_of_the_torque_campaign_stays_within_its_error_limits(tmp_path: Path) -> None:
    """The walls differ from the plan; the seeds differ from those of the published results."""
    rows = campaign_rows(tmp_path / "out", "torque", "--only", "set=off", "--seed", "2201", "--runs", "3")
    assert len(rows) == 3
    for row in rows:
        assert abs(row["torque_nm"] - row["true_torque_nm"]) <= max(0.15, 0.1 * row["true_torque_nm"])
        assert abs(row["lead_m"]) < 0.005 or row["side"] == ("right" if row["lead_m"] > 0.0 else "left")
        assert abs(row["incidence_rad"] - row["true_incidence_rad"]) < math.radians(1.5)
        assert abs(row["force_error"]) < 0.06


def test_a_change_across_a_gap_in_the_stream_is_no_noise() -> None:
    """The torque may change during a gap, so the samples on its two sides are not compared."""
    torque, turning = TorqueEstimator(VEHICLE), AngularMotion()
    rate, t_us, noise = 0.0, 0, list[Vec3]()
    for alpha, first_us in ((0.0, 1_000_000), (5.0, 3_000_000)):
        for i in range(100):
            t_us, rate = first_us + 4000 * i, rate + 0.004 * alpha
            turning.update(ImuSample(t_us, t_us, (0.0, 0.0, -9.81), (rate, 0.0, 0.0)))
            found = torque.estimate(t_us, turning, None, 1.0, learns=True)
            if found is not None:
                noise.append(found.noise_frd_nm)
    assert max(n[0] for n in noise[99:]) <= noise[98][0]
