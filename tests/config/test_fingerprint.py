"""The fingerprint of mission and vehicle, by which `check` recognises what was flown in simulation."""

from __future__ import annotations

from pathlib import Path

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.config.mission import load_mission
from dart_flight.config.section import without_defaults

ROOT = Path(__file__).parents[2]


class Before(msgspec.Struct):
    mass_kg: float
    motors: tuple[int, ...] = (1, 2)


class After(Before):
    added_m: float = 0.5


@given(st.floats(0.1, 5.0), st.lists(st.integers(0, 8)).map(tuple))
def test_a_key_added_later_does_not_change_a_fingerprint(mass_kg: float, motors: tuple[int, ...]) -> None:
    before, after = Before(mass_kg, motors), After(mass_kg, motors)
    assert without_defaults({"a": [before]}) == without_defaults({"a": (after,)})
    assert without_defaults(before) != without_defaults(After(mass_kg, motors, added_m=0.6))


def test_a_changed_value_changes_the_fingerprint() -> None:
    mission = load_mission(ROOT / "missions/ring_guard_250g/square.yaml")
    heavier = load_mission(ROOT / "missions/ring_guard_250g/square.yaml", settings=["airframe.mass_kg=0.26"])
    higher = msgspec.structs.replace(mission, altitude_m=mission.altitude_m + 0.1)
    assert len({mission.digest, heavier.digest, higher.digest}) == 3
    assert msgspec.structs.replace(mission, source="elsewhere.yaml").digest == mission.digest
    same = {
        "vehicle.mocap.url": "vrpn://192.0.2.1/dart",
        "vehicle.connection.url": "serial:///dev/ttyAMA0:921600",
    }
    assert mission.replace(same).digest == mission.digest
