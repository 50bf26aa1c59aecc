"""A pose source for Qualisys Track Manager (QTM), over QTM's real-time protocol."""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from typing import Any, Final

import qtm_rt

from dart_flight.base.geometry import quaternion_from_matrix
from dart_flight.vehicle.motion_capture.source import (
    AbsentSourceError,
    PoseAddress,
    RawPose,
    in_quotes,
    lost_pose,
)

_TIMEOUT_S: Final = 5.0
_RETRY_S: Final = 1.0


def body_names(parameters_xml: str) -> tuple[list[str], list[str]]:
    """Return the names of all and of the enabled 6DOF bodies. Raise ValueError if the input is not XML."""
    try:
        bodies = list(ET.fromstring(parameters_xml).iter("Body"))
    except ET.ParseError as error:
        raise ValueError(f"QTM's parameters are not XML: {error}") from None
    names = [(body.findtext("Name", ""), body.findtext("Enabled", "true")) for body in bodies]
    return [name for name, _ in names], [name for name, enabled in names if enabled.lower() != "false"]


class QualisysSource:
    """A source that reads one 6DOF body from QTM, in an event loop on its own thread.

    The port in the URL is QTM's little-endian port. The constructor raises AbsentSourceError if QTM does not
    answer, or does not stream the body.
    """

    def __init__(self, address: PoseAddress) -> None:
        self._address, self._sender = address, f"{address.host}:{address.port}"
        self.place = f"QTM at {self._sender}"
        self.remedy = "start a measurement in QTM"
        self.problem: str | None = None
        self._all: list[str] = []
        self._enabled: list[str] = []
        self._deliver: Callable[[RawPose], None] = lambda _: None
        self._loop = asyncio.new_event_loop()
        self._disconnected = asyncio.Event()
        self._thread = threading.Thread(target=self._loop.run_forever, name="mocap", daemon=True)
        self._thread.start()
        self._connection: Any = None
        self._streaming: asyncio.Task[None] | None = None
        try:
            self._call(self._connect())
        except (ValueError, OSError, TimeoutError) as error:
            self._end()
            reason = str(error) or "no answer"
            raise AbsentSourceError(f"mocap URL {address.url}: {self._sender}: {reason}") from None
        if address.body not in self._all:
            self._call(self._disconnect())
            self._end()
            raise AbsentSourceError(f"mocap URL {address.url}: {self._describe_missing_body()}")

    def _describe_missing_body(self) -> str:
        return f'QTM has no 6DOF body "{self._address.body}", only {in_quotes(self._all)}'

    def _call(self, routine: Any) -> None:
        asyncio.run_coroutine_threadsafe(routine, self._loop).result(2.0 * _TIMEOUT_S)

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _connect(self) -> None:
        """Connect and read the names of the bodies.

        Raises:
            ValueError: the answer does not come from QTM.
            TimeoutError: nothing answers.
        """
        self._disconnected.clear()
        self._connection = await asyncio.wait_for(
            qtm_rt.connect(
                self._address.host, self._address.port, on_disconnect=lambda _: self._disconnected.set()
            ),
            _TIMEOUT_S,
        )
        if self._connection is None:
            raise ValueError("QTM does not answer; check address and port, and start QTM")
        try:
            parameters = await self._connection.get_parameters(parameters=["6d"])
            self._all, self._enabled = body_names(parameters.decode("utf-8", "replace"))
        except qtm_rt.QRTCommandException as error:
            raise ValueError(f"QTM refuses to list its bodies: {error}") from None

    async def _disconnect(self) -> None:
        if self._connection is not None and self._connection.has_transport():
            self._connection.disconnect()
            await self._disconnected.wait()

    def start(self, deliver: Callable[[RawPose], None]) -> None:
        self._deliver = deliver
        self._call(self._begin())

    async def _begin(self) -> None:
        self._streaming = asyncio.create_task(self._stream())

    def stop(self) -> None:
        if self._loop.is_closed():
            return
        self._deliver = lambda _: None
        with contextlib.suppress(TimeoutError):
            self._call(self._finish())
        self._end()

    async def _finish(self) -> None:
        if self._streaming is not None:
            self._streaming.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._streaming
        await self._disconnect()

    async def _stream(self) -> None:
        """Stream until stopped; connect again if the connection is lost."""
        while True:
            try:
                if self._connection is None or not self._connection.has_transport():
                    await self._connect()
                # The client waits here for the first frame, which may arrive at any time.
                with contextlib.suppress(TimeoutError):
                    await self._connection.stream_frames(components=["6d"], on_packet=self._on_packet)
                await self._disconnected.wait()
                self.problem = f"connection to QTM at {self._sender} lost"
            except (ValueError, OSError, TimeoutError, qtm_rt.QRTCommandException) as error:
                self.problem = f"QTM at {self._sender}: {error or 'no answer'}"
            await asyncio.sleep(_RETRY_S)

    def _on_packet(self, packet: Any) -> None:
        found = packet.get_6d()
        if found is None:
            self.problem = f"QTM at {self._sender} sends frames without 6DOF bodies"
            return
        bodies, number, source_us = found[1], int(packet.framenumber), int(packet.timestamp)
        names = self._enabled if len(bodies) == len(self._enabled) else self._all
        if len(bodies) != len(names) or self._address.body not in names:
            self.problem = (
                f"QTM sends {len(bodies)} bodies but has named {len(self._all)}: restart the stream"
            )
            self._deliver(lost_pose(self._address.body, number, source_us, self._sender))
            return
        self.problem = None
        position, rotation = bodies[names.index(self._address.body)]
        self._deliver(self._pose(position, rotation.matrix, number, source_us))

    def _pose(
        self, position_mm: Sequence[float], matrix: Sequence[float], number: int, source_us: int
    ) -> RawPose:
        body, (x, y, z) = self._address.body, position_mm
        with contextlib.suppress(ValueError):
            if all(map(math.isfinite, (x, y, z))):
                attitude = quaternion_from_matrix(matrix)
                position = (1e-3 * x, 1e-3 * y, 1e-3 * z)
                return RawPose(body, True, position, attitude, number, source_us, self._sender)
        return lost_pose(body, number, source_us, self._sender)


def open_source(address: PoseAddress) -> QualisysSource:
    return QualisysSource(address)
