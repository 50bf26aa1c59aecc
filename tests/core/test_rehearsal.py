"""A hand-fed rehearsal: the paths to the standoff points, and their timeouts."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import GuardEvent, LockPhase, Mode, Override, Phase, PhaseChange, Setpoint
from dart_flight.core.mission.approach import plan_approach
from tests.core.conftest import SHORT_TIMEOUTS, HandFedCore, core_in, of_kind


def follow(c: HandFedCore, seconds: float) -> list[Setpoint]:
    """Move the vehicle to every setpoint without delay; return the setpoints."""
    sent: list[Setpoint] = []
    for _ in range(round(seconds / 0.008)):
        here = of_kind(Setpoint, c.run(0.008))
        sent += here
        if here:
            c.position_ned, c.velocity_ned = here[-1].position_ned, here[-1].velocity_ned or (0.0, 0.0, 0.0)
    return sent


def follow_through(c: HandFedCore, phase: Phase) -> Vec3:
    """Follow the setpoints until a phase ends; return where, NED."""
    for _ in range(100):
        follow(c, 0.1)
        if c.core.phase is not phase:
            return c.position_ned
    raise AssertionError(f"{phase} does not end")


def stand_off_first_wall(c: HandFedCore) -> None:
    """Fly to the standoff point before the first wall."""
    c.enter_approach()
    follow_through(c, Phase.APPROACH)


def given_up_after_s(c: HandFedCore, phase: Phase) -> float:
    """Return after which time in a phase the standoff point is given up, seconds."""
    (begun,) = (o for o in c.outputs if isinstance(o, PhaseChange) and o.after is phase)
    (event,) = of_kind(GuardEvent, c.outputs)
    assert (event.rule, event.action) == ("transit_timeout", Override.HOLD)
    assert event.detail == "the standoff point was not reached in time"
    return (event.t_us - begun.t_us) * 1e-6


def test_the_path_to_the_next_wall_starts_from_rest_after_a_slow_lock() -> None:
    c = HandFedCore(settings={"standoff_m": 0.3})
    stand_off_first_wall(c)
    assert c.core.phase is Phase.RECOVERY
    stood_at = c.position_ned
    assert c.core.mission.walls[0].signed_distance((stood_at[0], -stood_at[1])) == pytest.approx(
        0.3, abs=0.01
    )
    c.set_lock(Mode.RIGID, LockPhase.TRAVELLING)
    here = follow(c, 2.0)[-1].position_ned  # as long as the whole path takes
    assert math.dist(here, stood_at) < 0.01
    c.set_lock(Mode.RIGID)
    sent = follow(c, 4.0)
    steps = [math.dist(b.position_ned, a.position_ned) for a, b in pairwise(sent)]
    assert math.dist(sent[0].position_ned, here) < 0.01
    assert max(steps) < 0.01
    assert math.dist(sent[-1].position_ned, here) > 0.4
    wall = c.core.mission.walls[1]
    places = [(one.position_ned[0], -one.position_ned[1]) for one in sent]
    nearest = min(places, key=wall.signed_distance)
    assert wall.signed_distance(nearest) == pytest.approx(0.3, abs=1e-3)
    assert wall.along(nearest) == pytest.approx(wall.along((here[0], -here[1])), abs=1e-3)


def test_a_standoff_point_that_is_not_reached_is_given_up_after_the_timeout() -> None:
    c = core_in(Phase.APPROACH, settings={"standoff_m": 0.3, **SHORT_TIMEOUTS})
    c.run(4.0)  # the vehicle does not follow the setpoints
    assert given_up_after_s(c, Phase.APPROACH) == pytest.approx(3.0, abs=0.02)


def test_a_lock_that_never_settles_ends_the_rehearsal_before_the_next_wall() -> None:
    c = HandFedCore(settings={"standoff_m": 0.3, **SHORT_TIMEOUTS})
    stand_off_first_wall(c)
    c.set_lock(Mode.RIGID, LockPhase.TRAVELLING)
    follow(c, 4.0)
    assert given_up_after_s(c, Phase.RECOVERY) == pytest.approx(3.0, abs=0.02)


def test_a_wall_with_its_own_approach_is_rehearsed_from_its_run_up_point() -> None:
    approach = {"normal_m_s": -0.6, "tangential_m_s": 0.0}
    c = HandFedCore(settings={"standoff_m": 0.3, "collisions[1].approach": approach})
    stand_off_first_wall(c)
    begun = [(o.before, o.after) for o in c.outputs if isinstance(o, PhaseChange)]
    assert begun[-2:] == [(Phase.APPROACH, Phase.RECOVERY), (Phase.RECOVERY, Phase.TRANSIT)]
    acrylic = c.core.mission.collisions[1]
    begin, impact = plan_approach(c.core.mission, acrylic).begin, acrylic.impact_point
    assert impact is not None
    c.set_lock(Mode.RIGID)
    at_run_up = follow_through(c, Phase.TRANSIT)
    assert (at_run_up[0], -at_run_up[1]) == pytest.approx(begin[:2], abs=0.01)
    at_wall = follow_through(c, Phase.APPROACH)
    assert (at_wall[0], -at_wall[1]) == pytest.approx((impact[0] - 0.3, impact[1]), abs=0.01)


def test_a_waypoint_between_two_walls_is_rehearsed_too() -> None:
    settings = {
        "standoff_m": 0.3,
        "collisions[1].approach": {"normal_m_s": -0.6, "tangential_m_s": 0.0},
        "waypoints": [{"position_m": [0.2, 0.5], "after": 1, "hold_s": 0.5}],
    }
    c = HandFedCore(settings=settings)
    stand_off_first_wall(c)
    c.set_lock(Mode.RIGID)
    assert follow_through(c, Phase.WAYPOINT) == pytest.approx((0.2, -0.5, -1.0), abs=0.01)
    phases = [o.after for o in of_kind(PhaseChange, c.outputs)]
    assert phases[-3:] == [Phase.RECOVERY, Phase.WAYPOINT, Phase.TRANSIT]
