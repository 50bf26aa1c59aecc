"""The web server of the studio: viser, with the Host and Origin of every request checked.

viser accepts a WebSocket from any page, so that a page of another site could send commands to a studio on the
same computer. It also opens a tunnel to a server in the internet if a page asks for one. Neither is possible
here.
"""

from __future__ import annotations

import contextlib
import http
import io
import socket
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from dart_flight.config.document import InputError
from dart_flight.config.packages import missing_package

try:
    import viser
    import websockets.asyncio.server as websocket_server
    from viser import _messages as messages
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response
except ImportError as _error:
    raise missing_package(f"the studio needs {_error.name}", "studio") from None

LOCAL = "127.0.0.1"
_LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")
Pages = Callable[[str], str | None]  # path of a request, such as /report/3 -> an HTML page, or None


def open_server(host: str, port: int, label: str, pages: Pages = lambda path: None) -> viser.ViserServer:
    """Start the server; if the port is in use, the next free port is taken.

    Args:
        host: address to bind to; `LOCAL` for this computer only.
        pages: further pages of this server, by path.

    Raises:
        InputError: the address is not one of this computer.
    """
    _refuse_foreign_address(host)
    with _guarded(host, pages) as used, contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host, port, label, verbose=False)
    if not used:  # another version of viser, which listens in another way
        stop_server(server)
        raise InputError(f"viser {viser.__version__} cannot be guarded; install viser 1.1")
    for request in (messages.ShareUrlRequest, messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(request)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def stop_server(server: viser.ViserServer) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _refuse_foreign_address(host: str) -> None:
    # viser would wait for ever for an address that it cannot bind.
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except OSError as error:
        raise InputError(f"cannot listen on {host}: {error.strerror or error}", key=("--host",)) from None


@contextlib.contextmanager
def _guarded(host: str, pages: Pages) -> Iterator[list[bool]]:
    """Let servers that start meanwhile check each request; the yielded list is empty if none has started.

    viser has no option for that.
    """
    serve, used = websocket_server.serve, list[bool]()

    def guarded(*args: Any, process_request: Any, **options: Any) -> Any:
        used.append(True)

        def process(connection: Any, request: Request) -> Response | None:
            own_host, own_port = connection.local_address[:2]
            reason = refusal(request, {*_LOCAL_NAMES, host, own_host}, own_port)
            if reason is not None:
                return _response(http.HTTPStatus.FORBIDDEN, f"{reason}\n", "text/plain")
            page = pages(request.path.partition("?")[0])
            if page is not None:
                return _response(http.HTTPStatus.OK, page, "text/html")
            answer: Response | None = process_request(connection, request)
            return answer

        return serve(*args, process_request=process, **options)

    websocket_server.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield used
    finally:
        websocket_server.serve = serve  # type: ignore[misc]


def refusal(request: Request, names: set[str], port: int) -> str | None:
    """Return why a request is refused, or None.

    The Host must be this server, so that no other name leads here (DNS rebinding), and so must the Origin,
    which a browser adds to each WebSocket.
    """
    allowed = {f"{name}:{port}" for name in names} | (names if port == 80 else set())
    hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    if len(hosts) != 1 or hosts[0].lower() not in allowed:
        return "this name is not a name of this server"
    if any(origin.lower() not in {f"http://{name}" for name in allowed} for origin in origins):
        return "a page of another origin may not use this server"
    return None


def _response(status: http.HTTPStatus, text: str, kind: str) -> Response:
    body = text.encode("utf-8")
    headers = Headers(
        {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(body)),
            "Connection": "close",
        }
    )
    return Response(int(status), status.phrase, headers, body)


warnings.filterwarnings("ignore", category=DeprecationWarning, module="viser")
