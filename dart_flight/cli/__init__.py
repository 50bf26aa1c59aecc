"""The command line: one module per command, imported only when that command runs.

A command module has `configure(parser)` and `run(arguments) -> int`. It parses, calls into the rooms and
prints; it holds no logic. `InputError` becomes one line and exit status 2 here, for all of them.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import sys
from collections.abc import Collection, Sequence
from typing import Any

from dart_flight import __version__
from dart_flight.config.document import InputError
from dart_flight.errors import FlightError

# command -> what it does, in the order of `dart-flight --help`
COMMANDS = {
    "fly": "fly a mission on the vehicle",
    "dry-run": "fly a mission in simulation",
    "simulate": "a simulated vehicle alone, for `fly` in another terminal or a ground station",
    "check": "go or no-go: a mission, and the vehicle where one answers",
    "lock": "move or report the locking mechanism",
    "plan": "choose walls, velocities and modes for a scenario, and write the mission",
    "replay": "a recorded flight again through the same decisions",
    "report": "recorded flights as a page with plots",
    "export": "a flight log as CSV files",
    "predict": "predict a collision or a drop",
    "monitor": "live view of force, detection, streams, lock and phase, without flying",
    "calibrate": "thrust curve from hover segments of flights",
    "feel": "what PX4 logs of any multirotor felt: force, impacts, what is unknown",
    "identify": "contact coefficients from recorded trials",
    "tables": "the paper's collision tables beside the model's",
    "init": "copy the packaged configuration, missions and scenarios to start from",
    "completion": "what completes commands in bash, zsh or tcsh",
}

EXIT_OK, EXIT_INCOMPLETE, EXIT_INPUT = 0, 1, 2


class _Parser(argparse.ArgumentParser):
    """Errors of usage in one line, like every other wrong input."""

    def error(self, message: str) -> None:  # type: ignore[override]
        self.exit(EXIT_INPUT, f"{self.prog}: {message} (see `{self.prog} --help`)\n")


def build_parser(wanted: Collection[str]) -> argparse.ArgumentParser:
    """The parser; only the modules of the wanted commands are imported for their arguments."""
    parser = _Parser(prog="dart-flight", description="Fly a dual-stiffness quadrotor into walls on purpose.")
    parser.add_argument("--version", action="version", version=f"dart-flight {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, help_text in COMMANDS.items():
        sub = commands.add_parser(name, help=help_text, description=f"{help_text[0].upper()}{help_text[1:]}.")
        if name in wanted:
            _module(name).configure(sub)
            _common(sub)
    return parser


def _common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="one machine-readable object on standard output")
    parser.add_argument("--config", metavar="FILE", help="vehicle configuration (default: configs/dart.yaml)")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="say more on standard error")


def _module(command: str) -> Any:
    return importlib.import_module(f"dart_flight.cli.{command.replace('-', '_')}_command")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `dart-flight`. Returns the exit status: 0 success, 1 not completed, 2 wrong input."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = next((a for a in arguments if a in COMMANDS), None)
    try:
        parsed = build_parser([command] if command else []).parse_args(arguments)
        logging.basicConfig(
            stream=sys.stderr,
            level=logging.DEBUG if parsed.verbose > 1 else logging.ERROR,
            format="%(name)s: %(message)s",
        )
        return int(_module(parsed.command).run(parsed))
    except InputError as error:
        print(error.one_line(), file=sys.stderr)  # noqa: T201
        return EXIT_INPUT
    except FlightError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return EXIT_INCOMPLETE
    except KeyboardInterrupt:
        return EXIT_INCOMPLETE
    except BrokenPipeError:
        # The reader of our output went away (`| head`): nothing is left to say.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_INCOMPLETE
