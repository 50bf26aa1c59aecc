"""Rendering of templates: escaped text, missing values, number formats and a missing Jinja2."""

from __future__ import annotations

import html
import math
import re
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.summary import share
from dart_flight.config.document import InputError
from dart_flight.config.packages import install_command
from dart_flight.config.provenance import VehicleSource
from dart_flight.config.vehicle import load_vehicle
from dart_flight.lab.campaign.campaign_summary import CampaignSummary, FailedFlight, GridPoint
from dart_flight.lab.inspect.inspection import inspect_file
from dart_flight.lab.report import render as rendering
from dart_flight.lab.report.campaign_page import campaign_page
from dart_flight.lab.report.inspection_page import inspection_page
from dart_flight.lab.report.page import comparison_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.lab.report.render import Cell, Number, PageTable, Row, render, signed, write_number
from dart_flight.recording.reader import Log
from tests.doubles.ulog_file import write_ulog
from tests.lab.inspect.test_inspect import topics

HTML = "<b>[1] & \"two\"<i> 'three' {{ title }}"


def without_tags(page: str) -> str:
    return html.unescape(re.sub(r"<[^>]*>", "", page))


@settings(max_examples=25)
@given(st.text(min_size=1, max_size=40))
def test_names_with_any_characters_are_escaped(name: str) -> None:
    table = PageTable(["", name], [name, [name, {"command": name, "log": name}]])
    page = render(
        "comparison.html", name, missing=[(name, name)], flights=table, map="", errors="", forces=[],
        statistics=table, materials=[], used=dict.fromkeys(("name", "different", "mission", "vehicle"), name),
    )  # fmt: skip
    shown = html.escape(name, quote=False)
    written = page.replace("&#34;", '"').replace("&#39;", "'")
    assert written.count(f"<td>{shown}</td>") == 2
    assert f"<title>{shown}</title>" in written
    assert f"<pre>{shown}</pre>" in written
    assert f'href="{shown}"' in written


def test_names_in_a_comparison_are_escaped(flight: RecordedFlight) -> None:
    log = flight.log
    about = {**log.about, "mission_text": HTML}
    named = Log(f"/{HTML}/flight.mcap", about, {}, log.entries[:3000], complete=False)
    page = comparison_page([RecordedFlight(named), RecordedFlight(named)])
    assert "<b>[1]" not in page
    assert without_tags(page).count(f"{HTML} (seed 1)") >= 3
    assert page.count("&lt;b&gt;[1] &amp; ") >= 3


def test_names_in_a_campaign_page_are_escaped() -> None:
    settings, rate = {HTML: HTML}, share(1, 2)
    summary = CampaignSummary(
        flights=2, asked=3, errors=0, completed=rate, plan_followed=share(0, 0), figures={},
        points=[GridPoint(HTML, settings, rate, rate)], rules=[], drawn=[], varied=[], tried={},
        not_followed=[], failed=[FailedFlight(HTML, settings, 1, "aborted", HTML, f"{HTML}.mcap", HTML)],
        unexplained_modes=[], vary={}, software=HTML, vehicle=VehicleSource(None, None, 1.3),
    )  # fmt: skip
    page = campaign_page(summary)
    assert "<b>[1]" not in page
    assert without_tags(page).count(HTML) == 9  # software, 3 of the point, 5 of the failed flight
    assert "1 of 3 flights are not flown yet" in page


def test_the_name_of_an_inspected_log_is_escaped(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    page = inspection_page([inspect_file(write_ulog(tmp_path / f"{HTML}.ulg", topics()), load_vehicle())])
    assert "<b>[1]" not in page
    assert f"{HTML}.ulg" in without_tags(page)


def test_a_missing_template_value_is_an_error() -> None:
    from jinja2 import UndefinedError

    with pytest.raises(UndefinedError, match="flights"):
        render("inspection.html", "nothing")
    with pytest.raises(UndefinedError, match="facts"):
        render("inspection.html", "little", flights=[{"log": "", "force": None, "nothing_found": "",
                                                      "impacts": PageTable([], [])}])  # fmt: skip


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"), (math.nan, "–"), (-math.inf, "–"), (0, "0"), (12, "12"), (0.0, "0.000"),
        (-0.5, "-0.500"),
        (1.0, "1.00"), (-12.34, "-12.3"), (999.96, "1000.0"), (1000.4, "1000"),
        (Number("+0.1"), "+0.1"),
    ],
)  # fmt: skip
def test_numbers_are_written_with_three_digits(value: float | None, text: str) -> None:
    assert write_number(value) == text


def test_a_signed_number_near_zero_has_no_sign() -> None:
    assert [signed(v) for v in (None, 0.04, -0.04, 0.05, -1.26)] == [None, "0.0", "0.0", "+0.1", "-1.3"]


def test_numeric_columns_are_recognised_by_their_first_row() -> None:
    command: Cell = {"command": "ls", "log": None}
    rows: list[Row] = ["a heading", ["name", 1.0, None, Number("+1.0"), command], [""] * 5]
    heads = ["", "value", "unknown", "signed", "command"]
    found = PageTable(heads, rows).columns
    assert found == list(zip(heads, [False, True, True, True, False], strict=True))
    assert [numbers for _, numbers in PageTable(heads, []).columns] == [True] * 5


def test_missing_jinja2_is_reported_with_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "_environment", rendering._environment.__wrapped__)
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(InputError, match="a page needs jinja2") as error:
        render("inspection.html", "", flights=[])
    assert install_command("report") in str(error.value)
