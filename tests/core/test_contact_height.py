"""Height of a wall's push above the centre of mass, estimated from torque and force of contacts."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    MissionFrame,
    Quaternion,
    Vec3,
    add,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    rotate_back,
    scale,
)
from dart_flight.base.records import ContactRequest, ImpactOnset, Mode
from dart_flight.base.walls import Wall
from dart_flight.core.mission.contact_feedforward import (
    _AGAINST_PLAN,
    _BALANCED,
    _MOST_LEAN,
    balancing_acceleration_m_s2,
)
from dart_flight.core.sense.contact_height import _LEAST_N, _LEAST_N2, ContactHeight

OUT_M = 0.2
WALL = Wall("north-east", (0.6, 0.8), (-0.6, -0.8), 4.0, "acrylic")
NX, NY = WALL.normal
SLOW = (1.5, -2.0)  # slow force in addition to the contact's, N
ONSET = ImpactOnset(4_000, 4_000, 4_000, (0.0, 0.0, 1.0), (-10.0, 0.0, 0.0), (1.0, 0.0, 0.0), True)


def cross(a: Vec3, b: Vec3) -> Vec3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def height_after_contact(
    height_m: float,
    side: int,
    tilt: Vec3,
    peak_n: float,
    wall: Wall | None = WALL,
    weak_n: float = 0.0,
    clipped: int | None = None,
) -> ContactHeight:
    """Return the estimator after one contact at `height_m` on a side (0 front, 1 right, 2 back, 3 left).

    Samples below `weak_n`, the `clipped` one and one before the onset get an unrelated torque.
    """
    frame = MissionFrame(heading_rad=0.4)
    height = ContactHeight(OUT_M)
    to_wall = frame.vector_to_ned((-NX, -NY, 0.0))
    heading = math.atan2(to_wall[1], to_wall[0]) - side * 0.5 * math.pi
    level = quaternion_from_rotation_vector((0.0, 0.0, heading))
    q: Quaternion = quaternion_multiply(level, quaternion_from_rotation_vector(tilt))
    axis = (math.cos(side * 0.5 * math.pi), math.sin(side * 0.5 * math.pi), 0.0)
    at = add(scale(axis, OUT_M), (0.0, 0.0, -height_m))
    forces, torques = [(20.0 * NX, 20.0 * NY, 0.0)], [(3.0, 4.0, 5.0)]
    for k in range(20):
        force_n = peak_n * math.sin(math.pi * (k + 0.5) / 20.0)
        push = rotate_back(q, frame.vector_to_ned((force_n * NX, force_n * NY, 0.0)))
        forces.append((force_n * NX + SLOW[0], force_n * NY + SLOW[1], 0.0))
        torques.append((3.0, 4.0, 5.0) if force_n < weak_n or k == clipped else cross(at, push))
    request = ContactRequest(
        t_us=84_000,
        number=1,
        onset=ONSET,
        wall=wall,
        normal=WALL.normal,
        mode_reported=None,
        frame_heading_rad=0.4,
        slow_force=SLOW,
        noise_n=0.1,
        noise_frd_nm=(0.1, 0.1, 0.1),
        sample_us=tuple(range(0, 84_000, 4_000)),
        force_mission=tuple(forces),
        push_mission=((0.0, 0.0),) * 21,
        clipped=tuple(k - 1 == clipped for k in range(21)),
        torque_frd=tuple(torques),
        q_frd_to_ned=(q,) * 21,
        rate_frd=((0.0, 0.0, 0.0),) * 21,
    )
    height.add(request)
    return height


@given(
    st.floats(-0.05, 0.05),
    st.integers(0, 3),
    st.floats(-0.2, 0.2),
    st.floats(-0.2, 0.2),
    st.floats(15.0, 200.0),
)
def test_the_height_follows_from_torque_and_force(
    height_m: float, side: int, roll: float, pitch: float, peak_n: float
) -> None:
    found = height_after_contact(height_m, side, (roll, pitch, 0.0), peak_n).height_m
    assert found == pytest.approx(height_m, abs=1e-9)


def test_a_weak_or_unplanned_contact_gives_no_height() -> None:
    assert height_after_contact(0.02, 0, (0.0, 0.0, 0.0), 6.0).height_m is None
    assert height_after_contact(0.02, 0, (0.0, 0.0, 0.0), 50.0, wall=None).height_m is None
    assert ContactHeight(OUT_M).height_m is None


def test_clipped_and_weak_samples_and_unplanned_contacts_are_ignored() -> None:
    """The first sample of a weaker peak is below the limit, and that of a stronger one is not."""
    level = (0.02, 0, (0.0, 0.0, 0.0))
    assert height_after_contact(*level, 50.0, clipped=9).height_m == pytest.approx(0.02)
    first = math.sin(math.pi * 0.5 / 20.0)  # as a share of the peak
    for share, found in ((0.97, True), (1.02, False)):
        weak_n = 1.05 * _LEAST_N
        height_m = height_after_contact(*level, share * _LEAST_N / first, weak_n=weak_n).height_m
        assert (height_m == pytest.approx(0.02, abs=1e-4)) is found
    assert height_after_contact(*level, 50.0, wall=None).height_m is None


@pytest.mark.parametrize(("share", "known"), [(0.99, False), (1.02, True)])
def test_the_height_needs_a_minimum_sum_of_squared_forces(share: float, known: bool) -> None:
    """A half-sine over twenty samples has ten times its squared peak."""
    peak_n = share * math.sqrt(_LEAST_N2 / 10.0)
    assert (height_after_contact(0.02, 0, (0.0, 0.0, 0.0), peak_n).height_m is not None) is known


@pytest.mark.parametrize(
    ("planned", "height_m", "share"),
    [
        (None, 0.02, _BALANCED),
        (Mode.FLEXIBLE, 0.02, _BALANCED),
        (Mode.RIGID, 0.02, _BALANCED * _AGAINST_PLAN),  # against the lean at the end of the plan
        (Mode.RIGID, -0.02, _BALANCED),  # both lean off the wall
    ],
)
def test_the_balancing_lean_compensates_the_contact_height(
    planned: Mode | None, height_m: float, share: float
) -> None:
    expected = -share * height_m / OUT_M * GRAVITY_M_S2
    assert balancing_acceleration_m_s2(height_m, OUT_M, planned) == pytest.approx(expected)


def test_the_balancing_lean_is_limited_and_zero_for_an_unknown_height() -> None:
    assert balancing_acceleration_m_s2(None, OUT_M, Mode.RIGID) == 0.0
    for height_m in (0.5, -0.5):
        assert abs(balancing_acceleration_m_s2(height_m, OUT_M, Mode.RIGID)) == pytest.approx(
            _MOST_LEAN * GRAVITY_M_S2
        )
