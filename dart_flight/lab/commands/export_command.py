"""`dart-flight export LOG...`: flight logs as CSV files, or as MCAP files with standard schemas."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dart_flight.cli.terminal import emit_json, print_status
from dart_flight.config.document import InputError

FOXGLOVE_NAME = "foxglove.mcap"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", nargs="+", metavar="LOG", help="flight.mcap, or a folder of flights")
    parser.add_argument(
        "--foxglove",
        action="store_true",
        help="write an MCAP file with standard schemas, for the 3D views of Foxglove, Lichtblick and Rerun",
    )
    parser.add_argument(
        "--scene",
        type=Path,
        metavar="FILE",
        help="write the playback of one flight as an HTML page that needs neither a server nor a network",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="PATH",
        help="folder of the CSV files (default: csv beside the log); each of several logs gets a subfolder. "
        f"With --foxglove: output file (default: {FOXGLOVE_NAME} beside the log), or a folder for the files "
        "of several logs",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command; --json prints one object, or a list for several logs."""
    from dart_flight.recording.found import find_logs

    paths = find_logs(arguments.logs)
    if arguments.scene is not None:
        return _export_scene(paths, arguments)
    export = _export_foxglove if arguments.foxglove else _export_csv
    places = _files(paths, arguments.output) if arguments.foxglove else _folders(paths, arguments.output)
    exports = [export(path, place) for path, place in zip(paths, places, strict=True)]
    if arguments.json:
        emit_json(exports[0] if len(exports) == 1 else {"exports": exports})
    return 0


def _export_scene(paths: list[Path], arguments: argparse.Namespace) -> int:
    from dart_flight.lab.studio.scene_page import write_scene
    from dart_flight.recording.reader import read_log

    if len(paths) > 1:
        raise InputError(f"writes one flight, not {len(paths)}", key=("--scene",))
    if arguments.foxglove or arguments.output is not None:
        raise InputError("cannot be combined with --foxglove or --output", key=("--scene",))
    log = read_log(paths[0])
    write_scene(log, arguments.scene)
    _print_result(f"{paths[0]}: playback in {arguments.scene}", log.complete)
    if arguments.json:
        emit_json({"files": [str(arguments.scene)], "log": str(paths[0])})
    return 0


def _export_csv(path: Path, folder: Path) -> dict[str, Any]:
    from dart_flight.lab.scene.csv_export import export_csv
    from dart_flight.recording.reader import read_log

    log = read_log(path)
    files = export_csv(log, folder)
    _print_result(f"{path}: {len(log.entries)} records in {len(files)} files in {folder}", log.complete)
    return {"files": [str(file) for file in files], "records": len(log.entries), "log": str(path)}


def _export_foxglove(path: Path, file: Path) -> dict[str, Any]:
    from dart_flight.lab.scene.foxglove_export import export_foxglove
    from dart_flight.recording.reader import read_log

    log = read_log(path)
    count = export_foxglove(log, file)
    _print_result(f"{path}: {count} messages in {file}", log.complete)
    return {"files": [str(file)], "messages": count, "log": str(path)}


def _print_result(line: str, complete: bool) -> None:
    cut = "" if complete else "; the log is cut short, and the part before the cut is exported"
    print_status(f"{line}{cut}")


def _folders(logs: list[Path], output: Path | None) -> list[Path]:
    """Return a different output folder for each log."""
    if output is None:
        return [log.parent / ("csv" if log.stem == "flight" else f"{log.stem}_csv") for log in logs]
    if len(logs) == 1:
        return [output]
    return [output / name for name in _names(logs)]


def _files(logs: list[Path], output: Path | None) -> list[Path]:
    if output is None:
        names = [FOXGLOVE_NAME if log.stem == "flight" else f"{log.stem}_{FOXGLOVE_NAME}" for log in logs]
        return [log.with_name(name) for log, name in zip(logs, names, strict=True)]
    if len(logs) == 1 and not output.is_dir():
        # Viewers recognise the format by the file extension.
        return [output if output.suffix else output.with_name(f"{output.name}.mcap")]
    return [output / f"{name}.mcap" for name in _names(logs)]


def _names(logs: list[Path]) -> list[str]:
    names: list[str] = []
    for log in logs:
        base = name = log.resolve().parent.name if log.stem == "flight" else log.stem
        number = 1
        while name in names:
            number += 1
            name = f"{base}-{number}"
        names.append(name)
    return names
