"""URLs of pose sources, missing clients, and the network interface of multicast."""

import json
import queue
import socket
import subprocess
import sys

import pytest

from dart_flight.config.document import InputError
from dart_flight.vehicle.motion_capture.datagram_source import DatagramSource
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
        (
            "udp://239.255.1.2:9763/dart?interface=eht0",
            'no network interface "eht0" .*, only .*"lo 127.0.0.1"',
        ),
        ("udp://239.255.1.2:9763/dart?interface=192.0.2.1", 'no network interface "192.0.2.1"'),
        ("udp://0.0.0.0:9763/dart?interface=lo", "not a multicast group"),
    ],
)
def test_a_wrong_url_is_refused_in_one_line(url: str, fragment: str) -> None:
    with pytest.raises(InputError, match=fragment) as caught:
        open_source(url)
    assert "\n" not in str(caught.value)


def test_a_missing_client_is_reported_with_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "dart_flight.vehicle.motion_capture.qualisys", raising=False)
    monkeypatch.setitem(sys.modules, "qtm_rt", None)
    with pytest.raises(InputError, match=r"needs qtm_rt: .*install"):
        open_source("qualisys://127.0.0.1/dart")


def test_a_flight_without_motion_capture_loads_no_client() -> None:
    code = (
        "import sys, dart_flight.run.app, dart_flight.check.checks, dart_flight.cli.mocap_command;"
        "print([name for name in ('natnet', 'qtm_rt') if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


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
        assert f"listening on 239.255.1.2:{source.port} on " in source.place
    finally:
        source.stop()
