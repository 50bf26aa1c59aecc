"""The Foxglove layout matches the topics of the export and of the live view."""

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
from tests.lab.scene.test_translation import Messages, read_messages
from tests.shared_flights import SharedFlights

LAYOUT = json.loads(packaged("docs", "foxglove_layout.json").read_text())
PATH = re.compile(r"^(/[a-z_/]+)\.([a-z_]+)$")


@pytest.fixture(scope="module")
def exported(flown: SharedFlights, tmp_path_factory: pytest.TempPathFactory) -> Messages:
    path = tmp_path_factory.mktemp("layout") / "flight.mcap"
    export_foxglove(read_log(flown("paper_single_wall", 1).log), path)
    return read_messages(path)


def test_every_panel_of_the_layout_is_shown_once() -> None:
    def leaves(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
        else:
            yield from leaves(node["first"])
            yield from leaves(node["second"])

    assert sorted(leaves(LAYOUT["layout"])) == sorted(LAYOUT["configById"])


def test_the_layout_draws_every_scene_and_no_outlines() -> None:
    topics = LAYOUT["configById"]["3D!scene"]["topics"]
    assert {name for name, one in topics.items() if one["visible"]} == set(SCENES)
    assert {name for name, one in topics.items() if not one["visible"]} == set(OUTLINES)


def message_paths() -> list[str]:
    panels = LAYOUT["configById"].values()
    return [line["value"] for panel in panels for line in panel.get("paths", [])]


@pytest.mark.parametrize("path", message_paths())
def test_every_path_of_the_layout_is_published_and_varies(path: str, exported: Messages) -> None:
    match = PATH.match(path)
    assert match, path
    topic, field = match.groups()
    values = [message[field] for _, message in exported[topic]]
    assert len(values) > 100
    if field != "battery_v":  # the simulated battery stays full
        assert len(set(values)) > 1, "the plotted value is constant"


def test_every_published_topic_is_in_the_layout(exported: Messages) -> None:
    shown = {path.rpartition(".")[0] for path in message_paths()}
    shown |= {
        *LAYOUT["configById"]["3D!scene"]["topics"],
        LAYOUT["configById"]["RosOut!events"]["topicToRender"],
    }
    assert exported.keys() <= shown | {TRANSFORMS}
    assert LOG in shown
