"""What a table amounts to, on rows that are made so that the answer is known."""

from __future__ import annotations

import random
import re
import sys
from html import unescape
from pathlib import Path

import msgspec
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.config.packages import install_command
from dart_flight.config.vehicle import packaged
from dart_flight.lab.campaign import campaign_folder as campaigns
from dart_flight.lab.campaign.campaign_spec import CampaignSpec
from dart_flight.lab.campaign.campaign_summary import CampaignSummary, summarise
from dart_flight.lab.campaign.flight_job import line_of
from dart_flight.lab.campaign.table import Table
from dart_flight.lab.report.campaign_page import campaign_page
from dart_flight.lab.statistics import rank_correlation, rank_correlation_chance

SINGLE = str(packaged("missions", "paper_single_wall.yaml"))
FLIGHTS = 400


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> campaigns.CampaignFolder:
    """Flights that fail where the vehicle is heavy, and where the lock is stuck; nothing else matters."""
    asked = CampaignSpec(
        (SINGLE,), vary=("mass", "battery", "lock_true_mode", "contact_scatter"), runs=FLIGHTS
    )
    opened = campaigns.open_campaign(asked, tmp_path_factory.mktemp("made") / "out", resume=False)
    rng = random.Random(3)
    with Table(opened.folder / campaigns.TABLE, opened.campaign.columns) as table:
        for seed in range(1, FLIGHTS + 1):
            mass, stuck = rng.gauss(1.0, 0.1), rng.random() < 0.1
            rule = "lock_fault" if stuck else "too_heavy" if mass > 1.1 else ""
            cells: dict[str, str | float | int | bool | None] = {
                "mission": SINGLE,
                "seed": seed,
                "mass": mass,
                "battery": rng.gauss(1.0, 0.1),
                "lock_true_mode": "stuck" if stuck else "as commanded",
                "contact_scatter": 0.05,
                "outcome": "aborted" if rule else "completed",
                "reason": f"{rule}: in words, and <more>" if rule else None,
                "plan_followed": seed % 2 == 0,
                "goal_miss_m": None if rule else seed / FLIGHTS,
            }
            if seed == FLIGHTS:
                cells |= {"outcome": "error", "reason": "ValueError: no (plant.py:3)", "plan_followed": None}
            table.append(line_of([cells.get(name) for name in opened.campaign.columns]))
    return opened


@pytest.fixture(scope="module")
def summary(opened: campaigns.CampaignFolder) -> CampaignSummary:
    return summarise(opened)


def test_an_error_counts_in_no_rate(summary: CampaignSummary) -> None:
    assert (summary.flights, summary.errors, summary.completed.of) == (FLIGHTS, 1, FLIGHTS - 1)
    failed = sum(rule.flights for rule in summary.rules if rule.rule != "ValueError")
    assert summary.completed.count == FLIGHTS - 1 - failed
    assert (summary.plan_followed.count, summary.plan_followed.of) == (FLIGHTS // 2 - 1, FLIGHTS - 1)
    assert summary.figures["goal_miss_m"].flights == summary.completed.count


def test_a_rule_is_told_by_what_made_it_fire(summary: CampaignSummary) -> None:
    rules = {rule.rule: rule for rule in summary.rules}
    assert set(rules) == {"too_heavy", "lock_fault", "ValueError"}
    (heavy,) = rules["too_heavy"].telling
    assert heavy.name == "mass"
    assert heavy.failed > 1.1 > heavy.completed
    assert heavy.chance == 1.0
    assert rules["lock_fault"].telling[0].name == "share of lock_true_mode stuck"
    assert (rules["lock_fault"].telling[0].failed, rules["lock_fault"].telling[0].completed) == (1.0, 0.0)
    assert rules["ValueError"].telling == []


def test_what_matters_comes_first_and_what_never_varied_not_at_all(summary: CampaignSummary) -> None:
    names = [drawn.name for drawn in summary.drawn]
    assert set(names[:2]) == {"mass", "lock_true_mode"}
    assert names[2:] == ["battery"]
    (mass,) = (drawn.bins for drawn in summary.drawn if drawn.name == "mass")
    assert mass[-1].completed.count < mass[0].completed.count
    assert sum(one.completed.of for one in mass) == FLIGHTS - 1
    (words,) = (drawn.bins for drawn in summary.drawn if drawn.name == "lock_true_mode")
    assert {one.value: one.completed.count for one in words}["stuck"] == 0


def test_the_page_shows_it(summary: CampaignSummary) -> None:
    page = campaign_page(summary)
    assert "1 flights ended by a software error" in page
    assert "&lt;more&gt;" in page
    assert page.count("<code>dart-flight dry-run") == len(summary.failed)
    assert re.search(r"<details><summary>\d+ more", page), "many failed flights are folded away"
    assert "--vary lock_true_mode" in summary.failed[0].command


def test_without_matplotlib_the_page_says_what_is_missing(
    summary: CampaignSummary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    page = campaign_page(summary)
    assert f"Not drawn: a picture needs matplotlib: {install_command('report')}." in unescape(page)
    assert "<img" not in page


def test_where_everything_completed_the_page_shows_what_varied(tmp_path: Path) -> None:
    """Of one-point plots of the rate none; the miss over what it follows."""
    asked = CampaignSpec((SINGLE,), vary=("mass", "battery"), runs=40)
    opened = campaigns.open_campaign(asked, tmp_path / "out", resume=False)
    rng = random.Random(4)
    with Table(opened.folder / campaigns.TABLE, opened.campaign.columns) as table:
        for seed in range(1, 41):
            mass = rng.gauss(1.0, 0.1)
            cells: dict[str, str | float | int | bool | None] = {
                "mission": SINGLE, "seed": seed, "mass": mass, "battery": rng.gauss(1.0, 0.1),
                "outcome": "completed", "goal_miss_m": mass**3, "c1_peak_force_n": -mass,
            }  # fmt: skip
            table.append(line_of([cells.get(name) for name in opened.campaign.columns]))
    summary = summarise(opened)
    assert summary.drawn == []
    assert [(v.figure, v.name) for v in summary.varied if abs(v.correlation) > 0.99] == [
        ("goal_miss_m", "mass"),
        ("c1_peak_force_n", "mass"),
    ]
    assert all(len(v.points) == 40 for v in summary.varied)
    page = campaign_page(summary)
    assert "goal miss, m over mass: rank correlation 1.00" in page
    assert "Success versus drawn quantity" not in page


def test_a_campaign_without_a_row_has_a_page(tmp_path: Path) -> None:
    empty = campaigns.open_campaign(CampaignSpec((SINGLE,), vary=("mass",), runs=2), tmp_path, resume=False)
    summary = summarise(empty)
    assert summary.completed.share is None
    assert "2 of 2 flights are not flown yet" in campaign_page(summary)


DUAL = str(packaged("missions", "paper_dual_collision.yaml"))


def two_walls(folder: Path, rows: int, follows: str | None) -> CampaignSummary:
    """Flights of the dual collision (wood flexible, then acrylic rigid); the first peak follows one draw."""
    asked = CampaignSpec((DUAL,), vary=("contact", "wall_offset_m", "mass", "battery"), runs=rows)
    opened = campaigns.open_campaign(asked, folder / "out", resume=False)
    columns, rng = opened.campaign.columns, random.Random(5)
    names = columns[columns.index("seed") + 1 : columns.index("outcome")]
    with Table(opened.folder / campaigns.TABLE, columns) as table:
        for seed in range(1, rows + 1):
            drawn = {name: rng.gauss(1.0, 0.1) for name in names}
            peak_n = rng.gauss(20.0, 1.0) if follows is None else 20.0 * drawn[follows]
            missed = msgspec.json.encode([
                {"what": "collision 1 peak force, N", "planned": 20.0, "flown": 28.0 + seed,
                 "tolerance": 5.0},
                {"what": "collision 2 mode", "planned": "rigid", "flown": None, "tolerance": None},
            ][: 2 if seed % 2 else 0]).decode()  # fmt: skip
            cells: dict[str, str | float | int | bool | None] = {
                **drawn, "mission": DUAL, "seed": seed, "outcome": "completed", "c1_peak_force_n": peak_n,
                "plan_followed": seed % 2 == 0, "not_followed": missed if seed % 2 else None,
            }  # fmt: skip
            table.append(line_of([cells.get(name) for name in columns]))
    return summarise(opened)


@pytest.mark.parametrize(
    ("follows", "seen"),
    [
        ("contact.wood.flexible.k", True),
        ("mass", True),
        ("contact.wood.rigid.k", False),  # the other mode
        ("contact.acrylic.rigid.k", False),  # of a wall that is hit later
        ("wall_offset_m.acrylic", False),
        (None, False),
    ],
)
def test_a_peak_follows_only_what_can_matter_to_it(follows: str | None, seen: bool, tmp_path: Path) -> None:
    summary = two_walls(tmp_path, 40, follows)
    assert [one.name for one in summary.varied if one.figure == "c1_peak_force_n"][:1] == [follows] * seen
    tried = summary.tried["c1_peak_force_n"]
    assert tried == len(("k", "f", "mu", "nu")) + len(("wall_offset_m.wood", "mass", "battery"))
    words = f"c1 peak force, N: none of {tried} drawn quantities is significant"
    assert (words in campaign_page(summary)) is not seen


def test_the_page_says_what_was_not_followed(tmp_path: Path) -> None:
    summary = two_walls(tmp_path, 20, None)
    peak, mode = summary.not_followed
    assert (peak.what, peak.flights, peak.of, peak.not_flown) == ("collision 1 peak force, N", 10, 20, 0)
    assert (peak.planned, peak.flown, peak.tolerance) == (20.0, 38.0, 5.0)
    assert (mode.what, mode.not_flown, mode.planned, mode.flown) == ("collision 2 mode", 10, "rigid", None)
    page = campaign_page(summary)
    assert "Deviations from the plan" in page
    assert "10 of 20" in page


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-5.0, 5.0)] * 2), min_size=20, max_size=80, unique_by=lambda p: p[0]))
def test_the_p_value_is_near_that_of_scipy(pairs: list[tuple[float, float]]) -> None:
    if len({y for _, y in pairs}) < 2:
        return
    exact = scipy.stats.spearmanr(*zip(*pairs, strict=True))
    assert rank_correlation(pairs) == pytest.approx(float(exact.statistic), abs=1e-9)
    found = rank_correlation_chance(float(exact.statistic), len(pairs))
    assert found == pytest.approx(float(exact.pvalue), abs=0.03)


def test_of_a_few_pairs_nothing_is_significant() -> None:
    assert rank_correlation_chance(1.0, 9) == 1.0
    assert rank_correlation_chance(1.0, 10) < 0.001
    assert rank_correlation_chance(0.0, 100) == pytest.approx(1.0)
