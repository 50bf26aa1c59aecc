"""The summary and page of a campaign, from synthetic rows with known relations."""

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
    """Return flights that fail if the vehicle is heavy or the lock is stuck; other draws have no effect."""
    spec = CampaignSpec(
        (SINGLE,), vary=("mass", "battery", "lock_true_mode", "contact_scatter"), runs=FLIGHTS
    )
    opened = campaigns.open_campaign(spec, tmp_path_factory.mktemp("made") / "out", resume=False)
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
                "c1_normal_m_s": -1.0 - 0.2 * seed / FLIGHTS,
            }
            if seed == FLIGHTS:
                cells |= {"outcome": "error", "reason": "ValueError: no (plant.py:3)", "plan_followed": None}
            table.append(line_of([cells.get(name) for name in opened.campaign.columns]))
    return opened


@pytest.fixture(scope="module")
def summary(opened: campaigns.CampaignFolder) -> CampaignSummary:
    return summarise(opened)


def test_a_software_error_is_excluded_from_the_rates(summary: CampaignSummary) -> None:
    assert (summary.flights, summary.errors, summary.completed.of) == (FLIGHTS, 1, FLIGHTS - 1)
    failed = sum(rule.flights for rule in summary.rules if rule.rule != "ValueError")
    assert summary.completed.count == FLIGHTS - 1 - failed
    assert (summary.plan_followed.count, summary.plan_followed.of) == (FLIGHTS // 2 - 1, FLIGHTS - 1)
    assert summary.figures["goal_miss_m"].count == summary.completed.count


def test_the_most_of_the_normal_velocities_is_the_fastest_hit(summary: CampaignSummary) -> None:
    hits = summary.figures["c1_normal_m_s"]
    assert hits.high == pytest.approx(-1.0 - 0.2 * (FLIGHTS - 1) / FLIGHTS)
    assert hits.high < hits.high_95 < hits.median < hits.low_5


def test_a_rule_is_explained_by_the_quantity_that_triggered_it(summary: CampaignSummary) -> None:
    rules = {rule.rule: rule for rule in summary.rules}
    assert set(rules) == {"too_heavy", "lock_fault", "ValueError"}
    (heavy,) = rules["too_heavy"].telling
    assert heavy.name == "mass"
    assert heavy.failed > 1.1 > heavy.completed
    assert heavy.chance == 1.0
    assert rules["lock_fault"].telling[0].name == "share of lock_true_mode stuck"
    assert (rules["lock_fault"].telling[0].failed, rules["lock_fault"].telling[0].completed) == (1.0, 0.0)
    assert rules["ValueError"].telling == []


def test_influential_quantities_come_first_and_constant_ones_are_omitted(summary: CampaignSummary) -> None:
    names = [drawn.name for drawn in summary.drawn]
    assert set(names[:2]) == {"mass", "lock_true_mode"}
    assert names[2:] == ["battery"]
    (mass,) = (drawn.bins for drawn in summary.drawn if drawn.name == "mass")
    assert mass[-1].completed.count < mass[0].completed.count
    assert sum(one.completed.of for one in mass) == FLIGHTS - 1
    (modes,) = (drawn.bins for drawn in summary.drawn if drawn.name == "lock_true_mode")
    assert {one.value: one.completed.count for one in modes}["stuck"] == 0


def test_the_page_shows_errors_and_the_commands_of_failed_flights(summary: CampaignSummary) -> None:
    page = campaign_page(summary)
    assert "1 flights ended by a software error" in page
    assert "&lt;more&gt;" in page
    assert page.count("<code>dart-flight dry-run") == len(summary.failed)
    assert re.search(r"<details><summary>\d+ more", page), "a long list of failed flights is folded"
    assert "--vary lock_true_mode" in summary.failed[0].command


def test_missing_matplotlib_is_reported_with_the_package_to_install(
    summary: CampaignSummary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    page = campaign_page(summary)
    assert f"Not drawn: a picture needs matplotlib: {install_command('report')}." in unescape(page)
    assert "<img" not in page


def test_the_page_shows_correlations_if_every_flight_completed(tmp_path: Path) -> None:
    """The page omits one-point plots of the success rate and plots the miss over its cause."""
    spec = CampaignSpec((SINGLE,), vary=("mass", "battery"), runs=40)
    opened = campaigns.open_campaign(spec, tmp_path / "out", resume=False)
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


def test_a_campaign_without_rows_has_a_page(tmp_path: Path) -> None:
    empty = campaigns.open_campaign(CampaignSpec((SINGLE,), vary=("mass",), runs=2), tmp_path, resume=False)
    summary = summarise(empty)
    assert summary.completed.share is None
    assert "2 of 2 flights are not flown yet" in campaign_page(summary)


DUAL = str(packaged("missions", "paper_dual_collision.yaml"))


def two_wall_summary(folder: Path, rows: int, cause: str | None) -> CampaignSummary:
    """Summarise dual collisions (wood flexible, then acrylic rigid) whose first peak has one cause."""
    spec = CampaignSpec((DUAL,), vary=("contact", "wall_offset_m", "mass", "battery"), runs=rows)
    opened = campaigns.open_campaign(spec, folder / "out", resume=False)
    columns, rng = opened.campaign.columns, random.Random(5)
    names = columns[columns.index("seed") + 1 : columns.index("outcome")]
    with Table(opened.folder / campaigns.TABLE, columns) as table:
        for seed in range(1, rows + 1):
            drawn = {name: rng.gauss(1.0, 0.1) for name in names}
            peak_n = rng.gauss(20.0, 1.0) if cause is None else 20.0 * drawn[cause]
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
    ("cause", "correlated"),
    [
        ("contact.wood.flexible.k", True),
        ("mass", True),
        ("contact.wood.rigid.k", False),  # the other mode
        ("contact.acrylic.rigid.k", False),  # a wall that is hit later
        ("wall_offset_m.acrylic", False),
        (None, False),
    ],
)
def test_a_peak_force_is_correlated_only_with_draws_that_can_affect_it(
    cause: str | None, correlated: bool, tmp_path: Path
) -> None:
    summary = two_wall_summary(tmp_path, 40, cause)
    assert [one.name for one in summary.varied if one.figure == "c1_peak_force_n"][:1] == [cause] * correlated
    tried = summary.tried["c1_peak_force_n"]
    assert tried == len(("k", "f", "mu", "nu")) + len(("wall_offset_m.wood", "mass", "battery"))
    sentence = f"c1 peak force, N: none of {tried} drawn quantities is significant"
    assert (sentence in campaign_page(summary)) is not correlated


def test_the_page_shows_deviations_from_the_plan(tmp_path: Path) -> None:
    summary = two_wall_summary(tmp_path, 20, None)
    peak, mode = summary.not_followed
    assert (peak.what, peak.flights, peak.of, peak.not_flown) == ("collision 1 peak force, N", 10, 20, 0)
    assert (peak.planned, peak.flown, peak.tolerance) == (20.0, 38.0, 5.0)
    assert (mode.what, mode.not_flown, mode.planned, mode.flown) == ("collision 2 mode", 10, "rigid", None)
    page = campaign_page(summary)
    assert "Deviations from the plan" in page
    assert "10 of 20" in page


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-5.0, 5.0)] * 2), min_size=20, max_size=80, unique_by=lambda p: p[0]))
def test_the_p_value_is_close_to_scipys(pairs: list[tuple[float, float]]) -> None:
    if len({y for _, y in pairs}) < 2:
        return
    exact = scipy.stats.spearmanr(*zip(*pairs, strict=True))
    assert rank_correlation(pairs) == pytest.approx(float(exact.statistic), abs=1e-9)
    found = rank_correlation_chance(float(exact.statistic), len(pairs))
    assert found == pytest.approx(float(exact.pvalue), abs=0.03)


def test_fewer_than_ten_pairs_are_never_significant() -> None:
    assert rank_correlation_chance(1.0, 9) == 1.0
    assert rank_correlation_chance(1.0, 10) < 0.001
    assert rank_correlation_chance(0.0, 100) == pytest.approx(1.0)
