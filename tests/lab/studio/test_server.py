"""The studio's server: who may use it, and what its process loads. No browser is needed."""

import asyncio
import contextlib
import http.client
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="the page of the studio needs viser (extra studio)")
websockets = pytest.importorskip("websockets")

import viser  # noqa: E402

from dart_flight.base.signals import REPEAT_S  # noqa: E402
from dart_flight.cli import main  # noqa: E402
from dart_flight.config.document import InputError  # noqa: E402
from dart_flight.config.mission import load_mission  # noqa: E402
from dart_flight.lab.studio import edits  # noqa: E402
from dart_flight.lab.studio.page_server import LOCAL, open_server, stop_server  # noqa: E402
from dart_flight.lab.studio.scene_page import mission_scene  # noqa: E402
from dart_flight.lab.studio.studio import Studio  # noqa: E402
from dart_flight.lab.studio.studio_page import distinct  # noqa: E402
from dart_flight.run.fast import fly_fast  # noqa: E402
from tests.lab.studio.files import DUAL  # noqa: E402

PAGES = {"/report/1": "<b>a report</b>"}


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    server = open_server(LOCAL, 0, "test", PAGES.get)
    yield server.get_port()
    stop_server(server)


def get(port: int, path: str = "/", **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(LOCAL, port, timeout=10.0)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read()


def connects(port: int, origin: str) -> bool:
    protocol, address = f"viser-v{viser.__version__}", f"ws://{LOCAL}:{port}"

    async def connect() -> None:
        async with websockets.connect(address, origin=origin, subprotocols=[protocol]):
            pass

    try:
        asyncio.run(connect())
    except websockets.exceptions.InvalidStatus as error:
        return bool(error.response.status_code != 403)
    return True


def test_the_page_and_the_reports_are_served(port: int) -> None:
    status, page = get(port)
    assert status == 200
    assert b"<html" in page[:2000].lower()
    assert get(port, "/report/1") == (200, b"<b>a report</b>")
    assert get(port, "/report/2")[0] == 404


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_its_own_pages_may_connect(port: int, host: str) -> None:
    assert connects(port, f"http://{host}:{port}")
    assert get(port, Host=f"{host}:{port}")[0] == 200


@pytest.mark.parametrize(
    "origin", ["http://example.org", "null", "https://127.0.0.1", "http://127.0.0.1:1", "http://127.0.0.1"]
)
def test_pages_of_another_origin_may_not(port: int, origin: str) -> None:
    assert not connects(port, origin)
    assert get(port, Origin=origin)[0] == 403


def test_another_name_that_leads_here_may_not(port: int) -> None:
    assert get(port, Host=f"example.org:{port}")[0] == 403
    assert get(port, Host="")[0] == 403


def test_an_address_of_another_computer_is_refused_at_once() -> None:
    with pytest.raises(InputError, match=r"cannot listen on 192\.0\.2\.1"):
        open_server("192.0.2.1", 0, "test")


def test_no_page_can_open_a_tunnel_to_the_internet() -> None:
    from viser import _messages

    server = open_server(LOCAL, 0, "test")
    try:
        assert _messages.ShareUrlRequest not in server._websock_server._incoming_handlers
    finally:
        stop_server(server)


FRESH = """
import sys, threading
from dart_flight.cli import build_parser
from dart_flight.lab.commands import studio_command
from dart_flight.lab.studio.studio import Studio
opened = studio_command._open([])
studio = Studio(opened, studio_command.Path("flights"), ("127.0.0.1", 0))
thread = threading.Thread(target=studio.run)
thread.start()
for _ in range(600):
    if studio.checked is not None:
        break
    thread.join(0.1)
studio.stop()
thread.join()
assert studio.checked is not None and studio.checked.go, studio.checked
found = [m for m in sys.modules if m.split(".")[0] == "mavsdk" or m.startswith("dart_flight.vehicle")]
print("loaded:", found)
"""


def test_serving_a_page_loads_nothing_that_reaches_a_vehicle() -> None:
    done = subprocess.run(
        [sys.executable, "-c", FRESH], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "loaded: []" in done.stdout


def test_a_flight_and_a_mission_become_pages_that_need_no_network(tmp_path: Path) -> None:
    verdict = fly_fast(load_mission(DUAL), 1, tmp_path)
    page = tmp_path / "scene.html"
    assert main(["export", str(verdict.log), "--scene", str(page)]) == 0
    assert "__VISER_EMBED_DATA__" in page.read_text()
    assert main(["export", str(verdict.log), "--scene", str(page), "--foxglove"]) == 2
    with mission_scene(load_mission(DUAL)) as serializer:
        assert "__VISER_EMBED_DATA__" in serializer.as_html()


def test_ctrl_c_ends_the_page_as_soon_as_it_is_served(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "dart_flight", "studio", "--port", str(port), "--no-browser"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as page:
        while page.poll() is None:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
                break
        page.send_signal(signal.SIGINT)
        assert page.stderr is not None
        assert "forced exit" not in page.stderr.read()
    assert page.returncode == 0


def test_ctrl_c_asks_before_edits_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    said = list[str]()

    def act(studio: Studio) -> None:
        studio.page.open_file().edit(edits.move("start", (0.1, 0.0)))
        for _ in range(2):
            time.sleep(2.0 * REPEAT_S)
            os.kill(os.getpid(), signal.SIGINT)
            said.append(f"{studio._stopped.is_set()}")
        studio.close()

    monkeypatch.setattr(Studio, "run", act)
    assert main(["studio", str(DUAL), "--port", "0", "--no-browser"]) == 0
    assert said == ["False", "True"]


def test_equal_entries_of_a_menu_are_numbered() -> None:
    """Two equal ones would stop the whole page."""
    assert distinct(["a", "b", "a", "a", "a (2)"]) == ("a", "b", "a (2)", "a (3)", "a (2) (2)")
