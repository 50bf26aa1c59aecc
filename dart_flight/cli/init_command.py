"""`dart-flight init DIR`: the packaged configuration, missions and scenarios as files to start from."""

from __future__ import annotations

import argparse
from pathlib import Path

from dart_flight.cli.terminal import emit_json, messages
from dart_flight.config.starter import write_starter


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("directory", type=Path, metavar="DIR", help="where the files go; made if need be")


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit status."""
    written = write_starter(arguments.directory)
    if arguments.json:
        emit_json({"directory": str(arguments.directory), "files": [str(path) for path in written]})
    else:
        console = messages()
        console.print(f"{len(written)} files in {arguments.directory}; try:", markup=False, soft_wrap=True)
        console.print(f"  cd {arguments.directory}", markup=False, soft_wrap=True)
        console.print(
            "  dart-flight dry-run missions/dual_collision.yaml --fast", markup=False, soft_wrap=True
        )
    return 0
