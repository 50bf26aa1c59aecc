"""NatNet packets of every version: other assets, names that are not UTF-8, and damaged data."""

import contextlib
import struct
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.vehicle.motion_capture.natnet_packets import (
    ServerInfo,
    Version,
    decode_bodies,
    decode_frame,
    decode_server_info,
)

VERSIONS: tuple[Version, ...] = ((2, 7), (2, 11), (3, 1), (4, 0), (4, 1), (4, 2))
EXTRAS = ("none", "force plate", "device", "camera", "skeleton", "latin-1 asset")
LATIN = "Körper"


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


def frame(version: Version, assets: bool = True) -> bytes:
    def counted(*items: bytes) -> bytes:
        data = b"".join(items)
        size = struct.pack("<i", len(data)) if version >= (4, 1) else b""
        return struct.pack("<i", len(items)) + size + data

    def body(number: int, *pose: float) -> bytes:
        data = struct.pack("<i7f", number, *pose)
        data += struct.pack("<I", 2) + bytes(40) if version < (3, 0) else b""
        return data + struct.pack("<fh", 1e-4, 1)

    channels = struct.pack("<iiif", 1, 1, 1, 5.0)
    data = struct.pack("<i", 41) + counted(text(LATIN) + struct.pack("<i", 1) + bytes(12))
    data += counted(bytes(12), bytes(12))
    data += counted(body(1, 9, 9, 9, 0, 0, 0, 1), body(7, 1, 2, 0.5, 0, 0, 0.6, 0.8))
    data += counted(struct.pack("<ii", 2, 1) + body(7, 8, 8, 8, 0, 0, 0, 1)) if assets else counted()
    data += counted(b"trained markersets of any layout") if version >= (4, 1) else b""
    data += counted(bytes(22 if version < (3, 0) else 26))
    data += counted(channels) if version >= (2, 9) else b""
    data += counted(channels) if version >= (2, 11) else b""
    data += struct.pack("<iid", 0, 0, 2.5)
    data += struct.pack("<3Q", 25_000_000, 0, 0) if version >= (3, 0) else b""
    return data + struct.pack("<hi", 0, 0)


@pytest.mark.parametrize(("version", "kind"), list(product(VERSIONS, EXTRAS)))
def test_other_assets_do_not_cost_the_body_its_name_and_its_poses(version: Version, kind: str) -> None:
    if version >= (3, 0) or kind not in ("force plate", "device"):  # older descriptions have none
        assert decode_bodies(model(version, extra(kind, version)), version) == ({"wand": 1, "dart": 7}, "")
    found = decode_frame(frame(version), ServerInfo(version, 10_000_000), 7)
    assert (found.number, found.stamp_us) == (41, 2_500_000)
    assert found.body is not None
    assert found.body.position_room == (1.0, 2.0, 0.5)
    assert found.body.q_body_to_room == pytest.approx((0.8, 0.0, 0.0, 0.6))
    assert found.body.tracked


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


@given(st.binary(max_size=400), st.integers(0, 400), st.sampled_from(VERSIONS))
def test_any_packet_is_decoded_or_a_value_error(data: bytes, place: int, version: Version) -> None:
    whole = frame(version)
    for packet in (data, whole[:place] + data[:4] + whole[place + 4 :], whole[:place]):
        with contextlib.suppress(ValueError):
            decode_frame(packet, ServerInfo(version, 10_000_000), 7)
        with contextlib.suppress(ValueError):
            decode_bodies(packet, version)


def test_the_transmission_of_a_server_is_decoded() -> None:
    sender = b"Motive".ljust(256, b"\0") + bytes((2, 2, 0, 0, 3, 1, 0, 0))
    transmission = struct.pack("<QHB4B", 3_000_000, 1600, 1, 239, 1, 2, 3)
    data = struct.pack("<HH", 1, 279) + sender + transmission
    assert decode_server_info(data) == ServerInfo((3, 1), 3_000_000, 1600, True, "239.1.2.3")
    assert decode_server_info(data[:270]) == ServerInfo((3, 1))
    assert decode_server_info(b"\7\0" + data[2:]) is None
    assert decode_server_info(data[:100]) is None
