"""The approaches drawn in figures and on pages match the flown approaches."""

from __future__ import annotations

import json
import math

from hypothesis import given, reject, settings
from hypothesis import strategies as st

from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.core.mission.approach import NoApproachError, plan_approach
from dart_flight.planning.predicted_flight import predict_mission

VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))
_PLACES = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 1.5))


@st.composite
def missions(draw: st.DrawFn) -> Mission:
    """Draw a mission with one wall; impact point and waypoints are optional."""
    mode = draw(st.sampled_from(["rigid", "flexible"]))
    collision = {
        "wall": "acrylic",
        "mode": mode,
        "approach": {"normal_m_s": -draw(st.floats(0.4, 1.5)), "tangential_m_s": draw(st.floats(-0.6, 0.6))},
        "alpha_m_per_n": [0.02, 0.02],
    }
    if draw(st.booleans()):
        collision["impact_point_m"] = [1.65, draw(st.floats(-0.2, 1.2))]
    waypoints = [{"position_m": list(place)} for place in draw(st.lists(_PLACES, max_size=2))]
    document = json.dumps(
        {
            "version": 1,
            "name": "drawn",
            "start": {"position_m": list(draw(_PLACES)), "altitude_m": 1.0},
            "goal": {"position_m": [0.5, 0.0]},
            "bounds_m": {"x": [-4.0, 2.2], "y": [-4.0, 4.0], "z": [0.3, 2.0]},
            "walls": {
                "acrylic": {
                    "point_m": [1.65, 0.5],
                    "normal": [-1.0, 0.0],
                    "length_m": 6.0,
                    "material": "acrylic",
                }
            },
            "collisions": [collision],
            "waypoints": waypoints,
        }
    )
    try:
        return parse_mission(Document(document, "drawn.yaml"), VEHICLE)
    except InputError:  # such as a ray that misses the wall
        reject()


def drawn_and_flown_corners(mission: Mission) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Return the corners of the drawn path to the wall, and of the executive's reference path."""
    approach = plan_approach(mission, mission.collisions[0])
    before = mission.place_before(0)
    begin, impact = approach.begin[:2], mission.collisions[0].impact_point
    assert impact is not None
    flown = [begin, impact] if before in (None, begin) else [before, begin, impact]
    return predict_mission(mission).approaches[1], flown


@given(missions())
@settings(max_examples=60)
def test_the_drawn_approach_matches_the_flown_approach(mission: Mission) -> None:
    try:
        drawn, flown = drawn_and_flown_corners(mission)
    except NoApproachError:
        reject()
    assert len(drawn) == len(flown)
    for a, b in zip(drawn, flown, strict=True):
        assert math.dist(a, b) < 1e-6
