"""The lock of a drawn world: it moves in every world, and one that does not is noticed."""

from pathlib import Path

import pytest

from dart_flight.samples import World
from dart_flight.sim.draws import parse_vary
from dart_flight.worlds.embedded import fly_embedded
from dart_flight.worlds.fast import fly_fast
from dart_flight.worlds.prepare import load_flyable
from tests.shared_flights import PATIENT

ROOT = Path(__file__).parents[2]


@pytest.mark.mavlink
def test_a_drawn_servo_locks_the_arms_before_the_second_hit(tmp_path: Path) -> None:
    """Its faults used to be set before the autopilot's clock was known, which froze its model's time."""
    mission = load_flyable(ROOT / "missions/dual_collision.yaml", settings=PATIENT)
    spreads = parse_vary(["servo"], mission.vehicle)
    embedded = fly_embedded(mission, 4, tmp_path, spreads=spreads, speed=2.0)
    fast = fly_fast(mission, 4, None, spreads=spreads)
    assert embedded.world is World.EMBEDDED
    assert [c.mode_felt for c in embedded.collisions] == [c.mode_felt for c in fast.collisions]
    peaks = [c.truth.peak_force_n for v in (embedded, fast) for c in v.collisions[1:] if c.truth is not None]
    assert peaks == pytest.approx([69.0, 69.0], rel=0.1)
