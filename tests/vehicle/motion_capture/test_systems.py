"""One suite for all motion-capture systems: emulated, read by our sources and by the vendors' clients."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import queue
import socket
import struct
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import natnet
import pytest
import qtm_rt

from dart_flight.base.geometry import (
    Quaternion,
    Vec3,
    quaternion_from_rotation_vector,
    rotate,
    rotation_angle,
)
from dart_flight.base.records import PoseSample
from dart_flight.cli import main
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.sim.motion_capture import KINDS, PoseServer, make_server
from dart_flight.vehicle.clock import SimulatedTime
from dart_flight.vehicle.motion_capture import vrpn
from dart_flight.vehicle.motion_capture.natnet_packets import KEEP_ALIVE
from dart_flight.vehicle.motion_capture.pose_bridge import MotionCaptureBridge
from dart_flight.vehicle.motion_capture.qualisys import body_names
from dart_flight.vehicle.motion_capture.source import SYSTEMS as READ
from dart_flight.vehicle.motion_capture.source import AbsentSourceError, PoseSource, RawPose, open_source
from tests.doubles.ports import free_udp_port
from tests.doubles.scripted_peer import NatNet, ScriptedPeer, UdpLink
from tests.real_time import wait_until
from tests.vehicle.motion_capture.test_decoders import VRPN_COOKIE, VRPN_NAMES, VRPN_POSE

PAGE = Path(__file__).parents[3] / "docs" / "motion_capture.md"
BODY = "my dart"
POSITION = (1.25, -2.5, 0.75)
ATTITUDE = quaternion_from_rotation_vector((0.4, -0.9, 2.0))
STAMPS_US = (1_000_000, 1_020_000)
WAIT_S = 30.0

FAR = ((9_999_999.0, 9_999_999.0, 9_999_999.0), (0.0, -1200.0, 0.0))
NO_NUMBERS = ((math.nan,) * 3, (1.0, math.inf, 2.0))
NO_ROTATIONS = ((0.4, 0.0, 0.0, 0.1), (1e-30, 0.0, 0.0, 1e-30), (1.0, 1.0, 0.0, 0.0))
NAN_ROTATION, ZERO_ROTATION = (math.nan,) * 4, (0.0,) * 4


class System(NamedTuple):
    """What differs between the systems.

    Attributes:
        stamped: whether its frames have a stamp.
        program: the part of the message if nothing answers, for a system that is asked; None: it only sends.
        tells_lost: whether it sends frames in which the body is lost.
        says_why: whether every frame that is no pose is named as the reason.
        positions: positions that it can send but are none.
        attitudes: attitudes that it can send but are none.
    """

    stamped: bool = True
    program: str | None = None
    tells_lost: bool = True
    says_why: bool = True
    positions: tuple[Vec3, ...] = (*FAR, *NO_NUMBERS)
    attitudes: tuple[Quaternion, ...] = ()


SYSTEMS = {
    "optitrack": System(program="Motive", attitudes=(*NO_ROTATIONS, NAN_ROTATION)),
    "qualisys": System(program="QTM", says_why=False),
    "vicon": System(stamped=False),
    "vrpn": System(
        program="9: Connection refused",
        tells_lost=False,
        attitudes=(*NO_ROTATIONS, NAN_ROTATION, ZERO_ROTATION),
    ),
    "udp": System(positions=FAR, attitudes=(*NO_ROTATIONS, ZERO_ROTATION)),  # JSON has no NaN
}
ASKED = [kind for kind, system in SYSTEMS.items() if system.program is not None]


@contextlib.contextmanager
def serving(kind: str) -> Iterator[PoseServer]:
    server = make_server(kind, BODY)
    try:
        yield server
    finally:
        server.close()


@contextlib.contextmanager
def delivering(source: PoseSource) -> Iterator[queue.Queue[RawPose]]:
    """Start a source within the context."""
    poses: queue.Queue[RawPose] = queue.Queue()
    source.start(poses.put)
    try:
        yield poses
    finally:
        source.stop()


@contextlib.contextmanager
def connected(kind: str) -> Iterator[tuple[PoseServer, PoseSource, queue.Queue[RawPose]]]:
    with serving(kind) as server:
        source = open_source(server.url)
        with delivering(source) as poses:
            wait_until(lambda: server.clients, WAIT_S, "the source listens")
            yield server, source, poses


def url_of_body(server: PoseServer, body: str) -> str:
    return f"{server.url.rpartition('/')[0]}/{body}"


def assert_is_the_pose(pose: RawPose) -> None:
    assert (pose.body, pose.tracked) == (BODY, True)
    assert pose.position_room == pytest.approx(POSITION, abs=1e-6)
    assert rotation_angle(pose.q_body_to_room, ATTITUDE) < 1e-6


def test_every_system_is_tested_and_emulated() -> None:
    assert set(READ) == set(SYSTEMS) == set(KINDS)


@pytest.mark.parametrize("url", [system.url for system in READ.values()])
def test_every_system_is_on_the_page_and_in_the_help(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"\n| `{url}` | " in PAGE.read_text("utf-8")
    with pytest.raises(SystemExit):
        main(["mocap", "--help"])
    assert url in "".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("kind", SYSTEMS)
def test_a_source_delivers_poses_in_metres_with_frame_and_stamp_until_it_is_stopped(kind: str) -> None:
    with serving(kind) as server:
        source = open_source(server.url)
        with delivering(source) as poses:
            wait_until(lambda: server.clients, WAIT_S, "the source listens")
            for t_us in STAMPS_US:
                server.publish(t_us, POSITION, ATTITUDE)
            pair = [poses.get(timeout=WAIT_S) for _ in STAMPS_US]
            assert source.problem is None
        server.publish(2_000_000, POSITION, ATTITUDE)
        open_source(server.url).stop()  # the address is free again
        assert poses.empty()
    for pose, t_us in zip(pair, STAMPS_US, strict=True):
        assert_is_the_pose(pose)
        assert pose.source_us == (t_us if SYSTEMS[kind].stamped else None)
    first, second = (pose.frame_number for pose in pair)
    assert first is not None
    assert second == first + 1


@pytest.mark.parametrize("kind", SYSTEMS)
def test_a_lost_body_is_reported_and_found_again(kind: str) -> None:
    with connected(kind) as (server, source, poses):
        server.publish(1_000_000, POSITION, ATTITUDE)
        assert_is_the_pose(poses.get(timeout=WAIT_S))
        server.publish(1_020_000, POSITION, ATTITUDE, tracked=False)
        if SYSTEMS[kind].tells_lost:
            lost = poses.get(timeout=WAIT_S)
            assert (lost.body, lost.tracked, lost.position_room) == (BODY, False, (0.0, 0.0, 0.0))
        else:
            wait_until(lambda: source.problem, WAIT_S, "the silence is named")
            assert f'no pose of "{BODY}"' in str(source.problem)
        server.publish(1_040_000, POSITION, ATTITUDE)
        found = poses.get(timeout=WAIT_S)
        assert_is_the_pose(found)
        assert found.source_us == (1_040_000 if SYSTEMS[kind].stamped else None)
        assert source.problem is None


@pytest.mark.parametrize("kind", SYSTEMS)
def test_numbers_that_are_no_pose_count_as_a_lost_frame_and_do_not_reach_px4(kind: str) -> None:
    system, clock, sent = SYSTEMS[kind], SimulatedTime(), list[Any]()
    clock.receive(5_000_000, 0)
    poses: queue.Queue[PoseSample] = queue.Queue()
    with serving(kind) as server:
        bridge = MotionCaptureBridge(MotionCapture(), open_source(server.url), sent.append, clock, poses.put)
        bridge.start()
        try:
            wait_until(lambda: server.clients, WAIT_S, "the bridge listens")
            stamps_us = itertools.count(1_000_000, 20_000)
            server.publish(next(stamps_us), POSITION, ATTITUDE)
            assert poses.get(timeout=WAIT_S).tracked
            bad = [(p, ATTITUDE) for p in system.positions] + [(POSITION, q) for q in system.attitudes]
            for number, (position, attitude) in enumerate(bad):
                clock.receive(6_000_000 + number, 0)
                server.publish(next(stamps_us), position, attitude)
                lost = poses.get(timeout=WAIT_S)
                assert (lost.tracked, lost.position_room) == (False, (0.0, 0.0, 0.0))
                assert not system.says_why or "the body's" in str(bridge.problem)
            assert len(sent) == 1
            server.publish(next(stamps_us), POSITION, ATTITUDE)
            assert poses.get(timeout=WAIT_S).tracked
            assert bridge.problem is None
        finally:
            bridge.stop()


@pytest.mark.parametrize("started", [False, True])
@pytest.mark.parametrize("kind", SYSTEMS)
def test_a_source_may_be_stopped_twice(kind: str, started: bool) -> None:
    """By the bridge, and by the command that opened it."""
    with serving(kind) as server:
        source = open_source(server.url)
        if started:
            source.start(lambda pose: None)
        source.stop()
        source.stop()


@pytest.mark.parametrize("kind", ASKED)
def test_an_unknown_body_is_refused_with_the_names_of_the_known_bodies(kind: str) -> None:
    with (
        serving(kind) as server,
        pytest.raises(AbsentSourceError, match=f'no .* "cat", only .*"{BODY}".*"wand"'),
    ):
        open_source(url_of_body(server, "cat"))


@pytest.mark.parametrize("kind", ASKED)
def test_a_system_that_does_not_answer_is_named(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dart_flight.vehicle.motion_capture.optitrack._PING_S", 0.05)
    with pytest.raises(AbsentSourceError, match=SYSTEMS[kind].program or "") as caught:
        open_source(f"{kind}://127.0.0.1:9/{BODY}")
    assert "\n" not in str(caught.value)


# --- the vendors' clients ------------------------------------------------------------------------------


def test_the_natnet_client_understands_the_emulated_server() -> None:
    frames, models = list[Any](), list[Any]()
    with serving("optitrack") as server:
        port = int(server.url.split(":")[2].partition("/")[0])
        client = natnet.NatNetClient("127.0.0.1", "127.0.0.1", command_port=port, use_multicast=False)
        client.on_data_frame_received_event.handlers.append(frames.append)
        client.on_data_description_received_event.handlers.append(models.append)
        with client:
            assert client.server_info.application_name == "Motive"
            client.request_modeldef()
            wait_until(lambda: client.update_sync() or models, WAIT_S, "the model")
            wait_until(lambda: server.clients, WAIT_S, "the client")
            server.publish(5_000_000, POSITION, ATTITUDE)
            wait_until(lambda: client.update_sync() or frames, WAIT_S, "the frame")
    (model, frame), w = (models[0], frames[0]), ATTITUDE[0]
    ids = {body.name: body.id_num for body in model.rigid_bodies}
    body = next(body for body in frame.rigid_bodies if body.id_num == ids[BODY])
    assert body.pos == pytest.approx(POSITION)
    assert body.rot == pytest.approx((*ATTITUDE[1:], w))
    assert body.tracking_valid
    assert frame.suffix.timestamp == pytest.approx(5.0)


def test_the_qtm_client_understands_the_emulated_server() -> None:
    async def receive_frame(server: PoseServer) -> tuple[bytes, Any]:
        port = int(server.url.split(":")[2].partition("/")[0])
        connection = await qtm_rt.connect("127.0.0.1", port)
        assert connection is not None
        names = await connection.get_parameters(parameters=["6d"])
        with pytest.raises(qtm_rt.QRTCommandException):
            await connection.qtm_version()
        packets: asyncio.Queue[Any] = asyncio.Queue()
        streaming = asyncio.create_task(
            connection.stream_frames(components=["6d"], on_packet=packets.put_nowait)
        )
        await asyncio.to_thread(wait_until, lambda: server.clients, WAIT_S, "the client")
        server.publish(5_000_000, POSITION, ATTITUDE)
        packet = await packets.get()
        assert await streaming == b"Ok"
        connection.disconnect()
        return names, packet

    with serving("qualisys") as server:
        names, packet = asyncio.run(asyncio.wait_for(receive_frame(server), 60))
    assert body_names(names.decode())[0] == ["wand", BODY]
    position, rotation = packet.get_6d()[1][1]
    assert tuple(position) == pytest.approx([1e3 * x for x in POSITION])
    assert rotation.matrix[:3] == pytest.approx(rotate(ATTITUDE, (1.0, 0.0, 0.0)), abs=1e-6)
    assert packet.timestamp == 5_000_000


# --- what single systems do besides ----------------------------------------------------------------------


def test_an_optitrack_body_can_be_selected_by_its_id() -> None:
    with serving("optitrack") as server, delivering(open_source(url_of_body(server, "7"))) as poses:
        wait_until(lambda: server.clients, WAIT_S, "the source listens")
        server.publish(0, POSITION, ATTITUDE)
        assert poses.get(timeout=WAIT_S).tracked


GROUP = (239, 255, 42, 99)
INFO, MODEL, FRAME = 1, 5, 7  # kinds of NatNet's packets


def old_motive(data_port: int = 0) -> tuple[ScriptedPeer, UdpLink]:
    """Return a minimal Motive 2, which has a marker set, a skeleton and two bodies, and its link."""
    info = b"Motive".ljust(256, b"\0") + bytes((2, 2, 0, 0, 3, 1, 0, 0))
    info += struct.pack("<QHB4B", 1_000_000, data_port, data_port != 0, *GROUP)

    def body(name: bytes, number: int, markers: int) -> bytes:
        data = name + b"\0" + struct.pack("<ii3fI", number, -1, 0, 0, 0, markers)
        return data + struct.pack(f"<{3 * markers}f{markers}I", *[0.1] * 3 * markers, *[0] * markers)

    model = struct.pack("<II", 4, 0) + b"all\0" + struct.pack("<I", 1) + b"m1\0"
    model += struct.pack("<I", 2) + b"man\0" + struct.pack("<II", 1, 1) + body(b"hip", 1, 0)
    model += struct.pack("<I", 1) + body(b"cat", 2, 3)
    model += struct.pack("<I", 1) + body(BODY.encode(), 3, 4)
    answers = {0: lambda _: [(INFO, info)], 4: lambda _: [(MODEL, model)]}
    link = UdpLink()
    return ScriptedPeer(link, NatNet(), answers), link


def old_frame(number: int, stamp_us: int) -> tuple[int, bytes]:
    def rigid_body(identity: int, *pose: float) -> bytes:
        return struct.pack("<I7ffH", identity, *pose, 1e-4, 1)

    w, x, y, z = ATTITUDE
    data = struct.pack("<II", number, 1) + b"all\0" + struct.pack("<I3f", 1, 0.1, 0.2, 0.3)
    data += struct.pack("<I6f", 2, *[0.5] * 6)
    data += struct.pack("<I", 2) + rigid_body(2, 9, 9, 9, 0, 0, 0, 1) + rigid_body(3, *POSITION, x, y, z, w)
    data += struct.pack("<III", 1, 1, 1) + rigid_body(1, 8, 8, 8, 0, 0, 0, 1)
    data += struct.pack("<II3ffHf", 1, 0x10001, 0.1, 0.2, 0.3, 0.01, 2, 1e-4)
    data += struct.pack("<IIII2f", 1, 1, 1, 2, 5.0, 6.0) + struct.pack("<I", 0)
    return FRAME, data + struct.pack("<IIdQQQHI", 0, 0, 1e-6 * stamp_us, stamp_us, stamp_us, stamp_us, 0, 0)


@pytest.mark.parametrize("multicast", [False, True])
def test_an_old_motive_is_read_after_a_damaged_frame_and_asked_again_while_it_is_silent(
    multicast: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dart_flight.vehicle.motion_capture.optitrack._SILENT_S", 0.1)
    data_port = free_udp_port() if multicast else 0
    motive, link = old_motive(data_port)

    def send(packet: tuple[int, bytes]) -> None:
        group = (".".join(map(str, GROUP)), data_port)
        link.socket.sendto(motive.protocol.encode(packet), group if multicast else link.to or group)

    with motive:
        source = open_source(f"optitrack://127.0.0.1:{link.port}/my%20dart")
        with delivering(source) as poses:
            for _ in range(2):  # a server that has forgotten its client hears of it again
                motive.received.clear()
                wait_until(lambda: motive.received_of(0 if multicast else KEEP_ALIVE), WAIT_S, "a query")
            send((FRAME, struct.pack("<I", 1)))
            wait_until(lambda: source.problem, WAIT_S, "the damaged frame")
            assert "damaged packet from" in str(source.problem)
            send(old_frame(41, 2_000_000))
            pose = poses.get(timeout=WAIT_S)
            assert source.problem is None
    assert_is_the_pose(pose)
    assert (pose.frame_number, pose.source_us) == (41, 2_000_000)


def test_a_qtm_frame_with_a_wrong_body_count_is_lost_and_reported() -> None:
    with connected("qualisys") as (server, source, poses):
        # QTM names its bodies only when it is asked, and the emulated one never changes them.
        source._all = source._enabled = ["wand", "hat", BODY]  # type: ignore[attr-defined]
        server.publish(0, POSITION, ATTITUDE)
        assert not poses.get(timeout=WAIT_S).tracked
        assert source.problem == "QTM sends 2 bodies but has named 3: restart the stream"


def test_a_vrpn_source_survives_nonsense_and_a_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vrpn, "_RETRY_S", 0.05)
    greeting = VRPN_COOKIE + VRPN_NAMES
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]

    def serve(data: bytes) -> socket.socket:
        link, _ = listener.accept()
        cookie = link.recv(100)
        assert (len(cookie), cookie[:14], cookie[16:19]) == (24, b"vrpn: ver. 07.", b"  0")
        link.sendall(data)
        return link

    def is_named(reason: str) -> None:
        text = f"VRPN server at 127.0.0.1:{port}: {reason}"
        wait_until(lambda: text == source.problem, WAIT_S, text)

    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(serve, greeting + VRPN_POSE)
        source = open_source(f"vrpn://127.0.0.1:{port}/my%20dart")
        link = first.result()
    with delivering(source) as poses, listener:
        link.close()
        link = serve(greeting + b"\xff" * 24)
        is_named("message of 4294967295 bytes")
        with pytest.raises(ConnectionResetError):  # a reset leaves the server's port free
            link.recv(1)
        other = VRPN_COOKIE + VRPN_NAMES[40:] + VRPN_NAMES[:24] + b"\0\0\0\4cat\0" + bytes(8)
        for data, reason in (
            (b"HTTP/1.1 400 Bad Request", "the answer does not come from a VRPN 7 server"),
            (VRPN_COOKIE, "no answer"),
            (other, 'no sender "my dart", only "cat"'),
        ):
            link.close()
            link = serve(data)
            is_named(reason)
        link.close()
        link = serve(greeting + VRPN_POSE)
        assert poses.get(timeout=WAIT_S).position_room == POSITION
        assert source.problem is None
        listener.close()
        link.close()
        is_named("Connection refused")
