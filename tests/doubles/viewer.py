"""A viewer of flights that is not the SDK's: decodes what is published by the schemas that come with it."""

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
from websockets.typing import Subprotocol

SUBPROTOCOL = "foxglove.sdk.v1"
_MESSAGE, _TIME = 1, 2  # first byte of a binary frame
_HEAD = struct.Struct("<IQ")  # subscription, time in ns
_ASK_EVERY_S = 0.2  # whether there is enough: what it takes to answer grows with what has come


class Decoder:
    """Decodes the messages of one channel.

    Args:
        encoding: of the messages, protobuf or json.
        schema_name: the message's type.
        schema: as bytes; of protobuf a FileDescriptorSet.
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
        """A message as a dictionary, with protobuf's own names and every field in it."""
        if self._kind is None:
            decoded: dict[str, Any] = json.loads(data)
            return decoded
        message = self._kind.FromString(data)
        return json_format.MessageToDict(
            message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
        )


def advertised(channel: dict[str, Any]) -> Decoder:
    """The decoder of a channel as foxglove.websocket.v1 advertises it."""
    text = channel["schema"]
    binary = channel.get("schemaEncoding") == "protobuf"
    schema = base64.b64decode(text) if binary else text.encode()
    return Decoder(channel["encoding"], channel["schemaName"], schema)


class Viewer:
    """A client of foxglove.websocket.v1 by the `websockets` package: subscribes to everything and keeps it.

    Args:
        url: ws://...
        wanted: says when enough has come.

    Attributes:
        capabilities: that the server offers.
        messages: topic -> messages, in the order of their coming.
        times_us: of the flight, as the server tells it.
    """

    def __init__(self, url: str, wanted: Callable[[dict[str, list[dict[str, Any]]]], bool]) -> None:
        self._url, self._wanted = url, wanted
        self.capabilities: list[str] | None = None
        self.messages: dict[str, list[dict[str, Any]]] = {}
        self.times_us: list[int] = []
        self.refused: list[str] = []
        self._channels: dict[int, tuple[str, Decoder]] = {}

    def watch(self, timeout_s: float) -> bool:
        """Look until there is enough, the server goes, or time is up; whether there was enough."""
        ends = time.monotonic() + timeout_s
        asked = 0.0
        with self._connect(ends) as socket:
            while time.monotonic() < ends:
                try:
                    self._take(socket, socket.recv(timeout=_ASK_EVERY_S))
                except TimeoutError:
                    pass
                except ConnectionClosed:
                    break
                if time.monotonic() - asked > _ASK_EVERY_S:
                    if self._wanted(self.messages):
                        return True
                    asked = time.monotonic()
        return self._wanted(self.messages)

    def _connect(self, ends: float) -> ClientConnection:
        """Once there is a server."""
        while True:
            try:
                return connect(self._url, subprotocols=[Subprotocol(SUBPROTOCOL)], max_size=None)
            except ConnectionRefusedError:
                if time.monotonic() > ends:
                    raise
                time.sleep(0.05)

    def _take(self, socket: ClientConnection, frame: str | bytes) -> None:
        if isinstance(frame, bytes):
            self._take_binary(frame)
            return
        message = json.loads(frame)
        if message["op"] == "serverInfo":
            self.capabilities = message["capabilities"]
            # Nothing may be published: this one tries.
            offer = {"id": 1, "topic": "/mine", "encoding": "json", "schemaName": ""}
            socket.send(json.dumps({"op": "advertise", "channels": [offer]}))
        elif message["op"] == "advertise":
            for channel in message["channels"]:
                self._channels[channel["id"]] = (channel["topic"], advertised(channel))
            ids = [{"id": channel["id"], "channelId": channel["id"]} for channel in message["channels"]]
            socket.send(json.dumps({"op": "subscribe", "subscriptions": ids}))
        elif message["op"] == "status":
            self.refused.append(message["message"])

    def _take_binary(self, frame: bytes) -> None:
        if frame[0] == _MESSAGE:
            subscription, _ = _HEAD.unpack_from(frame, 1)
            topic, decode = self._channels[subscription]
            self.messages.setdefault(topic, []).append(decode(frame[1 + _HEAD.size :]))
        elif frame[0] == _TIME:
            self.times_us.append(int.from_bytes(frame[1:9], "little") // 1000)
