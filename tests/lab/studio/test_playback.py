"""A recorded flight as data of the player, and a flight in progress through its growing log."""

import math
from pathlib import Path

import numpy as np
import pytest

from dart_flight.config.document import InputError
from dart_flight.config.mission import load_mission
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.lab.report.tracks import angles
from dart_flight.lab.studio.playback import Playback, playback_of, value_at
from dart_flight.lab.studio.watching import WatchedFlight, growing_log
from dart_flight.run.fast import fly_fast
from tests.lab.studio.files import DUAL


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    verdict = fly_fast(load_mission(DUAL), 1, tmp_path_factory.mktemp("flights"))
    return Path(str(verdict.log))


@pytest.fixture(scope="module")
def flight(log: Path) -> RecordedFlight:
    return RecordedFlight.read(log)


@pytest.fixture(scope="module")
def playback(flight: RecordedFlight) -> Playback:
    found = playback_of(flight)
    assert found is not None
    return found


def test_the_player_shows_the_true_motion(flight: RecordedFlight, playback: Playback) -> None:
    true = flight.course.true
    for at_s in np.linspace(playback.time_s[0], playback.time_s[-1], 50):
        position, quaternion = playback.frame(float(at_s))
        expected = [np.interp(at_s, true.time_s, true.position[:, i]) for i in range(3)]
        assert position == pytest.approx(expected, abs=0.01)
        assert np.linalg.norm(quaternion) == pytest.approx(1.0)


def test_the_hits_and_their_charts_are_those_of_the_report(
    flight: RecordedFlight, playback: Playback
) -> None:
    assert playback.completed
    assert [hit.number for hit in playback.hits] == [1, 2]
    for hit, impact in zip(playback.hits, flight.impacts, strict=True):
        rows = {row.name: row for row in impact.compared}
        for chart, name in ((hit.normal, "peak normal force"), (hit.friction, "peak friction force")):
            for curve, value in ((chart.planned, rows[name].planned), (chart.true, rows[name].true)):
                assert np.isfinite(curve).all()
                assert value is None or np.abs(curve).max() == pytest.approx(abs(value), rel=0.06)
    assert playback.next_hit(0.0) is playback.hits[0]
    assert playback.next_hit(playback.hits[0].at_s) is playback.hits[1]
    assert playback.next_hit(playback.hits[1].at_s) is playback.hits[0]


def test_the_chart_of_the_lock_agrees_with_the_simulated_arms_at_each_hit(playback: Playback) -> None:
    chart = playback.lock_chart
    assert chart is not None
    for hit in playback.hits:
        at = int(np.searchsorted(chart.time, hit.at_s)) - 1
        assert chart.planned[at] == chart.measured[at] == chart.true[at]
        assert value_at(playback.lock, hit.at_s, "") == hit.summary.split(",")[0]


def test_the_nose_of_the_vehicle_goes_up_with_the_pitch(flight: RecordedFlight, playback: Playback) -> None:
    true = angles(flight.course, true=True)
    for at_s in playback.time_s[:: len(playback.time_s) // 20]:
        w, x, y, z = playback.frame(float(at_s))[1]
        up = math.asin(2 * (x * z - w * y))
        assert up == pytest.approx(np.interp(at_s, true.time_s, true.pitch), abs=0.01)


def test_a_growing_log_is_followed_to_its_end(log: Path, playback: Playback, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no flight in progress"):
        growing_log(tmp_path)
    data, copy = log.read_bytes(), tmp_path / "now/flight.mcap"
    copy.parent.mkdir()
    copy.write_bytes(data[: len(data) // 2])
    assert growing_log(tmp_path) == copy
    watched = WatchedFlight(copy)
    assert watched.mission.name == "dual-collision"
    assert watched.ended is None
    watched.update()
    with copy.open("ab") as file:
        file.write(data[len(data) // 2 :])
    state = watched.update()
    assert watched.ended == "completed"
    assert state.position is not None
    assert state.quaternion is not None
    forward_up = 2 * (state.quaternion[1] * state.quaternion[3] - state.quaternion[0] * state.quaternion[2])
    assert abs(forward_up) < 0.1  # it stands
    assert state.position[:2] == pytest.approx(playback.position[-1][:2], abs=0.2)
    assert state.phase == "done"
    assert state.lock in ("rigid", "flexible")
