"""One hit of a body, integrated: what the simulated vehicle does, and what it may not do."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import MissionFrame, Wall, quaternion_from_euler
from dart_flight.base.records import Mode
from dart_flight.cli import main
from dart_flight.config.vehicle import VehicleConfig, load_vehicle
from dart_flight.contact.contact_map import collide
from dart_flight.contact.law import Onset
from dart_flight.lab.predict.body_hit import body_hit
from dart_flight.sim.plant import Plant

ROOT = Path(__file__).parents[3]
LOADED = load_vehicle(ROOT / "configs" / "dart.yaml")
WALL = Wall("wall", (1.0, 0.0), (-1.0, 0.0), 80.0, "acrylic")


def vehicle(**changes: object) -> VehicleConfig:
    """The configured one without drag, with arms that take no motors with them."""
    contact = msgspec.structs.replace(LOADED.simulation.contact, fold_share=0.0, **changes)
    return msgspec.structs.replace(
        LOADED,
        simulation=msgspec.structs.replace(LOADED.simulation, contact=contact),
        airframe=msgspec.structs.replace(LOADED.airframe, drag_per_s=(0.0, 0.0, 0.0)),
    )


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize(("normal", "along"), [(-0.6, 0.5), (-1.5, -0.3)])
@pytest.mark.parametrize("askew_deg", [-20.0, -5.0, 0.0, 10.0])
def test_the_simulated_vehicle_turns_as_predicted(
    mode: Mode, normal: float, along: float, askew_deg: float
) -> None:
    flown = vehicle()
    plant = Plant(flown, (WALL,), MissionFrame())
    plant.position = plant.frame.point_to_ned((0.95, 0.0, 5.0))
    plant.velocity = plant.frame.vector_to_ned(WALL.from_collision((normal, along, 0.0)))
    plant.q = quaternion_from_euler(0.0, 0.0, -math.radians(askew_deg))
    hover = flown.hover_thrust_fraction()
    hover = flown.thrust.command_for(hover * flown.thrust.most_n)
    plant.motor = [hover] * 4
    plant.set_mode(mode)
    while not plant.finished and plant.time_s < 2.0:
        plant.advance((hover,) * 4)
    truth = plant.finished[0]
    hit = body_hit(flown, "acrylic", mode, normal, along, math.radians(askew_deg))
    assert hit.rate_frd == pytest.approx(truth.rate_out_frd, abs=0.05)
    assert hit.normal_out_m_s == pytest.approx(truth.normal_out_m_s, abs=0.03)
    assert hit.tangential_out_m_s == pytest.approx(truth.tangential_out_m_s, abs=0.03)
    assert hit.peak_normal_n == pytest.approx(truth.peak_normal_force_n, rel=0.01)


def test_a_straight_central_hit_is_the_points() -> None:
    straight = vehicle(vertical_lever_m=0.0)
    hit = body_hit(straight, "acrylic", Mode.RIGID, -1.0, 0.0)
    c = straight.materials["acrylic"].of(Mode.RIGID)
    point = collide(c, straight.airframe.mass_kg, -1.0, 0.0, Onset(straight.onset))
    assert hit.turning_deg_s == pytest.approx(0.0, abs=1e-6)
    assert hit.normal_out_m_s == pytest.approx(point.normal_out_m_s, rel=0.03)
    assert hit.peak_normal_n == pytest.approx(point.peak_normal_force_n, rel=0.03)


@settings(max_examples=25)
@given(st.sampled_from(list(Mode)), st.floats(-2.0, -0.3), st.floats(-0.6, 0.6), st.floats(-0.4, 0.4))
def test_a_hit_creates_no_energy_and_mirrors(mode: Mode, normal: float, along: float, askew: float) -> None:
    flown = vehicle(vertical_lever_m=0.0)
    hit = body_hit(flown, "acrylic", mode, normal, along, askew)
    turning = 0.5 * sum(i * w * w for i, w in zip(flown.airframe.inertia_kg_m2, hit.rate_frd, strict=True))
    moving = 0.5 * flown.airframe.mass_kg * (hit.normal_out_m_s**2 + hit.tangential_out_m_s**2)
    # The thrust of a vehicle that tilts works a little while it touches.
    assert turning + moving <= 0.5 * flown.airframe.mass_kg * (normal**2 + along**2) * 1.02
    mirrored = body_hit(flown, "acrylic", mode, normal, -along, -askew)
    assert mirrored.rate_frd[2] == pytest.approx(-hit.rate_frd[2], abs=1e-9)
    assert mirrored.normal_out_m_s == pytest.approx(hit.normal_out_m_s, abs=1e-9)


def test_predict_says_how_fast_the_vehicle_turns(capsys: pytest.CaptureFixture[str]) -> None:
    said = []
    for askew in ("0", "10", "20"):
        words = ["predict", "--surface", "acrylic", "--mode", "rigid", "--velocity", "-1.0", "0.0"]
        assert main([*words, "--incidence-deg", askew, "--json"]) == 0
        said.append(msgspec.json.decode(capsys.readouterr().out)["turning_deg_s"])
    assert said[0] < 30.0
    assert 100.0 < said[1] < said[2]
