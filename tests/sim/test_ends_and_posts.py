"""The simulated vehicle at ends of walls and at posts: an independent body and energy as references."""

import itertools
import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from dart_flight.base.records import Mode
from dart_flight.base.walls import Post, Wall
from dart_flight.config.vehicle import Coefficients, Material
from dart_flight.contact.cylinders import WallWithEnds
from dart_flight.contact.propeller_guards import WallLoad
from dart_flight.sim.plant import Plant
from tests.oracles.ends_and_posts import Board, Pillar, Scene
from tests.sim.plants import body_vehicle, drifting_plant, energy_j, oracle_of, rotation

# NED to north, west, up; FRD to forward, left, up.
FLIP = np.diag([1.0, -1.0, -1.0])
LENGTH_M = 2.0


def board(end_m: float, length_m: float = LENGTH_M) -> Wall:
    """Return a wall to the north whose western end is `end_m` west of the x axis."""
    return Wall("wall", (1.0, end_m - 0.5 * length_m), (-1.0, 0.0), length_m, "acrylic")


def oracle(plant: Plant, mode: Mode) -> Scene:
    """Return the oracle's body before the same obstacles."""
    body, law = oracle_of(plant.vehicle, mode)
    wall = None
    for plane in plant.planes:
        nx, ny = plane.wall.normal
        normal = np.array([nx, ny, 0.0])
        middle = np.array([*plane.wall.point, 0.0]) - plant.vehicle.simulation.contact.guard_out_m * normal
        wall = Board(middle, normal, 0.5 * plane.wall.length_m)
    posts = [Pillar(np.array(one.post.centre), one.post.radius_m) for one in plant.posts]
    return Scene(body, law, wall, posts)


def compare_with_oracle(plant: Plant, mode: Mode) -> tuple[float, float]:
    """Fly both through a contact; return the velocity error in m/s and the relative rate error."""
    y = np.concatenate(
        (
            FLIP @ np.array(plant.position),
            FLIP @ np.array(plant.velocity),
            (FLIP @ rotation(plant.q) @ FLIP).ravel(),
            FLIP @ np.array(plant.rate),
        )
    )
    scene = oracle(plant, mode)
    steps = 0
    while not plant.finished or plant.in_contact:
        plant.advance((0.0,) * 4)
        steps += 1
        assert steps < 500
    y = scene.fly(y, 1e-3 * steps)
    speed = float(np.linalg.norm(FLIP @ np.array(plant.velocity) - y[3:6]))
    off = float(np.linalg.norm(FLIP @ np.array(plant.rate) - y[15:]))
    return speed, off / max(1e-9, float(np.linalg.norm(y[15:])))


# Wall end west of the vehicle's centre in metres; yaw in degrees, velocity and yaw rate.
ENDS = [
    (0.05, 0.0, (1.0, 0.0), 0.0),  # one guard, the other beyond the end
    (-0.05, 0.0, (1.0, 0.0), 0.0),  # one guard, the centre and the other beyond the end
    (-0.12, 0.0, (1.0, 0.3), 0.0),  # a guard that slides
    (-0.12, -20.0, (1.0, 0.4), 0.0),  # the edge at a guard and beside it
    (0.05, -8.0, (1.0, 0.0), 0.0),  # the edge between the guards, one of which represents it
    (-0.05, -20.0, (1.5, 0.5), 0.0),  # the edge between the guards
    (-0.05, 8.0, (1.0, 0.3), 0.5),
    (0.05, 20.0, (2.0, -0.5), -1.0),
]


# The independent body takes a second or two for each case, so the modes alternate.
@pytest.mark.parametrize(
    ("end", "yaw", "velocity", "rate", "mode"),
    [
        pytest.param(*hit, mode, marks=[] if hit in ENDS[1:6:4] else pytest.mark.rest)
        for hit, mode in zip(ENDS, itertools.cycle(Mode), strict=False)
    ],
)
def test_a_collision_at_a_wall_end_agrees_with_an_independent_rigid_body(
    end: float, yaw: float, velocity: tuple[float, float], rate: float, mode: Mode
) -> None:
    plant = drifting_plant(
        body_vehicle(), mode, (board(end),), (0.95, 0.0), velocity, math.radians(yaw), 0.05, rate
    )
    off_m_s, off_share = compare_with_oracle(plant, mode)
    assert off_m_s < 1e-3
    assert off_share < 0.01


POSTS = [
    (0.0, 0.0, (1.0, 0.0), 0.0),  # central
    (0.05, 0.0, (1.0, 0.0), 0.0),  # beside it
    (0.13, 0.0, (1.0, 0.0), 0.0),  # at a guard
    (0.16, 0.0, (1.0, 0.0), 0.0),  # at the corner between two sides
    (0.05, 10.0, (1.0, 0.4), 0.0),  # oblique
    (-0.05, -25.0, (2.0, -0.5), 1.0),
    (0.02, 44.0, (1.0, 0.0), 0.5),
]


@pytest.mark.parametrize(("mode", "radius"), list(zip(Mode, (0.03, 0.1), strict=True)))
@pytest.mark.parametrize(
    ("off", "yaw", "velocity", "rate"),
    [pytest.param(*hit, marks=[] if hit in POSTS[3:6:2] else pytest.mark.rest) for hit in POSTS],
)
def test_a_collision_with_a_post_agrees_with_an_independent_rigid_body(
    mode: Mode, radius: float, off: float, yaw: float, velocity: tuple[float, float], rate: float
) -> None:
    post = Post("post", (1.25 + radius, off), radius, "acrylic")
    plant = drifting_plant(
        body_vehicle(), mode, (post,), (0.95, 0.0), velocity, math.radians(yaw), 0.05, rate
    )
    off_m_s, off_share = compare_with_oracle(plant, mode)
    assert off_m_s < 1e-3
    assert off_share < 0.01


signed = st.floats(-1.0, 1.0)


@settings(max_examples=15, phases=(Phase.explicit, Phase.generate))  # shrinking would take minutes
@given(
    mode=st.sampled_from(list(Mode)),
    obstacle=st.sampled_from(("end", "narrow", "post")),
    radius=st.floats(0.005, 0.2),
    along=signed,
    velocity=st.tuples(st.floats(-0.5, 3.0), st.floats(-2.0, 2.0)),
    yaw=st.floats(-math.pi, math.pi),
    tilt=st.floats(-0.3, 0.3),
    rate=st.floats(-8.0, 8.0),
    damping=st.sampled_from((0.0, 1.0)),
    friction=st.sampled_from((0.0, 0.3, 5.0)),
    share=st.floats(0.0, 1.0),
    behind=st.booleans(),
)
@pytest.mark.rest
def test_no_contact_adds_energy(
    mode: Mode,
    obstacle: str,
    radius: float,
    along: float,
    velocity: tuple[float, float],
    yaw: float,
    tilt: float,
    rate: float,
    damping: float,
    friction: float,
    share: float,
    behind: bool,
) -> None:
    """Without the law's vertical force, a vehicle never leaves a contact with more energy."""
    vehicle = body_vehicle(friction_lever_share=share)
    c = vehicle.materials["acrylic"].coefficients(mode)
    c = Coefficients(c.k, damping * c.f, friction, 0.0)
    vehicle = msgspec.structs.replace(vehicle, materials={"acrylic": Material(c, c)})
    walls: tuple[Wall, ...] = ()
    posts: tuple[Post, ...] = ()
    start, v = (0.85, 0.0), velocity
    if obstacle == "post":
        posts = (Post("post", (1.15 + radius, 0.3 * along), radius, "acrylic"),)
    else:
        walls = (board(0.3 * along, LENGTH_M if obstacle == "end" else radius),)
        if behind:  # starts behind the surface, beside the end, and flies to the end
            start, v = (1.1 + radius, 0.3 * along + 0.32), (0.2 * velocity[1], -abs(velocity[0]))
    plant = drifting_plant(vehicle, mode, (*walls, *posts), start, v, yaw, tilt, rate)
    before = energy_j(plant)
    for _ in range(250):
        plant.advance((0.0,) * 4)
        assert energy_j(plant) <= before * 1.002 + 1e-3


@pytest.mark.rest
def test_skipping_the_contact_model_far_from_an_end_changes_no_flight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The flights pass the end in front and behind, beside it, and hit it from the side."""

    def flown(place: tuple[float, float], velocity: tuple[float, float], yaw: float) -> tuple[Plant, int]:
        plant = drifting_plant(
            body_vehicle(), Mode.FLEXIBLE, (board(0.0),), place, velocity, yaw, 0.05, 0.3 * velocity[1]
        )
        for _ in range(300):
            plant.advance((0.0,) * 4)
        return plant, len(plant.finished)

    touch, calls = WallWithEnds.touch, []

    def counted(self: WallWithEnds, *given: Any) -> WallLoad:
        calls.append(1)
        return touch(self, *given)

    monkeypatch.setattr(WallWithEnds, "touch", counted)
    rng = np.random.default_rng(5)
    places, velocities = (
        rng.uniform((0.4, -0.4), (1.4, 0.5), (4, 2)),
        rng.uniform((-1.0, -2.0), (2.5, 2.0), (4, 2)),
    )
    cases = [
        ((float(x), float(y)), (float(u), float(v)), float(yaw))
        for (x, y), (u, v), yaw in zip(places, velocities, rng.uniform(0.0, 1.5, 4), strict=True)
    ]
    quick = [flown(*case) for case in cases]
    computed = len(calls)
    monkeypatch.setattr(WallWithEnds, "may_touch", lambda *_: True)
    thorough = [flown(*case) for case in cases]
    assert computed < 0.8 * (len(calls) - computed)
    assert sum(hits for _, hits in quick) > 1
    for (one, hits), (other, others) in zip(quick, thorough, strict=True):
        assert hits == others
        assert one.position == pytest.approx(other.position, abs=1e-6)
        assert one.rate == pytest.approx(other.rate, abs=1e-4)
