"""The player: a flight in the room with a time slider and charts, or a flight in progress."""

from __future__ import annotations

import html
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
from viser import uplot

from dart_flight.config.document import InputError
from dart_flight.lab.figure_style import ESTIMATED, PREDICTED, TRUE
from dart_flight.lab.report.page import flight_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.lab.studio.canvas import LIGHT
from dart_flight.lab.studio.playback import Chart, Playback, PlayedHit, playback_of, value_at
from dart_flight.lab.studio.room_view import VehicleView
from dart_flight.lab.studio.scene_model import Scene, scene_of_mission
from dart_flight.lab.studio.studio_page import GO, NO_GO, QUIET, StudioPage, block, line
from dart_flight.lab.studio.watching import WatchedFlight, growing_log

_BEFORE_HIT_S = 0.3  # the jump to a hit ends so long before it
_ACTED_S = 1.5  # an action of the guard is shown so long
_TEXT_S = 0.12  # shortest interval between two texts
_REPORTS = 5  # kept pages
_NO_FLIGHT = "Fly, or open a flight from a file: this page then plays it."


class Player:
    """The panel *Play*, and what it shows in the room.

    Attributes:
        at_s: time of the flight that is shown.
        reports: pages by their path, for the server.
    """

    def __init__(self, page: StudioPage, reports: dict[str, str]) -> None:
        self._page, self._view, self.reports = page, VehicleView(page.canvas), reports
        self.flight: Playback | None = None
        self._log = Path()
        self._scene: Scene | None = None
        self._hit: PlayedHit | None = None
        self._begun: tuple[float, float] | None = None  # clock and flight time at the last start
        self._watched: WatchedFlight | None = None
        self._texted = self.at_s = 0.0
        gui = page.gui
        self._title = gui.add_html(block(line(_NO_FLIGHT, QUIET)))
        self._controls = gui.add_folder(None, visible=False)
        self._charts: list[Any] = []
        with self._controls:
            self._play = page.button("Play", self.play_or_pause)
            self._slider = gui.add_slider("time, s", 0.0, 1.0, 0.01, 0.0)
            self._speed = gui.add_slider("speed", 0.1, 4.0, 0.1, 1.0)
            self._next = page.button("Next hit", self.jump_to_hit, color="gray")
            self._status = gui.add_html("")
            page.button("Report", self._report, color="gray", visible=not page.read_only)
            self._link = gui.add_html("", visible=False)
        page.when_changed(self._slider, self.seek)
        page.when_changed(self._speed, lambda value: self._restart())

    @property
    def is_playing(self) -> bool:
        return self._begun is not None

    @property
    def is_moving(self) -> bool:
        """Whether `tick` has something to show."""
        return self.is_playing or self._watched is not None

    def play(self, log: Path) -> None:
        """Read a flight and play it; without an open file, the room becomes that of the flight."""

        def read() -> tuple[Playback | None, Scene]:
            flight = RecordedFlight.read(log)
            return playback_of(flight), scene_of_mission(flight.mission, flight.planned)

        def show(found: tuple[Playback | None, Scene]) -> None:
            flight, scene = found
            if flight is None:
                raise InputError("the log contains no motion in the air", source=str(log))
            self._page.note("")
            self._log = log
            self._prepare(scene)
            self._open(flight)

        self._page.in_background(read, show)

    def _prepare(self, scene: Scene) -> None:
        self.close()
        self._scene = scene
        if self._page.file is None:
            self._page.scene = scene
            self._page.draw()

    def _open(self, flight: Playback) -> None:
        self.flight = flight
        acts = [line(f"{at_s:.2f} s: guard {what}", NO_GO) for at_s, what in flight.guard]
        summary = line(flight.summary, GO if flight.completed else NO_GO)
        self._title.content = block(line(flight.name, strong=True), summary, *acts)
        self._slider.min, self._slider.max = float(flight.time_s[0]), float(flight.time_s[-1])
        self._link.visible, self._next.visible = False, bool(flight.hits)
        self._controls.visible = True
        self.at_s = float(flight.time_s[0])
        self.redraw()
        self.play_or_pause()

    def close(self) -> None:
        """Remove the flight, or stop to watch it."""
        self._begun = self.flight = self._hit = self._watched = None
        self._controls.visible = False
        self._title.content = block(line(_NO_FLIGHT, QUIET))
        self._remove_charts()
        self._view.remove()

    def redraw(self) -> None:
        """Draw the vehicle and its path again, in the present colours."""
        if self._scene is not None and (self.flight is not None or self._watched is not None):
            path = None if self.flight is None else self.flight.position
            self._view.draw(self._scene, self._page.palette, path)
            self._remove_charts()
            self._show(force=True)

    def _report(self) -> None:
        log = self._log
        self._page.note("writing the report")

        def show(text: str) -> None:
            path = f"/report/{log.parent.name}"
            self.reports[path] = text
            for old in list(self.reports)[:-_REPORTS]:
                del self.reports[old]
            self._page.note("")
            link = f'<a href="{html.escape(path)}" target="_blank">open the report</a>'
            self._link.content, self._link.visible = block(link), True

        self._page.in_background(lambda: flight_page(RecordedFlight.read(log)), show)

    # --- a flight in progress -------------------------------------------------------------------------------

    @property
    def watch_label(self) -> str:
        """The label of the button for `watch_or_stop`."""
        return "Watch a flight in progress" if self._watched is None else "Stop watching"

    def watch_or_stop(self) -> None:
        """Begin to watch the flight that writes its log, or stop."""
        if self._watched is not None:
            self.close()
            self._page.note("stopped watching")
            return
        watched = WatchedFlight(growing_log(self._page.log_dir))
        self._prepare(scene_of_mission(watched.mission))
        self._watched = watched
        self.redraw()

    def _show_watched(self, watched: WatchedFlight) -> None:
        try:
            state = watched.update()
        except InputError:
            self._watched = None
            raise
        rows = [line(f"{watched.mission.name}, in progress", strong=True)]
        if state.position is None or state.quaternion is None:
            rows.append(line("the mission frame is not known yet", QUIET))
        else:
            with self._page.server.atomic():
                self._view.place(np.array(state.position), state.quaternion, state.lock, state.force_n)
            force = math.hypot(*state.force_n)
            rows.append(line(f"{state.phase}, {state.speed_m_s:.2f} m/s, force {force:.0f} N, {state.lock}"))
            rows += [line(f"guard {state.guard}", NO_GO, strong=True)] if state.guard else []
        self._title.content = block(*rows)
        if watched.ended is not None:
            self._watched = None
            self.play(watched.log)

    # --- time -----------------------------------------------------------------------------------------------

    def play_or_pause(self) -> None:
        if self.flight is None:
            return
        if self.is_playing:
            self._begun = None
        else:
            if self.at_s >= float(self._slider.max) - 1e-3:
                self.at_s = float(self._slider.min)
            self._begun = (time.monotonic(), self.at_s)
        self._play.label = "Pause" if self.is_playing else "Play"

    def _restart(self) -> None:
        if self.is_playing:
            self._begun = (time.monotonic(), self.at_s)

    def seek(self, at_s: float) -> None:
        self.at_s = float(at_s)
        self._restart()
        self._show(force=True)

    def jump_to_hit(self) -> None:
        """Go to shortly before the next hit, and pause there."""
        hit = self.flight and self.flight.next_hit(self.at_s + _BEFORE_HIT_S)
        if hit is not None:
            if self.is_playing:
                self.play_or_pause()
            self.seek(max(hit.at_s - _BEFORE_HIT_S, float(self._slider.min)))

    def tick(self) -> None:
        """Show the present time of a flight that plays or is watched."""
        if self._watched is not None:
            if time.monotonic() - self._texted > _TEXT_S:
                self._texted = time.monotonic()
                self._show_watched(self._watched)
        elif self._begun is not None:
            begun_s, from_s = self._begun
            self.at_s = from_s + (time.monotonic() - begun_s) * float(self._speed.value)
            if self.at_s >= float(self._slider.max):
                self.at_s = float(self._slider.max)
                self.play_or_pause()
            self._show(force=not self.is_playing)

    def _show(self, *, force: bool = False) -> None:
        flight, at_s = self.flight, self.at_s
        if flight is None:
            return
        arms, setpoint = value_at(flight.lock, at_s, ""), value_at(flight.setpoints, at_s, None)
        with self._page.server.atomic():
            self._view.place(*flight.frame(at_s), arms, flight.force_at(at_s), setpoint)
            self._slider.value = round(at_s, 2)
        if force or time.monotonic() - self._texted > _TEXT_S:
            self._texted = time.monotonic()
            self._describe(flight, arms)

    def _describe(self, flight: Playback, arms: str) -> None:
        at_s, hit = self.at_s, flight.hit_near(self.at_s)
        force = math.hypot(*flight.force_at(at_s))
        speed = float(np.interp(at_s, flight.time_s, flight.speed_m_s))
        rows = [
            line(f"{at_s:.2f} s   {value_at(flight.phases, at_s, '')}", strong=True),
            line(f"{speed:.2f} m/s, force {force:.0f} N" + (f", arms {arms}" if arms else "")),
        ]
        acted = [what for since_s, what in flight.guard if at_s - _ACTED_S <= since_s <= at_s]
        rows += [line(f"guard {what}", NO_GO, strong=True) for what in acted]
        if hit is not None:
            rows.append(line(f"hit {hit.number}, {hit.wall}: {hit.summary}", QUIET))
        self._status.content = block(*rows)
        if hit is not self._hit or not self._charts:
            self._hit = hit
            self._show_charts(flight, hit)

    # --- charts ---------------------------------------------------------------------------------------------

    def _remove_charts(self) -> None:
        for chart in self._charts:
            chart.remove()
        self._charts = []

    def _show_charts(self, flight: Playback, hit: PlayedHit | None) -> None:
        """Show the charts of a hit; the chart of the lock is that of the flight."""
        wanted: list[tuple[str, str, Chart]] = []
        if hit is not None:
            name, along = f"hit {hit.number}, {hit.wall}", "ms after detection"
            wanted += [
                (f"normal force, N ({name})", along, hit.normal),
                (f"friction, N ({name})", along, hit.friction),
            ]
        if flight.lock_chart is not None:
            wanted.append(("lock: 0 flexible, 1 rigid", "s", flight.lock_chart))
        if len(wanted) != len(self._charts):
            self._remove_charts()
            with self._controls:
                self._charts = [self._plot(1000.0 + i, *one) for i, one in enumerate(wanted)]
        for chart, (title, _, data) in zip(self._charts, wanted, strict=True):
            chart.title, chart.data = title, tuple(data)

    def _plot(self, order: float, title: str, along: str, data: Chart) -> Any:
        light = self._page.palette is LIGHT
        styles = (
            ("planned", PREDICTED["color"], 2.0),
            ("measured", ESTIMATED["color"], 1.8),
            ("true", TRUE["color"] if light else "#f0f0f0", 1.2),
        )
        lines = [uplot.Series(label=name, stroke=str(colour), width=width) for name, colour, width in styles]
        ink = "#333333" if light else "#cccccc"
        return self._page.gui.add_uplot(
            tuple(data),
            (uplot.Series(label=along), *lines),
            title=title,
            scales={"x": uplot.Scale(time=False)},
            axes=(uplot.Axis(stroke=ink), uplot.Axis(stroke=ink, size=42)),
            height=170,
            padding=(14, 10, 0, 0),
            order=order,
        )
