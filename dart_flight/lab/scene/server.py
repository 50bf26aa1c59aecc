"""The process of a live view: records come in by standard input, viewers connect by WebSocket.

The first line is a `LiveViewSpec`, then one record a line: its topic, a blank, its JSON as in the flight
log. Once the port is open, or cannot be opened, one line of JSON (`PortStatus`) goes out; nothing after
that. It runs only where a processor is idle, and ends with its input. Viewers can publish nothing: the one
capability that is offered to them is the time of the flight.
"""

from __future__ import annotations

import signal
import sys
import threading
from typing import BinaryIO

import foxglove
import msgspec
from foxglove.websocket import Capability, ChannelView, Client, ServerListener

from dart_flight.base.geometry import MissionFrame
from dart_flight.base.processes import use_idle_priority
from dart_flight.config.mission import Mission
from dart_flight.lab.scene.channels import Channels
from dart_flight.lab.scene.live import LiveViewSpec, PortStatus
from dart_flight.lab.scene.translation import LASTING, SceneTranslator
from dart_flight.recording.encoding import decode
from dart_flight.recording.reader import DECODERS

_BACKLOG = 256  # messages that wait for a slow viewer; beyond it the oldest go
_CLOCK_US = 50_000
_JUMP_US = 1_000_000


class SubscriptionListener(ServerListener):
    """Notes that a viewer has subscribed to what is published only on a change."""

    def __init__(self) -> None:
        self.waiting = threading.Event()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """On a thread of the server's."""
        if channel.topic in LASTING:
            self.waiting.set()


class Broadcast:
    """One flight for every viewer.

    Raises:
        RuntimeError: the port cannot be opened.
    """

    def __init__(self, show: LiveViewSpec) -> None:
        mission: Mission = show.mission
        frame = mission.frame_at((0.0, 0.0, 0.0)) if show.show_room else MissionFrame()
        given = frame if show.frame_known else None
        self._translation = SceneTranslator(mission, given, show.show_room, show.from_truth)
        self._channels, self._newcomers = Channels(), SubscriptionListener()
        self._clock_us = 0
        self._server = foxglove.start_server(
            name=f"dart-flight: {mission.name}",
            host=show.host,
            port=show.port,
            capabilities=[Capability.Time],
            server_listener=self._newcomers,
            context=self._channels.context,
            message_backlog_size=_BACKLOG,
        )
        self.port = self._server.port

    def take(self, line: bytes) -> None:
        """One record."""
        topic, _, data = line.partition(b" ")
        record = decode(data, DECODERS[topic.decode()])
        for message in self._translation.take(record):
            self._channels.publish(message)
        if self._newcomers.waiting.is_set():
            self._newcomers.waiting.clear()
            self._channels.publish_again()
        t_us = getattr(record, "t_us", 0)
        # Thinned samples come a little late, and viewers take any step back for a jump.
        if t_us and not -_JUMP_US < t_us - self._clock_us < _CLOCK_US:
            self._clock_us = t_us
            self._server.broadcast_time(t_us * 1000)

    def close(self) -> None:
        """Let go of the viewers."""
        self._server.stop()


def serve(records: BinaryIO, told: BinaryIO) -> int:
    """Broadcast until there are no more records; 1 where the port cannot be opened."""
    show = msgspec.json.decode(records.readline(), type=LiveViewSpec)
    try:
        broadcast = Broadcast(show)
    except RuntimeError as error:
        _tell(told, PortStatus(problem=str(error)))
        return 1
    _tell(told, PortStatus(broadcast.port))
    for line in records:
        broadcast.take(line)
    broadcast.close()
    return 0


def _tell(told: BinaryIO, opened: PortStatus) -> None:
    told.write(msgspec.json.encode(opened) + b"\n")
    told.flush()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the flight's business
    use_idle_priority()
    sys.exit(serve(sys.stdin.buffer, sys.stdout.buffer))
