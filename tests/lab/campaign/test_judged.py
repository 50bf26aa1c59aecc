"""Campaigns with their own judge and cases, whose rows are the judge's results."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.records import Mode, TruthContact
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.lab.campaign import campaign_folder as campaigns
from dart_flight.lab.campaign import flight_job
from dart_flight.lab.campaign.campaign_folder import Landings
from dart_flight.lab.campaign.campaign_spec import (
    Campaign,
    CampaignSpec,
    Item,
    Point,
    load_specification,
    named_function,
    points_of,
    row_type,
)
from dart_flight.lab.campaign.flight_job import FlownFlight, ItemFlyer
from dart_flight.run.workers import FinishedItem, Interrupt, attempt

ROOT = Path(__file__).parents[3]
MISSION = str(ROOT / "tests" / "data" / "near_wall.yaml")
HERE = "tests.lab.campaign.test_judged"
FLY, JUDGE = f"{HERE}:fly_nothing", f"{HERE}:judge_nothing"


class Row(msgspec.Struct, frozen=True):
    """A row with every type of field that a judge may return."""

    number: float | None
    count: int
    sure: bool
    mode: Mode | None
    words: str
    pairs: list[tuple[int, float]]


def judge_contacts(flown: FlownFlight) -> Row:
    contacts = [e.record for e in flown.log.entries if isinstance(e.record, TruthContact)]
    pairs = [(c.t_us, c.normal_in_m_s) for c in contacts]
    return Row(
        flown.verdict.max_tilt_deg, len(contacts), bool(contacts), Mode.RIGID, flown.point.case["word"], pairs
    )


def fly_nothing(point: Point, seed: int) -> tuple[Point, int]:
    if seed == 2:
        raise ValueError("no such world")
    return point, seed


def judge_nothing(flown: tuple[Point, int]) -> Row:
    point, seed = flown
    return Row(None, seed, False, None, point.case["word"], [])


def three_cases() -> list[dict[str, str]]:
    return [{"word": word} for word in ("a", "b, c", "d")]


def judge_without_type(flown: FlownFlight):  # type: ignore[no-untyped-def]
    return flown


def fly_in_this_process(flyer: ItemFlyer, items: Iterable[Item], interrupt: Interrupt) -> Landings:
    for item in items:
        yield FinishedItem(item, attempt(flyer, item))


def fly_rows(spec: CampaignSpec, out: Path, resume: bool = False) -> list[flight_job.JudgedRow]:
    opened = campaigns.open_campaign(spec, out, resume)
    campaigns.fly(opened, fly_in_this_process, Interrupt())
    return campaigns.read_rows(opened)


@pytest.mark.rest
def test_a_judge_receives_the_flight_with_its_truth_records(tmp_path: Path) -> None:
    spec = CampaignSpec((MISSION,), cases=({"word": "near"},), judge=f"{HERE}:judge_contacts")
    (row,) = fly_rows(spec, tmp_path / "out")
    assert row.values == {"word": "near"}
    assert row.row.count == len(row.row.pairs) > 0
    assert row.row.mode is Mode.RIGID
    assert row.row.pairs[0][1] < 0.0


def test_cases_are_flown_with_every_seed_and_errors_become_rows(tmp_path: Path) -> None:
    spec = CampaignSpec((MISSION,), runs=2, cases=f"{HERE}:three_cases", fly=FLY, judge=JUDGE)
    rows = fly_rows(spec, tmp_path / "out")
    assert [(r.values["word"], r.seed) for r in rows] == [(w, s) for s in (1, 2) for w in ("a", "b, c", "d")]
    assert [r.row and (r.row.words, r.row.count) for r in rows[:3]] == [("a", 1), ("b, c", 1), ("d", 1)]
    assert all(r.row is None and "ValueError: no such world" in r.error for r in rows[3:])


def test_resuming_flies_only_items_without_a_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = CampaignSpec((MISSION,), cases=f"{HERE}:three_cases", fly=FLY, judge=JUDGE)
    fly_rows(spec, tmp_path / "out")
    table = tmp_path / "out" / campaigns.TABLE
    whole = table.read_bytes()
    table.write_bytes(whole[:-3])  # truncate the last row
    assert len(fly_rows(spec, tmp_path / "out", resume=True)) == 3
    assert table.read_bytes() == whole
    assert main(["campaign", "--resume", "--out", str(tmp_path / "out")]) == 2
    assert "a function of another program" in capsys.readouterr().err
    with pytest.raises(InputError, match="the judge"):
        fly_rows(msgspec.structs.replace(spec, judge=f"{HERE}:judge_contacts"), tmp_path / "out", resume=True)


@given(
    st.floats(allow_nan=False) | st.none(),
    st.integers(-(2**53), 2**53),
    st.booleans(),
    st.sampled_from(Mode) | st.none(),
    st.text("abc,;\"'[{= ").map(lambda text: " ".join(text.split())),
    st.lists(st.tuples(st.integers(0, 9), st.floats(allow_nan=False, allow_infinity=False))),
)
def test_a_row_survives_writing_and_reading_the_table(
    number: float | None,
    count: int,
    sure: bool,
    mode: Mode | None,
    words: str,
    pairs: list[tuple[int, float]],
) -> None:
    row = Row(number, count, sure, mode, words, pairs)
    cells = {name: flight_job._text(cell) for name, cell in flight_job._judged_cells(row).items()}
    spec = CampaignSpec((MISSION,), judge=f"{HERE}:judge_nothing")
    campaign = Campaign(spec, (), ("mission", "seed", "error", *Row.__struct_fields__), "")
    (read,) = flight_job.judged_rows(campaign, [{"mission": MISSION, "seed": "1", "error": "", **cells}])
    assert read.row == row


def test_an_unknown_key_of_a_specification_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "spec.yaml"
    path.write_text("missions: [a.yaml]\nruns: 3\njudge: x:y\n")
    assert load_specification(path) == CampaignSpec(("a.yaml",), runs=3, judge="x:y")
    path.write_text("missions: [a.yaml]\nrunz: 3\n")
    with pytest.raises(InputError, match="runz"):
        load_specification(path)


def test_missing_functions_and_invalid_cases_are_refused() -> None:
    for name in ("", "no_such_module:f", f"{HERE}:nothing"):
        with pytest.raises(InputError, match="module:function"):
            named_function(name)
    with pytest.raises(InputError, match="annotate"):
        row_type(f"{HERE}:judge_without_type")
    with pytest.raises(InputError, match="same keys"):
        points_of(CampaignSpec((MISSION,), cases=({"a": "1"}, {"b": "1"})))
