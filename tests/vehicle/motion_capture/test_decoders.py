"""Handwritten packets of every motion-capture protocol; a damaged one has no other pose and no crash."""

from __future__ import annotations

import contextlib
import io
import json
import math
import struct
from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import (
    quaternion_from_intrinsic_xyz,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate,
    rotation_angle,
)
from dart_flight.sim.motion_capture.vicon_sender import euler_xyz
from dart_flight.vehicle.motion_capture import json_udp, vicon, vrpn
from dart_flight.vehicle.motion_capture.natnet_packets import (
    ServerInfo,
    Version,
    decode_bodies,
    decode_frame,
    decode_server_info,
)
from dart_flight.vehicle.motion_capture.qualisys import body_names
from dart_flight.vehicle.motion_capture.source import RawPose, checked_pose

BODY = "my dart"
POSITION = (1.25, -2.5, 0.75)
ATTITUDE = (0.8, 0.0, 0.0, 0.6)

# --- NatNet ----------------------------------------------------------------------------------------------

VERSIONS: tuple[Version, ...] = ((2, 7), (2, 11), (3, 1), (4, 0), (4, 1), (4, 2))
EXTRAS = ("none", "force plate", "device", "camera", "skeleton", "latin-1 asset")
LATIN = "Körper"
TICKS_PER_S = 10_000_000


def text(name: str) -> bytes:
    return name.encode("latin-1") + b"\0"


def described_body(name: str, number: int, version: Version, markers: int = 3) -> bytes:
    data = text(name) + struct.pack("<ii3f", number, -1, 0.0, 0.0, 0.0)
    data += struct.pack("<4f", 0, 0, 0, 1) if version >= (4, 2) else b""
    if version >= (3, 0):
        data += struct.pack("<I", markers) + bytes(16 * markers)
        data += b"".join(text(f"m{i}") for i in range(markers)) if version >= (4, 0) else b""
    return data


def extra(kind: str, version: Version) -> tuple[int, bytes]:
    channels = struct.pack("<iii", 1, 1, 2) + text("Fx") + text("Fy")
    return {
        "none": (0, text("all") + struct.pack("<i", 1) + text("m1")),
        "force plate": (3, struct.pack("<i", 1) + text("FP1") + bytes(4 * 161) + channels),
        "device": (4, struct.pack("<i", 1) + text("DAQ") + text("SN1") + channels),
        "camera": (5, text("Prime #1") + bytes(28)),
        "skeleton": (2, text("man") + struct.pack("<ii", 2, 1) + described_body("hip", 1, version, 0)),
        "latin-1 asset": (0, text(LATIN) + struct.pack("<i", 1) + text("größe")),
    }[kind]


def model(version: Version, *extras: tuple[int, bytes]) -> bytes:
    items = [*extras, (1, described_body("wand", 1, version)), (1, described_body("dart", 7, version))]
    data = struct.pack("<i", len(items))
    for kind, item in items:
        data += struct.pack("<i", kind)
        data += (struct.pack("<i", len(item)) if version >= (4, 1) else b"") + item
    return data


def frame(version: Version) -> bytes:
    def counted(*items: bytes) -> bytes:
        data = b"".join(items)
        size = struct.pack("<i", len(data)) if version >= (4, 1) else b""
        return struct.pack("<i", len(items)) + size + data

    def body(number: int, *pose: float) -> bytes:
        data = struct.pack("<i7f", number, *pose)
        data += struct.pack("<I", 2) + bytes(40) if version < (3, 0) else b""
        return data + struct.pack("<fh", 1e-4, 1)

    w, x, y, z = ATTITUDE
    channels = struct.pack("<iiif", 1, 1, 1, 5.0)
    data = struct.pack("<i", 41) + counted(text(LATIN) + struct.pack("<i", 1) + bytes(12))
    data += counted(bytes(12), bytes(12))
    data += counted(body(1, 9, 9, 9, 0, 0, 0, 1), body(7, *POSITION, x, y, z, w))
    data += counted(struct.pack("<ii", 2, 1) + body(7, 8, 8, 8, 0, 0, 0, 1))
    data += counted(b"trained markersets of any layout") if version >= (4, 1) else b""
    data += counted(bytes(22 if version < (3, 0) else 26))
    data += counted(channels) if version >= (2, 9) else b""
    data += counted(channels) if version >= (2, 11) else b""
    data += struct.pack("<iid", 0, 0, 2.5)
    data += struct.pack("<3Q", 25_000_000, 0, 0) if version >= (3, 0) else b""
    return data + struct.pack("<hi", 0, 0)


def read_natnet(version: Version) -> Callable[[bytes], RawPose | str]:
    def read(data: bytes) -> RawPose | str:
        found = decode_frame(data, ServerInfo(version, TICKS_PER_S), 7)
        if found.body is None:
            return "no such body"
        position, q, tracked = found.body
        return RawPose(BODY, tracked, position, q, found.number, found.stamp_us, "a:1")

    return read


@pytest.mark.parametrize(("version", "kind"), list(product(VERSIONS, EXTRAS)))
def test_other_assets_do_not_cost_the_natnet_body_its_name(version: Version, kind: str) -> None:
    if version < (3, 0) and kind in ("force plate", "device"):
        return  # older descriptions have none
    assert decode_bodies(model(version, extra(kind, version)), version) == ({"wand": 1, "dart": 7}, "")


@pytest.mark.parametrize("payload", [b"", b"\xff" * 40, struct.pack("<i", 1) + bytes(1000)])
def test_an_asset_of_an_unknown_layout_is_skipped_by_its_size(payload: bytes) -> None:
    for kind in (3, 6, 77):
        assert decode_bodies(model((4, 1), (kind, payload)), (4, 1)) == ({"wand": 1, "dart": 7}, "")


def test_an_old_stream_names_the_description_that_hides_the_bodies_behind_it() -> None:
    bodies, unread = decode_bodies(model((3, 1), (77, b"")), (3, 1))
    assert bodies == {}
    assert unread == "description 1, of type 77, cannot be read: stop streaming it"


def test_a_latin_1_body_is_found_by_its_name() -> None:
    data = struct.pack("<iii", 1, 1, 0) + described_body(LATIN, 3, (4, 1))
    data = data[:8] + struct.pack("<i", len(data) - 12) + data[12:]
    assert decode_bodies(data, (4, 1)) == ({LATIN: 3}, "")


def test_a_body_that_the_frame_lacks_and_a_stamp_that_is_no_number_are_none() -> None:
    data = frame((2, 7)).replace(struct.pack("<d", 2.5), struct.pack("<d", float("nan")))
    found = decode_frame(data, ServerInfo((2, 7)), 3)
    assert (found.body, found.stamp_us) == (None, None)


def test_the_transmission_of_a_server_is_decoded() -> None:
    sender = b"Motive".ljust(256, b"\0") + bytes((2, 2, 0, 0, 3, 1, 0, 0))
    transmission = struct.pack("<QHB4B", 3_000_000, 1600, 1, 239, 1, 2, 3)
    data = struct.pack("<HH", 1, 279) + sender + transmission
    assert decode_server_info(data) == ServerInfo((3, 1), 3_000_000, 1600, True, "239.1.2.3")
    assert decode_server_info(data[:270]) == ServerInfo((3, 1))
    assert decode_server_info(b"\7\0" + data[2:]) is None
    assert decode_server_info(data[:100]) is None


# --- Vicon -----------------------------------------------------------------------------------------------


def vicon_block(*objects: tuple[str, tuple[float, ...]], count: int | None = None) -> bytes:
    data = struct.pack("<IB", 41, len(objects) if count is None else count)
    for name, values in objects:
        data += struct.pack("<BH24s6d", 0, 72, name.encode(), *values)
    return data


MM = tuple(1e3 * x for x in POSITION)
VICON_POSE = (*MM, 0.0, 0.0, 2.0 * math.acos(0.8))
VICON_PACKET = vicon_block(("wand", (1, 2, 3, 0, 0, 0)), (BODY, VICON_POSE))


def read_vicon(data: bytes) -> RawPose | str:
    return vicon.decode(data, BODY, "a:1")


def test_an_item_of_another_kind_in_a_vicon_block_is_skipped() -> None:
    assert len(VICON_PACKET) == 155
    unknown_item = struct.pack("<IBBH3s", 41, 2, 4, 3, b"xyz") + VICON_PACKET[5 + 75 :]
    assert read_vicon(unknown_item) == read_vicon(VICON_PACKET)


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
    assert reason in str(read_vicon(data))
    assert isinstance(read_vicon(data), str)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_angles_of_a_vicon_object_that_are_no_numbers_are_no_attitude(bad: float) -> None:
    found = read_vicon(vicon_block((BODY, (1.0, 2.0, 3.0, 0.0, bad, 0.0))))
    assert isinstance(found, RawPose)
    pose, reason = checked_pose(found)
    assert (pose.tracked, reason) == (False, "the body's quaternion is not of length 1")


VECTORS = st.tuples(*[st.floats(-2.5, 2.5)] * 3)


@given(VECTORS | st.sampled_from([tuple(math.pi * x for x in v) for v in product((0, 1), repeat=3)]))
def test_euler_angles_and_a_matrix_by_columns_convert_back_to_the_attitude(
    vector: tuple[float, float, float],
) -> None:
    q = quaternion_from_rotation_vector(vector)
    assert rotation_angle(quaternion_from_intrinsic_xyz(*euler_xyz(q)), q) < 1e-5
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    columns = [x for axis in axes for x in rotate(q, axis)]
    assert rotation_angle(quaternion_from_matrix(columns), q) < 1e-6


# --- QTM -------------------------------------------------------------------------------------------------


def test_a_matrix_that_is_not_a_rotation_is_refused() -> None:
    with pytest.raises(ValueError, match="not a rotation"):
        quaternion_from_matrix([math.nan] * 9)


def test_disabled_qtm_bodies_are_recognised() -> None:
    xml = (
        "<QTM_Parameters_Ver_1.25><The_6D><Body><Name>a</Name><Enabled>false</Enabled></Body>"
        "<Body><Name>b</Name><Enabled>true</Enabled></Body></The_6D></QTM_Parameters_Ver_1.25>"
    )
    assert body_names(xml) == (["a", "b"], ["b"])
    with pytest.raises(ValueError, match="not XML"):
        body_names("Parse error")


# --- VRPN, byte by byte ----------------------------------------------------------------------------------

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
VRPN_PACKET = VRPN_COOKIE + VRPN_NAMES + VRPN_POSE


def vrpn_poses(data: bytes) -> list[RawPose]:
    return list(vrpn.read_poses(io.BytesIO(data), BODY, "a:1", {}))


def read_vrpn(data: bytes) -> RawPose | str:
    return next(iter(vrpn_poses(data)), "no pose")


def test_only_poses_of_the_named_vrpn_sensor_are_read() -> None:
    other_sensor = VRPN_POSE[:27] + b"\1" + VRPN_POSE[28:]
    other_sender = VRPN_POSE[:15] + b"\3" + VRPN_POSE[16:]
    other_type = VRPN_POSE[:19] + b"\4" + VRPN_POSE[20:]
    port = bytes.fromhex("0000001d 00000000 00000000 0000c350 fffffffd 00000000") + b"host\0\0\0\0"
    data = VRPN_COOKIE + port + VRPN_NAMES + other_sensor + other_sender + other_type + VRPN_POSE
    (pose,) = vrpn_poses(data + VRPN_POSE[:50])  # the connection is lost in the last message
    assert (pose.frame_number, pose.source_us) == (41, 3_000_007)
    assert vrpn_poses(VRPN_COOKIE + VRPN_POSE + VRPN_NAMES[:40] + VRPN_POSE) == []  # names still unknown
    padded = b"\0\0\0\x28" + VRPN_NAMES[4:40] + b"\0\0\0\x38" + VRPN_NAMES[44:]
    assert vrpn_poses(VRPN_COOKIE + padded + VRPN_POSE) == [pose]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"SSH-2.0-OpenSSH_9.2", "the answer does not come from a VRPN 7 server"),
        (VRPN_COOKIE + VRPN_NAMES + b"\0\0\0\x17" + VRPN_POSE[4:], "message of 23 bytes"),
        (VRPN_COOKIE + VRPN_NAMES + b"\xff\xff\xff\xff" + VRPN_POSE[4:], "message of 4294967295 bytes"),
        (VRPN_COOKIE + VRPN_NAMES + b"\0\0\0\x50" + VRPN_POSE[4:-8], "pose of 56 bytes"),
    ],
)
def test_nonsense_of_a_vrpn_server_is_an_error(data: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        vrpn_poses(data)


# --- JSON ------------------------------------------------------------------------------------------------

JSON_POSE = {"position_m": POSITION, "quaternion_wxyz": ATTITUDE, "frame": 41, "time_s": 2.5}


def read_json(data: bytes) -> RawPose | str:
    return json_udp.decode(data, BODY, "a:1")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"position_m": [1, 2]}, "not a pose in JSON"),
        ({"position_m": None}, "missing"),
        ({"frame": -1}, "not a pose in JSON"),
        ({"frame": 2**64}, "not a pose in JSON"),
        ({"time_s": 1e300}, "time_s"),
        ({"body": "other"}, "another body"),
    ],
)
def test_a_wrong_json_pose_is_ignored_with_its_reason(change: dict[str, object], reason: str) -> None:
    found = read_json(json.dumps(JSON_POSE | change).encode())
    assert isinstance(found, str)
    assert reason in found


@pytest.mark.parametrize("data", [b"[" * 100_000, b'{"body": "\xff"}'])
def test_json_that_no_parser_accepts_is_ignored(data: bytes) -> None:
    assert isinstance(read_json(data), str)


# --- every protocol --------------------------------------------------------------------------------------


class Packet(NamedTuple):
    """A packet with the pose above, its reader, and the stamp of the pose, microseconds."""

    data: bytes
    read: Callable[[bytes], RawPose | str]
    source_us: int | None


PACKETS = {
    **{f"NatNet {v[0]}.{v[1]}": Packet(frame(v), read_natnet(v), 2_500_000) for v in VERSIONS},
    "Vicon": Packet(VICON_PACKET, read_vicon, None),
    "VRPN": Packet(VRPN_PACKET, read_vrpn, 3_000_007),
    "JSON": Packet(json.dumps(JSON_POSE).encode(), read_json, 2_500_000),
}


def pose_in(packet: Packet, data: bytes) -> RawPose | None:
    """Return the pose in data, or None if the data are ignored, which needs a reason."""
    try:
        found = packet.read(data)
    except ValueError as error:
        found = str(error)
    if isinstance(found, RawPose):
        return found
    assert found
    assert "\n" not in found
    return None


@pytest.mark.parametrize("packet", PACKETS.values(), ids=list(PACKETS))
def test_a_handwritten_pose_is_read(packet: Packet) -> None:
    pose = pose_in(packet, packet.data)
    assert pose is not None
    assert (pose.body, pose.tracked) == (BODY, True)
    assert (pose.frame_number, pose.source_us) == (41, packet.source_us)
    assert pose.position_room == pytest.approx(POSITION)
    assert pose.q_body_to_room == pytest.approx(ATTITUDE)


@pytest.mark.parametrize("packet", PACKETS.values(), ids=list(PACKETS))
def test_a_truncated_packet_has_no_other_pose(packet: Packet) -> None:
    whole = pose_in(packet, packet.data)
    found = [pose_in(packet, packet.data[:length]) for length in range(len(packet.data))]
    assert None in found
    assert all(pose in (None, whole) for pose in found)


@given(st.sampled_from([*PACKETS]), st.binary(max_size=400), st.integers(0, 400))
def test_nonsense_is_ignored_or_a_pose_within_all_limits(name: str, data: bytes, place: int) -> None:
    packet = PACKETS[name]
    damaged = packet.data[:place] + data[:4] + packet.data[place + 4 :]
    for nonsense in (data, damaged, packet.data[:place] + data):
        found = pose_in(packet, nonsense)
        if found is None:
            continue
        pose, reason = checked_pose(found)
        assert pose.body == BODY
        assert pose.tracked is (found.tracked and reason is None)
        if pose.tracked:
            assert all(abs(coordinate) <= 1000.0 for coordinate in pose.position_room)
            assert math.hypot(*pose.q_body_to_room) == pytest.approx(1.0)
        assert pose.source_us is None or abs(pose.source_us) <= 2**62


@given(st.sampled_from(VERSIONS), st.binary(max_size=400), st.integers(0, 400))
def test_a_truncated_natnet_model_has_no_other_body_and_nonsense_no_crash(
    version: Version, data: bytes, place: int
) -> None:
    whole = model(version)
    with contextlib.suppress(ValueError):
        bodies, _ = decode_bodies(whole[:place], version)
        assert bodies.items() <= {"wand": 1, "dart": 7}.items()
    for nonsense in (data, whole[:place] + data[:4] + whole[place + 4 :]):
        with contextlib.suppress(ValueError):
            decode_bodies(nonsense, version)
