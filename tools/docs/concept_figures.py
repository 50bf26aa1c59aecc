"""Draw the figures of `docs/concepts.md` with the software's own functions.

python -m tools.docs.concept_figures [FOLDER]
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from dart_flight.base.geometry import MissionFrame, Vec2
from dart_flight.base.records import ImpactPeak, Mode, Setpoint
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import Airframe, Cam
from dart_flight.contact.law import Onset
from dart_flight.lab.flight_arrays import FlightArrays
from dart_flight.lab.map_model import DrawnWall
from dart_flight.lab.predict.path import trajectory
from dart_flight.lab.predict.prediction import condition, wall_contact
from dart_flight.lab.report.figures.map_drawing import draw_arrow, draw_vehicle, draw_wall
from dart_flight.recording.reader import read_log
from dart_flight.run.fast import fly_fast
from tools.docs.cam import limits_deg, rod_mm

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "img"
# Lines differ in darkness and dash, so that they remain distinct in grey.
DARK, MIDDLE, LIGHT = "#000000", "#0072B2", "#999999"
SOLID, DASHED, DOTTED = "-", (0, (5, 2)), (0, (1, 1.5))
# Free places for the walls' names in the figure of the dual collision.
_WALL_LABELS = {"wood": (-0.5, -1.52), "acrylic": (2.2, 0.5)}
_IMPACT_LABELS = ((-0.75, -0.12), (0.4, 0.37))
_STYLE = {
    "font.size": 9.0,
    "svg.hashsalt": "dart-flight",
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def _figure(width_in: float, height_in: float, columns: int = 1) -> tuple[Any, Any]:
    mpl.rcParams.update(_STYLE)
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    axes = figure.subplots(1, columns, squeeze=False)[0]
    return figure, axes if columns > 1 else axes[0]


def _arrow(axis: Any, begin: Vec2, vector: Vec2, text: str, colour: str, style: Any = SOLID) -> None:
    end = (begin[0] + vector[0], begin[1] + vector[1])
    draw_arrow(axis, begin, end, colour, linestyle=style)
    length = math.hypot(*vector)
    place = (end[0] + 0.13 * vector[0] / length, end[1] + 0.13 * vector[1] / length)
    axis.text(*place, text, color=colour, ha="center", va="center")


def _plain(axis: Any) -> None:
    axis.set_aspect("equal")
    axis.axis("off")


def draw_frames(folder: Path) -> None:
    """Draw local NED, the mission frame, the collision frame of a wall, and the angle of incidence."""
    figure, (left, right) = _figure(8.2, 3.9, columns=2)
    frame = MissionFrame(north_m=0.9, east_m=0.7, heading_rad=math.radians(60.0))

    def on_paper(north: float, east: float) -> Vec2:
        return east, north  # north is up

    def drawn(v_mission: Vec2) -> Vec2:
        n, e, _ = frame.vector_to_ned((*v_mission, 0.0))
        return on_paper(n, e)

    _arrow(left, (0.0, 0.0), on_paper(0.9, 0.0), "north", LIGHT, DASHED)
    _arrow(left, (0.0, 0.0), on_paper(0.0, 0.9), "east", LIGHT, DASHED)
    left.text(-0.05, -0.14, "PX4's local NED\n(down into the page)", color="#666666", ha="left", va="top")
    origin = on_paper(frame.north_m, frame.east_m)
    _arrow(left, origin, drawn((1.0, 0.0)), "x", DARK)
    _arrow(left, origin, drawn((0.0, 1.0)), "y", DARK)
    left.text(origin[0] + 0.12, origin[1] - 0.12, "mission frame\n(z out of the page)", ha="left", va="top")
    left.plot([origin[0]] * 2, [origin[1], origin[1] + 0.62], color=LIGHT, linestyle=DOTTED)
    arc = np.radians(np.linspace(90.0, 30.0, 30))
    left.plot(origin[0] + 0.45 * np.cos(arc), origin[1] + 0.45 * np.sin(arc), color=DARK, linewidth=1.0)
    left.text(origin[0] + 0.08, origin[1] + 0.66, "heading_deg", ha="left", va="bottom")
    left.plot(*zip((0.0, 0.0), origin, strict=True), color=LIGHT, linestyle=DOTTED)
    left.text(0.48, 0.42, "north_m,\neast_m", color="#666666", ha="left", va="center")
    left.set(xlim=(-0.5, 2.1), ylim=(-0.5, 2.3))

    wall = Wall("wall", (0.0, 0.0), (0.0, 1.0), 3.0, "acrylic")
    airframe = _mission("paper_single_wall.yaml").vehicle.airframe
    draw_wall(right, DrawnWall(wall, airframe.wall_surface(wall)))
    right.text(-1.5, -0.42, "wall", ha="left", va="center")
    impact = (-0.5, 0.0)
    for name, axis_vector in (("X†", (1.0, 0.0, 0.0)), ("Y†", (0.0, 1.0, 0.0))):
        vector = wall.from_collision(axis_vector)
        lifted = (impact[0], impact[1] + 0.04)  # slightly off the line of the wall
        _arrow(right, lifted, (0.65 * vector[0], 0.65 * vector[1]), "", DARK)
        right.text(lifted[0] + 0.65 * vector[0] + 0.06, lifted[1] + 0.65 * vector[1] + 0.1, name)
    right.text(impact[0] - 0.1, -0.42, "Z† into the page", ha="left", va="center")
    velocity = wall.from_collision((-1.0, 0.5, 0.0))
    begin = (impact[0] - 0.95 * velocity[0], impact[1] - 0.95 * velocity[1])
    _arrow(right, begin, (0.88 * velocity[0], 0.88 * velocity[1]), "", MIDDLE, DASHED)
    right.text(begin[0], begin[1] + 0.06, "velocity: normal −, tangential +", color=MIDDLE, ha="center")
    turned = wall.parallel_yaw(-0.5 * math.pi) + math.radians(20.0)
    at = (0.95, 0.85)
    draw_vehicle(right, airframe, at, turned, None)
    right.plot([0.55, 1.35], [0.6, 0.6], color=LIGHT, linestyle=DOTTED)
    incidence = f"angle of incidence {math.degrees(wall.incidence(turned)):.0f}°"
    right.text(0.95, 1.15, f"triangle at the leading edge,\n{incidence}", ha="center", va="bottom")
    right.set(xlim=(-1.6, 1.7), ylim=(-0.6, 1.7))
    for axis in (left, right):
        _plain(axis)
    figure.savefig(folder / "concept_frames.png", dpi=150)


def draw_vehicle_to_scale(folder: Path) -> None:
    """Draw the vehicle from above with its sizes, its arms in both modes, and the cam with its rods."""
    vehicle = _mission("paper_single_wall.yaml").vehicle
    figure, (left, right) = _figure(8.2, 3.9, columns=2)
    _draw_sizes(left, vehicle.airframe)
    _draw_cam(right, vehicle.lock.cam if vehicle.lock is not None else None)
    figure.savefig(folder / "concept_vehicle.png", dpi=150)


def _draw_sizes(axis: Any, airframe: Airframe) -> None:
    out, along = airframe.contact_distance_m, airframe.guard_along_m
    up = 0.5 * math.pi  # forward is up on paper
    draw_vehicle(axis, airframe, (0.0, 0.0), up, Mode.RIGID)
    draw_vehicle(axis, airframe, (0.62, 0.0), up, Mode.FLEXIBLE)
    for x, name in ((-0.14, "rigid"), (0.62, "flexible")):
        axis.text(x, -out - 0.04, name, ha="center", va="top")
    for number, motor in enumerate(airframe.motors, start=1):
        axis.text(
            motor.y_m, motor.x_m + math.copysign(0.035, motor.x_m), str(number), ha="center", va="center"
        )
    _arrow(axis, (0.0, 0.0), (0.0, 0.12), "", MIDDLE)
    _arrow(axis, (0.0, 0.0), (0.12, 0.0), "", MIDDLE)
    axis.text(0.012, 0.1, "x", color=MIDDLE)
    axis.text(0.085, -0.035, "y", color=MIDDLE)
    axis.plot([-0.33, 0.9], [out, out], color=DARK, linewidth=1.6)
    axis.text(0.31, out + 0.02, "a wall's surface", ha="center", va="bottom")
    axis.plot([-0.33, 0.9], [0.0, 0.0], color=LIGHT, linestyle=DASHED, linewidth=0.8)
    axis.text(0.31, 0.008, "plane of\nthe centre", ha="center", va="bottom", color="#666666")
    _size(axis, (-0.28, 0.0), (-0.28, out), f"{out:g} m")
    _size(axis, (0.0, -0.29), (along, -0.29), f"guard {along:g} m")
    motor = airframe.motors[0]
    _size(axis, (0.0, -0.38), (abs(motor.y_m), -0.38), f"motor {abs(motor.y_m):g} m")
    axis.set(xlim=(-0.36, 0.92), ylim=(-0.42, 0.3))
    _plain(axis)


def _size(axis: Any, begin: Vec2, end: Vec2, text: str) -> None:
    axis.annotate("", end, begin, arrowprops={"arrowstyle": "<->", "color": "#555555", "linewidth": 0.9,
                                              "shrinkA": 0, "shrinkB": 0})  # fmt: skip
    upright = abs(end[0] - begin[0]) < abs(end[1] - begin[1])
    place = (0.5 * (begin[0] + end[0]), 0.5 * (begin[1] + end[1]))
    shift = (-0.02, 0.0) if upright else (0.0, 0.012)
    axis.text(
        place[0] + shift[0], place[1] + shift[1], text, color="#555555", ha="right" if upright else "center",
        va="center" if upright else "bottom", rotation=90 if upright else 0,
    )  # fmt: skip


def _draw_cam(axis: Any, cam: Cam | None) -> None:
    """Draw the law l = R_cam - r cos theta at both ends, with the extension of each rod."""
    if cam is None:
        raise ValueError("the shipped vehicle has no lock")
    low, high = limits_deg(cam)
    for x, angle, name in ((-42.0, low, "flexible"), (42.0, high, "rigid")):
        reach = rod_mm(cam, angle)
        turn = np.linspace(0.0, 2.0 * math.pi, 73)
        axis.plot(x + cam.r_mm * np.cos(turn), cam.r_mm * np.sin(turn), color=DARK, linewidth=1.0)
        for k in range(4):
            direction = math.radians(45.0 + 90.0 * k)
            d = np.array([math.cos(direction), math.sin(direction)])
            tip = reach * d
            rod = np.stack([0.45 * tip, tip]) + np.array([x, 0.0])
            axis.plot(*rod.T, color=DARK, linewidth=5.0, solid_capstyle="butt")
            # The slot in the arm for the rod.
            slot = np.array([rod_mm(cam, high) - 0.5 * (rod_mm(cam, high) - rod_mm(cam, low)), 30.0])
            side = np.array([-d[1], d[0]])
            for s in (-2.6, 2.6):
                axis.plot(*(slot[:, None] * d + s * side + [x, 0.0]).T, color=LIGHT, linewidth=1.4)
        axis.text(x, -33.0, f"{name}\nθ = {angle:.0f}°, l = {reach:.0f} mm", ha="center", va="top")
    axis.text(0.0, 36.0, f"cam: l = {cam.r_cam_mm:g} mm − {cam.r_mm:g} mm · cos θ", ha="center", va="bottom")
    axis.plot([-10.0, 10.0], [-54.0, -54.0], color="#555555", linewidth=1.6)
    axis.text(0.0, -52.5, "20 mm", ha="center", va="bottom", color="#555555")
    axis.set(xlim=(-80.0, 80.0), ylim=(-58.0, 46.0))
    _plain(axis)


def draw_modes(folder: Path) -> None:
    """Draw the cam's effect on the rods, and the same hit in both modes."""
    vehicle = _mission("paper_single_wall.yaml").vehicle
    figure, (left, right) = _figure(8.2, 3.2, columns=2)
    assert vehicle.lock is not None
    cam = vehicle.lock.cam
    low, high = limits_deg(cam)
    angle = np.linspace(low, high, 91)
    left.plot(angle, [rod_mm(cam, float(a)) for a in angle], color=DARK)
    for at, name, align in (
        (low, "flexible:\nrods drawn back", "left"),
        (high, "rigid:\nrods in the arms", "right"),
    ):
        left.plot(at, rod_mm(cam, at), "o", color=DARK)
        shift = 6.0 if align == "left" else -14.0
        left.text(at + shift, rod_mm(cam, at), name, ha=align, va="top")
    left.set(xlabel="cam angle θ, degrees", ylabel="rod translation l, mm")
    left.set_xticks(np.linspace(low, high, 4))
    left.margins(y=0.15)
    time_s = np.linspace(-0.01, 0.14, 601)
    for mode, colour, style in ((Mode.RIGID, DARK, SOLID), (Mode.FLEXIBLE, MIDDLE, DASHED)):
        hit = wall_contact(condition(vehicle, "acrylic", mode.value, None, 0.0), -1.0, 0.5)
        path = trajectory(hit, time_s, 0.5)
        force = path.normal_force_n
        right.plot(1e3 * time_s, force, color=colour, linestyle=style)
        top = int(np.argmax(force))
        right.text(1e3 * time_s[top] + 4.0, force[top], f"{mode.value}, {force[top]:.0f} N", va="bottom")
    right.set(xlabel="time since the onset, ms", ylabel="normal force, N", ylim=(0.0, 74.0))
    figure.savefig(folder / "concept_modes.png", dpi=150)


def draw_contact(folder: Path) -> None:
    """Draw one hit by both onset rules: depth, velocity and force."""
    vehicle = _mission("paper_single_wall.yaml").vehicle
    figure, axes = _figure(8.2, 2.9, columns=3)
    time_s = np.linspace(-0.02, 0.12, 1401)
    for onset, colour, style in ((Onset.LCP, DARK, SOLID), (Onset.TOUCH, MIDDLE, DASHED)):
        hit = wall_contact(condition(vehicle, "acrylic", "flexible", onset.value, 0.0), -1.0, 0.5)
        # Time starts when the vehicle's centre is in the plane, where both rules agree.
        inward_s = np.linspace(time_s[0], hit.turn_s, 2001)
        to_plane_s = float(np.interp(0.0, -hit.normal(inward_s)[0], inward_s))
        path = trajectory(hit, time_s + to_plane_s, 0.5)
        values = (1e3 * path.normal_m, path.normal_m_s, path.normal_force_n)
        for axis, value in zip(axes, values, strict=True):
            axis.plot(1e3 * time_s, value, color=colour, linestyle=style, label=f"onset: {onset.value}")
    labels = ("distance to the plane x†, mm", "velocity along X†, m/s", "normal force, N")
    for axis, label in zip(axes, labels, strict=True):
        axis.axhline(0.0, color=LIGHT, linewidth=0.8)
        axis.axvline(0.0, color=LIGHT, linewidth=0.8)
        axis.set(xlabel="time since reaching the plane, ms", ylabel=label)
    axes[0].set_ylim(-40.0, 45.0)
    axes[0].legend(frameon=False, loc="upper right")
    figure.savefig(folder / "concept_contact.png", dpi=150)


def draw_recovery(folder: Path) -> None:
    """Draw a flown dual collision from above: path, peak forces and the resulting setpoints."""
    mission = _mission("paper_dual_collision.yaml")
    with tempfile.TemporaryDirectory() as logs:
        verdict = fly_fast(mission, 1, Path(logs))
        if verdict.log is None or verdict.outcome != "completed":
            raise RuntimeError(
                f"the flight for the figure did not complete: {verdict.outcome}, {verdict.reason}"
            )
        course = FlightArrays(read_log(verdict.log), mission)
    assert course.frame is not None
    figure, axis = _figure(6.8, 4.4)
    for wall in mission.walls:
        draw_wall(axis, DrawnWall(wall, mission.vehicle.airframe.wall_surface(wall)))
        axis.text(*_WALL_LABELS[wall.name], wall.name, ha="center", va="center")
    peaks = course.all(ImpactPeak)
    flown = course.true.time_s > course.time_of(peaks[0].t_us) - 2.5
    axis.plot(*course.true.position[flown, :2].T, color=DARK, linewidth=1.4, label="path of the vehicle")
    set_points = [s for s in course.all(Setpoint) if s.recovery]
    for number, peak in enumerate(peaks, start=1):
        n, t = peak.normal, (peak.normal[1], -peak.normal[0])
        force = [peak.normal_force_n * n[i] + peak.tangential_force_n * t[i] for i in (0, 1)]
        at = (peak.position_mission[0], peak.position_mission[1])
        axis.plot(*at, "o", color=DARK, markersize=5)
        tip = (at[0] + 0.008 * force[0], at[1] + 0.008 * force[1])
        draw_arrow(axis, at, tip, DARK, linewidth=2.5)
        shift = _IMPACT_LABELS[number - 1]
        axis.text(at[0] + shift[0], at[1] + shift[1], f"impact {number}: {math.hypot(*force):.0f} N")
        target = course.frame.point_from_ned(next(s for s in set_points if s.t_us >= peak.t_us).position_ned)
        style = {"color": MIDDLE, "linestyle": DASHED, "linewidth": 1.4}
        axis.plot(
            [at[0], target[0]], [at[1], target[1]], label="to the setpoint" if number == 1 else None, **style
        )
        axis.plot(*target[:2], "s", markerfacecolor="white", markeredgecolor=MIDDLE, markersize=7)
        axis.text(target[0], target[1] + 0.07, f"p_ref {number}", color=MIDDLE, ha="center")
    axis.plot(*mission.goal.position_m, "*", color=DARK, markersize=12)
    axis.text(mission.goal.position_m[0] - 0.08, mission.goal.position_m[1] + 0.03, "goal", ha="right")
    axis.set(xlabel="x, m", ylabel="y, m", aspect="equal", ylim=(-1.62, 0.75))
    axis.legend(frameon=False, loc="upper left")
    figure.savefig(folder / "concept_recovery.png", dpi=150)


def _mission(name: str) -> Mission:
    return load_mission(ROOT / "missions" / name, ROOT / "configs" / "dart.yaml")


FIGURES: tuple[Callable[[Path], None], ...] = (
    draw_frames, draw_vehicle_to_scale, draw_modes, draw_contact, draw_recovery,
)  # fmt: skip


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    for draw in FIGURES:
        draw(target)
