"""The animation of a page: its data, its size, and the map beside it."""

from __future__ import annotations

import itertools
import json
import re
from typing import Any

import numpy as np
import pytest

from dart_flight.lab.report.figures.flight_map import flight_map
from dart_flight.lab.report.page import flight_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.run.fast import fly_fast
from dart_flight.run.replay import Replay
from tests.lab.report.ten_hits import many_hits
from tests.shared_flights import SharedFlights

DATA = re.compile(r'<script type="application/json" id="flight-data">(.*?)</script>', re.DOTALL)


@pytest.fixture(scope="session")
def six_collisions(flown: SharedFlights) -> RecordedFlight:
    """Return a flight with six collisions."""
    mission = many_hits(6)
    folder = flown.once("six-hits", lambda cache: fly_fast(mission, 1, cache))
    return RecordedFlight.read(next(folder.glob("*/flight.mcap")))


@pytest.fixture(scope="session")
def six_collisions_page(six_collisions: RecordedFlight) -> str:
    """Return the page of the six collisions without a replay, which takes long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "dart_flight.lab.report.recorded_flight.replay",
            lambda _: Replay(0, 0, True, [], [], [], 0, "not in this test"),
        )
        return flight_page(six_collisions)


# --- data ----------------------------------------------------------------------------------------------


def animation_data(page: str) -> dict[str, Any]:
    found = DATA.search(page)
    assert found is not None
    data: dict[str, Any] = json.loads(found[1])
    return data


def test_the_animation_data_are_complete_ordered_and_match_the_flight(
    flight: RecordedFlight, page: str
) -> None:
    data = animation_data(page)
    times = np.array(data["t"])
    assert (np.diff(times) > 0).all()
    for name in ("x", "y", "z", "speed", "yaw", "pitch", "roll"):
        assert len(data[name]) == times.size
    for name in ("x", "y", "true"):
        assert len(data["force"][name]) == len(data["force"]["t"])
    assert (np.diff(data["force"]["t"]) > 0).all()
    for name in ("setpoints", "lock", "phases"):
        moments = [row[0] for row in data[name]]
        assert moments == sorted(moments)
        assert moments
    assert [hit["n"] for hit in data["hits"]] == [i.verdict.index for i in flight.impacts]
    true = flight.course.true
    for hit, impact in zip(data["hits"], flight.impacts, strict=True):
        assert hit["t"] == pytest.approx(1e3 * impact.at_s, abs=1.0)
        shown = [np.interp(hit["t"], times, data[axis]) * 1e-3 for axis in "xyz"]
        expected = [np.interp(impact.at_s, true.time_s, true.position[:, i]) for i in range(3)]
        assert shown == pytest.approx(expected, abs=0.005)
        near = np.abs(np.array(data["force"]["t"]) - hit["t"]) < 150
        nx, ny = impact.collision.wall.normal
        force = 0.1 * (nx * np.array(data["force"]["x"]) + ny * np.array(data["force"]["y"]))[near].max()
        assert force == pytest.approx(impact.verdict.measured.peak_force_n, rel=0.15)


def test_animation_frames_are_denser_around_an_impact(page: str) -> None:
    data = animation_data(page)
    times = np.array(data["t"])
    at = data["hits"][0]["t"]
    near = np.diff(times[np.abs(times - at) < 150])
    assert near.max() <= 10
    assert np.diff(times).max() <= 40


@pytest.mark.rest
def test_the_page_of_six_collisions_is_smaller_than_700_kilobytes(
    six_collisions: RecordedFlight, six_collisions_page: str
) -> None:
    assert len(six_collisions.impacts) == 6
    assert len(six_collisions_page.encode()) < 700_000
    assert len(animation_data(six_collisions_page)["hits"]) == 6


@pytest.mark.parametrize("count", [3, 6])
@pytest.mark.rest
def test_labels_of_many_collisions_do_not_overlap(six_collisions: RecordedFlight, count: int) -> None:
    flight = six_collisions if count == 6 else _first_hits(six_collisions, count)
    figure = flight_map([flight])
    figure.draw_without_rendering()
    axis = figure.axes[0]
    boxes = {text.get_text(): text.get_window_extent() for text in axis.texts if text.get_text()}
    hits = [name for name in boxes if re.match(r"\d+: \d+ N", name)]
    assert len(hits) == count
    names = [name for name in boxes if "acrylic" in name or "wood" in name]
    assert len(names) == 4
    page = axis.get_window_extent()
    for one, other in itertools.combinations([*hits, *names], 2):
        a, b = boxes[one], boxes[other]
        width = min(a.x1, b.x1) - max(a.x0, b.x0)
        height = min(a.y1, b.y1) - max(a.y0, b.y0)
        assert width <= 1.0 or height <= 1.0, f"{one} lies over {other}"
    for name in hits:
        assert boxes[name].x0 > page.x0 - 2
        assert boxes[name].x1 < page.x1 + 2


def _first_hits(flight: RecordedFlight, count: int) -> RecordedFlight:
    """Return the flight with only its first impacts."""
    other = RecordedFlight(flight.log)
    other.impacts = other.impacts[:count]
    return other


def test_the_content_security_policy_forbids_external_content(page: str, comparison: str) -> None:
    for text, scripts in ((page, "'sha256-"), (comparison, "'none'")):
        policy = re.search(r'Content-Security-Policy" content="([^"]+)"', text)
        assert policy is not None
        rules = dict(rule.strip().split(" ", 1) for rule in policy[1].split(";"))
        assert rules["default-src"] == "'none'"
        assert rules["img-src"] == "data:"
        assert rules["script-src"].startswith(scripts)
