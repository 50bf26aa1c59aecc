"""URLs of pose sources, and JSON datagrams with poses."""

import json
import queue
import socket
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.config.document import InputError
from dart_flight.sim.motion_capture import make_server
from dart_flight.vehicle.motion_capture.datagram_source import DatagramSource
from dart_flight.vehicle.motion_capture.json_udp import decode
from dart_flight.vehicle.motion_capture.source import PoseAddress, RawPose, open_source, parse_url
from tests.doubles.ports import free_udp_port

POSE = {"position_m": [1, 2.5, -3], "quaternion_wxyz": [1, 0, 0, 0], "frame": 7, "time_s": 2.5}


def test_a_url_names_system_host_port_and_body() -> None:
    assert parse_url("optitrack://10.0.0.1/dart") == (
        "optitrack",
        PoseAddress("optitrack://10.0.0.1/dart", "10.0.0.1", 1510, "dart"),
    )
    assert parse_url("vicon://0.0.0.0:51002/my%20drone")[1][2:4] == (51002, "my drone")
    assert parse_url("qualisys://lab/3")[1][1:4] == ("lab", 22223, "3")
    assert parse_url("vrpn://lab/dart") == ("vrpn", PoseAddress("vrpn://lab/dart", "lab", 3883, "dart"))
    for url in ("optitrack://h/a", "vicon://239.1.2.3/a", "udp://239.1.2.3:9/a"):
        assert parse_url(f"{url}?interface=eth0")[1].interface == "eth0"


@pytest.mark.parametrize(
    ("url", "fragment"),
    [
        ("ros://10.0.0.1/dart", "optitrack://SERVER/BODY"),
        ("optitrack://10.0.0.1", "optitrack://SERVER/BODY"),
        ("udp://0.0.0.0/dart", "add a port"),
        ("udp://0.0.0.0:99999/dart", "udp://ADDRESS:PORT/BODY"),
        ("dart", "udp://ADDRESS:PORT/BODY"),
        ("udp://192.0.2.1:9763/dart", "0.0.0.0 for all"),
        ("vrpn://lab/dart?interface=eth0", "the only option is"),
        ("udp://239.255.1.2:9763/dart?card=eth0", "the only option is"),
        ("udp://239.255.1.2:9763/dart?eth0", "bad query field"),
        ("udp://239.255.1.2:9763/dart?interface=eht0", 'no network card "eht0" .*, only .*"lo 127.0.0.1"'),
        ("udp://239.255.1.2:9763/dart?interface=192.0.2.1", 'no network card "192.0.2.1"'),
        ("udp://0.0.0.0:9763/dart?interface=lo", "no multicast group"),
    ],
)
def test_a_wrong_url_is_refused_in_one_line(url: str, fragment: str) -> None:
    with pytest.raises(InputError, match=fragment) as caught:
        open_source(url)
    assert "\n" not in str(caught.value)


def test_a_missing_client_is_reported_with_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError("No module named 'qtm_rt'", name="qtm_rt")

    monkeypatch.setattr("importlib.import_module", missing)
    with pytest.raises(InputError, match=r"needs qtm_rt: .*install"):
        open_source("qualisys://127.0.0.1/dart")


def test_a_flight_without_motion_capture_loads_no_client() -> None:
    code = (
        "import sys, dart_flight.run.app, dart_flight.check.checks, dart_flight.cli.mocap_command;"
        "print([name for name in ('natnet', 'qtm_rt') if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_a_json_pose_is_decoded() -> None:
    found = decode(json.dumps(POSE).encode(), "dart", "a:1")
    assert found == RawPose("dart", True, (1.0, 2.5, -3.0), (1.0, 0.0, 0.0, 0.0), 7, 2_500_000, "a:1")


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
    found = decode(json.dumps(POSE | change).encode(), "dart", "a:1")
    assert isinstance(found, str)
    assert reason in found


@given(
    st.binary(max_size=200)
    | st.recursive(st.none() | st.floats() | st.text(), st.lists).map(repr).map(str.encode)
)
def test_any_datagram_is_decoded_or_ignored(data: bytes) -> None:
    assert isinstance(decode(data, "dart", "a:1"), str | RawPose)
    assert isinstance(decode(b"[" * 100_000, "dart", "a:1"), str)


@pytest.mark.parametrize("option", ["", "?interface=lo", "?interface=127.0.0.1"])
def test_a_multicast_group_is_joined_on_every_card_or_on_the_card_of_the_url(option: str) -> None:
    source = open_source(f"udp://239.255.1.2:{free_udp_port()}/dart{option}")
    assert isinstance(source, DatagramSource)
    poses: queue.Queue[RawPose] = queue.Queue()
    source.start(poses.put)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            sender.sendto(json.dumps(POSE).encode(), ("239.255.1.2", source.port))
        assert poses.get(timeout=30).tracked
        assert f"listening at 239.255.1.2:{source.port} on " in source.place
    finally:
        source.stop()


def test_a_source_reads_poses_of_the_emulated_json_system() -> None:
    server = make_server("udp", "my drone")
    assert server.clients == 0
    source = open_source(server.url)
    poses: queue.Queue[RawPose] = queue.Queue()
    source.start(poses.put)
    try:
        assert server.clients == 1
        server.publish(20_000, (1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0))
        server.publish(40_000, (1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0), tracked=False)
        first, second = poses.get(timeout=10), poses.get(timeout=10)
        assert first[:6] == ("my drone", True, (1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0), 0, 20_000)
        assert (second.tracked, second.frame_number, second.source_us) == (False, 1, 40_000)
        assert source.problem is None
    finally:
        source.stop()
        server.close()
    assert server.clients == 0
