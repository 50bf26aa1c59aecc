"""The paper's figures from our model and our simulated flights, with its published numbers.

Of its own trials the paper publishes no courses: contact times and rebound speeds of the drops are drawn, the
rest is ours alone and says so. Needs matplotlib, the `report` extra.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from dart_flight.base.records import Mode
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.scenario import load_scenario
from dart_flight.config.vehicle import VehicleConfig, packaged
from dart_flight.contact.law import Onset
from dart_flight.lab.figure_panels import BLUE, GREY, ORANGE, legend_entries, panels, save, shade
from dart_flight.lab.paper import tables as paper
from dart_flight.lab.paper.contact_figures import plot_drop
from dart_flight.lab.predict import prediction
from dart_flight.lab.report.flight import Flight, Impact
from dart_flight.lab.search.plots import plot_search
from dart_flight.lab.search.search import search
from dart_flight.lock import cam
from dart_flight.run.fast import fly_fast

SEED = 1
_BEFORE_S, _AFTER_S = 0.08, 0.45  # about the onset: the second peak of the recovery is in it


class Written(NamedTuple):
    """One figure: its file in the folder, which of the paper's it is, and what is to be known of it."""

    file: str
    title: str
    says: str


def write(folder: Path, vehicle: VehicleConfig) -> Iterator[Written]:
    """Write the figures one after the other.

    Raises:
        InputError: matplotlib is missing, or a file cannot be written.
    """
    yield _cam(folder, vehicle)
    yield from _drops(folder, vehicle)
    yield from _searches(folder, vehicle)
    yield from _hits_in_flight(folder, vehicle)
    yield from _dual_collision(folder, vehicle)


def _cam(folder: Path, vehicle: VehicleConfig) -> Written:
    figure, (axis,) = panels(1)
    assert vehicle.lock is not None  # the command has made sure of it
    shape = vehicle.lock.cam
    low, high = cam.limits_deg(shape)
    angles = np.linspace(low, high, 181)
    axis.plot(angles, [cam.rod_mm(shape, float(a)) for a in angles], color=BLUE)
    axis.set(xlabel="cam angle, degrees", ylabel="rod translation, mm")
    save(figure, folder / "fig3_cam.svg")
    says = (
        "Equation (1), l = R_cam - r cos(theta), over its 90 degrees. The paper gives no R_cam, r, theta_0: "
        f"the configuration's {shape.r_cam_mm:g} mm, {shape.r_mm:g} mm and {shape.theta0_deg:g} degrees."
    )
    return Written("fig3_cam.svg", "Figure 3a, the cam", says)


def _drops(folder: Path, vehicle: VehicleConfig) -> Iterator[Written]:
    for published in paper.DROPS:
        what = prediction.condition(vehicle, paper.DROP_SURFACE, published.mode.value, Onset.LCP.value, 0.0)
        name = f"fig7_drop_{published.height_m:g}m_{published.mode.value}.svg"
        contact = prediction.drop_contact(what, published.height_m)
        plot_drop(folder / name, what, contact, published.height_m, published)
        yield Written(
            name,
            f"Figures 5 and 7, drop from {published.height_m:g} m, {published.mode.value}",
            "The model with the published coefficients; contact time and rebound speed as published. The "
            "paper's recorded courses are not published.",
        )


def _searches(folder: Path, vehicle: VehicleConfig) -> Iterator[Written]:
    for scenario, name, title, beside in (
        (
            "one_wall.yaml",
            "fig8a_one_wall.svg",
            "Figure 8a, velocity before a collision",
            "The paper has no numbers for its wall and goal.",
        ),
        (
            "dual_collision.yaml",
            "fig8b_dual_collision.svg",
            "Figure 8b, modes of two collisions",
            "The paper's optimum is flexible then rigid from -0.6 and 0.5 m/s; docs/departures.md says why "
            "ours differs.",
        ),
    ):
        loaded = load_scenario(packaged("missions", "scenarios", scenario))
        result = search(msgspec.structs.replace(loaded, vehicle=vehicle), top=1)
        plot_search(result, result.plans[0], folder / name)
        chosen = result.plans[0]
        first = chosen.collisions[0]
        yield Written(
            name,
            title,
            f"Every approach of the grid flown forward by the flight model. Nearest to the goal: "
            f"{' then '.join(mode.value for mode in chosen.modes)}, first impact at {first.normal_m_s:.3g} "
            f"m/s along the normal and {first.tangential_m_s:.3g} m/s along the wall, "
            f"{chosen.goal_miss_m:.3f} m from the goal. {beside}",
        )


def _hits_in_flight(folder: Path, vehicle: VehicleConfig) -> Iterator[Written]:
    mission = _with_vehicle("paper_single_wall.yaml", vehicle)
    for mode in Mode:
        collisions = tuple(msgspec.structs.replace(c, mode=mode) for c in mission.collisions)
        flight = _flown(msgspec.structs.replace(mission, collisions=collisions))
        name = f"fig9_{mode.value}.svg"
        _draw_forces(folder / name, flight, flight.impacts[:1])
        normal, tangential = paper.FLIGHT_APPROACH_M_S
        yield Written(
            name,
            f"Figure 9, a hit in flight, {mode.value}",
            f"Acrylic at {normal:g} and {tangential:g} m/s: predicted, and as estimated in a simulated "
            f"flight (seed {SEED}). The paper's predicted peak acceleration met its accelerometer's to "
            f"{paper.FLIGHT_ACCURACY[mode]:.0%}; the measured values are not published.",
        )


def _dual_collision(folder: Path, vehicle: VehicleConfig) -> Iterator[Written]:
    flight = _flown(_with_vehicle(paper.DUAL_MISSION, vehicle))
    _draw_forces(folder / "fig10_dual_collision.svg", flight, flight.impacts)
    yield Written(
        "fig10_dual_collision.svg",
        "Figure 10, the dual collision",
        "Forces on the vehicle along the mission's axes, predicted and as estimated in a simulated flight "
        f"(seed {SEED}).",
    )


def _with_vehicle(mission: str, vehicle: VehicleConfig) -> Mission:
    loaded = load_mission(packaged("missions", mission), packaged("configs", "dart.yaml"))
    return msgspec.structs.replace(loaded, vehicle=vehicle)


def _flown(mission: Mission) -> Flight:
    """A fast flight, read back from its log."""
    with tempfile.TemporaryDirectory() as folder:
        verdict = fly_fast(mission, SEED, Path(folder))
        assert verdict.log is not None
        return Flight.read(verdict.log)


def _draw_forces(path: Path, flight: Flight, impacts: list[Impact]) -> None:
    """Force along the mission's x and y (the paper's inertial frame): estimated, predicted, peaks."""
    figure, axes = panels(2)
    estimated = flight.course.estimated_force
    first_s, last_s = impacts[0].onset_s, impacts[-1].onset_s
    shown = (estimated.time_s >= first_s - _BEFORE_S) & (estimated.time_s <= last_s + _AFTER_S)
    ms = 1e3 * (estimated.time_s[shown] - first_s)
    for i, (axis, name) in enumerate(zip(axes, "xy", strict=True)):
        axis.plot(ms, estimated.force[shown, i], color=BLUE, lw=1.2, label="estimated in simulation")
        for impact in impacts:
            _draw_prediction(axis, impact, i, first_s)
        axis.set_ylabel(f"force along {name}, N")
        entries = legend_entries(axis)
        axis.legend(entries.values(), entries.keys(), loc="best", fontsize=8, frameon=False)
    axes[-1].set_xlabel("time since the first onset, ms")
    for impact in impacts:
        lock = impact.verdict.lock
        if lock is not None and lock.contact_end_us is not None:
            end_s = flight.course.time_of(lock.contact_end_us)
            shade(axes, 1e3 * (impact.onset_s - first_s), 1e3 * (end_s - first_s))
    modes = " then ".join(impact.collision.mode.value for impact in impacts)
    axes[0].set_title(f"{flight.mission.name}, {modes}", fontsize=10)
    save(figure, path)


def _draw_prediction(axis: Any, impact: Impact, component: int, zero_s: float) -> None:
    path = impact.prediction
    if path is None:
        return
    wall = impact.collision.wall
    force = path.normal_force_n * wall.normal[component] + path.tangential_force_n * wall.tangent[component]
    inside = path.normal_force_n > 0.0
    ms = 1e3 * (path.time_s + impact.onset_s - zero_s)
    axis.plot(
        ms[inside], force[inside], "--", color=ORANGE, lw=1.6, label="predicted at the velocity measured"
    )
    peak = int(np.argmax(np.abs(force)))
    axis.plot(ms[peak], force[peak], "o", color=ORANGE, ms=5)
    axis.annotate(
        f"{force[peak]:.0f} N",
        (ms[peak], force[peak]),
        (6, 2),
        textcoords="offset points",
        fontsize=8,
        color=GREY,
    )
