"""Campaign specifications: grids, items, differences between campaigns, and the statistics of results."""

from __future__ import annotations

import math
import random
import shutil
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.summary import share
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import packaged
from dart_flight.lab.campaign.campaign_folder import open_campaign
from dart_flight.lab.campaign.campaign_spec import (
    CampaignSpec,
    campaign_of,
    difference,
    items_of,
    parse_grid,
    points_of,
)
from dart_flight.lab.statistics import bin_edges, bin_of, separation

SINGLE, DUAL = (
    str(packaged("missions", f"{name}.yaml")) for name in ("paper_single_wall", "paper_dual_collision")
)


def test_grid_values_are_split_at_commas_outside_brackets_and_quotes() -> None:
    grid = parse_grid(
        ["airframe.mass_kg=1.2, 1.4", "lock.driver=mock", "imu.position_m=[0, 0, 0],[0.1, 0, 0]"]
    )
    assert grid == {
        "airframe.mass_kg": ("1.2", "1.4"),
        "lock.driver": ("mock",),
        "imu.position_m": ("[0, 0, 0]", "[0.1, 0, 0]"),
    }
    assert parse_grid(["a='x,y',z"]) == {"a": ("'x,y'", "z")}


@pytest.mark.parametrize("setting", ["airframe.mass_kg", "=1", "a=", "a=1,", "a=1,1"])
def test_an_invalid_grid_setting_is_refused(setting: str) -> None:
    with pytest.raises(InputError, match="--set"):
        parse_grid([setting])


def test_a_campaign_combines_every_mission_setting_and_seed() -> None:
    spec = CampaignSpec(
        (SINGLE, DUAL), settings=parse_grid(["airframe.mass_kg=1.2,1.4", "onset=lcp,touch"]), runs=3, seed=5
    )
    points = points_of(spec)
    assert [(p.number, p.path, p.values) for p in points][:5] == [
        (1, SINGLE, ("1.2", "lcp")),
        (2, SINGLE, ("1.2", "touch")),
        (3, SINGLE, ("1.4", "lcp")),
        (4, SINGLE, ("1.4", "touch")),
        (5, DUAL, ("1.2", "lcp")),
    ]
    assert points[2].mission.vehicle.airframe.mass_kg == 1.4
    assert len({p.digest for p in points}) == 8
    items = list(items_of(spec, points))
    assert len(items) == len(set(items)) == 24
    assert [item.seed for item in items[:8]] == [5] * 8, "the whole grid is flown before the next seed"
    columns = campaign_of(spec, points).columns
    assert columns[:4] == ("mission", "airframe.mass_kg", "onset", "seed")
    assert columns[-4:] == ("c1_normal_m_s", "c1_peak_force_n", "c2_normal_m_s", "c2_peak_force_n")


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (CampaignSpec((SINGLE, SINGLE)), "twice"),
        (CampaignSpec((SINGLE,), settings={"airframe.mas_kg": ("1",)}), "did you mean"),
        (CampaignSpec((SINGLE,), settings={"lock.driver": ("maestro",)}), "cannot be simulated"),
        (CampaignSpec((SINGLE,), vary=("mas",)), "did you mean mass"),
        (CampaignSpec(("none.yaml",)), "cannot read"),
    ],
)
def test_invalid_input_is_refused_before_the_first_flight(
    spec: CampaignSpec, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        open_campaign(spec, tmp_path / "new", resume=False)
    assert not (tmp_path / "new").exists()


def test_the_difference_to_an_existing_campaign_is_reported(tmp_path: Path) -> None:
    shutil.copytree(packaged("missions"), tmp_path / "missions")
    shutil.copytree(packaged("configs"), tmp_path / "configs")
    mission = tmp_path / "missions" / "paper_single_wall.yaml"
    spec = CampaignSpec((str(mission),), vary=("mass",), runs=4, seed=3)

    def differs(**changes: object) -> str | None:
        other = msgspec.structs.replace(spec, **changes)
        return difference(existing, campaign_of(other, points_of(other)))

    existing = campaign_of(spec, points_of(spec))
    assert differs() is None
    assert differs(runs=9) is None, "more runs extend the same campaign"
    for changes, message in (
        ({"runs": 2}, "--runs: 4 in the existing campaign"),
        ({"seed": 4}, "--seed: 3 in the existing campaign, not 4"),
        ({"vary": ("mass=0.2",)}, "--vary: mass in the existing campaign, not mass=0.2"),
        (
            {"settings": {"airframe.mass_kg": ("1.2",)}},
            "--set: none in the existing campaign, not airframe.mass_kg=1.2",
        ),
        ({"missions": (SINGLE,)}, "the missions"),
    ):
        found = differs(**changes)
        assert found is not None
        assert found.startswith(message)
    mission.write_text(mission.read_text().replace("hold_s: 2.0", "hold_s: 1.0"))
    assert differs() == "a mission or configuration file has changed since the campaign began"


# --- statistics -----------------------------------------------------------------------------------------


def test_the_interval_of_a_share_is_wilsons_score_interval() -> None:
    rate = share(8, 10)  # Agresti and Coull 1998
    assert rate.low == pytest.approx(0.4902, abs=1e-4)
    assert rate.high == pytest.approx(0.9433, abs=1e-4)
    assert share(0, 0).share is None
    assert share(5, 5).high == 1.0


def test_bins_hold_about_the_same_number_of_values() -> None:
    rng = random.Random(1)
    values = [rng.gauss(0.0, 1.0) for _ in range(400)]
    edges = bin_edges(values)
    counts = [sum(bin_of(v, edges) == i for v in values) for i in range(len(edges) - 1)]
    assert len(counts) == 8
    assert sum(counts) == 400
    assert max(counts) - min(counts) <= 2
    assert len(bin_edges([2.0] * 100)) == 2
    assert bin_of(2.0, bin_edges([2.0] * 100)) == 0


def test_separation_is_the_share_of_ordered_pairs() -> None:
    rng = random.Random(2)
    first = [rng.choice([1.0, 2.0, 3.0]) for _ in range(30)]
    second = [rng.choice([2.0, 3.0, 4.0]) for _ in range(40)]
    pairs = [(a > b) + 0.5 * (a == b) for a in first for b in second]
    found = separation(first, second)
    assert found.chance == pytest.approx(sum(pairs) / len(pairs))
    assert found.z < 0.0
    assert math.isclose(separation(first, first).chance, 0.5)
