"""Draw missions with collisions and the fastest collision-free flights, both flown in simulation.

python -m tools.docs.both_ways [FOLDER]

Each mission gets a picture and an animation with two clocks. One figure compares when both flights of every
mission pass the same places. The collision-free flights are planned first. This planning takes minutes.
"""

from __future__ import annotations

import sys
import tempfile
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import Vec2
from dart_flight.config.mission import Mission
from dart_flight.lab.figure_style import ESTIMATED, GREY, TRUE, Look, in_style, new_figure, save_figure
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import room_map
from dart_flight.lab.report.figures.map_drawing import draw_map, draw_vehicle, set_view, view_of
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.lab.report.tracks import angles, lock_mode
from dart_flight.run.fast import fly_fast
from tests.arrival import arrival_of
from tools.campaigns.arrivals import COLLIDING, FREE, USING_COLLISIONS, both_ways
from tools.docs.animation import shrink

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "img"
_LOOK = Look(6.6, 8.5)
_FRAMES_PER_S, _HOLD = 12, 18  # `_HOLD`: number of copies of the last frame
_BEFORE_S = 0.3
_LINES = {COLLIDING: TRUE, FREE: ESTIMATED}


class FlownVariant:
    """One flight with its clock, which starts with the first trajectory."""

    def __init__(self, name: str, mission: Mission, visits: list[tuple[Vec2, float]]) -> None:
        self.name, self.mission = name, mission
        with tempfile.TemporaryDirectory() as logs:
            verdict = fly_fast(mission, 1, Path(logs))
            if verdict.log is None or verdict.outcome != "completed":
                raise RuntimeError(f"{mission.name}, {name}: {verdict.outcome}, {verdict.reason}")
            self.flight = RecordedFlight.read(verdict.log)
        found = arrival_of(self.flight.log, mission, visits)
        if found is None or found.there_s is None or len(found.visits_us) < len(visits):
            raise RuntimeError(f"{mission.name}, {name}: the flight missed a place")
        course = self.flight.course
        self.begin_s, self.rest_s = course.time_of(round(found.begin_us)), found.there_s
        self.visits_s = [course.time_of(round(t)) - self.begin_s for t in found.visits_us]
        hits_s = (impact.at_s - self.begin_s for impact in self.flight.impacts)
        self.hits_s = [t for t in hits_s if t > 0.0]  # omit touches before the clock starts
        self.time_s = course.true.time_s - self.begin_s

    @cached_property
    def flown(self) -> NDArray[np.bool_]:
        """A mask (n,) of the samples while the clock runs."""
        return np.asarray((self.time_s >= 0.0) & (self.time_s <= self.rest_s), dtype=np.bool_)

    def position_at(self, at_s: float) -> Array:
        """Return the position from above, mission frame."""
        position = self.flight.course.true.position
        return np.array([np.interp(at_s, self.time_s, position[:, i]) for i in (0, 1)])

    def draw(self, axis: Any, at_s: float) -> None:
        """Draw the vehicle at a time."""
        heading = angles(self.flight.course, true=True)
        yaw = float(np.interp(at_s + self.begin_s, heading.time_s, heading.yaw))
        stamp = self.flight.course.start_us + round(1e6 * (at_s + self.begin_s))
        x, y = self.position_at(at_s)
        mode = lock_mode(self.flight.course, stamp)
        draw_vehicle(axis, self.mission.vehicle.airframe, (float(x), float(y)), yaw, mode)


class FlownBothWays:
    """A mission flown with its hits, and the collision-free flight of the same scenario."""

    def __init__(self, name: str) -> None:
        self.name, both = name, both_ways(name)
        self.scenario, self.planned_s = both.scenario, [both.planned_s(way) for way in (COLLIDING, FREE)]
        self.ways = [FlownVariant(way, both.missions[way], both.visits) for way in (COLLIDING, FREE)]

    @property
    def view(self) -> Array:
        """The area that the maps show."""
        tracks = [way.flight.course.true.position[way.flown, :2] for way in self.ways]
        return view_of(room_map(self.ways[0].mission), np.vstack(tracks))

    def draw_map(self, axis: Any, way: FlownVariant, until_s: float) -> None:
        """Draw the room and the path flown so far."""
        draw_map(axis, room_map(way.mission))
        for visit in self.scenario.visits:
            axis.plot(*visit.position_m, "D", color=GREY, markersize=4, zorder=2.2)
        track = way.flight.course.true.position[way.flown & (way.time_s <= until_s), :2]
        axis.plot(*track.T, zorder=2.1, **(_LINES[way.name] | {"linewidth": 1.2}))
        set_view(axis, self.view)
        axis.set_axis_off()

    @in_style
    def draw_picture(self, *, look: Look = _LOOK) -> Any:
        """Draw both flights from above, and their positions along x over elapsed time."""
        figure, axes = new_figure(look, 3.1, 2, 2, height_ratios=[1.0, 1.15])
        for axis, way in zip(axes[0], self.ways, strict=True):
            self.draw_map(axis, way, way.rest_s)
            for at_s in [0.0, *way.hits_s] if way.hits_s else [0.0, self.turn_s(way)]:
                way.draw(axis, at_s)
            axis.set_title(f"{way.name}: at the goal after {way.rest_s:.2f} s", loc="left")
        for axis in axes[1]:
            axis.remove()
        below = figure.add_subplot(axes[1, 0].get_gridspec()[1, :])
        for way in self.ways:
            x = way.flight.course.true.position[way.flown, 0]
            below.plot(way.time_s[way.flown], x, label=way.name, **_LINES[way.name])
            below.plot(way.rest_s, x[-1], "*", color=_LINES[way.name]["color"], markersize=9)
            for t in way.hits_s:
                below.plot(t, way.position_at(t)[0], "o", color="#c2261d", markersize=5, zorder=4)
        below.plot([], [], "o", color="#c2261d", markersize=5, label="hit")
        below.plot(
            [], [], "*", color=GREY, markersize=9, linestyle="none", label="at the goal, nearly at rest"
        )
        below.set(xlabel="elapsed time, s", ylabel="position along x, m", xlim=(0.0, None))
        below.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2)
        return figure

    def turn_s(self, way: FlownVariant) -> float:
        """Return the time at which the collision-free flight is farthest out."""
        x = np.where(way.flown, way.flight.course.true.position[:, 0], -np.inf)
        return float(way.time_s[int(np.argmax(x))])

    @property
    def moments(self) -> list[float]:
        """The times of the frames on the flights' clocks; the last time is repeated."""
        last = max(way.rest_s for way in self.ways)
        times = np.arange(-_BEFORE_S, last + 1.0 / _FRAMES_PER_S, 1.0 / _FRAMES_PER_S)
        return [*map(float, times), *[float(times[-1])] * _HOLD]

    def write_animation(self, path: Path, moments: list[float]) -> None:
        """Write both flights with their clocks as a looping GIF."""
        from matplotlib.animation import PillowWriter  # noqa: PLC0415  (slow)

        figure, axes = self._stage()
        writer = PillowWriter(fps=_FRAMES_PER_S)
        with writer.saving(figure, str(path), dpi=84):
            for at_s in moments:
                self._frame(axes, at_s)
                writer.grab_frame()
        shrink(path)

    @in_style
    def _stage(self, *, look: Look = _LOOK) -> tuple[Any, Any]:
        (x0, y0), (x1, y1) = self.view
        return new_figure(look, 0.4 + 2.2 * float((y1 - y0) / (x1 - x0)), 1, 2)

    @in_style
    def _frame(self, axes: Any, at_s: float, *, look: Look = _LOOK) -> None:
        for axis, way in zip(axes, self.ways, strict=True):
            axis.clear()
            self.draw_map(axis, way, at_s)
            way.draw(axis, min(max(at_s, 0.0), way.rest_s))
            clock = min(max(at_s, 0.0), way.rest_s)
            ending = "  at the goal" if at_s >= way.rest_s else ""
            axis.set_title(f"{way.name}   {clock:.2f} s{ending}", loc="left", fontsize=look.font_pt + 1.5)


@in_style
def draw_two_clocks(missions: list[FlownBothWays], *, look: Look = _LOOK) -> Any:
    """Draw when both flights of every mission pass the same places: visits, the wall, the goal."""
    figure, axes = new_figure(look, 0.75 * len(missions) + 0.4, len(missions), 1, sharex=True)
    for axis, both in zip(axes, missions, strict=True):
        moments = [_named_moments(both, way) for way in both.ways]
        for y, way in zip((1.0, 0.0), both.ways, strict=True):
            axis.plot([0.0, way.rest_s], [y, y], **_LINES[way.name])
            for t in way.hits_s:
                axis.plot(t, y, "o", color="#c2261d", markersize=6, zorder=4)
            axis.plot(way.rest_s, y, "*", color=_LINES[way.name]["color"], markersize=10, zorder=4)
            axis.annotate(
                f"{way.rest_s:.2f} s", (way.rest_s, y), (8, 0), textcoords="offset points", va="center"
            )
        for (name, here), (_, there) in zip(*moments, strict=True):
            axis.plot([here, there], [1.0, 0.0], color=GREY, linewidth=0.8, linestyle=(0, (2, 2)), zorder=1)
            axis.annotate(
                name, (there, 0.0), (0, -9), textcoords="offset points", ha="center", va="top",
                fontsize=look.small_pt, color="#333333",
            )  # fmt: skip
        colliding_s, free_s = (way.rest_s for way in both.ways)
        share = 1.0 - colliding_s / free_s
        words = f"{both.name.replace('_', ' ')}: {free_s - colliding_s:.2f} s saved ({share:.0%})"
        axis.set_title(words, loc="left")
        axis.set(yticks=[1.0, 0.0], yticklabels=["colliding", "free"], ylim=(-0.7, 1.4), xlim=(0.0, None))
        axis.spines["left"].set_visible(False)
        axis.tick_params(axis="y", length=0)
        axis.grid(axis="y", visible=False)
    axes[-1].set_xlabel("elapsed time, s")
    return figure


def _named_moments(both: FlownBothWays, way: FlownVariant) -> list[tuple[str, float]]:
    """Return the names of the places that both flights pass, with the times of one flight."""
    if both.scenario.visits:
        named = [(f"place {k}", t) for k, t in enumerate(way.visits_s, start=1)]
    else:
        named = [("turn", way.hits_s[0] if way.hits_s else both.turn_s(way))]
    return [*named, ("goal", way.rest_s)]


def main() -> None:
    """Fly and draw all missions."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    missions = [FlownBothWays(name) for name in USING_COLLISIONS]
    for both in missions:
        figures = zip(both.planned_s, both.ways, strict=True)
        print(both.name, *(f"{way.name}: planned {s:.2f} s, flown {way.rest_s:.2f} s" for s, way in figures))
        save_figure(both.draw_picture(), folder / f"both_{both.name}.png")
        both.write_animation(folder / f"both_{both.name}.gif", both.moments)
    save_figure(draw_two_clocks(missions), folder / "two_clocks.png")


if __name__ == "__main__":
    main()
