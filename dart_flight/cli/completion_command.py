"""`dart-flight completion SHELL`: print the script that completes commands, options and file names."""

from __future__ import annotations

import argparse
from typing import Any

from dart_flight.cli.terminal import emit_json, write_output

SHELLS = ("bash", "zsh", "tcsh")
_FILES = {"MISSION", "SCENARIO", "LOG", "TRIAL", "FILE"}
_FOLDERS = {"DIR"}


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=SHELLS, help="shell")


def run(arguments: argparse.Namespace) -> int:
    script = completion_script(arguments.shell)
    if arguments.json:
        emit_json({"shell": arguments.shell, "script": script})
    else:
        write_output(script)
    return 0


def completion_script(shell: str) -> str:
    """Return the completion script of one of `SHELLS`, generated from the parsers of all commands."""
    import shtab

    from dart_flight.cli import COMMANDS, build_parser

    parser = build_parser(COMMANDS)
    _complete_paths(parser, dict.fromkeys(_FILES, shtab.FILE) | dict.fromkeys(_FOLDERS, shtab.DIRECTORY))
    return str(shtab.complete(parser, shell))


def _complete_paths(parser: argparse.ArgumentParser, by_metavar: dict[str, Any]) -> None:
    """Let the shell complete paths for arguments whose placeholder is a file or a folder."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                _complete_paths(sub, by_metavar)
        elif isinstance(action.metavar, str) and action.metavar in by_metavar:
            action.complete = by_metavar[action.metavar]  # type: ignore[attr-defined]
