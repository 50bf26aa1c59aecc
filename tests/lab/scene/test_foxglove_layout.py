"""The Foxglove layout names what an export and a live view publish."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest

from dart_flight.config.vehicle import packaged
from dart_flight.lab.scene.foxglove_export import export_foxglove
from dart_flight.lab.scene.translation import LOG, OUTLINES, SCENES, TRANSFORMS
from dart_flight.recording.reader import read_log
from tests.lab.scene.test_translation import Messages, read
from tests.shared_flights import SharedFlights

LAYOUT = json.loads(packaged("docs", "foxglove_layout.json").read_text())
PATH = re.compile(r"^(/[a-z_/]+)\.([a-z_]+)$")


@pytest.fixture(scope="module")
def exported(flown: SharedFlights, tmp_path_factory: pytest.TempPathFactory) -> Messages:
    path = tmp_path_factory.mktemp("layout") / "flight.mcap"
    export_foxglove(read_log(flown("paper_single_wall", 1).log), path)
    return read(path)


def test_every_panel_of_the_layout_is_shown_once() -> None:
    def leaves(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
        else:
            yield from leaves(node["first"])
            yield from leaves(node["second"])

    assert sorted(leaves(LAYOUT["layout"])) == sorted(LAYOUT["configById"])


def test_it_draws_every_scene_and_no_outline_over_it() -> None:
    topics = LAYOUT["configById"]["3D!scene"]["topics"]
    assert {name for name, one in topics.items() if one["visible"]} == set(SCENES)
    assert {name for name, one in topics.items() if not one["visible"]} == set(OUTLINES)


def message_paths() -> list[str]:
    panels = LAYOUT["configById"].values()
    return [line["value"] for panel in panels for line in panel.get("paths", [])]


@pytest.mark.parametrize("path", message_paths())
def test_the_layout_names_what_is_published(path: str, exported: Messages) -> None:
    match = PATH.match(path)
    assert match, path
    topic, field = match.groups()
    values = [message[field] for _, message in exported[topic]]
    assert len(values) > 100
    if field != "battery_v":  # the simulated one lasts
        assert len(set(values)) > 1, "a line that never moves tells nothing"


def test_nothing_that_is_published_is_left_out_of_the_layout(exported: Messages) -> None:
    shown = {path.rpartition(".")[0] for path in message_paths()}
    shown |= {
        *LAYOUT["configById"]["3D!scene"]["topics"],
        LAYOUT["configById"]["RosOut!events"]["topicToRender"],
    }
    assert exported.keys() <= shown | {TRANSFORMS}
    assert LOG in shown
