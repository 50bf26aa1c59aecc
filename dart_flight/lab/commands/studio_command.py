"""`dart-flight studio [FILE...]`: a page in the browser that shows a room, edits, plans, flies and plays."""

from __future__ import annotations

import argparse
import signal
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from dart_flight.base.signals import StopSignals
from dart_flight.cli.terminal import emit_json, print_status
from dart_flight.config.document import InputError, read_text
from dart_flight.config.edit import update_text
from dart_flight.config.vehicle import packaged

if TYPE_CHECKING:
    from dart_flight.lab.studio.open_file import OpenFile

_FIRST = "dual_collision.yaml"
_LOCAL, _PORT = "127.0.0.1", 8650


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "files",
        nargs="*",
        type=Path,
        metavar="FILE",
        help="a mission or scenario to edit, or flights to play: flight.mcap, or a folder of flights or of a "
        "campaign (default: a copy of the dual collision)",
    )
    parser.add_argument(
        "--port",
        type=_port,
        default=_PORT,
        metavar="N",
        help=f"default: {_PORT}; 0: any free port",
    )
    parser.add_argument(
        "--host",
        default=_LOCAL,
        metavar="ADDRESS",
        help="also serve other computers, at this address of this computer; the page is then read-only for "
        "everybody",
    )
    parser.add_argument("--dark", action="store_true", help="light colours on a dark ground")
    parser.add_argument("--no-browser", action="store_true", help="only print the page's address")
    # Do not use `cli.options`: it loads the clients of motion capture.
    parser.add_argument(
        "--log-dir", type=Path, default=Path("flights"), metavar="DIR", help="default: flights"
    )


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 65535, not {text!r}")
    return int(text)


def run(arguments: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    opened = _open(arguments.files)
    from dart_flight.lab.studio.studio import Studio

    read_only = arguments.host != _LOCAL
    started: list[Studio] = []
    asked = threading.Event()

    def end(number: signal.Signals) -> None:
        files = [studio.page.file for studio in started if studio.page.file is not None]
        unsaved = any(file.is_changed and file.can_undo for file in files)
        if unsaved and number is signal.SIGINT and not asked.is_set():
            print_status("the edits are not saved; Ctrl-C again discards them")
            asked.set()
            return
        asked.set()
        for studio in started:
            studio.stop()

    with StopSignals(end):  # before the page starts: an interrupt of the start would leave threads
        address = (arguments.host, int(arguments.port))
        studio = Studio(opened, arguments.log_dir, address, read_only=read_only, dark=arguments.dark)
        started.append(studio)
        if asked.is_set():
            studio.stop()
        url = f"http://{arguments.host}:{studio.server.get_port()}"
        if arguments.json:
            emit_json({"url": url, "read_only": read_only})
        print_status(f"studio: {url}" + (" (read-only)" if read_only else "") + "; Ctrl-C ends it")
        if not arguments.no_browser and not asked.is_set():
            webbrowser.open(url)
        studio.run()
    return 0


def _open(files: list[Path]) -> OpenFile | list[Path]:
    from dart_flight.lab.studio.open_file import OpenFile

    if not files:
        return _first_mission()
    if len(files) == 1 and files[0].suffix in (".yaml", ".yml"):
        return OpenFile.load(files[0])
    for path in files:
        if path.suffix in (".yaml", ".yml"):
            raise InputError("open one mission or scenario, or flights", source=str(path))
    from dart_flight.recording.found import find_logs

    return find_logs(files)


def _first_mission() -> OpenFile:
    """Return a copy of the shipped dual collision for this folder; only *Save* writes the file."""
    from dart_flight.lab.studio.open_file import OpenFile

    shipped = packaged("missions", _FIRST)
    text = read_text(shipped)
    tree = OpenFile(shipped, text).tree
    del tree["vehicle"]  # use the default vehicle: the shipped path is relative to another folder
    names = [Path(_FIRST), *(Path(f"dual_collision_{n}.yaml") for n in range(2, 1000))]
    path = next(name for name in names if not name.exists())
    return OpenFile.new(path, update_text(text, tree, str(shipped)))
