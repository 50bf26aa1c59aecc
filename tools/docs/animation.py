"""Draw the animation at the top of the README: the dual collision, flown in simulation.

python -m tools.docs.animation [FILE]

The animation slows down at a hit, because a hit takes only a tenth of a second.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from dart_flight.config.mission import load_mission
from dart_flight.lab.figure_style import FORCE, SET_POINT, Look, in_style, new_figure
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import room_map
from dart_flight.lab.report.figures.labels import name_walls
from dart_flight.lab.report.figures.map_drawing import draw_arrow, draw_map, draw_vehicle
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.lab.report.tracks import angles, in_force, lock_mode, setpoint_series
from dart_flight.run.fast import fly_fast

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "docs" / "img" / "dual_collision.gif"
_LOOK = Look(6.6, 9.0)
_FRAMES_PER_S = 14
_FAST, _SLOW = 1.0, 0.09  # speed relative to real time
_SLOW_BEFORE_S, _SLOW_AFTER_S = 0.04, 0.16
_BEFORE_S, _AFTER_S = 1.4, 3.2  # shown time before the first hit and after the last hit
_HOLD = 14  # number of copies of the last frame
_ARROW_M_PER_N = 0.0075
_WINDOW_S = 0.3


def fly_dual_collision() -> RecordedFlight:
    """Fly the dual collision with the shipped configuration and return the flight."""
    mission = load_mission(ROOT / "missions" / "dual_collision.yaml", ROOT / "configs" / "dart.yaml")
    with tempfile.TemporaryDirectory() as logs:
        verdict = fly_fast(mission, 1, Path(logs))
        if verdict.log is None or verdict.outcome != "completed":
            raise RuntimeError(
                f"the flight for the animation did not complete: {verdict.outcome}, {verdict.reason}"
            )
        return RecordedFlight.read(verdict.log)


def moments(flight: RecordedFlight) -> list[float]:
    """Return the times of the frames, s: even, and dense at the hits."""
    at = [impact.at_s for impact in flight.impacts]
    t, end = at[0] - _BEFORE_S, min(at[-1] + _AFTER_S, flight.shown_span[1])
    found = []
    while t < end:
        found.append(t)
        slow = any(-_SLOW_BEFORE_S < t - hit < _SLOW_AFTER_S for hit in at)
        t += (_SLOW if slow else _FAST) / _FRAMES_PER_S
    return found


class Scene:
    """A figure in which successive times of a flight are drawn."""

    def __init__(self, flight: RecordedFlight) -> None:
        self.flight = flight
        self._sent, self._heading = setpoint_series(flight.course), angles(flight.course, true=True)
        force = flight.course.true_force
        self._force_s, self._force_n = force.time_s, np.hypot(force.force[:, 0], force.force[:, 1])
        self.figure, (self._plan, self._strip) = self._layout()

    @in_style
    def _layout(self) -> tuple[Any, Any]:
        figure, axes = new_figure(_LOOK, 2.75, 1, 2, width_ratios=[1.75, 1.0])
        return figure, axes

    @in_style
    def draw(self, at_s: float) -> None:
        """Draw the figure at a time of the flight."""
        self._draw_plan(at_s)
        self._draw_strip(at_s)

    def _draw_plan(self, at_s: float) -> None:
        axis, flight = self._plan, self.flight
        axis.clear()
        axis.set(xlim=(-0.3, 2.15), ylim=(-1.55, 0.1), aspect="equal")
        axis.set_axis_off()
        room = room_map(flight.mission)
        draw_map(axis, room)
        true = flight.course.true
        air = (true.time_s >= flight.shown_span[0]) & (true.time_s <= at_s)
        axis.plot(*true.position[air, :2].T, color="#000000", linewidth=1.2, zorder=2)
        x, y = self._place(at_s)
        i, known = in_force(self._sent.time_s, np.array([at_s]))
        if known[0] and self._sent.recovery[i[0]]:
            target = self._sent.position[i[0], :2]
            axis.plot(*np.stack([[x, y], target]).T, "--", color=SET_POINT, linewidth=1.0, zorder=2.5)
            axis.plot(*target, "x", color=SET_POINT, markersize=6, zorder=2.5)
        yaw = float(np.interp(at_s, self._heading.time_s, self._heading.yaw))
        mode = lock_mode(flight.course, flight.course.start_us + round(1e6 * at_s))
        draw_vehicle(axis, flight.mission.vehicle.airframe, (x, y), yaw, mode)
        force = np.array(
            [np.interp(at_s, self._force_s, flight.course.true_force.force[:, j]) for j in (0, 1)]
        )
        if np.hypot(*force) > 1.0:
            begin = np.array([x, y])
            draw_arrow(axis, begin, begin + _ARROW_M_PER_N * force, FORCE, linewidth=2.2)
        name_walls(axis, room.walls, 8.0)

    def _draw_strip(self, at_s: float) -> None:
        axis = self._strip
        axis.clear()
        near = np.abs(self._force_s - at_s) < _WINDOW_S
        axis.plot(self._force_s[near] - at_s, self._force_n[near], color=FORCE, linewidth=1.8)
        axis.axvline(0.0, color="#000000", linewidth=0.8)
        axis.set(xlim=(-_WINDOW_S, _WINDOW_S), ylim=(0.0, 80.0), xlabel="time from now, s", ylabel="force, N")
        axis.set_title(self._title(at_s), fontsize=9.0, loc="left")

    def _title(self, at_s: float) -> str:
        mode = lock_mode(self.flight.course, self.flight.course.start_us + round(1e6 * at_s))
        lock = "arms switching" if mode is None else f"arms {mode.value}"
        hits = [hit for hit in self.flight.impacts if hit.at_s - 0.02 <= at_s < hit.at_s + 0.8]
        event = f"hit {hits[-1].verdict.index}: {hits[-1].verdict.wall}" if hits else "in flight"
        return f"{at_s:.2f} s   {lock}\n{event}"

    def _place(self, at_s: float) -> Array:
        true = self.flight.course.true
        return np.array([np.interp(at_s, true.time_s, true.position[:, i]) for i in (0, 1)])


def write(path: Path, flight: RecordedFlight, times: list[float]) -> None:
    """Write the frames of these times as a looping GIF."""
    from matplotlib.animation import PillowWriter  # noqa: PLC0415  (slow)

    scene = Scene(flight)
    writer = PillowWriter(fps=_FRAMES_PER_S)
    with writer.saving(scene.figure, str(path), dpi=100):
        for t in times:
            scene.draw(t)
            writer.grab_frame()
    shrink(path)


def shrink(path: Path) -> None:
    """Store a GIF with one palette of 48 colours for all frames."""
    from PIL import Image, ImageSequence  # noqa: PLC0415  (comes with matplotlib)

    with Image.open(path) as image:
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(image)]
    palette = frames[len(frames) // 2].quantize(48)
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    period = 1000 // _FRAMES_PER_S
    small[0].save(path, save_all=True, append_images=small[1:], duration=period, loop=0, optimize=True)


if __name__ == "__main__":
    dual_collision = fly_dual_collision()
    frames_s = moments(dual_collision)
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else FILE
    write(target, dual_collision, frames_s + [frames_s[-1]] * _HOLD)
