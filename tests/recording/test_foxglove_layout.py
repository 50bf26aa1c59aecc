"""The Foxglove layout names what is in a log."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

DOCS = Path(__file__).parents[2] / "docs"
LAYOUT = json.loads((DOCS / "foxglove_layout.json").read_text())
PATH = re.compile(r"^(/[a-z_/]+)((?:\.[a-z_]+(?:\[\d+\])?)*)$")


def test_every_panel_of_the_layout_is_shown_once() -> None:
    def leaves(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
        else:
            yield from leaves(node["first"])
            yield from leaves(node["second"])

    assert sorted(leaves(LAYOUT["layout"])) == sorted(LAYOUT["configById"])


def message_paths() -> list[str]:
    paths = []
    for panel in LAYOUT["configById"].values():
        paths += [line["value"] for line in panel.get("paths", [])]
        if "topicPath" in panel:
            paths.append(panel["topicPath"])
    return paths


@pytest.mark.parametrize("path", message_paths())
def test_the_layout_names_what_is_in_a_real_log(path: str, flight_path: Path) -> None:
    match = PATH.match(path)
    assert match, path
    topic, fields = match.groups()
    with open(flight_path, "rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        channel = next(c for c in summary.channels.values() if c.topic == topic)
        assert channel.message_encoding == "json"
        schema = json.loads(summary.schemas[channel.schema_id].data)
        messages = [json.loads(m.data) for _, _, m in reader.iter_messages(topics=[topic])]
    for name, index in re.findall(r"\.([a-z_]+)(?:\[(\d+)\])?", fields):
        kind = schema["properties"][name]["type"]
        assert (kind == "array") == bool(index), path
        for message in messages:
            if index:
                assert len(message[name]) > int(index)
            else:
                assert name in message
    if topic not in ("/event/guard",):  # a good flight has none
        assert messages, f"{topic} is empty in a flight"
