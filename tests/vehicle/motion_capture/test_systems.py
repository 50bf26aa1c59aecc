"""The emulated systems with the vendors' unmodified clients and with our sources; damaged packets."""

import asyncio
import contextlib
import io
import itertools
import math
import queue
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from typing import Any

import natnet
import pytest
import qtm_rt
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import (
    quaternion_from_intrinsic_xyz,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate,
    rotation_angle,
)
from dart_flight.base.records import PoseSample
from dart_flight.config.document import InputError
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.sim.motion_capture import PoseServer, make_server
from dart_flight.sim.motion_capture.vicon_sender import euler_xyz
from dart_flight.vehicle.clock import SimulatedTime
from dart_flight.vehicle.motion_capture import vicon, vrpn
from dart_flight.vehicle.motion_capture.pose_bridge import MotionCaptureBridge
from dart_flight.vehicle.motion_capture.qualisys import body_names
from dart_flight.vehicle.motion_capture.source import PoseSource, RawPose, checked_pose, open_source
from tests.doubles.ports import free_udp_port

BODY = "my dart"
POSITION = (1.25, -2.5, 0.75)
ATTITUDE = quaternion_from_rotation_vector((0.4, -0.9, 2.0))
VECTORS = st.tuples(*[st.floats(-2.5, 2.5)] * 3)
SYSTEMS = ("optitrack", "qualisys", "vicon", "udp")


def wait_until(condition: Callable[[], object]) -> None:
    end_s = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.005)


@contextlib.contextmanager
def connected_source(kind: str) -> Iterator[tuple[PoseServer, PoseSource, "queue.Queue[RawPose]"]]:
    server = make_server(kind, BODY)
    poses: queue.Queue[RawPose] = queue.Queue()
    try:
        source = open_source(server.url)
        source.start(poses.put)
        try:
            wait_until(lambda: server.clients)
            yield server, source, poses
        finally:
            source.stop()
    finally:
        server.close()


@pytest.mark.parametrize("kind", SYSTEMS)
def test_a_source_reads_its_emulated_system(kind: str) -> None:
    with connected_source(kind) as (server, source, poses):
        server.publish(1_000_000, POSITION, ATTITUDE)
        server.publish(1_020_000, POSITION, ATTITUDE, tracked=False)
        first, second = poses.get(timeout=30), poses.get(timeout=30)
        assert source.problem is None
    assert (first.body, first.tracked, second.tracked) == (BODY, True, False)
    assert first.position_room == pytest.approx(POSITION, abs=1e-6)
    assert rotation_angle(first.q_body_to_room, ATTITUDE) < 1e-6
    assert first.frame_number is not None
    assert second.frame_number == first.frame_number + 1
    if kind == "vicon":  # its stream has no stamp
        assert first.source_us is None
    else:
        assert (first.source_us, second.source_us) == (1_000_000, 1_020_000)


@pytest.mark.parametrize("kind", ["optitrack", "qualisys", "vrpn"])
def test_an_unknown_body_is_refused_with_the_names_of_the_known_bodies(kind: str) -> None:
    server = make_server(kind, BODY)
    try:
        with pytest.raises(InputError, match=f'no .* "cat", only .*"{BODY}".*"wand"'):
            open_source(server.url.rpartition("/")[0] + "/cat")
    finally:
        server.close()


@pytest.mark.parametrize(
    ("scheme", "program"), [("optitrack", "Motive"), ("qualisys", "QTM"), ("vrpn", "9: Connection refused")]
)
def test_a_system_that_does_not_answer_is_named(
    scheme: str, program: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dart_flight.vehicle.motion_capture.optitrack._PING_S", 0.05)
    with pytest.raises(InputError, match=program) as caught:
        open_source(f"{scheme}://127.0.0.1:9/{BODY}")
    assert "\n" not in str(caught.value)


def test_an_optitrack_body_can_be_selected_by_its_id() -> None:
    server = make_server("optitrack", BODY)
    poses: queue.Queue[RawPose] = queue.Queue()
    source = open_source(server.url.rpartition("/")[0] + "/7")
    source.start(poses.put)
    try:
        wait_until(lambda: server.clients)
        server.publish(0, POSITION, ATTITUDE)
        assert poses.get(timeout=30).tracked
    finally:
        source.stop()
        server.close()


def test_an_optitrack_source_survives_a_damaged_frame_and_a_forgetful_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("dart_flight.vehicle.motion_capture.optitrack._SILENT_S", 0.1)
    with connected_source("optitrack") as (server, source, poses):
        (client,) = server._clients.values()  # type: ignore[attr-defined]
        client.send(struct.pack("<HHI", 7, 4, 1))
        wait_until(lambda: source.problem)
        assert "damaged packet from" in str(source.problem)
        for address in list(server._clients):  # type: ignore[attr-defined]
            server._forget(address)  # type: ignore[attr-defined]
        wait_until(lambda: server.clients)
        server.publish(0, POSITION, ATTITUDE)
        assert poses.get(timeout=30).tracked
        assert source.problem is None


# --- the check of every reader's poses -----------------------------------------------------------------

BAD_POSITIONS = ((9_999_999.0, 9_999_999.0, 9_999_999.0), (0.0, -1200.0, 0.0))
NO_NUMBERS = ((math.nan,) * 3, (1.0, math.inf, 2.0))
BAD_ATTITUDES = ((0.4, 0.0, 0.0, 0.1), (1e-30, 0.0, 0.0, 1e-30), (1.0, 1.0, 0.0, 0.0))
BAD_POSES = {
    "optitrack": [
        *((p, ATTITUDE) for p in (*BAD_POSITIONS, *NO_NUMBERS)),
        *((POSITION, q) for q in (*BAD_ATTITUDES, (math.nan,) * 4)),
    ],
    "vrpn": [
        *((p, ATTITUDE) for p in (*BAD_POSITIONS, *NO_NUMBERS)),
        *((POSITION, q) for q in (*BAD_ATTITUDES, (math.nan,) * 4, (0.0,) * 4)),
    ],
    "qualisys": [(p, ATTITUDE) for p in (*BAD_POSITIONS, *NO_NUMBERS)],
    "vicon": [(p, ATTITUDE) for p in (*BAD_POSITIONS, *NO_NUMBERS)],
    "udp": [*((p, ATTITUDE) for p in BAD_POSITIONS), *((POSITION, q) for q in (*BAD_ATTITUDES, (0.0,) * 4))],
}


@pytest.mark.parametrize("kind", BAD_POSES)
def test_numbers_that_are_no_pose_count_as_a_lost_frame_and_do_not_reach_px4(kind: str) -> None:
    server, clock = make_server(kind, BODY), SimulatedTime()
    clock.receive(5_000_000, 0)
    sent: list[Any] = []
    poses: queue.Queue[PoseSample] = queue.Queue()
    bridge = MotionCaptureBridge(MotionCapture(), open_source(server.url), sent.append, clock, poses.put)
    bridge.start()
    try:
        wait_until(lambda: server.clients)
        stamps_us = itertools.count(1_000_000, 20_000)
        server.publish(next(stamps_us), POSITION, ATTITUDE)
        assert poses.get(timeout=30).tracked
        for number, (position, attitude) in enumerate(BAD_POSES[kind]):
            clock.receive(6_000_000 + number, 0)
            server.publish(next(stamps_us), position, attitude)
            lost = poses.get(timeout=30)
            assert (lost.tracked, lost.position_room) == (False, (0.0, 0.0, 0.0))
            assert kind == "qualisys" or "the body's" in str(bridge.problem)
        assert len(sent) == 1
        server.publish(next(stamps_us), POSITION, ATTITUDE)
        assert poses.get(timeout=30).tracked
        assert bridge.problem is None
    finally:
        bridge.stop()
        server.close()


def test_angles_of_a_vicon_object_that_are_no_numbers_are_no_attitude() -> None:
    for bad in (math.nan, math.inf):
        found = vicon.decode(vicon_block((BODY, (1.0, 2.0, 3.0, 0.0, bad, 0.0))), BODY, "a:1")
        assert isinstance(found, RawPose)
        pose, reason = checked_pose(found)
        assert (pose.tracked, reason) == (False, "the body's quaternion is not of length 1")


# --- the vendors' clients ------------------------------------------------------------------------------


def test_the_natnet_client_understands_the_emulated_server() -> None:
    server = make_server("optitrack", BODY)
    port = int(server.url.split(":")[2].partition("/")[0])
    client = natnet.NatNetClient("127.0.0.1", "127.0.0.1", command_port=port, use_multicast=False)
    frames: list[Any] = []
    models: list[Any] = []
    client.on_data_frame_received_event.handlers.append(frames.append)
    client.on_data_description_received_event.handlers.append(models.append)
    try:
        with client:
            assert client.server_info.application_name == "Motive"
            client.request_modeldef()
            wait_until(lambda: client.update_sync() or models)
            wait_until(lambda: server.clients)
            server.publish(5_000_000, POSITION, ATTITUDE)
            wait_until(lambda: client.update_sync() or frames)
    finally:
        server.close()
    (model, frame), w = (models[0], frames[0]), ATTITUDE[0]
    ids = {body.name: body.id_num for body in model.rigid_bodies}
    body = next(body for body in frame.rigid_bodies if body.id_num == ids[BODY])
    assert body.pos == pytest.approx(POSITION)
    assert body.rot == pytest.approx((*ATTITUDE[1:], w))
    assert body.tracking_valid
    assert frame.suffix.timestamp == pytest.approx(5.0)


def test_the_qtm_client_understands_the_emulated_server() -> None:
    server = make_server("qualisys", BODY)
    port = int(server.url.split(":")[2].partition("/")[0])

    async def receive_frame() -> tuple[bytes, Any]:
        connection = await qtm_rt.connect("127.0.0.1", port)
        assert connection is not None
        names = await connection.get_parameters(parameters=["6d"])
        with pytest.raises(qtm_rt.QRTCommandException):
            await connection.qtm_version()
        packets: asyncio.Queue[Any] = asyncio.Queue()
        streaming = asyncio.create_task(
            connection.stream_frames(components=["6d"], on_packet=packets.put_nowait)
        )
        await asyncio.to_thread(wait_until, lambda: server.clients)
        server.publish(5_000_000, POSITION, ATTITUDE)
        packet = await packets.get()
        assert await streaming == b"Ok"
        connection.disconnect()
        return names, packet

    try:
        names, packet = asyncio.run(asyncio.wait_for(receive_frame(), 60))
    finally:
        server.close()
    assert body_names(names.decode())[0] == ["wand", BODY]
    position, rotation = packet.get_6d()[1][1]
    assert tuple(position) == pytest.approx([1e3 * x for x in POSITION])
    assert rotation.matrix[:3] == pytest.approx(rotate(ATTITUDE, (1.0, 0.0, 0.0)), abs=1e-6)
    assert packet.timestamp == 5_000_000


GROUP = (239, 255, 42, 99)


class OldMotive:
    """A minimal Motive 2: NatNet 3.1 without list sizes, with markers, a skeleton and a force plate."""

    def __init__(self, data_port: int = 0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        self.data_port = data_port  # multicast port, or 0 for unicast
        self.client: tuple[str, int] | None = None
        threading.Thread(target=self.answer, daemon=True).start()

    def answer(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                data, sender = self.socket.recvfrom(65535)
                kind = data[0]
                if kind == 0:
                    info = b"Motive".ljust(256, b"\0") + bytes((2, 2, 0, 0, 3, 1, 0, 0))
                    info += struct.pack("<QHB4B", 1_000_000, self.data_port, self.data_port != 0, *GROUP)
                    self.send(1, info, sender)
                elif kind == 4:
                    self.send(5, self.model(), sender)
                elif kind == 10:
                    self.client = sender

    def send(self, kind: int, payload: bytes, to: tuple[str, int]) -> None:
        self.socket.sendto(struct.pack("<HH", kind, len(payload)) + payload, to)

    @staticmethod
    def body(name: bytes, number: int, markers: int) -> bytes:
        data = name + b"\0" + struct.pack("<ii3fI", number, -1, 0, 0, 0, markers)
        return data + struct.pack(f"<{3 * markers}f{markers}I", *[0.1] * 3 * markers, *[0] * markers)

    def model(self) -> bytes:
        marker_set = struct.pack("<I", 0) + b"all\0" + struct.pack("<I", 1) + b"m1\0"
        skeleton = struct.pack("<I", 2) + b"man\0" + struct.pack("<II", 1, 1) + self.body(b"hip", 1, 0)
        bodies = struct.pack("<I", 1) + self.body(b"cat", 2, 3)
        bodies += struct.pack("<I", 1) + self.body(BODY.encode(), 3, 4)
        return struct.pack("<I", 4) + marker_set + skeleton + bodies

    def frame(self, number: int, stamp_us: int) -> bytes:
        def rigid_body(identity: int, *pose: float) -> bytes:
            return struct.pack("<I7ffH", identity, *pose, 1e-4, 1)

        w, x, y, z = ATTITUDE
        data = struct.pack("<II", number, 1) + b"all\0" + struct.pack("<I3f", 1, 0.1, 0.2, 0.3)
        data += struct.pack("<I6f", 2, *[0.5] * 6)
        data += (
            struct.pack("<I", 2) + rigid_body(2, 9, 9, 9, 0, 0, 0, 1) + rigid_body(3, *POSITION, x, y, z, w)
        )
        data += struct.pack("<III", 1, 1, 1) + rigid_body(1, 8, 8, 8, 0, 0, 0, 1)
        data += struct.pack("<II3ffHf", 1, 0x10001, 0.1, 0.2, 0.3, 0.01, 2, 1e-4)
        data += struct.pack("<IIII2f", 1, 1, 1, 2, 5.0, 6.0) + struct.pack("<I", 0)
        return data + struct.pack("<IIdQQQHI", 0, 0, 1e-6 * stamp_us, stamp_us, stamp_us, stamp_us, 0, 0)


@pytest.mark.parametrize("multicast", [False, True])
def test_a_body_is_read_from_a_natnet_3_frame_with_other_content(multicast: bool) -> None:
    motive = OldMotive(free_udp_port() if multicast else 0)
    poses: queue.Queue[RawPose] = queue.Queue()
    source = open_source(f"optitrack://127.0.0.1:{motive.socket.getsockname()[1]}/my%20dart")
    source.start(poses.put)
    try:
        client = (".".join(map(str, GROUP)), motive.data_port)
        if not multicast:
            wait_until(lambda: motive.client)
            assert motive.client is not None
            client = motive.client
        motive.send(7, motive.frame(41, 2_000_000), client)
        pose = poses.get(timeout=30)
    finally:
        source.stop()
        motive.socket.close()
    assert pose[:2] == (BODY, True)
    assert pose.position_room == pytest.approx(POSITION)
    assert rotation_angle(pose.q_body_to_room, ATTITUDE) < 1e-6
    assert (pose.frame_number, pose.source_us) == (41, 2_000_000)


# --- handwritten packets -------------------------------------------------------------------------------


def vicon_block(*objects: tuple[str, tuple[float, ...]], frame: int = 9, count: int | None = None) -> bytes:
    data = struct.pack("<IB", frame, len(objects) if count is None else count)
    for name, values in objects:
        data += struct.pack("<BH24s6d", 0, 72, name.encode(), *values)
    return data


def test_a_vicon_block_with_two_objects_is_decoded() -> None:
    block = vicon_block(("wand", (1, 2, 3, 0, 0, 0)), (BODY, (1000, -2000, 3000, 0, 0, math.pi / 2)))
    assert len(block) == 155
    pose = vicon.decode(block, BODY, "a:1")
    assert isinstance(pose, RawPose)
    assert (pose.tracked, pose.frame_number, pose.source_us) == (True, 9, None)
    assert pose.position_room == pytest.approx((1.0, -2.0, 3.0))
    assert rotate(pose.q_body_to_room, (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0))
    unknown_item = struct.pack("<IBBH3s", 1, 2, 4, 3, b"xyz") + block[5 + 75 :]
    assert isinstance(vicon.decode(unknown_item, BODY, "a:1"), RawPose)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "shorter than a block"),
        (vicon_block((BODY, (1,) * 6), count=3)[:-75] + b"\0", "fewer items"),
        (vicon_block((BODY, (1,) * 6))[:-1], "wrong size"),
        (struct.pack("<IBBH", 1, 1, 0, 71) + bytes(71), "wrong size"),
        (vicon_block(("cat", (1,) * 6)), 'no object "my dart", only "cat"'),
    ],
)
def test_a_wrong_vicon_block_is_ignored_with_its_reason(data: bytes, reason: str) -> None:
    found = vicon.decode(data, BODY, "a:1")
    assert isinstance(found, str)
    assert reason in found


@given(st.binary(max_size=300))
def test_any_vicon_datagram_is_decoded_or_ignored(data: bytes) -> None:
    assert isinstance(vicon.decode(data, "", "a:1"), str | RawPose)


@given(VECTORS)
def test_vicon_euler_angles_convert_back_to_the_attitude(vector: tuple[float, float, float]) -> None:
    q = quaternion_from_rotation_vector(vector)
    assert rotation_angle(quaternion_from_intrinsic_xyz(*euler_xyz(q)), q) < 1e-5


@given(VECTORS | st.sampled_from([tuple(math.pi * x for x in v) for v in product((0, 1), repeat=3)]))
def test_a_rotation_matrix_by_columns_converts_back_to_the_attitude(
    vector: tuple[float, float, float],
) -> None:
    q = quaternion_from_rotation_vector(vector)
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    columns = [x for axis in axes for x in rotate(q, axis)]
    assert rotation_angle(quaternion_from_matrix(columns), q) < 1e-6


def test_a_matrix_that_is_not_a_rotation_is_refused() -> None:
    with pytest.raises(ValueError, match="not a rotation"):
        quaternion_from_matrix([math.nan] * 9)


def test_a_qtm_frame_with_a_wrong_body_count_is_lost_and_reported() -> None:
    with connected_source("qualisys") as (server, source, poses):
        source._all = source._enabled = ["wand", "hat", BODY]  # type: ignore[attr-defined]
        server.publish(0, POSITION, ATTITUDE)
        assert not poses.get(timeout=30).tracked
        assert source.problem == "QTM sends 2 bodies but has named 3: restart the stream"


def test_disabled_qtm_bodies_are_recognised() -> None:
    xml = (
        "<QTM_Parameters_Ver_1.25><The_6D><Body><Name>a</Name><Enabled>false</Enabled></Body>"
        "<Body><Name>b</Name><Enabled>true</Enabled></Body></The_6D></QTM_Parameters_Ver_1.25>"
    )
    assert body_names(xml) == (["a", "b"], ["b"])
    with pytest.raises(ValueError, match="not XML"):
        body_names("Parse error")


# --- VRPN, byte by byte --------------------------------------------------------------------------------

VRPN_COOKIE = b"vrpn: ver. 07.33  0\0\0\0\0\0"
VRPN_NAMES = (
    bytes.fromhex("00000024 00000000 00000000 00000002 ffffffff 00000000 00000008")
    + b"my dart\0\0\0\0\0"
    + bytes.fromhex("00000032 00000000 00000000 00000005 fffffffe 00000000 00000016")
    + b"vrpn_Tracker Pos_Quat\0\0\0\0\0\0\0"
)
VRPN_HEADER = bytes.fromhex("00000058 00000003 00000007 00000002 00000005 00000029")
VRPN_POSE = VRPN_HEADER + bytes.fromhex(
    "00000000 00000000"
    "3ff4000000000000 c004000000000000 3fe8000000000000"
    "0000000000000000 0000000000000000 3fe3333333333333 3fe999999999999a"
)


def vrpn_poses(data: bytes) -> list[RawPose]:
    return list(vrpn.read_poses(io.BytesIO(VRPN_COOKIE + data), BODY, "a:1", {}))


def test_a_vrpn_pose_is_decoded() -> None:
    other_sensor = VRPN_POSE[:27] + b"\1" + VRPN_POSE[28:]
    other_sender = VRPN_POSE[:15] + b"\3" + VRPN_POSE[16:]
    other_type = VRPN_POSE[:19] + b"\4" + VRPN_POSE[20:]
    port = bytes.fromhex("0000001d 00000000 00000000 0000c350 fffffffd 00000000") + b"host\0\0\0\0"
    data = port + VRPN_NAMES + other_sensor + other_sender + other_type + VRPN_POSE
    (pose,) = vrpn_poses(data + VRPN_POSE[:50])  # the connection is lost in the last message
    assert pose.position_room == POSITION
    assert pose.q_body_to_room == pytest.approx((0.8, 0.0, 0.0, 0.6))
    assert (pose.body, pose.tracked, pose.frame_number, pose.source_us) == (BODY, True, 41, 3_000_007)
    assert vrpn_poses(VRPN_POSE + VRPN_NAMES[:40] + VRPN_POSE) == []  # before the names are known
    padded = b"\0\0\0\x28" + VRPN_NAMES[4:40] + b"\0\0\0\x38" + VRPN_NAMES[44:]
    assert vrpn_poses(padded + VRPN_POSE) == [pose]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"\0\0\0\x17" + VRPN_POSE[4:], "message of 23 bytes"),
        (b"\xff\xff\xff\xff" + VRPN_POSE[4:], "message of 4294967295 bytes"),
        (b"\0\0\0\x50" + VRPN_POSE[4:-8], "pose of 56 bytes"),
    ],
)
def test_nonsense_of_a_vrpn_server_is_an_error(data: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        vrpn_poses(VRPN_NAMES + data)
    with pytest.raises(ValueError, match="no cookie of VRPN 7"):
        list(vrpn.read_poses(io.BytesIO(b"SSH-2.0-OpenSSH_9.2"), BODY, "a:1", {}))


@given(st.binary(max_size=300), st.integers(0, 87))
def test_any_vrpn_bytes_are_poses_or_an_error(data: bytes, place: int) -> None:
    damaged = VRPN_POSE[:place] + data[:4] + VRPN_POSE[place + 4 :]
    for nonsense in (data, VRPN_COOKIE + data, VRPN_COOKIE + VRPN_NAMES + damaged + data):
        with contextlib.suppress(ValueError):
            for pose in vrpn.read_poses(io.BytesIO(nonsense), BODY, "a:1", {}):
                assert isinstance(pose, RawPose)


def test_a_vrpn_source_names_a_silent_body_and_reads_on() -> None:
    with connected_source("vrpn") as (server, source, poses):
        server.publish(1_000_000, POSITION, ATTITUDE)
        server.publish(1_010_000, POSITION, ATTITUDE, tracked=False)  # only the wand's pose
        wait_until(lambda: source.problem)
        assert 'no pose of "my dart" (sensor 0) for' in str(source.problem)
        server.publish(1_020_000, POSITION, ATTITUDE)
        first, second = poses.get(timeout=30), poses.get(timeout=30)
        assert source.problem is None
    assert first.position_room == pytest.approx(POSITION)
    assert rotation_angle(first.q_body_to_room, ATTITUDE) < 1e-6
    assert (first.frame_number, second.frame_number) == (0, 2)
    assert (first.source_us, second.source_us) == (1_000_000, 1_020_000)


def test_a_vrpn_source_survives_nonsense_and_a_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vrpn, "_RETRY_S", 0.05)
    poses: queue.Queue[RawPose] = queue.Queue()
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
        wait_until(lambda: f"VRPN server at 127.0.0.1:{port}: {reason}" == source.problem)

    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(serve, greeting + VRPN_POSE)
        source = open_source(f"vrpn://127.0.0.1:{port}/my%20dart")
        link = first.result()
    source.start(poses.put)
    try:
        link.close()
        link = serve(greeting + b"\xff" * 24)
        is_named("message of 4294967295 bytes")
        with pytest.raises(ConnectionResetError):  # a reset leaves the server's port free
            link.recv(1)
        for data, reason in (
            (b"HTTP/1.1 400 Bad Request", "no cookie of VRPN 7"),
            (VRPN_COOKIE, "no answer"),
            (
                VRPN_COOKIE + VRPN_NAMES[40:] + VRPN_NAMES[:24] + b"\0\0\0\4cat\0" + bytes(8),
                'no sender "my dart", only "cat"',
            ),
        ):
            link.close()
            link = serve(data)
            is_named(reason)
        link.close()
        link = serve(greeting + VRPN_POSE)
        assert poses.get(timeout=30).position_room == POSITION
        assert source.problem is None
        listener.close()
        link.close()
        is_named("Connection refused")
    finally:
        source.stop()
        link.close()
        listener.close()
