"""The player: a flight in the room with a time slider and charts, and many flights as thin lines."""

from __future__ import annotations

import html
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from viser import uplot

from dart_flight.lab.figure_style import ESTIMATED, PREDICTED, TRUE
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.studio.canvas import (
    BLUE,
    GREEN,
    LIGHT,
    RED,
    Canvas,
    Node,
    Palette,
    Rgb,
    segments,
)
from dart_flight.lab.studio.engine import FlownOne
from dart_flight.lab.studio.panels import GO, NO_GO, QUIET, Wiring, block, line
from dart_flight.lab.studio.playback import ForceChart, Playback, PlayedHit, value_at
from dart_flight.lab.studio.scene_model import VehicleShape
from dart_flight.lab.studio.vehicle_view import VehicleView
from dart_flight.lab.studio.watching import LiveState

_BEFORE_HIT_S = 0.3  # the jump to a hit ends so long before it
_TEXT_S, _FRAME_S = 0.12, 0.04  # shortest interval between two texts and two frames
_NO_FLIGHT = "Fly, or open a flight from a file: this page then plays it."
_OUTCOMES = {"completed": GREEN, "aborted": RED, "released": BLUE}


class Player:
    """The panel *Play*, and what it shows in the room."""

    def __init__(
        self,
        wiring: Wiring,
        canvas: Canvas,
        report: Callable[[], None],
        open_flight: Callable[[FlownOne], None],
    ) -> None:
        gui = wiring.server.gui
        self._canvas, self._wiring, self._open_flight = canvas, wiring, open_flight
        self._view = VehicleView(canvas)
        self._flight: Playback | None = None
        self._hit: PlayedHit | None = None
        self._unit_m, self._palette = 0.05, LIGHT
        self._vehicle: VehicleShape | None = None
        self._begun: tuple[float, float] | None = None  # clock and flight time at the last start
        self._texted = 0.0
        self.at_s = 0.0
        self._title = gui.add_html(block(line(_NO_FLIGHT, QUIET)))
        self._controls = gui.add_folder(None, visible=False)
        with self._controls:
            self._play = wiring.button("Play", self.play_or_pause)
            self._slider = gui.add_slider("time, s", 0.0, 1.0, 0.01, 0.0)
            self._speed = gui.add_slider("speed", 0.1, 4.0, 0.1, 1.0)
            self._next = wiring.button("Next hit", self.jump_to_hit, color="gray")
            self._status = gui.add_html("")
            self._charts: list[Any] = []
            self._report = wiring.button("Report", report, color="gray", visible=not wiring.read_only)
            self._link = gui.add_html("", visible=False)
        wiring.when_changed(self._slider, self.seek)
        wiring.when_changed(self._speed, lambda value: self._restart())

    @property
    def is_playing(self) -> bool:
        return self._begun is not None

    # --- what is shown --------------------------------------------------------------------------------------

    def open(self, flight: Playback, vehicle: VehicleShape, size_m: float, palette: Palette) -> None:
        """Show a flight and start to play it."""
        self.close()
        self._flight, self._vehicle, self._unit_m, self._palette = flight, vehicle, 0.012 * size_m, palette
        colour = GO if flight.completed else NO_GO
        acts = [line(f"{moment.at_s:.2f} s: guard {moment.value}", NO_GO) for moment in flight.guard]
        self._title.content = block(line(flight.name, strong=True), line(flight.summary, colour), *acts)
        begin, end = float(flight.time_s[0]), float(flight.time_s[-1])
        self._slider.min, self._slider.max = begin, end
        self._link.visible = False
        self._next.visible = bool(flight.hits)
        self._controls.visible = True
        self._draw()
        self.seek(begin)
        self.play_or_pause()

    def watch(self, vehicle: VehicleShape, size_m: float, palette: Palette) -> None:
        """Prepare to show a flight in progress with `show_live`."""
        self.close()
        self._vehicle, self._unit_m, self._palette = vehicle, 0.012 * size_m, palette
        self._view.draw(vehicle, self._unit_m, palette)

    def show_live(self, title: str, state: LiveState | None) -> None:
        """Show the newest state of a flight in progress."""
        rows = [line(title, strong=True)]
        if state is None:
            rows.append(line("the mission frame is not known yet", QUIET))
        else:
            with self._wiring.server.atomic():
                self._view.place(np.array(state.position), state.quaternion, state.lock, state.force_n)
            force = math.hypot(*state.force_n)
            rows.append(line(f"{state.phase}, {state.speed_m_s:.2f} m/s, force {force:.0f} N, {state.lock}"))
            rows += [line(f"guard {state.guard}", NO_GO, strong=True)] if state.guard else []
        self._title.content = block(*rows)

    def close(self) -> None:
        """Remove the flight."""
        self._begun = self._flight = self._hit = None
        self._controls.visible = False
        self._title.content = block(line(_NO_FLIGHT, QUIET))
        for chart in self._charts:
            chart.remove()
        self._charts = []
        self._view.remove()

    def use_palette(self, palette: Palette) -> None:
        self._palette = palette
        if self._flight is not None:
            self._draw()
            self._show(force=True)

    def _draw(self) -> None:
        if self._flight is not None and self._vehicle is not None:
            self._view.draw(self._vehicle, self._unit_m, self._palette, self._flight.position)

    def show_report(self, path: str) -> None:
        """Offer the page of the report."""
        self._link.content = block(f'<a href="{html.escape(path)}" target="_blank">open the report</a>')
        self._link.visible = True

    def show_many(self, landed: Sequence[FlownOne]) -> None:
        """Draw many flights as thin lines, in one object for each outcome, with a marker at each end."""
        nodes: list[Node] = []
        for outcome, colour in _OUTCOMES.items():
            flights = [f for f in landed if f.outcome == outcome and len(f.path) > 1]
            if not flights:
                continue
            lines = np.concatenate([np.stack([f.path[:-1], f.path[1:]], axis=1) for f in flights])
            nodes.append(segments(f"/flights/{outcome}", lines, colour, 1.0))
            nodes.append(self._ends(outcome, flights, colour))
        self._canvas.draw("flights", nodes)

    def _ends(self, outcome: str, flights: list[FlownOne], colour: Rgb) -> Node:
        ball = _BALL * 0.7 * self._unit_m
        props = {
            "vertices": np.asarray(ball, dtype=np.float32),
            "faces": _BALL_FACES,
            "batched_wxyzs": np.tile(np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (len(flights), 1)),
            "batched_positions": np.array([f.path[-1] for f in flights], dtype=np.float32),
            "batched_colors": colour,
            "cast_shadow": False,
        }

        def attach(made: Any) -> None:
            def clicked(event: Any) -> None:
                if event.instance_index is not None and event.instance_index < len(flights):
                    self._wiring.post(self._open_flight, flights[event.instance_index])

            if not self._wiring.read_only:
                made.on_click(clicked)

        return Node("batched_meshes_simple", f"/flights/{outcome}_ends", props, attach)

    # --- time -----------------------------------------------------------------------------------------------

    def play_or_pause(self) -> None:
        flight = self._flight
        if flight is None:
            return
        if self.is_playing:
            self._begun = None
        else:
            if self.at_s >= float(flight.time_s[-1]) - 1e-3:
                self.at_s = float(flight.time_s[0])
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
        hit = self._flight and self._flight.next_hit(self.at_s + _BEFORE_HIT_S)
        if hit is None:
            return
        if self.is_playing:
            self.play_or_pause()
        self.seek(max(hit.at_s - _BEFORE_HIT_S, float(self._slider.min)))

    def tick(self) -> None:
        """Show the present time of a flight that plays."""
        flight, begun = self._flight, self._begun
        if flight is None or begun is None:
            return
        end = float(flight.time_s[-1])
        self.at_s = begun[1] + (time.monotonic() - begun[0]) * float(self._speed.value)
        if self.at_s >= end:
            self.at_s = end
            self.play_or_pause()
        self._show(force=not self.is_playing)

    def _show(self, *, force: bool = False) -> None:
        flight, at_s = self._flight, self.at_s
        if flight is None:
            return
        position, quaternion = flight.frame(at_s)
        state = value_at(flight.lock, at_s)
        with self._wiring.server.atomic():
            self._view.place(position, quaternion, state, flight.force_at(at_s), flight.setpoint_at(at_s))
            self._slider.value = round(at_s, 2)
        now = time.monotonic()
        if force or now - self._texted > _TEXT_S:
            self._texted = now
            self._describe(flight, state)

    def _describe(self, flight: Playback, state: str) -> None:
        at_s, hit = self.at_s, flight.hit_near(self.at_s)
        force = math.hypot(*flight.force_at(at_s))
        speed = float(np.interp(at_s, flight.time_s, flight.speed_m_s))
        rows = [
            line(f"{at_s:.2f} s   {value_at(flight.phases, at_s)}", strong=True),
            line(f"{speed:.2f} m/s, force {force:.0f} N" + (f", arms {state}" if state else "")),
        ]
        acted = [m for m in flight.guard if at_s - 1.5 <= m.at_s <= at_s]
        rows += [line(f"guard {m.value}", NO_GO, strong=True) for m in acted]
        if hit is not None:
            rows.append(line(f"hit {hit.number}, {hit.wall}: {hit.summary}", QUIET))
        self._status.content = block(*rows)
        if hit is not self._hit or not self._charts:
            self._hit = hit
            self._chart(flight, hit)

    def _chart(self, flight: Playback, hit: PlayedHit | None) -> None:
        """Show the charts of a hit; the chart of the lock is that of the flight."""
        wanted: list[tuple[str, str, tuple[Array, ...]]] = []
        if hit is not None:
            name = f"hit {hit.number}, {hit.wall}"
            wanted += [
                (f"normal force, N ({name})", "ms after detection", _series(hit.normal)),
                (f"friction, N ({name})", "ms after detection", _series(hit.friction)),
            ]
        if flight.lock_chart is not None:
            wanted.append(("lock: 0 flexible, 1 rigid", "s", tuple(flight.lock_chart)))
        if len(wanted) == len(self._charts):
            for chart, (title, _, data) in zip(self._charts, wanted, strict=True):
                chart.title, chart.data = title, data
            return
        for chart in self._charts:
            chart.remove()
        with self._controls:
            self._charts = [self._plot(i, *one) for i, one in enumerate(wanted)]

    def _plot(self, order: int, title: str, along: str, data: tuple[Array, ...]) -> Any:
        styles = {
            "planned": (PREDICTED["color"], 2.0),
            "measured": (ESTIMATED["color"], 1.8),
            "true": (TRUE["color"] if self._palette is LIGHT else "#f0f0f0", 1.2),
        }
        ink = "#333333" if self._palette is LIGHT else "#cccccc"
        lines = [
            uplot.Series(label=name, stroke=str(colour), width=width)
            for name, (colour, width) in styles.items()
        ]
        return self._wiring.server.gui.add_uplot(
            data,
            (uplot.Series(label=along), *lines),
            title=title,
            scales={"x": uplot.Scale(time=False)},
            axes=(uplot.Axis(stroke=ink), uplot.Axis(stroke=ink, size=42)),
            height=170,
            padding=(14, 10, 0, 0),
            order=1000.0 + order,
        )


def _series(chart: ForceChart) -> tuple[Array, ...]:
    return chart.time_ms, chart.planned, chart.measured, chart.true


# An octahedron: enough for a marker.
_BALL = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], dtype=float)
_BALL_FACES = np.array(
    [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)], dtype=np.uint32
)
