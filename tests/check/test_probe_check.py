"""Findings of `check` about probes, the walls that they find, and anchors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from dart_flight.check.findings import CheckFinding
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from tests.mission_findings import check_mission


def findings(name: str, changes: Mapping[str, Any] | None = None) -> dict[str, CheckFinding]:
    mission = load_mission(packaged("missions", f"{name}.yaml")).replace(changes or {})
    return {finding.item: finding for finding in check_mission(mission)}


def test_an_unknown_wall_is_left_to_the_check_in_flight() -> None:
    found = findings("find_a_wall")
    assert all(finding.go for finding in found.values())
    assert "at most 37 N on the stiffest known material" in found["probe_1"].message
    assert "a probe locates wall" in found["approach_2"].message
    assert not {"wall_end", "path", "incidence_2", "survey_2"} & set(found)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (
            {"collisions[0].mode": "flexible", "collisions[0].probe.speed_m_s": 0.2},
            "too slow to detect a contact",
        ),
        ({"collisions[0].probe.speed_m_s": 2.5}, "limits.peak_force_n is 150 N"),
    ],
)
def test_a_probe_too_slow_to_detect_or_too_fast_is_a_no_go(changes: Mapping[str, Any], says: str) -> None:
    probe = findings("find_a_wall", changes)["probe_1"]
    assert not probe.go
    assert says in probe.message


def test_a_probe_that_may_end_before_its_wall_is_a_remark() -> None:
    uncertain = {"walls.wood.position_sd_m": 0.6}
    probe = findings("dual_collision_gps", uncertain)["probe_1"]
    assert (probe.go, probe.remark) == (True, True)
    assert "may be 1.80 m further away" in probe.message


def test_the_age_and_uncertainty_of_an_anchor_are_reported() -> None:
    """In flight both ages are about 7 s (docs/results/touch.md)."""
    found = findings("dual_collision_gps")
    assert found["anchor_3"].figures is not None
    assert found["anchor_4"].figures is not None
    assert 6.0 < found["anchor_3"].figures["age_s"] < 10.0
    assert 4.0 < found["anchor_4"].figures["age_s"] < 9.0
    assert found["anchor_4"].figures["sd_m"] == pytest.approx(0.04 * found["anchor_4"].figures["age_s"])


def test_a_wall_without_an_earlier_touch_is_a_no_go_in_a_drifting_frame() -> None:
    mission = load_mission(packaged("missions", "dual_collision.yaml"))
    drifting = mission.replace({"frame.origin": "takeoff", "frame.anchored_by": "touch"})
    found = {finding.item: finding for finding in check_mission(drifting)}
    assert not found["anchor_1"].go
    assert "touch this wall or a parallel wall first" in found["anchor_1"].message
