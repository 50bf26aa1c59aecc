"""The page of one flight and of several flights: complete, self-contained and equal to the verdict."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import msgspec
import numpy as np
import pytest

from dart_flight.base.records import GuardEvent, Override, TruthContact, World
from dart_flight.base.summary import mean_half_width
from dart_flight.cli import main
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.figure_style import as_svg
from dart_flight.lab.report.figures import forces, motion
from dart_flight.lab.report.figures import lock_timeline as lock
from dart_flight.lab.report.figures.flight_map import flight_map
from dart_flight.lab.report.page import flight_page
from dart_flight.lab.report.player import player_data
from dart_flight.lab.report.recorded_flight import Compared, RecordedFlight
from dart_flight.recording.about import describe_flight
from dart_flight.recording.reader import Log, LogEntry, read_log
from dart_flight.recording.writer import FlightLog
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from tests.lab.report.svg import texts_of

NEAR = Path(__file__).parents[2] / "data" / "near_wall.yaml"
VOID = {"meta", "img", "br", "link", "hr", "input"}
SECTIONS = [
    "Flight animation",
    "Predicted against measured",
    "Plan versus flight",
    "Force of each impact",
    "Motion",
    "Lock and timing",
    "Guard and decisions",
    "Contact coefficients",
    "Parameters used",
]


class Page(HTMLParser):
    """A parsed page with its tables, headings and links; it fails on unclosed tags."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.headings: list[str] = []
        self.rows: list[list[str]] = []
        self.sources: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)
        self.close()
        assert self.open == [], f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.sources += [v or "" for k, v in attributes if k in ("src", "href", "srcset", "data")]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
        elif tag == "h2":
            self.headings.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data
        elif self.open and self.open[-1] == "h2":
            self.headings[-1] += data

    def row(self, name: str, after: str = "") -> list[str]:
        """Return the first row with a name, under the heading `after` if that is given."""
        under = ""
        for row in self.rows:
            if len(row) == 1:
                under = row[0]
            elif row[0] == name and (not after or under == after):
                return row
        raise AssertionError(f"no row {name} under {after}")


def svgs(page: str) -> list[str]:
    return [
        base64.b64decode(d).decode() for d in re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', page)
    ]


def number(text: str) -> float | None:
    return None if text == "–" else float(text)


def texts(figure: Any) -> set[str]:
    return set(texts_of(as_svg(figure)))


# --- one flight ----------------------------------------------------------------------------------------


def test_a_page_has_every_section_and_needs_no_other_files(page: str) -> None:
    parsed = Page(page)
    assert parsed.headings == SECTIONS
    assert "does not contain the whole flight" not in page
    assert "Position from the motion capture" not in page, "this log has no poses"
    assert parsed.sources
    assert all(source.startswith("data:") for source in parsed.sources)
    assert not parsed.tags & {"link", "iframe", "object"}
    for content in (page, *svgs(page)):
        outside = set(re.findall(r"(?:href|src|url\()\s*=?\s*[\"']?((?:https?:)?//[^\"')\s]+)", content))
        assert not outside


def test_the_table_shows_the_figures_of_the_verdict(flight: RecordedFlight, page: str) -> None:
    parsed = Page(page)
    for impact in flight.impacts:
        v = impact.verdict
        assert v.truth is not None
        for name, field in (
            ("normal velocity, m/s", "normal_m_s"),
            ("tangential velocity, m/s", "tangential_m_s"),
            ("peak normal force, N", "peak_force_n"),
            ("normal velocity out, m/s", "normal_out_m_s"),
            ("tangential velocity out, m/s", "tangential_out_m_s"),
        ):
            _, planned, _, measured, true, error = parsed.row(name, impact.title)
            pairs = [(measured, getattr(v.measured, field)), (true, getattr(v.truth, field))]
            if v.index == 1 and "out" not in name:
                pairs.append((planned, getattr(v.planned, field)))
            for shown, value in pairs:
                assert number(shown) == pytest.approx(value, rel=6e-3, abs=6e-4)
            expected = 100.0 * (getattr(v.measured, field) / getattr(v.truth, field) - 1.0)
            if abs(getattr(v.truth, field)) > 0.05:
                assert float(error) == pytest.approx(expected, abs=0.051)
            else:
                assert error == "–"
        contact = parsed.row("contact time, ms", impact.title)
        assert number(contact[3]) == pytest.approx(v.contact_time_ms, rel=6e-3)


@pytest.mark.rest
def test_truth_prediction_and_estimate_of_a_contact_agree(tmp_path: Path) -> None:
    """The columns come from the plant, the contact law, the flight model and the estimate.

    The vehicle is a point here, as in the law and the flight model.
    """
    configuration = packaged("configs", "dart.yaml")
    mission = load_flyable(
        packaged("missions", "paper_dual_collision.yaml"), configuration, ["simulation.contact.body=point"]
    )
    flight = RecordedFlight.read(Path(str(fly_fast(mission, 1, tmp_path).log)))
    truths = flight.course.all(TruthContact)
    for impact, truth in zip(flight.impacts, truths, strict=True):
        rows = {c.name: c for c in impact.compared}
        assert rows["contact time"].true == (truth.end_us - truth.t_us) / 1000
        assert rows["normal velocity out"].true == truth.normal_out_m_s
        assert rows["peak friction force"].true == abs(truth.peak_friction_force_n)
        for name, tolerance in (
            ("contact time", 0.08),
            ("peak normal force", 0.05),
            ("normal velocity out", 0.12),
        ):
            assert rows[name].predicted == pytest.approx(rows[name].true, rel=tolerance)
            assert rows[name].measured == pytest.approx(rows[name].true, rel=tolerance)
        # The mission gives the first approach; the flight model predicts the second.
        assert rows["normal velocity"].planned == pytest.approx(truth.normal_in_m_s, rel=0.05)
        # The predicted onset coincides with the contact.
        assert impact.onset_s == pytest.approx(flight.course.time_of(truth.t_us), abs=0.002)


def test_the_estimated_force_follows_the_true_force_without_delay(flight: RecordedFlight) -> None:
    """A reading applies to the middle of its tick; half a tick of delay gives 2 N of error on the flanks."""
    course = flight.course
    for impact in flight.impacts:
        wall = impact.collision.wall
        near = (course.true_force.time_s > impact.at_s - 0.02) & (
            course.true_force.time_s < impact.at_s + 0.1
        )
        true = course.true_force.force[near, :2] @ wall.normal
        estimated = course.estimated_force.force[:, :2] @ wall.normal
        found = np.interp(course.true_force.time_s[near], course.estimated_force.time_s, estimated)
        late = np.interp(course.true_force.time_s[near] - 0.003, course.estimated_force.time_s, estimated)
        error = np.abs(found - true).max() / true.max()
        assert error < 0.12
        assert error < np.abs(late - true).max() / true.max()


def test_figures_contain_their_labels_and_legends(flight: RecordedFlight) -> None:
    words = texts(flight_map([flight]))
    assert {"wood", "acrylic", "planned", "flown (true)", "flown (estimated)", "start", "goal"} <= words
    assert {"recovery setpoint", "every second"} <= words
    words = texts(forces.impact_forces(flight, flight.impacts[1]))
    assert {"true", "estimated", "predicted", "normal, N", "vertical, N", "time after detection, ms"} <= words
    assert {"phase", "contact", "may lock", "lock", "flexible"} <= texts(lock.timeline(flight))
    assert {"roll, °", "pitch, °", "yaw, °"} <= texts(motion.attitude(flight))
    assert {"thrust, N", "motors, %", "highest", "lowest"} <= texts(motion.thrust_and_battery(flight))


@pytest.mark.rest
def test_the_page_of_an_aborted_flight_shows_the_reason_and_the_guards_action(
    aborted: Path, tmp_path: Path
) -> None:
    assert main(["report", str(aborted), "-o", str(tmp_path / "page.html")]) == 0
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    page = Page(text)
    assert page.headings == [s for s in SECTIONS if s != "Force of each impact"]
    assert "dual-collision, fast: aborted" in text
    assert (
        "<p class=reason>wall_not_met: no contact, but the vehicle is 0.15 m behind the plane of wall wood"
        in text
    )
    assert any(row[1:3] == ["wall_not_met", "break_off"] for row in page.rows if len(row) == 4)


def test_a_truncated_log_gives_a_page_without_animation(trials: list[Path], tmp_path: Path) -> None:
    whole = trials[0].read_bytes()
    path = tmp_path / "flight.mcap"
    path.write_bytes(whole[: len(whole) // 50])
    assert main(["report", str(path), "-o", str(tmp_path / "page.html")]) == 0
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    Page(text)
    assert "cut short: the end of the flight is missing" in text
    assert "<script" not in text
    assert player_data(RecordedFlight.read(path)) is None


def test_a_log_truncated_before_its_mission_is_refused(
    trials: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "flight.mcap"
    path.write_bytes(trials[0].read_bytes()[:100])
    assert main(["report", str(path), "-o", str(tmp_path / "page.html")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "does not contain its mission" in error


@pytest.mark.rest
def test_text_from_the_log_is_escaped(flight: RecordedFlight) -> None:
    markup = "<script>alert(1)</script>&\"'"
    about = {**flight.log.about, "mission_text": markup, "software": markup, "host": markup}
    mission = flight.mission  # a mission's own name may contain only letters
    walls = {w.name: msgspec.structs.replace(w, name=markup + w.name) for w in mission.walls}
    collisions = tuple(msgspec.structs.replace(c, wall=walls[c.wall.name]) for c in mission.collisions)
    mission = msgspec.structs.replace(mission, walls=tuple(walls.values()), collisions=collisions)
    about["flown"] = msgspec.json.encode(mission).decode()
    last = flight.log.entries[-1].number
    entries = [*flight.log.entries, LogEntry(last, GuardEvent(1, markup, Override.LAND, markup))]
    log = Log(f"/{markup}/flight.mcap", about, flight.log.end, entries, True)
    text = flight_page(RecordedFlight(log))
    Page(text)
    # The page has two scripts of its own: the data of the animation and its player.
    assert re.findall(r"<script[^>]*>", text) == [
        '<script type="application/json" id="flight-data">',
        "<script>",
    ]
    assert "&lt;script&gt;alert(1)&lt;/script&gt;&amp;" in text
    assert all("<script" not in svg for svg in svgs(text))


@pytest.mark.rest
def test_a_rehearsal_has_a_page(tmp_path: Path) -> None:
    rehearsal = msgspec.structs.replace(load_flyable(NEAR), standoff_m=0.3)
    verdict = fly_fast(rehearsal, 1, tmp_path)
    assert verdict.log is not None
    flight = RecordedFlight.read(verdict.log)
    assert flight.planned.approaches
    assert flight.planned.legs == {}
    Page(flight_page(flight))


# --- several flights -----------------------------------------------------------------------------------


def test_the_comparison_shows_the_statistics_of_its_flights(
    flights: list[RecordedFlight], comparison: str
) -> None:
    page = Page(comparison)
    assert "dual-collision, fast: 2 of 2 completed" in comparison
    seeds = [row[0].split("seed ")[1] for row in page.rows if "seed" in row[0]]
    assert sorted(seeds) == ["1)", "2)"]
    for index, title in ((1, "Collision 1: wood, flexible"), (2, "Collision 2: acrylic, rigid")):
        values = [f.impacts[index - 1].verdict.measured.peak_force_n or 0.0 for f in flights]
        _, n, *shown = page.row("peak normal force, N", title)
        assert n == "2"
        expected = [fmean(values), 12.7062 * stdev(values) / 2**0.5, stdev(values), min(values), max(values)]
        assert [float(s) for s in shown] == pytest.approx(expected, rel=6e-3, abs=6e-4)


def test_the_half_width_of_a_mean_matches_scipys_students_t() -> None:
    from scipy import stats

    for n in (2, 5, 11, 12, 20, 100):
        values = [(-1.0) ** i for i in range(n)]
        expected = stats.t.ppf(0.975, n - 1) * stdev(values) / n**0.5
        assert mean_half_width(values) == pytest.approx(expected, rel=2e-4)
    assert mean_half_width([1.0]) is None


def test_an_error_in_percent_needs_a_reference() -> None:
    assert Compared("v", "m/s", None, 2.0, 1.0, None).error_percent == -50.0
    assert Compared("v", "m/s", None, 2.0, 1.0, 4.0).error_percent == -75.0
    assert Compared("v", "m/s", None, None, 1.0, None).error_percent is None
    assert Compared("v", "m/s", None, 2.0, None, 4.0).error_percent is None
    assert Compared("v", "m/s", None, None, 1.0, 0.01).error_percent is None


@pytest.mark.rest
def test_flights_of_different_missions_are_not_compared(
    trials: list[Path], dual: Mission, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = msgspec.structs.replace(dual, altitude_m=1.2)
    path = tmp_path / "other" / "flight.mcap"
    path.parent.mkdir()
    log = FlightLog(path, describe_flight(other, World.FAST, 1))
    for entry in read_log(trials[0]).entries[:2000]:
        log.put(entry.record, entry.number)
    log.close()
    assert main(["report", str(trials[0]), str(path), "-o", str(tmp_path / "page.html")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "another mission" in error


@pytest.mark.rest
def test_an_aborted_flight_is_compared_with_others_of_its_mission(
    trials: list[Path], aborted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(trials[0]), str(aborted), "-o", str(tmp_path / "page.html"), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["verdicts"]) == 2
    assert "1 of 2 completed" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_page_that_cannot_be_written_is_reported_in_one_line(
    trials: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "flight.mcap"
    path.write_bytes(trials[0].read_bytes()[:20_000])  # a short page will do
    assert main(["report", str(path), "-o", str(tmp_path / "none" / "page.html")]) == 2  # no such folder
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.rest
def test_figures_for_a_paper_have_column_width_and_editable_text(
    trials: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "dart_flight.lab.report.page.flight_page", lambda *_, **__: "the same figures once more"
    )
    pdf, folder = tmp_path / "figures.pdf", tmp_path / "figures"
    arguments = ["-o", str(tmp_path / "page.html"), "--pdf", str(pdf), "--svg", str(folder)]
    assert main(["report", str(trials[0]), *arguments]) == 0
    drawn = {path.stem for path in folder.iterdir()}
    assert drawn == {"map", "force_1", "force_2", "motion", "attitude", "tracking", "thrust", "timeline"}
    for path in folder.iterdir():
        text = path.read_text(encoding="utf-8")
        assert re.search(r'<svg [^>]*width="252pt"', text), "3.5 inches"
        assert "<text" in text
    data = pdf.read_bytes()
    assert data.count(b"/Type /Page\n") + data.count(b"/Type /Page ") == len(drawn)
    assert b"/FontType 42" in data or b"/CIDFontType2" in data
    assert b"/Type3" not in data


@pytest.mark.rest
def test_paper_figures_that_cannot_be_written_are_reported(
    trials: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "flight.mcap"
    path.write_bytes(trials[0].read_bytes()[:20_000])  # a short page will do
    page = ["-o", str(tmp_path / "page.html")]
    for option in (["--pdf", str(tmp_path)], ["--svg", str(path / "figures")]):
        assert main(["report", str(path), *page, *option]) == 2
        assert "cannot" in capsys.readouterr().err
