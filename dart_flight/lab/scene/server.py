"""The process of a live view: records arrive on standard input, viewers connect by WebSocket.

The first line is a `LiveViewSpec`. Each subsequent line is one record: its topic, a blank, and its JSON as in
the flight log. The process tries to open the port, prints the result as one line of JSON (`PortStatus`), and
prints nothing else. The process runs with idle priority and ends when its standard input ends. Viewers cannot
publish, because the server offers them only the time of the flight (`Capability.Time`).
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

_BACKLOG = 256  # maximum number of messages queued for a slow viewer; the server drops older messages
_CLOCK_US = 50_000
_JUMP_US = 1_000_000


class SubscriptionListener(ServerListener):
    """A listener that notes new subscriptions to channels whose messages are published only on changes."""

    def __init__(self) -> None:
        self.waiting = threading.Event()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Handle a subscription, on a thread of the server."""
        if channel.topic in LASTING:
            self.waiting.set()


class Broadcast:
    """The broadcast of one flight to every viewer; a RuntimeError means that the port cannot be opened."""

    def __init__(self, show: LiveViewSpec) -> None:
        mission: Mission = show.mission
        frame = mission.frame_at((0.0, 0.0, 0.0)) if show.show_room else MissionFrame()
        given = frame if show.frame_known else None
        self._translation = SceneTranslator(mission, given, show.show_room, show.from_truth)
        self._channels, self._newcomers = Channels(), SubscriptionListener()
        self._clock_us = 0
        self._lock = threading.Lock()  # two threads publish: one for records, one for new viewers
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
        threading.Thread(target=self._welcome, name="newcomers", daemon=True).start()

    def publish(self, line: bytes) -> None:
        topic, _, data = line.partition(b" ")
        record = decode(data, DECODERS[topic.decode()])
        messages = self._translation.translate(record)
        with self._lock:
            for message in messages:
                self._channels.publish(message)
        t_us = getattr(record, "t_us", 0)
        # Downsampled records are late. Skip their times, because viewers treat a step back as a jump.
        if t_us and not -_JUMP_US < t_us - self._clock_us < _CLOCK_US:
            self._clock_us = t_us
            self._server.broadcast_time(t_us * 1000)

    def close(self) -> None:
        self._server.stop()

    def _welcome(self) -> None:
        """Repeat, for each new viewer, the messages that are published only on changes.

        This loop has its own thread, because a viewer may connect while no records arrive.
        """
        while self._newcomers.waiting.wait():
            self._newcomers.waiting.clear()
            with self._lock:
                self._channels.publish_again()


def serve(records: BinaryIO, output: BinaryIO) -> int:
    """Broadcast until the input ends; return 1 if the port cannot be opened."""
    show = msgspec.json.decode(records.readline(), type=LiveViewSpec)
    try:
        broadcast = Broadcast(show)
    except RuntimeError as error:
        _report_status(output, PortStatus(problem=str(error)))
        return 1
    _report_status(output, PortStatus(broadcast.port))
    for line in records:
        broadcast.publish(line)
    broadcast.close()
    return 0


def _report_status(output: BinaryIO, opened: PortStatus) -> None:
    output.write(msgspec.json.encode(opened) + b"\n")
    output.flush()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the flight handles Ctrl-C
    use_idle_priority()
    sys.exit(serve(sys.stdin.buffer, sys.stdout.buffer))
