"""A viewer independent of Foxglove's SDK, which decodes messages by the schemas in their channels."""

from __future__ import annotations

import base64
import json
import struct
import time
from collections.abc import Callable
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

SUBPROTOCOL = "foxglove.sdk.v1"
_MESSAGE, _TIME = 1, 2  # first byte of a binary frame
_HEAD = struct.Struct("<IQ")  # subscription, time in ns
_CHECK_EVERY_S = 0.2  # period of the check, whose cost grows with the number of messages


class Decoder:
    """A decoder of the messages of one channel.

    Args:
        encoding: encoding of the messages: protobuf or json.
        schema_name: type of the messages.
        schema: schema as bytes; for protobuf a FileDescriptorSet.
    """

    def __init__(self, encoding: str, schema_name: str, schema: bytes) -> None:
        self._kind: Any = None
        if encoding == "protobuf":
            files = descriptor_pb2.FileDescriptorSet.FromString(schema)
            pool = descriptor_pool.DescriptorPool()
            for file in files.file:
                pool.Add(file)
            self._kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema_name))
        else:
            assert encoding == "json", encoding

    def __call__(self, data: bytes) -> dict[str, Any]:
        """Return a message as a dictionary with protobuf's own names and all fields."""
        if self._kind is None:
            decoded: dict[str, Any] = json.loads(data)
            return decoded
        message = self._kind.FromString(data)
        return json_format.MessageToDict(
            message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
        )


def make_decoder(channel: dict[str, Any]) -> Decoder:
    """Return the decoder of a channel that foxglove.websocket.v1 advertises."""
    text = channel["schema"]
    binary = channel.get("schemaEncoding") == "protobuf"
    schema = base64.b64decode(text) if binary else text.encode()
    return Decoder(channel["encoding"], channel["schemaName"], schema)


class Viewer:
    """A client of foxglove.websocket.v1, which subscribes to all channels and keeps their messages.

    Args:
        url: ws://...
        wanted: returns whether the received messages suffice.

    Attributes:
        capabilities: capabilities that the server offers.
        messages: topic -> messages, in order of arrival.
        times_us: times of the flight that the server sends.
        refused: error messages of the server.
        timed_out: whether the last `watch` ended by its timeout.
    """

    def __init__(self, url: str, wanted: Callable[[dict[str, list[dict[str, Any]]]], bool]) -> None:
        self._url, self._wanted = url, wanted
        self.capabilities: list[str] | None = None
        self.messages: dict[str, list[dict[str, Any]]] = {}
        self.times_us: list[int] = []
        self.refused: list[str] = []
        self.timed_out = False
        self._channels: dict[int, tuple[str, Decoder]] = {}

    def watch(self, timeout_s: float) -> bool:
        """Receive until the messages suffice, the server ends or the timeout; return whether they suffice."""
        ends = time.monotonic() + timeout_s
        checked = 0.0
        with self._connect(ends) as socket:
            while time.monotonic() < ends:
                try:
                    self._handle_frame(socket, socket.recv(timeout=_CHECK_EVERY_S))
                except TimeoutError:
                    pass
                except ConnectionClosed:
                    break
                if time.monotonic() - checked > _CHECK_EVERY_S:
                    if self._wanted(self.messages):
                        return True
                    checked = time.monotonic()
            else:
                self.timed_out = True
        return self._wanted(self.messages)

    def _connect(self, ends: float) -> ClientConnection:
        """Connect, and retry until the server listens."""
        while True:
            try:
                return connect(self._url, subprotocols=[Subprotocol(SUBPROTOCOL)], max_size=None)
            except ConnectionRefusedError:
                if time.monotonic() > ends:
                    raise
                time.sleep(0.05)

    def _handle_frame(self, socket: Connection, frame: str | bytes) -> None:
        if isinstance(frame, bytes):
            self._handle_binary(frame)
            return
        message = json.loads(frame)
        if message["op"] == "serverInfo":
            self.capabilities = message["capabilities"]
            # The server must reject a client that publishes, so this client tries.
            offer = {"id": 1, "topic": "/mine", "encoding": "json", "schemaName": ""}
            socket.send(json.dumps({"op": "advertise", "channels": [offer]}))
        elif message["op"] == "advertise":
            for channel in message["channels"]:
                self._channels[channel["id"]] = (channel["topic"], make_decoder(channel))
            ids = [{"id": channel["id"], "channelId": channel["id"]} for channel in message["channels"]]
            socket.send(json.dumps({"op": "subscribe", "subscriptions": ids}))
        elif message["op"] == "status":
            self.refused.append(message["message"])

    def _handle_binary(self, frame: bytes) -> None:
        if frame[0] == _MESSAGE:
            subscription, _ = _HEAD.unpack_from(frame, 1)
            topic, decode = self._channels[subscription]
            self.messages.setdefault(topic, []).append(decode(frame[1 + _HEAD.size :]))
        elif frame[0] == _TIME:
            self.times_us.append(int.from_bytes(frame[1:9], "little") // 1000)
