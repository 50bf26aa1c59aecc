"""Command line: one module per command, imported only when that command runs.

The commands for analysis and planning are in `lab/commands/` and are loaded through `lab_entries`. A command
module has two functions: `configure(parser)` adds the arguments, and `run(arguments)` returns the exit
status. The module calls other packages and prints; it has no logic of its own. If a command raises
`InputError`, `main` prints the error as one line and returns exit status 2.
"""

from __future__ import annotations

import argparse
import logging
import os
import re
import sys
import traceback
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NoReturn

from dart_flight import __version__
from dart_flight.base.errors import FlightError
from dart_flight.base.processes import exit_within, use_idle_priority
from dart_flight.cli.terminal import OutputError, open_closed_streams, print_status, write_output
from dart_flight.config.document import InputError, did_you_mean, suggest_known, write_problem
from dart_flight.lab_entries import COMMANDS as LAB_COMMANDS
from dart_flight.lab_entries import load_entry

# command -> help text, in the order of `dart-flight --help`
COMMANDS = {
    "fly": "fly a mission on the vehicle",
    "dry-run": "fly a mission in simulation",
    "campaign": "fly thousands of simulated missions and collect the results; can be resumed",
    "simulate": "run a simulated vehicle; `fly` in another terminal or a ground station connects to it",
    "check": "check a mission before a flight and, with --connection, the vehicle",
    "parameters": "list PX4's parameters that differ from the desired values, write or restore them",
    "bringup": "bring up a vehicle on the bench step by step, and record the measurements",
    "mocap": "forward motion-capture poses to PX4, and show their rate, gaps and age",
    "survey": "touch a mission's walls gently, and write the mission with the measured walls",
    "standby": "stay connected to vehicle and lock, and fly when a ground station's button is pressed",
    "lock": "move the lock, report its position, or calibrate its servo",
    "plan": "choose walls, velocities and modes for a scenario, and write the mission",
    "px4-log": "download PX4's own log of a flight into the flight's folder",
    "replay": "replay a recorded flight through the flight core and compare decisions",
    "report": "write an HTML report of recorded flights",
    "export": "export flight logs as CSV, or for 3D playback in Foxglove, Lichtblick and Rerun",
    "studio": "open a page in the browser: see a room, move walls, plan, fly and play flights",
    "predict": "predict a collision or a drop",
    "monitor": "show force, detection, streams, lock and phase live, without flying",
    "calibrate": "calibrate thrust curve or inertia from flight logs",
    "inspect": "find impacts and forces in PX4 logs of any multirotor",
    "identify": "identify contact coefficients from recorded trials",
    "room": "measure the walls of a room with the vehicle held by hand",
    "series": "fly a trial series on one wall, from the first hit to dated coefficients",
    "tables": "compare the paper's tables with the model",
    "doctor": "show what this installation can do: packages, PX4, ports, permissions, disk, clock",
    "init": "copy the packaged configuration, missions and scenarios to start from",
    "completion": "print a completion script for bash, zsh or tcsh",
}

# renamed commands: the old name works for one more release, with a note
RENAMED = {"feel": "inspect"}

EXIT_OK, EXIT_INCOMPLETE, EXIT_INPUT = 0, 1, 2
_OWN_OPTIONS = ("-h", "--help", "--version")
_EXIT_S = 4.0  # time for a normal exit, before a forced exit
EXIT_INTERRUPTED = 130  # a shell's status for SIGINT


_WRONG_VALUE = re.compile(r"argument (?P<name>.+?): invalid (choice|\w+ value): (?P<value>'[^']*')")


class _Parser(argparse.ArgumentParser):
    """Parser that reports a usage error in one line and suggests the most similar valid word."""

    def error(self, message: str) -> None:  # type: ignore[override]
        self.exit(EXIT_INPUT, f"{self.prog}: {self._suggest_choice(message)} (see `{self.prog} --help`)\n")

    def _print_message(self, message: str, file: Any = None) -> None:
        if message and file is sys.stdout:
            write_output(message)
        elif message:
            print_status(message.rstrip("\n"))

    def parse_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]
        parsed, unknown = self.parse_known_args(args, namespace)
        if unknown:
            command = self._command(parsed)
            option = next((word.partition("=")[0] for word in unknown if word.startswith("-")), None)
            if option is None:
                command.error(f"unexpected argument {unknown[0]!r}")
            else:
                known = [name for action in command._actions for name in action.option_strings]
                command.error(f"unknown option {option}{did_you_mean(option, known)}")
        return parsed

    def _command(self, parsed: argparse.Namespace) -> _Parser:
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                found = action.choices.get(getattr(parsed, action.dest))
                return found if isinstance(found, _Parser) else self
        return self

    def _suggest_choice(self, message: str) -> str:
        """If the message is about a wrong value, add the most similar allowed value."""
        wrong = _WRONG_VALUE.match(message)
        if wrong is None:
            return message
        action = next((a for a in self._actions if a.choices and wrong["name"] in _names(a)), None)
        if action is None or action.choices is None:
            return message
        known = [str(choice) for choice in action.choices]
        near = suggest_known(wrong["value"].strip("'"), known)
        what = "command" if action.dest == "command" else wrong["name"]
        return f"unknown {what} {wrong['value']}{near}"


def _names(action: argparse.Action) -> list[str]:
    """Return the names by which argparse's messages may call an argument."""
    return ["/".join(action.option_strings), str(action.metavar), action.dest]


def build_parser(wanted: Collection[str]) -> argparse.ArgumentParser:
    """Return the parser with the arguments of the requested commands; import no other command."""
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
    parser.add_argument("--config", metavar="FILE", help="vehicle configuration (default: one in configs/)")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="more messages on standard error")


def _module(command: str) -> Any:
    here = f"dart_flight.cli.{command.replace('-', '_')}_command"
    return load_entry(LAB_COMMANDS.get(command, here))


def _renamed(arguments: list[str]) -> list[str]:
    if arguments and arguments[0] in RENAMED:
        new = RENAMED[arguments[0]]
        print_status(f"dart-flight: `{arguments[0]}` is now `{new}`")
        return [new, *arguments[1:]]
    return arguments


def main(argv: Sequence[str] | None = None) -> int:
    """Run `dart-flight` and return the exit status: 0 success, 1 not completed, 2 wrong input."""
    arguments = _renamed(list(sys.argv[1:] if argv is None else argv))
    command = next((a for a in arguments if a in COMMANDS), None)
    open_closed_streams()
    if command and arguments[0].startswith("-") and arguments[0] not in _OWN_OPTIONS:
        print_status(f"dart-flight: options come after the command: dart-flight {command} {arguments[0]} ...")
        return EXIT_INPUT
    # Idle priority is permanent, so do not set it if another program or a test calls `main`.
    if argv is None and command == "monitor" and not any(a.startswith("--connection") for a in arguments):
        use_idle_priority()
    try:
        if command:
            _need_working_folder()
        parser = build_parser([command] if command else [])
        if not arguments:
            parser.print_help()
            return EXIT_OK
        parsed = parser.parse_args(arguments)
        logging.basicConfig(
            stream=sys.stderr,
            level=logging.DEBUG if parsed.verbose > 1 else logging.ERROR,
            format="%(name)s: %(message)s",
        )
        return int(_module(parsed.command).run(parsed))
    except InputError as error:
        print_status(error.one_line(), *error.hints)
        return EXIT_INPUT
    except OutputError as error:
        if not error.closed:
            print_status(error)
        return EXIT_INCOMPLETE
    except FlightError as error:
        print_status(error)
        return EXIT_INCOMPLETE
    except KeyboardInterrupt:
        print_status("interrupted")
        return EXIT_INTERRUPTED
    except OSError as error:  # an unexpected error: print its text and its origin
        if "-vv" in arguments:
            raise
        print_status(_system_error(error))
        return EXIT_INCOMPLETE


def run() -> NoReturn:
    """Run `dart-flight` and end the process soon after the command has finished."""
    exit_within(main(), _EXIT_S)


def _need_working_folder() -> None:
    """Raise InputError if the working folder was removed, because relative paths then fail."""
    try:
        os.getcwd()
    except OSError as error:
        raise InputError(f"cannot use the working folder: {error.strerror}; cd to another folder") from None


def _system_error(error: OSError) -> str:
    """Return a system error in one line, with the source file and line that raised it."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    names = [os.fsdecode(n) for n in (error.filename, error.filename2) if isinstance(n, str | bytes)]
    why = write_problem(names[0], error) if names else error.strerror or str(error)
    what = ": ".join([*names, why])
    return f"{what} ({Path(place.filename).name}:{place.lineno}; -vv shows the whole trace)"
