"""Whole missions in the fast world."""

from pathlib import Path

import msgspec
import pytest

from dart_flight.flights import fly_fast, load_flyable
from dart_flight.samples import Record, SetPoint

ROOT = Path(__file__).parents[2]


def test_dual_collision_completes_as_the_paper_flew_it(tmp_path: Path) -> None:
    verdict = fly_fast(load_flyable(ROOT / "missions/dual_collision.yaml"), 1, tmp_path)
    assert verdict.outcome == "completed"
    assert [(c.wall, c.mode) for c in verdict.collisions] == [("wood", "flexible"), ("acrylic", "rigid")]
    first = verdict.collisions[0]
    assert first.truth is not None
    assert first.truth.normal_m_s == pytest.approx(-0.6, abs=0.1)
    assert first.truth.tangential_m_s == pytest.approx(0.5, abs=0.1)
    for collision in verdict.collisions:
        assert collision.truth is not None
        assert collision.measured.peak_force_n == pytest.approx(collision.truth.peak_force_n, rel=0.15)
    switch = verdict.collisions[0].lock
    assert switch.contact_end_us is not None
    assert switch.relaxed_us is not None
    assert switch.commanded_us is not None
    assert switch.settled_us is not None
    # The lock moves after the contact and the relaxation, and is there before the next wall.
    assert switch.contact_end_us < switch.relaxed_us <= switch.commanded_us + 20_000
    assert switch.commanded_us < switch.settled_us < verdict.collisions[1].t_us
    assert verdict.final_error_m is not None
    assert verdict.final_error_m <= 0.2
    assert verdict.max_tilt_deg is not None
    assert verdict.max_tilt_deg < 45.0
    assert not verdict.guard


def test_a_seed_decides_everything(tmp_path: Path) -> None:
    mission = load_flyable(ROOT / "missions/dual_collision.yaml")

    def setpoints(seed: int) -> bytes:
        records: list[Record] = []
        fly_fast(mission, seed, None, records.append)
        return msgspec.json.encode([r for r in records if isinstance(r, SetPoint)])

    once = setpoints(3)
    assert once == setpoints(3)
    assert once != setpoints(4)


@pytest.mark.parametrize("seed", range(5, 9))
def test_missions_complete_over_seeds(seed: int) -> None:
    for name in ("dual_collision", "single_wall"):
        verdict = fly_fast(load_flyable(ROOT / f"missions/{name}.yaml"), seed, None)
        assert (verdict.outcome, verdict.reason) == ("completed", None)
