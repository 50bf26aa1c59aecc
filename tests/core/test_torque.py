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
from dart_flight.core.sense import detector
from dart_flight.core.sense.angular_motion import AngularMotion
from dart_flight.core.sense.contact_recorder import ContactRecorder
from dart_flight.core.sense.detector import ExpectedContact, ImpactDetector
from dart_flight.core.sense.force import ForceEstimator
from dart_flight.core.sense.state import FlightState
from dart_flight.core.sense.torque import TorqueEstimator
from dart_flight.planning.contact_fit import ContactFitter
from dart_flight.sim.plant import Plant
from tests.core.conftest import HOVER
from tests.shared_campaigns import campaign_rows
from tests.shared_flights import SharedFlights
from tests.sim.test_body import WALL, before_the_wall, body_vehicle
from tests.sim.test_plant import VEHICLE

MASS = VEHICLE.airframe.mass_kg
component = st.floats(-3.0, 3.0)
vectors = st.tuples(component, component, component)


# --- turning ------------------------------------------------------------------------------------------


@given(force=vectors, rate=vectors, change=vectors, at=vectors)
def test_the_lever_is_taken_out_of_any_turning(force: Vec3, rate: Vec3, change: Vec3, at: Vec3) -> None:
    """Against alpha x r + w x (w x r) by numpy, with w and alpha the means over the tick."""
    turning = AngularMotion()
    before = np.subtract(rate, np.multiply(0.002, change))
    after = np.add(rate, np.multiply(0.002, change))
    for t_us, w in ((4000, before), (8000, after)):
        turning.update(ImuSample(t_us, t_us, (0.0, 0.0, 0.0), (float(w[0]), float(w[1]), float(w[2]))))
    reading = np.add(force, np.add(np.cross(change, at), np.cross(rate, np.cross(rate, at))))
    found = turning.at_centre((float(reading[0]), float(reading[1]), float(reading[2])), at)
    assert found == pytest.approx(force, abs=1e-9)


def test_a_gap_is_no_turning() -> None:
    turning = AngularMotion()
    turning.update(ImuSample(4000, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    turning.update(ImuSample(304_000, 0, (0.0, 0.0, 0.0), (5.0, 0.0, 0.0)))
    assert not turning.known
    assert turning.acceleration == (0.0, 0.0, 0.0)
    assert TorqueEstimator(VEHICLE).estimate(304_000, turning, None, 1.0, False) is None


def felt_while_spinning(vehicle: VehicleConfig, at: Vec3) -> list[float]:
    """Horizontal force felt by a hovering vehicle that spins up to 8 rad/s about the vertical, newton."""
    state, estimator = FlightState(), ForceEstimator(vehicle)
    state.frame = MissionFrame()
    state.status = StatusSample(0, 0, landed=LandedState.IN_AIR)
    q, felt, last, turning = IDENTITY, [], 0.0, AngularMotion()
    for i in range(250):
        t = 1_000_000 + 4000 * i
        rate = 8.0 * min(1.0, max(0.0, (i - 100) / 100))
        mean, change = 0.5 * (rate + last), (rate - last) / 0.004
        last = rate
        q = advance_attitude(q, (0.0, 0.0, mean), 0.004)
        state.update_attitude(AttitudeSample(t, t, q))
        estimator.add_attitude(AttitudeSample(t, t, q))
        state.update_odometry(OdometrySample(t, t, (0.0, 0.0, -1.0), (0.0, 0.0, 0.0)))
        estimator.thrust.add_commands(ActuatorSample(t, t, (HOVER,) * 4))
        x, y, _ = at
        force = (-change * y - mean * mean * x, change * x - mean * mean * y, -9.81)
        imu = ImuSample(t, t, force, (0.0, 0.0, rate))
        turning.update(imu)
        estimate = estimator.estimate(imu, state, in_contact=True)
        assert estimate is not None
        felt.append(math.hypot(estimate.force_mission[0], estimate.force_mission[1]))
    return felt


def test_a_turning_body_is_not_taken_for_friction() -> None:
    at = (0.05, -0.03, 0.0)
    known = msgspec.structs.replace(VEHICLE, imu=msgspec.structs.replace(VEHICLE.imu, position_m=at))
    assert max(felt_while_spinning(known, at)) < 0.05
    # Without the position it would be a force of m w^2 r along the wall and into it.
    assert max(felt_while_spinning(VEHICLE, at)) == pytest.approx(MASS * 64.0 * math.hypot(*at[:2]), rel=0.1)


# --- torque against the plant ---------------------------------------------------------------------------


class Met(NamedTuple):
    """A simulated hit as the senses see it, without noise."""

    torques: list[TorqueEstimate]
    true: list[Vec3]  # mean over the same ticks
    bodies: list[ImpactBody]
    peaks: list[ImpactPeak]
    contact: TruthContact | None


def sense(
    plant: Plant,
    vehicle: VehicleConfig,
    commands: tuple[float, float, float, float],
    heading_rad: float = 0.0,
) -> Met:
    """Fly a plant past its first contact and give its IMU to the senses; `heading_rad`: the mission's."""
    state = FlightState()
    state.frame = frame = MissionFrame(heading_rad=heading_rad)
    state.status = StatusSample(0, 0, landed=LandedState.IN_AIR)
    state.lock = LockState(0, LockPhase.SETTLED, plant.mode)
    force, torque = ForceEstimator(vehicle), TorqueEstimator(vehicle)
    detector, contacts, fitter = ImpactDetector(vehicle), ContactRecorder(vehicle), ContactFitter(vehicle)
    nx, ny, _ = frame.vector_from_ned(plant.frame.vector_to_ned((*WALL.normal, 0.0)))
    wall = msgspec.structs.replace(WALL, normal=(nx, ny))
    expected = ExpectedContact(True, (nx, ny), WALL.material, wall)
    out = Met([], [], [], [], None)
    touched = False
    while plant.time_s < 0.6:
        reading, sums = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        for _ in range(4):
            part = plant.advance(commands, 1)
            reading = [reading[i] + 0.25 * part[i] for i in range(3)]
            sums = [sums[i] + 0.25 * plant.contact_torque_frd[i] for i in range(3)]
        t = 1_000_000 + round(plant.time_s * 1e6)
        touched = touched or plant.in_contact
        attitude = AttitudeSample(t, t, plant.q)
        state.update_attitude(attitude)
        force.add_attitude(attitude)
        state.update_odometry(OdometrySample(t, t, plant.position, plant.velocity))
        force.thrust.add_commands(ActuatorSample(t, t, commands))
        imu = ImuSample(t, t, (reading[0], reading[1], reading[2]), plant.rate)
        state.update_imu(imu)
        estimate = force.estimate(imu, state, detector.in_contact)
        each = force.thrust.each_n
        found = torque.estimate(t, force.turning, each, 1.0, not touched)
        if estimate is None or found is None or force.attitude is None:
            continue
        out.torques.append(found)
        out.true.append((sums[0], sums[1], sums[2]))
        events = detector.update(estimate, t, state, expected)
        out.peaks.extend(e for e in events if isinstance(e, ImpactPeak))
        contacts.add(estimate, found, force.attitude, force.turning.rate)
        request = contacts.update(state, (0.0, 0.0), events, expected)
        if request is not None:
            answer = fitter.answer(request, 0)
            assert answer.body is not None, answer.problem
            out.bodies.append(answer.body)
    return out._replace(contact=plant.finished[0] if plant.finished else None)


@pytest.mark.parametrize("yaw", [-0.12, 0.03, 0.09])
@pytest.mark.parametrize("mode", list(Mode))
def test_torque_is_the_walls(mode: Mode, yaw: float) -> None:
    # Arms that fold take their motors along: a torque that no wall exerts, and that is not known.
    vehicle = body_vehicle(fold_share=0.0)
    seen = sense(before_the_wall(vehicle, mode, -1.0, 0.4, yaw), vehicle, (HOVER,) * 4)
    top = max(norm(t) for t in seen.true)
    assert top > 0.5
    worst = max(math.dist(e.torque_frd, t) for e, t in zip(seen.torques, seen.true, strict=True))
    # What is left is the midpoint in time: the truth of four milliseconds, read at their ends.
    assert worst < 0.1 * top
    assert seen.contact is not None
    last = seen.bodies[-1]
    assert last.final
    assert last.peak_torque_nm == pytest.approx(seen.contact.peak_torque_nm, rel=0.1, abs=0.15)
    assert last.incidence_rad == pytest.approx(seen.contact.incidence_rad, abs=math.radians(1.0))
    assert last.lead_m * seen.contact.lead_m > 0.0
    assert last.side is ContactSide.from_lead(seen.contact.lead_m)


@pytest.mark.parametrize("heading_rad", [0.4, -1.1])
def test_a_wall_may_stand_at_any_angle_to_the_missions_axes(heading_rad: float) -> None:
    vehicle = body_vehicle()
    one, other = (
        sense(before_the_wall(vehicle, Mode.RIGID, -1.0, 0.3, 0.06), vehicle, (HOVER,) * 4, heading)
        for heading in (0.0, heading_rad)
    )
    assert one.bodies
    for a, b in zip(one.bodies, other.bodies, strict=True):
        assert b.incidence_rad == pytest.approx(a.incidence_rad, abs=1e-6)
        assert b.torque_peak_frd == pytest.approx(a.torque_peak_frd, abs=1e-6)


@pytest.mark.parametrize("mode", list(Mode))
def test_a_pure_centre_hit_has_no_torque(mode: Mode) -> None:
    vehicle = body_vehicle(vertical_lever_m=0.0, fold_share=0.0)
    seen = sense(before_the_wall(vehicle, mode, -1.0, 0.0, 0.0), vehicle, (HOVER,) * 4)
    assert max(norm(e.torque_frd) for e in seen.torques) < 1e-6
    assert [(b.side, b.final) for b in seen.bodies] == [(ContactSide.BOTH, True)]
    assert seen.bodies[-1].peak_torque_nm < 1e-3


@settings(max_examples=8, deadline=None)
@given(
    yaw=st.floats(-0.15, 0.15),
    normal=st.floats(-1.5, -0.5),
    tangential=st.floats(-0.5, 0.5),
    mode=st.sampled_from(list(Mode)),
)
def test_left_and_right_are_mirrored(yaw: float, normal: float, tangential: float, mode: Mode) -> None:
    """The mirror image of a hit has the other side, the opposite incidence and the opposite yaw torque."""
    vehicle = body_vehicle()
    one = sense(before_the_wall(vehicle, mode, normal, tangential, yaw), vehicle, (HOVER,) * 4)
    other = sense(before_the_wall(vehicle, mode, normal, -tangential, -yaw), vehicle, (HOVER,) * 4)
    assert one.bodies
    for a, b in zip(one.bodies, other.bodies, strict=True):
        assert b.incidence_rad == pytest.approx(-a.incidence_rad, abs=1e-4)
        assert b.peak_torque_nm == pytest.approx(a.peak_torque_nm, rel=1e-3, abs=1e-4)
    for x, y in zip(one.torques, other.torques, strict=True):
        assert y.torque_frd[2] == pytest.approx(-x.torque_frd[2], abs=1e-6)


def test_right_is_right_when_flying_into_the_wall() -> None:
    """Turned to the left, the right point comes first and is pushed back: the vehicle turns to the right."""
    vehicle = body_vehicle()
    # The wall is to the north; a yaw of -5 degrees (FRD) is to the left.
    seen = sense(before_the_wall(vehicle, Mode.RIGID, -1.0, 0.0, -math.radians(5.0)), vehicle, (HOVER,) * 4)
    last = seen.bodies[-1]
    assert (last.side, last.lead_m > 0.0, last.incidence_rad > 0.0) == (ContactSide.RIGHT, True, True)
    assert last.torque_peak_frd[2] > 1.0


@pytest.mark.parametrize(
    "difference", [(0.05, -0.05, -0.05, 0.05), (0.05, -0.05, 0.05, -0.05), (0.05, 0.05, -0.05, -0.05)]
)
def test_the_motors_are_not_external(difference: tuple[float, float, float, float]) -> None:
    """Roll, pitch and yaw by the motors alone: nothing is left of them."""
    plant = Plant(VEHICLE, (), MissionFrame())
    plant.position, plant.ground_down, plant.motor = (0.0, 0.0, -50.0), 100.0, [HOVER] * 4
    torque, force = TorqueEstimator(VEHICLE), ForceEstimator(VEHICLE)
    turning, largest, motors = AngularMotion(), 0.0, 0.0
    for i in range(100):
        t = 1_000_000 + 4000 * i
        sign = 1.0 if i // 10 % 2 == 0 else -1.0
        commands = tuple(HOVER + sign * d for d in difference)
        a, b, c, d = commands
        force.thrust.add_commands(ActuatorSample(t, t, (a, b, c, d)))
        plant.advance((a, b, c, d), 4)
        turning.update(ImuSample(t + 4000, t, (0.0, 0.0, 0.0), plant.rate))
        force.thrust.mean_over_tick(t + 4000)
        found = torque.estimate(t + 4000, turning, force.thrust.each_n, 1.0, learns=False)
        if found is not None and i > 45:  # what the motors did before the first command is forgotten
            largest = max(largest, norm(found.torque_frd))
            j = VEHICLE.airframe.inertia_kg_m2
            motors = max(motors, *(abs(j[k] * turning.acceleration[k]) for k in range(3)))
    assert motors > 0.01
    assert largest < 0.1 * motors


def test_a_torque_that_is_always_there_is_taken_off() -> None:
    """A centre of mass 5 mm ahead of the motors' middle, and what the gyro's noise makes of the torque."""
    rng = np.random.default_rng(8)
    torque, turning = TorqueEstimator(VEHICLE), AngularMotion()
    each = tuple(MASS * 9.81 / 4.0 + d for d in (-0.12, 0.12, -0.12, 0.12))
    a, b, c, d = each
    seen = []
    for i in range(2000):
        t = 1_000_000 + 4000 * i
        x, y, z = rng.normal(0.0, 0.01, 3)
        turning.update(ImuSample(t, t, (0.0, 0.0, -9.81), (float(x), float(y), float(z))))
        found = torque.estimate(t, turning, (a, b, c, d), 1.0, True)
        if found is not None:
            seen.append(found)
    assert abs(np.mean([s.torque_frd[1] for s in seen[:50]])) > 0.03
    late = np.array([s.torque_frd for s in seen[1000:]])
    assert np.abs(late.mean(axis=0)).max() < 0.005
    inertia = VEHICLE.airframe.inertia_kg_m2
    for k in range(3):
        white = inertia[k] * math.sqrt(2.0) * 0.01 / 0.004
        assert late[:, k].std() == pytest.approx(white, rel=0.1)
        assert seen[-1].noise_frd_nm[k] == pytest.approx(white, rel=0.25)


def test_a_lasting_torque_larger_than_a_vehicles_own_stays_visible() -> None:
    """About one axis is enough: half a newton metre about pitch, of which 0.3 may be the vehicle's."""
    torque, turning = TorqueEstimator(VEHICLE), AngularMotion()
    each = tuple(MASS * 9.81 / 4.0 + d for d in (-1.0, 1.0, -1.0, 1.0))
    a, b, c, d = each
    found = None
    for i in range(2000):
        t = 1_000_000 + 4000 * i
        turning.update(ImuSample(t, t, (0.0, 0.0, -9.81), (0.0, 0.0, 0.0)))
        found = torque.estimate(t, turning, (a, b, c, d), 1.0, True)
        if i == 1:
            assert found is not None
            whole = abs(found.torque_frd[1])
    assert found is not None
    assert whole > 0.45
    assert abs(found.torque_frd[1]) == pytest.approx(whole - 0.3, abs=0.01)


def test_the_torque_that_is_always_there_and_the_noise_are_learnt_as_slowly_as_they_should_be() -> None:
    """By a 250th of the difference with a sample, and by a 125th; a change of white noise counts a third."""
    torque, turning = TorqueEstimator(VEHICLE), AngularMotion()
    jx = VEHICLE.airframe.inertia_kg_m2[0]
    seen = []
    for t_us, rate in ((1_000_000, 0.0), (1_004_000, 0.02), (1_008_000, 0.04), (1_012_000, 0.06)):
        turning.update(ImuSample(t_us, t_us, (0.0, 0.0, -9.81), (rate, 0.0, 0.0)))
        found = torque.estimate(t_us, turning, None, 1.0, learns=True)
        if found is not None:
            seen.append(found)
    kept = 1.0
    for i, found in enumerate(seen):
        kept *= 1.0 - 0.004
        assert found.torque_frd[0] == pytest.approx(kept * jx * 5.0)
        variance = 1e-3
        for _ in range(i):
            variance = variance * (1.0 - 0.008) + 1e-10
        assert found.noise_frd_nm == pytest.approx((math.sqrt(variance),) * 3, rel=1e-3 if i == 0 else 1e-9)


def test_a_body_is_not_fitted_as_a_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """One point first: the pulse is not the oscillator's, and its fit is 5 % too low; the top is not."""
    vehicle = body_vehicle()
    # As learnt in a second of quiet flight.
    quiet = msgspec.structs.replace(vehicle.estimation, imu_noise_m_s2=0.2)
    vehicle = msgspec.structs.replace(vehicle, estimation=quiet)
    plants = [before_the_wall(vehicle, Mode.RIGID, -1.2, 0.0, 0.1) for _ in range(2)]
    chosen = sense(plants[0], vehicle, (HOVER,) * 4)
    monkeypatch.setattr(detector, "PULSE_MISFIT", 1000.0)
    fitted = sense(plants[1], vehicle, (HOVER,) * 4)
    assert chosen.contact is not None
    true = chosen.contact.peak_normal_force_n
    assert not chosen.peaks[0].fitted
    assert fitted.peaks[0].fitted
    assert chosen.peaks[0].normal_force_n == pytest.approx(true, rel=0.03)
    assert fitted.peaks[0].normal_force_n < 0.96 * true


# --- flights --------------------------------------------------------------------------------------------


def test_the_verdict_says_how_the_body_met(flown: SharedFlights) -> None:
    verdict = flown("paper_single_wall", 2).verdict
    measured, truth = verdict.collisions[0].measured, verdict.collisions[0].truth
    assert truth is not None
    assert truth.incidence_deg is not None
    assert measured.incidence_deg == pytest.approx(truth.incidence_deg, abs=2.0)
    assert measured.contact_side is not None
    assert measured.peak_torque_nm is not None
    assert verdict.collisions[0].planned.contact_side is None


def test_a_sample_of_the_campaign(tmp_path: Path) -> None:
    """Walls that stand off the plan, on seeds beside those of the results."""
    rows = campaign_rows(tmp_path / "out", "torque", "--only", "set=off", "--seed", "2201", "--runs", "3")
    assert len(rows) == 3
    for row in rows:
        assert abs(row["torque_nm"] - row["true_torque_nm"]) <= max(0.15, 0.1 * row["true_torque_nm"])
        assert abs(row["lead_m"]) < 0.005 or row["side"] == ("right" if row["lead_m"] > 0.0 else "left")
        assert abs(row["incidence_rad"] - row["true_incidence_rad"]) < math.radians(1.5)
        assert abs(row["force_error"]) < 0.06


def test_a_change_over_a_gap_of_the_stream_is_no_noise() -> None:
    """What turns the vehicle may have changed meanwhile: two samples of either side say nothing together."""
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
