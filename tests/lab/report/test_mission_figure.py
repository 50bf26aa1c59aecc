"""The figure of a mission before its flight shows the prediction of the flight model."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from matplotlib.text import Text

from dart_flight.check.mission_check import check_collisions
from dart_flight.cli import main
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.packages import install_command
from dart_flight.config.vehicle import packaged
from dart_flight.lab.figure_style import as_svg
from dart_flight.lab.report.figures.map_drawing import along
from dart_flight.lab.report.figures.mission_figure import mission_figure, prediction_lines
from dart_flight.lab.search.drawn import predict_with_draws
from dart_flight.planning.predicted_flight import predict_mission
from tests.lab.report.svg import texts_of

DUAL = str(packaged("missions", "paper_dual_collision.yaml"))


def test_every_collision_is_labelled_with_its_speed_and_force(dual: Mission) -> None:
    planned = predict_mission(dual)
    texts = texts_of(as_svg(mission_figure(dual, planned)))
    words = " ".join(texts)
    for index, hit in planned.hits.items():
        speed = np.hypot(hit.normal_m_s, hit.tangential_m_s)
        force = np.hypot(hit.normal_n, hit.tangential_n)
        assert f"{index} {dual.collisions[index - 1].mode.value}" in words
        assert f"{speed:.2f} m/s, {force:.0f} N" in words
    assert {"wood", "acrylic", "run-up begins", "recovery setpoint"} <= set(texts)
    assert f"Passes the goal at a distance of {planned.goal_miss_m:.2f} m" in words


def test_draws_without_spread_equal_the_plan(dual: Mission) -> None:
    estimation = dual.vehicle.estimation
    without_spread = msgspec.structs.replace(
        estimation, walls=msgspec.structs.replace(estimation.walls, spread=1e-9)
    )
    mission = msgspec.structs.replace(
        dual, vehicle=msgspec.structs.replace(dual.vehicle, estimation=without_spread)
    )
    nominal = predict_mission(mission).goal_miss_m
    assert [f.goal_miss_m for f in predict_with_draws(mission, 3)] == pytest.approx([nominal] * 3, abs=1e-6)
    spread = [f.goal_miss_m for f in predict_with_draws(dual, 20)]
    assert np.std([miss for miss in spread if miss is not None]) > 0.01


@pytest.mark.rest
def test_draws_vary_the_position_and_direction_of_uncertain_walls(dual: Mission) -> None:
    known = predict_with_draws(dual, 60)
    assert all(not flight.walls for flight in known)
    for sd_m, yaw_deg in ((0.05, 0.0), (0.0, 3.0)):
        uncertain_wall = dual.replace({"walls.wood.position_sd_m": sd_m, "walls.wood.yaw_sd_deg": yaw_deg})
        drawn = predict_with_draws(uncertain_wall, 60)
        assert {wall.name for flight in drawn for wall in flight.walls} == {"wood"}
        pairs = [(a, b) for a, b in zip(known, drawn, strict=True) if 1 in a.hits and 1 in b.hits]
        assert len(pairs) > 40
        # With equal coefficients, the distance from the drawn plane equals that from the mission's plane.
        wood = next(wall for wall in dual.walls if wall.name == "wood")
        nominal_m = [wood.signed_distance(a.hits[1].position) for a, _ in pairs]
        drawn_m = [b.walls[0].signed_distance(b.hits[1].position) for _, b in pairs]
        assert drawn_m == pytest.approx(nominal_m, abs=1e-6 if yaw_deg == 0.0 else 0.005)
        assert np.std([b.hits[1].position[1] - a.hits[1].position[1] for a, b in pairs]) > 0.3 * sd_m
        directions = [b.walls[0].normal[0] for _, b in pairs]
        assert np.std(directions) == pytest.approx(np.radians(yaw_deg), rel=0.3, abs=1e-9)
    uncertain = dual.replace({"walls.wood.position_sd_m": 0.05})
    words = prediction_lines(uncertain, predict_mission(uncertain), predict_with_draws(uncertain, 20))
    assert any("The positions of wood are varied" in line for line in words)


def heights_in_the_side_view(mission: Mission) -> tuple[dict[str, float], list[float]]:
    """Return the height of each collision's number, and of every star, which marks the goal."""
    side = mission_figure(mission, predict_mission(mission)).axes[1]
    stars = [float(line.get_ydata()[0]) for line in side.lines if line.get_marker() == "*"]
    return {text.get_text(): float(text.xy[1]) for text in side.texts}, stars


def test_the_side_view_shows_the_altitude_of_the_waypoints(dual: Mission) -> None:
    higher = dual.replace({"waypoints": [{"position_m": [0.0, 0.0], "altitude_m": 1.5}]})
    assert heights_in_the_side_view(dual) == ({"1": 1.0, "2": 1.0}, [1.0])
    assert heights_in_the_side_view(higher) == ({"1": 1.5, "2": 1.5}, [1.5])


def test_the_text_gives_the_quantiles_of_the_draws(dual: Mission) -> None:
    drawn = predict_with_draws(dual, 20)
    low, high = np.quantile([f.goal_miss_m for f in drawn if f.goal_miss_m is not None], (0.05, 0.95))
    line = prediction_lines(dual, predict_mission(dual), drawn)[-1]
    assert [float(v) for v in re.findall(r"\d\.\d\d", line)] == pytest.approx([low, high], abs=0.006)
    assert "± 30 %" in line


def test_the_room_of_an_unflyable_mission_is_drawn(dual: Mission) -> None:
    words = texts_of(as_svg(mission_figure(dual, None)))
    assert {"wood", "acrylic", "goal"} <= set(words)
    assert any("cannot be flown" in word for word in words)


@pytest.mark.parametrize(
    ("extension", "begin"),
    [
        ("svg", b"<?xml"),
        pytest.param("png", b"\x89PNG", marks=pytest.mark.rest),
        pytest.param("pdf", b"%PDF", marks=pytest.mark.rest),
    ],
)
def test_the_format_of_the_picture_follows_the_file_extension(
    extension: str, begin: bytes, tmp_path: Path
) -> None:
    path = tmp_path / f"mission.{extension}"
    assert main(["check", DUAL, "--plot", str(path)]) == 0
    assert path.read_bytes().startswith(begin)


def test_an_unsupported_format_or_missing_matplotlib_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["check", DUAL, "--plot", str(tmp_path / "mission.gif")]) == 2
    assert "mission.gif: the picture must be a .png, .svg or .pdf file" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["check", DUAL, "--plot", str(tmp_path / "mission.png")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert install_command("report") in error


def test_a_mission_of_waypoints_shows_its_trajectories() -> None:
    mission = load_mission(packaged("missions", "square.yaml"))
    figure = mission_figure(mission, predict_mission(mission))
    texts = set(texts_of(as_svg(figure)))
    assert {"1", "2, 6: 1 m high", "3: 1.4 m high"} <= texts
    assert {"waypoint", "predicted trajectory", "goal"} <= texts
    plan, side = figure.axes[:2]
    (x0, x1), (y0, y1), (_, z1) = plan.get_xlim(), plan.get_ylim(), side.get_ylim()
    for waypoint in mission.waypoints:
        if waypoint.position is not None:
            x, y, z = waypoint.position
            assert x0 < x < x1
            assert y0 < y < y1
            assert z < z1


def oblique(mission: Mission) -> Mission:
    """Return the mission with the second wall turned by 20 degrees; its recovery keeps the heading."""
    angle = math.radians(20.0)
    return mission.replace({"walls.acrylic.normal": [-math.cos(angle), -math.sin(angle)]})


def with_waypoints(mission: Mission) -> Mission:
    """Return the mission with two waypoints after the last recovery."""
    places = ([0.5, 0.9], [-0.5, 0.3])
    return mission.replace({"waypoints": [{"after": 2, "position_m": place} for place in places]})


def plain(mission: Mission) -> Mission:
    return mission


PICTURES = [
    pytest.param("dual_collision", with_waypoints, marks=pytest.mark.rest),
    ("dual_collision_replan", oblique),
    ("hairpin", plain),
    pytest.param("touch_and_return", plain, marks=pytest.mark.rest),
]


@pytest.mark.rest
@pytest.mark.parametrize(("name", "changed"), PICTURES)
def test_no_label_lies_on_a_line_and_the_bounds_are_shown(
    name: str, changed: Callable[[Mission], Mission]
) -> None:
    mission = changed(load_mission(packaged("missions", f"{name}.yaml")))
    figure = mission_figure(mission, predict_mission(mission))
    plan = figure.axes[0]
    figure.canvas.draw()
    bounds, (x0, x1), (y0, y1) = mission.bounds, plan.get_xlim(), plan.get_ylim()
    assert x0 <= bounds.x[0] < bounds.x[1] <= x1
    assert y0 <= bounds.y[0] < bounds.y[1] <= y1
    for text in plan.texts:
        if not text.get_text() or text.get_text() == "N":
            continue
        low, high = Text.get_window_extent(text).get_points()
        for line in plan.lines:
            if line.get_linestyle() == "None" or " draws" in line.get_label() or not len(line.get_xydata()):
                continue
            points = plan.transData.transform(along(np.array(line.get_xydata(), dtype=float)))
            inside = (points > low + 1.0) & (points < high - 1.0)
            assert not inside.all(axis=1).any(), f"{text.get_text()!r} lies on {line.get_label()!r}"


@pytest.mark.parametrize(
    ("name", "changed", "begin", "end"),
    [
        pytest.param("dual_collision", with_waypoints, "hit", "setpoint", marks=pytest.mark.rest),
        ("dual_collision_replan", oblique, "hit", "goal"),
        ("touch_and_return", plain, "first hit", "setpoint"),
    ],
)
def test_the_leg_after_each_recovery_is_drawn(
    name: str, changed: Callable[[Mission], Mission], begin: str, end: str
) -> None:
    mission = changed(load_mission(packaged("missions", f"{name}.yaml")))
    planned = predict_mission(mission)
    hit = planned.hits[1 if begin == "first hit" else len(mission.collisions)]
    wanted = [hit.position, mission.goal.position_m if end == "goal" else hit.setpoint]
    plan = mission_figure(mission, planned).axes[0]
    drawn = [line.get_xydata() for line in plan.lines if line.get_label() == "predicted trajectory"]
    assert any(path.shape == (2, 2) and np.allclose(path, wanted) for path in drawn)


def test_an_oblique_second_impact_is_shown_with_its_incidence() -> None:
    mission = oblique(load_mission(packaged("missions", "dual_collision_replan.yaml")))
    planned = predict_mission(mission)
    assert "incidence 20°" in " ".join(texts_of(as_svg(mission_figure(mission, planned))))
    found = {f.item: f for f in check_collisions(mission, planned)}["approach_2"]
    hit = planned.hits[2]
    assert found.figures["incidence_deg"] == pytest.approx(20.0)
    assert found.figures["normal_m_s"] == hit.normal_m_s
    assert f"at {-hit.normal_m_s:.2f} m/s, {abs(hit.tangential_m_s):.2f} m/s along the wall" in found.message
    assert "incidence 20 degrees: one guard touches first" in found.message
