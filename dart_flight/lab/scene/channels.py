"""The channels on which a flight is published to a file, to viewers, or to both."""

from __future__ import annotations

from typing import Any

import msgspec
from foxglove import Channel, Context
from foxglove.channels import FrameTransformsChannel, LogChannel, PointCloudChannel, SceneUpdateChannel

from dart_flight.lab.scene.scalars import SCALARS
from dart_flight.lab.scene.translation import LASTING, LOG, OUTLINES, SCENES, TRANSFORMS, Message
from dart_flight.recording.schema import schema


class Channels:
    """Every channel of a flight, in a foxglove context of its own (`context`), for a file or a server."""

    def __init__(self) -> None:
        self.context = Context()
        self._typed: dict[str, Any] = {
            topic: SceneUpdateChannel(topic, context=self.context) for topic in SCENES
        }
        self._typed |= {topic: PointCloudChannel(topic, context=self.context) for topic in OUTLINES}
        self._typed[TRANSFORMS] = FrameTransformsChannel(TRANSFORMS, context=self.context)
        self._typed[LOG] = LogChannel(LOG, context=self.context)
        self._plain = {
            kind.topic: Channel(
                kind.topic, schema=schema(kind), message_encoding="json", context=self.context
            )
            for kind in SCALARS
        }
        self._lasting: dict[str, Message] = {}

    def publish(self, message: Message) -> None:
        """Write or send a message, stamped with the autopilot's time."""
        time_ns = max(0, message.t_us) * 1000
        plain = self._plain.get(message.topic)
        if plain is not None:
            plain.log(msgspec.json.encode(message.content), log_time=time_ns)
            return
        if message.topic in LASTING:
            self._lasting[message.topic] = message
        self._typed[message.topic].log(message.content, log_time=time_ns)

    def publish_again(self) -> None:
        """Repeat, for a new viewer, the messages that are published only on changes."""
        for message in list(self._lasting.values()):
            self.publish(message)
